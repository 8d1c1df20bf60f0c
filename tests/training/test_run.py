"""Runs: the files they write, how they stop and resume, and what they refuse.

The network does not matter here; ``tests/cli/test_train.py`` trains FCOS-LiDAR's.
"""

import contextlib
import dataclasses
import functools
import io
import json
import os
import re
import resource
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from unittest.mock import Mock

import jax
import numpy as np
import pytest
from commands import contents
from event_files import summaries
from linear_network import linear_network
from PIL import Image
from tiny_run import CONFIG, FRAMES, LOOK, REFINED, SENSOR, STEPS, TESTS, bits, train_tiny, weights

from fcos_lidar_jax.checkpoints import load_checkpoint, load_state
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli import exit_code
from fcos_lidar_jax.config import CopyPasteConfig
from fcos_lidar_jax.data.frame import Frame, InMemoryFrames
from fcos_lidar_jax.devices.feeding import feed
from fcos_lidar_jax.devices.mesh import make_mesh
from fcos_lidar_jax.input_pipeline import loader
from fcos_lidar_jax.input_pipeline.database import prepare_database
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.training import plan
from fcos_lidar_jax.training import run as runs
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.types import HostBatch


@pytest.fixture(scope="module", autouse=True)
def traces():
    """All runs of this module share one step; the list grows with each trace of it."""
    traces, made = [], {}
    with linear_network(), pytest.MonkeyPatch.context() as patch:
        make_train_step = runs.make_train_step

        def shared_step(*args):
            step = make_train_step(*args)

            @functools.wraps(step)  # keeps the name of the compiled program, which other processes share
            def counted(state, batch):
                traces.append(1)
                return step(state, batch)

            return made.setdefault("step", counted)

        patch.setattr(runs, "make_train_step", shared_step)
        yield traces


@pytest.fixture(scope="module")
def finished(tmp_path_factory, traces):
    """An uninterrupted run: its folder, last state, number of traces of its step, and calls of its hook."""
    folder, calls = tmp_path_factory.mktemp("finished") / "run", []
    options = {"evaluate": 2, "tests": TESTS, "weights": weights()}
    state = train_tiny(folder, **options, hooks=[lambda *call: calls.append(call)])
    return folder, state, len(traces), calls


@pytest.fixture
def begun(finished, tmp_path) -> Path:
    """A folder that only holds the specification of the run."""
    folder = tmp_path / "begun"
    folder.mkdir()
    shutil.copy(finished[0] / "run.json", folder)
    return folder


def scores(folder: Path) -> dict[int, float]:
    return {line["step"]: line["test/mAP"] for line in read_metrics(folder) if "test/mAP" in line}


def checkpoint_names(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "checkpoints").glob("*"))


def test_a_step_is_compiled_once(finished):
    _, state, traces, _ = finished
    assert int(state.step) == STEPS
    assert traces == 1


RAY = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, regression_axes="ray"))
REVERSED = dataclasses.replace(CONFIG, classes=NUSCENES_CLASSES[::-1])
TRAINED = "^warning: .*: weights trained"
OTHERS = {  # what differs from the network and the sensor of the weights, and what is told
    "coding": (RAY, {}, "weights of model.regression_axes 'lidar', to be trained with 'ray'$"),
    "classes": (REVERSED, {}, r"these start with random weights: predictions \(2 of 2 arrays\)"),
    "name": (CONFIG, {"name": "mine", "limit_xy_m": 20.0}, None),
    "heading": (CONFIG, {"forward_rad": SENSOR.forward_rad - np.pi / 2}, f"{TRAINED} on clouds rotated by 90 deg"),
    "place": (CONFIG, {"origin_m": (1.4, 0, 1.6)}, rf"{TRAINED} .*\(0.0, 0.0, 0.0\) m, here at \(1.4, 0, 1.6\)"),
    "columns": (CONFIG, {"num_columns": 128}, rf"{TRAINED} .*, here sensor 'tiny' \(16 beams, 128 columns\): the"),
    "beams": (
        *(CONFIG, {"name": "few", "inclinations_rad": SENSOR.inclinations_rad[::2]}),
        rf"{TRAINED} for sensor 'tiny' \(16 beams, 64 columns\), here sensor 'few' \(8 beams, 64 columns\): ",
    ),
}


@pytest.mark.parametrize("other", OTHERS)
def test_initial_weights_of_another_network_or_sensor_are_reported(finished, capsys, other):
    config, changes, message = OTHERS[other]
    plan._initial_weights(build_detector(config, dataclasses.replace(SENSOR, **changes)), finished[0])
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == (message is not None)
    assert all(re.search(message, line) for line in lines)


def test_a_frozen_detector_keeps_its_classes(finished):
    frozen = dataclasses.replace(FROZEN, classes=REVERSED.classes)
    with pytest.raises(ValueError, match=r"freeze_detector: got True, expected False, or the classes of .*: car,"):
        plan._initial_weights(build_detector(frozen, SENSOR), finished[0])


def test_initial_weights_in_half_precision_are_trained_in_float32():
    half = jax.tree.map(lambda leaf: np.asarray(leaf, np.float16), weights())
    taken = plan._initial_weights(build_detector(CONFIG, SENSOR), half)
    assert bits(taken) == bits(jax.tree.map(lambda leaf: leaf.astype(np.float32), half))


def test_the_hook_of_the_page_stops_a_run_without_better_scores(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "training.md").read_text()
    exec(re.search(r"```python\n(import signal\n.*?)```", page, re.DOTALL)[1], given := {})
    monkeypatch.setattr(runs, "_evaluate", lambda _, number, *rest: {"test/mAP": min(number, 3) / 10})
    options = {"tests": TESTS, "weights": weights(), "hooks": [given["stop_early"]]}
    with pytest.raises(KeyboardInterrupt):
        train_tiny(tmp_path / "run", steps=20, evaluate=1, **options)
    assert given["scores"] == [0.1, 0.2, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3]
    assert checkpoint_names(tmp_path / "run")[-1] == "00000009"  # the step after the sixth that is not better


def test_all_documented_metrics_are_recorded(finished):
    lines = read_metrics(finished[0])
    steps = [line for line in lines if "loss/total" in line]
    tests = [line for line in lines if "test/mAP" in line]
    assert [line["step"] for line in steps] == [1, 2, 3, 4]
    assert [line["step"] for line in tests] == [2, 4]
    parts = ("classification", "l1", "iou", "iou_prediction")
    counts = {"truncated_points", "truncated_boxes", "invalid_points", "pasted_objects", "dropped_points"}
    for line in steps:
        weighted = sum(getattr(CONFIG.loss, f"{part}_weight") * line[f"loss/{part}"] for part in parts)
        assert line["loss/total"] == pytest.approx(weighted, rel=1e-5)
        assert sum(line["positives_per_level"]) == line["positives"] > 0
        assert line["unique_positives"] <= line["positives"]
        assert line["mean_k"] == pytest.approx(line["positives"] / line["owned_boxes"])
        assert 0 <= line["positive_iou"] <= 1
        assert line["gradient_norm"] > 0
        assert line["samples_per_second"] == pytest.approx(CONFIG.optimizer.batch_size / line["seconds"])
        assert 0 <= line["waiting_seconds"] <= line["seconds"]
        assert counts <= line.keys()
    peak = CONFIG.optimizer.peak_learning_rate
    # The first of four steps is at a tenth of the peak, the second at the peak.
    np.testing.assert_allclose([line["learning_rate"] for line in steps[:2]], [peak / 10, peak], rtol=1e-5)
    np.testing.assert_allclose([line["b1"] for line in steps[:2]], [0.95, 0.85], rtol=1e-5)
    assert [(step, "test/mAP" in values) for step, values in finished[3]] == [
        *((1, False), (2, False), (2, True)),
        *((3, False), (4, False), (4, True)),
    ]
    for line in tests:
        aps = [line[f"test/AP/{name}"] for name in NUSCENES_CLASSES if f"test/AP/{name}" in line]
        assert line["test/mAP"] == pytest.approx(np.mean(aps))
        assert "test/NDS" not in line


def test_the_folder_holds_specification_checkpoints_curves_and_pictures(finished):
    folder, state, *_ = finished
    names = ".lock run.json metrics.jsonl tensorboard checkpoints pictures loss.png scores.png"
    assert {path.name for path in folder.iterdir()} == set(names.split())
    maps = scores(folder)
    best = max(maps, key=lambda step: (maps[step], step))
    assert checkpoint_names(folder) == [f"{step:08d}" for step in sorted({3, 4, best})]
    frames = [f"step_{step:06d}_frame_{index}.png" for step in (2, 4) for index in (0, 1)]
    assert sorted(path.name for path in (folder / "pictures").iterdir()) == frames
    images = {(tag, step): value for tag, step, value in summaries(folder / "tensorboard") if "frame" in tag}
    assert len(images) == 4
    for (tag, step), image in images.items():
        png = (folder / "pictures" / f"step_{step:06d}_{tag.removeprefix('test/')}.png").read_bytes()
        height, width = np.asarray(Image.open(io.BytesIO(png))).shape[:2]
        assert (image.height, image.width, image.encoded_image_string) == (height, width, png)
    for picture in folder.rglob("*.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")
    last = load_checkpoint(folder / "checkpoints" / "00000004")
    spec = json.loads((folder / "run.json").read_text())
    assert spec["config"]["sensor"] == spec["sensor"]["name"] == "tiny" != CONFIG.sensor
    assert (spec["data"], spec["frames"], spec["steps"]) == (FRAMES.fingerprint(), 12, STEPS)
    assert json.loads(last.data) == {name: spec[name] for name in ("data", "frames", "weights")}
    assert (last.step, last.score) == (4, maps[4])
    # The running mean of the weights is used for detection.
    assert bits(last.variables) == bits({"params": state.ema, "batch_stats": state.batch_stats})
    assert bits(load_state(folder / "checkpoints" / "00000004", state)) == bits(state)


def test_resuming_a_finished_run_changes_nothing(finished, capsys):
    folder, state, *_ = finished
    before = contents(folder)
    (folder / "loss.png").unlink()  # as if the run had been ended before
    assert bits(train_tiny(folder, evaluate=2, tests=TESTS, resume=True)) == bits(state)
    assert "the run is complete, with 4 steps" in capsys.readouterr().err
    assert contents(folder) == before


def disturb(monkeypatch, at: int, how) -> None:
    """Call a function when the run takes one of its batches, which may have been made long before."""
    first = 0

    def make_batches(*args, first_step, **kwargs):
        nonlocal first
        first = first_step
        return loader.make_batches(*args, first_step=first_step, **kwargs)

    @contextlib.contextmanager
    def disturbed(batches, mesh):
        with feed(batches, mesh) as stream:
            yield (how(host) if step == at else host for step, host in enumerate(stream, start=first))

    monkeypatch.setattr(runs, "make_batches", make_batches)
    monkeypatch.setattr(runs, "feed", disturbed)


def signalled(number: int):
    def send(host):
        os.kill(os.getpid(), number)
        return host

    return send


def overflowing(host):
    points = host.batch.points.at[1, :, 3].set(3e38)  # finite, until the network sums it
    return dataclasses.replace(host, batch=dataclasses.replace(host.batch, points=points))


def without_times(folder: Path) -> list[dict]:
    times = {"seconds", "waiting_seconds", "samples_per_second"}
    return [{name: line[name] for name in line.keys() - times} for line in read_metrics(folder)]


def fill_disk(host):
    """Fail like a full disk from now on, by a limit of the file size."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    return host


@pytest.fixture
def limits():
    """The limits of the file size, which are restored after the test."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield limits
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def unrecorded(folder: Path) -> None:
    *kept, last = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    assert "test/mAP" in last
    (folder / "metrics.jsonl").write_text("".join(kept))


class Event(NamedTuple):
    """How a run ends early. Steps 2 and 4 are evaluated, and step 2 has the best score."""

    step: int  # the number of steps before it
    happens: Callable[[HostBatch], HostBatch]  # in the next step
    code: int  # the exit code
    left: str  # checkpoints in the folder afterwards
    said: str  # when the run stops or resumes
    save: int = 9  # steps between two checkpoints
    change: Callable[[Path], None] | None = None  # of the folder, before the run resumes


TERM = signalled(signal.SIGTERM)
EVENTS = {
    "Ctrl-C": Event(1, signalled(signal.SIGINT), 130, "00000002", "stopped after step 2, which is saved"),
    "SIGTERM": Event(2, TERM, 143, "00000002 00000003", "stopped after step 3, which is saved"),
    "SIGTERM before the first step": Event(0, TERM, 143, "", ""),
    "SIGTERM before an evaluation": Event(1, TERM, 143, "00000001 00000002", "stopped after step 2", save=1),
    # The exit code tells a script that no further run starts.
    "SIGTERM in the last step, and a kill before its evaluation is recorded": Event(
        3, TERM, 143, "00000002 00000004", "resuming after step 4", change=unrecorded
    ),
    "a loss that is not finite": Event(
        2, overflowing, 1, "00000001 00000002", "; the last checkpoint is ", save=1
    ),
    "a full disk": Event(
        2, fill_disk, 1, "00000001 00000002", "00000003: cannot be written: File too large\n", save=1
    ),
}


def exit_code_of(run: Callable[[], object]) -> int | str | None:
    try:
        return exit_code("train", run)
    except SystemExit as stop:
        return stop.code


@pytest.mark.slow
@pytest.mark.parametrize("event", EVENTS.values(), ids=EVENTS)
def test_a_run_that_ends_early_resumes_bit_identical(finished, tmp_path, capsys, monkeypatch, limits, event):
    whole, state, *_ = finished
    folder = tmp_path / "run"
    options = {"save": event.save, "evaluate": 2, "tests": TESTS, "weights": weights()}
    monkeypatch.setattr(runs, "draw_metrics", Mock())
    monkeypatch.setattr(runs, "draw_predictions", Mock(return_value=[]))
    disturb(monkeypatch, event.step, event.happens)
    assert exit_code_of(lambda: train_tiny(folder, **options)) == event.code
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    if event.change is not None:
        event.change(folder)
    assert checkpoint_names(folder) == event.left.split()
    disturb(monkeypatch, -1, None)
    assert bits(train_tiny(folder, resume=True, **options)) == bits(state)
    told = capsys.readouterr().err
    assert event.said in told
    assert "Traceback" not in told
    assert without_times(folder) == without_times(whole)


@pytest.mark.slow
def test_a_run_that_is_killed_in_its_only_save_begins_again(finished, begun):
    lines = (line for line in read_metrics(finished[0]) if "test/mAP" not in line)
    (begun / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert bits(train_tiny(begun, save=9, tests=TESTS, resume=True, weights=weights())) == bits(finished[1])
    assert checkpoint_names(begun) == ["00000004"]


def let_others_differ(monkeypatch, of: str) -> list:
    """Let another process have other data ``of`` some kind; returns the checksums of this process."""

    def check_same(checksum, what):
        if what == of:
            checksums.append(checksum)
            raise ValueError(f"process 1: {what}")

    checksums = []
    monkeypatch.setattr(runs, "check_same", check_same)
    return checksums


def test_processes_with_other_data_are_refused_before_the_run_starts(tmp_path, monkeypatch):
    checksums = let_others_differ(monkeypatch, "configuration or data")
    one_frame = {"frames": InMemoryFrames((TESTS.frame(0),), TESTS.sensor, NUSCENES_CLASSES)}
    for options in (one_frame, {}, {}):
        with pytest.raises(ValueError, match=r"^process 1: configuration or data$"):
            train_tiny(tmp_path / "run", **options)
    assert checksums[0] != checksums[1] == checksums[2]
    assert list(tmp_path.iterdir()) == []


def test_processes_that_find_other_checkpoints_are_refused(finished, tmp_path, monkeypatch):
    checksums = let_others_differ(monkeypatch, "checkpoint to resume from")
    done, new = shutil.copytree(finished[0], tmp_path / "done"), tmp_path / "new"
    for folder, options in ((done, {"resume": True}), (new, {}), (new, {"resume": True})):
        with pytest.raises(ValueError, match=r"^process 1: checkpoint to resume from$"):
            train_tiny(folder, evaluate=2, tests=TESTS, **options)
    assert checksums[0] != checksums[1] == checksums[2]


@pytest.mark.slow
def test_a_checkpoint_without_a_mean_ap_is_saved_without_a_score(tmp_path, capsys):
    """The test frames have no boxes, so the mean over classes is NaN."""
    none = np.zeros(0, np.int32)
    bare = dataclasses.replace(TESTS.frame(0), boxes=np.zeros((0, 9), np.float32), labels=none, num_points=none)
    tests = InMemoryFrames((bare,), TESTS.sensor, NUSCENES_CLASSES)
    train_tiny(tmp_path, steps=1, evaluate=1, tests=tests, weights=weights())
    assert "step 1: mAP by centre distance nan" in capsys.readouterr().err
    assert load_checkpoint(tmp_path / "checkpoints" / "00000001").score is None
    records = read_metrics(tmp_path)
    train_tiny(tmp_path, steps=1, evaluate=1, tests=tests, resume=True, weights=weights())
    assert len(read_metrics(tmp_path)) == len(records)  # it is not evaluated again


@pytest.mark.parametrize(
    ("field", "value", "got"),
    [
        ("config.loss.l1_weight", 9.0, "0.25"),
        ("config.model.remat", None, "False"),
        ("steps", 5, "4"),
        ("data", "other frames", ""),
    ],
)
def test_a_different_specification_is_refused_and_the_field_named(begun, field, value, got):
    spec = json.loads((begun / "run.json").read_text())
    *path, name = field.split(".")
    place = functools.reduce(dict.__getitem__, path, spec)
    place[name] = value
    if value is None:
        del place[name]
    (begun / "run.json").write_text(json.dumps(spec))
    was = repr("nothing" if value is None else value)
    with pytest.raises(
        ValueError, match=rf"run.json: {field}: was {was}, got {got}.*: only the same run can be resumed$"
    ):
        train_tiny(begun, resume=True)
    assert [path.name for path in begun.iterdir()] == ["run.json"]


def test_a_different_ground_truth_database_of_the_same_frames_is_refused(begun, tmp_path):
    config = dataclasses.replace(CONFIG, copy_paste=CopyPasteConfig())
    first, other = (prepare_database(FRAMES, tmp_path / str(n), min_points=n) for n in (6, 5))
    spec = json.loads((begun / "run.json").read_text()) | {"objects": first.manifest.source}
    spec |= {"config": plan.recorded_config(config, FRAMES), "ground_truth_database": first.fingerprint()}
    (begun / "run.json").write_text(json.dumps(spec))
    message = f"ground_truth_database: was '{first.fingerprint()}', got '{other.fingerprint()}': only the same run"
    with pytest.raises(ValueError, match=message):
        train_tiny(begun, resume=True, config=config, objects=other)


LOST = "checkpoints: found none, but metrics of 4 steps, and this schedule saves step"
AGAIN = {"resume": True}
REFUSED = {  # what is removed from the folder of a run and written to it, options, and the error
    "another run": ("", {}, {}, "holds a run, expected another folder or --resume, in Python resume=T"),
    "no folder": (".", {}, AGAIN, "run.json: no such file, expected the specification of the run to resume"),
    "no JSON": ("", {"run.json": "{"}, AGAIN, "run.json: not JSON"),
    "metrics": ("run.json checkpoints", {}, {}, "holds a run, expected another folder"),
    "checkpoints": ("run.json metrics.jsonl", {}, {}, "holds a run, expected another folder"),
    "no checkpoints": ("checkpoints", {}, AGAIN, f"{LOST} 1: expected the"),
    "no last checkpoint": ("checkpoints", {}, {"resume": True, "save": 9, "evaluate": 9}, f"{LOST} 4"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_folder_without_the_run_is_refused_and_unchanged(finished, tmp_path, case):
    removed, written, options, message = REFUSED[case]
    folder = shutil.copytree(finished[0], tmp_path / "run")
    for path in (folder / name for name in removed.split()):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for name, text in written.items():
        (folder / name).write_text(text)
    before = contents(tmp_path), set(tmp_path.rglob("*"))
    with pytest.raises(ValueError, match=message):
        train_tiny(folder, **{"evaluate": 2, "tests": TESTS, "weights": weights(), **options})
    assert (contents(tmp_path), set(tmp_path.rglob("*"))) == before


def test_other_weights_behind_a_path_are_refused_if_the_run_would_read_them_again(finished, begun):
    spec = json.loads((begun / "run.json").read_text())
    other = spec | {"weights_hash": "0123"}
    plan.check_run(finished[0], other, resume=True)  # from its own checkpoint
    with pytest.raises(ValueError, match=r"run.json: weights_hash: was '\w+', got '0123': only the same run"):
        plan.check_run(begun, other, resume=True)
    del spec["weights_hash"]  # as in a run of an earlier version
    (begun / "run.json").write_text(json.dumps(spec))
    plan.check_run(begun, other, resume=True)


def test_a_resumed_run_keeps_its_first_weights_without_their_name(finished, tmp_path):
    folder = shutil.copytree(finished[0], tmp_path / "run")
    spec = json.loads((folder / "run.json").read_text()) | {"weights": "elsewhere"}
    (folder / "run.json").write_text(json.dumps(spec))
    again = plan.RunSpec(CONFIG, FRAMES, folder, steps=STEPS, tests=TESTS, resume=True)
    assert plan.plan_run(again, make_mesh(jax.local_devices()[:1])).record["weights"] == "elsewhere"
    frozen = dataclasses.replace(again, config=FROZEN)  # the arrays are in its checkpoints
    assert plan.plan_run(frozen, make_mesh(jax.local_devices()[:1])).weights is None


def in_memory(*frames: Frame) -> InMemoryFrames:
    return InMemoryFrames(frames, FRAMES.sensor, FRAMES.classes)


def without_points(frame: Frame) -> Frame:
    return dataclasses.replace(frame, num_points=0 * frame.num_points)


def far(frame: Frame) -> Frame:
    return dataclasses.replace(frame, points=frame.points * np.float32([1000, 1000, 1000, 1, 1]))


GIVEN = [FRAMES.frame(index) for index in range(3)]
WARNINGS = {
    "boxes without points": (
        [GIVEN[0], *map(without_points, GIVEN[1:])],
        "contain no point and are not learned: are points and boxes in the same frame?",
    ),
    "another sensor": ([GIVEN[0], far(GIVEN[1])], "^frame 1: points do not fit sensor 'tiny'"),
    "nothing": (GIVEN, None),
}


@pytest.mark.parametrize("case", WARNINGS)
def test_data_that_may_not_be_learned_are_reported(case):
    frames, message = WARNINGS[case]
    lines = list(plan._warnings(in_memory(*frames), CONFIG))
    assert len(lines) == (message is not None)
    assert all(re.search(message, line) for line in lines)


def test_single_sweeps_are_reported_if_several_are_configured(tmp_path, capsys):
    train_tiny(tmp_path / "run", config=dataclasses.replace(CONFIG, num_sweeps=3), steps=1)
    assert "warning: num_sweeps: got 3, but the frames hold one sweep each: expected 1" in capsys.readouterr().err


class PartialFrames(InMemoryFrames):
    def check_files(self, indices):
        raise ValueError(f"{len([*indices])} keyframes are missing")


class UnreadableFrames(InMemoryFrames):
    def frame(self, index):
        raise ValueError("clouds/0.npy: empty file")


def rings(frame: Frame) -> Frame:
    points = frame.points.copy()
    points[:, 4] = np.arange(len(points)) % 16 / 15
    return dataclasses.replace(frame, points=points)


PARTIAL = PartialFrames(tuple(GIVEN[:2]), FRAMES.sensor, FRAMES.classes)
UNREADABLE = UnreadableFrames((GIVEN[0],), FRAMES.sensor, FRAMES.classes)
FROZEN = dataclasses.replace(REFINED, refinement=dataclasses.replace(LOOK, freeze_detector=True))
OTHER_NETWORK = {"params": {"kernel": np.ones(3)}, "batch_stats": {}}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 2.5}, "steps: got 2.5, expected an integer from 1 to 2147483647"),
        ({"seed": 2**32}, "seed: got 4294967296, expected an integer from 0 to 4294967295"),
        ({"config": dataclasses.replace(CONFIG, copy_paste=CopyPasteConfig())}, "copy_paste: got no ground-truth"),
        ({"config": FROZEN}, "refinement.freeze_detector: got True, expected False without weights of a detector"),
        ({"frames": "my_lidar"}, "frames: got 'str', expected a set of frames, as open_frames returns"),
        ({"threads": -1}, "threads: got -1, expected at least 0"),
        ({"frames": UNREADABLE}, "clouds/0.npy: empty file"),
        ({"frames": PARTIAL}, "2 keyframes are missing"),
        ({"tests": PARTIAL}, "2 keyframes are missing"),
        ({"frames": in_memory(*map(without_points, GIVEN))}, "boxes of 3 frames contain no point, expected some"),
        ({"frames": in_memory(rings(GIVEN[0]))}, "frame 0: fifth column: got 16 different values up to 1"),
        ({"weights": OTHER_NETWORK}, "^weights: .*: the arrays do not belong to the network to be trained"),
    ],
)
def test_invalid_arguments_are_refused_before_the_run_starts(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        runs.train(out=tmp_path / "run", **{"config": CONFIG, "frames": FRAMES, "steps": 1, **options})
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("steps", "every", "expected"),
    [
        (20, None, [20]),
        (250, None, [100, 200, 250]),
        (2001, None, [201, 402, 603, 804, 1005, 1206, 1407, 1608, 1809, 2001]),
        (20, 8, [8, 16, 20]),
    ],
)
def test_short_runs_evaluate_rarely_by_default(steps, every, expected):
    run = Mock(steps=steps, schedule=plan.Schedule(evaluate_every=every))
    assert [step for step in range(1, steps + 1) if plan.RunSpec.evaluates_at(run, step)] == expected

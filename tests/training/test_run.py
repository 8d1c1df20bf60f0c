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
import shutil
import signal
from pathlib import Path
from unittest.mock import Mock

import jax
import numpy as np
import pytest
from commands import run_python
from event_files import summaries
from linear_network import linear_network
from PIL import Image
from tiny_run import CONFIG, FRAMES, SENSOR, STEPS, TESTS, bits, train_tiny, weights

from fcos_lidar_jax.checkpoints import Checkpoint, load_checkpoint, load_state, save_checkpoint
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli import exit_code
from fcos_lidar_jax.config import CopyPasteConfig
from fcos_lidar_jax.data.frame import Frame, InMemoryFrames
from fcos_lidar_jax.devices.feeding import feed
from fcos_lidar_jax.input_pipeline import loader
from fcos_lidar_jax.input_pipeline.database import prepare_database
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.training import NonFiniteLossError, plan
from fcos_lidar_jax.training import run as runs
from fcos_lidar_jax.training.metrics_log import read_metrics


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
    """An uninterrupted run: its folder, its last state, and the number of traces of its step."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    state = train_tiny(folder, evaluate=2, tests=TESTS, weights=weights())
    return folder, state, len(traces)


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
    return sorted(path.name for path in (folder / "checkpoints").iterdir())


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_step_is_compiled_once(finished):
    _, state, traces = finished
    assert int(state.step) == STEPS
    assert traces == 1


def test_initial_weights_of_another_coding_are_reported(finished, tmp_path, capsys):
    model = dataclasses.replace(CONFIG.model, regression_axes="ray")
    for config in (CONFIG, dataclasses.replace(CONFIG, model=model)):
        train_tiny(tmp_path / config.model.regression_axes, config=config, steps=1, weights=finished[0])
    lines = capsys.readouterr().err.splitlines()
    (line,) = [line for line in lines if "weights of" in line]
    assert line.endswith("weights of model.regression_axes 'lidar', to be trained with 'ray'")
    assert not any(line.startswith("warning: ") for line in lines)


OTHERS = {  # what differs from the sensor of the weights, and the warning
    "the same": ({}, None),
    "name": ({"name": "mine", "limit_xy_m": 20.0}, None),
    "heading": (
        {"forward_rad": SENSOR.forward_rad - np.pi / 2},
        "on clouds rotated by 90 degrees relative to these: ",
    ),
    "place": ({"origin_m": (1.4, 0, 1.6)}, r"with the LiDAR at \(0.0, 0.0, 0.0\) m, here at \(1.4, 0, 1.6\) m: "),
    "columns": (
        {"name": "fine", "num_columns": 128},
        r"for sensor 'tiny' .*, here sensor 'fine' \(16 beams, 128 columns\): the arrays fit, but not the beams",
    ),
    "beams": (
        {"name": "few", "inclinations_rad": SENSOR.inclinations_rad[::2]},
        r"for sensor 'tiny' \(16 beams, 64 columns\), here sensor 'few' \(8 beams, 64 columns\): ",
    ),
}


@pytest.mark.parametrize("other", OTHERS)
def test_initial_weights_of_another_sensor_are_reported(finished, capsys, other):
    changes, message = OTHERS[other]
    plan._initial_weights(build_detector(CONFIG, dataclasses.replace(SENSOR, **changes)), finished[0])
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == (message is not None)
    assert all(re.search(f"^warning: .*: weights trained {message}", line) for line in lines)


@pytest.mark.parametrize("classes", [("car",), NUSCENES_CLASSES[::-1]])
def test_initial_weights_for_other_classes_are_taken_where_they_fit(finished, capsys, classes):
    detector = build_detector(dataclasses.replace(CONFIG, classes=classes), SENSOR)
    given, taken = load_checkpoint(finished[0]).variables, plan._initial_weights(detector, finished[0])
    assert bits(given["params"]["norm"]) == bits(taken["params"]["norm"])
    assert bits(given["params"]["predictions"]) != bits(taken["params"]["predictions"])
    assert "these start with random weights: predictions (2 of 2 arrays)" in capsys.readouterr().err


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
    for line in tests:
        aps = [line[f"test/AP/{name}"] for name in NUSCENES_CLASSES if f"test/AP/{name}" in line]
        assert line["test/mAP"] == pytest.approx(np.mean(aps))
        assert "test/NDS" not in line


def test_the_folder_holds_specification_checkpoints_curves_and_pictures(finished):
    folder, state, _ = finished
    names = ".lock run.json metrics.jsonl tensorboard checkpoints pictures loss.png scores.png"
    assert {path.name for path in folder.iterdir()} == set(names.split())
    maps = scores(folder)
    best = max(maps, key=lambda step: (maps[step], step))
    assert checkpoint_names(folder) == [f"{step:08d}" for step in sorted({3, 4, best})]
    frames = [f"step_{step:06d}_frame_{index}.png" for step in (2, 4) for index in (0, 1)]
    assert sorted(path.name for path in (folder / "pictures").iterdir()) == frames
    images = {(tag, step): value for tag, step, value in summaries(folder / "tensorboard") if type(value) is dict}
    assert len(images) == 4
    for (tag, step), image in images.items():
        png = (folder / "pictures" / f"step_{step:06d}_{tag.removeprefix('test/')}.png").read_bytes()
        height, width = np.asarray(Image.open(io.BytesIO(png))).shape[:2]
        assert (image[1], image[2], image[4]) == (height, width, png)
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
    folder, state, _ = finished
    before = contents(folder)
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


def cut_description(folder: Path) -> None:
    newest = folder / "checkpoints" / "00000003" / "checkpoint.json"
    newest.write_text(newest.read_text()[:-9])


# How a run ends: the step and what happens in it, the steps between its saves, a change of its folder afterwards;
# then the checkpoints in the folder, and what is said when the run stops or resumes. Steps 2 and 4 are evaluated.
TERM = signalled(signal.SIGTERM)
EVENTS = {
    "Ctrl-C": (1, signalled(signal.SIGINT), 9, None, "2", "stopped after step 2, which is saved"),
    "SIGTERM": (2, TERM, 9, None, "2 3", "stopped after step 3, which is saved"),
    "SIGTERM in a step that is evaluated": (1, TERM, 1, None, "1 2", "stopped after step 2"),
    "SIGTERM in the last step": (3, TERM, 9, None, "2 4", "stopped after step 4"),  # so that no further run starts
    "a loss that is not finite": (2, overflowing, 1, None, "1 2", ""),
    "a damaged checkpoint": (2, TERM, 1, cut_description, "2 3", "going back to the checkpoint before"),
}


@pytest.mark.slow
@pytest.mark.parametrize("event", EVENTS)
def test_a_run_that_ends_early_resumes_bit_identical(finished, tmp_path, capsys, monkeypatch, event):
    step, happens, save, change, left, said = EVENTS[event]
    whole, state, _ = finished
    folder, options = tmp_path / "run", {"save": save, "evaluate": 2, "tests": TESTS}

    def run():
        train_tiny(folder, weights=weights(), **options)

    disturb(monkeypatch, step, happens)
    if happens is overflowing:
        message = r"^step 3: not finite: .*; samples: seed \d+, seed \d+; the last checkpoint is .*/00000002$"
        with pytest.raises(NonFiniteLossError, match=message):
            run()
    elif event == "Ctrl-C":
        with pytest.raises(KeyboardInterrupt):
            run()
    else:
        with pytest.raises(SystemExit, match="143"):
            exit_code("train", run)
    if change is not None:
        change(folder)
    assert checkpoint_names(folder) == [f"{int(number):08d}" for number in left.split()]
    disturb(monkeypatch, -1, None)
    assert bits(train_tiny(folder, resume=True, **options)) == bits(state)
    assert said in capsys.readouterr().err
    assert without_times(folder) == without_times(whole)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [STEPS - 1, STEPS])
def test_a_run_that_is_killed_in_its_last_step_or_only_save_begins_again(finished, tmp_path, steps):
    folder, options = tmp_path / "run", {"save": 9, "weights": weights()}
    train_tiny(folder, **options)
    shutil.rmtree(folder / "checkpoints")
    lines = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    (folder / "metrics.jsonl").write_text("".join(lines[:steps]))
    assert bits(train_tiny(folder, resume=True, **options)) == bits(finished[1])
    assert checkpoint_names(folder) == ["00000004"]


def test_processes_with_other_data_are_refused_before_the_run_starts(tmp_path, monkeypatch):
    def refuse(checksum, what):
        checksums.append(checksum)
        raise ValueError(f"process 1: {what}")

    checksums = []
    monkeypatch.setattr(runs, "check_same", refuse)
    one_frame = {"frames": InMemoryFrames((TESTS.frame(0),), TESTS.sensor, NUSCENES_CLASSES)}
    for options in (one_frame, {}, {}):
        with pytest.raises(ValueError, match=r"^process 1: configuration or data$"):
            train_tiny(tmp_path / "run", **options)
    assert len(set(checksums)) == 2
    assert checksums[1] == checksums[2]
    assert list(tmp_path.iterdir()) == []


def test_processes_that_find_other_checkpoints_are_refused(finished, tmp_path, monkeypatch):
    def refuse(checksum, what):
        if what == "checkpoint to resume from":
            checksums.append(checksum)
            raise ValueError(f"process 1: {what}")

    checksums = []
    monkeypatch.setattr(runs, "check_same", refuse)
    done, new = shutil.copytree(finished[0], tmp_path / "done"), tmp_path / "new"
    for folder, options in ((done, {"resume": True}), (new, {}), (new, {"resume": True})):
        with pytest.raises(ValueError, match=r"^process 1: checkpoint to resume from$"):
            train_tiny(folder, evaluate=2, tests=TESTS, **options)
    assert checksums[0] != checksums[1] == checksums[2]


@pytest.mark.slow
def test_weights_in_half_precision_are_trained_in_float32(tmp_path):
    half, same = (
        {"weights": jax.tree.map(cast, weights())}
        for cast in (
            lambda leaf: np.asarray(leaf, np.float16),
            lambda leaf: np.asarray(leaf, np.float16).astype(np.float32),
        )
    )
    assert bits(train_tiny(tmp_path / "half", **half)) == bits(train_tiny(tmp_path / "same", **same))


STOPPED = """
import os, resource, signal, sys
import linear_network
from tiny_run import train_tiny, weights
from fcos_lidar_jax.cli import exit_code
from fcos_lidar_jax.training import run
full, killed = sys.argv[1:]
linear_network.use()
make_train_step, made = run.make_train_step, {}
run.make_train_step = lambda *given: made.setdefault("step", make_train_step(*given))  # compiled once
limits = resource.getrlimit(resource.RLIMIT_FSIZE)
def fill(step, _):
    if step == 3:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, limits[1]))
assert exit_code("program", lambda: train_tiny(full, weights=weights(), hooks=[fill])) == 1
resource.setrlimit(resource.RLIMIT_FSIZE, limits)
# Called when the third checkpoint is written and not yet in its place.
os.chmod = lambda path, mode: ".00000003." in str(path) and os.kill(os.getpid(), signal.SIGKILL)
train_tiny(killed, weights=weights())
"""


@pytest.fixture(scope="module")
def stopped(finished, tmp_path_factory) -> tuple[Path, Path, list[str]]:
    """The folders of two runs of one process, and its messages: the disk was full, and the process was killed."""
    full, killed = (tmp_path_factory.mktemp(name) for name in ("full", "killed"))
    done = run_python("-c", STOPPED, full, killed)
    assert done.returncode == -signal.SIGKILL, done.stderr
    return full, killed, done.stderr.splitlines()


@pytest.mark.slow
def test_a_run_that_is_killed_while_saving_resumes_bit_identical(finished, stopped):
    _, folder, _ = stopped
    assert [name[:9] for name in checkpoint_names(folder)] == [".00000003", "00000001", "00000002"]
    assert bits(train_tiny(folder, resume=True)) == bits(finished[1])
    assert checkpoint_names(folder) == ["00000003", "00000004"]


@pytest.mark.slow
def test_a_run_that_is_killed_before_its_first_checkpoint_resumes_with_the_initial_weights(finished, begun):
    assert bits(train_tiny(begun, evaluate=2, tests=TESTS, resume=True, weights=weights())) == bits(finished[1])
    assert scores(begun) == scores(finished[0])  # the initial weights are not evaluated
    assert checkpoint_names(begun) == checkpoint_names(finished[0])


@pytest.mark.slow
def test_a_full_disk_is_reported_in_one_line_and_loses_no_checkpoint(stopped):
    """A limit of the file size, from the third checkpoint on, fails as a full disk does."""
    folder, _, messages = stopped
    lines = [line for line in messages if not line.startswith(("compiling ", "steps "))]
    lines = [line for line in lines if "cpu_aot_loader.cc" not in line]  # jaxlib 0.10.1 about its own cache
    refused = folder / "checkpoints" / "00000003"
    assert lines == [f"program: error: {refused}: cannot be written: File too large"]
    assert checkpoint_names(folder) == ["00000001", "00000002"]
    assert [load_checkpoint(path).step for path in sorted(refused.parent.iterdir())] == [1, 2]


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
        ("sensor.num_columns", 8, "64"),
        ("steps", 5, "4"),
        ("seed", 1, "0"),
        ("seed", None, "0"),
        ("ground_truth_database", None, "None"),
        ("ground_truth_database", "x", "None"),
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


LOST = "checkpoints: found none, but metrics of 4 steps, and this schedule saves step"
REFUSED = {  # what is removed from the folder of a run and written to it, options, and the error
    "another run": ("", {}, {}, "holds a run, expected another folder or --resume, in Python resume=T"),
    "no run": (
        "run.json metrics.jsonl checkpoints",
        {},
        {"resume": True},
        "run.json: found nothing, expected the run",
    ),
    "no folder": (".", {}, {"resume": True}, "run.json: found nothing, expected the run"),
    "no JSON": ("", {"run.json": "{"}, {"resume": True}, "run.json: not JSON"),
    "a checkpoint": ("run.json", {}, {}, "00000004: found a checkpoint without run.json, expected another"),
    "metrics": (
        "run.json checkpoints",
        {},
        {},
        r"metrics\.jsonl: found metrics without run\.json, expected another",
    ),
    "no checkpoints": ("checkpoints", {}, {"resume": True}, f"{LOST} 1: expected the"),
    "no last checkpoint": ("checkpoints", {}, {"resume": True, "save": 9, "evaluate": 9}, f"{LOST} 4"),
    "a file": (".", {".": ""}, {}, "found a file, expected a folder"),
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


@pytest.mark.parametrize("part", ["params", "network"])
def test_arrays_of_another_network_are_refused_before_anything_is_written(tmp_path, part):
    own = weights()
    given = own["params"] if part == "params" else {**own, "params": {"kernel": np.ones(3)}}
    with pytest.raises(ValueError, match=r"^weights: .*: the arrays do not belong to the network to be trained"):
        train_tiny(tmp_path / "run", weights=given)
    assert list(tmp_path.iterdir()) == []


def begin_again(run):
    """Make a run look as if it had been killed before its first checkpoint."""
    shutil.rmtree(run / "checkpoints")
    (run / "metrics.jsonl").unlink()


@pytest.mark.slow
def test_other_weights_behind_a_path_are_refused_if_the_run_would_read_them_again(tmp_path):
    start, run = tmp_path / "start", tmp_path / "run"
    options = {"weights": start, "steps": 1}
    first = weights()
    save_checkpoint(start, Checkpoint(CONFIG, SENSOR, first, 1))
    train_tiny(run, **options)
    other = jax.tree.map(lambda leaf: leaf * 2, first)
    save_checkpoint(start, Checkpoint(CONFIG, SENSOR, other, 1))
    train_tiny(run, resume=True, **options)  # from its own checkpoint
    begin_again(run)
    with pytest.raises(ValueError, match=r"run.json: weights_hash: was '\w+', got '\w+': only the same run"):
        train_tiny(run, resume=True, **options)
    save_checkpoint(start, Checkpoint(CONFIG, SENSOR, first, 2, score=0.5))  # the same weights
    train_tiny(run, resume=True, **options)
    spec = json.loads((run / "run.json").read_text())
    del spec["weights_hash"]  # as in a run of an earlier version
    (run / "run.json").write_text(json.dumps(spec))
    begin_again(run)
    save_checkpoint(start, Checkpoint(CONFIG, SENSOR, other, 1))
    train_tiny(run, resume=True, **options)


def test_a_different_ground_truth_database_of_the_same_frames_is_refused(begun, tmp_path):
    config = dataclasses.replace(CONFIG, copy_paste=CopyPasteConfig())
    first, other = (prepare_database(FRAMES, tmp_path / str(n), min_points=n) for n in (6, 5))
    assert first.manifest.source == other.manifest.source
    spec = json.loads((begun / "run.json").read_text()) | {"objects": first.manifest.source}
    spec |= {"config": plan.recorded_config(config, FRAMES), "ground_truth_database": first.fingerprint()}
    (begun / "run.json").write_text(json.dumps(spec))
    message = f"ground_truth_database: was '{first.fingerprint()}', got '{other.fingerprint()}': only the same run"
    with pytest.raises(ValueError, match=message):
        train_tiny(begun, resume=True, config=config, objects=other)


@pytest.mark.slow
def test_a_run_that_is_killed_during_an_evaluation_repeats_it_on_resume(finished, tmp_path, monkeypatch):
    folder, evaluate, evaluated = tmp_path / "run", runs._evaluate, []

    def killed(*_):
        raise SystemExit(137)

    def noted(run, number, *rest):
        evaluated.append(number)
        return evaluate(run, number, *rest)

    monkeypatch.setattr(runs, "_evaluate", killed)
    with pytest.raises(SystemExit):
        train_tiny(folder, evaluate=2, tests=TESTS, weights=weights())
    assert checkpoint_names(folder)[-1] == "00000002"
    assert load_checkpoint(folder / "checkpoints" / "00000002").score is None
    monkeypatch.setattr(runs, "_evaluate", noted)
    hooked = []
    options = {"hooks": [lambda *call: hooked.append(call)]}
    assert bits(train_tiny(folder, evaluate=2, tests=TESTS, resume=True, **options)) == bits(finished[1])
    assert evaluated == [2, 4]
    assert [(number, "test/mAP" in values) for number, values in hooked] == [
        (2, True),
        (3, False),
        (4, False),
        (4, True),
    ]
    assert {number: values["test/mAP"] for number, values in hooked if "test/mAP" in values} == scores(folder)
    # After an evaluation, hooks get the scores only.
    kinds = [{name.partition("/")[0] for name in values} for _, values in hooked]
    assert (
        [kind == {"test"} for kind in kinds]
        == ["loss" not in kind for kind in kinds]
        == [True, False, False, True]
    )
    assert scores(folder) == scores(finished[0])
    assert load_checkpoint(folder / "checkpoints" / "00000004").score == scores(folder)[4]
    # Killed after the last evaluation and before its record.
    records = read_metrics(folder)
    *kept, last = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    assert "test/mAP" in last
    (folder / "metrics.jsonl").write_text("".join(kept))
    for _ in range(2):  # the second time, nothing is left to do
        train_tiny(folder, evaluate=2, tests=TESTS, resume=True)
        assert evaluated == [2, 4, 4]
        assert read_metrics(folder) == records


def test_single_sweeps_are_reported_if_several_are_configured(tmp_path, capsys):
    train_tiny(tmp_path / "run", config=dataclasses.replace(CONFIG, num_sweeps=3), steps=1)
    assert "warning: num_sweeps: got 3, but the frames hold one sweep each: expected 1" in capsys.readouterr().err


def test_boxes_without_points_are_reported(tmp_path, capsys):
    frames = [FRAMES.frame(i) for i in range(4)]
    others = [dataclasses.replace(frame, num_points=0 * frame.num_points) for frame in frames[1:]]
    own = InMemoryFrames((frames[0], *others), FRAMES.sensor, FRAMES.classes)
    train_tiny(tmp_path / "run", frames=own, steps=1)
    assert "contain no point and are not learned: are points and boxes in the same" in capsys.readouterr().err


class PartialFrames(InMemoryFrames):
    def check_files(self, indices):
        raise ValueError(f"{len([*indices])} keyframes are missing")


@pytest.mark.parametrize("which", ["frames", "tests"])
def test_missing_files_are_refused_before_the_first_step(tmp_path, which):
    partial = PartialFrames(tuple(FRAMES.frame(i) for i in range(2)), FRAMES.sensor, FRAMES.classes)
    with pytest.raises(ValueError, match="2 keyframes are missing"):
        train_tiny(tmp_path / "run", **{"tests": TESTS, which: partial})
    assert not (tmp_path / "run").exists()


class UnreadableFrames(InMemoryFrames):
    def frame(self, index):
        raise ValueError("clouds/0.npy: empty file")


def without_points(index: int) -> Frame:
    frame = FRAMES.frame(index)
    return dataclasses.replace(frame, num_points=0 * frame.num_points)


UNREADABLE = UnreadableFrames((FRAMES.frame(0),), FRAMES.sensor, FRAMES.classes)
EMPTY = InMemoryFrames(tuple(map(without_points, range(3))), FRAMES.sensor, FRAMES.classes)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "steps: got 0, expected an integer from 1 to 2147483647"),
        ({"steps": 2.5}, "steps: got 2.5, expected an integer"),
        ({"seed": 2**32}, "seed: got 4294967296, expected an integer from 0 to 4294967295"),
        ({"config": dataclasses.replace(CONFIG, copy_paste=CopyPasteConfig())}, "copy_paste: got no ground-truth"),
        ({"config": "quickstart"}, "config: got 'quickstart', expected a Config"),
        ({"frames": "my_lidar"}, "frames: got 'str', expected a set of frames, as open_frames returns"),
        ({"schedule": 5}, "schedule: got 5, expected a Schedule"),
        ({"threads": -1}, "threads: got -1, expected at least 0"),
        ({"workers": -1}, "workers: got -1, expected at least 0"),
        ({"frames": UNREADABLE}, "clouds/0.npy: empty file"),
        ({"frames": EMPTY}, "frame 'frame 0': box 0: got 0 points, like all boxes of 3 frames"),
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

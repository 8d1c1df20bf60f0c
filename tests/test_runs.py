"""A run in a folder: what it leaves there, how it is stopped and gone on with, and what it refuses."""

import dataclasses
import json
import os
import shutil
import signal
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from tiny_run import CONFIG, STEPS, TESTS, bits, feed, make_run, weights

from fcos_lidar_jax.commands import runs
from fcos_lidar_jax.training import NonFiniteLossError, load_checkpoint
from fcos_lidar_jax.training.checkpoint import CheckpointError, load_state
from fcos_lidar_jax.training.records import read_records
from fcos_lidar_jax.types import CLASSES


@pytest.fixture(scope="module", autouse=True)
def traces():
    """All runs of this module share one step and one detection; how often the step was traced."""
    found, made = [], {}
    with pytest.MonkeyPatch.context() as patch:
        make_train_step, make_detect = runs.make_train_step, runs.make_detect

        def shared_step(*args):
            step = make_train_step(*args)

            def counted(state, batch):
                found.append(1)
                return step(state, batch)

            return made.setdefault("step", counted)

        patch.setattr(runs, "make_train_step", shared_step)
        patch.setattr(runs, "make_detect", lambda *args: made.setdefault("detect", make_detect(*args)))
        yield found


@pytest.fixture(scope="module")
def finished(tmp_path_factory, traces):
    """A run that was left alone: its folder, its last state, and how often its step was traced."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    state = make_run(folder, evaluate=2, tests=TESTS).train(feed, weights=weights())
    return folder, state, len(traces)


def test_the_step_is_compiled_once(finished):
    _, state, traces = finished
    assert int(state.step) == STEPS
    assert traces == 1


def test_all_that_is_promised_is_recorded(finished):
    lines = read_records(finished[0])
    steps = [line for line in lines if "loss/total" in line]
    tests = [line for line in lines if "test/mAP" in line]
    assert [line["step"] for line in steps] == [1, 2, 3, 4]
    assert [line["step"] for line in tests] == [2, 4]
    parts = ("total", "classification", "l1", "iou", "iou_prediction")
    for line in steps:
        weighed = sum(
            getattr(CONFIG.loss, f"{part}_weight") * line[f"loss/{part}"] for part in parts if part != "total"
        )
        assert line["loss/total"] == pytest.approx(weighed, rel=1e-5)
        assert sum(line["positives_per_level"]) == line["positives"] > 0
        assert line["unique_positives"] <= line["positives"]
        assert line["mean_k"] == pytest.approx(line["positives"] / line["owned_boxes"])
        assert 0 <= line["positive_iou"] <= 1
        assert line["gradient_norm"] > 0
        assert line["samples_per_second"] == pytest.approx(CONFIG.optimizer.batch_size / line["seconds"])
        assert 0 <= line["waiting_seconds"] <= line["seconds"]
        assert {"overflow_points", "overflow_boxes", "pasted_objects", "dropped_points"} <= line.keys()
    peak = CONFIG.optimizer.peak_learning_rate
    # Four steps: the first at a tenth of the peak, the second at the peak.
    np.testing.assert_allclose([line["learning_rate"] for line in steps[:2]], [peak / 10, peak], rtol=1e-5)
    np.testing.assert_allclose([line["b1"] for line in steps[:2]], [0.95, 0.85], rtol=1e-5)
    for line in tests:
        assert {f"test/AP/{name}" for name in CLASSES} | {"test/NDS"} <= line.keys()


def test_the_folder_holds_plan_checkpoints_curves_and_pictures(finished):
    folder, state, _ = finished
    assert {path.name for path in folder.iterdir()} == {
        "run.json",
        "metrics.jsonl",
        "tensorboard",
        "checkpoints",
        "pictures",
        "loss.png",
        "scores.png",
    }
    assert json.loads((folder / "run.json").read_text())["num_steps"] == STEPS
    scores = {line["step"]: line["test/mAP"] for line in read_records(folder) if "test/mAP" in line}
    best = max(scores, key=lambda step: (scores[step], step))
    kept = sorted(path.name for path in (folder / "checkpoints").iterdir())
    assert kept == [f"{step:08d}" for step in sorted({3, 4, best})]
    frames = [f"step_{step:06d}_frame_{index}.png" for step in (2, 4) for index in (0, 1)]
    assert sorted(path.name for path in (folder / "pictures").iterdir()) == frames
    for picture in folder.rglob("*.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")
    last = load_checkpoint(folder / "checkpoints" / "00000004")
    assert (last.step, last.score, json.loads(last.data)) == (
        4,
        read_records(folder)[-1]["test/mAP"],
        {"kind": "simulated"},
    )
    # Detection gets the running mean of the weights.
    assert bits(last.variables) == bits({"params": state.ema, "batch_stats": state.batch_stats})
    assert bits(load_state(folder / "checkpoints" / "00000004", state)) == bits(state)


def test_a_finished_run_says_so_and_nothing_changes(finished, capsys):
    folder, state, _ = finished
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    again = make_run(folder, evaluate=2, tests=TESTS).train(feed, resume=True)
    assert bits(again) == bits(state)
    assert "the run has done all of its 4 steps" in capsys.readouterr().err
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before


@contextmanager
def disturbed(first_step: int, at: int, how):
    """The batches, with something happening while one of them is made."""

    def batches(stream):
        for host in stream:
            yield how(host) if host.step == at else host

    with feed(first_step) as stream:
        yield batches(stream)


def signalled(number: int):
    def ask(host):
        os.kill(os.getpid(), number)
        return host

    return ask


def broken(host):
    points = host.batch.points.copy()
    points[1, :, 3] = 3e38  # finite, until the network adds it up
    return dataclasses.replace(host, batch=dataclasses.replace(host.batch, points=points))


def test_stopped_failed_and_gone_on_with_it_ends_where_the_run_left_alone_ended(finished, tmp_path, capsys):
    whole, state, _ = finished
    folder = tmp_path / "run"

    def train(at, how, **kwargs):
        run = make_run(folder, evaluate=2, tests=TESTS, save=10)
        return run.train(lambda first: disturbed(first, at, how), **kwargs)

    with pytest.raises(KeyboardInterrupt):
        train(0, signalled(signal.SIGINT), weights=weights())
    assert "stopped after step 1, which is saved" in capsys.readouterr().err
    assert [path.name for path in (folder / "checkpoints").iterdir()] == ["00000001"]
    with pytest.raises(SystemExit) as stopped:
        train(2, signalled(signal.SIGTERM), resume=True)
    assert stopped.value.code == 143
    newest = folder / "checkpoints" / "00000003"
    (newest / "checkpoint.json").write_text((newest / "checkpoint.json").read_text()[:-9])
    told = (
        r"^step 3: not finite: .*; samples: seed \d+, seed \d+; "
        r"the last checkpoint is .*checkpoints/0000000[23]$"
    )
    with pytest.raises(NonFiniteLossError, match=told):
        train(2, broken, resume=True)
    assert "going back to the checkpoint before" in capsys.readouterr().err
    assert bits(train(-1, None, resume=True)) == bits(state)
    wanted, found = read_records(whole), read_records(folder)
    timed = ("seconds", "waiting_seconds", "samples_per_second")
    assert [{k: v for k, v in line.items() if k not in timed} for line in found] == [
        {k: v for k, v in line.items() if k not in timed} for line in wanted
    ]


def altered(folder: Path, change) -> Path:
    file = folder / "run.json"
    plan = json.loads(file.read_text())
    change(plan)
    file.write_text(json.dumps(plan))
    return folder


@pytest.fixture
def begun(finished, tmp_path) -> Path:
    """A folder with the plan of the run alone."""
    folder = tmp_path / "begun"
    folder.mkdir()
    shutil.copy(finished[0] / "run.json", folder)
    return folder


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda plan: plan["config"]["loss"].update(l1_weight=9.0), r"config.loss.l1_weight: was 9.0, got 0.25"),
        (lambda plan: plan["sensor"].update(num_columns=8), "sensor.num_columns: was 8, got 64"),
        (lambda plan: plan.update(num_steps=5), "num_steps: was 5, got 4"),
        (lambda plan: plan.update(seed=1), "seed: was 1, got 0"),
        (lambda plan: plan.pop("seed"), "seed: was None, got 0"),
        (lambda plan: plan["data"].update(kind="real"), "data.kind: was 'real', got 'simulated'"),
    ],
)
def test_another_plan_is_refused_and_the_field_is_named(begun, change, told):
    altered(begun, change)
    with pytest.raises(ValueError, match=rf"run.json: {told}: a run goes on with the same plan alone$"):
        make_run(begun).train(feed, resume=True)
    assert [path.name for path in begun.iterdir()] == ["run.json"]


def test_what_is_no_run_or_another_one_is_refused(begun, tmp_path):
    with pytest.raises(ValueError, match="holds a run, expected --resume or another folder"):
        make_run(begun).train(feed)
    with pytest.raises(ValueError, match=r"run.json: found nothing, expected the run to go on with"):
        make_run(tmp_path / "nothing").train(feed, resume=True)
    assert not (tmp_path / "nothing").exists()
    (begun / "run.json").write_text("{")
    with pytest.raises(ValueError, match=r"run.json: not JSON, expected the plan of a run"):
        make_run(begun).train(feed, resume=True)
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="found a file, expected a folder"):
        make_run(tmp_path / "file").train(feed)


def test_with_damaged_checkpoints_alone_the_run_is_not_begun_anew(finished, tmp_path):
    folder = shutil.copytree(finished[0], tmp_path / "run")
    for description in folder.glob("checkpoints/*/checkpoint.json"):
        description.unlink()
    with pytest.raises(CheckpointError, match=r"all \d checkpoints are damaged"):
        make_run(folder, evaluate=2, tests=TESTS).train(feed, resume=True)

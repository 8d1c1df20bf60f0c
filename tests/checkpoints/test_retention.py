"""The checkpoints of a run: which ones are kept, and from which one a run resumes."""

import dataclasses
import functools
import os
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import contents, cut
from refusal import refused
from tiny_run import CONFIG, SENSOR, bits

from fcos_lidar_jax.checkpoints import Checkpoint, CheckpointError, load_checkpoint, storage
from fcos_lidar_jax.checkpoints.retention import CHECKPOINTS, Checkpoints, best_of, find_checkpoint
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.training import detection_variables, make_optimizer, make_state


@functools.cache
def shapes():
    detector, optimizer = build_detector(CONFIG, SENSOR), make_optimizer(CONFIG.optimizer, 10)
    return jax.eval_shape(lambda key: make_state(detector, optimizer, key), jax.random.key(0))


def state_at(step: int):
    """A state filled with its step."""
    arrays = dataclasses.replace(shapes(), key=None)
    filled = jax.tree.map(lambda leaf: np.full(leaf.shape, step, leaf.dtype), arrays)
    return dataclasses.replace(filled, key=jax.random.key(step))


def save(checkpoints: Checkpoints, step: int, score: float | None = None) -> None:
    state = state_at(step)
    checkpoints.save(Checkpoint(CONFIG, SENSOR, detection_variables(state), step, score=score), state)


@pytest.fixture(scope="module")
def three(tmp_path_factory) -> Path:
    checkpoints = Checkpoints(tmp_path_factory.mktemp("three") / CHECKPOINTS, keep=3)
    for step, score in ((2, 0.3), (4, None), (6, 0.1)):
        save(checkpoints, step, score)
    return checkpoints.folder


@pytest.fixture
def copy(three, tmp_path) -> Checkpoints:
    return Checkpoints(shutil.copytree(three, tmp_path / CHECKPOINTS), keep=3)


def steps(checkpoints: Checkpoints) -> list[int]:
    return [int(path.name) for path in checkpoints.paths()]


def truncate(path: Path) -> None:
    largest = max((p for p in path.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    cut(largest, -1)


def test_the_newest_checkpoints_and_the_best_are_kept(tmp_path):
    checkpoints = Checkpoints(tmp_path / "c", keep=2)
    assert checkpoints.newest(shapes()) is None
    kept = []
    for step, score in ((1, None), (2, 0.5), (3, 0.4), (4, None), (5, 0.5)):
        save(checkpoints, step, score)
        kept.append(steps(checkpoints))
    # The newest of equal scores is kept.
    assert kept == [[1], [1, 2], [2, 3], [2, 3, 4], [4, 5]]


def test_recording_a_score_does_not_change_the_arrays(copy):
    before = contents(copy.folder)
    copy.record_score(6, 0.7)
    assert best_of(copy.paths()) == copy.folder / "00000006"
    changed = [path for path, content in contents(copy.folder).items() if content != before[path]]
    assert changed == ["00000006/checkpoint.json"]
    assert load_checkpoint(copy.folder / "00000006").score == 0.7
    assert bits(copy.newest(shapes())) == bits(state_at(6))
    Checkpoints(copy.folder, keep=1).record_score(6, 0.8)
    assert steps(copy) == [6]  # step 2 was the best before


def test_a_kill_while_a_score_is_recorded_does_not_damage_the_checkpoint(copy, tmp_path, monkeypatch):
    def killed(*_):
        shutil.copytree(copy.folder, left.folder)  # what a kill leaves at this moment
        raise KeyboardInterrupt

    left = Checkpoints(tmp_path / "left")
    with monkeypatch.context() as patch:
        patch.setattr(storage.os, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            copy.record_score(6, 0.7)
    assert len(list(left.folder.glob(".*"))) == 1
    assert int(left.newest(shapes()).step) == 6
    save(left, 7)
    assert list(left.folder.glob(".*")) == []  # the next save tidies up


@pytest.mark.parametrize("number", [1, 2])
def test_an_interruption_of_the_replacement_keeps_the_old_checkpoint(copy, monkeypatch, number):
    before = contents(copy.folder)
    replace, calls = os.replace, []

    def interrupted(source, target):
        calls.append(target)
        if len(calls) == number:
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(storage.os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save(copy, 6, 0.9)
    assert contents(copy.folder) == before


def test_corrupt_checkpoints_are_skipped_with_a_warning(copy, capsys):
    truncate(copy.folder / "00000006")
    (copy.folder / "00000004" / "checkpoint.json").write_text("{")
    assert bits(copy.newest(state_at(0))) == bits(state_at(2))
    first, second = capsys.readouterr().err.splitlines()
    for line, step in ((first, "00000006"), (second, "00000004")):
        assert line.startswith("warning: ")
        assert step in line
        assert line.endswith("going back to the checkpoint before")
    assert "damaged" in first


def test_a_run_that_resumed_before_a_corrupt_checkpoint_removes_it(copy):
    """The run resumed from step 4; the corrupt checkpoint is neither the newest nor the best."""
    copy.keep = 1
    truncate(copy.folder / "00000006")
    save(copy, 5, 0.2)
    assert steps(copy) == [2, 5]
    assert find_checkpoint(copy.folder.parent) == copy.folder / "00000005"
    assert find_checkpoint(copy.folder.parent / "best") == copy.folder / "00000002"


def test_a_checkpoint_without_its_description_is_replaced_by_the_run(copy):
    """The run resumed from step 4 and reaches step 6 again."""
    (copy.folder / "00000006" / "checkpoint.json").unlink()
    save(copy, 6, 0.2)
    assert bits(copy.newest(state_at(0))) == bits(state_at(6))
    assert [path.name for path in copy.folder.glob(".*")] == []


def test_a_run_with_only_corrupt_checkpoints_is_not_started_again(copy):
    for path in copy.paths():
        truncate(path)
    with pytest.raises(CheckpointError, match="all 3 checkpoints are damaged, expected a whole one"):
        copy.newest(state_at(0))


def test_an_intact_checkpoint_that_cannot_be_read_now_is_not_taken_for_a_corrupt_one(copy, monkeypatch):
    error = OSError(24, "Too many open files")

    def failing(*_, **__):
        raise error

    monkeypatch.setattr(storage, "_checkpointer", failing)
    with pytest.raises(CheckpointError, match="00000006/state: cannot be read") as raised:
        copy.newest(state_at(0))
    assert raised.value.__cause__ is error


def test_a_checkpoint_whose_folder_cannot_be_removed_yet_does_not_fail_the_save(copy, monkeypatch):
    """As on a network file system, while another process reads a file in it."""
    remove = shutil.rmtree
    monkeypatch.setattr(shutil, "rmtree", lambda path, ignore_errors=False: ignore_errors or remove("in use"))
    save(copy, 8)
    save(copy, 9)
    assert steps(copy) == [2, 6, 8, 9]  # step 2 is the best
    monkeypatch.undo()
    save(copy, 10)
    assert list(copy.folder.glob(".*")) == []


def test_a_run_stands_for_its_last_or_best_checkpoint(copy):
    run = copy.folder.parent
    assert find_checkpoint(run) == copy.folder / "00000006"
    assert find_checkpoint(run / "best") == copy.folder / "00000002"
    (copy.folder / "00000002" / "checkpoint.json").write_text("{")  # does not hide the best of the others
    assert find_checkpoint(run / "best") == copy.folder / "00000006"
    shutil.rmtree(copy.folder / "00000006")
    assert find_checkpoint(run) == copy.folder / "00000004"
    with refused("best: found no checkpoint of this run with a score, expected one", "--val-split"):
        find_checkpoint(run / "best")
    assert find_checkpoint(copy.folder / "00000004") == copy.folder / "00000004"
    shutil.rmtree(copy.folder)
    assert [find_checkpoint(path) for path in (run, run / "best")] == [run, run / "best"]

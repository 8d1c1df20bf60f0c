"""The checkpoints of a run: which are kept, and which one a run goes on from."""

import dataclasses
import functools
import os
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from tiny_run import CONFIG, SENSOR, bits

from fcos_lidar_jax.checkpoints import Checkpoint, CheckpointError, load_checkpoint
from fcos_lidar_jax.checkpoints import storage as checkpoint
from fcos_lidar_jax.checkpoints.retention import CHECKPOINTS, Checkpoints, best_of, find_checkpoint
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.training import detection_variables, make_optimizer, make_state


@functools.cache
def shapes():
    detector, optimizer = build_detector(CONFIG, SENSOR), make_optimizer(CONFIG.optimizer, 10)
    return jax.eval_shape(lambda key: make_state(detector, optimizer, key), jax.random.key(0))


def state_at(step: int):
    """A state that says where it is from."""
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


def damage(path: Path) -> None:
    largest = max((p for p in path.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    largest.write_bytes(largest.read_bytes()[:-1])


def test_keeps_the_newest_ones_and_the_best(tmp_path):
    checkpoints = Checkpoints(tmp_path / "c", keep=2)
    kept = []
    for step, score in ((1, None), (2, 0.5), (3, 0.4), (4, None), (5, 0.5), (6, None), (7, None), (8, 0.6)):
        save(checkpoints, step, score)
        kept.append(steps(checkpoints))
    # Of equal scores the newest stays.
    assert kept == [[1], [1, 2], [2, 3], [2, 3, 4], [4, 5], [5, 6], [5, 6, 7], [7, 8]]


def test_a_score_comes_later_and_leaves_the_arrays_alone(copy):
    before = {path: path.read_bytes() for path in copy.folder.rglob("*") if path.is_file()}
    copy.record_score(6, 0.7)
    assert best_of(copy.paths()) == copy.folder / "00000006"
    changed = [path for path in before if path.exists() and path.read_bytes() != before[path]]
    assert changed == [copy.folder / "00000006" / "checkpoint.json"]
    assert load_checkpoint(copy.folder / "00000006").score == 0.7
    assert bits(copy.newest(shapes())[1]) == bits(state_at(6))
    Checkpoints(copy.folder, keep=1).record_score(6, 0.8)
    assert steps(copy) == [6]  # the one of step 2 was the best


@pytest.mark.parametrize("number", [1, 2])
def test_interrupted_while_a_checkpoint_is_replaced_the_old_one_stays(copy, monkeypatch, number):
    before = {p: p.read_bytes() for p in copy.folder.rglob("*") if p.is_file()}
    replace, calls = os.replace, []

    def interrupted(source, target):
        calls.append(target)
        if len(calls) == number:
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(checkpoint.os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save(copy, 6, 0.9)
    assert {p: p.read_bytes() for p in copy.folder.rglob("*") if p.is_file()} == before


def test_goes_on_from_the_newest(copy):
    found = copy.newest(state_at(0))
    assert found is not None
    checkpoint, state = found
    assert (checkpoint.step, checkpoint.score) == (6, 0.1)
    assert bits(state) == bits(state_at(6))


def test_a_damaged_one_is_passed_over_with_a_warning(copy, capsys):
    damage(copy.folder / "00000006")
    (copy.folder / "00000004" / "checkpoint.json").write_text("{")
    found = copy.newest(state_at(0))
    assert found is not None
    assert bits(found[1]) == bits(state_at(2))
    warnings = capsys.readouterr().err.splitlines()
    assert [line.startswith("warning: ") for line in warnings] == [True, True]
    assert "00000006" in warnings[0]
    assert "damaged" in warnings[0]
    assert "00000004" in warnings[1]
    assert all(line.endswith("going back to the checkpoint before") for line in warnings)


@pytest.mark.parametrize("keep", [1, 2])
def test_after_a_damaged_one_new_saves_stay_and_it_goes(copy, keep):
    """The run went on from step 4; the damaged checkpoint is neither the newest nor the best."""
    copy.keep = keep
    damage(copy.folder / "00000006")
    save(copy, 5, 0.2)
    assert steps(copy) == ([2, 5] if keep == 1 else [2, 4, 5])
    assert find_checkpoint(copy.folder.parent) == copy.folder / "00000005"
    assert find_checkpoint(copy.folder.parent / "best") == copy.folder / "00000002"


def test_where_all_are_damaged_nothing_is_begun_anew(copy):
    for path in copy.paths():
        damage(path)
    with pytest.raises(CheckpointError, match="all 3 checkpoints are damaged, expected a whole one"):
        copy.newest(state_at(0))


def test_without_any_there_is_none(tmp_path):
    assert Checkpoints(tmp_path / "none").newest(state_at(0)) is None
    assert Checkpoints(tmp_path / "none").paths() == []


def test_what_killed_saves_left_is_no_checkpoint_and_goes_with_the_next_save(copy):
    (copy.folder / ".00000008.abc" / "variables").mkdir(parents=True)
    shutil.copytree(copy.folder / "00000006", copy.folder / ".00000006.abc.old")
    assert steps(copy) == [2, 4, 6]
    save(copy, 8)
    assert [p.name for p in copy.folder.glob(".*")] == []
    assert steps(copy) == [2, 4, 6, 8]


def test_a_failed_save_leaves_the_others_and_nothing_of_itself(copy, monkeypatch):
    before = {p: p.read_bytes() for p in copy.folder.rglob("*") if p.is_file()}

    def full(*_, **__):
        raise OSError("No space left on device")

    monkeypatch.setattr("fcos_lidar_jax.checkpoints.storage._save_arrays", full)
    with pytest.raises(OSError, match="No space left"):
        save(copy, 8)
    assert {p: p.read_bytes() for p in copy.folder.rglob("*") if p.is_file()} == before
    assert list(copy.folder.glob(".*")) == []


def test_a_run_stands_for_its_last_or_its_best_and_a_checkpoint_for_itself(copy):
    run = copy.folder.parent
    assert find_checkpoint(run) == copy.folder / "00000006"
    assert find_checkpoint(run / "best") == copy.folder / "00000002"
    shutil.rmtree(copy.folder / "00000006")
    assert find_checkpoint(run) == copy.folder / "00000004"
    shutil.rmtree(copy.folder / "00000002")
    assert find_checkpoint(run / "best") == run / "best"  # none of the others has a score
    assert find_checkpoint(copy.folder / "00000002") == copy.folder / "00000002"
    shutil.rmtree(copy.folder)
    assert find_checkpoint(run) == run


def test_a_damaged_description_does_not_hide_the_best_of_the_others(copy):
    (copy.folder / "00000002" / "checkpoint.json").write_text("{")
    assert best_of(copy.paths()) == copy.folder / "00000006"

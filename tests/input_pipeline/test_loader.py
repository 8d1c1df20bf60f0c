"""The training pipeline: bit-identical batches however they are prepared, and the content of each sample."""

import dataclasses
import itertools
import multiprocessing
import os
import shutil
import signal
from pathlib import Path

import jax
import numpy as np
import oracles
import pytest
from commands import run_python, wait_until
from refusal import refused
from toy_frames import ListedFrames, ToyFrames, toy_frame

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import CopyPasteConfig
from fcos_lidar_jax.data.frame import Frame, InMemoryFrames
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.input_pipeline.database import cut_reading, prepare_database
from fcos_lidar_jax.input_pipeline.loader import (
    SampleOrder,
    check_loader_options,
    default_threads,
    make_batches,
    steps_per_epoch,
)
from fcos_lidar_jax.presets import NUSCENES, NUSCENES_SINGLE, QUICKSTART
from fcos_lidar_jax.sensors import ARGOVERSE2

CONFIG = dataclasses.replace(
    QUICKSTART,
    num_sweeps=3,
    max_points=3000,
    max_boxes=64,
    copy_paste=CopyPasteConfig(),
    class_balanced=False,
    fade_epochs=1,
    optimizer=dataclasses.replace(QUICKSTART.optimizer, batch_size=4, epochs=3),
)
PLAIN = dataclasses.replace(CONFIG, copy_paste=None)
STEPS = 6  # three epochs of seven frames in batches of four


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    folder = tmp_path_factory.mktemp("objects")
    return prepare_database(ToyFrames(20), folder)


def run(frames=None, config=PLAIN, *, count=None, seed=0, num_steps=STEPS, threads=0, **options):
    frames = ToyFrames() if frames is None else frames
    with make_batches(frames, config, seed=seed, num_steps=num_steps, threads=threads, **options) as batches:
        return [owned(batch) for batch in itertools.islice(batches, count)]


def owned(host):
    """A batch whose arrays are copied out of the memory of workers."""
    return dataclasses.replace(host, batch=jax.tree.map(np.array, host.batch))


def assert_same(found, expected):
    assert len(found) == len(expected)
    assert [b.counts for b in found] == [b.counts for b in expected]
    assert [b.names for b in found] == [b.names for b in expected]
    leaves = (jax.tree.leaves([b.batch for b in batches]) for batches in (found, expected))
    for a, b in zip(*leaves, strict=True):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())


@pytest.fixture(scope="module")
def alone(objects):
    """All batches of a run without threads and processes."""
    batches = run(config=CONFIG, objects=objects)
    assert len(batches) == STEPS
    return batches


@pytest.mark.parametrize("how", [{"threads": 4, "first_step": 1}, {"first_step": STEPS}])
def test_batches_do_not_depend_on_threads_or_the_first_step(objects, alone, how):
    assert_same(run(config=CONFIG, objects=objects, **how), alone[how.get("first_step", 0) :])
    balanced = dataclasses.replace(PLAIN, class_balanced=True)
    assert_same(run(config=balanced, **how), run(config=balanced)[how.get("first_step", 0) :])


def test_the_rows_of_all_processes_form_the_global_batch(objects, alone):
    parts = [run(config=CONFIG, objects=objects, num_processes=4, process_index=i) for i in range(4)]
    for step, batch in enumerate(alone):
        joined = jax.tree.map(lambda *rows: np.concatenate(rows), *(p[step].batch for p in parts))
        for a, b in zip(jax.tree.leaves(joined), jax.tree.leaves(batch.batch), strict=True):
            np.testing.assert_array_equal(a, b)
        assert batch.counts == {name: sum(p[step].counts[name] for p in parts) for name in batch.counts}


@pytest.mark.parametrize(
    ("cores", "workers", "threads"), [(1, 0, 1), (2, 0, 2), (3, 0, 2), (128, 0, 16), (32, 4, 4), (4, 16, 1)]
)
def test_the_default_number_of_threads_depends_on_the_cores(monkeypatch, cores, workers, threads):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    assert default_threads(workers) == threads
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    assert default_threads(workers) == threads


def seen_frames(batches, size=7):
    """The index of each sample's toy frame, identified by its first point."""
    first = {tuple(toy_frame(i).points[0].tolist()): i for i in range(size)}
    return [first[tuple(np.asarray(points[0]).tolist())] for b in batches for points in b.batch.points]


def test_batches_follow_the_order_of_samples():
    config = dataclasses.replace(PLAIN, class_balanced=True)
    order, steps = SampleOrder(ToyFrames(), config, seed=0), 2 * steps_per_epoch(ToyFrames(), config)
    batches = run(config=config, num_steps=steps)
    seen = seen_frames(batches)
    assert seen == [order[position] for position in range(4 * steps)]
    assert [name for b in batches for name in b.names] == [f"toy {i}" for i in seen]


def test_a_sample_contains_its_frame_without_empty_boxes():
    [batch] = run(count=1)
    hidden = 0
    for row, index in enumerate(seen_frames([batch])):
        frame = toy_frame(index)
        shown = frame.num_points >= 1
        hidden += int((~shown).sum())
        np.testing.assert_array_equal(batch.batch.points[row][batch.batch.valid[row]], frame.points)
        np.testing.assert_array_equal(batch.batch.boxes[row][batch.batch.box_valid[row]], frame.boxes[shown])
        np.testing.assert_array_equal(batch.batch.labels[row][batch.batch.box_valid[row]], frame.labels[shown])
    assert hidden > 0
    assert np.isnan(batch.batch.boxes).any()  # unknown velocities stay unknown
    assert batch.counts == {"truncated_points": 0, "truncated_boxes": 0, "invalid_points": 0, "pasted_objects": 0}


def test_boxes_with_an_unknown_number_of_points_are_learned():
    frame = toy_frame(0)
    frame.num_points[:3] = -1, 0, -1
    frames = ListedFrames((frame,))
    [batch] = run(frames, count=1)
    np.testing.assert_array_equal(batch.batch.labels[0][:2], frame.labels[[0, 2]])
    np.testing.assert_array_equal(frames.labels(0), frame.labels[frame.num_points != 0])


def test_pasted_objects_replace_the_points_of_the_frame_in_their_boxes(objects):
    [batch] = run(config=CONFIG, objects=objects, count=1)
    assert batch.counts["pasted_objects"] > 20
    total = 0
    for row, index in enumerate(seen_frames([batch])):
        frame, truth = toy_frame(index), batch.batch.boxes[row][batch.batch.box_valid[row]]
        points, valid, size = batch.batch.points[row], batch.batch.valid[row], len(toy_frame(index).points)
        pasted = truth[int((frame.num_points >= 1).sum()) :]
        total += len(pasted)
        scene, added = points[:size][valid[:size]], points[size:][valid[size:]]
        for box in pasted.astype(float):
            assert not any(oracles.inside(p, box) for p in scene[:, :3].astype(float))
            assert sum(oracles.inside(p, box) for p in added[:, :3].astype(float)) >= 5
    assert total == batch.counts["pasted_objects"]


def test_pasting_ends_at_a_step_also_in_a_resumed_run(alone):
    # Seven frames in batches of four are two steps per epoch; the last of three epochs is without pasting.
    assert [b.counts["pasted_objects"] > 0 for b in alone] == [True] * 4 + [False] * 2
    assert_same(alone[4:], run(first_step=4))


def test_every_sample_gets_its_own_random_objects(objects):
    """All samples show the same frame, but no two of them have the same pasted objects."""
    frames = ListedFrames((toy_frame(0),))
    own = int((toy_frame(0).num_points >= 1).sum())
    batches = run(frames, dataclasses.replace(CONFIG, fade_epochs=0), objects=objects, count=3)
    pasted = [boxes[own:].tobytes() for b in batches for boxes in b.batch.boxes]
    assert len(set(pasted)) == len(pasted) == 12


def test_the_oldest_points_are_truncated_first_and_counted(objects):
    """Those of the frame and of the pasted objects together."""
    roomy = run(config=CONFIG, objects=objects, count=1)[0]
    tight = run(config=dataclasses.replace(CONFIG, max_points=1200), objects=objects, count=1)[0]
    lost = 0
    for row in range(4):
        every, kept = (b.batch.points[row][b.batch.valid[row]] for b in (roomy, tight))
        assert len(kept) == 1200 < len(every)
        lost += len(every) - 1200
        oldest = kept[:, 4].max()
        assert oldest > 0
        np.testing.assert_array_equal(kept[kept[:, 4] < oldest], every[every[:, 4] < oldest])
    assert tight.counts["truncated_points"] == lost
    assert roomy.counts["truncated_points"] == 0


def test_points_beyond_physical_limits_are_removed_and_counted():
    """A single intensity of 1e30 would make a running variance in the checkpoint infinite."""
    frame = toy_frame(0)
    points = frame.points.copy()
    points[5, 3], points[6, 0], points[7, 4], points[8, 4] = 1e30, np.nan, -0.1, 1e9
    [batch] = run(ListedFrames((dataclasses.replace(frame, points=points),)), count=1)
    assert batch.counts["invalid_points"] == 4 * 4
    for row in range(4):
        kept = batch.batch.points[row][batch.batch.valid[row]]
        np.testing.assert_array_equal(kept, np.delete(frame.points, range(5, 9), axis=0))


def test_an_implausible_box_stops_the_run_with_one_line():
    frame = toy_frame(0)
    frame.boxes[7, 6] = np.nan
    with refused("frame 'frame 0': box 7: yaw: got nan, expected a finite number"):
        run(ListedFrames((frame,)), count=1)


def test_boxes_with_the_fewest_points_are_truncated_first_and_counted():
    tight = run(config=dataclasses.replace(PLAIN, max_boxes=5), count=1)[0]
    lost = 0
    for row, index in enumerate(seen_frames([tight])):
        frame = toy_frame(index)
        ranks = sorted(range(len(frame.boxes)), key=lambda i: (-frame.num_points[i], i))
        best = sorted(i for i in ranks[:5] if frame.num_points[i] >= 1)
        np.testing.assert_array_equal(tight.batch.boxes[row][tight.batch.box_valid[row]], frame.boxes[best])
        np.testing.assert_array_equal(tight.batch.labels[row][: len(best)], frame.labels[best])
        lost += max(int((frame.num_points >= 1).sum()) - 5, 0)
    assert tight.counts["truncated_boxes"] == lost > 4


def test_the_laser_column_is_kept():
    frames = InMemoryFrames((toy_frame(0, columns=6),), ARGOVERSE2, NUSCENES_CLASSES)
    [batch] = run(frames, count=1)
    assert batch.batch.points.shape == (4, 3000, 6)


def test_a_frame_without_boxes_and_points_gives_an_empty_sample():
    nothing = Frame(np.zeros((0, 5), np.float32), np.zeros((0, 9), np.float32), *[np.zeros(0, np.int32)] * 2)
    [batch] = run(ListedFrames((nothing,)), count=1)
    assert not batch.batch.valid.any()
    assert not batch.batch.box_valid.any()


@pytest.mark.slow
def test_batches_of_workers_are_the_same_and_signals_are_left_to_the_main_process(alone, objects):
    options = {"seed": 0, "num_steps": STEPS, "threads": 2, "objects": objects, "workers": 2}
    with make_batches(ToyFrames(), CONFIG, **options) as stream:
        found = [owned(next(stream)), owned(next(stream))]  # one of each worker, which has then begun
        for process in multiprocessing.active_children():
            os.kill(process.pid, signal.SIGTERM)
            os.kill(process.pid, signal.SIGINT)
        found += map(owned, stream)
    assert_same(found, alone)


def test_too_little_shared_memory_is_refused(monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(64 << 20, 0, 64 << 20))
    config = dataclasses.replace(PLAIN, max_points=300_000)
    # Five batches of four rows of 300,000 points of 25 bytes, and the boxes.
    with refused("workers: got 2, for which /dev/shm has 64 MiB free, expected 143 MiB"):
        check_loader_options(config, threads=None, workers=2)
    assert len(run(config=config, threads=1, count=1)) == 1


@pytest.mark.real_data
@pytest.mark.parametrize("preset", [NUSCENES, NUSCENES_SINGLE])
def test_real_samples_fit_the_presets(real_data, tmp_path, preset):
    data = NuScenes(real_data / "nuscenes_scene0523", "v1.0-scene0523")
    frames = NuScenesFrames(data, tuple(data.split("scene0523")[-6:]), cut_reading(preset.num_sweeps))
    options = {"objects": prepare_database(frames, tmp_path), "count": 2}
    config = dataclasses.replace(preset, optimizer=dataclasses.replace(preset.optimizer, batch_size=3))
    for batch in run(frames, config, **options):
        assert batch.counts["truncated_points"] == batch.counts["truncated_boxes"] == 0
        assert batch.counts["pasted_objects"] > 3
        points, valid = batch.batch.points, batch.batch.valid
        filled = valid.sum(axis=1) / preset.max_points
        assert (filled > 0.5).all()  # the presets are not twice as large as necessary
        lags = [len(np.unique(cloud[row][:, 4])) for cloud, row in zip(points, valid, strict=True)]
        assert all(lag >= preset.num_sweeps for lag in lags)
        assert preset.num_sweeps > 1 or lags == [1, 1, 1]


@dataclasses.dataclass(frozen=True)
class Broken(ToyFrames):
    def frame(self, index):
        raise ValueError(f"sweeps/{index}.bin: got 3 bytes, expected 20")


@pytest.mark.slow
@pytest.mark.parametrize(("threads", "workers"), [(2, 0), (0, 1)])
def test_an_unreadable_file_stops_the_run_with_its_message(threads, workers):
    with refused(".bin: got 3 bytes, expected 20"):
        run(Broken(), threads=threads, workers=workers)


def test_no_frames_are_refused():
    with refused("training frames: got none, expected at least one"):
        run(ToyFrames(0))


SCRIPT = """
import dataclasses, multiprocessing, os, signal
from fcos_lidar_jax.input_pipeline.loader import make_batches
from fcos_lidar_jax.presets import QUICKSTART
from toy_frames import ToyFrames
if __name__ == "__main__":
    # Shared memory of this size is freed slowly.
    large = dataclasses.replace(QUICKSTART, max_points=300_000, class_balanced=False)
    with make_batches(ToyFrames(), large, seed=0, num_steps=6, threads=1, workers=1) as batches:
        print(len({next(batches).batch.points.shape, next(batches).batch.points.shape}))
        print(*[process.pid for process in multiprocessing.active_children()], flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("killed", [False, True])
def test_workers_end_with_a_run_that_ends_early_or_is_killed_and_nothing_is_told(tmp_path, killed):
    script = tmp_path / "leave.py"
    script.write_text(SCRIPT + killed * "        os.kill(os.getpid(), signal.SIGKILL)")
    done = run_python(script)
    assert done.returncode == (-signal.SIGKILL if killed else 0)
    shapes, *left = done.stdout.split()
    assert (shapes, len(left)) == ("1", 1)
    wait_until(lambda: not any(Path(f"/proc/{number}").exists() for number in left), 30)
    assert killed or not done.stderr

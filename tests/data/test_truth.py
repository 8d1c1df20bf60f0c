"""``truth``: in every format the boxes of the frame, without its points and, if possible, without reading them."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from made_argoverse2 import make_argoverse2
from made_folder import make_folder
from made_kitti import make_kitti
from made_nuscenes import make_tables, write
from toy_frames import toy_frame

from experiments.cached import CachedFrames
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.class_mapping import MappedFrames
from fcos_lidar_jax.data.clouds import CloudFiles
from fcos_lidar_jax.data.frame import Frame, FrameSet, InMemoryFrames, SelectedFrames
from fcos_lidar_jax.input_pipeline.open import Format, open_frames
from fcos_lidar_jax.sensors import ARGOVERSE2, TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames

COARSE = dataclasses.replace(ARGOVERSE2, num_columns=128)


def nuscenes(root: Path) -> FrameSet:
    return open_frames(write(root, *make_tables()), num_sweeps=3)


def argoverse2(root: Path) -> FrameSet:
    return open_frames(make_argoverse2(root, sweeps=2, sensor=COARSE), num_sweeps=2)


def kitti(root: Path) -> FrameSet:
    return open_frames(make_kitti(root, train=2, val=1, sensor=TINY))


def folder(root: Path) -> FrameSet:
    """The second frame has a list of two sweeps, of which the older one shows the same place."""
    make_folder(root, train=2, val=0)
    older, lists = root / "older", root / "sweeps"
    older.mkdir()
    lists.mkdir()
    shutil.copy(root / "clouds" / "001.npy", older)
    files = ("../clouds/001.npy", 100_000), ("../older/001.npy", 0)
    pose = np.eye(4).tolist()
    sweeps = [{"file": file, "timestamp_us": time_us, "sensor_to_world": pose} for file, time_us in files]
    (lists / "001.json").write_text(json.dumps(sweeps))
    return open_frames(root, num_sweeps=2)


def simulated(root: Path) -> FrameSet:
    return SimulatedFrames(TINY, 2, reading=CloudReading(2))


def in_memory(root: Path) -> FrameSet:
    return InMemoryFrames((toy_frame(0), toy_frame(1)), TINY, ("car",) * 10)


def mapped(root: Path) -> FrameSet:
    return MappedFrames(nuscenes(root), ("cyclist", "person"), {"pedestrian": "person"})


def selected(root: Path) -> FrameSet:
    return SelectedFrames(kitti(root), (2, 0))


def cached_frames(root: Path) -> FrameSet:
    frames = CachedFrames(SimulatedFrames(TINY, 2, reading=CloudReading(2)), root)
    frames.frame(0)  # The other one is made when its boxes are requested.
    return frames


def clouds(root: Path) -> FrameSet:
    folder(root)
    return CloudFiles((root / "clouds" / "000.npy", root / "sweeps" / "001.json"), TINY, CloudReading(2))


MAKERS = (nuscenes, argoverse2, kitti, folder, simulated, in_memory, mapped, selected, cached_frames, clouds)
COUNTED = (kitti, folder, simulated, selected, cached_frames)  # From the clouds, by the reader or the simulation.


def test_every_format_is_tested():
    assert {make.__name__ for make in MAKERS} >= set(get_args(Format))


def assert_truth(found: Frame, frame: Frame) -> None:
    for name in ("boxes", "labels", "num_points"):
        ours, theirs = getattr(found, name), getattr(frame, name)
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)
    assert found.points.shape == (0, frame.points.shape[1])
    assert found.points.dtype == frame.points.dtype
    assert found.points.base is None
    assert found.num_close == 0


@pytest.mark.parametrize("make", MAKERS)
def test_the_truth_has_the_boxes_of_the_frame(make, tmp_path):
    frames = make(tmp_path / "data")
    truths = [frames.truth(index) for index in range(len(frames))]
    assert sum(len(truth.boxes) for truth in truths) > 0 or make is clouds
    for index, truth in enumerate(truths):
        assert_truth(truth, frames.frame(index))
    if make in COUNTED:
        assert any((truth.num_points > 0).any() for truth in truths)


@pytest.mark.parametrize("make", [nuscenes, argoverse2, mapped, clouds])
def test_the_truth_is_read_without_the_clouds(make, tmp_path):
    frames = make(tmp_path / "data")
    expected = [frames.frame(index) for index in range(len(frames))]
    deleted = [file for ending in ("*.bin", "*.npy", "lidar/*.feather") for file in tmp_path.rglob(ending)]
    assert len(deleted) >= len(frames)
    for file in deleted:
        file.unlink()
    with pytest.raises((OSError, ValueError)):
        frames.frame(0)
    for index, frame in enumerate(expected):
        assert_truth(frames.truth(index), frame)


def test_the_truth_of_a_folder_reads_the_current_sweep_only(tmp_path):
    frames = folder(tmp_path / "data")
    expected = frames.frame(1)
    assert len(np.unique(expected.points[:, 4])) == 2
    (tmp_path / "data" / "older" / "001.npy").write_bytes(b"no cloud")
    with pytest.raises(ValueError, match="older/001"):
        frames.frame(1)
    assert_truth(frames.truth(1), expected)

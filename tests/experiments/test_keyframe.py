"""Folders of annotated keyframes: points, boxes and counts as in the files; one-line errors."""

import json

import numpy as np
import pytest
from refusal import refused

from experiments.real_frames import read_keyframe
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.box_geometry import count_inside
from fcos_lidar_jax.sensors import NUSCENES_HDL32E


def test_a_keyframe_has_points_boxes_and_unknown_velocities(tmp_path):
    points = np.random.default_rng(0).uniform(-20, 20, (200, 5)).astype(np.float32)
    points[:, 3:] = np.stack([np.full(200, 50), np.arange(200) % 32], axis=1)  # intensity; ring, as in nuScenes
    points.tofile(tmp_path / "a.pcd.bin")
    box = dict(zip("xyzlwh", range(1, 7), strict=True)) | {"yaw": 0.5, "vx": None, "vy": None}
    box |= {"class": "truck", "num_lidar_pts": 9}

    def read(content, number=0, **how):
        (tmp_path / "boxes.json").write_text(json.dumps(content))
        return read_keyframe(tmp_path, NUSCENES_HDL32E, number, **how)

    def record(*boxes):
        return {"lidar_file": "a.pcd.bin", "boxes": boxes}

    truck = record(box, {**box, "class": None})
    frame = read(truck)
    np.testing.assert_array_equal(frame.boxes, np.array([[1, 2, 3, 4, 5, 6, 0.5, np.nan, np.nan]], np.float32))
    assert (frame.labels.tolist(), frame.num_points.tolist(), len(frame.points)) == ([1], [9], 200)
    close = int((np.abs(points[:, :2]) < 8).all(axis=1).sum())
    far = read(truck, reading=CloudReading(1, "all", 8.0))
    assert (len(far.points), far.num_close) == (200 - close, close)
    counted = {"num_lidar_pts_at_key_frame" if k == "num_lidar_pts" else k: v for k, v in box.items()}
    several = [truck, record({**counted, "class": "bus"})]
    assert [read(several, i).labels.tolist() for i in (0, 1)] == [[1], [2]]
    for content, message in (
        ({"boxes": []}, "boxes.json: a field is missing or of another kind: 'lidar_file'"),
        (record(box, {**box, "z": None}), "box 1 of the ten classes: z: got nan, expected a finite number"),
    ):
        with refused(message):
            read(content)


@pytest.mark.real_data
def test_real_keyframes_of_a_list_have_their_boxes_and_points(real_data):
    """The annotated counts are of boxes with their full rotation, so that a few differ."""
    frames = [read_keyframe(real_data / "nuscenes_scene0103", NUSCENES_HDL32E, number) for number in (0, 1)]
    annotated = np.concatenate([frame.num_points for frame in frames])
    inside = np.concatenate([count_inside(frame.points, frame.boxes) for frame in frames])
    assert len(annotated) > 60
    assert (annotated == inside).mean() > 0.7

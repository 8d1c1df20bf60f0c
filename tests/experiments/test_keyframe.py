"""Folders of annotated keyframes: points, boxes and counts as in the files; one-line errors."""

import json

import numpy as np
import pytest
from refusal import refused

from experiments.keyframe import read_keyframe
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.box_geometry import count_inside
from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.simulation.frames import make_frame


def test_a_keyframe_has_points_boxes_and_unknown_velocities(tmp_path):
    points = make_frame(0, NUSCENES_HDL32E).points[:2000]
    points[:, 4] = np.arange(len(points)) % 32  # the ring, as in files of nuScenes
    points.tofile(tmp_path / "a.pcd.bin")
    box = dict(zip("xyzlwh", range(1, 7), strict=True)) | {"yaw": 0.5, "vx": None, "vy": None, "num_lidar_pts": 9}
    counted = {("num_lidar_pts_at_key_frame" if k == "num_lidar_pts" else k): v for k, v in box.items()}

    def read(content, number=0, **how):
        (tmp_path / "boxes.json").write_text(content if isinstance(content, str) else json.dumps(content))
        return read_keyframe(tmp_path, NUSCENES_HDL32E, number, **how)

    def record(*boxes):
        return {"lidar_file": "a.pcd.bin", "boxes": boxes}

    truck = record({**box, "class": "truck"}, {**box, "class": None})
    frame = read(truck)
    np.testing.assert_array_equal(frame.boxes, np.array([[1, 2, 3, 4, 5, 6, 0.5, np.nan, np.nan]], np.float32))
    assert (frame.labels.tolist(), frame.num_points.tolist(), len(frame.points)) == ([1], [9], len(points))
    close = int((np.abs(points[:, :2]) < 8).all(axis=1).sum())
    far = read(truck, reading=CloudReading(1, "all", 8.0))
    assert (len(far.points), far.num_close) == (len(points) - close, close)
    assert 0 < close < len(points)
    several = [truck, record({**counted, "class": "bus"})]
    assert [read(several, i).labels.tolist() for i in (0, 1)] == [[1], [2]]
    with refused("list index out of range"):
        read(several, 2)
    for text, message in [("{", "not JSON"), ('{"boxes": []}', "'lidar_file'"), ('{"boxes": 3}', "missing or of")]:
        with refused(message):
            read(text)
    with refused("box 1 of the ten classes: z: got nan, expected a finite number"):
        read(record({**box, "class": "truck"}, {**box, "class": "car", "z": None}))


@pytest.mark.real_data
def test_real_keyframes_of_a_list_have_their_boxes_and_points(real_data):
    """The annotated counts are of boxes with their full rotation, so that a few differ."""
    counts = []
    for number, total in ((0, 23), (1, 55)):
        frame = read_keyframe(real_data / "nuscenes_scene0103", NUSCENES_HDL32E, number)
        assert len(frame.boxes) <= total
        counts.append(np.stack([frame.num_points, count_inside(frame.points, frame.boxes)]))
    annotated, inside = np.concatenate(counts, axis=1)
    assert len(annotated) > 60
    assert (annotated == inside).mean() > 0.7

"""The simulated sensor: hits by another method, exact counts, the same bytes for the same seed."""

import numpy as np
import pytest
from shapely.geometry import Polygon

import oracles
from fcos_lidar_jax.data.batching import make_batch
from fcos_lidar_jax.data.frame import count_inside
from fcos_lidar_jax.data.synthetic.frames import make_frame
from fcos_lidar_jax.data.synthetic.raycast import beam_directions, cast_rays
from fcos_lidar_jax.data.synthetic.world import GROUND_Z, make_scene
from fcos_lidar_jax.projection import image_cells
from fcos_lidar_jax.sensors import ARGOVERSE2, NUSCENES_HDL32E, TINY, WAYMO_TOP
from fcos_lidar_jax.types import CLASSES


def occupied(point, scene, slack):
    """Whether a point lies in or on a solid or the ground."""
    if point[2] <= GROUND_Z + slack:
        return True
    for c in scene.cuboids:
        if oracles.inside(point, [*c[:3], *(c[3:6] + 2 * slack), c[6]]):
            return True
    for x, y, radius, low, high in scene.cylinders:
        if np.hypot(point[0] - x, point[1] - y) <= radius + slack and low - slack <= point[2] <= high + slack:
            return True
    return False


def test_rays_end_on_the_first_solid():
    """Marching along the ray: free before the hit, solid right behind it."""
    scene = make_scene(3, reach_m=20.0)
    directions = beam_directions(TINY)
    range_m, _ = cast_rays(directions, scene)
    rng = np.random.default_rng(0)
    hits = 0
    for row, column in zip(rng.integers(0, 16, 150), rng.integers(0, 256, 150), strict=True):
        ray, reach = directions[row, column], range_m[row, column]
        end = min(reach, 30.0)
        for t in np.arange(0.5, end - 0.02, 0.05):
            assert not occupied(t * ray, scene, -1e-6), (row, column, t, reach)
        if np.isfinite(reach):
            hits += 1
            assert occupied(reach * ray, scene, 1e-6)
    assert hits > 80


def test_ground_and_strength_by_hand():
    empty = make_scene(0, reach_m=20.0, num_objects=0)
    bare = type(empty)(empty.cuboids[:0], empty.cuboid_albedo[:0], empty.cylinders[:0], empty.cylinder_albedo[:0],
                       empty.boxes, empty.labels)  # fmt: skip
    down = np.array([[[np.cos(0.5), 0, -np.sin(0.5)]], [[1.0, 0, 0]]])
    range_m, strength = cast_rays(down, bare)
    np.testing.assert_allclose(range_m[:, 0], [1.84 / np.sin(0.5), np.inf])
    np.testing.assert_allclose(strength[:, 0], [0.25 * np.sin(0.5), 0])


@pytest.mark.parametrize("sensor", [TINY, NUSCENES_HDL32E, WAYMO_TOP, ARGOVERSE2], ids=lambda s: s.name)
def test_frames_repeat_count_and_fill_one_cell_a_beam(sensor):
    frame = make_frame(11, sensor)
    make_frame(12, sensor)
    again = make_frame(11, sensor)
    for a, b in zip(vars(frame).values(), vars(again).values(), strict=True):
        np.testing.assert_array_equal(a, b)
    assert frame.points.shape[1] == sensor.point_columns
    assert (frame.num_points >= 1).all()
    box = int(frame.num_points.argmax())
    inside = sum(oracles.inside(p[:3].astype(float), frame.boxes[box].astype(float)) for p in frame.points)
    assert inside == frame.num_points[box] > 20
    cells = np.asarray(image_cells(frame.points, np.ones(len(frame.points), bool), sensor)[0])
    seen = cells[cells < sensor.num_rows * sensor.num_columns]
    assert len(np.unique(seen)) > 0.98 * len(seen)
    assert len(seen) > 0.6 * sensor.num_rows * sensor.num_columns * 0.5


def test_count_inside_is_exact():
    rng = np.random.default_rng(0)
    boxes, points = oracles.random_boxes(rng, 8), rng.normal(0, 3, (300, 3))
    expected = [sum(oracles.inside(p, b) for p in points) for b in boxes]
    assert count_inside(points, boxes).tolist() == expected


def test_scenes_show_all_classes_apart_from_each_other():
    labels = []
    for seed in range(20):
        scene = make_scene(seed, reach_m=20.0)
        labels += scene.labels.tolist()
        shapes = []
        for x, y, _, l, w, _, yaw in scene.boxes[:, :7]:
            c, s = np.cos(yaw), np.sin(yaw)
            signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
            shapes.append(
                Polygon([(x + c * i * l / 2 - s * j * w / 2, y + s * i * l / 2 + c * j * w / 2) for i, j in signs])
            )
        for i, a in enumerate(shapes):
            assert all(a.disjoint(b) for b in shapes[:i])
        speed = np.hypot(scene.boxes[:, 7], scene.boxes[:, 8])
        along = scene.boxes[:, 7] * np.cos(scene.boxes[:, 6]) + scene.boxes[:, 8] * np.sin(scene.boxes[:, 6])
        np.testing.assert_allclose(along, speed, atol=1e-9)
        np.testing.assert_allclose(scene.boxes[:, 2] - scene.boxes[:, 5] / 2, GROUND_Z, atol=1e-9)
    counts = np.bincount(labels, minlength=10)
    assert counts.min() >= 10, dict(zip(CLASSES, counts, strict=True))


def test_batches_pad_and_refuse_to_drop():
    frames = [make_frame(i, TINY) for i in range(2)]
    batch = make_batch(frames, max_points=4096, max_boxes=16)
    for i, frame in enumerate(frames):
        assert batch.valid[i].sum() == len(frame.points)
        np.testing.assert_array_equal(batch.points[i][batch.valid[i]], frame.points)
        np.testing.assert_array_equal(batch.boxes[i][batch.box_valid[i]], frame.boxes)
        np.testing.assert_array_equal(batch.labels[i][batch.box_valid[i]], frame.labels)
    with pytest.raises(ValueError, match=r"sample 0: points: got \d+, expected at most 100"):
        make_batch(frames, max_points=100, max_boxes=16)
    with pytest.raises(ValueError, match=r"boxes: got \d+, expected at most 2"):
        make_batch(frames, max_points=4096, max_boxes=2)

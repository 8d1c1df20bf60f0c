"""Boxes: which are plausible, overlap against polygons, and points inside against a test of every pair."""

import numpy as np
import oracles
import pytest
from refusal import refused
from shapely import area, intersection

from fcos_lidar_jax.data.box_geometry import LIMITS, check_boxes, footprints_overlap, points_in_boxes

CAR = dict(zip(LIMITS, (8, 1, -1, 4, 2, 1.5, 0.25, 1.5, -0.5), strict=True))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"yaw": np.nan}, "yaw: got nan, expected a finite number"),
        ({"x": np.inf}, "x: got inf, expected a finite number"),
        ({"vy": np.nan}, "vy: got nan, expected a finite number"),  # a velocity is unknown as a whole
        ({"z": 1e30}, "z: got 1e+30, expected a finite number, at most 10000"),
        ({"yaw": 90}, "yaw: got 90, expected a finite number, at most 25.1327 radians"),  # degrees
        ({"l": 501}, "l: got 501, expected a size above 0 m, at most 500"),
        ({"vx": -501}, "vx: got -501, expected a finite number, at most 500"),
        ({"h": 0}, "h: got 0, expected a size above 0 m"),
        ({"h": 1e-60}, "h: got 1e-60, expected a size above 0 m"),  # zero as float32
    ],
)
def test_an_implausible_box_is_refused_with_its_row_and_field(changes, message):
    unknown_velocity = CAR | {"vx": np.nan, "vy": np.nan}
    boxes = np.array([list(box.values()) for box in (unknown_velocity, CAR | changes, CAR | changes)])
    check_boxes(boxes[:1], "box {}".format)
    with refused(f"box 1: {message}"):
        check_boxes(boxes, "box {}".format)


def test_overlap_equals_that_of_polygons():
    rng = np.random.default_rng(0)
    a, b = oracles.random_boxes(rng, 60, 6), oracles.random_boxes(rng, 80, 6)
    found = footprints_overlap(a[:, None], b)
    shared = area(intersection(np.array(oracles.rectangles(a))[:, None], np.array(oracles.rectangles(b))))
    np.testing.assert_array_equal(found, shared > 1e-9)
    assert 0.05 < found.mean() < 0.95


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ([4, 0, 0, 4, 2, 1, 0], False),  # side by side, edges touching
        ([3.999, 0, 0, 4, 2, 1, 0], True),
        ([0, 0, 0, 1, 1, 1, 0.3], True),  # contained
        ([0, 0, 9, 4, 2, 1, 0], True),  # height does not matter
        ([2 + np.sqrt(0.5) + 1e-6, 0, 0, 1, 1, 1, np.pi / 4], False),  # a corner before an edge
        ([2 + np.sqrt(0.5) - 1e-6, 0, 0, 1, 1, 1, np.pi / 4], True),
    ],
)
def test_touching_boxes_do_not_overlap(other, expected):
    box = np.array([[0, 0, 0, 4, 2, 1, 0.0]])
    assert footprints_overlap(box, np.array([other])).item() is expected
    assert footprints_overlap(np.array([other]), box).item() is expected


@pytest.mark.parametrize("reach_m", [6, 40, 4000])
def test_points_in_boxes_equal_a_test_of_every_pair(reach_m):
    rng = np.random.default_rng(1)
    boxes = oracles.random_boxes(rng, 25, reach_m)
    points = rng.uniform(-reach_m, reach_m, (1000, 5)).astype(np.float32)
    points[:500, :3] = np.repeat(boxes[:, :3], 20, 0) + rng.normal(0, 1, (500, 3))
    points[7, 0], points[8, 1], points[9, 2] = np.nan, np.inf, -np.inf
    found = points_in_boxes(points, boxes)
    expected = [[i for i, p in enumerate(points[:, :3]) if oracles.inside(p, b)] for b in boxes.astype(np.float64)]
    assert [f.tolist() for f in found] == expected
    assert sum(map(len, found)) > 80


def test_points_on_the_boundary_are_inside_and_inputs_may_be_empty():
    box = np.array([[10, -3, 1, 4, 2, 2, 0.0]])
    points = np.array([[12, -2, 2], [8, -4, 0], [12, -4, 2], [10, -3, 2], [12.001, -3, 1]], np.float32)
    assert points_in_boxes(points, box)[0].tolist() == [0, 1, 2, 3]
    assert points_in_boxes(np.zeros((0, 5)), np.zeros((2, 9)))[1].tolist() == []
    assert points_in_boxes(np.zeros((3, 5)), np.zeros((0, 9))) == []

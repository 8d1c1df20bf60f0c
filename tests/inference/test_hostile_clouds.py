"""Hostile clouds give finite images and boxes, each row at most once, bit-identical when repeated."""

import dataclasses
from unittest.mock import Mock

import jax
import numpy as np
import pytest
from tiny_run import bits

from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.inference import detector as detector_module
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import ARGOVERSE2, TINY

POINTS = 256  # points of every projected cloud, so that projection is compiled once
SENSORS = (TINY, dataclasses.replace(ARGOVERSE2, num_columns=64))
_FINFO = np.finfo(np.float32)
_LIMITS = (59.999, 60.0, 65_535.0, 65_536.0, 2.0**24, 2.0**31, 2.0**63)
_MAGNITUDES = (0.0, 1e-45, _FINFO.tiny, _FINFO.eps, 1.0, *_LIMITS, 1e30, _FINFO.max, np.inf)
EXTREME = np.array([np.nan, *(s * m for m in _MAGNITUDES for s in (1, -1))], np.float32)


def anywhere(rng, sensor, number):
    scale = rng.choice([1e-3, 1.0, sensor.limit_xy_m, 1e3])
    return with_columns(rng, sensor, rng.normal(0, 1, (number, 3)) * [scale, scale, min(scale, 3)])


def on_a_beam(rng, sensor, number):
    """Directions at the centre or on the edge of cells, or the next float32."""
    inclination = rng.choice(np.concatenate([sensor.inclinations_rad, sensor.row_edges_rad]), number)
    azimuth = np.pi - rng.integers(0, 2 * sensor.num_columns + 1, number) * np.pi / sensor.num_columns
    range_m = rng.choice([1e-6, 0.5, 5.0, sensor.limit_xy_m, 2 * sensor.limit_xy_m], number)
    flat = np.cos(inclination) * range_m
    xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(inclination) * range_m], axis=1)
    return with_columns(rng, sensor, beside(rng, xyz.astype(np.float32)) + sensor.origin_m)


def on_the_limits(rng, sensor, number):
    xy = rng.choice([-1, -0.5, 0, 0.1, 1], (number, 2)) * sensor.limit_xy_m
    xyz = np.column_stack([xy, rng.choice([*sensor.limit_z_m, 0.0, -1.7], number)]).astype(np.float32)
    return with_columns(rng, sensor, beside(rng, xyz))


def one_point(rng, sensor, number):
    return np.repeat(anywhere(rng, sensor, 1), number, axis=0)


def extreme(rng, sensor, number):
    return rng.choice(EXTREME, (number, sensor.point_columns))


def beside(rng, xyz):
    """The values, or the next float32."""
    return xyz if rng.random() < 0.3 else np.nextafter(xyz, np.float32(rng.choice([-np.inf, 0.0, np.inf])))


def with_columns(rng, sensor, xyz):
    """Coordinates with intensities, lags of sweeps and laser numbers."""
    number = len(xyz)
    more = [rng.choice([0.0, 1, 255, 70_000], number), rng.choice([0.0, 0.05, 0.45, 100], number)]
    if sensor.row_source == "laser":
        more.append(rng.integers(-1, sensor.num_rows + 1, number))
    return np.column_stack([xyz, *more])


KINDS = (anywhere, on_a_beam, on_the_limits, one_point, extreme)


def make_points(rng, sensor, number):
    """Points f32[number, c] of one to three kinds, sometimes with extreme values."""
    kinds = [KINDS[rng.integers(len(KINDS))](rng, sensor, number) for _ in range(rng.integers(1, 4))]
    points = np.stack(kinds)[rng.integers(0, len(kinds), number), np.arange(number)].astype(np.float32)
    if rng.random() < 0.3:
        hit = rng.random(points.shape) < rng.choice([0.01, 0.2, 1.0])
        points[hit] = rng.choice(EXTREME, hit.sum())
    return points


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda sensor: sensor.name)
def test_a_projected_cloud_is_finite_and_contains_each_point_at_most_once(sensor):
    dropped = filled_cells = 0
    for seed in range(150):
        rng = np.random.default_rng([0, seed])
        points = make_points(rng, sensor, POINTS)
        valid = rng.random(POINTS) < rng.choice([0.0, 0.5, 1.0], p=[0.05, 0.35, 0.6])
        options = {"num_rounds": 3, "prioritize_current": seed % 3 > 0}
        image, again = (jax.device_get(project_points(points, valid, sensor, **options)) for _ in range(2))
        filled = image.point_index >= 0
        rows = image.point_index[filled]
        assert np.isfinite(image.features).all(), seed
        assert not image.features[np.broadcast_to(~filled[:, :, None], image.features.shape)].any(), seed
        assert len(np.unique(rows)) == len(rows), seed
        assert valid[rows].all(), seed
        assert (filled[..., :-1] >= filled[..., 1:]).all(), "a round is filled after an empty one"
        assert 0 <= image.num_dropped <= valid.sum() - len(rows), seed
        own = image.features.transpose(0, 1, 3, 2)[filled][:, [0, 1, 2, 6, 8]]
        np.testing.assert_array_equal(own, points[rows, :5])
        assert bits(image) == bits(again), seed
        dropped, filled_cells = dropped + int(image.num_dropped), filled_cells + len(rows)
    assert dropped
    assert filled_cells


def test_boxes_are_finite(detector):
    boxes = 0
    config = dataclasses.replace(detector.config, num_sweeps=100)
    for seed in range(10):
        rng = np.random.default_rng([0, seed, 1])
        points = make_points(rng, detector.sensor, int(rng.choice([1, 7, 500, 1000, 2000])))
        cloud = make_cloud(points, config, sensor=detector.sensor, num_close=0)  # lags are not refused
        found, again = detector.detect(cloud), detector.detect(cloud)
        assert np.isfinite(found.boxes).all(), seed
        assert ((found.scores >= 0) & (found.scores <= 1)).all(), seed
        assert (found.boxes[found.valid][:, 3:6] > 0).all(), seed
        assert (found.labels < len(detector.classes)).all(), seed
        assert bits(found) == bits(again), seed
        boxes += int(found.valid.sum())
    assert boxes


def test_no_note_about_scaled_intensities_if_the_sensor_does_not_scale(monkeypatch):
    monkeypatch.setattr(detector_module, "tell", told := Mock())
    points = np.full((10, 4), 60_000.0, np.float32)
    np.testing.assert_array_equal(detector_module._scaled_once(points, TINY, 1)[:, 3], points[:, 3])
    told.assert_not_called()
    _ = detector_module._scaled_once(points, dataclasses.replace(TINY, intensity_scale=255.0), 1)
    told.assert_called_once()

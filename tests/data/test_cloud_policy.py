"""The cloud policy: removal, truncation and counts of points, and warnings about another sensor."""

import dataclasses
import re

import numpy as np
import pytest
from refusal import refused

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.cloud_policy import (
    MAX_INTENSITY,
    make_cloud,
    no_usable_points,
    sensor_mismatch,
    unusable_cloud,
    unusable_clouds,
    usable_rows,
)
from fcos_lidar_jax.data.point_files import MAX_TIME_LAG_S, read_points
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import ARGOVERSE2, NUSCENES_HDL32E, PRESETS, TINY
from fcos_lidar_jax.simulation.frames import make_frame

LAGS = np.repeat(np.array([0, 0.05, 0.1], np.float32), [40, 50, 60])


def cloud_of(points, size=200, *, sensor=TINY, remove="all", close_m=1.0, **options):
    projection = dataclasses.replace(QUICKSTART.projection, remove_close=remove, close_m=close_m)
    config = dataclasses.replace(QUICKSTART, num_sweeps=4, max_points=size, projection=projection)
    return make_cloud(points, config, sensor=sensor, **options)


def test_the_fifth_column_is_checked_in_points_of_no_reader():
    with refused("points: fifth column: got whole numbers up to 31, which look like a ring"):
        cloud_of(numbered(np.arange(32, dtype=np.float32)))
    with refused("points: fifth column: got 5 different values up to 4, expected the time lag in seconds"):
        cloud_of(numbered(np.arange(5, dtype=np.float32)), num_close=0)
    seconds = numbered(np.arange(3, dtype=np.float32))
    assert cloud_of(seconds, num_close=0).valid.sum() == 3  # a reader's sweeps may be whole seconds apart


def numbered(lags=LAGS, *, columns=5):
    """Rows that are numbered by x, with the sweeps in mixed order."""
    points = np.full((len(lags), columns), 9, np.float32)
    points[:, 0] = 5 + np.arange(len(lags)) / 1000
    points[:, 4] = np.random.default_rng(0).permutation(lags)
    return points


def test_valid_rows_stay_unchanged():
    points = numbered()
    cloud = cloud_of(points)
    np.testing.assert_array_equal(cloud.points[:150], points)
    assert not cloud.points[150:].any()
    assert cloud.valid.tolist() == [True] * 150 + [False] * 50
    assert (cloud.num_points, cloud.num_removed) == (150, 0)


@pytest.mark.parametrize(
    ("column", "absurd", "fine"),
    [
        *((column, value, 9.0) for column in range(5) for value in (np.nan, -np.inf)),
        *((3, 1e30, MAX_INTENSITY), (3, -65_536.0, -1.0), (4, 60.1, MAX_TIME_LAG_S), (4, -0.05, 0.0)),
    ],
)
def test_rows_beyond_physical_limits_are_marked_invalid(column, absurd, fine):
    points = numbered()
    points[[3, 77], column], points[4, column] = absurd, fine
    cloud = cloud_of(points)
    assert np.flatnonzero(~cloud.valid[:150]).tolist() == [3, 77]
    assert (cloud.num_invalid, cloud.num_close, cloud.num_truncated) == (2, 0, 0)


@pytest.mark.parametrize(("mode", "removed"), [("all", [0, 1, 2]), ("sweeps", [2])])
def test_close_points_are_removed_as_configured_and_counted_once(mode, removed):
    points = numbered()
    points[:4, :2] = [[0.5, -0.5], [1.0, 0], [-0.99, 0.99], [0, 0]]
    points[:4, 4] = [0, 0, 0.05, 0.05]
    points[3, 3] = np.nan  # close and not finite: counted as not finite
    cloud = cloud_of(points, remove=mode, close_m=1.01)
    assert np.flatnonzero(~cloud.valid[:150]).tolist() == [*removed, 3]
    assert (cloud.num_close, cloud.num_invalid) == (len(removed), 1)
    assert (cloud.num_points, cloud.num_removed) == (150, len(removed) + 1)
    read = cloud_of(points, remove=mode, close_m=1.01, num_close=11)  # the reader has removed close points
    assert np.flatnonzero(~read.valid[:150]).tolist() == [3]
    assert (read.num_points, read.num_close, read.num_removed) == (161, 11, 12)


@pytest.mark.parametrize(
    ("size", "kept"),
    [(150, (40, 50, 60)), (149, (40, 50, 59)), (95, (40, 50, 5)), (60, (40, 20, 0)), (13, (13, 0, 0))],
)
def test_the_oldest_sweeps_are_truncated_first(size, kept):
    points = numbered()
    cloud = cloud_of(points, size)
    assert cloud.points.shape == (size, 5)
    assert cloud.valid.all()
    assert cloud.num_truncated == 150 - size
    assert tuple(np.count_nonzero(cloud.points[:, 4] == lag) for lag in np.unique(LAGS)) == kept
    assert (np.diff(cloud.points[:, 0]) > 0).all()  # in their order, each once
    assert np.isin(cloud.points[:, 0], points[:, 0]).all()


def test_random_rows_of_the_boundary_sweep_are_truncated():
    """They are spread over the sweep; otherwise a sector of the scan would be missing."""
    points = numbered(np.zeros(10_000, np.float32))
    first, again = cloud_of(points, 4000), cloud_of(points, 4000)
    np.testing.assert_array_equal(first.points, again.points)
    rows = np.searchsorted(points[:, 0], first.points[:, 0])
    assert np.abs(np.bincount(rows // 1000, minlength=10) - 400).max() < 60


def test_removed_rows_do_not_count_towards_the_limit():
    points = numbered()
    points[:30, 0] = np.nan
    cloud = cloud_of(points, 120)
    np.testing.assert_array_equal(cloud.points, points[30:])
    assert (cloud.valid.all(), cloud.num_invalid, cloud.num_truncated) == (True, 30, 0)


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
def test_missing_columns_are_zero_and_surplus_columns_are_dropped(columns):
    cloud = cloud_of(numbered(columns=6)[:, :columns].astype(np.float64))
    assert (cloud.points.shape, cloud.points.dtype) == ((200, 5), np.float32)
    assert cloud.points[:150, 3].any() == (columns > 3)
    assert cloud.points[:150, 4].any() == (columns > 4)
    assert cloud.valid.sum() == 150


@pytest.mark.parametrize(
    ("shape", "sensor", "expected"),
    [((4, 2), TINY, "3 to 6"), ((4, 7), TINY, "3 to 6"), ((4, 5), ARGOVERSE2, "6")],
)
def test_a_wrong_number_of_columns_is_refused(shape, sensor, expected):
    with refused(f"points: got shape {shape}, expected [n, {expected}]"):
        cloud_of(np.zeros(shape, np.float32), sensor=sensor)


def test_a_line_tells_a_cloud_without_usable_points_with_the_counts():
    points = numbered()
    points[:20, 2], points[20:50, :2] = np.nan, 0
    cloud = cloud_of(points)
    assert no_usable_points("a.bin", cloud, 99, TINY) is None
    line = no_usable_points("a.bin", cloud, 100, TINY)
    assert line.startswith("a.bin: none of its 150 points")
    assert "(20 not finite or beyond physical limits, 30 on the ego vehicle" in line
    line = no_usable_points("a.bin", cloud_of(points[:0]), 0, TINY)
    assert line == "a.bin: no points in it, expected at least one"


def test_a_cloud_of_a_reader_is_usable_with_one_point_in_the_range_image():
    points = np.tile(np.float32([1e3, 0, 0, 50, 0]), (10_000, 1))
    points[:7, 3] = np.nan
    line = unusable_cloud("a.bin", points, np.asarray(usable_rows(points)), 5, TINY)
    expected = "none of its 10005 points is usable (7 not finite or beyond physical limits, 5 on the ego vehicle, "
    assert line.startswith(f"a.bin: {expected}")
    points[9_000, 0] = 9
    assert unusable_cloud("a.bin", points, np.asarray(usable_rows(points)), 5, TINY) is None
    line = unusable_cloud("a.bin", points[:0], np.zeros(0, bool), 0, TINY)
    assert line == "a.bin: no points in it, expected at least one"


def test_one_line_tells_all_unusable_clouds_and_none_usable_is_refused():
    assert unusable_clouds([], 0) is None
    line = unusable_clouds(["a: no", "b: no"], 3)
    assert line == "2 of 3 clouds without usable points, and so without boxes: the first is a: no"
    with refused("a: no"):
        unusable_clouds(["a: no", "b: no"], 2)


@pytest.fixture(scope="module")
def clouds():
    return {name: make_frame(0, sensor).points for name, sensor in PRESETS.items()}


@pytest.mark.parametrize("name", PRESETS)
def test_a_sensors_own_clouds_give_no_warning(clouds, name):
    sensor = PRESETS[name]
    assert sensor_mismatch(clouds[name], sensor) is None
    ahead = clouds[name][np.abs(np.arctan2(clouds[name][:, 1], clouds[name][:, 0])) < 0.7]
    assert sensor_mismatch(ahead, sensor) is None  # KITTI's labelled part of the turn


def test_the_warning_is_about_the_current_sweep_only():
    points = make_frame(1, TINY, reading=CloudReading(4, "none")).points
    assert sensor_mismatch(points, TINY) is None
    points[:, 4] = 0
    assert sensor_mismatch(points, TINY) is not None


# Pairs (detector's sensor, cloud's sensor) with HDL-32E, whose beams and columns are like no other's.
OTHERS = sorted(PRESETS.keys() - {"nuscenes_hdl32e"})
PAIRS = [(name, "nuscenes_hdl32e") for name in OTHERS] + [("nuscenes_hdl32e", name) for name in OTHERS]


@pytest.mark.parametrize(("own", "other"), PAIRS)
def test_clouds_of_another_sensor_give_a_warning(clouds, own, other):
    points, sensor = clouds[other], PRESETS[own]
    if sensor.row_source == "laser":
        with refused("expected [n, 6]"):
            sensor_mismatch(points, sensor)
        return
    line = sensor_mismatch(points, sensor)
    assert repr(own) in (line or "")
    assert "\n" not in (line or "")


def test_the_warning_describes_the_mismatch(clouds):
    hdl32e = clouds["nuscenes_hdl32e"]
    millimetres = hdl32e * np.array([1000, 1000, 1000, 1, 1], np.float32)
    shares = hdl32e * np.array([1, 1, 1, 1 / 255, 1], np.float32)
    upwards, shuffled = (clouds["argoverse2"].copy() for _ in range(2))
    upwards[:, 5] = 63 - upwards[:, 5]
    shuffled[:, 5] = np.random.default_rng(0).permutation(64)[shuffled[:, 5].astype(int)]
    for points, sensor, finding in (
        (shares, "short_range", r"no intensity is above 1.*\d\.\d points per cell"),
        (hdl32e, "kitti_hdl64e", "0% of the points have a neighbour in the next row|next column"),
        (clouds["vlp16"], "nuscenes_hdl32e", "only 1[2-4] of 32 rows have points: the cloud has far fewer beams"),
        (hdl32e, "waymo_top", "outside its vertical field of view"),
        (hdl32e + np.array([0, 0, 100, 0, 0]), "nuscenes_hdl32e", "beyond its limits, .* < 54 m"),
        (millimetres, "nuscenes_hdl32e", "of the points lie beyond its limits"),
        (shares, "nuscenes_hdl32e", r"expected 0 to 255: multiply them by 255 \(--intensity-scale 255, or "),
        (hdl32e[:, :3], "nuscenes_hdl32e", "no intensity is above 1, expected 0 to 255;"),
        (hdl32e * np.array([1, 1, 1, 255, 1]), "nuscenes_hdl32e", "most intensities are above 255, expected 0 to"),
        (hdl32e + np.array([0, 0, 0, 0, 0.05]), "nuscenes_hdl32e", r"no points of the current .* lag is 0\.05 s"),
        (upwards, "argoverse2", "0% of the lasers lie above the next, expected all: number them from the top"),
        (shuffled, "argoverse2", "% of the lasers lie above the next"),
    ):
        assert re.search(finding, sensor_mismatch(points, PRESETS[sensor]) or "")


def test_too_few_points_give_no_warning():
    assert sensor_mismatch(np.ones((400, 4), np.float32) * 9, TINY) is None
    assert sensor_mismatch(np.zeros((0, 3), np.float32), TINY) is None


@pytest.mark.real_data
def test_real_clouds_fit_their_sensor_only(real_data):
    patterns = ("nuscenes_scene0[01]*/*.pcd.bin", "nuscenes_scene0523/samples/*/*.bin")
    files = [file for pattern in patterns for file in sorted(real_data.glob(pattern))]
    assert len(files) == 43
    clouds = [read_points(file, NUSCENES_HDL32E) for file in files]
    for points in clouds:
        assert sensor_mismatch(points, NUSCENES_HDL32E) is None
    for name in OTHERS:
        if PRESETS[name].row_source != "laser":
            assert sensor_mismatch(clouds[0], PRESETS[name]) is not None, name
    fused = np.fromfile(real_data / "ten_sweep_cloud" / "cloud.f16.bin", np.float16).reshape(-1, 5)
    assert sensor_mismatch(fused, NUSCENES_HDL32E) is None

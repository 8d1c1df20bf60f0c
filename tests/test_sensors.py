"""Check presets, sensor files, and one-line errors for invalid sensors."""

import dataclasses
import json
import math

import jax.numpy as jnp
import numpy as np
import pytest

from fcos_lidar_jax.geometry import image_columns
from fcos_lidar_jax.projection import image_cells
from fcos_lidar_jax.sensors import (
    PRESETS,
    TINY,
    Sensor,
    in_frame_of,
    load_sensor,
    sector,
    sensor_from_json,
    sensor_to_json,
)


def test_presets_match_the_paper_and_the_data_sheets():
    nuscenes = PRESETS["nuscenes_hdl32e"]
    assert (nuscenes.num_rows, nuscenes.num_columns) == (32, 1086)
    degrees = np.degrees(nuscenes.inclinations_rad)
    np.testing.assert_allclose(degrees, 10.67 - np.arange(32) * (10.67 + 30.67) / 31, atol=1e-9)
    assert (PRESETS["waymo_top"].num_rows, PRESETS["waymo_top"].num_columns) == (64, 2650)
    assert PRESETS["kitti_hdl64e"].num_rows == PRESETS["argoverse2"].num_rows == 64
    assert PRESETS["argoverse2"].point_columns == 6
    assert nuscenes.even_step_rad is not None
    assert PRESETS["kitti_hdl64e"].even_step_rad is None
    camera = PRESETS["kitti_camera"]
    assert camera.inclinations_rad == PRESETS["kitti_hdl64e"].inclinations_rad
    assert camera.column_rad == PRESETS["kitti_hdl64e"].column_rad
    assert camera.azimuth_limits_rad == (-math.pi / 4, math.pi / 4)


@pytest.mark.parametrize(
    ("name", "beams", "highest", "lowest", "finest", "columns"),
    [
        ("vlp16", 16, 15.0, -15.0, 2.0, 1800),
        ("os1_64", 64, 16.6, -16.6, 33.2 / 63, 1024),
        ("os1_128", 128, 22.5, -22.5, 45 / 127, 1024),
        ("pandar64", 64, 15.0, -25.0, 1 / 6, 1800),
    ],
)
def test_sensors_of_data_sheets(name, beams, highest, lowest, finest, columns):
    degrees = np.degrees(PRESETS[name].inclinations_rad)
    assert (len(degrees), PRESETS[name].num_columns) == (beams, columns)
    np.testing.assert_allclose([degrees[0], degrees[-1], -np.diff(degrees).max()], [highest, lowest, finest])


def test_pandar64_is_within_a_fifth_of_a_degree_of_a_calibrated_unit():
    # Some channels of a unit's angle correction file, as the manufacturer's SDK ships it.
    unit = {1: 14.838, 4: 5.017, 6: 1.999, 18: -0.024, 30: -2.058, 42: -4.094, 54: -6.109, 55: -7.097, 64: -24.883}
    degrees = np.degrees(PRESETS["pandar64"].inclinations_rad)
    np.testing.assert_allclose([degrees[channel - 1] for channel in unit], list(unit.values()), atol=0.2)


def test_row_edges_are_midpoints_and_extend_half_a_row_outwards():
    sensor = Sensor("three", (0.3, 0.1, 0.0), 8)
    np.testing.assert_allclose(sensor.row_edges_rad, [0.4, 0.2, 0.05, -0.05])


@pytest.mark.parametrize("name", PRESETS)
def test_sensors_survive_a_round_trip_through_files(tmp_path, name):
    path = tmp_path / "sensor.json"
    path.write_text(json.dumps(sensor_to_json(PRESETS[name])))
    assert load_sensor(path) == PRESETS[name] == load_sensor(name)


@pytest.mark.parametrize("middle", np.linspace(-4, 4, 23))
def test_a_sector_can_be_a_whole_turn(middle):
    whole = sector(TINY, middle, TINY.num_columns)
    assert whole.column_rad == pytest.approx(TINY.column_rad)
    moved = in_frame_of(whole, dataclasses.replace(TINY, forward_rad=math.remainder(middle - 1, 2 * math.pi)))
    assert moved.column_rad == pytest.approx(TINY.column_rad)
    seam = np.float32(whole.first_azimuth_rad) + np.linspace(-3e-6, 3e-6, 13, dtype=np.float32)
    column, inside = image_columns(jnp.concatenate([seam, seam - np.float32(2 * np.pi)]), whole)
    assert inside.all()
    assert set(column.tolist()) <= {0, whole.num_columns - 1}


@pytest.mark.parametrize("middle", [math.pi / 2, -math.pi, 7.0])
def test_a_sector_keeps_the_column_width(middle):
    part = sector(TINY, middle, 64)
    right, left = part.azimuth_limits_rad
    assert math.remainder((left + right) / 2 - middle, 2 * math.pi) == pytest.approx(0, abs=1e-12)
    assert left - right == pytest.approx(math.pi / 2)
    assert part.column_rad == pytest.approx(TINY.column_rad) == pytest.approx(2 * math.pi / 256)
    assert (part.first_azimuth_rad, TINY.first_azimuth_rad) == (left, math.pi)


def test_the_heading_of_files_without_it_is_that_of_the_preset_of_the_same_name():
    for sensor in PRESETS.values():
        record = sensor_to_json(sensor)
        assert record.pop("forward_rad") == sensor.forward_rad
        assert sensor_from_json(record).forward_rad == sensor.forward_rad
        assert sensor_from_json({**record, "name": "mine"}).forward_rad is None
        for heading in (None, -1.0):
            other = dataclasses.replace(sensor, forward_rad=heading)
            assert sensor_from_json(json.loads(json.dumps(sensor_to_json(other)))) == other
            assert repr(other) == repr(sensor)
    headings = {name: sensor.forward_rad for name, sensor in PRESETS.items()}
    assert [headings[name] for name in ("nuscenes_hdl32e", "kitti_hdl64e", "vlp16")] == [math.pi / 2, 0, None]


def test_an_image_in_another_frame_has_the_same_cells():
    """Points that NumPy's matrices move to the sensor's frame fall into the same cells."""
    rng = np.random.default_rng(0)
    data = dataclasses.replace(TINY, origin_m=(1.4, -0.3, 1.6), forward_rad=-2.0, intensity_scale=255.0)
    expected = dataclasses.replace(sector(TINY, 1.0, 100), origin_m=(0.2, 0.5, -0.4))
    here = in_frame_of(expected, data)
    assert (here.origin_m, here.forward_rad, here.intensity_scale) == (data.origin_m, -2.0, 255.0)
    turn = np.pi / 2 + 2.0
    matrix = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    directions = rng.uniform((-8, -8, -3), (8, 8, 1), (2000, 3))
    points = np.pad(directions, ((0, 0), (0, 2))).astype(np.float32)
    there = np.pad(directions @ matrix.T + expected.origin_m, ((0, 0), (0, 2))).astype(np.float32)
    points[:, :3] += data.origin_m
    valid = np.ones(2000, bool)
    cells, others = (
        np.asarray(image_cells(*each)[0]) for each in ((points, valid, here), (there, valid, expected))
    )
    assert (cells == others).mean() > 0.99  # but for points on the edge of a cell
    assert 100 < (cells < 1600).sum() < 1500


@pytest.mark.parametrize("beams", [{"lowest": -25, "highest": 3, "rows": 3}, [3, -11, -25]])
def test_beams_can_be_given_in_degrees(beams):
    sensor = sensor_from_json({"name": "a", "num_columns": 1024, "inclinations_deg": beams})
    np.testing.assert_allclose(sensor.inclinations_rad, np.deg2rad([3, -11, -25]))


GOOD = {"name": "a", "num_columns": 8, "inclinations_rad": [0.1, 0.0]}
BEAMLESS = {"name": "a", "num_columns": 8}
BAD = [
    ([1], "got list, expected a JSON object"),
    ({**GOOD, "colour": 1}, "colour: unknown field, expected one of name, inclinations_rad, num_columns"),
    (BEAMLESS, "inclinations_deg, inclinations_rad: missing, expected one of them"),
    ({**GOOD, "inclinations_deg": {}}, "inclinations_deg, inclinations_rad: both, expected one of them"),
    ({**GOOD, "num_columns": "many"}, "num_columns: got 'many'"),
    ({**GOOD, "num_columns": 100_000_000}, "num_columns: got 100000000, expected within"),
    ({**GOOD, "inclinations_rad": [-i / 1e4 for i in range(5000)]}, "expected 2 to 4096 strictly decreasing"),
    ({**GOOD, "inclinations_rad": [0.0, 0.1]}, "expected 2 to 4096 strictly decreasing values, the highest"),
    ({**GOOD, "inclinations_rad": [3.0, 0.0]}, "within"),
    ({**GOOD, "inclinations_rad": "0.1 0.0"}, "expected a list"),
    ({**GOOD, "inclinations_rad": [None, 0.0]}, r"inclinations_rad\[0\]: got None, expected float"),
    ({**BEAMLESS, "inclinations_deg": {"lowest": 1}}, "inclinations_deg.highest: missing"),
    ({**BEAMLESS, "inclinations_deg": {"lowest": 0, "highest": 1, "rows": 2**32}}, "rows: got 4294967296"),
    ({**BEAMLESS, "inclinations_deg": {"lowest": 5, "highest": -5, "rows": 2}}, "inclinations_rad: .* decreasing"),
    ({**BEAMLESS, "inclinations_deg": [1, "2"]}, r"inclinations_deg\[1\]: got '2', expected float"),
    ({**GOOD, "azimuth_limits_rad": [1]}, "azimuth_limits_rad: got .*, expected a tuple of 2 float or None"),
    ({**GOOD, "azimuth_limits_rad": [1, 1]}, r"azimuth_limits_rad: got \(1\.0, 1\.0\), expected \(right, left\)"),
    ({**GOOD, "azimuth_limits_rad": [-3, 4]}, r"azimuth_limits_rad: got \(-3\.0, 4\.0\), expected \(right, "),
    ({**GOOD, "limit_xy_m": 1e31}, "limit_xy_m: got 1e"),
    ({**GOOD, "limit_xy_m": math.nan}, "limit_xy_m: got nan"),
    ({**GOOD, "limit_z_m": [3, 1]}, "limit_z_m"),
    ({**GOOD, "forward_rad": 90}, "forward_rad: got 90.0, expected within"),
    ({**GOOD, "row_source": "ring"}, "row_source: got 'ring'"),
    (None, r"no such file, expected a sensor file or a preset \(nuscenes_hdl32e"),
    ("{", "not JSON"),
    pytest.param("[" * 100_000, "not JSON", id="deep"),
    ('"tinny"', "got 'tinny', expected tiny$"),
]


@pytest.mark.parametrize(("record", "message"), BAD)
def test_errors_are_one_line_with_file_and_field(tmp_path, record, message):
    path = tmp_path / "sensor.json"
    if record is not None:
        path.write_text(record if isinstance(record, str) else json.dumps(record))
    with pytest.raises(ValueError, match=message) as caught:
        load_sensor(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_may_hold_the_name_of_a_preset(tmp_path):
    """As ``sensor.json`` in a folder of own data may."""
    (tmp_path / "sensor.json").write_text('"tiny"')
    assert load_sensor(tmp_path / "sensor.json") == TINY

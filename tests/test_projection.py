"""Compare multi-round projection with loops, on random, degenerate and real clouds."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from jax import export

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.projection import image_cells, priority_keys, project_points, remove_close, winners
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, PRESETS, WAYMO_TOP, Sensor, even_inclinations, sector

pytestmark = pytest.mark.optimised

SMALL = Sensor("small", even_inclinations(-20, 10, 4), 12)
LASER = dataclasses.replace(SMALL, name="laser", row_source="laser", origin_m=(1.0, -2.0, 0.5))


AHEAD, BEHIND = sector(NUSCENES_HDL32E, np.pi / 2, 272), sector(WAYMO_TOP, -np.pi, 300)  # across azimuth pi


def cloud(seed: int, number: int = 400, columns: int = 5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = np.zeros((number, columns), np.float32)
    points[:, :2] = rng.normal(0, 20, (number, 2))
    points[:, 2] = rng.normal(-1, 1.5, number)
    # Exact ties of cell and range, some between sweeps. The intensity distinguishes the points.
    points[rng.integers(0, number, 60)] = points[rng.integers(0, number, 60)]
    points[:, 3] = rng.uniform(0, 255, number)
    points[:, 4] = rng.integers(0, 3, number) * np.float32(0.05)
    if columns == 6:
        points[:, 5] = rng.integers(-1, 5, number)
    return points


def cells_of(points: np.ndarray, sensor: Sensor) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Cells and angles of up to 5,000 points, padded so that each sensor is compiled once."""
    padded = np.zeros((5000, sensor.point_columns), np.float32)
    padded[: len(points), : points.shape[1]] = points
    found = image_cells(jnp.asarray(padded), jnp.arange(5000) < len(points), sensor)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(points)], found)


def reference_cells(points: np.ndarray, sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Cells by definition, in float64, and the angle between each point and the nearest edge of its cell."""
    p = points.astype(np.float64)
    x, y, z = (p[:, i] - sensor.origin_m[i] for i in range(3))
    theta, phi = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    right, left = sensor.azimuth_limits_rad or (-np.pi, np.pi)
    u = (left - theta) % (2 * np.pi) / (left - right) * sensor.num_columns
    table = np.array(sensor.inclinations_rad)
    if sensor.row_source == "laser":
        row = p[:, 5].astype(int)
        edge = np.full(len(p), np.inf)
    else:
        row = np.abs(phi[:, None] - table).argmin(1)
        top = table[0] + (table[0] - table[1]) / 2
        bottom = table[-1] - (table[-2] - table[-1]) / 2
        row = np.where((phi > top) | (phi < bottom), -1, row)
        middles = np.array([top, *(table[1:] + table[:-1]) / 2, bottom])
        edge = np.abs(phi[:, None] - middles).min(1)
    edge = np.minimum(edge, np.abs(u - np.round(u)) * (left - right) / sensor.num_columns)
    good = (np.abs(p[:, 0]) < sensor.limit_xy_m) & (np.abs(p[:, 1]) < sensor.limit_xy_m)
    good &= (p[:, 2] > sensor.limit_z_m[0]) & (p[:, 2] < sensor.limit_z_m[1])
    good &= (row >= 0) & (row < sensor.num_rows) & (u < sensor.num_columns)
    cells = sensor.num_rows * sensor.num_columns
    return np.where(good, row * sensor.num_columns + np.floor(u).astype(int) % sensor.num_columns, cells), edge


@pytest.mark.parametrize("sensor", [SMALL, LASER, AHEAD, BEHIND, *PRESETS.values()], ids=lambda s: s.name)
def test_cells_match_their_definition(sensor):
    points = cloud(0, 5000, sensor.point_columns)
    cells, (range_m, azimuth, inclination) = cells_of(points, sensor)
    expected, edge = reference_cells(points, sensor)
    clear = edge > 1e-6  # rounding decides at the edge itself
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(cells[clear], expected[clear])
    xyz = points[:, :3].astype(np.float64) - np.array(sensor.origin_m)
    np.testing.assert_allclose(range_m, np.linalg.norm(xyz, axis=1), rtol=1e-6)
    np.testing.assert_allclose(azimuth, np.arctan2(xyz[:, 1], xyz[:, 0]), atol=4e-7)
    np.testing.assert_allclose(inclination, np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])), atol=4e-7)


@pytest.mark.parametrize(("num_rounds", "prioritize_current"), [(1, True), (5, True), (5, False)])
def test_rounds_keep_the_same_points_as_loops(num_rounds, prioritize_current):
    points = cloud(num_rounds)
    valid = np.random.default_rng(9).random(len(points)) < 0.9
    image = project_points(points, valid, SMALL, num_rounds=num_rounds, prioritize_current=prioritize_current)
    cell, angles = cells_of(points, SMALL)
    cell = np.where(valid, cell, 48)
    older = (points[:, 4] != 0) & prioritize_current
    expected = oracles.project(cell, older, angles[0], 48, num_rounds)
    np.testing.assert_array_equal(np.asarray(image.point_index).reshape(48, num_rounds), expected)
    assert int(image.num_dropped) == (valid & (cell == 48)).sum() > 0
    features = np.asarray(image.features).reshape(48, 9, num_rounds)
    channels = np.stack([*points[:, :3].T, *angles, points[:, 3], np.ones(400), points[:, 4]], 1)
    expected_features = np.where(expected[..., None] >= 0, channels[expected], 0)
    np.testing.assert_array_equal(features, expected_features.swapaxes(1, 2))


@pytest.mark.parametrize("form", ["scatter", "sort"])
def test_winners_match_a_sort_per_cell(form):
    """Includes ties, empty cells, excluded points, more rounds than points, and a cloud without points."""
    rng = np.random.default_rng(0)
    cell, keys = rng.integers(0, 21, 200).astype(np.int32), rng.integers(0, 9, 200).astype(np.uint32)
    keys[::7] |= np.uint32(1 << 31)
    cell[cell == 4] = 5
    expected = np.full((20, 12), -1)
    for c in range(20):
        own = np.flatnonzero(cell == c)
        ranked = own[np.lexsort((own, keys[own]))][:12]
        expected[c, : len(ranked)] = ranked
    assert {11, 12} < set((expected >= 0).sum(axis=1))
    compute = functools.partial(winners, num_cells=20, num_rounds=12, form=form)
    np.testing.assert_array_equal(jax.jit(compute)(cell, keys), expected)
    batch = jax.jit(jax.vmap(compute))(np.stack([cell, np.full_like(cell, 20)]), np.stack([keys] * 2))
    np.testing.assert_array_equal(batch, [expected, np.full_like(expected, -1)])


def test_tpu_programs_contain_no_64_bit_types_and_no_loop():
    given = jnp.zeros(9, jnp.int32), jnp.zeros(9, jnp.uint32)
    for platform, wide in (("cpu", True), ("cuda", True), ("tpu", False)):
        program = jax.jit(functools.partial(winners, num_cells=4, num_rounds=3))
        text = export.export(program, platforms=(platform,))(*given).mlir_module()
        assert ("ui64" in text, "stablehlo.while" in text) == (wide, wide)


@pytest.mark.parametrize(
    "sensor", [s for s in PRESETS.values() if s.azimuth_limits_rad is None], ids=lambda sensor: sensor.name
)
def test_columns_run_clockwise_from_azimuth_pi(sensor):
    """Column 0 starts at azimuth pi, for both signs of y = 0, and the last column ends there."""
    x, _, z = sensor.origin_m
    behind, count = np.float32(x - 5), sensor.num_columns
    y = np.array([0.0, -0.0, 1e-3, -1e-3], np.float32)
    points = np.zeros((6, sensor.point_columns), np.float32)
    points[:4, 0], points[:4, 1], points[:, 2] = behind, y, z - 0.1
    points[4, :2], points[5, :2] = (x + 1e-3, 5), (x + 1e-3, -5)
    assert (cells_of(points, sensor)[0] % count).tolist() == [0, 0, 0, count - 1, count // 4, (3 * count - 1) // 4]


def test_range_limits_are_exclusive():
    ends = [(0, 54), (0, -54), (1, 54), (1, -54), (2, -5), (2, 3)]
    points = np.tile(np.float32([20, 0, 0, 0, 0]), (12, 1))
    for i, (axis, end) in enumerate(ends):
        points[2 * i : 2 * i + 2, axis] = end, np.nextafter(np.float32(end), np.float32(0))
    assert (cells_of(points, SMALL)[0] < SMALL.num_rows * SMALL.num_columns).tolist() == [False, True] * 6


def test_only_points_with_zero_time_lag_are_current():
    range_m, lag = jnp.array([5.0, 9.0, 6.0]), jnp.array([1e-6, -0.0, 0.4])
    for prioritize, order in ((True, [1, 0, 2]), (False, [0, 2, 1])):
        keys = priority_keys(range_m, lag, prioritize_current=prioritize)
        assert np.argsort(np.asarray(keys)).tolist() == order


def test_unusable_rows_are_dropped_and_counted_and_change_no_other_point():
    points, valid = cloud(3), np.arange(400) >= 5
    alone = project_points(points, valid, SMALL)
    points[:5] = [[np.nan, 1, 0, 0, 0], [1, np.inf, 0, 0, 0], [5, 5, 0, np.nan, 0], [5, 5, 0, 0, np.nan], [60] * 5]
    mixed = project_points(points, np.ones(400, bool), SMALL)
    assert_same(alone, mixed)
    assert int(mixed.num_dropped) == int(alone.num_dropped) + 5


@pytest.mark.parametrize("number", [0, 400])
def test_a_cloud_of_padding_gives_an_empty_image(number):
    image = project_points(np.full((number, 5), np.nan, np.float32), np.zeros(number, bool), SMALL)
    assert image.features.shape == (SMALL.num_rows, SMALL.num_columns, 9, 5)
    assert (np.asarray(image.point_index) == -1).all()
    assert not np.asarray(image.features).any()
    assert int(image.num_dropped) == 0


def bits(image):
    return [np.asarray(image.features).view(np.uint32), np.asarray(image.point_index)]


def assert_same(a, b):
    for x, y in zip(bits(a), bits(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_jit_vmap_and_repetition_are_bit_identical():
    a, b = cloud(1), cloud(2)
    valid = np.ones(400, bool)
    plain = project_points(a, valid, SMALL)
    assert_same(plain, project_points(a, valid, SMALL))
    assert_same(plain, jax.jit(lambda p: project_points(p, valid, SMALL))(a))
    batched = jax.jit(jax.vmap(lambda p: project_points(p, valid, SMALL)))(np.stack([b, a]))
    assert_same(plain, jax.tree.map(lambda leaf: leaf[1], batched))


def test_points_with_distinct_keys_can_be_in_any_order():
    points, valid = cloud(4), np.zeros(400, bool)
    valid[np.unique(points[:, :3], axis=0, return_index=True)[1]] = True
    order = np.random.default_rng(0).permutation(400)
    straight, shuffled = project_points(points, valid, SMALL), project_points(points[order], valid[order], SMALL)
    index = np.asarray(shuffled.point_index)
    np.testing.assert_array_equal(np.where(index >= 0, order[index], -1), straight.point_index)
    np.testing.assert_array_equal(bits(straight)[0], bits(shuffled)[0])


def test_gradients_are_finite_on_degenerate_points():
    points = cloud(5, 20)
    points[0, :3], points[1], points[2, :2] = 0, np.nan, 0

    def energy(p):
        return (project_points(p, np.ones(20, bool), SMALL, num_rounds=2).features ** 2).sum()

    gradient = np.asarray(jax.jit(jax.grad(energy))(jnp.asarray(points)))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0


@pytest.mark.parametrize(
    ("mode", "kept"), [("all", [0, 0, 1, 1]), ("sweeps", [1, 0, 1, 1]), ("none", [1, 1, 1, 1])]
)
def test_remove_close_modes(mode, kept):
    points = np.array(
        [[0.5, -0.9, 0, 0, 0], [0.5, 0.5, 0, 0, 0.1], [0.5, 1, 0, 0, 0.1], [2, 0, 0, 0, 0]], np.float32
    )
    for kind in (np.asarray, jnp.asarray):
        valid = remove_close(kind(points), kind(np.ones(4, bool)), SMALL, CloudReading(remove_close=mode))
        assert np.asarray(valid).astype(int).tolist() == kept


@pytest.fixture(scope="module")
def real_cloud(real_data):
    """A cloud of ten sweeps, and its mask without close points, by the mode that removes them."""
    raw = np.fromfile(real_data / "ten_sweep_cloud" / "cloud.f16.bin", np.float16)
    points = raw.reshape(-1, 5).astype(np.float32)
    every = np.ones(len(points), bool)
    modes = (CloudReading(remove_close=mode) for mode in ("none", "all"))
    masks = {m.remove_close: np.asarray(remove_close(points, every, NUSCENES_HDL32E, m)) for m in modes}
    return points, masks


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("close", "expected"),
    [
        ("none", [236_510, 225_958, 28_195, 11.9, 33.4, 50.9, 63.9, 22_928, 6_611]),
        ("all", [227_016, 219_375, 27_195, 12.0, 34.0, 52.2, 65.7, 21_811, 5_418]),
    ],
)
def test_real_cloud_gives_the_expected_counts(real_cloud, close, expected):
    points, valid = real_cloud[0], real_cloud[1][close]
    limits = (np.abs(points[:, :2]) < 54).all(axis=1) & (points[:, 2] > -5) & (points[:, 2] < 3)
    in_range = int((limits & valid).sum())
    current = []
    for prioritize in (True, False):
        image = project_points(points, valid, NUSCENES_HDL32E, num_rounds=7, prioritize_current=prioritize)
        index = np.asarray(image.point_index)
        kept = (index >= 0).sum((0, 1)).cumsum()
        first = index[..., 0]
        current.append(int(((first >= 0) & (points[np.maximum(first, 0), 4] == 0)).sum()))
        in_view = int(valid.sum()) - int(image.num_dropped)
        shares = [round(100 * kept[r - 1] / in_range, 1) for r in (1, 3, 5, 7)]
    actual = [in_range, in_view, int(kept[0]), *shares, *current]
    # In range, in view, kept by round 1, % kept by 1, 3, 5, 7 rounds, current cells with and without priority.
    for got, paper in zip(actual, expected, strict=True):
        assert abs(got - paper) <= (12 if isinstance(paper, int) else 0.1)

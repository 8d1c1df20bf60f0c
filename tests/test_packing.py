"""Check that packing is lossless, and that values that do not fit are named and never rounded."""

import dataclasses
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fcos_lidar_jax.packing import MisfitError, Packing, choose_packing, pack, unpack
from fcos_lidar_jax.types import Batch

ROWS, BOXES = 12, 3
unpack_compiled = jax.jit(unpack)


def make_batch(clouds, *, columns=5, seed=0) -> Batch:
    """Scatter the points of each cloud among padding rows of NaN."""
    rng = np.random.default_rng(seed)
    points = np.full((len(clouds), ROWS, columns), np.nan, np.float32)
    valid = np.zeros((len(clouds), ROWS), bool)
    for sample, cloud in enumerate(clouds):
        rows = np.sort(rng.choice(ROWS, len(cloud), replace=False))
        points[sample, rows] = np.array(cloud, np.float32).reshape(-1, columns)
        valid[sample, rows] = True
    boxes = rng.normal(0, 9, (len(clouds), BOXES, 9)).astype(np.float32)
    boxes[:, 0, 7:], boxes[:, 1, 0] = np.nan, -0.0
    labels = rng.integers(0, 10, (len(clouds), BOXES), dtype=np.int32)
    return Batch(points, valid, boxes, labels, rng.random((len(clouds), BOXES)) > 0.5)


def compacted(batch: Batch) -> Batch:
    """Move the valid rows to the front, by a loop over rows, and fill up with zeros."""
    points, valid = np.zeros_like(batch.points), np.zeros_like(batch.valid)
    for sample, (cloud, mask) in enumerate(zip(batch.points, batch.valid, strict=True)):
        for row, point in enumerate([p for p, is_valid in zip(cloud, mask, strict=True) if is_valid]):
            points[sample, row], valid[sample, row] = point, True
    return dataclasses.replace(batch, points=points, valid=valid)


def assert_same_bits(actual: Batch, expected: Batch) -> None:
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert (a.dtype, a.shape, np.asarray(a).tobytes()) == (b.dtype, b.shape, np.asarray(b).tobytes())


def shapes_and_types(tree) -> list:
    return [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


metres = st.floats(width=32, allow_nan=False, allow_subnormal=False) | st.just(-0.0)
byte = st.integers(0, 255).map(float)
lag = st.sampled_from([0.0, -0.0, 0.05, 0.1, 59.9])


@st.composite
def batches(draw, columns):
    row = [metres, metres, metres, byte, lag, byte][:columns]
    clouds = draw(st.lists(st.lists(st.tuples(*row), max_size=ROWS), min_size=1, max_size=3))
    return make_batch(clouds, columns=columns, seed=draw(st.integers(0, 99)))


@pytest.mark.parametrize("columns", [5, 6])
@pytest.mark.parametrize("packing", [Packing(5), Packing(400), Packing(0), Packing(5, False, False)], ids=str)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_unpacking_restores_the_same_bits(packing, columns, data):
    batch = data.draw(batches(columns))
    packed = pack(batch, packing)
    assert_same_bits(unpack_compiled(packed), compacted(batch))
    assert_same_bits(unpack(packed), compacted(batch))
    empty = make_batch([[]] * len(batch.points), columns=columns)
    assert shapes_and_types(packed) == shapes_and_types(pack(empty, packing))


@pytest.mark.parametrize("packing", [Packing(2), Packing(300), Packing(0, False)], ids=str)
@pytest.mark.parametrize("number", [0, ROWS])
def test_full_and_empty_clouds(packing, number):
    batch = make_batch([[(1, 2, 3, 4, 0.5)] * number] * 2)
    assert_same_bits(unpack(pack(batch, packing)), compacted(batch))
    assert int(unpack(pack(batch, packing)).valid.sum()) == 2 * number


@pytest.mark.parametrize(
    ("packing", "columns", "types"),
    [
        (Packing(256), 5, ("uint8", "uint8", None)),
        (Packing(257), 6, ("uint8", "uint16", "uint8")),
        (Packing(0, False, False), 6, ("float32", "float32", "float32")),
    ],
)
def test_packed_rows_have_the_stated_types_and_bytes(packing, columns, types):
    packed = pack(make_batch([[]], columns=columns), packing)
    arrays = packed.intensity, packed.lag, packed.laser
    assert tuple(None if array is None else str(array.dtype) for array in arrays) == types
    sizes = [array.nbytes for array in (packed.xyz, packed.intensity, packed.lag)]
    assert sum(sizes) == ROWS * packing.row_bytes
    assert packed.lags.shape == (1, packing.num_lags)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (3, 12.5, "intensity: got 12.5, expected whole numbers from 0 to 255"),
        (3, 256.0, "intensity: got 256.0, expected whole numbers from 0 to 255"),
        (3, -1.0, "intensity: got -1.0, expected whole numbers from 0 to 255"),
        (3, -0.0, "intensity: got -0.0, expected whole numbers from 0 to 255"),
        (3, np.nan, "intensity: got nan, expected whole numbers from 0 to 255"),
        (5, 0.25, "laser number: got 0.25, expected whole numbers from 0 to 255"),
        (4, 0.2, "time lag: got 3 different values in a sample, expected at most 2"),
        (4, -0.0, "time lag: got 3 different values in a sample, expected at most 2"),
    ],
)
def test_values_that_do_not_fit_are_named_and_never_rounded(column, value, message):
    cloud = np.array([[1, 2, 3, 7, lag, 9] for lag in (0, 0.1, 0.1)], np.float32)
    cloud[2, column] = value
    batch = make_batch([cloud[:2], cloud, cloud], columns=6)
    with pytest.raises(MisfitError) as caught:
        pack(batch, Packing(2))
    assert (caught.value.row, str(caught.value)) == (1, message)
    assert_same_bits(unpack(pack(batch, Packing(0, False, False))), compacted(batch))


def test_the_table_of_lags_can_have_65536_entries():
    with pytest.raises(ValueError, match="num_lags: got 65537, expected 0 to 65536"):
        Packing(65_537)
    lags = np.arange(65_536, dtype=np.float32) / 1024
    points = np.zeros((1, len(lags), 5), np.float32)
    points[0, :, 4] = np.random.default_rng(0).permutation(lags)
    truth = np.zeros((1, 1, 9), np.float32), np.zeros((1, 1), np.int32), np.zeros((1, 1), bool)
    batch = Batch(points, np.ones((1, len(lags)), bool), *truth)
    for size in (65_536, 0):
        assert_same_bits(unpack_compiled(pack(batch, Packing(size))), batch)


def test_an_unpacked_batch_is_returned_unchanged():
    batch = make_batch([[(1, 2, 3, 4, 0)]])
    assert unpack(batch) is batch


def cloud_of(*, intensity=(0, 255), lags=(0, 0.1), laser=()):
    columns = [np.resize(np.array(values, np.float32), 40) for values in (intensity, lags, laser) if len(values)]
    return np.stack([*np.random.default_rng(0).normal(size=(3, 40)).astype(np.float32), *columns], axis=1)


@pytest.mark.parametrize(
    ("clouds", "num_sweeps", "num_pasted", "expected"),
    [
        ([cloud_of()], 2, 0, Packing(2)),
        ([cloud_of(), cloud_of(intensity=(1, 2.5))], 2, 0, Packing(2, byte_intensity=False)),
        ([cloud_of(intensity=(1, np.nan))], 2, 0, Packing(2, byte_intensity=False)),
        ([cloud_of(lags=(0,))], 1, 50, Packing(51)),  # one-byte indices
        ([cloud_of()], 10, 50, Packing(510)),  # two-byte indices
        ([cloud_of()], 2, 40_000, Packing(0)),
        ([cloud_of(), cloud_of(lags=(0, 0.1, 0.2))], 2, 0, Packing(0)),  # one time lag per point
        ([cloud_of(laser=(0, 63))], 2, 0, Packing(2)),
        ([cloud_of(laser=(0, 300))], 2, 0, Packing(2, byte_laser=False)),
        ([cloud_of()[:0]], 2, 0, Packing(2)),
        ([], 2, 0, Packing(2)),
    ],
)
def test_the_given_clouds_determine_the_packing(clouds, num_sweeps, num_pasted, expected):
    assert choose_packing(clouds, num_sweeps=num_sweeps, num_pasted=num_pasted) == expected


def check_no_communication() -> None:
    """Each device unpacks its own samples."""
    from fcos_lidar_jax.devices.mesh import make_mesh, shard_batch

    mesh = make_mesh()
    assert mesh.size == 2
    batch = make_batch([[(1, 2, 3, 4, 0.1)] * n for n in range(4)])
    packed = shard_batch(pack(batch, Packing(3)), mesh)
    compiled = unpack_compiled.lower(packed).compile()
    text = compiled.as_text()
    assert not any(word in text for word in ("all-gather", "all-reduce", "all-to-all", "collective-permute"))
    assert_same_bits(compiled(packed), compacted(batch))


def test_each_device_unpacks_its_own_samples():
    code = "import test_packing; test_packing.check_no_communication()"
    paths = [os.path.dirname(__file__), *sys.path]
    environment = {**os.environ, "JAX_NUM_CPU_DEVICES": "2", "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]

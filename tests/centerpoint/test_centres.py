"""Targets, focal loss and coding of centres against loops and closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fcos_lidar_jax.centerpoint.centres import (
    centre_targets,
    decode_centres,
    encode_centres,
    focal_loss,
    gaussian_radius,
)
from fcos_lidar_jax.centerpoint.pillars import Grid
from fcos_lidar_jax.iou import oriented

GRID = Grid(24, 0.8, (-9.6, -9.6))
OPTIONS = {"grid": GRID, "num_classes": 3, "min_overlap": 0.1, "min_radius": 2}


targets_of = jax.jit(functools.partial(centre_targets, **OPTIONS))


def ground_truth(seed=0, number=14):
    rng = np.random.default_rng(seed)
    boxes = np.zeros((number, 9), np.float32)
    boxes[:, :2] = rng.uniform(-11, 11, (number, 2))
    boxes[:, 2] = rng.normal(size=number)
    boxes[:, 3:6] = rng.uniform(0.3, 12, (number, 3))
    boxes[:, 6] = rng.uniform(-np.pi, np.pi, number)
    boxes[:, 7:] = rng.normal(size=(number, 2))
    boxes[3, :2] = boxes[2, :2] + 0.9  # neighbours
    boxes[5] = np.nan  # padding
    valid = np.ones(number, bool)
    valid[5:7] = False
    return jnp.array(boxes), jnp.array(rng.integers(0, 3, number), jnp.int32), jnp.array(valid)


def published_radius(length, width, overlap):
    """CornerNet's three cases with numpy's roots; the larger one times the leading coefficient."""
    cases = [
        (1, -(length + width), length * width * (1 - overlap) / (1 + overlap)),
        (4, -2 * (length + width), (1 - overlap) * length * width),
        (4 * overlap, 2 * overlap * (length + width), (overlap - 1) * length * width),
    ]
    return min(max(np.roots(case).real) * case[0] for case in cases)


def heat_by_loops(boxes, labels, valid):
    heat = np.zeros((GRID.side, GRID.side, 3))
    for box, label, counts in zip(np.float64(boxes), labels, valid, strict=True):
        if not counts:
            continue
        column, row = np.floor((box[:2] + 9.6) / 0.8).astype(int)
        if not (0 <= column < GRID.side and 0 <= row < GRID.side):
            continue
        radius = max(2, int(published_radius(box[3] / 0.8, box[4] / 0.8, 0.1)))
        sigma = (2 * radius + 1) / 6
        for i in range(GRID.side):
            for j in range(GRID.side):
                if max(abs(i - row), abs(j - column)) <= radius:
                    value = np.exp(-((i - row) ** 2 + (j - column) ** 2) / (2 * sigma**2))
                    heat[i, j, label] = max(heat[i, j, label], value)
    return heat


@pytest.mark.parametrize("size", [(0.5, 0.5), (4.6, 1.9), (12.0, 2.9)])
@pytest.mark.parametrize("overlap", [0.1, 0.7])
def test_radius_is_the_published_one(size, overlap):
    found = gaussian_radius(*map(jnp.float32, size), min_overlap=overlap)
    assert float(found) == pytest.approx(published_radius(*size, overlap), rel=1e-5)


def test_heat_is_that_of_loops_also_in_batches():
    truth = ground_truth()
    expected = heat_by_loops(*truth)
    targets = targets_of(*truth)
    np.testing.assert_allclose(targets.heat, expected, atol=1e-6)
    assert targets.valid.sum() == np.count_nonzero(truth[2] & (np.abs(truth[0][:, :2]) < 9.6).all(axis=1)) > 3
    assert np.isfinite(targets.boxes).all()
    centres = targets.heat.reshape(-1, 3)[targets.cell[targets.valid], truth[1][targets.valid]]
    assert (centres == 1).all()
    other = ground_truth(7)
    several = jax.vmap(targets_of)(*map(jnp.stack, zip(truth, other, strict=True)))
    np.testing.assert_array_equal(several.heat[0], targets.heat)
    np.testing.assert_allclose(several.heat[1], heat_by_loops(*other), atol=1e-6)


def test_focal_loss_is_that_of_loops_and_finite_for_absurd_logits():
    boxes, labels, valid = ground_truth()
    targets = targets_of(boxes, labels, valid)
    logits = np.random.default_rng(2).normal(0, 2, targets.heat.shape)
    p, heat = 1 / (1 + np.exp(-logits)), np.asarray(targets.heat, np.float64)
    away, at_boxes = focal_loss(jnp.float32(logits), targets.heat, targets.cell, labels, targets.valid)
    for k in range(3):
        total = 0.0
        for i, j in np.ndindex(GRID.side, GRID.side):
            total -= (1 - heat[i, j, k]) ** 4 * p[i, j, k] ** 2 * np.log(1 - p[i, j, k])
        assert float(away[k]) == pytest.approx(total, rel=1e-4)
    for m in range(len(boxes)):
        expected = 0.0
        if targets.valid[m]:
            at = p.reshape(-1, 3)[targets.cell[m], labels[m]]
            expected = -((1 - at) ** 2) * np.log(at)
        assert float(at_boxes[m]) == pytest.approx(expected, rel=1e-4, abs=1e-7)

    def total(scale):
        parts = focal_loss(scale * jnp.float32(logits), targets.heat, targets.cell, labels, targets.valid)
        return sum(part.sum() for part in parts)

    value, slope = jax.jit(jax.value_and_grad(total))(jnp.float32(1e4))
    assert np.isfinite(value)
    assert np.isfinite(slope)


def test_decoding_undoes_encoding():
    boxes = np.delete(ground_truth()[0], 5, axis=0)
    column_row = np.clip(np.floor((boxes[:, :2] + 9.6) / 0.8), 0, 23).astype(np.int32)
    boxes, cell = jnp.array(boxes), jnp.array(column_row[:, 1] * GRID.side + column_row[:, 0])
    numbers = encode_centres(boxes, cell, GRID)
    np.testing.assert_allclose(numbers[:, :2], (boxes[:, :2] + 9.6) / 0.8 - column_row, atol=1e-4)
    np.testing.assert_allclose(numbers[:, 2], boxes[:, 2])
    np.testing.assert_allclose(numbers[:, 3:6], np.log(boxes[:, 3:6]), atol=1e-5)
    np.testing.assert_allclose(numbers[:, 6:8], np.stack([np.sin(boxes[:, 6]), np.cos(boxes[:, 6])], 1), atol=1e-5)
    np.testing.assert_allclose(decode_centres(numbers, cell, GRID), boxes, atol=1e-4)
    np.testing.assert_allclose(decode_centres(numbers, cell, GRID, oriented=True), oriented(boxes), atol=1e-4)

"""The objective of CenterPoint against loops over boxes, by group, and on empty batches."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_peer import CONFIG
from tiny_run import SENSOR, host_batch, untrained

from fcos_lidar_jax.centerpoint.centres import centre_targets, decode_centres, encode_centres, focal_loss
from fcos_lidar_jax.centerpoint.objective import make_sums, sample_losses
from fcos_lidar_jax.centerpoint.pillars import pillar_grid
from fcos_lidar_jax.centerpoint.types import CentreOutputs
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.training.objective import batch_metrics
from fcos_lidar_jax.training.step import make_gradient

PILLARS = CONFIG.pillars
GROUPED = dataclasses.replace(CONFIG, pillars=dataclasses.replace(PILLARS, groups=(0, 1, 2, 2, 1, 5, 4, 4, 5, 3)))
GRID = pillar_grid(PILLARS, SENSOR, stride=PILLARS.output_stride)


OPTIONS = {"num_classes": 10, "min_overlap": PILLARS.min_overlap, "min_radius": PILLARS.min_radius}
targets_of = jax.jit(functools.partial(centre_targets, grid=GRID, **OPTIONS))


@functools.cache
def losses_of(config):
    return jax.jit(functools.partial(sample_losses, config=config, pillars=config.pillars, grid=GRID))


def outputs(config, seed=0):
    rng, groups = np.random.default_rng(seed), max(config.pillars.class_groups(10)) + 1
    heat = rng.normal(-2, 1, (GRID.side, GRID.side, 10)).astype(np.float32)
    regression = rng.normal(0, 0.3, (GRID.side, GRID.side, groups, 10)).astype(np.float32)
    return CentreOutputs(*map(jnp.asarray, (heat, regression)))


def ground_truth():
    batch = host_batch()
    return tuple(map(jnp.asarray, (batch.boxes[0], batch.labels[0], batch.box_valid[0])))


@pytest.mark.parametrize("config", [CONFIG, GROUPED], ids=["one group", "six groups"])
def test_sums_equal_a_loop_over_boxes(config):
    boxes, labels, valid = ground_truth()
    boxes = boxes.at[::2, 7:].set(jnp.nan)
    predicted = outputs(config)
    parts, counts = losses_of(config)(predicted, boxes, labels, valid)
    targets = targets_of(boxes, labels, valid)
    away, at = focal_loss(predicted.heat, targets.heat, targets.cell, labels, targets.valid)
    numbers = np.asarray(encode_centres(targets.boxes, targets.cell, GRID))
    groups = config.pillars.class_groups(10)
    heat, l1, count = (np.zeros(max(groups) + 1) for _ in range(3))
    for k in range(10):
        heat[groups[k]] += away[k]
    for m in np.flatnonzero(targets.valid):
        g, row, column = groups[labels[m]], *divmod(int(targets.cell[m]), GRID.side)
        difference = np.abs(predicted.regression[row, column, g] - numbers[m])
        l1[g] += np.nansum(difference * ([1.0] * 8 + [0.2] * 2))
        heat[g] += at[m]
        count[g] += 1
    np.testing.assert_allclose(parts["classification"], heat, rtol=1e-5)
    np.testing.assert_allclose(parts["l1"], l1, rtol=1e-5)
    assert counts["positives"].tolist() == count.tolist()
    assert count.sum() > 3


def test_every_group_is_divided_by_its_own_boxes():
    batch, samples = host_batch(), [outputs(GROUPED, seed) for seed in range(2)]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *samples)
    sums_of = jax.jit(lambda found, batch: make_sums(GROUPED, GROUPED.pillars, GRID)(None, found, None, batch))
    metrics = batch_metrics(sums_of(both, batch), GROUPED.loss)
    sums, boxes = {"classification": np.zeros(6), "l1": np.zeros(6)}, np.zeros(6)
    for i, sample in enumerate(samples):
        truth = (jnp.asarray(leaf[i]) for leaf in (batch.boxes, batch.labels, batch.box_valid))
        own, count = losses_of(GROUPED)(sample, *truth)
        sums, boxes = {name: sums[name] + own[name] for name in sums}, boxes + count["positives"]
    assert np.count_nonzero(boxes) > 2
    expected = {name: float((part / np.maximum(boxes, 1)).sum()) for name, part in sums.items()}
    for name, value in expected.items():
        assert float(metrics[f"loss/{name}"]) == pytest.approx(value, rel=1e-4)
    total = expected["classification"] + 0.25 * expected["l1"]
    assert float(metrics["loss/total"]) == pytest.approx(total, rel=1e-4)


@pytest.mark.slow
def test_a_batch_without_points_or_boxes_has_finite_losses_and_gradients():
    detector = build_detector(CONFIG, SENSOR)
    variables = jax.tree.map(jnp.asarray, untrained(CONFIG, SENSOR))
    batch = host_batch()
    nothing = dataclasses.replace(
        batch,
        valid=np.zeros_like(batch.valid),
        box_valid=np.zeros_like(batch.box_valid),
        boxes=batch.boxes * np.nan,
    )
    empty = dataclasses.replace(batch, points=batch.points * np.nan)
    gradient_of = jax.jit(make_gradient(detector))
    for shown in (nothing, empty):
        found = gradient_of(variables["params"], variables["batch_stats"], shown)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
        metrics = found[2]
        assert metrics["loss/total"] > 0
    assert metrics["positives"] > 0
    assert metrics["dropped_points"] == np.count_nonzero(batch.valid)


def test_an_exact_prediction_costs_nothing_but_confidence_and_overlaps_fully():
    boxes, labels, valid = ground_truth()
    targets = targets_of(boxes, labels, valid)
    numbers = encode_centres(targets.boxes, targets.cell, GRID)
    known = np.asarray(targets.valid)
    cell, first = np.unique(np.asarray(targets.cell)[known], return_index=True)
    chosen = np.flatnonzero(known)[first]
    regression = np.zeros((GRID.side**2, 1, 10), np.float32)
    regression[cell, 0] = np.asarray(numbers)[chosen]
    heat = np.full((GRID.side**2, 10), -20, np.float32)
    heat[cell, labels[chosen]] = 20
    alone, side = jnp.isin(jnp.arange(len(boxes)), chosen), GRID.side
    exact = CentreOutputs(
        jnp.array(heat).reshape(side, side, 10), jnp.array(regression).reshape(side, side, 1, 10)
    )
    parts, counts = losses_of(CONFIG)(exact, boxes, labels, alone)
    assert float(parts["classification"].sum()) < 1e-4
    assert float(parts["l1"].sum()) < 1e-3
    assert float(counts["iou_sum"]) == pytest.approx(len(chosen), rel=1e-3)
    np.testing.assert_allclose(decode_centres(numbers[chosen], jnp.array(cell), GRID), boxes[chosen], atol=1e-3)

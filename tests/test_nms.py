"""Check that both forms of rotated NMS keep the same boxes as a greedy loop with Shapely."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from jax import export

from fcos_lidar_jax import nms
from fcos_lidar_jax.config import InferenceConfig
from fcos_lidar_jax.nms import merge_boxes, rotated_nms, suppress

FORMS = pytest.mark.parametrize("form", ["rows", "matrix"])
OPTIONS = {"iou_threshold": 0.2, "max_outputs": 100}
merge = jax.jit(merge_boxes, static_argnames=("iou_threshold", "overlap", "form"))
compute = jax.jit(rotated_nms, static_argnames=("iou_threshold", "max_outputs", "overlap", "form"))


def clusters(seed: int, number: int = 200):
    rng = np.random.default_rng(seed)
    centres = oracles.random_boxes(rng, number // 10, 12.0)
    boxes = centres[rng.integers(0, len(centres), number)] + rng.normal(0, 0.2, (number, 7))
    boxes[:, 3:6] = np.maximum(np.abs(boxes[:, 3:6]), 0.3)
    scores = np.round(rng.random(number), 2).astype(np.float32)  # ties
    return boxes.astype(np.float32), scores, rng.random(number) < 0.9, rng.integers(0, 3, number).astype(np.int32)


def keep(boxes, scores, valid, labels, **options):
    return indices(*compute(boxes, scores, valid, labels=labels, **options))


def indices(kept, used):
    kept, used = np.asarray(kept), np.asarray(used)
    assert not kept[~used].any()
    return kept[used].tolist()


def keep_few(form, boxes, scores, valid=True, *, overlap="bev"):
    """Of a few boxes of one class, in the first of eight slots, so that all tests share a program."""
    number = len(boxes)
    slots = np.zeros((8, 7), np.float32), np.zeros(8, np.float32), np.zeros(8, bool)
    for slot, given in zip(slots, (boxes, scores, valid), strict=True):
        slot[:number] = given
    options = {"iou_threshold": 0.25, "max_outputs": 8, "overlap": overlap, "form": form}
    return keep(*slots, np.zeros(8, np.int32), **options)


@FORMS
def test_the_same_boxes_are_kept_as_with_shapely(form):
    for seed in range(3):
        boxes, scores, valid, labels = clusters(seed)
        expected = oracles.nms(boxes, scores, valid, labels, 0.2, 7, vertical=True)
        assert len(expected) == 7
        options = {"iou_threshold": 0.2, "max_outputs": 7, "overlap": "3d", "form": form}
        assert keep(boxes, scores, valid, labels, **options) == expected


@FORMS
def test_the_same_boxes_are_kept_as_with_shapely_under_vmap(form):
    data = [clusters(seed) for seed in range(3)]

    def go(boxes, scores, valid, labels):
        return rotated_nms(boxes, scores, valid, labels=labels, **OPTIONS, form=form)

    found = jax.jit(jax.vmap(go))(*map(np.stack, zip(*data, strict=True)))
    for one, kept, used in zip(data, *found, strict=True):
        expected = oracles.nms(*one, 0.2, 100)
        assert indices(kept, used) == expected
        assert len(expected) < 100


def test_invalid_slots_do_not_change_the_result_of_rows(monkeypatch):
    """Includes counts around the size of the blocks that the form ``rows`` computes with."""
    monkeypatch.setattr(nms, "_BLOCK", 16)
    rows = jax.jit(functools.partial(rotated_nms, **OPTIONS, form="rows"))
    boxes, scores, _, labels = clusters(5, 40)
    for number in (0, 16, 17, 40):
        valid = np.random.default_rng(0).permutation(40) < number
        expected = oracles.nms(boxes, scores, valid, labels, 0.2, 100)
        assert indices(*rows(boxes, scores, valid, labels=labels)) == expected


BOX = [0, 0, 0, 4, 2, 1, 0.0]


@FORMS
def test_the_lower_index_wins_ties_and_nan_scores_are_invalid(form):
    assert keep_few(form, [BOX] * 4, [np.nan, 0.5, 0.5, 0.4]) == [1]


@FORMS
@pytest.mark.parametrize(("overlap", "columns"), [("bev", (0, 1, 3, 4, 6)), ("3d", range(7))])
def test_a_box_with_nan_overlaps_no_box(form, overlap, columns):
    for column in columns:
        boxes = np.array([BOX] * 4, np.float32)
        boxes[[1, 3], column] = np.nan
        assert keep_few(form, boxes, [0.9, 0.8, 0.7, 0.6], overlap=overlap) == [0, 1, 3]


@FORMS
def test_equal_iou_is_not_above_the_threshold(form):
    for x, kept in ((2.35, [0]), (2.45, [0, 1])):  # IoU 0.26 and 0.24
        assert keep_few(form, [BOX, [x, *BOX[1:]]], [0.9, 0.8]) == kept
    assert keep_few(form, [BOX, [0, 0, 0, 1, 2, 1, 0]], [0.9, 0.8]) == [0, 1]  # exactly 0.25


@FORMS
def test_distant_boxes_do_not_overlap_by_rounding(form):
    rng = np.random.default_rng(0)
    boxes = np.zeros((64, 7), np.float32)
    boxes[:, :2] = 12.0 * np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1).reshape(-1, 2)
    boxes[:, 3:] = rng.uniform((3, 1, 1, -3), (6, 3, 3, 3), (64, 4))
    given = boxes, np.ones(64, np.float32), np.ones(64, bool), np.zeros(64, np.int32)
    assert len(keep(*given, iou_threshold=0.0, max_outputs=64, form=form)) == 64


@FORMS
def test_without_valid_boxes_and_with_boxes_of_zero_size(form):
    assert keep_few(form, np.zeros((5, 7)), np.linspace(1, 0, 5), False) == []
    assert keep_few(form, np.zeros((5, 7)), np.linspace(1, 0, 5)) == [0, 1, 2, 3, 4]


def test_exported_programs_use_the_form_of_their_platform():
    suppress = jax.jit(lambda *args: rotated_nms(*args, **OPTIONS))
    for platform, is_matrix in (("cpu", False), ("cuda", True), ("tpu", True)):
        text = export.export(suppress, platforms=(platform,))(*clusters(0, 70)[:3]).mlir_module()
        assert ("tensor<70x70xi1>" in text) == is_matrix


def merged_by_loops(boxes, scores, valid, labels, kept, threshold, *, vertical):
    result = []
    for i in kept:
        mean, total = np.zeros(boxes.shape[1]), 0.0
        for j in np.flatnonzero(valid & (labels == labels[i])):
            turn = (float(boxes[j, 6]) - float(boxes[i, 6]) + np.pi) % (2 * np.pi) - np.pi
            overlap = oracles.iou(boxes[i : i + 1, :7], boxes[j : j + 1, :7], vertical=vertical)[0]
            if overlap > threshold and abs(turn) <= np.pi / 3:
                offset = boxes[j].astype(np.float64) - boxes[i]
                offset[6] = turn
                mean, total = mean + float(scores[j]) ** 2 * offset, total + float(scores[j]) ** 2
        result.append(boxes[i] + mean / total)
    return np.array(result)


@pytest.mark.parametrize(("form", "overlap"), [("rows", "3d"), ("matrix", "bev")])
def test_merged_boxes_are_weighted_means_of_overlapping_boxes(form, overlap):
    """Some boxes point backwards, and some yaws lie on either side of pi."""
    options = {"iou_threshold": 0.3, "overlap": overlap, "form": form}
    for seed in range(3):
        boxes, scores, valid, labels = clusters(seed, 100)
        rng = np.random.default_rng(seed)
        boxes[:, 6] += np.where(rng.random(len(boxes)) < 0.3, np.pi, 0)
        boxes = np.concatenate([boxes, rng.normal(0, 5, (len(boxes), 2)).astype(np.float32)], axis=1)
        scores = np.maximum(scores, np.float32(0.01))
        kept, used = compute(boxes[:, :7], scores, valid, labels=labels, **OPTIONS, overlap="bev", form="rows")
        boxes[~valid] = np.nan
        actual = np.asarray(merge(boxes, scores, valid, kept, used, labels=labels, **options))
        assert not actual[~np.asarray(used)].any()
        best = indices(kept, used)
        expected = merged_by_loops(boxes, scores, valid, labels, best, 0.3, vertical=overlap == "3d")
        difference = actual[np.asarray(used)] - expected
        difference[:, 6] = (difference[:, 6] + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(difference, 0, atol=5e-6)
        assert np.abs(expected - boxes[best]).max() > 0.05


@pytest.mark.parametrize("overlap", ["bev", "3d"])
@pytest.mark.parametrize("merge_iou", [None, 0.3])
def test_suppression_follows_the_configuration(overlap, merge_iou):
    boxes, scores, valid, labels = clusters(0, 100)
    boxes = np.concatenate([boxes, np.ones((100, 2), np.float32)], axis=1)
    scores = np.maximum(scores, np.float32(0.01))
    config = InferenceConfig(iou_threshold=0.2, nms_overlap=overlap, merge_iou=merge_iou, max_detections=40)
    results = jax.jit(suppress, static_argnums=4)(boxes, scores, labels, valid, config)
    found, _, found_labels, used = map(np.asarray, results)
    kept = oracles.nms(boxes[:, :7], scores, valid, labels, 0.2, 40, vertical=overlap == "3d")
    assert found_labels[used].tolist() == labels[kept].tolist()
    expected = boxes[kept]
    if merge_iou is not None:
        expected = merged_by_loops(boxes, scores, valid, labels, kept, merge_iou, vertical=overlap == "3d")
    difference = found[used] - expected
    difference[:, 6] = (difference[:, 6] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(difference, 0, atol=5e-6)


@pytest.mark.parametrize("slots", [10, 40])
def test_merging_does_not_depend_on_unused_slots(slots, monkeypatch):
    """Uses fewer and more valid boxes than the first block of the form ``rows``."""
    monkeypatch.setattr(nms, "_BLOCK", 16)
    merge = jax.jit(functools.partial(merge_boxes, iou_threshold=0.3))
    boxes, scores, _, labels = clusters(5, slots)
    scores, every = np.maximum(scores, np.float32(0.01)), np.ones(slots, bool)
    used = np.arange(9) < slots // 5
    kept = np.where(used, np.arange(9), 0).astype(np.int32)
    expected = merge(boxes, scores, every, kept, used, labels=labels)
    place = np.sort(np.random.default_rng(0).permutation(100)[:slots]).astype(np.int32)
    spread = [np.zeros((100, *part.shape[1:]), part.dtype) for part in (boxes, scores, labels)]
    for target, part in zip(spread, (boxes, scores, labels), strict=True):
        target[place] = part
    valid, there = np.isin(np.arange(100), place), np.where(used, place[kept], 0)
    actual = merge(*spread[:2], valid, there, used, labels=spread[2])
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-5)
    assert np.abs(np.asarray(expected) - boxes[kept])[used].max() > 0.05


@FORMS
def test_boxes_with_zero_size_or_score_are_unchanged_and_gradients_are_finite(form):
    boxes = np.zeros((4, 9), np.float32)
    boxes[:, 0] = [0, 5, 5, 9]
    boxes[1:3, 3:6] = 1
    scores, valid = np.array([0.9, 0.0, 0.0, np.nan], np.float32), np.array([True, True, True, False])
    kept, used = jnp.array([0, 1, 0, 0]), jnp.array([True, True, False, False])
    options = {"iou_threshold": 0.3, "form": form}
    actual = np.asarray(merge(boxes, scores, valid, kept, used, **options))
    np.testing.assert_array_equal(actual[:2], boxes[:2])
    assert not actual[2:].any()

    def loss(boxes, scores):
        return jax.vmap(lambda b, s: merge_boxes(b, s, valid, kept, used, **options))(boxes, scores).sum()

    given = np.stack([boxes] * 2), np.stack([np.nan_to_num(scores)] * 2)
    slope = jax.jit(lambda *given: jax.jvp(loss, given, jax.tree.map(jnp.ones_like, given))[1])
    assert bool(jnp.isfinite(slope(*given)))


def test_nothing_is_found_in_no_boxes():
    none, scores = np.zeros((0, 7), np.float32), np.zeros(0, np.float32)
    kept, used = rotated_nms(none, scores, scores > 0, iou_threshold=0.2, max_outputs=3)
    merged = merge_boxes(none, scores, scores > 0, kept, used, iou_threshold=0.2)
    assert kept.tolist() == [0, 0, 0]
    assert not used.any()
    assert merged.tolist() == np.zeros((3, 7)).tolist()

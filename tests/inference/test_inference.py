"""Candidates and detection, compared with loops."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from tiny_run import CONFIG, SENSOR, bits

from fcos_lidar_jax.coding import decode
from fcos_lidar_jax.config import AugmentConfig, InferenceConfig
from fcos_lidar_jax.inference import detector as detectors
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.inference.detect import suppress
from fcos_lidar_jax.locations import image_layout, locate
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.models.candidates import select_candidates
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.types import Outputs

LAYOUT = image_layout(SENSOR, CONFIG.model)


@pytest.fixture(scope="module")
def scene():
    """Random predictions over a real range image."""
    rng = np.random.default_rng(0)
    frame = make_frame(0, SENSOR)
    image = project_points(frame.points, np.ones(len(frame.points), bool), SENSOR, num_rounds=1)
    number = LAYOUT.num_locations
    logits = rng.normal(0, 2, (number, 4)).astype(np.float32)
    logits[:, 3] += 3
    regression = rng.normal(0, 0.5, (number, 10, 3)).astype(np.float32)
    iou_logits = rng.normal(0, 1, (number, 3)).astype(np.float32)
    return Outputs(*map(jnp.asarray, (logits, regression, iou_logits))), locate(image, LAYOUT)


def candidates_by_loops(outputs, locations, config):
    logits = np.asarray(outputs.logits, np.float64)
    p = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    quality = (1 + np.exp(-np.asarray(outputs.iou_logits, np.float64))) ** -config.iou_exponent
    found, first = [], 0
    for size in LAYOUT.level_sizes:
        level = []
        for l in range(first, first + size):
            if not bool(locations.occupied[l]):
                continue
            for k in range(3):
                if p[l, k] > config.min_probability:
                    level.append((-p[l, k] * quality[l, k], l, k))
        found += sorted(level)[: config.candidates_per_level]
        first += size
    return found


@pytest.mark.parametrize(("iou_exponent", "axes"), [(1.0, "lidar"), (0.5, "ray")])
def test_candidates_are_the_best_pairs_of_each_level(scene, iou_exponent, axes):
    outputs, locations = scene
    config = InferenceConfig(min_probability=0.2, candidates_per_level=90, iou_exponent=iou_exponent)
    select = jax.jit(functools.partial(select_candidates, config=config, layout=LAYOUT, axes=axes))
    boxes, scores, labels, valid = map(np.asarray, select(outputs, locations))
    expected = candidates_by_loops(outputs, jax.device_get(locations), config)
    assert 90 < valid.sum() == len(expected) < 6 * 90
    np.testing.assert_allclose(np.sort(scores[valid]), np.sort([-s for s, _, _ in expected]), atol=1e-6)
    order = {(round(float(s), 5), int(k)) for s, k in zip(scores[valid], labels[valid], strict=True)}
    assert len(order ^ {(round(-s, 5), k) for s, _, k in expected}) <= 0.02 * len(expected)  # last-digit rounding
    best = int(np.argmax(np.where(valid, scores, -1)))
    _, l, k = min(expected)
    one = decode(outputs.regression[l, :, k], locations.points[l], locations.azimuth_rad[l], axes=axes)
    np.testing.assert_allclose(boxes[best], one, atol=1e-5)
    assert not scores[~valid].any()


@pytest.mark.parametrize("across", [False, True])
def test_postprocessing_is_greedy_nms_within_or_across_classes(scene, across):
    outputs, locations = scene
    config = InferenceConfig(
        min_probability=0.2, candidates_per_level=30, max_detections=40, nms_across_classes=across
    )

    @jax.jit
    def find(outputs, locations):
        candidates = select_candidates(outputs, locations, config=config, layout=LAYOUT, axes="lidar")
        return candidates, suppress(*candidates, config)

    candidates, found = jax.device_get(find(outputs, locations))
    boxes, scores, labels, valid = candidates
    expected = oracles.nms(boxes, scores, valid, np.zeros_like(labels) if across else labels, 0.2, 40)
    *best, used = found
    assert used.sum() == len(expected)
    for array, candidate in zip(best, (boxes, scores, labels), strict=True):
        np.testing.assert_array_equal(array[used], candidate[expected])
        assert not array[~used].any()


def test_a_detector_warns_about_clouds_without_usable_points(detector):
    with pytest.warns(UserWarning, match="points: none of its 9 points is usable"):
        assert not len(detector(np.full((9, 4), np.nan)))
    with pytest.warns(UserWarning, match="points: no points in it, expected at least one"):
        assert not len(detector(np.zeros((0, 4))))


def test_detection_ignores_padding_and_works_under_vmap(detector):
    detect, variables = make_detect(detector.model), detector.variables
    scans = [make_frame(seed, SENSOR).points for seed in range(2)]
    points = np.stack([np.pad(s, ((0, 1024 - len(s)), (0, 0)), constant_values=np.nan) for s in scans])
    valid = np.stack([np.arange(1024) < len(scan) for scan in scans])
    one_by_one, together = jax.jit(detect), jax.jit(jax.vmap(detect, in_axes=(None, 0, 0)))
    both = together(variables, points, valid)
    for i in range(2):
        one = one_by_one(variables, points[i], valid[i])
        assert bool(one.valid.any())
        assert bool(jnp.isfinite(one.boxes).all())
        np.testing.assert_allclose(both.scores[i], one.scores, atol=1e-4)
        assert int(both.num_dropped[i]) == int(one.num_dropped)
    empty = one_by_one(variables, points[0], np.zeros(1024, bool))
    assert not empty.valid.any()
    assert not empty.boxes.any()


def arrays(found):
    return bits((found.boxes, found.scores, found.labels))


@pytest.mark.parametrize("axes", ["lidar", "ray"])
def test_centres_are_offset_along_the_axes_of_the_configuration(axes):
    """The network predicts the same everywhere: one class, and the centre one metre along the first axis."""
    model = dataclasses.replace(CONFIG.model, regression_axes=axes)
    inference = InferenceConfig(iou_threshold=1.0, max_detections=200)
    config = dataclasses.replace(CONFIG, model=model, inference=inference)
    number, kinds = LAYOUT.num_locations, len(config.classes)

    def apply(_variables, _images):
        logits = jnp.where(jnp.arange(kinds + 1) == 2, 5.0, -5.0)
        one = jnp.zeros((1, number, 10, kinds)).at[..., 0, :].set(1.0)
        return Outputs(jnp.tile(logits, (1, number, 1)), one, jnp.zeros((1, number, kinds))), {}

    points = make_frame(0, SENSOR).points
    detect = jax.jit(make_detect(build_detector(config, SENSOR)._replace(apply=apply)))
    found = detect({}, points, np.ones(len(points), bool))
    boxes = np.asarray(found.boxes, np.float64)
    assert found.valid.all()
    distance = np.hypot(*boxes[:, :2].T)[:, None]
    expected = boxes[:, :2] - (boxes[:, :2] / distance if axes == "ray" else np.array([1.0, 0.0]))
    off = np.abs(points[None, :, :2] - expected[:, None]).max(axis=2).min(axis=1)
    np.testing.assert_allclose(off, 0, atol=1e-4)


def test_other_post_processing_keeps_weights_and_other_fields(detector):
    fewer = detector.with_inference(max_detections=3)
    assert fewer.config == dataclasses.replace(
        CONFIG, inference=dataclasses.replace(CONFIG.inference, max_detections=3)
    )
    assert (fewer.sensor, fewer.fingerprint) == (detector.sensor, detector.fingerprint)
    points = make_frame(0, SENSOR).points
    np.testing.assert_array_equal(fewer(points).scores, detector(points).scores[:3])
    with pytest.raises(ValueError, match=r"^max_detections: got 0"):
        detector.with_inference(max_detections=0)


def test_weights_are_transferred_once(detector, monkeypatch):
    detector, placed = dataclasses.replace(detector), []
    replicate = detectors.replicate
    monkeypatch.setattr(detectors, "replicate", lambda *given: placed.append(1) or replicate(*given))
    first, second = (detector(make_frame(0, SENSOR).points) for _ in range(2))
    assert placed == [1]
    assert arrays(first) == arrays(second)


@pytest.mark.parametrize("axis", [0, 1])
def test_detections_with_flips_are_equivariant_to_mirrored_clouds(detector, axis):
    sensor = dataclasses.replace(SENSOR, origin_m=(0.5, -0.25, 0.0))
    inference = dataclasses.replace(CONFIG.inference, flips="xy", merge_iou=0.3)
    config, variables = (
        dataclasses.replace(CONFIG, inference=inference, augment=AugmentConfig()),
        detector.variables,
    )
    detect = jax.jit(make_detect(build_detector(config, sensor)))
    points = make_frame(0, SENSOR).points
    mirrored, middle = points.copy(), sensor.origin_m[axis]
    mirrored[:, axis] = 2 * middle - points[:, axis]
    valid = np.ones(len(points), bool)
    found, back = detect(variables, points, valid), detect(variables, mirrored, valid)
    assert found.valid.sum() > 10
    np.testing.assert_allclose(back.scores, found.scores, atol=1e-5)
    expected = np.asarray(found.boxes)[np.asarray(found.valid)]
    expected[:, axis] = 2 * middle - expected[:, axis]
    expected[:, 6] = (np.pi if axis == 0 else 0) - expected[:, 6]
    expected[:, 7 + axis] *= -1
    difference = np.asarray(back.boxes)[np.asarray(found.valid)] - expected
    difference[:, 6] = (difference[:, 6] + np.pi) % (2 * np.pi) - np.pi
    # Boxes with nearly equal scores may change places.
    assert (np.abs(difference).max(axis=1) < 1e-3).mean() > 0.9

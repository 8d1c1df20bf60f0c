"""Points to boxes as one pure function (paper, section 3.4)."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from fcos_lidar_jax.augment import flip_x, flip_y
from fcos_lidar_jax.coding import decode
from fcos_lidar_jax.config import InferenceConfig
from fcos_lidar_jax.locations import ImageLayout, image_layout, image_sensor, locate
from fcos_lidar_jax.models import Detector
from fcos_lidar_jax.nms import merge_boxes, rotated_nms
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import Detections, Locations, Outputs

Detect = Callable[[Any, Array, Array], Detections]
_MIRRORS = {"none": ("",), "x": ("", "x"), "y": ("", "y"), "xy": ("", "x", "y", "xy")}


def select_candidates(
    outputs: Outputs, locations: Locations, *, config: InferenceConfig, layout: ImageLayout
) -> tuple[Array, Array, Array, Array]:
    """The best (location, class) pairs of every level, decoded.

    A pair needs a class probability above the threshold, before the IoU factor, and a point in its cell.
    Boxes are decoded only for the pairs that are kept.

    Args:
        outputs, locations: of one sample.
        config, layout: thresholds, counts and sizes (static).

    Returns:
        boxes f32[c, 9], scores f32[c], labels i32[c], valid bool[c].

    >>> layout = ImageLayout(rows=32, columns=32, row_upscale=1)
    >>> l = layout.num_locations
    >>> first = jnp.arange(l) == 0  # alone has a point
    >>> seen = Locations(jnp.zeros((l, 3)), jnp.zeros(l), jnp.zeros(l, int), first)
    >>> outputs = Outputs(jnp.zeros((l, 2)), jnp.zeros((l, 10, 1)), jnp.zeros((l, 1)))
    >>> boxes, scores, labels, valid = select_candidates(outputs, seen, config=InferenceConfig(), layout=layout)
    >>> scores[valid].tolist()  # probability 0.5, IoU 0.5
    [0.25]
    """
    num_classes = outputs.iou_logits.shape[-1]
    probability = jax.nn.softmax(outputs.logits)[:, :num_classes]
    eligible = (probability > config.min_probability) & locations.occupied[:, None]
    scores = jnp.where(eligible, probability * jax.nn.sigmoid(outputs.iou_logits), -1.0)
    kept, first = [], 0
    for size in layout.level_sizes:
        level = scores[first : first + size].reshape(-1)
        best, index = lax.top_k(level, min(config.candidates_per_level, level.shape[0]))
        kept.append((best, index + first * num_classes))
        first += size
    score, pair = (jnp.concatenate(values) for values in zip(*kept, strict=True))
    location, label = pair // num_classes, (pair % num_classes).astype(jnp.int32)
    regression = outputs.regression[location, :, label]
    boxes = decode(regression, locations.points[location], locations.azimuth_rad[location])
    valid = score >= 0
    return boxes, jnp.where(valid, score, 0.0), label, valid


def postprocess(
    outputs: Outputs, locations: Locations, *, config: InferenceConfig, layout: ImageLayout
) -> tuple[Array, Array, Array, Array]:
    """Candidates, class-wise rotated NMS, the best boxes; arguments as in :func:`select_candidates`.

    Returns:
        boxes f32[d, 9], scores f32[d], labels i32[d], valid bool[d]; zero where invalid.

    >>> layout = ImageLayout(rows=32, columns=32, row_upscale=1)
    >>> l = layout.num_locations
    >>> seen = Locations(jnp.zeros((l, 3)), jnp.zeros(l), jnp.zeros(l, int), jnp.arange(l) < 3)
    >>> outputs = Outputs(jnp.zeros((l, 2)), jnp.zeros((l, 10, 1)), jnp.zeros((l, 1)))
    >>> few = InferenceConfig(max_detections=5, candidates_per_level=10)
    >>> boxes, scores, labels, valid = postprocess(outputs, seen, config=few, layout=layout)
    >>> valid.tolist()  # of three times the same box
    [True, False, False, False, False]
    """
    return _suppress(select_candidates(outputs, locations, config=config, layout=layout), config)


def _suppress(
    candidates: tuple[Array, Array, Array, Array], config: InferenceConfig
) -> tuple[Array, Array, Array, Array]:
    """The best boxes of the candidates; in and out as of :func:`postprocess`."""
    boxes, scores, labels, valid = candidates
    options: dict[str, Any] = {"labels": labels, "overlap": config.nms_overlap}
    with jax.named_scope("nms"):
        index, used = rotated_nms(
            boxes,
            scores,
            valid,
            **options,
            iou_threshold=config.iou_threshold,
            max_outputs=config.max_detections,
        )
    if config.merge_iou is None:
        best_boxes = jnp.where(used[:, None], boxes[index], 0.0)
    else:
        best_boxes = merge_boxes(boxes, scores, valid, index, used, **options, iou_threshold=config.merge_iou)
    return best_boxes, jnp.where(used, scores[index], 0.0), jnp.where(used, labels[index], 0), used


def make_detect(detector: Detector) -> Detect:
    """The whole path from points to boxes: projection, network, decoding, NMS.

    Returns:
        pure ``(variables, points f32[n, c], valid bool[n]) -> Detections`` of one cloud, to be jitted by the
        caller: one compilation for a point count. Close points are the caller's to drop, see
        :func:`fcos_lidar_jax.projection.remove_close`.

    >>> from fcos_lidar_jax.models import build_detector
    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> from fcos_lidar_jax.sensors import SHORT_RANGE
    >>> detector = build_detector(QUICKSTART, SHORT_RANGE)
    >>> variables = jax.eval_shape(detector.init, jax.random.key(0))
    >>> points, valid = jax.ShapeDtypeStruct((4096, 5), jnp.float32), jax.ShapeDtypeStruct((4096,), bool)
    >>> jax.eval_shape(make_detect(detector), variables, points, valid).boxes.shape
    (500, 9)
    """
    config, sensor = detector.config, detector.sensor
    binned, layout = image_sensor(sensor, config.model), image_layout(sensor, config.model)

    rounds, current_first = config.projection.num_rounds, config.projection.prioritize_current
    views = _MIRRORS[config.inference.flips]
    no_points, no_boxes = jnp.zeros((0, 5)), jnp.zeros((0, 9))

    def detect(variables: Any, points: Array | np.ndarray, valid: Array | np.ndarray) -> Detections:
        with jax.named_scope("mrv"):
            images = [
                project_points(cloud, valid, binned, num_rounds=rounds, prioritize_current=current_first)
                for cloud in (_mirror(view, sensor, jnp.asarray(points), no_boxes)[0] for view in views)
            ]
        outputs, _ = detector.apply(variables, jnp.stack([image.features for image in images]), train=False)
        found = []
        for i, (view, image) in enumerate(zip(views, images, strict=True)):
            seen = jax.tree.map(lambda leaf, i=i: leaf[i], outputs)
            boxes, *rest = select_candidates(seen, locate(image, layout), config=config.inference, layout=layout)
            found.append((_mirror(view, sensor, no_points, boxes)[1], *rest))
        candidates = tuple(jnp.concatenate(parts) for parts in zip(*found, strict=True))
        return Detections(*_suppress(candidates, config.inference), images[0].num_dropped)  # type: ignore[arg-type]

    return detect


def _mirror(view: str, sensor: Sensor, points: Array, boxes: Array) -> tuple[Array, Array]:
    """Points and boxes in a view that is mirrored at the sensor, or back from there."""
    origin = jnp.asarray(sensor.origin_m[:2], jnp.float32)
    for axis in view:
        points, boxes = points.at[:, :2].add(-origin), boxes.at[:, :2].add(-origin)
        points, boxes = (flip_x if axis == "x" else flip_y)(points, boxes)
        points, boxes = points.at[:, :2].add(origin), boxes.at[:, :2].add(origin)
    return points, boxes

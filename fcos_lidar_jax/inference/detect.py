"""Points to boxes as one pure function (paper, section 3.4)."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from fcos_lidar_jax.augment import flip_x, flip_y
from fcos_lidar_jax.centres import decode_centres
from fcos_lidar_jax.coding import Axes, decode
from fcos_lidar_jax.config import Config, InferenceConfig
from fcos_lidar_jax.locations import ImageLayout, image_layout, image_sensor, locate
from fcos_lidar_jax.models import Detector
from fcos_lidar_jax.nms import merge_boxes, rotated_nms
from fcos_lidar_jax.pillars import Grid, make_pillars, pillar_grid
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import CentreOutputs, Detections, Locations, Outputs

_BEYOND_M = 10.0  # How far beyond CenterPoint's map, and above or below the sensor, a box may lie.

Detect = Callable[[Any, Array, Array], Detections]
_MIRRORS = {"none": ("",), "x": ("", "x"), "y": ("", "y"), "xy": ("", "x", "y", "xy")}


def select_candidates(
    outputs: Outputs,
    locations: Locations,
    *,
    config: InferenceConfig,
    layout: ImageLayout,
    axes: Axes,
) -> tuple[Array, Array, Array, Array]:
    """The best (location, class) pairs of every level, decoded.

    A pair needs a class probability above the threshold, before the IoU factor, and a point in its cell.
    Boxes are decoded only for the pairs that are kept.

    Args:
        outputs, locations: of one sample.
        config, layout: thresholds, counts and sizes (static).
        axes: of the regression, see :mod:`fcos_lidar_jax.coding` (static).

    Returns:
        boxes f32[c, 9], scores f32[c], labels i32[c], valid bool[c].

    >>> layout = ImageLayout(rows=32, columns=32, row_upscale=1)
    >>> l = layout.num_locations
    >>> first = jnp.arange(l) == 0  # alone has a point
    >>> seen = Locations(jnp.zeros((l, 3)), jnp.zeros(l), jnp.zeros(l, int), first)
    >>> outputs = Outputs(jnp.zeros((l, 2)), jnp.zeros((l, 10, 1)), jnp.zeros((l, 1)))
    >>> choices = {"config": InferenceConfig(), "layout": layout, "axes": "lidar"}
    >>> boxes, scores, labels, valid = select_candidates(outputs, seen, **choices)
    >>> scores[valid].tolist()  # probability 0.5, IoU 0.5
    [0.25]
    """
    num_classes = outputs.iou_logits.shape[-1]
    probability = jax.nn.softmax(outputs.logits)[:, :num_classes]
    eligible = (probability > config.min_probability) & locations.occupied[:, None]
    quality = jax.nn.sigmoid(outputs.iou_logits) ** config.iou_exponent
    scores = jnp.where(eligible, probability * quality, -1.0)
    kept, first = [], 0
    for size in layout.level_sizes:
        best, index = _best_pairs(scores[first : first + size], config.candidates_per_level)
        kept.append((best, index + first * num_classes))
        first += size
    score, pair = (jnp.concatenate(values) for values in zip(*kept, strict=True))
    location, label = pair // num_classes, (pair % num_classes).astype(jnp.int32)
    regression = outputs.regression[location, :, label]
    boxes = decode(regression, locations.points[location], locations.azimuth_rad[location], axes=axes)
    valid = score >= 0
    return boxes, jnp.where(valid, score, 0.0), label, valid


def _best_pairs(scores: Array, number: int) -> tuple[Array, Array]:
    """``lax.top_k`` of the flattened scores f32[l, k], equal ones by index.

    The best pairs are pairs of the locations with the best classes, so only these are sorted.
    """
    num_locations, num_classes = scores.shape
    _, best = lax.top_k(scores.max(axis=1), min(number, num_locations))
    best = jnp.sort(best)  # Equal scores stay in the order of their index.
    score, index = lax.top_k(scores[best].reshape(-1), min(number, len(best) * num_classes))
    return score, best[index // num_classes] * num_classes + index % num_classes


def postprocess(
    outputs: Outputs,
    locations: Locations,
    *,
    config: InferenceConfig,
    layout: ImageLayout,
    axes: Axes,
) -> tuple[Array, Array, Array, Array]:
    """Candidates, class-wise rotated NMS, the best boxes; arguments as in :func:`select_candidates`.

    Returns:
        boxes f32[d, 9], scores f32[d], labels i32[d], valid bool[d]; zero where invalid.

    >>> layout = ImageLayout(rows=32, columns=32, row_upscale=1)
    >>> l = layout.num_locations
    >>> seen = Locations(jnp.zeros((l, 3)), jnp.zeros(l), jnp.zeros(l, int), jnp.arange(l) < 3)
    >>> outputs = Outputs(jnp.zeros((l, 2)), jnp.zeros((l, 10, 1)), jnp.zeros((l, 1)))
    >>> few = InferenceConfig(max_detections=5, candidates_per_level=10)
    >>> boxes, scores, labels, valid = postprocess(outputs, seen, config=few, layout=layout, axes="lidar")
    >>> valid.tolist()  # of three times the same box
    [True, False, False, False, False]
    """
    candidates = select_candidates(outputs, locations, config=config, layout=layout, axes=axes)
    return suppress(*candidates, config)


def centre_candidates(outputs: CentreOutputs, *, config: Config, grid: Grid) -> tuple[Array, Array, Array, Array]:
    """The best (cell, class) pairs of CenterPoint's heat map, decoded; boxes far beyond the map are none.

    Args:
        outputs: of one sample.
        config, grid: thresholds and counts, and the cells of the heat map (static).

    Returns:
        as :func:`select_candidates`.
    """
    assert config.pillars is not None
    probability = jax.nn.sigmoid(outputs.heat)
    scores = jnp.where(probability > config.inference.min_probability, probability, -1.0).reshape(-1)
    score, pair = lax.top_k(scores, min(config.inference.candidates_per_level, scores.shape[0]))
    cell, label = pair // len(config.classes), (pair % len(config.classes)).astype(jnp.int32)
    group = jnp.array(config.class_groups)[label]
    regression = outputs.regression.reshape(-1, *outputs.regression.shape[-2:])[cell, group]
    boxes = decode_centres(regression, cell, grid)
    reach, centre = config.pillars.range_m + _BEYOND_M, np.asarray(grid.low_m) + config.pillars.range_m
    near = (jnp.abs(boxes[:, :2] - centre.astype(np.float32)) <= reach).all(axis=1) & (
        jnp.abs(boxes[:, 2]) <= _BEYOND_M
    )
    valid = (score >= 0) & near
    return boxes, jnp.where(valid, score, 0.0), label, valid


def suppress(
    boxes: Array, scores: Array, labels: Array, valid: Array, config: InferenceConfig
) -> tuple[Array, Array, Array, Array]:
    """Class-wise rotated NMS of candidates; returns what :func:`postprocess` does."""
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


class DetectStages(NamedTuple):
    """The stages of detection in one cloud, pure functions.

    Attributes:
        prepare: ``(points f32[n, c], valid bool[n]) -> image``, a RangeImage, or Pillars for CenterPoint.
        network: ``(variables, image) -> outputs``.
        candidates: ``(outputs, image) -> boxes, scores, labels, valid`` as of :func:`select_candidates`.
        postprocess: the same as of :func:`postprocess`.
    """

    prepare: Callable[..., Any]
    network: Callable[..., Any]
    candidates: Callable[..., tuple[Array, Array, Array, Array]]
    postprocess: Callable[..., tuple[Array, Array, Array, Array]]


def make_stages(detector: Detector) -> DetectStages:
    """The stages that :func:`make_detect` joins, to be jitted by the caller."""
    config, sensor = detector.config, detector.sensor
    if config.pillars is not None:
        cells = pillar_grid(config.pillars, sensor, stride=config.pillars.output_stride)
        prepare: Callable[..., Any] = functools.partial(
            make_pillars, grid=pillar_grid(config.pillars, sensor), sensor=sensor
        )

        def candidates(outputs: Any, image: Any) -> tuple[Array, Array, Array, Array]:
            return centre_candidates(outputs, config=config, grid=cells)
    else:
        layout, options = image_layout(sensor, config.model), dataclasses.asdict(config.projection)
        choices: dict[str, Any] = {"config": config.inference, "axes": config.model.regression_axes}
        prepare = functools.partial(
            project_points,
            sensor=image_sensor(sensor, config.model),
            **{name: options[name] for name in ("num_rounds", "prioritize_current")},
        )

        def candidates(outputs: Any, image: Any) -> tuple[Array, Array, Array, Array]:
            return select_candidates(outputs, locate(image, layout), layout=layout, **choices)

    def network(variables: Any, image: Any) -> Any:
        return _of_one(detector, variables, image if config.pillars is not None else image.features)

    def postprocess(outputs: Any, image: Any) -> tuple[Array, Array, Array, Array]:
        return suppress(*candidates(outputs, image), config.inference)

    return DetectStages(prepare, network, candidates, postprocess)


def _of_one(detector: Detector, variables: Any, image: Any) -> Any:
    """The network's outputs for one sample."""
    outputs, _ = detector.apply(variables, jax.tree.map(lambda leaf: leaf[None], image), train=False)
    return jax.tree.map(lambda leaf: leaf[0], outputs)


def make_detect(detector: Detector) -> Detect:
    """The whole path from points to boxes: projection or pillars, network, decoding, NMS.

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
    config, sensor, stages = detector.config, detector.sensor, make_stages(detector)
    views = _MIRRORS[config.inference.flips]
    no_points, no_boxes = jnp.zeros((0, 5)), jnp.zeros((0, 9))

    def detect(variables: Any, points: Array | np.ndarray, valid: Array | np.ndarray) -> Detections:
        with jax.named_scope("mrv"):
            clouds = [_mirror(view, sensor, jnp.asarray(points), no_boxes)[0] for view in views]
            images = [stages.prepare(cloud, valid) for cloud in clouds]
        found = []
        for view, image in zip(views, images, strict=True):
            boxes, *rest = stages.candidates(stages.network(variables, image), image)
            found.append((_mirror(view, sensor, no_points, boxes)[1], *rest))
        boxes, scores, labels, valid = (jnp.concatenate(parts) for parts in zip(*found, strict=True))
        best = suppress(boxes, scores, labels, valid, config.inference)
        return Detections(*best, images[0].num_dropped)

    return detect


def _mirror(view: str, sensor: Sensor, points: Array, boxes: Array) -> tuple[Array, Array]:
    """Points and boxes in a view that is mirrored at the sensor, or back from there."""
    origin = jnp.asarray(sensor.origin_m[:2], jnp.float32)
    for axis in view:
        points, boxes = points.at[:, :2].add(-origin), boxes.at[:, :2].add(-origin)
        points, boxes = (flip_x if axis == "x" else flip_y)(points, boxes)
        points, boxes = points.at[:, :2].add(origin), boxes.at[:, :2].add(origin)
    return points, boxes

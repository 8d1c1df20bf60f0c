"""Points to boxes as one pure function (paper, section 3.4)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from fcos_lidar_jax.augment import flip_x, flip_y
from fcos_lidar_jax.models import Detector
from fcos_lidar_jax.nms import suppress
from fcos_lidar_jax.refinement import Boxes, proposal_inference
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import Detections

Detect = Callable[[Any, Array, Array], Detections]
_MIRRORS = {"none": ("",), "x": ("", "x"), "y": ("", "y"), "xy": ("", "x", "y", "xy")}


class Stages(NamedTuple):
    """Stages of detection in one cloud, as pure functions."""

    prepare: Callable[..., Any]  # ``(points f32[n, c], valid bool[n]) -> input``
    network: Callable[..., Any]  # ``(variables, input) -> outputs``
    candidates: Callable[..., tuple[Array, ...]]  # ``(outputs, input) -> boxes, scores, labels, valid``
    postprocess: Callable[..., Boxes]  # Candidates after NMS, see ``nms.suppress``.
    refine: Callable[..., Boxes]
    """``(variables, points, valid, *boxes after NMS) -> boxes``; the same boxes without a second look."""


def make_stages(detector: Detector) -> Stages:
    """Make the stages of :func:`make_detect`, to be jitted, timed or replaced separately.

    >>> from fcos_lidar_jax.inference import load_trained
    >>> stages = make_stages(load_trained("quickstart").model)
    >>> points, valid = jax.ShapeDtypeStruct((4096, 5), jnp.float32), jax.ShapeDtypeStruct((4096,), bool)
    >>> jax.eval_shape(stages.prepare, points, valid).point_index.shape
    (32, 128, 1)
    """

    inference = proposal_inference(detector.config)

    def network(variables: Any, sample: Any) -> Any:
        outputs, _ = detector.apply(variables, jax.tree.map(lambda leaf: leaf[None], sample))
        return jax.tree.map(lambda leaf: leaf[0], outputs)

    def postprocess(outputs: Any, sample: Any) -> tuple[Array, Array, Array, Array]:
        return suppress(*detector.candidates(outputs, sample), inference)

    def unchanged(variables: Any, points: Any, valid: Any, *boxes: Array) -> Boxes:
        best, scores, labels, used = boxes
        return best, scores, labels, used

    return Stages(detector.prepare, network, detector.candidates, postprocess, detector.refine or unchanged)


def make_detect(detector: Detector) -> Detect:
    """Make the whole path from points to boxes: prepare, network, candidates, NMS, second look if configured.

    Returns:
        pure ``(variables, points f32[n, c], valid bool[n]) -> Detections`` for one cloud, to be jitted by the
        caller; compiled once per number of points. Does not remove close points, see
        :func:`fcos_lidar_jax.projection.remove_close`. A cloud without a point in view has no boxes.

    >>> from fcos_lidar_jax.inference import load_trained
    >>> detector = load_trained("quickstart").model
    >>> variables = jax.eval_shape(detector.init, jax.random.key(0))
    >>> points, valid = jax.ShapeDtypeStruct((4096, 5), jnp.float32), jax.ShapeDtypeStruct((4096,), bool)
    >>> jax.eval_shape(make_detect(detector), variables, points, valid).boxes.shape
    (500, 9)
    """
    config, sensor, stages = detector.config, detector.sensor, make_stages(detector)
    views = _MIRRORS[config.inference.flips]
    no_points, no_boxes = jnp.zeros((0, 5)), jnp.zeros((0, 9))

    def detect(variables: Any, points: Array | np.ndarray, valid: Array | np.ndarray) -> Detections:
        clouds = [_mirror(view, sensor, jnp.asarray(points), no_boxes)[0] for view in views]
        inputs = [stages.prepare(cloud, valid) for cloud in clouds]
        candidates = []
        for view, sample in zip(views, inputs, strict=True):
            boxes, *rest = stages.candidates(stages.network(variables, sample), sample)
            candidates.append((_mirror(view, sensor, no_points, boxes)[1], *rest))
        boxes, scores, labels, used = (jnp.concatenate(parts) for parts in zip(*candidates, strict=True))
        best = suppress(boxes, scores, labels, used, proposal_inference(config))
        best = stages.refine(variables, jnp.asarray(points), jnp.asarray(valid), *best)
        return Detections(*best, inputs[0].num_dropped)

    return detect


def over_clouds(detect: Callable[..., Detections], batch: int | str) -> Callable[..., Detections]:
    """Extend detection in one cloud to ``batch`` clouds: ``(variables, points[b, n, c], valid[b, n])``.

    All clouds share further arguments. A batch of one cloud runs the program for a single cloud, because NMS under
    ``vmap`` does not stop early.
    """

    def several(variables: Any, points: Array, valid: Array, *shared: Any) -> Detections:
        if batch == 1:
            return jax.tree.map(lambda leaf: leaf[None], detect(variables, points[0], valid[0], *shared))
        return jax.vmap(lambda p, v: detect(variables, p, v, *shared))(points, valid)

    return several


def _mirror(view: str, sensor: Sensor, points: Array, boxes: Array) -> tuple[Array, Array]:
    """Mirror points and boxes at the axes of the sensor; applied twice, this is the identity."""
    origin = jnp.asarray(sensor.origin_m[:2], jnp.float32)
    for axis in view:
        points, boxes = points.at[:, :2].add(-origin), boxes.at[:, :2].add(-origin)
        points, boxes = (flip_x if axis == "x" else flip_y)(points, boxes)
        points, boxes = points.at[:, :2].add(origin), boxes.at[:, :2].add(origin)
    return points, boxes

"""The second look as a stage of a detector, trained in the same step."""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from fcos_lidar_jax.config import Config, InferenceConfig, RefinementConfig
from fcos_lidar_jax.forms import in_form
from fcos_lidar_jax.initialization import init_variables
from fcos_lidar_jax.losses import cross_entropy
from fcos_lidar_jax.nms import suppress
from fcos_lidar_jax.refinement.crops import crop_points
from fcos_lidar_jax.refinement.network import SecondLook, box_features, find_neighbours, point_features
from fcos_lidar_jax.refinement.targets import match_boxes, move_boxes
from fcos_lidar_jax.refinement.types import LookInputs, RefinementTargets
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import Batch, Sums

if TYPE_CHECKING:
    from fcos_lidar_jax.models import Detector

SECOND_LOOK = "refinement"  # Name of the parameters of the second look.
Boxes = tuple[Array, Array, Array, Array]
"""Boxes f32[m, 9], scores f32[m], labels i32[m] and valid bool[m] of one cloud, best first."""


def add_refinement(detector: "Detector") -> "Detector":
    """Add the second look of ``config.refinement`` to a detector: variables, the stage ``refine``, losses.

    Its parameters are ``params["refinement"]``. With ``config.refinement.freeze_detector``, the detector is
    applied as in detection, and only the second look has losses.

    >>> from fcos_lidar_jax.models import build_detector  # which calls this function
    >>> from fcos_lidar_jax.presets import COMPACT
    >>> from fcos_lidar_jax.sensors import NUSCENES_HDL32E
    >>> variables = jax.eval_shape(build_detector(COMPACT, NUSCENES_HDL32E).init, jax.random.key(0))
    >>> sorted({name.rstrip("0123456789") for name in variables["params"]["refinement"]})
    ['box', 'norm', 'other', 'out', 'own', 'pair', 'point', 'together']
    """
    config, refinement = detector.config, _config_of(detector.config)
    network = make_network(config)

    def init(key: Any) -> dict[str, Any]:
        variables = detector.init(key)
        look = init_variables(network, jax.random.fold_in(key, 1), _shapes(detector))
        return variables | {"params": variables["params"] | {SECOND_LOOK: look["params"]}}

    def apply(variables: Any, inputs: Any, *, train: bool = False) -> tuple[Any, Any]:
        return detector.apply(
            without_second_look(variables), inputs, train=train and not refinement.freeze_detector
        )

    def sums(variables: Any, outputs: Any, inputs: Any, batch: Batch) -> Sums:
        of_boxes = refinement_sums(detector, variables, outputs, inputs, batch)
        if refinement.freeze_detector:
            return of_boxes
        of_detector = detector.sums(without_second_look(variables), outputs, inputs, batch)
        (losses, counts, means), own = of_boxes, of_detector
        return Sums(own.losses | losses, own.counts | counts, own.means | means)

    refine = functools.partial(refine_boxes, network, config, detector.sensor)
    return detector._replace(init=init, apply=apply, sums=sums, refine=refine)


def without_second_look(variables: dict[str, Any]) -> dict[str, Any]:
    """Variables of a detector without those of the second look."""
    return variables | {
        "params": {name: part for name, part in variables["params"].items() if name != SECOND_LOOK}
    }


def make_network(config: Config) -> SecondLook:
    """The network of a configuration with a second look."""
    refinement, size = _config_of(config), 10 if _sees_motion(config) else 8
    channels = refinement.point_channels, refinement.box_channels, refinement.pair_channels
    return SecondLook(len(config.classes), size, *channels)


def _sees_motion(config: Config) -> bool:
    """Whether points of several sweeps show velocities, which the second look then corrects too."""
    return config.num_sweeps > 1


def trainable(params: dict[str, Any], config: Config) -> dict[str, Any]:
    """The part of the parameters that a training changes: all, or those of the second look only."""
    return {SECOND_LOOK: params[SECOND_LOOK]} if config.trains_second_look_only else params


def proposal_inference(config: Config) -> InferenceConfig:
    """Post-processing before the second look, which looks at the best boxes of all classes.

    The numbers and classes of ``config.inference`` apply to the boxes after it.
    """
    if config.refinement is None:
        return config.inference
    number = config.refinement.num_boxes
    return dataclasses.replace(config.inference, nms_across_classes=False, max_detections=number)


def look_inputs(config: Config, sensor: Sensor, points: Array, valid: Array, boxes: Boxes) -> LookInputs:
    """Features of points, boxes and neighbours of one cloud; ranges and rays begin at the sensor."""
    refinement = _config_of(config)
    place, scores, labels, used = boxes
    crops = crop_points(points, valid, place, num_points=refinement.num_points, margin_m=refinement.margin_m)
    seen = jnp.concatenate([place[:, :3] - jnp.array(sensor.origin_m, jnp.float32), place[:, 3:]], axis=1)
    of_boxes = box_features(
        seen, scores, labels, crops.count, len(config.classes), with_velocity=_sees_motion(config)
    )
    number = refinement.num_neighbours
    neighbours = find_neighbours(place, scores, labels, used, number) if number else None
    return LookInputs(point_features(crops, place), crops.valid, of_boxes, neighbours)


def look(network: SecondLook, variables: Any, inputs: LookInputs) -> tuple[Array, Array]:
    """Class logits and residuals of boxes, from the results of :func:`look_inputs`."""
    outputs: Any = network.apply({"params": variables["params"][SECOND_LOOK]}, inputs)
    return outputs


def refine_boxes(
    network: SecondLook,
    config: Config,
    sensor: Sensor,
    variables: Any,
    points: Array,
    valid: Array,
    *boxes: Array,
) -> Boxes:
    """Score the boxes of one cloud anew, and move them.

    Args:
        variables: ``params`` of the detector, with the second look's.
        points, valid: the cloud, f32[n, c] and bool[n].
        boxes: boxes f32[d, 9], scores f32[d], labels i32[d], valid bool[d] after NMS with
            :func:`proposal_inference`, best first.

    Returns:
        ``inference.max_detections`` boxes, scores, labels and their mask, best first; zero where invalid.
    """
    refinement = _config_of(config)
    place, scores, labels, used = boxes
    with jax.named_scope("refine"):
        looked = look_inputs(config, sensor, points, valid, (place, scores, labels, used))
        logits, residual = look(network, variables, looked)
        probability = jnp.take_along_axis(jax.nn.softmax(logits), labels[:, None], axis=1)[:, 0]
        share = refinement.first_score_weight
        scores = jnp.where(used, probability ** (1 - share) * scores**share, 0.0)
        if refinement.move_boxes:
            place = move_boxes(place, residual)
        return suppress(place, scores, labels, used, dataclasses.replace(config.inference, merge_iou=None))


def refinement_sums(detector: "Detector", variables: Any, outputs: Any, inputs: Any, batch: Batch) -> Sums:
    """The losses of the second look on the detector's own boxes, which have no gradient, as sums over the batch.

    ``refined_class`` is the cross-entropy of all boxes, ``refined_box`` the L1 distance of the residuals of boxes
    near an object, with ``loss.velocity_weight``.
    """
    with jax.named_scope("refine"):
        return look_sums(detector.config, variables, *look_samples(detector, outputs, inputs, batch))


def look_samples(
    detector: "Detector", outputs: Any, inputs: Any, batch: Batch
) -> tuple[LookInputs, RefinementTargets]:
    """Inputs of the second look for the detector's boxes of a batch, and their targets; without gradient."""
    config, refinement = detector.config, _config_of(detector.config)
    inference = proposal_inference(config)

    def prepared(sample: Any) -> tuple[LookInputs, RefinementTargets]:
        outputs, input_, one = sample
        boxes = suppress(*detector.candidates(outputs, input_), inference)
        targets = match_boxes(
            boxes[0],
            boxes[2],
            boxes[3],
            one.boxes,
            one.labels,
            one.box_valid,
            num_classes=len(config.classes),
            radius_range_m=refinement.radius_range_m,
            between_weight=refinement.between_weight,
            with_velocity=_sees_motion(config),
        )
        return look_inputs(config, detector.sensor, one.points, one.valid, boxes), targets

    return over_samples(prepared, lax.stop_gradient((outputs, inputs, batch)))


def look_sums(config: Config, variables: Any, looked: LookInputs, targets: RefinementTargets) -> Sums:
    """The losses of the second look on boxes of several clouds, from the results of :func:`look_samples`."""
    logits, residual = look(make_network(config), variables, looked)
    entropy = jax.vmap(cross_entropy)(logits, targets.label)
    known = ~jnp.isnan(targets.residual)
    distance = jnp.abs(jnp.where(known, residual - jnp.where(known, targets.residual, 0.0), 0.0))
    if _sees_motion(config):
        distance *= jnp.array([*[1.0] * 6, *[config.loss.velocity_weight] * 2, 1.0, 1.0])
    distance = distance.sum(axis=-1)
    used = targets.weight > 0
    right = (logits.argmax(axis=-1) == targets.label) & used
    losses = {
        "refined_boxes": {"refined_class": (entropy * targets.weight).sum()},
        "refined_near": {"refined_box": jnp.where(targets.near, distance, 0.0).sum()},
    }
    counts = {
        "refined_boxes": used.sum(dtype=jnp.int32),
        "refined_near": targets.near.sum(dtype=jnp.int32),
        "refined_objects": (targets.label < len(config.classes)).sum(dtype=jnp.int32),
    }
    return Sums(losses, counts, {"refined_boxes": {"refined_accuracy": right.sum(dtype=jnp.float32)}})


def over_samples(function: Callable[[Any], Any], samples: Any) -> Any:
    """Apply a function to the samples of a batch: one after the other on CPUs, where NMS then stops early."""
    leaves, tree = jax.tree.flatten(samples)
    one_by_one = lambda *leaves: lax.map(function, jax.tree.unflatten(tree, leaves))  # noqa: E731
    together = lambda *leaves: jax.vmap(function)(jax.tree.unflatten(tree, leaves))  # noqa: E731
    if len(leaves[0]) == 1:  # no loop, in which XLA is slower on CPUs
        return jax.tree.map(lambda leaf: leaf[None], function(jax.tree.map(lambda leaf: leaf[0], samples)))
    return in_form(None, {"map": one_by_one, "vmap": together}, *leaves, cpu="map", default="vmap")


def _config_of(config: Config) -> RefinementConfig:
    assert config.refinement is not None
    return config.refinement


def _shapes(detector: "Detector") -> Any:
    """Shapes of the network's inputs for one box of a cloud of one point."""
    boxes = jnp.zeros((1, 9)), jnp.zeros(1), jnp.zeros(1, jnp.int32), jnp.zeros(1, bool)
    cloud = detector.config, detector.sensor, jnp.zeros((1, 5)), jnp.zeros(1, bool)
    return jax.eval_shape(lambda: look_inputs(*cloud, boxes))

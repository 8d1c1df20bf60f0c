"""A detector as one ONNX graph from points to boxes.

JAX traces the stages before and after the network, and each primitive becomes a few nodes, see
:mod:`~fcos_lidar_jax.inference.onnx_rules`. The graph of the network is between them.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fcos_lidar_jax.data.cloud_policy import usable_rows
from fcos_lidar_jax.files import refusing
from fcos_lidar_jax.inference.detect import make_stages
from fcos_lidar_jax.inference.detector import TrainedDetector
from fcos_lidar_jax.inference.onnx_graph import Graph, add_network, cpu_package
from fcos_lidar_jax.inference.onnx_rules import translate
from fcos_lidar_jax.projection import remove_close
from fcos_lidar_jax.types import Outputs

_OPSET, _IR_VERSION = 26, 13  # the first with BitCast
_BATCH = np.array([0])  # axis of the network's batch of one


def program_graph(detector: TrainedDetector) -> bytes:
    """Convert an FCOS-LiDAR detector to an ONNX file from points to boxes, deterministic for fixed versions.

    The inputs are ``points`` f32[n, c] and ``valid`` bool[n] with n rows, ``config.max_points``. The outputs are
    ``boxes``, ``scores``, ``labels`` and ``used``, as in :class:`~fcos_lidar_jax.types.Detections`.
    Rows that are not finite or beyond physical limits are dropped, and points on the ego vehicle as configured.
    """
    config, sensor, stages = detector.config, detector.sensor, make_stages(detector.model)
    if config.inference.flips != "none":
        raise ValueError(f"ONNX: found inference.flips {config.inference.flips}, expected none")
    graph = Graph(cpu_package("onnx"))
    points = jax.ShapeDtypeStruct((config.max_points, sensor.point_columns), np.float32)
    cloud = points, jax.ShapeDtypeStruct((config.max_points,), np.bool_)

    def clean(points: jax.Array, valid: jax.Array) -> jax.Array:
        usable = valid & jnp.asarray(usable_rows(points))
        return jnp.asarray(remove_close(points, usable, sensor, config.reading))

    valid, _ = _add(graph, "clean", clean, cloud, ("points", "valid"))
    image, image_shape = _add(graph, "prepare", stages.prepare, cloud, ["points", valid])
    outputs_shape = jax.eval_shape(stages.network, detector.variables, image_shape)
    names = add_network(graph, detector, graph("Unsqueeze", image.features, _BATCH))
    found: dict[str, Any] = {name: graph("Squeeze", name, _BATCH) for name in names}
    outputs = Outputs(**found)
    proposed = _add(graph, "postprocess", stages.postprocess, (outputs_shape, image_shape), (outputs, image))
    refine = functools.partial(stages.refine, detector.variables)
    boxes, kinds = _add(graph, "refine", refine, (*cloud, *proposed[1]), ("points", valid, *proposed[0]))
    results = ["boxes", "scores", "labels", "used"]
    for name, value in zip(results, boxes, strict=True):
        graph("Identity", value, output=name)
    described = ["points", "valid"], cloud, results, kinds
    return graph.file(detector, *described, opset=_OPSET, ir_version=_IR_VERSION)


def _add(graph: Graph, stage: str, function: Callable[..., Any], shapes: Sequence[Any], values: Any) -> Any:
    """Add a stage to a graph; returns its results, as names in the graph and as shapes."""
    jaxpr, shape = jax.make_jaxpr(function, return_shape=True)(*shapes)
    with refusing(f"ONNX: {stage}", NotImplementedError):
        results = translate(graph, jaxpr, jax.tree.leaves(values))
    return jax.tree.unflatten(jax.tree.structure(shape), results), shape

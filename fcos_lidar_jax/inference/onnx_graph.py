"""The network as an ONNX graph in float32, with batch norms folded into convolutions.

Like ``Detector.apply``, it maps the features of a range image to the raw predictions of all levels, without
projection, decoding and NMS. Images inside the graph are [b, c, h, w].
"""

import json
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fcos_lidar_jax import __version__
from fcos_lidar_jax.config import Config, ModelConfig, StemConfig, config_to_json
from fcos_lidar_jax.files import import_extra
from fcos_lidar_jax.inference.detector import TrainedDetector
from fcos_lidar_jax.locations import STRIDES, ImageLayout, image_layout
from fcos_lidar_jax.models.layers import EPSILON, norm_groups
from fcos_lidar_jax.models.lidar_net import STAGE_STRIDES
from fcos_lidar_jax.models.local_geometry import COLUMNS, OWN, ROWS, UNIT_M, window
from fcos_lidar_jax.models.modality import block_diagonal, channel_groups
from fcos_lidar_jax.refinement import without_second_look
from fcos_lidar_jax.sensors import sensor_to_json
from fcos_lidar_jax.types import CHANNELS

_OPSET, _IR_VERSION = 17, 8  # from 2022, supported by all current runtimes
_TELEMETRY = "openvino_telemetry"
_END = np.iinfo(np.int64).max
INPUTS = "image", "local_geometry"
"""Names of the tensors that the convolutions take; the second only with local geometry."""


def cpu_package(name: str) -> Any:
    """Import a package of the extra ``cpu``; OpenVINO is imported without its telemetry.

    Telemetry would report every import, from a fork of this process that may make threads hang. OpenVINO works
    without telemetry if importing it fails.
    """
    reporter = sys.modules.get(_TELEMETRY)
    sys.modules[_TELEMETRY] = None  # type: ignore[assignment]
    try:
        return import_extra(name, "cpu")
    finally:
        if reporter is None:
            del sys.modules[_TELEMETRY]
        else:
            sys.modules[_TELEMETRY] = reporter


def network_graph(detector: TrainedDetector) -> bytes:
    """Convert the network of an FCOS-LiDAR detector to an ONNX file, deterministic for fixed versions.

    The input is ``features`` f32[b, h, w, c, r], a range image from ``project_points`` in raw units. The outputs
    are ``logits``, ``regression`` and ``iou_logits``, see :class:`~fcos_lidar_jax.types.Outputs`. Everything is
    float32 regardless of ``config.model.precision``. A second look is not part of the graph. The metadata hold
    classes, configuration and sensor as JSON.
    """
    graph = Graph(cpu_package("onnx"))
    shapes, model = add_network(graph, detector, "features"), detector.config.model
    layout, rounds = image_layout(detector.sensor, model), detector.config.projection.num_rounds
    image = "b", layout.rows, layout.columns, len(model.channel_mean), rounds
    features, *outputs = (
        types.SimpleNamespace(dtype=np.float32, shape=shape)
        for shape in (image, *(("b", layout.num_locations, *shape) for shape in shapes.values()))
    )
    return graph.file(detector, ["features"], [features], [*shapes], outputs, opset=_OPSET, ir_version=_IR_VERSION)


def add_network(graph: "Graph", detector: TrainedDetector, features: str) -> dict[str, tuple[int, ...]]:
    """Add the nodes of the network to a graph; returns the outputs' names with their shapes at a location."""
    config, model = detector.config, detector.config.model
    if type(config) is not Config:
        raise ValueError(f"ONNX: got the detector {config.name!r}, expected one on range images")
    layout, rounds = image_layout(detector.sensor, model), config.projection.num_rounds
    network = _Network(graph, without_second_look(detector.variables), circular=model.circular_width)
    image = network("Identity", _preprocessing(network, features, model, layout), output=INPUTS[0])
    stem = _stem(network, image, model.stem, channel_groups(model.stem, rounds, len(model.channel_mean)))
    levels = _pyramid(network, _backbone(network, stem, model.backbone_blocks))
    k = len(config.classes)
    shapes = {"logits": (k + 1,), "regression": (10, k), "iou_logits": (k,)}
    local = _local_geometry(network, image, rounds, model) if model.local_geometry else None
    _heads(network, levels, local, model, shapes)
    if unknown := sorted(network.parameters.keys() - network.used):
        raise ValueError(f"ONNX: found the parameters {unknown[0]}, which are not part of the graph")
    return shapes


class Graph:
    """Nodes and constants of a graph in order of creation. Values are float32, int64 for all integers, or bool."""

    def __init__(self, onnx: Any) -> None:
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: dict[Any, Any] = {}
        self.count = 0  # nodes of this graph and of graphs within it, for unique names

    def constant(self, value: Any) -> str:
        """The name of a constant; equal constants are shared."""
        array = np.asarray(value)
        array = np.ascontiguousarray(array, kind_of(array.dtype)).reshape(array.shape)
        key = array.dtype.kind, array.shape, array.tobytes()
        if key not in self.constants:
            name = f"constant{len(self.constants)}"
            self.constants[key] = self.onnx.numpy_helper.from_array(array, name)
        return self.constants[key].name

    def __call__(self, kind: str, *inputs: Any, output: str = "", **attributes: Any) -> str:
        """Add a node and return the name of its output; inputs other than names become constants."""
        return self.several(kind, *inputs, outputs=[output or f"{kind.lower()}{self.count}"], **attributes)[0]

    def several(self, kind: str, *inputs: Any, outputs: int | list[str], **attributes: Any) -> list[str]:
        """Add a node with a number of outputs, or with outputs of given names."""
        if isinstance(outputs, int):
            outputs = [f"{kind.lower()}{self.count}_{i}" for i in range(outputs)]
        names = [x if isinstance(x, str) else self.constant(x) for x in inputs]
        self.nodes.append(self.onnx.helper.make_node(kind, names, outputs, **attributes))
        self.count += 1
        return outputs

    def inner(self, compute: Callable[..., Sequence[Any]], inputs: Sequence[Any], outputs: Sequence[Any]) -> Any:
        """The graph of a loop or branch, whose nodes ``compute`` adds; arguments describe types and shapes."""
        outside, self.nodes, self.count = self.nodes, [], self.count + 1
        names = [f"inner{self.count}_{i}" for i in range(len(inputs))]
        results = [self("Identity", result) for result in compute(*names)]
        graph, self.nodes = self._graph("inner", names, inputs, results, outputs), outside
        return graph

    def _graph(self, name: str, *described: Sequence[Any], constants: Sequence[Any] = ()) -> Any:
        """A graph of the nodes; inputs and outputs are described by names, and by arrays or the like."""
        helper, values = self.onnx.helper, []
        for names, kinds in zip(described[::2], described[1::2], strict=True):
            types = [helper.np_dtype_to_tensor_dtype(kind_of(kind.dtype)) for kind in kinds]
            shapes = [kind.shape for kind in kinds]
            values.append([*map(helper.make_tensor_value_info, names, types, shapes)])
        return helper.make_graph(self.nodes, name, *values, constants)

    def file(self, detector: TrainedDetector, *described: Sequence[Any], opset: int, ir_version: int) -> bytes:
        """The bytes of an ONNX file, with channels, classes, configuration and sensor of a detector as JSON."""
        helper, config = self.onnx.helper, detector.config
        file = helper.make_model(
            self._graph(config.name, *described, constants=[*self.constants.values()]),
            producer_name="fcos_lidar_jax",
            producer_version=__version__,
            opset_imports=[helper.make_opsetid("", opset)],
            ir_version=ir_version,
        )
        about = {
            "channels": CHANNELS[: len(config.model.channel_mean)],
            "classes": detector.classes,
            "config": config_to_json(config),
            "sensor": sensor_to_json(detector.sensor),
        }
        helper.set_model_props(file, {name: json.dumps(value) for name, value in about.items()})
        return file.SerializeToString(deterministic=True)


def kind_of(dtype: Any) -> Any:
    """The type of values in the graph: int64 for all integers, float32 for all floating-point numbers."""
    return np.dtype({"b": np.bool_, "i": np.int64, "u": np.int64}.get(np.dtype(dtype).kind, np.float32))


class _Network:
    """A graph to which the layers of a network are added, and the parameters by path."""

    def __init__(self, graph: Graph, variables: Any, *, circular: bool) -> None:
        self.graph, self.circular = graph, circular
        leaves = jax.tree_util.tree_leaves_with_path(variables)
        self.parameters = {"/".join(key.key for key in path): np.asarray(leaf) for path, leaf in leaves}
        self.used: set[str] = set()

    def __call__(self, kind: str, *inputs: Any, **options: Any) -> str:
        return self.graph(kind, *inputs, **options)

    def parameter(self, path: str, kind: str = "params") -> np.ndarray:
        """A parameter in float64, so that folding rounds only once."""
        self.used.add(f"{kind}/{path}")
        return self.parameters[f"{kind}/{path}"].astype(np.float64)

    def conv(
        self, x: str, kernel: np.ndarray, *bias: np.ndarray, stride: int = 1, dilation: int = 1, groups: int = 1
    ) -> str:
        """See :func:`fcos_lidar_jax.models.convolution.convolve`, including the layout of the kernel."""
        x, high, wide = self.wrapped(x, *(size // 2 * dilation for size in kernel.shape[:2]))
        options: Any = {"strides": [stride] * 2, "dilations": [dilation] * 2, "pads": [high, wide] * 2}
        return self("Conv", x, kernel.transpose(3, 2, 0, 1), *bias, group=groups, **options)

    def conv_norm(self, x: str, path: str, *, stride: int = 1, relu: bool = True) -> str:
        gain, shift = self.batch_norm(f"{path}/norm")
        y = self.conv(x, self.parameter(f"{path}/conv/kernel") * gain, shift, stride=stride)
        return self("Relu", y) if relu else y

    def conv_bias(self, x: str, path: str, *, stride: int = 1) -> str:
        return self.conv(x, self.parameter(f"{path}/kernel"), self.parameter(f"{path}/bias"), stride=stride)

    def batch_norm(self, path: str) -> tuple[np.ndarray, np.ndarray]:
        """Factor and offset per channel."""
        mean, var = (self.parameter(f"{path}/{name}", "batch_stats") for name in ("mean", "var"))
        gain = self.parameter(f"{path}/scale") / np.sqrt(var + EPSILON)
        return gain, self.parameter(f"{path}/bias") - mean * gain

    def group_norm(self, x: str, path: str) -> str:
        scale, bias = (self.parameter(f"{path}/{name}")[:, None, None] for name in ("scale", "bias"))
        groups = norm_groups(len(scale))
        grouped = self("Reshape", x, [0, groups, -1])
        y = self("InstanceNormalization", grouped, np.ones(groups), np.zeros(groups), epsilon=EPSILON)
        return self("Add", self("Mul", self("Reshape", y, self("Shape", x)), scale), bias)

    def tower(self, x: str, path: str, depth: int) -> str:
        for i in range(depth):
            x = self(
                "Relu", self.group_norm(self.conv(x, self.parameter(f"{path}/conv{i}/kernel")), f"{path}/norm{i}")
            )
        return x

    def padded(self, x: str, high: int, wide: int) -> str:
        """Pad an image on all sides with zeros, or with its other end along a circular width."""
        x, high, wide = self.wrapped(x, high, wide)
        return self("Pad", x, [0, 0, high, wide, 0, 0, high, wide])

    def wrapped(self, x: str, high: int, wide: int) -> tuple[str, int, int]:
        """Wrap a circular image around its width; returns the rows and columns of zeros left to pad."""
        if not self.circular or not wide:
            return x, high, wide
        last, first = self("Slice", x, [-wide], [_END], [3]), self("Slice", x, [0], [wide], [3])
        return self("Concat", last, x, first, axis=3), high, 0

    def cut(self, x: str, row: int, column: int, high: int, wide: int) -> str:
        """A window of a padded image; its end is relative to the end of the image, whose size may be unknown."""
        ends = [_END if place == 2 * pad else place - 2 * pad for place, pad in ((row, high), (column, wide))]
        return self("Slice", x, [row, column], ends, [2, 3])

    def upsample(self, x: str, rows: int, columns: int) -> str:
        how = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
        return self("Resize", x, "", [1.0, 1.0, rows, columns], **how)


def _preprocessing(network: _Network, features: str, model: ModelConfig, layout: ImageLayout) -> str:
    """See :func:`fcos_lidar_jax.models.detector.network_input`."""
    mean, scale = (np.array(values)[:, None] for values in (model.channel_mean, model.channel_scale))
    exists = network("Greater", network("Slice", features, [7], [8], [3]), 0.0)
    scaled = network("Div", network("Sub", features, mean), scale)
    scaled = network("Where", exists, scaled, 0.0)
    image = network("Transpose", network("Reshape", scaled, [0, 0, 0, -1]), perm=[0, 3, 1, 2])
    if model.row_upscale > 1:
        image = network.upsample(image, model.row_upscale, 1)
    extra, below = layout.width - layout.columns, layout.height - layout.rows * model.row_upscale
    if layout.full_turn and extra:
        whole, rest = divmod(layout.width, layout.columns)
        parts = [image] * whole + ([network("Slice", image, [0], [rest], [3])] if rest else [])
        image, extra = network("Concat", *parts, axis=3), 0
    if extra or below:
        image = network("Pad", image, [0, 0, 0, 0, 0, 0, below, extra])
    return image


def _stem(network: _Network, image: str, config: StemConfig, groups: Sequence[tuple[int, int]]) -> str:
    gain, shift = network.batch_norm("stem/norm")
    merged = ""
    for index, dilation in enumerate(config.dilations):
        path, x = f"stem/branch{index}", image
        for layer in range(config.num_convs):
            kernels = [network.parameter(f"{path}/conv{layer}_group{g}") for g in range(len(groups))]
            factor, bias = network.batch_norm(f"{path}/norm{layer}")
            alike = len(set(groups)) == 1 and groups[0][1] % _FAST_WIDTH == 0
            diagonal = np.asarray(block_diagonal([*map(jnp.asarray, kernels)]))
            kernel = np.concatenate(kernels, axis=-1) if alike else diagonal
            together = len(groups) if alike else 1
            x = network("Relu", network.conv(x, kernel * factor, bias, dilation=dilation, groups=together))
        merge = network.parameter(f"stem/merge{index if config.merge == 'per_branch' else 0}") * gain
        y = network.conv(x, merge[None, None], *([] if merged else [shift]))
        merged = network("Add", merged, y) if merged else y
    return network("Relu", merged)


_FAST_WIDTH = 16
"""Grouped convolutions on CPUs are slow unless the width of a group is a multiple of this."""


def _local_geometry(network: _Network, image: str, rounds: int, model: ModelConfig) -> str:
    """See :class:`fcos_lidar_jax.models.local_geometry.LocalGeometry`."""

    def points_of(r: int) -> tuple[str, str]:
        points = network("Gather", image, [r, rounds + r, 2 * rounds + r], axis=1)
        filled = network("Greater", network("Gather", image, [7 * rounds + r], axis=1), 0.0)
        points = network("Mul", points, np.array(model.channel_scale[:3])[:, None, None])
        return points, network("Where", filled, 1.0, 0.0)

    points, exists = points_of(0)
    azimuth = network("Mul", network("Gather", image, [4 * rounds], axis=1), model.channel_scale[4])
    azimuth = network("Add", azimuth, model.channel_mean[4])
    cos, sin = network("Cos", azimuth), network("Sin", azimuth)

    def offsets_to(others: str) -> str:
        offset = network("Sub", others, points)
        dx, dy, dz = (network("Slice", offset, [axis], [axis + 1], [1]) for axis in range(3))
        radial = network("Add", network("Mul", cos, dx), network("Mul", sin, dy))
        tangential = network("Sub", network("Mul", cos, dy), network("Mul", sin, dx))
        return network("Asinh", network("Div", network("Concat", radial, tangential, dz, axis=1), UNIT_M))

    padded_points, padded_exists = (network.padded(x, ROWS, COLUMNS) for x in (points, exists))
    channels = []
    for row, column in window():
        both = network("Mul", network.cut(padded_exists, row, column, ROWS, COLUMNS), exists)
        offsets = offsets_to(network.cut(padded_points, row, column, ROWS, COLUMNS))
        channels += [network("Mul", offsets, both), both]
    channels.append(network("Gather", image, [rounds * channel for channel in OWN], axis=1))
    for r in range(1, rounds if model.round_offsets else 1):
        others, filled = points_of(r)
        both = network("Mul", filled, exists)
        times = (network("Gather", image, [8 * rounds + k], axis=1) for k in (r, 0))
        later = network("Concat", offsets_to(others), network("Sub", *times), axis=1)
        channels += [network("Mul", later, both), both]
    x = network("Concat", *channels, axis=1, output=INPUTS[1])
    for layer in range(2):
        gain, shift = network.batch_norm(f"local_geometry/norm{layer}")
        kernel = network.parameter(f"local_geometry/linear{layer}") * gain
        x = network("Relu", network.conv(x, kernel[None, None], shift))
    return x


def _backbone(network: _Network, x: str, blocks: Sequence[int]) -> list[str]:
    x, levels = network.conv_norm(x, "backbone/first"), []
    for stage, (count, stride) in enumerate(zip(blocks, STAGE_STRIDES, strict=True)):
        for block in range(count):
            path, step = f"backbone/stage{stage}_block{block}", stride if block == 0 else 1
            y = network.conv_norm(x, f"{path}/reduce")
            y = network.conv_norm(y, f"{path}/spatial", stride=step)
            y = network.conv_norm(y, f"{path}/expand", relu=False)
            if block == 0:
                x = network.conv_norm(x, f"{path}/shortcut", stride=step, relu=False)
            x = network("Relu", network("Add", x, y))
        levels.append(x)
    return levels


def _pyramid(network: _Network, levels: Sequence[str]) -> list[str]:
    laterals = [network.conv_bias(x, f"fpn/lateral{i + 2}") for i, x in enumerate(levels)]
    for i in range(len(laterals) - 2, -1, -1):
        laterals[i] = network("Add", laterals[i], network.upsample(laterals[i + 1], 2, 2))
    outputs = [network.conv_bias(x, f"fpn/output{i + 2}") for i, x in enumerate(laterals)]
    outputs.append(network.conv_bias(outputs[-1], "fpn/output6", stride=2))
    return [*outputs, network.conv_bias(network("Relu", outputs[-1]), "fpn/output7", stride=2)]


_TOWERS = ("classification", "regression")
_PREDICTIONS = {
    "logits": ("classification", ("logits",)),
    "regression": ("regression", ("centre", "size", "heading", "velocity")),
    "iou_logits": ("regression", ("iou",)),
}
"""Tower and layers of each output."""


def _heads(
    network: _Network,
    levels: Sequence[str],
    local: str | None,
    model: ModelConfig,
    shapes: Mapping[str, Sequence[int]],
) -> None:
    outputs: dict[str, list[str]] = {name: [] for name in _PREDICTIONS}
    for level, image in enumerate(levels):
        path = "heads/shared" if model.tied_heads else f"heads/level{level + 2}"
        here = network("Slice", local, [0, 0], [_END] * 2, [2, 3], [STRIDES[level]] * 2) if local else None
        image = network("Add", image, here) if here else image
        towers = {name: network.tower(image, f"{path}/{name}_tower", model.head_convs) for name in _TOWERS}
        if here:
            for name, x in towers.items():
                joined = network.conv(here, network.parameter(f"{path}/{name}_local/kernel"))
                towers[name] = network("Relu", network("Add", x, joined))
        for name, (tower, layers) in _PREDICTIONS.items():
            kernel, bias = (
                np.concatenate([network.parameter(f"{path}/{tower}/{layer}_{part}") for layer in layers], axis=-1)
                for part in ("kernel", "bias")
            )
            y = network("Transpose", network.conv(towers[tower], kernel, bias), perm=[0, 2, 3, 1])
            outputs[name].append(network("Reshape", y, [0, -1, *shapes[name]]))
    for name, of_levels in outputs.items():
        network("Concat", *of_levels, axis=1, output=name)

"""Detectors whose network runs in OpenVINO, which is fast on CPUs.

XLA compiles the projection, OpenVINO the network, and XLA decoding, NMS and the second look.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from fcos_lidar_jax.inference.detect import make_stages
from fcos_lidar_jax.inference.detector import TrainedDetector
from fcos_lidar_jax.inference.onnx_graph import INPUTS, cpu_package, network_graph
from fcos_lidar_jax.models import Detector
from fcos_lidar_jax.types import Detections, Outputs, RangeImage

Precision = Literal["float32", "bfloat16"]
_HINT = {"float32": "f32", "bfloat16": "bf16"}


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class OpenVinoDetector(TrainedDetector):
    """A :class:`TrainedDetector` whose network runs in OpenVINO, see :func:`with_openvino`."""

    precision: Precision  # precision of the convolutions
    network: Callable[[RangeImage], Outputs]  # for one sample

    @property
    def fingerprint(self) -> str:
        return f"{super().fingerprint} openvino {cpu_package('openvino').__version__} {self.precision}"

    def __post_init__(self) -> None:
        if (flips := self.config.inference.flips) != "none":
            raise ValueError(f"backend openvino: found inference.flips {flips}, expected none")

    def program(self, mesh: Mesh, batch_size: int = 1) -> Callable[..., Any]:
        """See :meth:`CloudDetector.program`; clouds of a batch run one by one, with identical results."""
        prepare, postprocess, refine = _jitted_stages(self.model)

        def one(points: np.ndarray, valid: np.ndarray) -> Detections:
            image = prepare(points, valid)
            best = postprocess(self.network(image), image)
            boxes, scores, labels, used = refine(self.variables, points, valid, *best)
            return Detections(boxes, scores, labels, used, image.num_dropped)

        def several(points: Any, valid: Any) -> Detections:
            detections = [one(*cloud) for cloud in zip(np.asarray(points), np.asarray(valid), strict=True)]
            return jax.tree.map(lambda *leaves: jnp.stack(leaves), *detections)

        return several


@functools.lru_cache(maxsize=8)
def _jitted_stages(detector: Detector) -> tuple[Callable[..., Any], ...]:
    stages = make_stages(detector)
    return jax.jit(stages.prepare), jax.jit(stages.postprocess), jax.jit(stages.refine)


def processor_precision() -> Precision:
    """bfloat16 if the processor supports it, else float32."""
    capabilities = cpu_package("openvino").Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    return "bfloat16" if "BF16" in capabilities else "float32"


def with_openvino(detector: TrainedDetector, *, precision: Precision | None = None) -> OpenVinoDetector:
    """Compile the network of a detector with OpenVINO, for one cloud at a time, on the CPU in one process.

    ``precision`` applies to the convolutions; by default :func:`processor_precision`. Positions and the offsets
    between them are always float32: at 40 m, bfloat16 has steps of 0.25 m.
    """
    if jax.default_backend() != "cpu" or jax.process_count() > 1:
        found = f"{jax.process_count()} processes on {jax.default_backend()}"
        raise ValueError(f"backend openvino: found {found}, expected one on cpu")
    graph = network_graph(detector)
    precision = precision or processor_precision()
    core = cpu_package("openvino").Core()
    model = core.read_model(graph)
    (features,) = model.inputs
    model.reshape([1, *(size.get_length() for size in features.partial_shape[1:])])

    def compiled(part: Any, precision: Precision) -> Any:
        options = {"INFERENCE_PRECISION_HINT": _HINT[precision], "PERFORMANCE_HINT": "LATENCY"}
        return core.compile_model(part, "CPU", options).create_infer_request()

    inputs, rest = _parts(model)
    prepare, convolve = compiled(inputs, "float32"), compiled(rest, precision)

    def network(image: RangeImage) -> Outputs:
        # Inputs are shared. Outputs are copied, because the next cloud overwrites them.
        prepared = prepare.infer([np.asarray(image.features)[None]], share_inputs=True, share_outputs=True)
        outputs = convolve.infer([*prepared.values()], share_inputs=True)
        return Outputs(*(outputs[name][0] for name in ("logits", "regression", "iou_logits")))

    return OpenVinoDetector(detector.model, detector.variables, precision, network)


def _parts(model: Any) -> tuple[Any, Any]:
    """Split a model into the computation of the convolutions' inputs, and everything after it."""
    openvino = cpu_package("openvino")
    tensors = {name: output for op in model.get_ordered_ops() for output in op.outputs() for name in output.names}
    ends = [tensors[name] for name in INPUTS if name in tensors]
    inputs, parameters = openvino.Model(ends, model.get_parameters()).clone(), []
    for end in ends:
        parameters.append(openvino.opset13.parameter(end.shape, end.element_type))
        for target in end.get_target_inputs():
            target.replace_source_output(parameters[-1].output(0))
    return inputs, openvino.Model(model.get_results(), parameters)

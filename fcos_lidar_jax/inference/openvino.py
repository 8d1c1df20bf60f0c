"""A detector whose network runs in OpenVINO: the fast path on CPUs.

Three programs per cloud: projection, compiled by XLA; the network, by OpenVINO; decoding and NMS, by XLA again.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.inference.detect import make_stages
from fcos_lidar_jax.inference.detector import TrainedDetector
from fcos_lidar_jax.inference.onnx_graph import cpu_package, network_graph
from fcos_lidar_jax.models import Detector
from fcos_lidar_jax.types import Detections, Outputs, RangeImage

Precision = Literal["float32", "bfloat16"]
_HINT = {"float32": "f32", "bfloat16": "bf16"}


@dataclasses.dataclass(frozen=True)
class OpenVinoDetector(TrainedDetector):
    """As :class:`TrainedDetector`, with the network in OpenVINO, see :func:`with_openvino`."""

    precision: Precision  # That the network computes in.
    network: Callable[[RangeImage], Outputs]  # Of one sample.

    @property
    def fingerprint(self) -> str:
        return f"{super().fingerprint} openvino {cpu_package('openvino').__version__} {self.precision}"

    def with_inference(self, **fields: Any) -> TrainedDetector:
        """As of any detector; flips are refused."""
        detector = super().with_inference(**fields)
        _check_flips(detector.config)
        return detector

    def program(self, mesh: Mesh, batch_size: int = 1) -> Callable[..., Any]:
        """As of any detector, but one cloud after the other: a batch changes nothing."""
        prepare, postprocess = _ends(self.model)

        def one(points: np.ndarray, valid: np.ndarray) -> Detections:
            image = prepare(points, valid)
            boxes, scores, labels, used = postprocess(self.network(image), image)
            return Detections(boxes, scores, labels, used, image.num_dropped)

        def several(points: Any, valid: Any) -> Detections:
            found = [one(*cloud) for cloud in zip(np.asarray(points), np.asarray(valid), strict=True)]
            return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)

        return several


@functools.lru_cache(maxsize=8)
def _ends(detector: Detector) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The stages before and behind the network, compiled once."""
    stages = make_stages(detector)
    return jax.jit(stages.prepare), jax.jit(stages.postprocess)


def _check_flips(config: Config) -> None:
    if config.inference.flips != "none":
        raise ValueError(f"backend openvino: found inference.flips {config.inference.flips}, expected none")


def processor_precision() -> Precision:
    """bfloat16 where the processor computes in it, else float32.

    Raises:
        ValueError: OpenVINO is not installed.
    """
    abilities = cpu_package("openvino").Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    return "bfloat16" if "BF16" in abilities else "float32"


def with_openvino(detector: TrainedDetector, *, precision: Precision | None = None) -> OpenVinoDetector:
    """The detector with its network in OpenVINO, compiled for one cloud at once.

    Args:
        detector: network with its weights.
        precision: of the network but for its ends; default: :func:`processor_precision`.

    Raises:
        ValueError: OpenVINO or onnx is not installed, or JAX does not run on the CPU of this process alone.
    """
    if jax.default_backend() != "cpu" or jax.process_count() > 1:
        found = f"{jax.process_count()} processes on {jax.default_backend()}"
        raise ValueError(f"backend openvino: found {found}, expected one on cpu")
    _check_flips(detector.config)
    graph = network_graph(detector)
    precision = precision or processor_precision()
    openvino = cpu_package("openvino")
    core = openvino.Core()
    model = core.read_model(graph)
    (features,) = model.inputs
    model.reshape([1, *(size.get_length() for size in features.partial_shape[1:])])
    options = {"INFERENCE_PRECISION_HINT": _HINT[precision], "PERFORMANCE_HINT": "LATENCY"}
    request = core.compile_model(model, "CPU", options).create_infer_request()

    def network(image: RangeImage) -> Outputs:
        # Inputs are read where they are; outputs are copied, for the next cloud overwrites them.
        found = request.infer([np.asarray(image.features)[None]], share_inputs=True)
        return Outputs(*(found[name][0] for name in ("logits", "regression", "iou_logits")))

    return OpenVinoDetector(detector.model, detector.variables, precision, network)

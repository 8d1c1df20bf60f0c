"""The same computations on a GPU and on the CPU of one machine: projection, detection, gradient.

    python -m experiments.studies.gpu_equivalence --data FOLDER  # the real data

Projects the real ten-sweep cloud in five rounds, and detects in real keyframes with ``hdl32e``, in the default
precision of the GPU (TF32 in convolutions) and in full float32. ``gradient`` is the difference of the gradient of
one training step of ``compact``, relative to the largest value of each leaf. ``tests/test_projection.py`` compares
the projection with an oracle on the CPU. Cost: some minutes, mostly compilation. Expected: the same point
wins in every cell, and ranges and angles differ by rounding; in full float32 all boxes are found on both.
"""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.benchmarks.latency import fused_cloud, padded
from experiments.real_frames import real_frames
from experiments.script import Options, run_measurement
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.inference import TrainedDetector, load_trained, make_detect
from fcos_lidar_jax.inference.timing import interleaved
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.training.step import make_gradient
from fcos_lidar_jax.types import CHANNELS, Detections

_NEAR_M = 0.5  # Boxes of one class whose centres are at most this far apart are the same object.
_SCENES = {"scene-0523, odd": 10, "scene-0103": 2, "scene-0061": 1}  # Keyframes per scene.
_PRECISIONS = ("highest", "default")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """Options of the comparison."""

    data: Path | None = None
    """Folder of the real data; default: the environment's FCOS_LIDAR_REAL_DATA."""
    repeats: int = 50  # Timed detections.


def on(device: Any, function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function for a device; its arguments are copied there."""
    compiled = jax.jit(function)
    return lambda *args: jax.block_until_ready(compiled(*jax.device_put(args, device)))


def compare_projection(cpu: Any, gpu: Any, data: Path | None) -> dict[str, Any]:
    """Count the values of the range images of a ten-sweep cloud that differ, by channel."""
    fused, name = fused_cloud(data, NUSCENES_HDL32E)
    cloud = padded(fused, "multi", NUSCENES_HDL32E)

    def project(points: Any, valid: Any) -> Any:
        return project_points(points, valid, NUSCENES_HDL32E, num_rounds=NUSCENES.projection.num_rounds)

    first, second = (jax.device_get(on(device, project)(cloud.points, cloud.valid)) for device in (cpu, gpu))
    pairs = {"point_index": (first.point_index, second.point_index)}
    pairs |= {name: (first.features[:, :, i], second.features[:, :, i]) for i, name in enumerate(CHANNELS)}
    return {
        "cloud": name,
        "points_kept": int((first.point_index >= 0).sum()),
        "differing": {name: int((a != b).sum()) for name, (a, b) in pairs.items()},
        "largest_difference": {
            name: float(np.abs(a - b).max()) for name, (a, b) in pairs.items() if (a != b).any()
        },
    }


def compare_detections(
    cpu: Any, gpu: Any, detector: TrainedDetector, scenes: dict[str, FrameSet]
) -> dict[str, Any]:
    """Match the boxes of both devices in each keyframe."""
    clouds = [
        make_cloud(scenes[name].frame(i).points, detector.config, sensor=detector.sensor)
        for name, number in _SCENES.items()
        for i in range(number)
    ]
    record = {}
    expected = _detect(cpu, detector, clouds, "highest")
    for precision in _PRECISIONS:
        found = _detect(gpu, detector, clouds, precision)
        pairs = [pair for a, b in zip(expected, found, strict=True) for pair in _pairs(a, b)]
        record[precision] = {
            "boxes_on_cpu": sum(int(boxes.valid.sum()) for boxes in expected),
            "boxes_on_gpu": sum(int(boxes.valid.sum()) for boxes in found),
            "found_on_both": len(pairs),
            "largest_distance_m": round(max((apart for apart, _ in pairs), default=0.0), 5),
            "largest_score_difference": round(max((score for _, score in pairs), default=0.0), 5),
        }
    return record


def _detect(device: Any, detector: TrainedDetector, clouds: list[Any], precision: str) -> list[Detections]:
    with jax.default_matmul_precision(precision):
        detect = on(device, make_detect(detector.model))
        return [jax.device_get(detect(detector.variables, cloud.points, cloud.valid)) for cloud in clouds]


def _pairs(first: Detections, second: Detections) -> Iterator[tuple[float, float]]:
    """Distance and difference of scores of each box and its nearest partner of the same class, used once."""
    free = second.valid.copy()
    for row in np.flatnonzero(first.valid):
        same = np.flatnonzero(free & (second.labels == first.labels[row]))
        distance = np.linalg.norm(second.boxes[same, :3] - first.boxes[row, :3], axis=1)
        if len(same) and distance.min() <= _NEAR_M:
            nearest = same[distance.argmin()]
            free[nearest] = False
            yield float(distance.min()), float(abs(second.scores[nearest] - first.scores[row]))


def compare_gradients(cpu: Any, gpu: Any, detector: TrainedDetector, frames: FrameSet) -> dict[str, float]:
    """Largest difference of a gradient from the CPU's, relative to the largest value of its leaf."""
    config, gradient = detector.config, make_gradient(detector.model)
    batch = make_batch([frames.frame(0)], max_points=config.max_points, max_boxes=config.max_boxes)
    given = detector.variables["params"], detector.variables["batch_stats"], batch

    def compute(device: Any, precision: str) -> list[np.ndarray]:
        with jax.default_matmul_precision(precision):
            return jax.tree.leaves(jax.device_get(on(device, gradient)(*given)[0]))

    expected = compute(cpu, "highest")
    return {
        precision: max(
            float(np.abs(a - b).max() / max(np.abs(a).max(), 1e-12))
            for a, b in zip(expected, compute(gpu, precision), strict=True)
        )
        for precision in _PRECISIONS
    }


def measure(args: Args) -> dict[str, Any]:
    """Compare both devices, and time the detection on the GPU."""
    gpus = [device for device in jax.devices() if device.platform == "gpu"]
    if not gpus:
        raise ValueError(f"devices: got {jax.devices()[0].platform}, expected a GPU")
    gpu, cpu, detector = gpus[0], jax.devices("cpu")[0], load_trained("hdl32e")
    scenes = real_frames(args.data, CloudReading(1, "all"))
    record = {
        "projection": compare_projection(cpu, gpu, args.data),
        "detection": compare_detections(cpu, gpu, detector, scenes),
        "gradient": compare_gradients(cpu, gpu, detector, scenes["scene-0061"]),
    }
    cloud = make_cloud(scenes["scene-0061"].frame(0).points, detector.config, sensor=detector.sensor)
    detect, variables = jax.jit(make_detect(detector.model)), jax.device_put(detector.variables, gpu)
    call = {"points to boxes": lambda: detect(variables, cloud.points, cloud.valid)}
    return {**record, "hdl32e_milliseconds": interleaved(call, args.repeats)["points to boxes"]}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

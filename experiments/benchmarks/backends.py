"""The network in OpenVINO beside XLA: how much faster on this processor, and as good?

    python -m experiments.benchmarks.backends --data FOLDER --out experiments/results/backends.json
    taskset -c 0 python -m experiments.benchmarks.backends --frames 0  # times on one core

Points to boxes, and the network alone: of ``compact`` on a simulated sweep, with the weights ``hdl32e`` and with
random ones, and of the paper's preset on ten fused sweeps. Random weights have a background's prior of 0.5, so
that NMS is at its busiest. Both backends take turns. Then the mAP of ``hdl32e`` with both, on unseen simulated
frames and on the real keyframes in FOLDER (see ``transfer``). Needs ``pip install 'fcos-lidar-jax[cpu]'``.

Cost: five minutes for the times on two CPU cores, and a second a frame for the mAP. Expected: at most half of
XLA's time in bfloat16, else at most 0.95 of it, and an mAP within 0.005.
"""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.benchmarks.latency import fused_cloud
from experiments.changes import change
from experiments.real_frames import real_frames
from experiments.runs import detections
from experiments.script import Options, find_real_data, run_measurement
from fcos_lidar_jax import open_frames
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.data.frame import FrameSet, SelectedFrames
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import metric_of
from fcos_lidar_jax.inference import TrainedDetector, load_trained
from fcos_lidar_jax.inference.detect import make_stages
from fcos_lidar_jax.inference.onnx_graph import cpu_package
from fcos_lidar_jax.inference.openvino import Precision, processor_precision, with_openvino
from fcos_lidar_jax.inference.timing import Call, interleaved
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import PRESETS
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.simulation.frames import make_frame


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """What to time, how often, and on what to score."""

    presets: tuple[str, ...] = ("hdl32e", "compact", "nuscenes")  # To be timed; or shipped weights.
    repeats: int = 15  # Turns.
    weights: Path = Path("hdl32e")  # To be scored.
    frames: int = 200  # Unseen simulated frames; 0 scores nothing, on real keyframes neither.
    data: Path | None = None  # Folder with the real data; default: the environment's FCOS_LIDAR_REAL_DATA.


def times(preset: str, repeats: int) -> dict[str, Any]:
    """Milliseconds of both backends, turn by turn, and OpenVINO's share of XLA's."""
    if preset in PRESETS:
        config = change(model__background_prior=0.5)(PRESETS[preset])
        model = build_detector(config, load_sensor(config.sensor))
        trained = TrainedDetector(model, jax.jit(model.init)(jax.random.key(0)))
    else:
        trained = load_trained(preset)
    config, sensor, model = trained.config, trained.sensor, trained.model
    points = make_frame(0, sensor).points if config.num_sweeps == 1 else fused_cloud(None, sensor)[0]
    cloud = make_cloud(points, config, sensor=sensor)
    precisions: tuple[Precision, ...] = ("float32",)
    if (best := processor_precision()) not in precisions:
        precisions = (best, *precisions)
    others = {precision: with_openvino(trained, precision=precision) for precision in precisions}
    stages, variables = make_stages(model), jax.device_put(trained.variables)
    network = jax.jit(stages.network)
    image = stages.prepare(cloud.points, cloud.valid)
    calls: dict[str, Call] = {
        "points to boxes, xla": lambda: trained.detect(cloud),
        "network, xla": lambda: network(variables, image),
    }
    for precision, other in others.items():
        calls[f"points to boxes, {precision}"] = lambda other=other: other.detect(cloud)
        calls[f"network, {precision}"] = lambda other=other: other.network(image)
    found = interleaved(calls, repeats)
    return {
        "points": cloud.num_points,
        "times": found,
        "to_xla": {
            name: round(found[name]["median_ms"] / found[f"{name.partition(',')[0]}, xla"]["median_ms"], 3)
            for name in found
        },
        "largest_difference": {
            precision: difference(network(variables, image), other.network(image))
            for precision, other in others.items()
        },
    }


def difference(ours: Any, other: Any) -> dict[str, float]:
    """The largest difference of each output, relative to the largest value."""
    scale = {name: float(np.abs(value).max()) for name, value in vars(ours).items()}
    return {n: float(f"{np.abs(getattr(other, n) - v).max() / scale[n]:.2g}") for n, v in vars(ours).items()}


def scores(args: Args) -> dict[str, Any]:
    """mAP with both backends."""
    trained = load_trained(args.weights)
    other = with_openvino(trained)
    unseen = open_frames(format="simulated", split="val", sensor=trained.sensor, reading=trained.config.reading)
    sets: dict[str, Sequence[FrameSet]] = {
        f"{args.frames} unseen simulated frames": [SelectedFrames(unseen, tuple(range(args.frames)))]
    }
    if find_real_data(args.data) is not None:
        sets["real keyframes"] = list(real_frames(args.data, trained.config.reading).values())
    record: dict[str, Any] = {"weights": str(args.weights), "precision": other.precision}
    for name, frames in sets.items():
        mean_aps = [mean_ap(detector, frames) for detector in (trained, other)]
        record[name] = {
            "keyframes": sum(map(len, frames)),
            "xla": round(mean_aps[0], 4),
            "openvino": round(mean_aps[1], 4),
            "difference": round(mean_aps[1] - mean_aps[0], 4),
        }
    return record


def mean_ap(detector: TrainedDetector, sets: Sequence[FrameSet]) -> float:
    """Of all frames together."""
    found, read = [], []
    for frames in sets:
        for collected, new in zip((found, read), detections(detector, frames), strict=True):
            collected.extend(new)
    return float(evaluate_frames(found, read, metric_of(detector.classes)).summary["mean_ap"])


def measure(args: Args) -> dict[str, Any]:
    """Times and scores."""
    record: dict[str, Any] = {
        "openvino": cpu_package("openvino").__version__,
        "cores_used": len(os.sched_getaffinity(0)),
        "repeats": args.repeats,
        **{preset: times(preset, args.repeats) for preset in args.presets},
    }
    return record | ({"mAP": scores(args)} if args.frames else {})


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

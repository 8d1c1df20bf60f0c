"""Gain and cost of post-processing that is not in the paper.

    python -m experiments.studies.post_processing --out experiments/results/post_processing.json

A lower NMS threshold, weighted NMS (box voting), the exponent of the predicted IoU and mirrored views are fields
of ``Config.inference``, which training does not depend on. Each is applied with the shipped weights to the same
unseen simulated frames, and to the real keyframes if the environment's ``FCOS_LIDAR_REAL_DATA`` has them. The
intervals are bootstrap intervals of the paired difference in mAP. The values of ``compact`` were chosen on 60
other simulated frames. Cost: one second per frame on two CPU cores.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from experiments.real_frames import real_frames
from experiments.script import Options, find_real_data, run_measurement
from experiments.statistics import paired_difference
from fcos_lidar_jax import open_frames
from fcos_lidar_jax.config import InferenceConfig
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.data.frame import Frame, FrameSet, SelectedFrames
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import metric_of
from fcos_lidar_jax.inference import TrainedDetector, load_trained
from fcos_lidar_jax.inference.detect import make_detect
from fcos_lidar_jax.inference.timing import Call, interleaved
from fcos_lidar_jax.presets import COMPACT
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.types import Detections

PAPER = "as in the paper"
_COMPACT = dataclasses.asdict(COMPACT.inference)
VARIANTS: dict[str, dict[str, Any]] = {
    PAPER: {},
    "weighted NMS": {"merge_iou": 0.3},
    "NMS at 0.1": {"iou_threshold": 0.1},
    "NMS at 0.1, weighted": {"iou_threshold": 0.1, "merge_iou": 0.1},
    "square root of the IoU": {"iou_exponent": 0.5},
    "as in compact": _COMPACT,
    "as in compact, across classes": {**_COMPACT, "nms_across_classes": True},
    "mirrored view": {"flips": "x"},
    "as in compact, mirrored view": {**_COMPACT, "flips": "x"},
}
"""Changes of the paper's post-processing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """Options of the comparison."""

    weights: Path = Path("hdl32e")  # Weights that were trained with flips of x.
    frames: int = 400  # Unseen simulated frames.
    data: Path | None = None  # Folder of the real data; default: the environment's FCOS_LIDAR_REAL_DATA.
    repeats: int = 15  # Timed calls per variant.


def programs(trained: TrainedDetector) -> dict[str, Any]:
    """Make the pure detection function of each variant."""
    paper = dataclasses.asdict(InferenceConfig())
    return {n: make_detect(trained.with_inference(**{**paper, **own}).model) for n, own in VARIANTS.items()}


def find(trained: TrainedDetector, sets: Sequence[FrameSet]) -> tuple[dict[str, list[Detections]], list[Frame]]:
    """Detect with all variants; returns their detections and the frames."""
    # One program, so that the variants share the network.
    each = programs(trained)
    together = jax.jit(lambda *given: {name: detect(*given) for name, detect in each.items()})
    variables, found, visited = jax.device_put(trained.variables), {name: [] for name in VARIANTS}, []
    progress = Progress("frames", sum(map(len, sets)))
    for frames in sets:
        for index in range(len(frames)):
            visited.append(frames.frame(index))
            cloud = make_cloud(visited[-1].points, trained.config, sensor=trained.sensor, num_close=0)
            for name, detections in jax.device_get(together(variables, cloud.points, cloud.valid)).items():
                found[name].append(detections)
            progress.show(len(visited))
    return found, visited


def compare(found: dict[str, list[Detections]], frames: list[Frame], classes: Sequence[str]) -> dict[str, Any]:
    """Compute the mAP of each variant and its difference from the paper's post-processing."""
    metric = metric_of(classes)
    evaluations = {name: evaluate_frames(boxes, frames, metric) for name, boxes in found.items()}
    record: dict[str, Any] = {"frames": len(frames)}
    for name, evaluation in evaluations.items():
        record[name] = {"mAP": round(evaluation.summary["mean_ap"], 4)}
        if name != PAPER:
            low, high = paired_difference(evaluations[PAPER], evaluation)
            difference = evaluation.summary["mean_ap"] - evaluations[PAPER].summary["mean_ap"]
            record[name] |= {"difference": round(difference, 4), "interval": [round(low, 4), round(high, 4)]}
    return record


def times(trained: TrainedDetector, repeats: int) -> dict[str, Any]:
    """Time each variant from points to boxes, in milliseconds."""
    frame = open_frames(format="simulated", split="val", sensor=trained.sensor).frame(0)
    cloud = make_cloud(frame.points, trained.config, sensor=trained.sensor)
    inputs = jax.device_put(trained.variables), cloud.points, cloud.valid
    jitted = {name: jax.jit(detect) for name, detect in programs(trained).items()}
    calls: dict[str, Call] = {
        name: lambda detect=detect: jax.block_until_ready(detect(*inputs)) for name, detect in jitted.items()
    }
    return interleaved(calls, repeats)


def measure(args: Args) -> dict[str, Any]:
    """Compare scores and times."""
    trained = load_trained(args.weights)
    unseen = open_frames(format="simulated", split="val", sensor=trained.sensor, reading=trained.config.reading)
    sets: dict[str, Sequence[FrameSet]] = {"unseen simulated": [SelectedFrames(unseen, tuple(range(args.frames)))]}
    if find_real_data(args.data) is not None:
        sets["real keyframes"] = list(real_frames(args.data, trained.config.reading).values())
    record: dict[str, Any] = {"weights": str(args.weights), "times": times(trained, args.repeats)}
    return record | {name: compare(*find(trained, frames), trained.classes) for name, frames in sets.items()}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

"""What do additions to the paper's network and losses give to preset ``compact``, and what do they cost?

    python -m experiments.studies.compact_additions --out experiments/results/compact_additions.json

The paper predicts the offset of the centre and the velocity along the axes of the LiDAR frame; LaserNet and
RangeDet take the direction of each point's azimuth (``model.regression_axes``). And the paper pads the image
with zeros, where ``compact`` lets it wrap around (``model.circular_width``). ``compact`` has neither RangeDet's
Meta-Kernel (``model.meta_kernel``) nor a centreness in place of the predicted IoU (``loss.quality``). Its
network is trained from random weights as it is, without each of the first two and with each of the others, on
the same frames of fresh streets, for the same number of steps, and tested on unseen ones: mAP by centre distance
with the interval of the paired difference over frames drawn anew, AP at the shortest and at the longest matching
distance, the errors of hits, the IoU of the positives during the last tenth of the training, and which part of
the objects at the image's seam, and of those opposite, is found. The interval knows nothing of other seeds of
the training, which differ by more. The time of the network is measured in turns. The same command resumes it.
Cost: ten minutes for each of the five on two CPU cores.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.changes import Change, change
from experiments.runs import detections, trained
from experiments.script import Options, run_measurement
from experiments.statistics import paired_difference
from experiments.studies.shipped_weights import CONFIGS, streets
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.matching import DISTANCES_M
from fcos_lidar_jax.evaluation.metrics import Evaluation, metric_of
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.inference.detect import make_stages
from fcos_lidar_jax.inference.timing import Call, interleaved
from fcos_lidar_jax.models import count_parameters
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.types import Detections

COMPACT = "compact"
VARIANTS: dict[str, Change] = {
    COMPACT: change(),
    "LiDAR axes": change(model__regression_axes="lidar"),
    "zero padding": change(model__circular_width=False),
    "Meta-Kernel": change(model__meta_kernel=True),
    "centreness": change(loss__quality="centreness"),
}
_LAST = 0.1  # Part of the training that the IoU of the positives is a mean over.
_OTHERS = 400  # Unseen frames that shipped weights are reported on: not those that decide about an addition.
_NEAR_SEAM_RAD = np.radians(15.0)
_FOUND_M = 2.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """How long, and on how much."""

    steps: int = 1500  # Updates of each training, on a frame each.
    seed: int = 0  # Of weights and streets.
    test_frames: int = 200  # Unseen frames.
    repeats: int = 15  # Turns of the timing.
    work: Path = Path("outputs/compact_additions")  # Folder of the runs.


def figures(evaluation: Evaluation, run: Path, steps: int) -> dict[str, Any]:
    """Scores of a training, and how well its boxes fit."""
    summary, records = evaluation.summary, read_metrics(run)
    late = [r["positive_iou"] for r in records if "positive_iou" in r and r["step"] > (1 - _LAST) * steps]
    near, far = (
        np.mean([aps[str(distance)] for aps in summary["label_aps"].values()])
        for distance in (min(DISTANCES_M), max(DISTANCES_M))
    )
    return {
        "mAP": round(summary["mean_ap"], 4),
        f"AP at {min(DISTANCES_M):g} m": round(float(near), 4),
        f"AP at {max(DISTANCES_M):g} m": round(float(far), 4),
        "centre error of hits, m": round(summary["tp_errors"]["trans_err"], 3),
        "velocity error of hits, m/s": round(summary["tp_errors"]["vel_err"], 3),
        "IoU of the last positives": round(float(np.mean(late)), 4),
    }


def recall_towards(azimuth: float, found: Sequence[Detections], frames: Sequence[Frame]) -> tuple[float, int]:
    """Which part of the objects within 15 degrees of an azimuth has a box of its class within 2 m; their number.

    Boxes of any score count.
    """
    hits: list[bool] = []
    for detections_, frame in zip(found, frames, strict=True):
        kept = np.asarray(detections_.valid)
        centres, labels = np.asarray(detections_.boxes)[kept, :2], np.asarray(detections_.labels)[kept]
        for box, label in zip(frame.boxes, frame.labels, strict=True):
            turn = np.arctan2(box[1], box[0]) - azimuth
            if abs(np.arctan2(np.sin(turn), np.cos(turn))) < _NEAR_SEAM_RAD:
                far = np.hypot(*(centres[labels == label] - box[:2]).T)
                hits.append(bool((far < _FOUND_M).any()))
    return float(np.mean(hits)) if hits else float("nan"), len(hits)


def network_times(detectors: dict[str, TrainedDetector], frame: Frame, repeats: int) -> dict[str, Any]:
    """Milliseconds of the networks on one image, in turns."""
    calls: dict[str, Call] = {}
    for name, detector in detectors.items():
        stages = make_stages(detector.model)
        cloud = make_cloud(frame.points, detector.config, sensor=detector.sensor, num_close=0)
        image, network = jax.jit(stages.prepare)(cloud.points, cloud.valid), jax.jit(stages.network)
        variables = jax.device_put(detector.variables)
        calls[name] = lambda network=network, given=(variables, image): jax.block_until_ready(network(*given))
    return {name: times["median_ms"] for name, times in interleaved(calls, repeats).items()}


def measure(args: Args) -> dict[str, Any]:
    """Train what is missing, evaluate, compare."""
    evaluations, detectors = dict[str, Evaluation](), dict[str, TrainedDetector]()
    record: dict[str, Any] = {"steps": args.steps, "seed": args.seed, "test_frames": args.test_frames}
    frames: list[Frame] = []
    for name, changed in VARIANTS.items():
        config = changed(CONFIGS["hdl32e"])
        shown, unseen = streets(config, steps=args.steps, seed=args.seed)
        folder = args.work / f"{name.replace(' ', '_').lower()}_{args.steps}_{args.seed}"
        detector = detectors[name] = trained(folder, config, shown, steps=args.steps, seed=args.seed)
        assert isinstance(unseen, SimulatedFrames)
        tests = dataclasses.replace(unseen, number=args.test_frames, first_seed=unseen.first_seed + _OTHERS)
        found, frames = detections(detector, tests)
        evaluations[name] = evaluate_frames(found, frames, metric_of(detector.classes))
        record[name] = figures(evaluations[name], folder, args.steps)
        seam = detector.sensor.first_azimuth_rad
        for place, azimuth in (("at the seam", seam), ("opposite", seam + np.pi)):
            recall, number = recall_towards(azimuth, found, frames)
            record[name][f"recall {place}"], record[f"objects {place}"] = round(recall, 4), number
        record[name]["parameters"] = count_parameters(detector.variables["params"])["total"]
    for name in VARIANTS:
        if name != COMPACT:
            low, high = paired_difference(evaluations[COMPACT], evaluations[name])
            difference = record[name]["mAP"] - record[COMPACT]["mAP"]
            record[name] |= {"difference": round(difference, 4), "interval": [round(low, 4), round(high, 4)]}
    for name, milliseconds in network_times(detectors, frames[0], args.repeats).items():
        record[name]["network, ms"] = milliseconds
    return record


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

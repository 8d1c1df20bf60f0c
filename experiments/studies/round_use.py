"""Use of the extra rounds: what a network trained with five rounds loses if four of them are empty.

    python -m experiments.studies.round_use --trained RUN_OF_FIVE_ROUNDS RUN_OF_ONE_ROUND \
        --out experiments/results/round_use.json

Scores networks of the scale ``sector`` on its test frames. Networks with several rounds are also scored on clouds
reduced to the points that the first round keeps: the first round stays the same, and the others are empty. Equal
scores would mean that the network does not use the later rounds. Lower scores mean that it does, or that empty
rounds, which it has not seen in training, disturb it. The record also has NDS, AP by class, and AP and velocity
error of cars. For objects faster than 0.5 m/s, and for the others, it has the mAP over the classes with such
objects, AP by class, and AP and velocity error of cars. It names each run by its folder. Cost: some minutes of one
CPU core per network.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper_tables.scales import quarter
from experiments.runs import benchmark, detections
from experiments.script import Options, run_measurement
from experiments.studies.round_contents import MOVING_MPS
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.frame import Frame, FrameSet, WrappedFrames
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.inference import TrainedDetector, load_trained
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.types import Detections

_NEAR_M = 2.0
_STEP = 8192  # Clouds are padded to its multiples, so that few sizes are compiled.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """Options of the comparison."""

    trained: tuple[Path, ...]  # Finished runs, or checkpoints, of the scale sector.
    frames: Path = Path("outputs/runs/frames")  # Folder of the simulated frames.


@dataclasses.dataclass(frozen=True)
class FirstRound(WrappedFrames):
    """Frames reduced to the points that the first round keeps, in their order; the annotations stay."""

    frames: FrameSet
    prioritize_current: bool  # As the network that sees the frames.

    def frame(self, index: int) -> Frame:
        frame = self.frames.frame(index)
        number = len(frame.points)
        points = np.pad(frame.points, ((0, -number % _STEP), (0, 0)))
        options = {"num_rounds": 1, "prioritize_current": self.prioritize_current}
        image = project_points(points, np.arange(len(points)) < number, self.sensor, **options)
        kept = np.unique(image.point_index)
        return dataclasses.replace(frame, points=frame.points[kept[kept >= 0]])

    def fingerprint(self) -> str:
        return checksum(repr((self.frames.fingerprint(), "first round", self.prioritize_current)).encode())


def scores(detector: TrainedDetector, frames: FrameSet) -> dict[str, Any]:
    """Score a detector: mAP, NDS, AP by class, AP and velocity error of cars in m/s; all but NDS by motion too."""
    found, tests = detections(detector, frames)
    summary = benchmark(found, tests).summary
    record: dict[str, Any] = {
        "mAP": round(summary["mean_ap"], 4),
        "NDS": round(summary["nd_score"], 4),
        "AP": _by_class(summary),
        "cars": _cars(summary),
    }
    for motion, moving in (("moving", True), ("standing", False)):
        parts = [by_motion(d, frame, moving) for d, frame in zip(found, tests, strict=True)]
        summary = benchmark([d for d, _ in parts], [frame for _, frame in parts]).summary
        labels = np.unique(np.concatenate([frame.labels for _, frame in parts]))
        present = [summary["mean_dist_aps"][NUSCENES_CLASSES[label]] for label in labels]
        record[f"{motion} objects"] = {"mAP": round(float(np.mean(present)), 4), "AP": _by_class(summary)}
        record[f"{motion} cars"] = _cars(summary)
    return record


def _by_class(summary: dict[str, Any]) -> dict[str, float]:
    return {name: round(ap, 3) for name, ap in summary["mean_dist_aps"].items()}


def _cars(summary: dict[str, Any]) -> dict[str, float]:
    error = summary["label_tp_errors"]["car"]["vel_err"]
    return {"AP": round(summary["mean_dist_aps"]["car"], 3), "velocity error": round(error, 3)}


def by_motion(found: Detections, frame: Frame, moving: bool) -> tuple[Detections, Frame]:
    """Select the moving or the standing objects.

    A detection within 2 m of an object of its class belongs to the nearest one, and is dropped if that one is not
    selected. All other detections stay in both selections, so both APs include them as false positives.
    """
    own = (np.hypot(frame.boxes[:, 7], frame.boxes[:, 8]) > MOVING_MPS) == moving
    boxes, labels = np.asarray(found.boxes), np.asarray(found.labels)
    distance = np.linalg.norm(boxes[:, None, :2] - frame.boxes[:, :2], axis=2)
    distance = np.where(labels[:, None] == frame.labels, distance, np.inf)
    nearest = distance.min(axis=1, where=own, initial=np.inf), distance.min(axis=1, where=~own, initial=np.inf)
    of_others = (nearest[1] < _NEAR_M) & (nearest[1] < nearest[0])
    kept = {name: getattr(frame, name)[own] for name in ("boxes", "labels", "num_points")}
    selected = dataclasses.replace(found, valid=np.asarray(found.valid) & ~of_others)
    return selected, dataclasses.replace(frame, **kept)


def measure(args: Args) -> dict[str, Any]:
    """Score each network."""
    scale, record = quarter(args.frames), dict[str, Any]()
    for path in args.trained:
        detector = load_trained(path)
        tests = scale.frames("test", detector.config.num_sweeps)
        record[path.name] = {"all rounds": scores(detector, tests)}
        projection = detector.config.projection
        if projection.num_rounds > 1:
            first = FirstRound(tests, projection.prioritize_current)
            record[path.name]["first round only"] = scores(detector, first)
    return record


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

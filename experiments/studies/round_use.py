"""Use of the extra rounds: what a network trained with five rounds loses if four of them are empty.

    python -m experiments.studies.round_use --trained outputs/runs/sector/model.local_geometry=true_seed=0 \
        --out experiments/results/round_use.json

Scores networks of the scale ``sector`` on its test frames. Networks with several rounds are also scored on clouds
reduced to the points that the first round keeps: the first round stays the same, and the others are empty. Equal
scores would mean that the network does not use the later rounds. Lower scores mean that it does, or that empty
rounds, which it has not seen in training, disturb it. The record also has NDS, AP by class, and the velocity
error of detected cars. Cost: some minutes of one CPU core per network.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper_tables.scales import quarter
from experiments.runs import benchmark, detections
from experiments.script import Options, run_measurement
from fcos_lidar_jax.data.frame import Frame, FrameSet, WrappedFrames
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.inference import TrainedDetector, load_trained
from fcos_lidar_jax.projection import project_points

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
    """Score a detector: mAP, NDS, AP by class, and the velocity error of cars in m/s."""
    summary = benchmark(*detections(detector, frames)).summary
    return {
        "mAP": round(summary["mean_ap"], 4),
        "NDS": round(summary["nd_score"], 4),
        "car velocity error": round(summary["label_tp_errors"]["car"]["vel_err"], 3),
        "AP": {name: round(ap, 3) for name, ap in summary["mean_dist_aps"].items()},
    }


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

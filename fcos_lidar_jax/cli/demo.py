"""``fcos-lidar demo``: a trained detector on a simulated drive, without any data."""

import dataclasses
import time
from pathlib import Path
from typing import Annotated

import numpy as np

from fcos_lidar_jax.checkpoints.storage import shipped_checkpoints
from fcos_lidar_jax.cli.checks import Output
from fcos_lidar_jax.cli.scoring import Task, run_detector, write_reports, write_scores
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.evaluation.comparison import compare_by_benchmark
from fcos_lidar_jax.evaluation.metrics import Evaluation
from fcos_lidar_jax.evaluation.truth import split_truth
from fcos_lidar_jax.fields import Count, Natural
from fcos_lidar_jax.inference import CloudDetector, load_detector
from fcos_lidar_jax.input_pipeline import open_frames
from fcos_lidar_jax.progress import Progress, tell
from fcos_lidar_jax.simulation.nuscenes_export import write_dataset
from fcos_lidar_jax.simulation.nuscenes_tables import CHANNEL
from fcos_lidar_jax.simulation.render import DatasetSpec
from fcos_lidar_jax.visualization.drive import draw_drive
from fcos_lidar_jax.visualization.evaluation_report import make_examples
from fcos_lidar_jax.visualization.page import page_frame, write_page

WEIGHTS = "hdl32e"
_CAPTION = """The drive, one keyframe every half second: the range image, and the view from above, where higher
points are darker, detections have the colour of their class, and the truth is dashed."""
_GIF, _PAGE = "drive.gif", "drive.html"
_MAX_LIMIT_M = 50.0  # half the side of the square that pictures show


@dataclasses.dataclass(frozen=True)
class Demo:
    """Run the shipped detector on an unseen simulated drive. Needs no data and no GPU.

    The command simulates a drive, writes it as a data set in the nuScenes layout, detects boxes in its keyframes,
    and computes the nuScenes metrics. It writes the files of `fcos-lidar evaluate`, an animation, and drive.html,
    which plays the drive.
    """

    out: Annotated[Path, Output.FOLDER] = Path("demo_output")  # Folder for the results.
    keyframes: Count = 12  # Length of the drive in keyframes, half a second apart.
    drive: Natural = 3  # Seed of the drive.


def run(args: Demo) -> None:
    """Simulate, evaluate and draw."""
    began = time.monotonic()
    tell(f"simulating a drive of {args.keyframes} keyframes")
    detector, title = load_detector(shipped_checkpoints()[WEIGHTS]), f"{WEIGHTS} on an unseen simulated drive"
    frames = _simulate(args, detector)
    truth = split_truth(frames.nuscenes, frames.tokens)
    comparison = compare_by_benchmark(truth, "the drive", detector.classes, frames)
    task = Task("the drive", comparison, detector.sensor, detector, frames)
    run_detector(task, args.out)
    compared = comparison.read(args.out / comparison.file)
    evaluation = write_scores(task, compared, args.out, bootstrap=200)
    _draw(args.out, title, evaluation, frames)
    more = {"pictures": [(_CAPTION, args.out / _GIF)], "links": [("Look at the drive: play, turn, zoom", _PAGE)]}
    write_reports(task, compared, evaluation, args.out, title=title, **more)
    cloud = min((args.out / "drive" / "samples" / CHANNEL).iterdir())
    print(f"done after {time.monotonic() - began:.0f} s")
    print(
        f"look at {args.out / 'report.html'}, or detect in a cloud yourself:\n"
        f"  fcos-lidar detect {cloud} --checkpoint {WEIGHTS} --out boxes.json --pictures {args.out / 'detected'}"
    )


def _simulate(args: Demo, detector: CloudDetector) -> NuScenesFrames:
    """Write the drive as a data set; returns its keyframes."""
    root, sensor = args.out / "drive", detector.sensor
    spec = DatasetSpec(1, args.drive, args.keyframes, sensor, True, "v1.0-drive")
    write_dataset(spec, root, workers=1, report=Progress("sweeps", spec.sweeps).show)
    frames = open_frames(root, reading=detector.config.reading, sensor=sensor)
    assert isinstance(frames, NuScenesFrames)
    return frames


def _draw(out: Path, title: str, evaluation: Evaluation, frames: FrameSet) -> None:
    rows = {name: row for row, name in enumerate(evaluation.tokens)}
    origins = np.zeros((len(rows), 3))
    scenes = list(make_examples(evaluation, frames, origins, rows, min_score=0, all_sweeps=True))
    page_frames = [
        page_frame(
            scene.points,
            scene.detections,
            name=scene.name,
            time_us=frames.time_us(row),
            pose=frames.pose(row),
            truth=scene.truth,
        )
        for row, scene in enumerate(scenes)
    ]
    classes, sensor = evaluation.metric.classes, frames.sensor
    write_page(out / _PAGE, page_frames, classes=classes, title=title)
    draw_drive(
        out / _GIF,
        scenes,
        sensor=sensor,
        classes=classes,
        title=title,
        limit_m=min(sensor.limit_xy_m, _MAX_LIMIT_M),
        report=Progress("pictures", len(scenes)).show,
    )

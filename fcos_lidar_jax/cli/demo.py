"""``fcos-lidar demo``: a trained detector on a simulated drive, without any data."""

import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from fcos_lidar_jax.cli import demo_training
from fcos_lidar_jax.cli.checks import check_at_least, check_out_folder, option_name
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.evaluation.benchmark import evaluate_keyframes
from fcos_lidar_jax.evaluation.examples import choose_examples
from fcos_lidar_jax.evaluation.records import confident
from fcos_lidar_jax.evaluation.results import LIDAR_META
from fcos_lidar_jax.evaluation.summary import describe, write_evaluation
from fcos_lidar_jax.inference import CloudDetector, load_detector
from fcos_lidar_jax.inference.prediction import Prediction, predict
from fcos_lidar_jax.input_pipeline import open_frames
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.simulation.nuscenes_export import write_dataset
from fcos_lidar_jax.simulation.nuscenes_tables import CHANNEL
from fcos_lidar_jax.simulation.render import DatasetSpec
from fcos_lidar_jax.visualization.drive import Scene, draw_drive
from fcos_lidar_jax.visualization.evaluation_report import make_examples, write_evaluation_report
from fcos_lidar_jax.visualization.page import page_frame, write_page

WEIGHTS = "hdl32e"
_BOOTSTRAP_SETS = 200
_CAPTION = """The drive, one keyframe every half second: the range image, and the view from above, where higher
points are darker, detections have the colour of their class, and the truth is dashed."""
_PAGE = "drive.html"
_MAX_LIMIT_M = 50.0  # half the side of the square that pictures show


@dataclasses.dataclass(frozen=True)
class Demo:
    """Run the shipped detector on an unseen simulated drive. Needs no data and no GPU.

    The command simulates a street, writes it as a data set in the nuScenes layout, detects boxes in its keyframes
    and evaluates them as the benchmark does. It writes report.html, metrics_summary.json, an animation, pictures,
    and drive.html, which plays the drive. With --train it then trains the quickstart preset from scratch in the
    folder training. Ctrl-C ends the training early and evaluates the result; the same command resumes.
    """

    out: Path = Path("demo_output")  # Folder for the results.
    keyframes: int = 12  # Length of the drive in keyframes, half a second apart.
    drive: int = 3  # Seed of the drive.
    train: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False  # Also train a small detector, for some minutes.
    steps: int = 2000  # With --train: training steps.
    test_frames: int = 40  # With --train: unseen frames to evaluate on.
    seed: int = 0  # With --train: seed of the weights and frames.


def run(args: Demo) -> None:
    """Simulate, detect, evaluate and draw; with ``--train`` also train."""
    check_at_least(args, 1, "keyframes", "test_frames")
    check_at_least(args, 0, "steps", "drive", "seed")
    check_out_folder(args.out)
    for name in () if args.train else ("steps", "test_frames", "seed"):
        if getattr(args, name) != getattr(Demo, name):
            raise ValueError(f"{option_name(name)}: expected --train with it")
    began = time.monotonic()
    print(f"simulating a drive of {args.keyframes} keyframes", file=sys.stderr, flush=True)
    detector = load_detector(WEIGHTS)
    frames = _simulate(args, detector)
    print("compiling the detector", file=sys.stderr, flush=True)
    predictions, progress = [], Progress("keyframes", len(frames))
    for prediction in predict(detector, frames):
        predictions.append(prediction)
        progress.show(len(predictions))
    scores = _report(args, detector, frames, predictions)
    print(f"{WEIGHTS} on an unseen simulated drive, after {time.monotonic() - began:.0f} s:\n{scores}")
    cloud = min((args.out / "drive" / "samples" / CHANNEL).iterdir())
    print(
        f"look at {args.out / 'report.html'}, or detect in a cloud yourself:\n"
        f"  fcos-lidar detect {cloud} --checkpoint {WEIGHTS} --out boxes.json --pictures {args.out / 'detected'}"
    )
    if args.train:
        demo_training.run(args.out / "training", args.steps, args.test_frames, args.seed)


def _simulate(args: Demo, detector: CloudDetector) -> NuScenesFrames:
    """Write the drive as a data set; returns its keyframes."""
    version = "v1.0-drive"
    spec = DatasetSpec(1, args.drive, args.keyframes, detector.sensor, True, version)
    write_dataset(spec, args.out / "drive", workers=1, report=Progress("sweeps", spec.sweeps).show)
    frames = open_frames(
        args.out / "drive", version=version, reading=detector.config.reading, sensor=detector.sensor
    )
    assert isinstance(frames, NuScenesFrames)
    return frames


def _report(args: Demo, detector: CloudDetector, frames: NuScenesFrames, predictions: list[Prediction]) -> str:
    """Write metrics, pictures and the report; returns the scores as text."""
    classes, sensor = detector.classes, detector.sensor
    detections = [prediction.detections for prediction in predictions]
    evaluation = evaluate_keyframes(detections, frames.nuscenes, frames.tokens, classes)
    progress = Progress("sets", _BOOTSTRAP_SETS)
    intervals = write_evaluation(args.out, evaluation, LIDAR_META, repeats=_BOOTSTRAP_SETS, report=progress.show)
    examples = choose_examples(evaluation)
    min_score = examples.min_score
    _write_page(args.out / _PAGE, detector, frames, predictions, min_score)
    scenes = [_scene(prediction, min_score) for prediction in predictions]
    draw_drive(
        args.out / "drive.gif",
        scenes,
        sensor=sensor,
        classes=classes,
        title=f"{WEIGHTS} on an unseen simulated drive: score {min_score:.2f} and more, truth dashed",
        limit_m=min(sensor.limit_xy_m, _MAX_LIMIT_M),
        report=Progress("pictures", len(scenes)).show,
    )
    write_evaluation_report(
        args.out,
        title=f"{WEIGHTS} on an unseen simulated drive",
        num_samples=len(scenes),
        examples=make_examples(evaluation, frames, np.zeros((len(scenes), 3)), examples.rows, min_score=min_score),
        sensor=sensor,
        pictures=[(_CAPTION, args.out / "drive.gif")],
        links=[("Look at the drive: play, turn, zoom", _PAGE)],
    )
    return describe(evaluation, intervals)


def _write_page(
    path: Path, detector: CloudDetector, frames: NuScenesFrames, predictions: list[Prediction], min_score: float
) -> None:
    """Write the page with all detections; it first shows those with at least ``min_score``."""
    page_frames = []
    for prediction in predictions:
        scene, index = _scene(prediction, 0.0), prediction.index
        place = {"time_us": frames.time_us(index), "pose": frames.pose(index), "name": frames.name(index)}
        page_frames.append(page_frame(scene.points, scene.detections, truth=scene.truth, **place))
    title = f"{WEIGHTS} on a simulated drive"
    write_page(path, page_frames, classes=detector.classes, title=title, min_score=min_score)


def _scene(prediction: Prediction, min_score: float) -> Scene:
    frame = prediction.frame
    assert frame is not None
    seen = frame.num_points > 0
    detections = confident(prediction.detections, min_score)
    return Scene(frame.points, detections, (frame.boxes[seen], np.asarray(frame.labels)[seen]))

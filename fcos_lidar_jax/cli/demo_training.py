"""The training of ``fcos-lidar demo --train``: the quickstart preset from scratch, beside its shipped weights."""

import time
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np

from fcos_lidar_jax.checkpoints.retention import find_checkpoint
from fcos_lidar_jax.evaluation.metrics import DISTANCES_M
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.inference import TrainedDetector, evaluate, load_trained, predict
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.simulation.frame_set import fresh_streets, unseen_frames
from fcos_lidar_jax.training import Schedule, train
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.training.pictures import draw_predictions
from fcos_lidar_jax.training.plan import RUN_SPEC
from fcos_lidar_jax.visualization.range_image import draw_range_image
from fcos_lidar_jax.visualization.report import Picture, write_report

_NUM_DRAWN = 3  # frames in the report and in the folder unseen
_NUM_VALIDATED = 10  # test frames of the evaluations during training
_NUM_EVALUATIONS = 6

_TITLES = {"shipped": "shipped weights", "after": "trained here", "before": "untrained"}


def run(out: Path, steps: int, test_frames: int, seed: int) -> None:
    """Detect with the shipped weights, train, detect again, and write the report.

    Writes metrics.json, pictures, report.html, unseen clouds, and the run with its checkpoints. Ctrl-C ends the
    training early and evaluates the result.
    """
    began = time.monotonic()
    shipped = load_trained("quickstart")
    tests, num_drawn = unseen_frames(shipped.sensor, test_frames), min(_NUM_DRAWN, test_frames)
    metrics: dict[str, Any] = {}
    pictures: list[Picture] = []

    def assess(model: str, detector: TrainedDetector, *, draw: bool = True) -> None:
        """Evaluate on the test frames, print the score, and draw the first frames."""
        summary = metrics[model] = evaluate(detector, tests).summary
        minutes = (time.monotonic() - began) / 60
        score = f"mAP {summary['mean_ap']:.3f} on {test_frames} unseen frames"
        print(f"{_TITLES[model]}: {score}, after {minutes:.1f} minutes", flush=True)
        if draw:
            first, title = predict(detector, tests, indices=range(num_drawn)), f"{_TITLES[model]}, unseen frame"
            paths = draw_predictions(out, first, tests, prefix=model, title=title)
            pictures.extend((f"From above: {title} {index}.", path) for index, path in enumerate(paths))

    assess("shipped", shipped)
    run_folder = out / "run"
    if steps:
        _train(run_folder, steps, test_frames, seed)
        trained = load_trained(run_folder)
        assess("before", TrainedDetector(trained.model, trained.model.init(jax.random.key(seed))), draw=False)
        assess("after", trained)
        metrics["training"] = _training_record(run_folder)
    clouds = [tests.frame(index).points for index in range(num_drawn)]
    for index, points in enumerate(clouds):
        atomic_write(out / "unseen" / f"frame_{index:03d}.npy", lambda path, points=points: np.save(path, points))
    path = out / "range_image.png"
    image = project_points(clouds[0], np.ones(len(clouds[0]), bool), tests.sensor, num_rounds=1)
    draw_range_image(image, path, title="unseen frame 0 as the network sees it")
    pictures.append(("The range image of unseen frame 0.", path))
    if steps:
        pictures += [
            ("The parts of the loss during the training.", run_folder / "loss.png"),
            ("Scores during the training, on some of the unseen frames.", run_folder / "scores.png"),
        ]
    metrics["minutes"] = round((time.monotonic() - began) / 60, 2)
    text = msgspec.json.format(msgspec.json.encode(metrics), indent=1)  # NaN becomes null
    atomic_write(out / "metrics.json", lambda path: path.write_bytes(text))
    _report(out, test_frames, metrics, pictures)
    print(
        f"look at {out / 'report.html'}, or detect in a cloud yourself:\n"
        f"  fcos-lidar detect {out / 'unseen' / 'frame_000.npy'} "
        f"--checkpoint {run_folder if steps else 'quickstart'} "
        f"--out boxes.json --pictures {out / 'detected'}"
    )


def _train(folder: Path, steps: int, test_frames: int, seed: int) -> None:
    config, frames = fresh_streets(QUICKSTART, steps=steps, seed=seed)
    every = max(-(-steps // _NUM_EVALUATIONS), 1)
    tell(f"training from random weights on {len(frames)} simulated frames")
    try:
        train(
            config,
            frames,
            folder,
            steps=steps,
            seed=seed,
            tests=unseen_frames(frames.sensor, min(_NUM_VALIDATED, test_frames)),
            resume=(folder / RUN_SPEC).exists(),
            devices=jax.devices()[:1],
            schedule=Schedule(every, every),
            threads=1,
        )
    except KeyboardInterrupt:
        if find_checkpoint(folder) == folder:  # no checkpoint yet
            raise
        tell("evaluating the last checkpoint")


def _training_record(folder: Path) -> dict[str, Any]:
    records = read_metrics(folder)
    steps, loss = [(record["step"], record["loss/total"]) for record in records if "loss/total" in record][-1]
    return {
        "steps": steps,
        "frames_seen": steps * QUICKSTART.optimizer.batch_size,
        "final_loss": loss,
        "curve": [[record["step"], record["test/mAP"]] for record in records if "test/mAP" in record],
    }


def _report(out: Path, test_frames: int, metrics: dict[str, Any], pictures: list[Picture]) -> None:
    models = [model for model in _TITLES if model in metrics]
    rows = [
        (name.replace("_", " "), *(metrics[model]["mean_dist_aps"][name] for model in models))
        for name in metrics["shipped"]["mean_dist_aps"]
    ]
    summary = {f"mAP, {_TITLES[model]}": metrics[model]["mean_ap"] for model in models}
    summary["unseen frames"] = test_frames
    lead = "A small detector on unseen simulated LiDAR frames: with the shipped weights"
    if training := metrics.get("training"):
        summary |= {"training steps": training["steps"], "frames seen": training["frames_seen"]}
        lead += ", and after a few minutes of training from scratch"
    distances = ", ".join(f"{d:g}" for d in DISTANCES_M)
    caption = f"Average precision per class, mean over the matching distances {distances} m"
    write_report(
        out / "report.html",
        title="FCOS-LiDAR: quickstart",
        lead=f"{lead}.",
        summary={**summary, "total minutes": metrics["minutes"]},
        tables=[(caption, ("class", *(_TITLES[model] for model in models)), rows)],
        pictures=pictures,
    )

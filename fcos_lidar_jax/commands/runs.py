"""A training run in a folder: step, checkpoints, evaluation, records and pictures; begun or gone on with."""

import dataclasses
import json
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from fcos_lidar_jax.commands.clouds import make_cloud
from fcos_lidar_jax.commands.detect import confident
from fcos_lidar_jax.config import Config, config_to_json
from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.data.pipeline import HostBatch
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.models import Variables, build_detector
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.sensors import Sensor, sensor_to_json
from fcos_lidar_jax.training import (
    Checkpoint,
    NonFiniteLossError,
    detection_variables,
    fit,
    make_optimizer,
    make_state,
    make_train_step,
)
from fcos_lidar_jax.training.loop import Record
from fcos_lidar_jax.training.records import Records, read_records
from fcos_lidar_jax.training.sharding import check_batch_size, jit_step, make_mesh, replicate, shard_batch
from fcos_lidar_jax.training.snapshots import CHECKPOINTS, Snapshots
from fcos_lidar_jax.training.stopping import stop_requests
from fcos_lidar_jax.types import Detections, TrainState

_PLAN = "run.json"
_SHOWN_SCORE = 0.2
_NUM_PICTURES = 2

Feed = Callable[[int], AbstractContextManager[Iterator[HostBatch]]]
"""From a step on, this process's batches."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """What a run is; it goes on with the same plan alone."""

    config: Config
    """What is trained."""
    sensor: Sensor
    """For which sensor."""
    num_steps: int
    """Updates of the whole run."""
    seed: int
    """Of weights, order, pasted objects and augmentation."""
    data: dict[str, Any]
    """What it is trained on, as JSON."""


@dataclasses.dataclass(frozen=True)
class Rhythm:
    """When what is done beside training."""

    save_every: int
    """Steps between two checkpoints."""
    evaluate_every: int
    """Steps between two evaluations; each saves a checkpoint, too."""
    keep: int = 2
    """Newest checkpoints that are kept, beside the best."""


class Run:
    """A run in a folder.

    ``run.json`` is the plan, ``metrics.jsonl`` and ``tensorboard/`` are the records, ``checkpoints/`` holds the
    newest checkpoints and the best one, ``pictures/`` some test frames at every evaluation, ``loss.png`` and
    ``scores.png`` the curves.

    Args:
        folder: of the run.
        plan: what it is.
        rhythm: when to save and evaluate.
        tests: to evaluate on; may be empty.
    """

    def __init__(self, folder: Path, plan: Plan, rhythm: Rhythm, tests: FrameSet | None) -> None:
        """Nothing is written yet."""
        self.folder, self.plan, self.rhythm, self.tests = folder, plan, rhythm, tests
        self.snapshots = Snapshots(folder / CHECKPOINTS, keep=rhythm.keep)
        self.detector = build_detector(plan.config, plan.sensor)
        self.optimizer = make_optimizer(plan.config.optimizer, plan.num_steps)
        self.detect = jax.jit(make_detect(self.detector, plan.config, plan.sensor))
        self.leads = jax.process_index() == 0

    def train(
        self,
        feed: Feed,
        *,
        resume: bool = False,
        weights: Variables | None = None,
        devices: Sequence[Any] | None = None,
    ) -> TrainState:
        """Train to the end, or until Ctrl-C or SIGTERM, which save a checkpoint first.

        Args:
            feed: the batches.
            resume: go on from the newest whole checkpoint, if there is one.
            weights: to begin with, instead of random ones.
            devices: to share each batch; default: all.

        Returns:
            the last state.

        Raises:
            ValueError: the folder holds another run, or devices and batch do not fit.
            NonFiniteLossError: the last checkpoint is from before.
            KeyboardInterrupt: after Ctrl-C, when all is saved.
            SystemExit: after SIGTERM, likewise.
        """
        mesh = make_mesh(devices)
        check_batch_size(self.plan.config.optimizer.batch_size, mesh)
        self.check_folder(resume=resume)
        several = jax.process_count() > 1
        if several:  # nobody writes before all have looked
            multihost_utils.sync_global_devices("looked")
        start = self._start(resume, weights)
        first = int(start.step)
        if first == self.plan.num_steps:
            print(f"{self.folder}: the run has done all of its {first} steps", file=sys.stderr)
            return start
        if self.leads:
            self.folder.mkdir(parents=True, exist_ok=True)
            text = json.dumps(self._as_json(), indent=1)
            write_beside(self.folder / _PLAN, lambda path: path.write_text(text, encoding="utf-8"))
        step = jit_step(make_train_step(self.detector, self.plan.config, self.plan.sensor, self.optimizer), mesh)
        records = Records(self.folder, first_step=first) if self.leads else None
        saved = first if resume else -1

        def report(number: int, record: Record) -> None:
            if records is not None:
                samples = self.plan.config.optimizer.batch_size / max(float(record["seconds"]), 1e-9)  # type: ignore[arg-type]
                records.write(number, record | {"samples_per_second": samples})

        def pause(number: int, state: TrainState) -> None:
            nonlocal saved
            if not self.leads:
                return
            assert records is not None
            score = None
            if self._evaluates_at(number):
                score = self._evaluate(number, state, records)
            records.flush()
            self._save(state, score)
            saved = number

        with stop_requests(active=not several) as request, feed(first) as batches:

            def stopping(done: int) -> bool:
                if several:  # all stop after the same step, whichever of them was asked to
                    return multihost_utils.reached_preemption_sync_point(done)
                return request.signal is not None

            try:
                state = fit(
                    step,
                    replicate(start, mesh),
                    (dataclasses.replace(b, batch=shard_batch(b.batch, mesh)) for b in batches),
                    num_steps=self.plan.num_steps,
                    report=report,
                    pause_at=self._pauses_at,
                    pause=pause,
                    stopping=stopping,
                    log_every_s=10.0 if self.leads else float("inf"),
                )
            except NonFiniteLossError as error:
                kept = self.snapshots.paths()
                last = f"the last checkpoint is {kept[-1]}" if kept else "there is no checkpoint yet"
                raise NonFiniteLossError(f"{error}; {last}") from None
            finally:
                if records is not None:
                    records.close()
            done = int(state.step)
            if self.leads and saved != done:
                self._save(state, None)
        if self.leads:
            self.draw_curves()
        if done < self.plan.num_steps:
            print(f"stopped after step {done}, which is saved", file=sys.stderr)
            if request.signal == signal.SIGINT:
                raise KeyboardInterrupt
            raise SystemExit(128 + signal.SIGTERM)
        return state

    def check_folder(self, *, resume: bool) -> None:
        """The folder is free for this run, or holds it.

        Args:
            resume: it is to go on.

        Raises:
            ValueError: neither; for another plan with the first field that differs.
        """
        file = self.folder / _PLAN
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"{self.folder}: found a file, expected a folder")
        if not file.is_file():
            if resume:
                raise ValueError(f"{file}: found nothing, expected the run to go on with")
            return
        if not resume:
            raise ValueError(f"{self.folder}: holds a run, expected --resume or another folder")
        try:
            found = json.loads(file.read_text(encoding="utf-8"))
        except ValueError:
            raise ValueError(f"{file}: not JSON, expected the plan of a run") from None
        for name, (was, wanted) in _differences(found, self._as_json()):
            raise ValueError(
                f"{file}: {name}: was {was!r}, got {wanted!r}: a run goes on with the same plan alone"
            )

    def evaluate(self, variables: Variables, frames: FrameSet) -> dict[str, Any]:
        """The official summary over some frames, without attributes; ranges count from the sensor."""
        found, truths = [], []
        progress = Progress("test frames", len(frames))
        for index, frame in enumerate(frames.frame(i) for i in range(len(frames))):
            found.append(self.detections(variables, frame))
            truths.append(dataclasses.replace(frame, points=frame.points[:0]))
            progress.show(index + 1)
        return evaluate_frames(found, truths).summary

    def detections(self, variables: Variables, frame: Frame) -> Detections:
        """What a detector finds in a frame, as NumPy arrays."""
        cloud = make_cloud(frame.points, self.plan.sensor, size=self.plan.config.max_points, remove="none")
        return jax.tree.map(np.asarray, self.detect(variables, cloud.points, cloud.valid))

    def draw_curves(self) -> None:
        """The losses and, where there is one, the mean average precision over the steps."""
        from fcos_lidar_jax.visualization.curves import draw_curves

        lines = read_records(self.folder)
        parts = ("total", "classification", "l1", "iou", "iou_prediction")
        losses = {p: [(line["step"], line[f"loss/{p}"]) for line in lines if f"loss/{p}" in line] for p in parts}
        draw_curves(self.folder / "loss.png", losses, x_label="step", y_label="loss", title="training", log_y=True)
        scores = {
            label: [(line["step"], line[name]) for line in lines if name in line]
            for label, name in (("mAP", "test/mAP"), ("NDS", "test/NDS"))
        }
        if scores["mAP"]:
            draw_curves(self.folder / "scores.png", scores, x_label="step", y_label="", title="test frames")

    def _pauses_at(self, number: int) -> bool:
        return number % self.rhythm.save_every == 0 or self._evaluates_at(number)

    def _evaluates_at(self, number: int) -> bool:
        return self.tests is not None and (
            number % self.rhythm.evaluate_every == 0 or number == self.plan.num_steps
        )

    def _as_json(self) -> dict[str, Any]:
        plan = self.plan
        whole = {
            "config": config_to_json(plan.config),
            "sensor": sensor_to_json(plan.sensor),
            "num_steps": plan.num_steps,
            "seed": plan.seed,
            "data": plan.data,
        }
        return json.loads(json.dumps(whole))

    def _start(self, resume: bool, weights: Variables | None) -> TrainState:
        key = jax.random.key(self.plan.seed)
        ema = self.plan.config.optimizer.ema_decay > 0
        if resume:
            like = jax.eval_shape(lambda k: make_state(self.detector.init(k), self.optimizer, k, ema=ema), key)
            found = self.snapshots.newest(like)
            if found is not None:
                return found[1]
        variables = self.detector.init(key) if weights is None else weights
        return make_state(variables, self.optimizer, key, ema=ema)

    def _save(self, state: TrainState, score: float | None) -> None:
        local = jax.tree.map(lambda leaf: leaf.addressable_data(0), detection_variables(state))
        data = json.dumps(self.plan.data, sort_keys=True)
        checkpoint = Checkpoint(self.plan.config, self.plan.sensor, local, int(state.step), data, score)
        self.snapshots.save(checkpoint, state)

    def _evaluate(self, number: int, state: TrainState, records: Records) -> float:
        assert self.tests is not None
        local = jax.tree.map(lambda leaf: leaf.addressable_data(0), detection_variables(state))
        summary = self.evaluate(local, self.tests)
        score = summary["mean_ap"]
        values = {f"test/AP/{name}": value for name, value in summary["mean_dist_aps"].items()}
        records.write(number, {"test/mAP": score, "test/NDS": summary["nd_score"], **values})
        print(f"step {number}: mAP {score:.3f}, NDS {summary['nd_score']:.3f}", file=sys.stderr, flush=True)
        self._draw(number, local)
        return score

    def _draw(self, number: int, variables: Variables) -> None:
        from fcos_lidar_jax.visualization.bev import draw_bev

        assert self.tests is not None
        folder = self.folder / "pictures"
        folder.mkdir(exist_ok=True)
        for index in range(min(_NUM_PICTURES, len(self.tests))):
            frame = self.tests.frame(index)
            draw_bev(
                frame.points,
                folder / f"step_{number:06d}_frame_{index}.png",
                limit_m=self.plan.sensor.limit_xy_m,
                detections=confident(self.detections(variables, frame), _SHOWN_SCORE),
                truth=(frame.boxes, frame.labels),
                title=f"step {number}, test frame {index}: score {_SHOWN_SCORE} and more, truth dashed",
            )


def _differences(found: Any, wanted: Any, name: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    """Where two JSON values differ."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in sorted(found.keys() | wanted.keys()):
            yield from _differences(found.get(key), wanted.get(key), f"{name}.{key}" if name else key)
    elif found != wanted:
        yield name, (found, wanted)

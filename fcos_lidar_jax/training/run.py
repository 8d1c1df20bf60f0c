"""Training in the folder of a run, which can be stopped and resumed, with evaluations along the way.

The folder holds the specification ``run.json``, the metrics ``metrics.jsonl`` and ``tensorboard/``, the last and
the best of the ``checkpoints/``, ``pictures/`` of test frames, and the curves ``loss.png`` and ``scores.png``.
"""

import contextlib
import dataclasses
import json
import math
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from fcos_lidar_jax.checkpoints.preemption import StopRequest, stop_requests
from fcos_lidar_jax.checkpoints.storage import Checkpoint, NonFiniteStateError
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.class_mapping import MappedFrames
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.devices.agreement import agreed, check_same
from fcos_lidar_jax.devices.feeding import feed
from fcos_lidar_jax.devices.mesh import jit_step, make_mesh, replicate
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.files import atomic_write, checksum, folder_lock, local_path
from fcos_lidar_jax.inference.detector import TrainedDetector
from fcos_lidar_jax.inference.prediction import evaluate, predict
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase
from fcos_lidar_jax.input_pipeline.loader import make_batches
from fcos_lidar_jax.models import Variables
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.training.loop import NonFiniteLossError, Record, fit
from fcos_lidar_jax.training.metrics_log import MetricsLog, evaluated_steps, last_step
from fcos_lidar_jax.training.pictures import draw_metrics, draw_predictions
from fcos_lidar_jax.training.plan import RUN_SPEC, Run, Schedule, check_run, plan_run
from fcos_lidar_jax.training.step import detection_variables, make_state, make_train_step
from fcos_lidar_jax.types import HostBatch, TrainState

_NUM_PICTURES = 2  # number of test frames drawn at an evaluation
_STOPPING = "stopping after this step or evaluation, which is saved"

Hook = Callable[[int, Record], None]
"""Called with the number of steps and the metrics of the last one, or the scores of the evaluation after it."""


def train(
    config: Config,
    frames: FrameSet,
    out: str | Path,
    *,
    steps: int,
    seed: int = 0,
    tests: FrameSet | None = None,
    objects: GroundTruthDatabase | None = None,
    resume: bool = False,
    weights: str | Path | Variables | None = None,
    devices: Sequence[Any] | None = None,
    hooks: Sequence[Hook] = (),
    schedule: Schedule = Schedule(),
    threads: int | None = None,
    workers: int = 0,
    packing: bool | None = None,
) -> TrainState:
    """Train a detector and return the last state; Ctrl-C and SIGTERM save a checkpoint and stop.

    Args:
        frames: training frames; classes are matched to ``config.classes`` by name, and the detector is built for
            their sensor.
        steps: number of updates of the whole run.
        seed: seed of weights, order, pasted objects and augmentation.
        tests: frames to evaluate on during training.
        objects: ground-truth database for copy-paste; required unless ``config.copy_paste`` is None.
        resume: resume the same run from the newest intact checkpoint in the folder.
        weights: initial weights, as a checkpoint or arrays; random by default.
        devices: devices that share each batch; by default all.
        hooks: functions ``(number of steps, values)`` to call in every process: after every step with its metrics,
            and after every evaluation with the scores ``test/mAP`` and ``test/AP/CLASS``.
        schedule: when to save and evaluate.
        threads, workers: number of threads and additional processes that prepare batches; by default as many
            threads as ``input_pipeline.loader.default_threads`` returns, and no processes.
        packing: transfer batches to the devices in fewer bytes, with the same results, see
            :mod:`fcos_lidar_jax.packing`; by default unless the devices are CPUs.

    Raises:
        ValueError: the folder holds another run, no class is shared, the devices cannot share the batch, steps or
            seed are out of range, the augmentation does not suit the sector of the sensor, see
            :func:`fcos_lidar_jax.augment.check_augmentation`, or processes have different runs or data.
        OSError: another process trains in the folder, or writing failed.
        NonFiniteLossError, NonFiniteStateError: a value is not finite; earlier checkpoints remain.
        KeyboardInterrupt: after Ctrl-C, once the state is saved; before the first step, nothing is saved.
        SystemExit: after SIGTERM, once the state is saved; both also if the signal came during the last step.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> from fcos_lidar_jax.simulation.frame_set import fresh_streets
    >>> config, frames = fresh_streets(QUICKSTART, steps=500)
    >>> train(dataclasses.replace(config, classes=("boat",)), frames, "run", steps=500)
    Traceback (most recent call last):
    ValueError: ...
    """
    check(isinstance(config, Config), "config", config, "a Config, such as presets.COMPACT")
    check(isinstance(schedule, Schedule), "schedule", schedule, "a Schedule")
    mesh = make_mesh(devices)
    is_main_process, several = jax.process_index() == 0, jax.process_count() > 1
    with agreed("cannot train"):
        run = plan_run(
            config,
            MappedFrames(frames, config.classes),
            local_path(out),
            mesh,
            steps=steps,
            seed=seed,
            tests=None if tests is None else MappedFrames(tests, config.classes),
            objects=objects,
            resume=resume,
            weights=weights,
            devices=devices,
            schedule=schedule,
            threads=threads,
            workers=workers,
            packing=packing,
        )
    packed = None if run.packing is None else dataclasses.asdict(run.packing)
    program = json.dumps([run.spec, packed], sort_keys=True)
    check_same(checksum(program.encode()), "configuration, data or packing")
    with contextlib.ExitStack() as held:
        with agreed("cannot train"):
            if is_main_process:
                held.enter_context(run_folder(run.folder, run.spec, resume=resume))
        with agreed("cannot train"):
            start = _start(run, resume=resume)
            first = int(start.step)
            pending = run.evaluation_pending(first)
        # Processes that see other checkpoints, as in folders of their own, would train different networks.
        check_same(checksum(f"{first} {pending}".encode()), "checkpoint to resume from")
        if first == steps and not pending:
            tell(f"{run.folder}: the run is complete, with {first} steps")
            return start
        log = MetricsLog(run.folder, first_step=first) if is_main_process else None
        if log is not None:
            held.callback(log.close)
        for line in run.warnings:
            tell(f"warning: {line}")
        if resume:
            tell(f"{run.folder}: resuming after step {first}")
        tell("compiling the training step: a minute or more on a CPU")
        batches = make_batches(
            run.frames,
            config,
            seed=seed,
            num_steps=steps,
            first_step=first,
            objects=objects,
            process_index=jax.process_index(),
            num_processes=jax.process_count(),
            threads=threads,
            workers=workers,
            packing=run.packing,
            lend=True,
            order=run.order,
        )
        request: StopRequest | None = None  # none while the first step is compiled: there is nothing to save
        with contextlib.ExitStack() as asked, batches as prepared, feed(prepared, mesh) as stream:

            def stopping(done: int) -> bool:
                nonlocal request
                if several:  # all stop after the same step, whichever of them received the signal
                    return multihost_utils.reached_preemption_sync_point(done)
                request = request or asked.enter_context(stop_requests(_STOPPING))
                return request.signal is not None

            state = _take_steps(run, mesh, start, stream, pending, log, hooks, stopping)
        if is_main_process:
            draw_metrics(run.folder)
    stopped_by = None if request is None else request.signal
    if (done := int(state.step)) < steps or stopped_by is not None:
        tell(f"stopped after step {done}, which is saved")
        if stopped_by == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + signal.SIGTERM)
    return state


def _take_steps(
    run: Run,
    mesh: Mesh,
    start: TrainState,
    batches: Iterable[HostBatch],
    pending: bool,
    log: MetricsLog | None,
    hooks: Sequence[Hook],
    stopping: Callable[[int], bool],
) -> TrainState:
    """Take the remaining steps of a run and return the last state; the process with a log saves and records.

    ``pending`` tells whether the evaluation of the first state is missing.
    """
    batch_size, stop = run.detector.config.optimizer.batch_size, False

    def report(number: int, record: Record) -> None:
        if log is not None:
            samples = batch_size / max(float(record["seconds"]), 1e-9)  # type: ignore[arg-type]
            log.write(number, record | {"samples_per_second": samples})
        _call(hooks, number, record)

    def pause(number: int, state: TrainState) -> None:
        if log is not None:
            log.flush()
            _save(run, state)  # before the evaluation, which may take long
        if run.evaluates_at(number) and not (stop and number < run.num_steps):  # resuming evaluates
            _call(hooks, number, _evaluate(run, number, state, log))

    def stops(number: int) -> bool:
        nonlocal stop
        stop = stopping(number)
        return stop

    try:
        state = replicate(start, mesh)
        if pending:
            _call(hooks, int(start.step), _evaluate(run, int(start.step), state, log))
        state = fit(
            jit_step(make_train_step(run.detector, run.optimizer), mesh),
            state,
            batches,
            num_steps=run.num_steps,
            report=report,
            pause_at=run.saves_at,
            pause=pause,
            stopping=stops,
            log_every_s=math.inf if log is None else 10.0,
        )
        if log is not None and not run.saves_at(int(state.step)):
            _save(run, state)
        return state
    except (NonFiniteLossError, NonFiniteStateError) as error:
        saved = run.checkpoints.paths()
        last = f"the last checkpoint is {saved[-1]}" if saved else "there is no checkpoint yet"
        raise type(error)(f"{error}; {last}") from None


def _call(hooks: Sequence[Hook], number: int, values: Record) -> None:
    for hook in hooks:
        hook(number, values)


@contextlib.contextmanager
def run_folder(folder: Path, spec: dict[str, Any] | None = None, *, resume: bool) -> Iterator[None]:
    """Lock the folder of a run against other processes; with ``spec``, make it the folder of that run.

    Errors of :func:`~fcos_lidar_jax.training.plan.check_run` are raised before anything is written.
    """
    check_run(folder, spec, resume=resume)  # before the lock, which makes the folder
    with folder_lock(folder, "training"):
        check_run(folder, spec, resume=resume)  # another process may have been faster
        if spec is not None and not resume:
            text = json.dumps(spec, indent=1)
            atomic_write(folder / RUN_SPEC, lambda path: path.write_text(text, encoding="utf-8"))
        yield


def _start(run: Run, *, resume: bool) -> TrainState:
    """The state of the newest checkpoint, or a new state with initial weights."""
    key = jax.random.key(run.seed)
    if resume:
        like = jax.eval_shape(lambda k: make_state(run.detector, run.optimizer, k), key)
        if (newest := run.checkpoints.newest(like)) is not None:
            return newest[1]
        # Only a run that was killed before its first checkpoint begins again; the metrics of others would be lost.
        # A recorded evaluation comes after a checkpoint.
        first = next(filter(run.saves_at, range(1, run.num_steps)), run.num_steps)
        if (done := last_step(run.folder)) > first or evaluated_steps(run.folder):
            found = f"found none, but metrics of {done} steps, and this schedule saves step {first}"
            expected = "the checkpoints of the run, or the schedule that it began with"
            raise ValueError(f"{run.checkpoints.folder}: {found}: expected {expected}")
    return make_state(run.detector, run.optimizer, key, variables=run.weights)


def _evaluate(run: Run, number: int, state: TrainState, log: MetricsLog | None) -> Record:
    """Evaluate on the test frames in all processes and return the scores; the main process draws and records."""
    assert run.tests is not None
    trained = TrainedDetector(run.detector, _local_variables(state))
    summary = evaluate(trained, run.tests, devices=run.devices).summary
    score = summary["mean_ap"]
    scores: Record = {"test/mAP": score}
    scores |= {f"test/AP/{name}": value for name, value in summary["mean_dist_aps"].items()}
    first = range(min(_NUM_PICTURES, len(run.tests)))
    examples = list(predict(trained, run.tests, indices=first, devices=run.devices))
    if log is not None:
        tell(f"step {number}: mAP by centre distance {score:.3f}")
        prefix, title = f"step_{number:06d}_frame", f"step {number}, test frame"
        pictures = draw_predictions(run.folder / "pictures", examples, run.tests, prefix=prefix, title=title)
        log.write_pictures(number, pictures)
        if not math.isnan(score):
            run.checkpoints.record_score(number, score)
        log.write(number, scores)  # last, because a recorded evaluation is not repeated
    return scores


def _save(run: Run, state: TrainState) -> None:
    data = json.dumps({name: run.spec[name] for name in ("data", "frames", "weights")}, sort_keys=True)
    config, sensor = run.detector.config, run.detector.sensor
    checkpoint = Checkpoint(config, sensor, _local_variables(state), int(state.step), data)
    run.checkpoints.save(checkpoint, state)


def _local_variables(state: TrainState) -> Variables:
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), detection_variables(state))

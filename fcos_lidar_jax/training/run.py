"""Training in the folder of a run, which can be stopped and resumed, with evaluations along the way.

The folder holds the specification ``run.json``, the metrics ``metrics.jsonl`` and ``tensorboard/``, the last and
the best of the ``checkpoints/``, ``pictures/`` of test frames, and the curves ``loss.png`` and ``scores.png``.
"""

import contextlib
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
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.devices.agreement import agreed, check_same
from fcos_lidar_jax.devices.feeding import feed
from fcos_lidar_jax.devices.mesh import jit_step, make_mesh, replicate
from fcos_lidar_jax.files import atomic_write, checksum, folder_lock
from fcos_lidar_jax.inference.detector import TrainedDetector
from fcos_lidar_jax.inference.prediction import evaluate, predict
from fcos_lidar_jax.input_pipeline.loader import make_batches
from fcos_lidar_jax.models import Variables
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.training.loop import NonFiniteLossError, Record, fit
from fcos_lidar_jax.training.metrics_log import MetricsLog, evaluated_steps, last_step
from fcos_lidar_jax.training.pictures import draw_metrics, draw_predictions
from fcos_lidar_jax.training.plan import RUN_SPEC, Hook, Run, RunSpec, check_run, plan_run
from fcos_lidar_jax.training.step import detection_variables, make_state, make_train_step
from fcos_lidar_jax.types import HostBatch, TrainState

_NUM_PICTURES = 2  # number of test frames drawn at an evaluation
_STOPPING = "stopping after this step or evaluation, which is saved"


def train(config: Config, frames: FrameSet, out: str | Path, **options: Any) -> TrainState:
    """Train a detector and return the last state; Ctrl-C and SIGTERM save a checkpoint and stop.

    Args:
        config, frames, out, options: the fields of :class:`~fcos_lidar_jax.training.RunSpec`; ``steps`` is
            required.

    Raises:
        ValueError: the folder holds another run, no class is shared, the devices cannot share the batch, steps or
            seed are out of range, the augmentation does not suit the sector of the sensor, see
            :func:`fcos_lidar_jax.augment.check_augmentation`, or processes have different runs or data.
        OSError: another process trains in the folder, or writing failed.
        NonFiniteLossError, NonFiniteStateError: a value is not finite; earlier checkpoints remain.
        KeyboardInterrupt: after Ctrl-C, once the state is saved; before the first step, nothing is saved.
        SystemExit: after SIGTERM, once the state is saved; both also if the signal came during the last step.
    """
    with agreed("cannot train"):
        spec = RunSpec(config, frames, Path(out), **options)
        mesh = make_mesh(spec.devices)
        run = plan_run(spec, mesh)
    check_same(checksum(json.dumps(run.record, sort_keys=True).encode()), "configuration or data")
    is_main_process = jax.process_index() == 0
    with contextlib.ExitStack() as held:
        with agreed("cannot train"):
            if is_main_process:
                held.enter_context(run_folder(spec.out, run.record, resume=spec.resume))
                if not spec.resume:
                    atomic_write(spec.out / RUN_SPEC, json.dumps(run.record, indent=1))
        with agreed("cannot train"):
            start = _start(run)
            first = int(start.step)
            pending = run.evaluation_pending(first)
        # Processes that see other checkpoints, as in folders of their own, would train different networks.
        check_same(checksum(f"{first} {pending}".encode()), "checkpoint to resume from")
        if first == spec.steps and not pending:
            tell(f"{spec.out}: the run is complete, with {first} steps")
            if is_main_process:
                draw_metrics(spec.out)  # a run that was ended while it drew may lack them
            return start
        log = MetricsLog(spec.out, first_step=first) if is_main_process else None
        if log is not None:
            held.callback(log.close)
        state, stopped_by = _train(run, mesh, start, pending, log)
        if is_main_process:
            draw_metrics(spec.out)
    if (done := int(state.step)) < spec.steps or stopped_by is not None:
        tell(f"stopped after step {done}, which is saved")
        if stopped_by == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + signal.SIGTERM)
    return state


def _train(
    run: Run, mesh: Mesh, start: TrainState, pending: bool, log: MetricsLog | None
) -> tuple[TrainState, int | None]:
    """Train from a state to the end, or until a signal asks to stop; also returns the signal."""
    spec, several = run.spec, jax.process_count() > 1
    for line in run.warnings:
        tell(f"warning: {line}")
    if spec.resume:
        tell(f"{spec.out}: resuming after step {int(start.step)}")
    tell("compiling the training step: a minute or more on a CPU")
    batches = make_batches(
        spec.frames,
        spec.config,
        seed=spec.seed,
        num_steps=spec.steps,
        first_step=int(start.step),
        objects=spec.objects,
        process_index=jax.process_index(),
        num_processes=jax.process_count(),
        threads=spec.threads,
        workers=spec.workers,
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

        state = _take_steps(run, mesh, start, stream, pending, log, stopping)
    return state, None if request is None else request.signal


def _take_steps(
    run: Run,
    mesh: Mesh,
    start: TrainState,
    batches: Iterable[HostBatch],
    pending: bool,
    log: MetricsLog | None,
    stopping: Callable[[int], bool],
) -> TrainState:
    """Take the remaining steps of a run and return the last state; the process with a log saves and records.

    ``pending`` tells whether the evaluation of the first state is missing.
    """
    spec, stop = run.spec, False
    batch_size = spec.config.optimizer.batch_size

    def report(number: int, record: Record) -> None:
        if log is not None:
            samples = batch_size / max(float(record["seconds"]), 1e-9)  # type: ignore[arg-type]
            log.write(number, record | {"samples_per_second": samples})
        _call(spec.hooks, number, record)

    def pause(number: int, state: TrainState) -> None:
        if log is not None:
            log.flush()
            _save(run, state)  # before the evaluation, which may take long
        if spec.evaluates_at(number) and not (stop and number < spec.steps):  # resuming evaluates
            _call(spec.hooks, number, _evaluate(run, number, state, log))

    def stops(number: int) -> bool:
        nonlocal stop
        stop = stopping(number)
        return stop

    try:
        state = replicate(start, mesh)
        if pending:
            _call(spec.hooks, int(start.step), _evaluate(run, int(start.step), state, log))
        state = fit(
            jit_step(make_train_step(run.detector, run.optimizer), mesh),
            state,
            batches,
            num_steps=spec.steps,
            report=report,
            pause_at=spec.saves_at,
            pause=pause,
            stopping=stops,
            log_every_s=math.inf if log is None else 10.0,
        )
        if log is not None and not spec.saves_at(int(state.step)):
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
def run_folder(folder: Path, spec: dict[str, Any], *, resume: bool) -> Iterator[None]:
    """Lock the folder of a run, of which ``spec`` has fields of ``run.json``, against other processes.

    Errors of :func:`~fcos_lidar_jax.training.plan.check_run` are raised before anything is written.
    """
    check_run(folder, spec, resume=resume)  # before the lock, which makes the folder
    with folder_lock(folder, "training"):
        check_run(folder, spec, resume=resume)  # another process may have been faster
        yield


def _start(run: Run) -> TrainState:
    """The state of the newest checkpoint, or a new state with initial weights."""
    spec, key = run.spec, jax.random.key(run.spec.seed)
    if spec.resume:
        like = jax.eval_shape(lambda k: make_state(run.detector, run.optimizer, k), key)
        if (newest := run.checkpoints.newest(like)) is not None:
            return newest
        # Only a run that was killed before its first checkpoint begins again; the metrics of others would be lost.
        # A recorded evaluation comes after a checkpoint.
        first = next(filter(spec.saves_at, range(1, spec.steps)), spec.steps)
        if (done := last_step(spec.out)) > first or evaluated_steps(spec.out):
            found = f"found none, but metrics of {done} steps, and this schedule saves step {first}"
            expected = "the checkpoints of the run, or the schedule that it began with"
            raise ValueError(f"{run.checkpoints.folder}: {found}: expected {expected}")
    return make_state(run.detector, run.optimizer, key, variables=run.weights)


def _evaluate(run: Run, number: int, state: TrainState, log: MetricsLog | None) -> Record:
    """Evaluate on the test frames in all processes and return the scores; the main process draws and records."""
    tests, devices = run.spec.tests, run.spec.devices
    assert tests is not None
    trained = TrainedDetector(run.detector, _local_variables(state))
    summary = evaluate(trained, tests, devices=devices).summary
    score = summary["mean_ap"]
    scores: Record = {"test/mAP": score}
    scores |= {f"test/AP/{name}": value for name, value in summary["mean_dist_aps"].items()}
    first = range(min(_NUM_PICTURES, len(tests)))
    examples = list(predict(trained, tests, indices=first, devices=devices))
    if log is not None:
        tell(f"step {number}: mAP by centre distance {score:.3f}")
        pictures = draw_predictions(run.spec.out / "pictures", examples, tests, number)
        log.write_pictures(number, pictures)
        if not math.isnan(score):
            run.checkpoints.record_score(number, score)
        log.write(number, scores)  # last, because a recorded evaluation is not repeated
    return scores


def _save(run: Run, state: TrainState) -> None:
    data = json.dumps({name: run.record[name] for name in ("data", "frames", "weights")}, sort_keys=True)
    config, sensor = run.detector.config, run.detector.sensor
    checkpoint = Checkpoint(config, sensor, _local_variables(state), int(state.step), data)
    run.checkpoints.save(checkpoint, state)


def _local_variables(state: TrainState) -> Variables:
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), detection_variables(state))

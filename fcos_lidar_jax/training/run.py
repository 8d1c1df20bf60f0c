"""Training as a run in a folder: begun, stopped, resumed, evaluated along the way.

``run.json`` is the run's specification, ``metrics.jsonl`` and ``tensorboard/`` hold the metrics, ``checkpoints/``
the last checkpoints and the best one, ``pictures/`` some test frames at every evaluation, ``loss.png`` and
``scores.png`` the curves.
"""

import contextlib
import dataclasses
import json
import math
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from fcos_lidar_jax.augment import check_augmentation
from fcos_lidar_jax.checkpoints.preemption import stop_requests
from fcos_lidar_jax.checkpoints.retention import CHECKPOINTS, Checkpoints, find_checkpoint
from fcos_lidar_jax.checkpoints.storage import (
    Checkpoint,
    CheckpointError,
    NonFiniteStateError,
    check_arrays,
    load_checkpoint,
    with_later_fields,
)
from fcos_lidar_jax.config import Config, config_to_json
from fcos_lidar_jax.data.class_mapping import MappedFrames
from fcos_lidar_jax.data.cloud_policy import sensor_mismatch
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.devices.agreement import agreed, check_same
from fcos_lidar_jax.devices.mesh import check_batch_size, jit_step, make_mesh, replicate
from fcos_lidar_jax.devices.transfer import feed
from fcos_lidar_jax.files import atomic_write, checksum, folder_lock, read_json
from fcos_lidar_jax.inference.detector import TrainedDetector
from fcos_lidar_jax.inference.prediction import evaluate, predict
from fcos_lidar_jax.input_pipeline.batching import check_counts
from fcos_lidar_jax.input_pipeline.copy_paste import make_paste
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase
from fcos_lidar_jax.input_pipeline.loader import check_loader_options, make_batches, packing_for
from fcos_lidar_jax.models import Detector, Variables, build_detector
from fcos_lidar_jax.sensors import sensor_to_json
from fcos_lidar_jax.training.loop import NonFiniteLossError, Record, fit
from fcos_lidar_jax.training.metrics_log import MetricsLog, evaluated_steps
from fcos_lidar_jax.training.optimizer import make_optimizer
from fcos_lidar_jax.training.pictures import draw_metrics, draw_predictions
from fcos_lidar_jax.training.step import detection_variables, make_state, make_train_step
from fcos_lidar_jax.types import TrainState

_NUM_PICTURES = 2  # Test frames that are drawn at an evaluation.
_LATER_FIELDS = ("ground_truth_database", "tests")  # that the specification did not have at first
NUM_SEEDS = 2**32  # JAX keeps 32 bits of a seed: larger ones would be others' again.
RUN_SPEC = "run.json"  # Name of the file in a run's folder that says what the run is.

Hook = Callable[[int, Record], None]  # Called with (steps done, metrics of the last of them) after every step.


@dataclasses.dataclass(frozen=True)
class Schedule:
    """When a run saves and evaluates.

    >>> Schedule(save_every=100).keep
    2
    """

    save_every: int | None = None  # Steps between two checkpoints; default: a fiftieth of the run.
    evaluate_every: int | None = None
    """Steps between two evaluations; each saves a checkpoint, too; default: a tenth of the run."""
    keep: int = 2  # Newest checkpoints that are kept, beside the best.

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is not None and (type(value) is not int or value < 1):
                raise ValueError(f"schedule.{field.name}: got {value!r}, expected an integer of at least 1")


@dataclasses.dataclass(frozen=True)
class _Run:
    """What stays the same through a run."""

    folder: Path
    detector: Detector
    schedule: Schedule
    num_steps: int
    tests: FrameSet | None
    devices: Sequence[Any] | None
    spec: dict[str, Any]

    def evaluation_pending(self, step: int) -> bool:
        """Whether a run was stopped during the evaluation after a step, whose record is written last."""
        return step > 0 and self.evaluates_at(step) and step not in evaluated_steps(self.folder)

    @property
    def checkpoints(self) -> Checkpoints:
        return Checkpoints(self.folder / CHECKPOINTS, keep=self.schedule.keep)

    def evaluates_at(self, step: int) -> bool:
        every = self.schedule.evaluate_every or -(-self.num_steps // 10)
        return self.tests is not None and (step % every == 0 or step == self.num_steps)

    def saves_at(self, step: int) -> bool:
        return step % (self.schedule.save_every or -(-self.num_steps // 50)) == 0 or self.evaluates_at(step)


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
    """Train to the end, or until Ctrl-C or SIGTERM, which save a checkpoint first.

    Args:
        config: what to train.
        frames: to train on; their classes are matched to ``config.classes`` by name, and their sensor is the
            detector's.
        out: folder of the run.
        steps: updates of the whole run.
        seed: of weights, order, pasted objects and augmentation.
        tests: frames to evaluate on along the way.
        objects: ground-truth database for copy-paste; needed unless ``config.copy_paste`` is None.
        resume: from the newest whole checkpoint in the folder; the run must be the same.
        weights: to begin with, instead of random ones: a checkpoint, or arrays.
        devices: to share each batch; default: all.
        hooks: called after every step.
        schedule: when to save and to evaluate.
        threads, workers: threads that prepare batches, and processes beside them; default: as many threads as
            ``input_pipeline.loader.default_threads`` says, and no processes.
        packing: whether batches travel to the devices in fewer bytes, see :mod:`fcos_lidar_jax.packing`; the
            results are the same. Default: unless the devices are CPUs.

    Returns:
        the last state.

    Raises:
        ValueError: the folder holds another run, no class is shared, devices and batch do not fit, steps or seed
            are out of range, or the augmentation does not suit the sector that the sensor covers, see
            :func:`fcos_lidar_jax.augment.check_augmentation`; or processes were given different runs or data.
        OSError: another process trains in the folder, or it cannot be written.
        NonFiniteLossError, NonFiniteStateError: the last checkpoint is from before.
        KeyboardInterrupt: after Ctrl-C, when all is saved.
        SystemExit: after SIGTERM, likewise.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> from fcos_lidar_jax.simulation.frame_set import fresh_streets
    >>> config, frames = fresh_streets(QUICKSTART, steps=500)
    >>> train(dataclasses.replace(config, classes=("boat",)), frames, "run", steps=500)
    Traceback (most recent call last):
    ValueError: ...
    """
    frames = MappedFrames(frames, config.classes)
    tests = None if tests is None else MappedFrames(tests, config.classes)
    mesh = make_mesh(devices)
    is_main_process, several = jax.process_index() == 0, jax.process_count() > 1
    with agreed("cannot train"):  # What can be refused is refused before the folder becomes a run's.
        if type(steps) is not int or steps < 1:
            raise ValueError(f"steps: got {steps!r}, expected an integer of at least 1")
        if type(seed) is not int or not 0 <= seed < NUM_SEEDS:
            raise ValueError(f"seed: got {seed!r}, expected an integer from 0 to {NUM_SEEDS - 1}")
        if not len(frames):
            raise ValueError("training frames: got none, expected at least one")
        check_counts(frames)
        check_batch_size(config.optimizer.batch_size, mesh)
        check_loader_options(config, objects, threads=threads, workers=workers, num_processes=jax.process_count())
        if config.augment is not None:
            check_augmentation(config.augment, frames.sensor)
        # What the run follows from: only the same can be resumed. Weights given as arrays are not recorded.
        spec = {
            "config": config_to_json(config),
            "sensor": sensor_to_json(frames.sensor),
            "steps": steps,
            "seed": seed,
            "frames": len(frames),
            "data": frames.fingerprint(),
            "tests": None if tests is None else tests.fingerprint(),
            "objects": None if objects is None else objects.manifest.source,
            "ground_truth_database": None if objects is None else objects.fingerprint(),
            "weights": str(weights) if isinstance(weights, str | Path) else None,
        }
        spec, detector = json.loads(json.dumps(spec)), build_detector(config, frames.sensor)
        run = _Run(Path(out), detector, schedule, steps, tests, devices, spec)
        check_run(run.folder, run.spec, resume=resume)
        given = weights if resume else _given_weights(run.detector, weights)  # needed where no checkpoint is yet
        optimizer = make_optimizer(config.optimizer, steps)
        jax.eval_shape(lambda key: make_state(run.detector, optimizer, key), jax.random.key(seed))
        if config.copy_paste is not None and objects is not None:
            make_paste(objects, config)
        mismatch = sensor_mismatch(frames.frame(0).points, frames.sensor)
        single = config.num_sweeps > 1 and _of_one_sweep(frames)
        on_cpus = mesh.devices.flat[0].platform == "cpu"
        packed = packing_for(frames, config) if packing or (packing is None and not on_cpus) else None
    program = json.dumps([spec, None if packed is None else dataclasses.asdict(packed)], sort_keys=True)
    check_same(checksum(program.encode()), "configuration, data or packing")
    with _claimed(run, resume=resume):
        start = _start(run, optimizer, seed, resume, given)
        first = int(start.step)
        pending = run.evaluation_pending(first)
        if first == steps and not pending:
            print(f"{run.folder}: the run has done all of its {first} steps", file=sys.stderr)
            return start
        step = jit_step(make_train_step(run.detector, optimizer), mesh)
        metrics = MetricsLog(run.folder, first_step=first) if is_main_process else None
        if is_main_process:
            if mismatch:
                print(f"warning: {frames.name(0)}: {mismatch}", file=sys.stderr, flush=True)
            if single:
                print(
                    f"warning: num_sweeps: got {config.num_sweeps}, but the frames hold one sweep each: expected "
                    "1, for `stream` will fuse as many, which the detector has not seen",
                    file=sys.stderr,
                    flush=True,
                )
            print("compiling the training step: a minute or more on a CPU", file=sys.stderr, flush=True)

        def report(number: int, record: Record) -> None:
            if metrics is not None:
                samples = config.optimizer.batch_size / max(float(record["seconds"]), 1e-9)  # type: ignore[arg-type]
                metrics.write(number, record | {"samples_per_second": samples})
            for hook in hooks:
                hook(number, record)

        def pause(number: int, state: TrainState) -> None:
            if metrics is not None:
                metrics.flush()
                _save(run, state)  # What is done is safe before an evaluation, which may take long.
            if run.evaluates_at(number):
                _evaluate(run, number, state, metrics)

        processes = {"process_index": jax.process_index(), "num_processes": jax.process_count()}
        helpers: dict[str, Any] = {"threads": threads, "workers": workers, "packing": packed, **processes}
        batches = make_batches(
            frames, config, seed=seed, num_steps=steps, first_step=first, objects=objects, lend=True, **helpers
        )
        with stop_requests(active=not several) as request, batches as prepared, feed(prepared, mesh) as stream:

            def stopping(done: int) -> bool:
                if several:  # all stop after the same step, whichever of them was asked to
                    return multihost_utils.reached_preemption_sync_point(done)
                return request.signal is not None

            try:
                state = replicate(start, mesh)
                if pending:
                    _evaluate(run, first, state, metrics)
                state = fit(
                    step,
                    state,
                    stream,
                    num_steps=steps,
                    report=report,
                    pause_at=run.saves_at,
                    pause=pause,
                    stopping=stopping,
                    log_every_s=10.0 if is_main_process else math.inf,
                )
                done = int(state.step)
                if is_main_process and not run.saves_at(done):
                    _save(run, state)
            except (NonFiniteLossError, NonFiniteStateError) as error:
                kept = run.checkpoints.paths()
                last = f"the last checkpoint is {kept[-1]}" if kept else "there is no checkpoint yet"
                raise type(error)(f"{error}; {last}") from None
            finally:
                if metrics is not None:
                    metrics.close()
        if is_main_process:
            draw_metrics(run.folder)
    if done < steps:
        print(f"stopped after step {done}, which is saved", file=sys.stderr)
        if request.signal == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + signal.SIGTERM)
    return state


def _of_one_sweep(frames: FrameSet) -> bool:
    """Whether none of some frames, spread over the set, has points of an older sweep."""
    looked_at = np.unique(np.linspace(0, len(frames) - 1, 5).round().astype(int))
    return all(len(np.unique(frames.frame(int(i)).points[:, 4])) <= 1 for i in looked_at)


def check_run(folder: str | Path, spec: dict[str, Any] | None = None, *, resume: bool) -> list[str]:
    """Refuse a folder that cannot take a run.

    Args:
        folder: of the run.
        spec: what ``run.json`` must hold; None to check only whether there is a run.
        resume: the run is to be resumed.

    Returns:
        fields of the specification that an older run does not have, and that were not compared.

    Raises:
        ValueError: there is a run and it is not to be resumed, or none to resume, or another one, with the first
            field that differs.
    """
    folder = Path(folder)
    file = folder / RUN_SPEC
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: found a file, expected a folder")
    if not file.is_file():
        if resume:
            raise ValueError(f"{file}: found nothing, expected the run to resume")
        return []
    if not resume:
        raise ValueError(f"{folder}: holds a run, expected --resume or another folder")
    found = read_json(file, dict[str, Any], what="the specification of a run")
    if spec is None:
        return []
    missing = [name for name in _LATER_FIELDS if name in spec and name not in found]
    found |= {name: spec[name] for name in missing}
    if isinstance(config := found.get("config"), dict):
        found["config"] = with_later_fields(config)
    for name, (was, wanted) in _differences(found, spec):
        raise ValueError(f"{file}: {name}: was {was!r}, got {wanted!r}: only the same run can be resumed")
    return missing


@contextlib.contextmanager
def _claimed(run: _Run, *, resume: bool) -> Iterator[None]:
    """Hold the run's folder in the main process; the others continue only when it does."""
    with contextlib.ExitStack() as held:
        error: Exception | None = None
        if jax.process_index() == 0:
            try:
                held.enter_context(folder_lock(run.folder, "training"))
                missing = check_run(run.folder, run.spec, resume=resume)  # another process may have been faster
                if missing:
                    print(f"{run.folder}: an older run, without {', '.join(missing)} to compare", file=sys.stderr)
                text = json.dumps(run.spec, indent=1)
                if not resume:
                    atomic_write(run.folder / RUN_SPEC, lambda path: path.write_text(text, encoding="utf-8"))
            except (OSError, ValueError) as failure:
                error = failure
        if jax.process_count() > 1 and not multihost_utils.broadcast_one_to_all(np.array(error is None)):
            error = error or OSError(f"{run.folder}: the main process cannot work there")
        if error is not None:
            raise error
        yield


def _given_weights(detector: Detector, weights: str | Path | Variables | None) -> Variables | None:
    if not isinstance(weights, str | Path):
        return weights
    folder = find_checkpoint(Path(weights))
    checkpoint = load_checkpoint(folder)
    theirs, ours = checkpoint.config.classes, detector.config.classes
    if theirs != ours:
        raise CheckpointError(f"{folder}: classes: got {theirs}, expected {ours}, which are to be trained")
    expected = jax.eval_shape(detector.init, jax.random.key(0))
    check_arrays(folder, expected, checkpoint.variables, whose="the network that is to be trained")
    # Arrays of the same shapes may still mean something else.
    given, wanted = (config_to_json(config)["model"] for config in (checkpoint.config, detector.config))
    if jax.process_index() == 0:
        for name, (theirs, ours) in _differences(given, wanted, "model"):
            print(
                f"{folder}: weights of {name} {theirs!r}, to be trained with {ours!r}", file=sys.stderr, flush=True
            )
    return checkpoint.variables


def _start(
    run: _Run, optimizer: Any, seed: int, resume: bool, weights: str | Path | Variables | None
) -> TrainState:
    """The state of the newest checkpoint, or one of given or random weights."""
    key = jax.random.key(seed)
    if resume:
        like = jax.eval_shape(lambda k: make_state(run.detector, optimizer, k), key)
        found = run.checkpoints.newest(like)
        if found is not None:
            return found[1]
    return make_state(run.detector, optimizer, key, variables=_given_weights(run.detector, weights))


def _evaluate(run: _Run, number: int, state: TrainState, metrics: MetricsLog | None) -> None:
    """Score on the test frames, which all processes share; the main process draws, saves and records."""
    assert run.tests is not None
    trained = TrainedDetector(run.detector, _local_variables(state))
    summary = evaluate(trained, run.tests, devices=run.devices).summary
    score = summary["mean_ap"]
    first = range(min(_NUM_PICTURES, len(run.tests)))
    shown = list(predict(trained, run.tests, indices=first, devices=run.devices))
    if metrics is not None:
        print(f"step {number}: mAP by centre distance {score:.3f}", file=sys.stderr, flush=True)
        draw_predictions(run.folder / "pictures", shown, run.tests, number)
        if not math.isnan(score):
            run.checkpoints.record_score(number, score)
        values = {f"test/AP/{name}": value for name, value in summary["mean_dist_aps"].items()}
        metrics.write(number, {"test/mAP": score, **values})  # Last: what is recorded is not done again.


def _save(run: _Run, state: TrainState) -> None:
    data = json.dumps({name: run.spec[name] for name in ("data", "frames", "weights")}, sort_keys=True)
    config, sensor = run.detector.config, run.detector.sensor
    checkpoint = Checkpoint(config, sensor, _local_variables(state), int(state.step), data)
    run.checkpoints.save(checkpoint, state)


def _local_variables(state: TrainState) -> Variables:
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), detection_variables(state))


def _differences(found: Any, wanted: Any, name: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    """Where two JSON values differ."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in sorted(found.keys() | wanted.keys()):
            yield from _differences(found.get(key), wanted.get(key), f"{name}.{key}" if name else key)
    elif found != wanted:
        yield name, (found, wanted)

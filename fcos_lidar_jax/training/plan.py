"""The plan of a run: checks all inputs, and the folder, before anything is written to it."""

import dataclasses
import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from fcos_lidar_jax.augment import check_augmentation
from fcos_lidar_jax.checkpoints.retention import CHECKPOINTS, Checkpoints, find_checkpoint
from fcos_lidar_jax.checkpoints.storage import by_name, check_arrays, read_checkpoint
from fcos_lidar_jax.config import Config, config_to_json
from fcos_lidar_jax.data.class_mapping import MappedFrames
from fcos_lidar_jax.data.cloud_policy import sensor_mismatch
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.point_files import check_num_lags
from fcos_lidar_jax.fields import Bounds, Checked, Count, check
from fcos_lidar_jax.files import local_path, read_json
from fcos_lidar_jax.inference.detector import TrainedDetector
from fcos_lidar_jax.input_pipeline.copy_paste import make_paste
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase
from fcos_lidar_jax.input_pipeline.loader import SampleOrder, check_loader_options
from fcos_lidar_jax.models import Detector, Variables, build_detector
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.refinement import SECOND_LOOK, without_second_look
from fcos_lidar_jax.sensors import Sensor, sensor_to_json, turn_between
from fcos_lidar_jax.training.loop import Record
from fcos_lidar_jax.training.metrics_log import METRICS, evaluated_steps
from fcos_lidar_jax.training.optimizer import make_optimizer
from fcos_lidar_jax.training.step import make_state

NUM_SEEDS = 2**32  # JAX uses 32 bits of a seed, so larger seeds would repeat smaller ones
_MIN_EVALUATE_EVERY = 100
"""An evaluation of a whole split can take longer than so few steps, which hardly change the scores."""
_NUM_INSPECTED = 20  # frames that are read before a run starts
RUN_SPEC = "run.json"  # file with the specification of a run in its folder

Hook = Callable[[int, Record], None]
"""Called with the number of steps and the metrics of the last one, or the scores of the evaluation after it."""


@dataclasses.dataclass(frozen=True)
class Schedule(Checked):
    """Steps of a run at which it saves checkpoints and evaluates.

    Attributes:
        save_every: steps between checkpoints; by default a fiftieth of the run.
        evaluate_every: steps between evaluations, each of which also saves a checkpoint; by default a tenth of the
            run, but at least 100. The last step is always evaluated.
        keep: number of newest checkpoints to keep, in addition to the best.
    """

    save_every: Annotated[int | None, Bounds(1)] = None
    evaluate_every: Annotated[int | None, Bounds(1)] = None
    keep: Count = 2


@dataclasses.dataclass(frozen=True)
class RunSpec:
    """What to train on what, and where: the arguments of :func:`train`, checked.

    Attributes:
        config: the detector and its training.
        frames: training frames; classes are matched to ``config.classes`` by name, and the detector is built for
            their sensor.
        out: folder of the run.
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
        threads: number of threads that prepare batches; by default as many as
            ``input_pipeline.loader.default_threads`` returns.
        workers: number of additional processes that prepare batches.
    """

    config: Config
    frames: FrameSet
    out: Path
    _: dataclasses.KW_ONLY
    steps: int
    seed: int = 0
    tests: FrameSet | None = None
    objects: GroundTruthDatabase | None = None
    resume: bool = False
    weights: str | Path | Variables | None = None
    devices: Sequence[Any] | None = None
    hooks: Sequence[Hook] = ()
    schedule: Schedule = Schedule()
    threads: int | None = None
    workers: int = 0

    def __post_init__(self) -> None:
        config, steps, seed = self.config, self.steps, self.seed
        check(type(steps) is int and 1 <= steps < 2**31, "steps", steps, f"an integer from 1 to {2**31 - 1}")
        check(type(seed) is int and 0 <= seed < NUM_SEEDS, "seed", seed, f"an integer from 0 to {NUM_SEEDS - 1}")
        object.__setattr__(self, "out", local_path(self.out))
        object.__setattr__(self, "frames", MappedFrames(self.frames, config.classes))
        if self.tests is not None:
            object.__setattr__(self, "tests", MappedFrames(self.tests, config.classes))

    def evaluates_at(self, step: int) -> bool:
        every = self.schedule.evaluate_every or max(-(-self.steps // 10), _MIN_EVALUATE_EVERY)
        return self.tests is not None and (step % every == 0 or step == self.steps)

    def saves_at(self, step: int) -> bool:
        return step % (self.schedule.save_every or -(-self.steps // 50)) == 0 or self.evaluates_at(step)


@dataclasses.dataclass(frozen=True)
class Run:
    """Everything that is constant during a run."""

    spec: RunSpec
    record: dict[str, Any]  # content of ``run.json``: a run resumes only with the same
    detector: Detector
    optimizer: Any  # pair of functions from optax
    order: SampleOrder
    weights: Variables | None  # initial weights
    warnings: tuple[str, ...]

    def evaluation_pending(self, step: int) -> bool:
        """Whether a run was stopped before the evaluation after a step was recorded."""
        return step > 0 and self.spec.evaluates_at(step) and step not in evaluated_steps(self.spec.out)

    @property
    def checkpoints(self) -> Checkpoints:
        return Checkpoints(self.spec.out / CHECKPOINTS, keep=self.spec.schedule.keep)


def plan_run(spec: RunSpec, mesh: Mesh) -> Run:
    """Plan a run, and refuse one that cannot be trained."""
    begun = bool(spec.resume and Checkpoints(spec.out / CHECKPOINTS).paths())
    if begun and spec.weights is None:  # they are not used again
        spec = dataclasses.replace(spec, weights=_recorded_run(spec.out).get("weights"))
    config, frames = spec.config, spec.frames
    order = SampleOrder(frames, config, seed=spec.seed)
    for read in filter(None, (frames, spec.tests)):
        read.check_files(range(len(read)))
    size, number = config.optimizer.batch_size, mesh.size
    check(size % number == 0, "batch_size", size, f"a multiple of the {number} devices")
    options = {"threads": spec.threads, "workers": spec.workers, "num_processes": jax.process_count()}
    check_loader_options(config, **options)
    if config.copy_paste is not None:
        _check_pasting(spec, -(-order.epoch_size // config.optimizer.batch_size))
    if config.augment is not None:
        check_augmentation(config.augment, frames.sensor)
    if config.trains_second_look_only:
        has_weights = begun or spec.weights is not None
        check(has_weights, "refinement.freeze_detector", True, "False without weights of a detector")
    detector, optimizer = build_detector(config, frames.sensor), make_optimizer(config.optimizer, spec.steps)
    jax.eval_shape(lambda key: make_state(detector, optimizer, key), jax.random.key(spec.seed))
    weights = None if begun else _initial_weights(detector, spec.weights, spec.seed)
    warnings = tuple(_warnings(frames, config))
    return Run(spec, _record(spec, detector, weights), detector, optimizer, order, weights, warnings)


def _check_pasting(spec: RunSpec, epoch_steps: int) -> None:
    config = spec.config
    expected = f"less than the run, {spec.steps} steps, {epoch_steps} per epoch: nothing would be pasted"
    check(config.fade_epochs * epoch_steps < spec.steps, "fade_epochs", config.fade_epochs, expected)
    if spec.objects is None:
        raise ValueError("copy_paste: got no ground-truth database, expected one, or None in the configuration")
    make_paste(spec.objects, config)


def _record(spec: RunSpec, detector: Detector, weights: Variables | None) -> dict[str, Any]:
    objects, tests = spec.objects, spec.tests
    record = {
        "config": recorded_config(spec.config, spec.frames),
        "sensor": sensor_to_json(spec.frames.sensor),
        "steps": spec.steps,
        "seed": spec.seed,
        "frames": len(spec.frames),
        "data": spec.frames.fingerprint(),
        "tests": None if tests is None else tests.fingerprint(),
        "objects": None if objects is None else objects.manifest.source,
        "ground_truth_database": None if objects is None else objects.fingerprint(),
        "weights": str(spec.weights) if isinstance(spec.weights, str | Path) else None,
        "weights_hash": None if weights is None else TrainedDetector(detector, weights).fingerprint,
    }
    return json.loads(json.dumps(record))


def recorded_config(config: Config, frames: FrameSet) -> dict[str, Any]:
    """The configuration of a run as JSON, with the sensor of the data."""
    return config_to_json(config) | {"sensor": frames.sensor.name}


def _warnings(frames: FrameSet, config: Config) -> Iterator[str]:
    """What a sample of the frames shows; refuses frames with boxes but without a single point in them."""
    indices = sorted({round(index) for index in np.linspace(0, len(frames) - 1, _NUM_INSPECTED)})
    read = {index: frames.frame(index) for index in indices}
    inside = np.concatenate([frame.num_points for frame in read.values()])
    num_empty, same = int((inside == 0).sum()), "are points and boxes in the same frame?"
    found = f"{num_empty} of {len(inside)} boxes of {len(read)} frames contain no point"
    if num_empty == len(inside) > 0:
        raise ValueError(f"{found}, expected some with points: {same}")
    if num_empty > len(inside) / 2:
        yield f"{found} and are not learned: {same}"
    clouds = {index: frame.points for index, frame in read.items()}
    for index, points in clouds.items():
        check_num_lags(points[:, 4], frames.name(index), config.num_sweeps)
        if mismatch := sensor_mismatch(points, frames.sensor):
            yield f"{frames.name(index)}: {mismatch}"
            break
    if config.num_sweeps > 1 and all(len(np.unique(points[:, 4])) <= 1 for points in clouds.values()):
        yield (
            f"num_sweeps: got {config.num_sweeps}, but the frames hold one sweep each: expected 1, because "
            f"`stream` would fuse {config.num_sweeps} sweeps, which the detector has not been trained for"
        )


def _recorded_run(folder: Path) -> dict[str, Any]:
    return read_json(folder / RUN_SPEC, dict[str, Any], what="the specification of the run to resume")


def check_run(folder: str | Path, spec: dict[str, Any], *, resume: bool) -> None:
    """Check that a run can be started or resumed in a folder; names the first field in which another run differs.

    ``spec`` has fields of ``run.json`` that a resumed run must have.
    """
    folder = local_path(folder)
    file, checkpoints = folder / RUN_SPEC, Checkpoints(folder / CHECKPOINTS).paths()
    if not resume:
        # A new run would remove checkpoints and metrics.
        if checkpoints or file.exists() or (folder / METRICS).exists():
            raise ValueError(f"{folder}: holds a run, expected another folder or --resume, in Python resume=True")
        return
    recorded = {name: value for name, value in _recorded_run(folder).items() if name in spec}
    for name, was, now in _differences(recorded, spec):
        # Runs of earlier versions lack the hash, and a run with checkpoints does not use its first weights again.
        if name == "weights_hash" and (name not in recorded or checkpoints):
            continue
        raise ValueError(f"{file}: {name}: was {was!r}, got {now!r}: only the same run can be resumed")


def _initial_weights(
    detector: Detector, weights: str | Path | Variables | None, seed: int = 0
) -> Variables | None:
    """Load initial weights, and report differences of the network's configuration that shapes do not show."""
    if weights is None:
        return None
    shapes, whose = jax.eval_shape(detector.init, jax.random.key(0)), "the network to be trained"
    if not isinstance(weights, str | Path):
        check_arrays("weights", shapes, weights, whose=whose)
        return jax.tree.map(lambda expected, leaf: jnp.asarray(leaf, expected.dtype), shapes, weights)
    folder = find_checkpoint(Path(weights))
    checkpoint = read_checkpoint(folder)
    classes = checkpoint.config.classes
    same, frozen = classes == detector.config.classes, detector.config.trains_second_look_only
    expected = f"False, or the classes of {folder}: {', '.join(classes)}"  # other classes need random layers
    check(same or not frozen, "refinement.freeze_detector", frozen, expected)
    variables = _with_second_look(folder, checkpoint.variables, detector, classes, seed)
    if not same:
        variables = _for_other_classes(folder, classes, variables, detector, seed)
    check_arrays(folder, shapes, variables, whose=whose)
    # What describes the network: `model`, and fields that only another detector's configuration has.
    others = {field.name for field in dataclasses.fields(Config)} - {"model"}
    configs = map(config_to_json, (checkpoint.config, detector.config))
    own, new = ({name: value for name, value in config.items() if name not in others} for config in configs)
    for name, was, now in _differences(own, new):
        tell(f"{folder}: weights of {name} {was!r}, to be trained with {now!r}")
    for line in _sensor_differences(checkpoint.sensor, detector.sensor):
        tell(f"warning: {folder}: weights trained {line}: expect scores to fall at first")
    return variables


def _sensor_differences(was: Sensor, now: Sensor) -> Iterator[str]:
    """What weights trained with one sensor have to learn of another."""
    beams = [(s.inclinations_rad, s.num_columns, s.azimuth_limits_rad, s.row_source) for s in (was, now)]
    if beams[0] != beams[1]:
        names = [f"sensor {s.name!r} ({s.num_rows} beams, {s.num_columns} columns)" for s in (was, now)]
        yield f"for {names[0]}, here {names[1]}: the arrays fit, but not the beams"
    if turn := turn_between(now, was):
        yield f"on clouds rotated by {math.degrees(turn):g} degrees relative to these"
    if was.origin_m != now.origin_m:
        yield f"with the LiDAR at {was.origin_m} m, here at {now.origin_m} m"


def _with_second_look(
    where: Path, variables: Variables, detector: Detector, classes: Sequence[str], seed: int
) -> Variables:
    """Variables with the arrays of the detector's second look, random arrays where none fits."""
    params = variables["params"]
    found = by_name(params.get(SECOND_LOOK, {}))
    if detector.refine is None:
        if found:
            tell(f"{where}: the second look is left out, since refinement is None")
        return without_second_look(variables)
    new = jax.jit(detector.init)(jax.random.key(seed))["params"][SECOND_LOOK]
    own, same = by_name(new), classes == detector.config.classes  # otherwise shapes are compared later
    fits = {n for n, leaf in own.items() if n in found and (found[n].shape == leaf.shape or not same)}
    if fits == own.keys() == found.keys():
        return variables
    anew, left_out = len(own) - len(fits), len(found.keys() - own.keys())
    changes = f"{anew} of {len(own)} arrays start with random weights, {left_out} are left out"
    tell(f"{where}: has another second look, or none: {changes}")
    leaves = [found[name] if name in fits else leaf for name, leaf in own.items()]
    look = jax.tree.unflatten(jax.tree.structure(new), leaves)
    return variables | {"params": params | {SECOND_LOOK: look}}


def _for_other_classes(
    where: Path, was: Sequence[str], variables: Variables, detector: Detector, seed: int
) -> Variables:
    """Variables with random arrays where an array depends on the number of classes or does not fit."""
    doubled = build_detector(detector.config.with_doubled_classes(), detector.sensor)
    new, more = jax.jit(detector.init)(jax.random.key(seed)), jax.eval_shape(doubled.init, jax.random.key(0))
    found, own, more = (by_name(tree) for tree in (variables, new, more))
    fits = {n for n, x in own.items() if n in found and found[n].shape == x.shape == more[n].shape}
    if not fits:  # the weights of another detector, which are refused
        return variables
    totals, anew = (Counter(name.split("/")[1] for name in names) for names in (own, own.keys() - fits))
    told = ", ".join(f"{part} ({anew[part]} of {totals[part]} arrays)" for part in sorted(anew))
    tell(f"{where}: weights for other classes ({', '.join(was)}): these start with random weights: {told}")
    leaves = [found[name] if name in fits else leaf for name, leaf in own.items()]
    return jax.tree.unflatten(jax.tree.structure(new), leaves)


def _differences(was: Any, now: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    if isinstance(was, dict) and isinstance(now, dict):
        for key in sorted(was.keys() | now.keys()):
            values = was.get(key, "nothing"), now.get(key, "nothing")
            yield from _differences(*values, f"{name}.{key}" if name else key)
    elif was != now:
        yield name, was, now

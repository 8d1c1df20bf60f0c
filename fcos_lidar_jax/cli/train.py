"""``fcos-lidar train``: train a preset on a data set."""

import contextlib
import dataclasses
import json
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from fcos_lidar_jax.checkpoints.retention import CHECKPOINTS, Checkpoints, best_of
from fcos_lidar_jax.cli.checks import check_out_folder
from fcos_lidar_jax.cli.data import DataOptions
from fcos_lidar_jax.cli.processes import ProcessOptions, check_processes, join_processes, tell
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.nuscenes.index import has_index
from fcos_lidar_jax.devices.agreement import agreed
from fcos_lidar_jax.files import folder_lock
from fcos_lidar_jax.input_pipeline import database
from fcos_lidar_jax.input_pipeline.loader import steps_per_epoch
from fcos_lidar_jax.input_pipeline.open import DataSet
from fcos_lidar_jax.presets import PRESETS
from fcos_lidar_jax.training import Schedule, train
from fcos_lidar_jax.training.plan import check_numbers, check_run

_ABOUT = {
    "nuscenes": "the paper's detector on ten sweeps",
    "nuscenes_single": "the same on one sweep",
    "nuscenes_test": "the paper's test-set model",
    "kitti": "one sweep of KITTI's camera view, three classes",
    "argoverse2": "one sweep of Argoverse 2, 26 classes",
    "compact": "one sweep of nuScenes, quick on two CPU cores",
    "quickstart": "small enough for two CPU cores",
    "centerpoint_pillars": "CenterPoint on ten sweeps, for comparison",
    "centerpoint_compact": "CenterPoint on one sweep, of about the cost of compact",
}
_PRESETS: Any = (
    Annotated[
        type(preset), tyro.conf.subcommand(name, default=preset, prefix_name=False, description=_ABOUT[name])
    ]
    for name, preset in PRESETS.items()
)
_OBJECTS = "objects"  # Folder in the run's, where objects of single frames are cut.
_MAX_SIMULATED = 2000  # Simulated frames that may be made before the first step: minutes.
_Preset: Any = reduce(or_, _PRESETS)


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a preset: fcos-lidar train PRESET --data-root DIR --out DIR; every number of the preset is an option,
    see fcos-lidar train PRESET --help.

    OUT gets checkpoints, metrics.jsonl, TensorBoard events, curves and pictures. All local devices share each
    batch. Ctrl-C and SIGTERM save and stop; the same command with --resume resumes, bit for bit.
    """

    config: Annotated[_Preset, tyro.conf.arg(name=""), tyro.conf.AvoidSubcommands]  # type: ignore[valid-type]
    """The preset, with its changes."""
    data: tyro.conf.OmitArgPrefixes[DataOptions]  # The data set.
    out: Path  # Folder of the run.
    train_split: str | None = None
    """Default: train, or mini_train for a version that ends in mini; all frames where the data have no splits."""
    val_split: str | None = None
    """Evaluated on along the way; default: val or mini_val where there is one; "none" for no evaluation."""
    samples: str | None = None
    """FIRST:LAST: frames of the training split in their order, LAST excluded; several, separated by commas."""
    val_samples: str | None = None  # Likewise, of the split that is evaluated on.
    resume: bool = False  # Go on from the newest checkpoint in OUT.
    weights: Path | None = None  # Begin with the weights of this checkpoint, or of the last of this run.
    steps: int | None = None  # Updates, instead of optimizer.epochs passes over the training set.
    seed: int = 0  # Of weights, order, pasted objects and augmentation.
    evaluate_every: int | None = None  # Steps between two evaluations; default: a tenth of the run.
    save_every: int | None = None  # Steps between two checkpoints; default: a fiftieth of the run.
    keep: int = 2  # Newest checkpoints that are kept beside the best.
    no_augment: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False  # Without flips, rotations and scales.
    no_copy_paste: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False  # Without objects of other frames.
    threads: int | None = None
    """Threads that prepare batches, per worker process if there are any. Default: the available cores, divided
    among the workers, less one if there are more than two; at most 16."""
    workers: int = 0  # Worker processes that prepare batches in place of the main process; 0 for none.
    no_packing: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Send batches to GPUs and TPUs unpacked: more bytes, the same results. CPUs always get them unpacked."""
    processes: tyro.conf.OmitArgPrefixes[ProcessOptions] = dataclasses.field(default_factory=ProcessOptions)
    """Several processes share each batch."""


def run(args: Train) -> None:
    """Train, and print where the result is."""
    _check(args)
    schedule = Schedule(args.save_every, args.evaluate_every, args.keep)
    join_processes(args.processes)
    is_main_process = jax.process_index() == 0
    with agreed("cannot train"):
        task = _open(args)
    checkpoints = Checkpoints(args.out / CHECKPOINTS)
    try:
        with contextlib.ExitStack() as held:
            with agreed("cannot train"):
                if task.cuts_objects and is_main_process:  # one cuts, the others find it done
                    check_numbers(task.steps, args.seed)
                    held.enter_context(folder_lock(args.out, "training"))
                    check_run(args.out, resume=args.resume)  # another process may have been faster
                    _cut_objects(args.out, task)
            with agreed("cannot train"):
                objects = _objects(args, task)
            state = train(
                task.config,
                task.frames,
                args.out,
                steps=task.steps,
                tests=task.tests,
                objects=objects,
                schedule=schedule,
                packing=False if args.no_packing else None,
                **{name: getattr(args, name) for name in ("seed", "resume", "weights", "threads", "workers")},
            )
    except (KeyboardInterrupt, SystemExit):
        if checkpoints.paths():
            tell("the same command with --resume goes on")
        raise
    if is_main_process:
        paths = checkpoints.paths()
        best = best_of(paths)
        record = {"run": str(args.out), "steps": int(state.step), "checkpoint": str(paths[-1])}
        print(json.dumps(record | ({} if best is None else {"best": str(best)})))


@dataclasses.dataclass(frozen=True)
class _Task:
    """What is trained, on what."""

    config: Config
    data: DataSet
    split: str | None
    frames: FrameSet
    tests: FrameSet | None
    steps: int
    cuts_objects: bool  # Pasted objects are those of these frames alone, cut in the run's folder.


def _open(args: Train) -> _Task:
    """Open the data; refuse what does not fit together."""
    config = dataclasses.replace(
        args.config,
        augment=None if args.no_augment else args.config.augment,
        copy_paste=None if args.no_copy_paste else args.config.copy_paste,
    )
    check_run(args.out, resume=args.resume)
    check_out_folder(args.out)
    data = args.data.find()
    index = args.data.index or data.index
    if data.tables is not None and data.tables.is_dir() and not has_index(index):
        raise ValueError(f"{index}: no index here, expected one: run fcos-lidar prepare")
    split = args.train_split or args.data.split("train")
    frames = args.data.open(config, split=split, samples=args.samples)
    _check_sensor(config, data, frames)
    tests = _open_tests(args, config, data)
    if split is None and args.samples is None and tests is None:
        tell(f"{data.root}: no splits: all {len(frames)} frames are trained on, none is left to evaluate on")
    if tests is not None:
        _tell_of_overlap(frames, tests)
    if not data.on_disk:
        _check_simulated(len(frames), config)
    steps = args.steps if args.steps is not None else config.optimizer.epochs * steps_per_epoch(frames, config)
    own = args.samples is not None or not data.on_disk
    return _Task(config, data, split, frames, tests, steps, own and config.copy_paste is not None)


def _check_sensor(config: Config, data: DataSet, frames: FrameSet) -> None:
    # The default sensor is that of the preset, which --name may have renamed.
    presets = [preset for preset in PRESETS.values() if preset.name == config.name] or PRESETS.values()
    if data.reader.sensor is None and config.sensor not in (frames.sensor.name, *(p.sensor for p in presets)):
        raise ValueError(
            f"--sensor: got {config.sensor!r}, expected none: {data.root}/sensor.json has {frames.sensor.name!r}"
        )


def _open_tests(args: Train, config: Config, data: DataSet) -> FrameSet | None:
    """The frames to evaluate on along the way, if there are any."""
    split, tests = args.val_split or args.data.split("val", required=False), None
    if split != "none" and (split or args.val_samples):
        tests = args.data.open(config, split=split, samples=args.val_samples, option="--val-samples")
    if tests is None and args.evaluate_every is not None:
        raise ValueError(
            f"--evaluate-every: got {args.evaluate_every}, expected --val-split or --val-samples too: "
            f"{data.root} has no split to evaluate on"
        )
    return tests


def _check(args: Train) -> None:
    check_processes(args.processes)
    if args.val_split == "none":
        for name in ("val_samples", "evaluate_every"):
            if (given := getattr(args, name)) is not None:
                option = f"--{name.replace('_', '-')}"
                raise ValueError(f"{option}: got {given!r} with --val-split none, which evaluates nothing")


def _check_simulated(number: int, config: Config) -> None:
    """Simulated frames are made one by one, so nothing should need all of very many before the first step."""
    wanted = {"class_balanced": config.class_balanced, "copy_paste": config.copy_paste is not None}
    if number > _MAX_SIMULATED and any(wanted.values()):
        options = " ".join(f"--no-{name.replace('_', '-')}" for name, on in wanted.items() if on)
        raise ValueError(
            f"--format simulated: all {number} frames would be made before the first step, expected {options}, or "
            f"at most {_MAX_SIMULATED} of them by --samples"
        )


def _cut_objects(out: Path, task: _Task) -> None:
    """Cut the objects of the training frames alone in the run's folder, which is locked."""
    assert task.config.copy_paste is not None
    database.prepare_database(task.frames, out / _OBJECTS, min_points=task.config.copy_paste.min_points)


def _objects(args: Train, task: _Task) -> database.GroundTruthDatabase | None:
    """The objects to paste: those just cut, or those prepared of the split."""
    config, split = task.config, task.split
    if config.copy_paste is None:
        return None
    if task.cuts_objects:
        return database.open_database(args.out / _OBJECTS)
    folder = database.objects_folder(args.data.index or task.data.index, split)
    if not folder.is_dir():
        of = "" if split is None else f" --train-split {split}"
        raise ValueError(
            f"{folder}: no objects here, expected those of the training frames: run fcos-lidar prepare{of}, "
            "or train with --no-copy-paste"
        )
    source = database.read_manifest(folder).source
    if config.num_sweeps > database.MAX_SWEEPS:
        raise ValueError(
            f"num_sweeps: got {config.num_sweeps}, expected at most {database.MAX_SWEEPS} with pasted objects, or "
            "--no-copy-paste"
        )
    # Objects of more sweeps than are fused will do: those too many are left out.
    sweeps = range(config.num_sweeps, database.MAX_SWEEPS + 1)
    if not any(source == args.data.open_whole(split, database.cut_reading(n)).fingerprint() for n in sweeps):
        raise ValueError(
            f"{folder}: cut from other frames than those of split {split!r}, with another --class-map, or from "
            f"fewer sweeps than {config.num_sweeps}, expected these: run fcos-lidar prepare again, with the same "
            "options for the data"
        )
    return database.open_database(folder)


def _tell_of_overlap(frames: FrameSet, tests: FrameSet) -> None:
    """Print how many frames are both trained and evaluated on."""
    names, tested = ({each.name(index) for index in range(len(each))} for each in (frames, tests))
    if shared := len(names & tested):
        tell(f"{shared} of the {len(tests)} frames to evaluate on are trained on too: scores will be too high")

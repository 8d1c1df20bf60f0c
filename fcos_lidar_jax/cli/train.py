"""``fcos-lidar train``: train a preset on a data set."""

import dataclasses
import json
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro

from fcos_lidar_jax.checkpoints.retention import CHECKPOINTS, Checkpoints, best_of
from fcos_lidar_jax.cli.checks import Output, option_name
from fcos_lidar_jax.cli.data import DataOptions
from fcos_lidar_jax.cli.options import option
from fcos_lidar_jax.cli.processes import ProcessOptions, join_processes
from fcos_lidar_jax.config import Config, RefinementConfig
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.nuscenes.index import has_index
from fcos_lidar_jax.devices.agreement import agreed, check_same
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.input_pipeline import database
from fcos_lidar_jax.input_pipeline.loader import check_loader_options, steps_per_epoch
from fcos_lidar_jax.input_pipeline.open import DataSet
from fcos_lidar_jax.presets import ABOUT, PRESETS
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.training import Schedule, train
from fcos_lidar_jax.training.plan import RUN_SPEC, recorded_config
from fcos_lidar_jax.training.run import run_folder

_PRESETS: Any = (
    Annotated[type(preset), tyro.conf.subcommand(name, default=preset, prefix_name=False, description=ABOUT[name])]
    for name, preset in PRESETS.items()
)
_OBJECTS = "objects"  # folder in the run's folder for objects cut from selected frames
_MAX_SIMULATED = 2000  # simulated frames that may be made before the first step, which takes minutes
_Preset: Any = reduce(or_, _PRESETS)


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a preset: fcos-lidar train PRESET --data-root DIR --out DIR.

    Every field of the preset is an option, see fcos-lidar train PRESET --help. The command writes checkpoints,
    metrics.jsonl, TensorBoard events, curves and pictures to OUT. Each batch is split over all local devices.
    Ctrl-C and SIGTERM save a checkpoint and stop (with several processes, only SIGTERM). The same command with
    --resume continues.
    """

    config: Annotated[_Preset, tyro.conf.arg(name=""), tyro.conf.AvoidSubcommands]  # type: ignore[valid-type]
    """Preset to train."""
    data: tyro.conf.OmitArgPrefixes[DataOptions]  # The data set.
    out: Annotated[Path, Output.FOLDER, option("DIR")]  # Folder of the run.
    train_split: Annotated[
        str | None, option("SPLIT", default="train, mini_train, or all frames without splits")
    ] = None
    """Split to train on."""
    val_split: Annotated[str | None, option("SPLIT|none", default="val or mini_val, if there is one")] = None
    """Split to evaluate on during training; none for no evaluation."""
    samples: Annotated[str | None, option("FIRST:LAST,...", default="all")] = None
    """Ranges of the training split's frames, LAST excluded."""
    val_samples: Annotated[str | None, option("FIRST:LAST,...", default="all")] = None
    """Ranges of the frames of --val-split, LAST excluded."""
    resume: bool = False  # Continue from the newest checkpoint in OUT.
    auto_resume: bool = False
    """Continue the run in OUT, or start one. For jobs that a cluster restarts with the same command."""
    weights: Annotated[Path | None, option("C", default="random weights")] = None
    """Start from the weights of a checkpoint, of the last checkpoint of a run, or from shipped weights."""
    steps: Annotated[int | None, option("N", default="--optimizer.epochs passes over the frames")] = None
    """Training steps."""
    seed: int = 0  # Seed of weights, frame order, pasted objects and augmentation.
    evaluate_every: Annotated[int | None, option("N", default="a tenth of the run, but at least 100")] = None
    """Steps between two evaluations; the last step is always evaluated."""
    save_every: Annotated[int | None, option("N", default="a fiftieth of the run")] = None
    """Steps between two checkpoints."""
    keep: int = 2  # Number of newest checkpoints to keep, in addition to the best one.
    no_augment: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False  # Turn off flips, rotations and scaling.
    no_copy_paste: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False  # Turn off copy-paste of objects.
    second_look: Annotated[Literal["on", "off"] | None, option("{on,off}", default="the preset's")] = None
    """Turn the second look at the best boxes on or off (refinement; not in the paper)."""
    threads: Annotated[
        int | None, option("N", default="the cores per worker, minus one if more than two; at most 16")
    ] = None
    """Threads that prepare batches, per worker process if there are any."""
    workers: int = 0  # Worker processes that prepare batches; 0 for threads of the main process.
    processes: tyro.conf.OmitArgPrefixes[ProcessOptions] = dataclasses.field(default_factory=ProcessOptions)
    """Share each batch among several processes."""


def run(args: Train) -> None:
    """Train, and print the paths of the run and its checkpoints."""
    schedule = Schedule(args.save_every, args.evaluate_every, args.keep)
    join_processes(args.processes)
    is_main_process = jax.process_index() == 0
    with agreed("cannot train"):
        task = _open(args)
    resume = args.resume or (args.auto_resume and (args.out / RUN_SPEC).is_file())
    check_same(f"{resume:02d}", f"--auto-resume: a run in {args.out}")
    if args.auto_resume and not resume:
        tell(f"{args.out}: no run to resume, starting one")
    checkpoints = Checkpoints(args.out / CHECKPOINTS)
    try:
        with agreed("cannot train"):
            if task.cuts_objects and is_main_process:  # the other processes open the result
                # A run with other frames or options keeps its objects.
                config = recorded_config(task.config, task.frames)
                cut_from = json.dumps({"config": config, "objects": task.frames.fingerprint()})
                with run_folder(args.out, json.loads(cut_from), resume=resume):
                    _cut_objects(task)
        with agreed("cannot train"):
            objects = _objects(task, args.data)
        state = train(
            task.config,
            task.frames,
            args.out,
            steps=task.steps,
            tests=task.tests,
            objects=objects,
            schedule=schedule,
            resume=resume,
            **{name: getattr(args, name) for name in ("seed", "weights", "threads", "workers")},
        )
    except (KeyboardInterrupt, SystemExit):
        if checkpoints.paths():
            tell(f"the same command {'' if args.auto_resume else 'with --resume '}continues")
        raise
    if is_main_process:
        paths = checkpoints.paths()
        best = best_of(paths)
        record = {"run": str(args.out), "steps": int(state.step), "checkpoint": str(paths[-1])}
        print(json.dumps(record | ({} if best is None else {"best": str(best)})))


@dataclasses.dataclass(frozen=True)
class _Task:
    config: Config
    split: str | None
    frames: FrameSet
    tests: FrameSet | None
    steps: int
    objects: Path | None  # folder of the objects to paste; None without copy-paste
    cuts_objects: bool  # they come only from these frames and are stored in the run's folder


def _open(args: Train) -> _Task:
    """Open the data, and check that they fit the options."""
    config = dataclasses.replace(
        args.config,
        augment=None if args.no_augment else args.config.augment,
        copy_paste=None if args.no_copy_paste else args.config.copy_paste,
        refinement=_refinement(args.config.refinement, args.second_look),
    )
    options = {"threads": args.threads, "workers": args.workers, "num_processes": jax.process_count()}
    check_loader_options(config, **options)  # before objects are cut
    data = args.data.data_set
    index = args.data.index or data.index
    if data.tables is not None and data.tables.is_dir() and not has_index(index):
        raise ValueError(f"{index}: no index here, expected one: run fcos-lidar prepare")
    split = args.data.split("train", args.train_split)
    frames = args.data.open(config, split=split, samples=args.samples)
    _check_sensor(config, data, frames)
    if absent := [name for name in config.classes if name not in frames.frames.classes]:
        known = ", ".join(frames.frames.classes)
        tell(f"warning: --classes: the data have no example of {', '.join(absent)}, only of {known}")
    tests = _open_tests(args, config)
    if split is None and args.samples is None and tests is None:
        tell(f"{data.root}: no splits: training on all {len(frames)} frames, with no evaluation")
    if tests is not None:
        names, tested = ({each.name(index) for index in range(len(each))} for each in (frames, tests))
        if shared := len(names & tested):
            tell(
                f"{shared} of the {len(tests)} evaluation frames are also training frames: scores will be too high"
            )
    if not data.on_disk:
        _check_simulated(len(frames), config)
    steps = args.steps if args.steps is not None else config.optimizer.epochs * steps_per_epoch(frames, config)
    cuts_objects = config.copy_paste is not None and (args.samples is not None or not data.on_disk)
    objects = args.out / _OBJECTS if cuts_objects else None
    if config.copy_paste is not None and not cuts_objects:
        objects = database.objects_folder(index, split)
    elif data.tables is None:
        args.data.refuse_index("no prepared objects are used")
    return _Task(config, split, frames, tests, steps, objects, cuts_objects)


def _refinement(of_preset: RefinementConfig | None, second_look: str | None) -> RefinementConfig | None:
    if second_look is None:
        return of_preset
    return None if second_look == "off" else of_preset or RefinementConfig()


def _check_sensor(config: Config, data: DataSet, frames: FrameSet) -> None:
    # --sensor was given if it differs from the preset's sensor; --name may have renamed the preset.
    presets = [preset for preset in PRESETS.values() if preset.name == config.name] or PRESETS.values()
    fits = data.reader.sensor is not None or config.sensor in (frames.sensor.name, *(p.sensor for p in presets))
    check(fits, "--sensor", config.sensor, f"none: {data.root}/sensor.json has {frames.sensor.name!r}")


def _open_tests(args: Train, config: Config) -> FrameSet | None:
    split = args.data.split("val", args.val_split, required=False)
    if split != "none" and (split is not None or args.val_samples):
        return args.data.open(config, split=split, samples=args.val_samples, option="--val-samples")
    expected = "frames to evaluate on: --val-split, or --val-samples where there are no splits"
    for name in ("val_samples", "evaluate_every"):
        if (given := getattr(args, name)) is not None:
            raise ValueError(f"{option_name(name)}: got {given!r}, expected {expected}")
    return None


def _check_simulated(number: int, config: Config) -> None:
    """Reject options that would simulate very many frames before the first step."""
    if number > _MAX_SIMULATED and (config.class_balanced or config.copy_paste is not None):
        expected = f"--no-class-balanced --no-copy-paste, or at most {_MAX_SIMULATED} of them by --samples"
        raise ValueError(
            f"--format simulated: all {number} frames would be made before the first step, expected {expected}"
        )


def _cut_objects(task: _Task) -> None:
    assert task.config.copy_paste is not None
    assert task.objects is not None
    min_points, num_sweeps = task.config.copy_paste.min_points, task.config.num_sweeps
    database.prepare_database(task.frames, task.objects, min_points=min_points, num_sweeps=num_sweeps)


def _objects(task: _Task, data: DataOptions) -> database.GroundTruthDatabase | None:
    """Open the objects to paste, just cut or prepared for the split; None without copy-paste."""
    folder, split = task.objects, task.split
    if folder is None:
        return None
    if task.cuts_objects:
        # The folder is not locked since they were cut: another process may have cut others.
        return database.open_database(folder, fingerprint=task.frames.fingerprint())
    if not folder.is_dir():
        option = "" if split is None else f" --train-split {split}"
        raise ValueError(
            f"{folder}: no objects here, expected objects of the training frames: run fcos-lidar prepare{option}, "
            "or train with --no-copy-paste"
        )
    objects = database.open_database(folder)
    reading = database.cut_reading(objects.manifest.num_sweeps)
    if objects.manifest.source != data.open_whole(split, reading, report_missing=False).fingerprint():
        of = "all frames" if split is None else f"split {split!r}"
        raise ValueError(
            f"{folder}: cut from other frames than {of}, or with other options, such as --class-map or "
            "--full-turn, expected the same: run fcos-lidar prepare again"
        )
    return objects

"""``fcos-lidar train``: train a preset on a data set in the nuScenes layout."""

import dataclasses
import json
import sys
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro
from jax.experimental import multihost_utils

from fcos_lidar_jax.commands.prepare import default_train_split, fingerprint, objects_folder
from fcos_lidar_jax.commands.runs import Feed, Plan, Rhythm, Run
from fcos_lidar_jax.config import PRESETS, Config, CopyPasteConfig
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.index import has_index
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames, default_index
from fcos_lidar_jax.data.object_builder import build_objects
from fcos_lidar_jax.data.objects import ObjectDatabase, open_objects, read_manifest
from fcos_lidar_jax.data.pipeline import epoch_frames, make_batches, steps_per_epoch
from fcos_lidar_jax.models import Variables
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.training import load_checkpoint
from fcos_lidar_jax.training.checkpoint import check_arrays
from fcos_lidar_jax.training.snapshots import find_checkpoint

_ABOUT = {
    "nuscenes": "the paper's detector on ten sweeps",
    "nuscenes_single": "the same on one sweep",
    "nuscenes_test": "the paper's test-set model",
    "quickstart": "small enough for two CPU cores",
}
_MOST_SWEEPS = 20
_Preset: Any = reduce(
    or_,
    (
        Annotated[
            Config, tyro.conf.subcommand(name, default=preset, prefix_name=False, description=_ABOUT.get(name, ""))
        ]
        for name, preset in PRESETS.items()
    ),
)


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a preset: fcos-lidar train PRESET --data-root DIR --version V --out DIR; every number of the preset is
    an option, see fcos-lidar train PRESET --help.

    OUT gets checkpoints, metrics.jsonl, TensorBoard events, curves and pictures. All local devices share each
    batch. Ctrl-C and SIGTERM save and stop; the same command with --resume goes on, to the bit.
    """

    config: Annotated[
        _Preset,  # type: ignore[valid-type]
        tyro.conf.arg(name=""),
        tyro.conf.AvoidSubcommands,
    ]
    """The preset, with its changes."""
    data_root: Path
    """Folder with the version's folder, samples/ and sweeps/; see fcos-lidar prepare."""
    version: str
    """Folder of the tables, such as v1.0-trainval."""
    out: Path
    """Folder of the run."""
    index: Path | None = None
    """Where fcos-lidar prepare has put the index; default: DATA_ROOT/.fcos_lidar/VERSION."""
    train_split: str | None = None
    """Default: mini_train for a version that ends in mini, else train."""
    val_split: str | None = None
    """Evaluated on; default: mini_val or val; "none" for no evaluation."""
    splits: Path | None = None
    """File {name: [scene, ...]} with own splits."""
    samples: str | None = None
    """FIRST:LAST: keyframes of the training split in time order, LAST excluded; several, separated by commas."""
    val_samples: str | None = None
    """Likewise, of the split that is evaluated on."""
    resume: bool = False
    """Go on from the newest checkpoint in OUT."""
    weights: Path | None = None
    """Begin with the weights of this checkpoint, or of the best of this run."""
    steps: int | None = None
    """Updates, instead of optimizer.epochs passes over the training set."""
    seed: int = 0
    """Of weights, order, pasted objects and augmentation."""
    evaluate_every: int | None = None
    """Steps between two evaluations; default: a tenth of the run."""
    save_every: int | None = None
    """Steps between two checkpoints; default: a fiftieth of the run."""
    keep: int = 2
    """Newest checkpoints that are kept beside the best."""
    no_augment: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Without flips, rotations and scales."""
    no_copy_paste: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Without objects of other frames."""
    threads: int = 2
    """That prepare batches."""
    workers: int = 0
    """Processes that prepare batches, beside the threads."""
    allow_missing_sweeps: bool = False
    """Go on with fewer sweeps where files of older sweeps are missing; they are counted."""
    distributed: bool = False
    """One of several processes, started by Slurm, Open MPI or a TPU pod, which tell JAX about each other."""
    coordinator: str | None = None
    """HOST:PORT of process 0, where nothing tells JAX; with --num-processes and --process-index."""
    num_processes: int | None = None
    """In all."""
    process_index: int | None = None
    """Which one this is, from 0."""


def run(args: Train) -> None:
    """Do it, and print where the result is."""
    _check(args)
    if args.distributed or args.coordinator is not None:
        jax.distributed.initialize(args.coordinator, args.num_processes, args.process_index)
    config = dataclasses.replace(
        args.config,
        augment=None if args.no_augment else args.config.augment,
        copy_paste=None if args.no_copy_paste else args.config.copy_paste,
    )
    sensor = load_sensor(config.sensor)
    index = args.index or default_index(args.data_root, args.version)
    if (args.data_root / args.version).is_dir() and not has_index(index):
        raise ValueError(f"{index}: no index here, expected one: run fcos-lidar prepare")
    data = NuScenes(args.data_root, args.version, index=index, allow_missing_sweeps=args.allow_missing_sweeps)
    split = args.train_split or default_train_split(args.version)
    frames = _frames(data, config, split, args.samples, "--samples", args)
    val_split = args.val_split or ("mini_val" if args.version.endswith("mini") else "val")
    tests = (
        None if val_split == "none" else _frames(data, config, val_split, args.val_samples, "--val-samples", args)
    )
    num_steps = _num_steps(args, config, frames)
    about = {
        "version": args.version,
        "split": split,
        "keyframes": len(frames),
        "samples": args.samples,
        "test_split": None if tests is None else val_split,
        "test_samples": args.val_samples,
        "fingerprint": fingerprint(index, frames),
        "weights": None if args.weights is None else str(args.weights),
    }
    plan = Plan(config, sensor, num_steps, args.seed, about)
    rhythm = Rhythm(args.save_every or -(-num_steps // 50), args.evaluate_every or -(-num_steps // 10), args.keep)
    training = Run(args.out, plan, rhythm, tests)
    training.check_folder(resume=args.resume)
    weights = None if args.weights is None or args.resume else _weights(args.weights, training)
    objects = None if config.copy_paste is None else _objects(config.copy_paste, frames, index, split, args)
    feed = _feed(args, config, frames, objects, num_steps)
    try:
        state = training.train(feed, resume=args.resume, weights=weights)
    except (KeyboardInterrupt, SystemExit):
        if training.leads and training.snapshots.paths():
            print("the same command with --resume goes on", file=sys.stderr)
        raise
    if jax.process_index() == 0:
        best = find_checkpoint(args.out)
        print(json.dumps({"run": str(args.out), "steps": int(state.step), "checkpoint": str(best)}))


def _check(args: Train) -> None:
    for name in ("steps", "evaluate_every", "save_every", "keep", "num_processes"):
        value = getattr(args, name)
        if value is not None and value < 1:
            raise ValueError(f"--{name.replace('_', '-')}: got {value}, expected at least 1")
    for name in ("threads", "workers", "seed"):
        if getattr(args, name) < 0:
            raise ValueError(f"--{name}: got {getattr(args, name)}, expected at least 0")
    given = [args.coordinator is not None, args.num_processes is not None, args.process_index is not None]
    if any(given) and not all(given):
        raise ValueError("--coordinator, --num-processes and --process-index: got some, expected all or none")
    if args.process_index is not None and not 0 <= args.process_index < (args.num_processes or 0):
        raise ValueError(f"--process-index: got {args.process_index}, expected 0 to {args.num_processes} excluded")


def _num_steps(args: Train, config: Config, frames: NuScenesFrames) -> int:
    an_epoch = steps_per_epoch(len(epoch_frames(frames, config, seed=args.seed)), config.optimizer.batch_size)
    num_steps = args.steps or config.optimizer.epochs * an_epoch
    if config.copy_paste is not None and config.fade_epochs * an_epoch >= num_steps:
        raise ValueError(
            f"fade_epochs: got {config.fade_epochs}, of {an_epoch} steps each, expected less than the run's "
            f"{num_steps} steps: nothing would ever be pasted"
        )
    return num_steps


def _frames(
    data: NuScenes, config: Config, split: str, samples: str | None, option: str, args: Train
) -> NuScenesFrames:
    tokens = data.split(split, file=args.splits)
    chosen = range(len(tokens)) if samples is None else parse_ranges(samples, len(tokens), option)
    tokens = [tokens[i] for i in chosen]
    missing = data.missing_sweeps(tokens, config.num_sweeps)
    if missing:
        print(f"{missing} sweep files of split {split!r} are missing", file=sys.stderr)
    projection = config.projection
    return NuScenesFrames(
        data,
        tuple(tokens),
        num_sweeps=config.num_sweeps,
        remove_close=projection.remove_close,
        close_m=projection.close_m,
    )


def parse_ranges(text: str, number: int, option: str = "samples") -> list[int]:
    """Indices of ``FIRST:LAST[,FIRST:LAST...]``, each range without its end.

    Args:
        text: ranges in any order that do not overlap.
        number: of what is counted.
        option: where the text is from, for messages.

    Raises:
        ValueError: with the range that cannot be.

    >>> parse_ranges("0:2,5:7", 7)
    [0, 1, 5, 6]
    """
    found: list[int] = []
    for part in text.split(","):
        first, colon, last = part.partition(":")
        if not (colon and first.strip().isdecimal() and last.strip().isdecimal()):
            raise ValueError(f"{option}: got {part!r}, expected FIRST:LAST")
        indices = range(int(first), int(last))
        if not indices or int(last) > number:
            raise ValueError(f"{option}: got {part!r}, expected FIRST < LAST within the {number} keyframes")
        if set(indices) & set(found):
            raise ValueError(f"{option}: {part!r} overlaps with another range of {text!r}")
        found += indices
    return found


def _objects(
    recipe: CopyPasteConfig, frames: NuScenesFrames, index: Path, split: str, args: Train
) -> ObjectDatabase:
    """The prepared objects of the split, or, for a part of it, objects of that part alone."""
    if args.samples is None:
        folder = objects_folder(index, split)
        if not folder.is_dir():
            raise ValueError(
                f"{folder}: no objects here, expected those of split {split!r}: "
                f"run fcos-lidar prepare --train-split {split}, or train with --no-copy-paste"
            )
        source = read_manifest(folder).source
        # Objects of more sweeps than are fused will do: those too many are left out.
        whole = dataclasses.replace(frames, remove_close="all", close_m=1.0)
        wanted = (dataclasses.replace(whole, num_sweeps=n) for n in range(frames.num_sweeps, _MOST_SWEEPS + 1))
        if not any(source == fingerprint(index, each) for each in wanted):
            raise ValueError(
                f"{folder}: cut from other frames than split {split!r} of this index, or from fewer sweeps than "
                f"{frames.num_sweeps}, expected these: run fcos-lidar prepare again"
            )
        return open_objects(folder)

    def cut() -> ObjectDatabase:
        return build_objects(
            frames,
            args.out / "objects",
            shards=[("chosen", list(range(len(frames))))],
            fingerprint=fingerprint(index, frames),
            min_points=recipe.min_points,
        )

    if jax.process_count() > 1:  # one cuts, the others find it done
        if jax.process_index() == 0:
            cut()
        multihost_utils.sync_global_devices("objects")
    return cut()


def _weights(folder: Path, training: Run) -> Variables:
    """The weights of a checkpoint of the same network."""
    folder = find_checkpoint(folder)
    variables = load_checkpoint(folder).variables
    expected = jax.eval_shape(training.detector.init, jax.random.key(0))
    check_arrays(folder, expected, variables, whose="the network that is to be trained")
    return variables


def _feed(
    args: Train, config: Config, frames: NuScenesFrames, objects: ObjectDatabase | None, num_steps: int
) -> Feed:
    def feed(first_step: int) -> Any:
        return make_batches(
            frames,
            config,
            seed=args.seed,
            num_steps=num_steps,
            first_step=first_step,
            objects=objects,
            process_index=jax.process_index(),
            num_processes=jax.process_count(),
            threads=args.threads,
            workers=args.workers,
        )

    return feed

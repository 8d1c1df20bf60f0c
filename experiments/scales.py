"""Where and how long the cells of a table are trained.

- ``smoke``: a toy network and a few steps on a few simulated frames: that everything runs, in minutes, on two
  cores. Its scores mean nothing.
- ``simulated``: the quickstart's network on ten sweeps of hurried simulated streets. One GPU, or a long CPU run.
- ``calm``: the same with ordinary traffic, to tell what the hurry does.
- ``nuscenes``: the paper's detector on a data set in the nuScenes layout that ``fcos-lidar prepare`` has seen.
"""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any, Literal, Protocol

import jax
import numpy as np
from claim import claim

from fcos_lidar_jax.commands import evaluate as evaluate_command
from fcos_lidar_jax.commands import train as train_command
from fcos_lidar_jax.commands.prepare import default_train_split, fingerprint
from fcos_lidar_jax.commands.runs import Plan, Rhythm, Run
from fcos_lidar_jax.config import NUSCENES, QUICKSTART, Config, InferenceConfig, StemConfig
from fcos_lidar_jax.data.cached import CachedFrames
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.index import has_index
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames, default_index
from fcos_lidar_jax.data.object_builder import build_objects
from fcos_lidar_jax.data.objects import ObjectDatabase
from fcos_lidar_jax.data.pipeline import epoch_frames, make_batches, steps_per_epoch
from fcos_lidar_jax.data.synthetic.frame_set import SimulatedFrames
from fcos_lidar_jax.data.synthetic.lidar import SWEEP_S
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.sensors import SHORT_RANGE, TINY, Sensor
from fcos_lidar_jax.training import load_checkpoint
from fcos_lidar_jax.training.snapshots import CHECKPOINTS, Snapshots

_UNSEEN = 1_000_000
"""Seeds of test streets start here."""


_BONNET_M = 2.1
"""Nearer points are on the own bonnet, which would leave a trail when sweeps are fused."""


class Scale(Protocol):
    """Where and how long cells are trained."""

    @property
    def name(self) -> str:
        """As on the command line."""
        ...

    @property
    def base(self) -> Config:
        """What the tables' rows are changes of."""
        ...

    def check(self, config: Config) -> None:
        """Refuse a row that cannot be trained here, or that would change nothing: ValueError."""
        ...

    def score(self, config: Config, seed: int, folder: Path) -> dict[str, Any]:
        """Train in the folder and evaluate: ``{"mAP", "NDS", "AP": {class: AP}}``."""
        ...

    def describe(self) -> dict[str, Any]:
        """What of the scale decides a cell's result, as JSON."""
        ...


@dataclasses.dataclass(frozen=True)
class NewestSweeps:
    """Simulated frames of which only the newest sweeps are kept; what is annotated, the current sweep decides."""

    frames: CachedFrames
    num_sweeps: int

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.frames)

    def frame(self, index: int) -> Frame:
        """One frame without the older sweeps."""
        frame = self.frames.frame(index)
        newest = frame.points[:, 4] < (self.num_sweeps - 0.5) * SWEEP_S
        return dataclasses.replace(frame, points=frame.points[newest])

    def labels(self, index: int) -> np.ndarray:
        """Of the frame's boxes."""
        return self.frames.labels(index)

    def name(self, index: int) -> str:
        """As without the choice."""
        return self.frames.name(index)


@dataclasses.dataclass(frozen=True)
class Simulated:
    """Simulated streets, ten sweeps a frame, the same frames for every cell."""

    name: str
    base: Config
    sensor: Sensor
    train_frames: int
    test_frames: int
    cache: Path
    """Frames are simulated once and kept here."""
    hurry: bool = True
    """The car is fast, and nearly all that can move does."""

    def describe(self) -> dict[str, Any]:
        """Streets and sensor."""
        return {
            "scale": self.name,
            "sensor": dataclasses.asdict(self.sensor),
            "train_frames": self.train_frames,
            "test_frames": self.test_frames,
            "sweeps": self.base.num_sweeps,
            "hurry": self.hurry,
            "close_m": _BONNET_M,
        }

    def check(self, config: Config) -> None:
        """The streets' sensor, sweeps and close points are those of the base."""
        if not 1 <= config.num_sweeps <= self.base.num_sweeps:
            raise ValueError(
                f"num_sweeps: got {config.num_sweeps}, expected 1 to {self.base.num_sweeps} at scale {self.name}"
            )
        ours, base = (
            {
                "sensor": c.sensor,
                "projection.remove_close": c.projection.remove_close,
                "projection.close_m": c.projection.close_m,
            }
            for c in (config, self.base)
        )
        for field, value in ours.items():
            if value != base[field]:
                raise ValueError(f"{field}: got {value!r}, expected {base[field]!r} at scale {self.name}")

    def frames(self, split: str, num_sweeps: int) -> "NewestSweeps":
        """Training or test streets; the same, and the same sweeps, however many of them are fused."""
        number, first = {"train": (self.train_frames, 0), "test": (self.test_frames, _UNSEEN)}[split]
        sweeps = self.base.num_sweeps
        made = SimulatedFrames(self.sensor, number, first, num_sweeps=sweeps, hurry=self.hurry, close_m=_BONNET_M)
        return NewestSweeps(CachedFrames(made, self._folder(f"{split}_{number}", sweeps)), num_sweeps)

    def _folder(self, what: str, num_sweeps: int) -> Path:
        calm = "" if self.hurry else "_calm"
        return self.cache / f"{self.sensor.name}_{what}_{num_sweeps}_sweeps{calm}"

    def clouds(self, num_sweeps: int, number: int = 20) -> list[np.ndarray]:
        """The first test clouds, f32[n, 5], for figures that need no training."""
        frames = self.frames("test", num_sweeps)
        return [frames.frame(i).points for i in range(min(number, len(frames)))]

    def objects(self, num_sweeps: int) -> ObjectDatabase:
        """For copy-paste."""
        frames = self.frames("train", num_sweeps)
        folder = self._folder(f"objects_{self.train_frames}", num_sweeps)
        everything = list(range(len(frames)))
        # Two builders would sweep away each other's files.
        with claim(folder.with_suffix(".lock"), wait=True):
            return build_objects(
                frames, folder, shards=[("all", everything)], fingerprint=repr(frames.frames.frames)
            )

    def score(self, config: Config, seed: int, folder: Path) -> dict[str, Any]:
        """Train on the training streets, evaluate on the test streets."""
        frames, tests = (self.frames(split, config.num_sweeps) for split in ("train", "test"))
        objects = None if config.copy_paste is None else self.objects(config.num_sweeps)
        an_epoch = len(epoch_frames(frames, config, seed=seed))
        steps = config.optimizer.epochs * steps_per_epoch(an_epoch, config.optimizer.batch_size)
        plan = Plan(config, self.sensor, steps, seed, self.describe())
        run = Run(folder, plan, Rhythm(save_every=-(-steps // 5), evaluate_every=steps), tests=None)

        def feed(first_step: int) -> Any:
            return make_batches(
                frames,
                config,
                seed=seed,
                num_steps=steps,
                first_step=first_step,
                objects=objects,
                threads=1,
            )

        run.train(feed, resume=(folder / "run.json").exists(), devices=jax.devices()[:1])
        variables = load_checkpoint(Snapshots(folder / CHECKPOINTS).paths()[-1]).variables
        read = [tests.frame(i) for i in range(len(tests))]
        summary = evaluate_frames([run.detections(variables, frame) for frame in read], read).summary
        return _scores(summary)


@dataclasses.dataclass(frozen=True)
class Layout:
    """Options of --scale nuscenes."""

    data_root: Path | None = None
    """Folder of a data set in the nuScenes layout that fcos-lidar prepare has seen."""
    version: str = "v1.0-trainval"
    """Folder of its tables."""
    index: Path | None = None
    """Where fcos-lidar prepare has put the index; default: DATA_ROOT/.fcos_lidar/VERSION."""
    splits: Path | None = None
    """File {name: [scene, ...]} with own splits."""
    train_split: str | None = None
    """Default: mini_train for a version that ends in mini, else train."""
    val_split: str | None = None
    """Default: mini_val or val."""
    test_version: str | None = None
    """Version whose split test table 8 writes a results file for, such as v1.0-test."""
    allow_missing_sweeps: bool = False
    """Go on with fewer sweeps where files of older sweeps are missing."""
    steps: int | None = None
    """Updates of every cell, instead of the preset's epochs."""
    accumulate: int = 1
    """Parts that a batch is cut into where it does not fit; changes batch norm alone."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the convolutions behind the first."""
    threads: int = 2
    """That prepare batches."""
    workers: int = 0
    """Processes that prepare batches, beside the threads."""


@dataclasses.dataclass(frozen=True)
class NuScenesLayout:
    """A data set in the nuScenes layout that ``fcos-lidar prepare`` has seen, by the commands themselves.

    Raises:
        ValueError: at construction, where data, index or splits are not there.
    """

    layout: Layout
    name: str = "nuscenes"

    def __post_init__(self) -> None:
        """Look before anything is trained."""
        if self.layout.data_root is None:
            raise ValueError("--data-root: missing, expected the data set for --scale nuscenes")
        if self.layout.test_version is not None:
            tables = self.layout.data_root / self.layout.test_version
            if not tables.is_dir():
                raise ValueError(f"--test-version: {tables}: no such folder, expected the version's tables")
        self.describe()

    @property
    def data_root(self) -> Path:
        """Of the data set."""
        assert self.layout.data_root is not None
        return self.layout.data_root

    @property
    def splits(self) -> tuple[str, str]:
        """To train and to evaluate on."""
        layout = self.layout
        val = "mini_val" if layout.version.endswith("mini") else "val"
        return layout.train_split or default_train_split(layout.version), layout.val_split or val

    @property
    def base(self) -> Config:
        """The paper's detector."""
        return dataclasses.replace(
            NUSCENES,
            model=dataclasses.replace(NUSCENES.model, precision=self.layout.precision),
            optimizer=dataclasses.replace(NUSCENES.optimizer, accumulate=self.layout.accumulate),
        )

    @functools.cache  # noqa: B019 - a handful of scales a process
    def describe(self) -> dict[str, Any]:
        """Data, splits and steps."""
        layout = self.layout
        index = layout.index or default_index(self.data_root, layout.version)
        if (self.data_root / layout.version).is_dir() and not has_index(index):
            raise ValueError(f"{index}: no index here, expected one: run fcos-lidar prepare")
        data = NuScenes(
            self.data_root, layout.version, index=index, allow_missing_sweeps=layout.allow_missing_sweeps
        )
        tokens = {split: data.split(split, file=layout.splits) for split in self.splits}
        return {
            "scale": self.name,
            "version": layout.version,
            "splits": list(self.splits),
            "fingerprints": [fingerprint(index, NuScenesFrames(data, tuple(tokens[s]))) for s in self.splits],
            "steps": layout.steps,
            # Where it is not set, it cannot have changed a thing.
            **({"allow_missing_sweeps": True} if layout.allow_missing_sweeps else {}),
        }

    def check(self, config: Config) -> None:
        """All can be trained here."""

    def score(self, config: Config, seed: int, folder: Path) -> dict[str, Any]:
        """``fcos-lidar train`` and ``fcos-lidar evaluate``; the results file stays in the folder."""
        layout, (train_split, val_split) = self.layout, self.splits
        train_command.run(
            train_command.Train(
                config,
                data_root=self.data_root,
                version=layout.version,
                out=folder,
                index=layout.index,
                train_split=train_split,
                val_split="none",
                splits=layout.splits,
                resume=(folder / "run.json").exists(),
                seed=seed,
                steps=layout.steps,
                threads=layout.threads,
                workers=layout.workers,
                allow_missing_sweeps=layout.allow_missing_sweeps,
            )
        )
        out = folder / f"evaluation_{val_split}"
        evaluate_command.run(
            evaluate_command.Evaluate(
                out=out,
                data_root=self.data_root,
                version=layout.version,
                split=val_split,
                checkpoint=folder,
                index=layout.index,
                splits=layout.splits,
                report=False,
                allow_missing_sweeps=layout.allow_missing_sweeps,
            )
        )
        return _scores(json.loads((out / "metrics_summary.json").read_text()))


def _scores(summary: dict[str, Any]) -> dict[str, Any]:
    aps = {name: round(ap, 5) for name, ap in summary["mean_dist_aps"].items()}
    return {"mAP": round(summary["mean_ap"], 5), "NDS": round(summary["nd_score"], 5), "AP": aps}


_TEN_SWEEPS = dataclasses.replace(
    QUICKSTART,
    name="small",
    num_sweeps=10,
    max_points=40_960,
    copy_paste=None,
    class_balanced=False,
    augment=None,
    projection=NUSCENES.projection,
    model=dataclasses.replace(
        QUICKSTART.model,
        # As many channels a type as there are rounds, or table 3 could not leave them ungrouped.
        stem=StemConfig(channels_per_type=5, out_channels=16),
    ),
    optimizer=dataclasses.replace(QUICKSTART.optimizer, epochs=2),
)
_TOY = dataclasses.replace(
    _TEN_SWEEPS,
    name="toy",
    max_points=10_240,
    model=dataclasses.replace(
        _TEN_SWEEPS.model,
        stem=StemConfig(channels_per_type=5, out_channels=8),
        backbone_blocks=(1, 1, 1, 1),
        backbone_widths=(8, 8, 8, 8),
        fpn_channels=8,
        head_channels=8,
        head_convs=1,
    ),
    inference=InferenceConfig(max_detections=50, candidates_per_level=100),
)


def smoke(cache: Path) -> Simulated:
    """A toy that runs in seconds; its scores mean nothing."""
    sensor = dataclasses.replace(TINY, name="toy", num_columns=64)
    return Simulated("smoke", _TOY, sensor, train_frames=16, test_frames=6, cache=cache)


def simulated(cache: Path) -> Simulated:
    """The quickstart's network on ten sweeps of what is near."""
    return Simulated("simulated", _TEN_SWEEPS, SHORT_RANGE, train_frames=1200, test_frames=200, cache=cache)


def calm(cache: Path) -> Simulated:
    """As simulated, in ordinary traffic."""
    return dataclasses.replace(simulated(cache), name="calm", hurry=False)

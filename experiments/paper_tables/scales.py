"""Data and length of the training of a table's cells.

- ``smoke``: a toy network and a few steps on a few simulated frames, to check in minutes that everything runs. Its
  scores mean nothing.
- ``sector``: a small network, with sizes that compact had before 2026-11-27, on ten sweeps of varied simulated
  streets in a quarter of the view of nuScenes' sensor, at full resolution and range. Half an hour of one CPU core
  per cell.
- ``nuscenes``: the paper's detector on a data set in the nuScenes layout, prepared by ``fcos-lidar prepare``.
"""

import contextlib
import dataclasses
import functools
import math
import operator
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro

from experiments.cached import CachedFrames
from experiments.changes import AHEAD, BONNET_M, SLIM, change
from experiments.pool import simulating
from experiments.real_frames import scores_by_range
from experiments.runs import benchmark, detections, trained
from experiments.second_look import USES, look_again, look_config
from fcos_lidar_jax.config import CloudReading, Config, InferenceConfig, StemConfig
from fcos_lidar_jax.data.frame import Frame, SelectedFrames, WrappedFrames
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.evaluation.metrics import evaluate
from fcos_lidar_jax.evaluation.results import read_results, result_entries, write_results
from fcos_lidar_jax.evaluation.truth import split_truth
from fcos_lidar_jax.files import checksum, file_lock, refusing
from fcos_lidar_jax.inference import CloudDetector, Prediction
from fcos_lidar_jax.inference.prediction_log import write_predictions
from fcos_lidar_jax.input_pipeline import database
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase
from fcos_lidar_jax.input_pipeline.loader import default_threads, steps_per_epoch
from fcos_lidar_jax.input_pipeline.open import default_split, find_data_set
from fcos_lidar_jax.presets import COMPACT, NUSCENES, QUICKSTART
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, TINY, Sensor, sector
from fcos_lidar_jax.simulation.frame_set import UNSEEN_SEED, SimulatedFrames
from fcos_lidar_jax.simulation.lidar import SWEEP_S
from fcos_lidar_jax.simulation.streets import CITY, PLAIN, Streets
from fcos_lidar_jax.training import Schedule
from fcos_lidar_jax.training.metrics_log import read_metrics

_LOOK_SAMPLES = 2000  # Augmented frames in which boxes are found for a second look.
_CURVE_FRAMES = 100  # Test frames of evaluations during training.
_PROCESSES = 4  # Processes assumed to share the cores, so that each reads frames with a quarter of the threads.


@dataclasses.dataclass(frozen=True)
class NewestSweeps(WrappedFrames):
    """Frames reduced to their newest sweeps; their annotations depend on the current sweep only."""

    num_sweeps: int

    def frame(self, index: int) -> Frame:
        frame = self.frames.frame(index)
        newest = frame.points[:, 4] < (self.num_sweeps - 0.5) * SWEEP_S
        return dataclasses.replace(frame, points=frame.points[newest])

    def fingerprint(self) -> str:
        return checksum(repr((self.frames.fingerprint(), self.num_sweeps)).encode())


@dataclasses.dataclass(frozen=True)
class Simulated:
    """Simulated streets with ten sweeps per frame, the same for each cell."""

    name: str
    base: Config  # Configuration that the rows of tables change.
    sensor: Sensor
    train_frames: int
    test_frames: int
    cache: Path  # Folder of the frames, which are simulated once.
    streets: Streets = PLAIN
    num_objects: int = 14  # See make_frame, also for the next two.
    reach_m: float = 10.0
    min_points: int = 5
    evaluations: int = 0  # Evaluations on the first test frames during training.

    def describe(self) -> dict[str, Any]:
        """Describe all that determines the result of a cell, as JSON."""
        return {
            "scale": self.name,
            "streets": dataclasses.asdict(self.streets),
            "num_objects": self.num_objects,
            "reach_m": self.reach_m,
            "min_points": self.min_points,
            "sensor": {k: v for k, v in dataclasses.asdict(self.sensor).items() if k != "forward_rad"},
            "train_frames": self.train_frames,
            "test_frames": self.test_frames,
            "sweeps": self.base.num_sweeps,
            "close_m": BONNET_M,
        }

    def check(self, config: Config) -> None:
        """Raise a ValueError for a row that cannot be trained here or would change nothing."""
        sweeps = self.base.num_sweeps
        if not 1 <= config.num_sweeps <= sweeps:
            raise ValueError(f"num_sweeps: got {config.num_sweeps}, expected 1 to {sweeps} at scale {self.name}")
        for field in ("sensor", "projection.remove_close", "projection.close_m"):
            value, base = (operator.attrgetter(field)(c) for c in (config, self.base))
            if value != base:
                raise ValueError(f"{field}: got {value!r}, expected {base!r} at scale {self.name}")

    def frames(self, split: str, num_sweeps: int) -> NewestSweeps:
        """Training or test frames, with the same streets and sweeps for each number of sweeps."""
        number, first = {"train": (self.train_frames, 0), "test": (self.test_frames, UNSEEN_SEED)}[split]
        sweeps = self.base.num_sweeps
        reading, extent = CloudReading(sweeps, "all", BONNET_M), (self.num_objects, self.reach_m, self.min_points)
        made = SimulatedFrames(self.sensor, number, first, *extent, reading, streets=self.streets)
        return NewestSweeps(CachedFrames(made, self._folder(f"{split}_{number}", sweeps)), num_sweeps)

    @contextlib.contextmanager
    def simulating(self, processes: int) -> Iterator[None]:
        """Context manager in which a number of processes simulate the training frames, and one the test frames."""
        with contextlib.ExitStack() as started:
            for split, number in (("train", processes), ("test", min(processes, 1))):
                cached = self.frames(split, self.base.num_sweeps).frames
                assert isinstance(cached, CachedFrames)
                started.enter_context(simulating(cached, number))
            yield

    def _folder(self, content: str, num_sweeps: int) -> Path:
        return self.cache / f"{self.sensor.name}_{content}_{num_sweeps}_sweeps"

    def clouds(self, num_sweeps: int) -> list[np.ndarray]:
        """Points of the first twenty test frames, f32[n, 5], for figures that need no training."""
        frames = self.frames("test", num_sweeps)
        return [frames.frame(i).points for i in range(min(20, len(frames)))]

    def objects(self, num_sweeps: int) -> GroundTruthDatabase:
        folder = self._folder(f"objects_{self.train_frames}", num_sweeps)
        # Concurrent builders would delete each other's files.
        with file_lock(folder.with_suffix(".lock"), wait=True):
            return database.prepare_database(self.frames("train", num_sweeps), folder)

    def score(self, config: Config, seed: int, folder: Path) -> dict[str, Any]:
        """Train in a folder and evaluate: ``{"mAP", "NDS", "AP": {class: AP}, "errors"}``.

        A second look with ``freeze_detector`` is trained afterwards, on boxes in 2,000 of the frames.
        ``errors`` are nuScenes' errors of true positives: means over the classes, and of cars. With
        ``evaluations`` also ``curve``, [[samples, mAP]], ``ranges``, scores by distance, and ``seconds_of_steps``.
        """
        frames, tests = (self.frames(split, config.num_sweeps) for split in ("train", "test"))
        objects = None if config.copy_paste is None else self.objects(config.num_sweeps)
        steps = config.optimizer.epochs * steps_per_epoch(frames, config)
        options: dict[str, Any] = {"threads": max(default_threads() // _PROCESSES, 1)}
        if self.evaluations:
            first = SelectedFrames(tests, tuple(range(min(_CURVE_FRAMES, len(tests)))))
            options |= {"tests": first, "schedule": Schedule(-(-steps // 20), -(-steps // self.evaluations))}
        look = config.refinement if config.trains_second_look_only else None
        first = config if look is None else dataclasses.replace(config, refinement=None)
        detector = trained(folder, first, frames, steps=steps, seed=seed, objects=objects, **options)
        if look is not None:
            samples = min(_LOOK_SAMPLES, len(frames))
            numbers = {"samples": samples, "updates": USES * samples, "seed": seed, "folder": folder / "boxes"}
            detector = look_again(detector, look_config(first, look), frames, **numbers)
        boxes, test_frames = detections(detector, tests)
        scores = _scores(benchmark(boxes, test_frames).summary)
        if not self.evaluations:
            return scores
        batch, records = config.optimizer.batch_size, read_metrics(folder)
        return scores | {
            "curve": [[r["step"] * batch, round(r["test/mAP"], 5)] for r in records if "test/mAP" in r],
            "ranges": scores_by_range(boxes, test_frames),
            "seconds_of_steps": round(sum(r.get("seconds", 0.0) for r in records)),
        }


@dataclasses.dataclass(frozen=True)
class NuScenesLayout:
    """A data set in the nuScenes layout, prepared by ``fcos-lidar prepare``; used like :class:`Simulated`.

    The fields are the options of --scale nuscenes. Call :meth:`checked` before the rest.
    """

    data_root: Path | None = None  # Folder of a data set in the nuScenes layout, after fcos-lidar prepare.
    version: str | None = None  # Folder of its tables; default: the only one.
    index: Path | None = None
    """Index written by fcos-lidar prepare; default: DATA_ROOT/.fcos_lidar/VERSION."""
    splits: Path | None = None  # File {name: [scene, ...]} with your own splits of --version.
    train_split: str | None = None  # Default: that of fcos-lidar prepare, train or mini_train.
    val_split: str | None = None  # Default: val or mini_val.
    test_version: str | None = None
    """Version, such as v1.0-test. Table 8 writes a results file for its split test."""
    allow_missing_sweeps: bool = False  # Use fewer sweeps if files of older sweeps are missing.
    steps: int | None = None  # Updates of each cell, instead of the preset's epochs.
    accumulate: Annotated[int, tyro.conf.arg(aliases=("--optimizer.accumulate",))] = 1
    """Micro-batches per step, if a batch does not fit; only batch norm changes."""
    batch_size: int = NUSCENES.optimizer.batch_size  # Samples per step.
    learning_rate: float = NUSCENES.optimizer.peak_learning_rate  # Peak learning rate.
    precision: Annotated[Literal["float32", "bfloat16"], tyro.conf.arg(aliases=("--model.precision",))] = "float32"
    """Precision of the convolutions after the first."""
    remat: Annotated[bool, tyro.conf.arg(aliases=("--model.remat",))] = False
    """Recompute the largest activations, for less memory."""
    threads: int | None = None  # Threads that prepare batches; default: as fcos-lidar train.
    workers: int = 0  # Additional processes that prepare batches.

    @property
    def name(self) -> str:
        return "nuscenes"

    def checked(self) -> "NuScenesLayout":
        """Fill in the defaults, and refuse missing data, indices and splits, of --test-version too."""
        data = find_data_set(self.data_root, "nuscenes", self.version)
        split = functools.partial(default_split, data, required=True, splits=self.splits)
        splits = {"train_split": self.train_split or split("train"), "val_split": self.val_split or split("val")}
        whole = dataclasses.replace(self, version=data.version, index=self.index or data.index, **splits)
        whole.describe()
        if self.test_version is not None:  # before days of training
            with refusing("--test-version", ValueError):
                whole.frames("test", whole.base, self.test_version).frame(0)
        return whole

    @property
    def base(self) -> Config:
        return change(
            model__precision=self.precision,
            model__remat=self.remat,
            optimizer__batch_size=self.batch_size,
            optimizer__accumulate=self.accumulate,
            optimizer__peak_learning_rate=self.learning_rate,
        )(NUSCENES)

    @functools.cache  # noqa: B019 - few scales per process
    def _data(self, version: str) -> NuScenes:
        index = self.index if version == self.version else None
        assert self.data_root is not None
        return NuScenes(self.data_root, version, index=index, allow_missing_sweeps=self.allow_missing_sweeps)

    def frames(self, split: str | None, config: Config, version: str | None = None) -> NuScenesFrames:
        """Keyframes of a split, of the layout's version or another, read according to a configuration."""
        assert split is not None
        version = version or self.version
        assert version is not None
        data = self._data(version)
        splits = self.splits if version == self.version else None  # names scenes of the layout's version
        return NuScenesFrames(data, tuple(data.split(split, file=splits)), config.reading)

    @functools.cache  # noqa: B019
    def describe(self) -> dict[str, Any]:
        splits = [self.train_split, self.val_split]
        return {
            "scale": self.name,
            "version": self.version,
            "splits": splits,
            "fingerprints": [self.frames(split, NUSCENES).fingerprint() for split in splits],
            "steps": self.steps,
            "allow_missing_sweeps": self.allow_missing_sweeps,
        }

    def objects(self, frames: NuScenesFrames) -> GroundTruthDatabase:
        """Open the database that fcos-lidar prepare has cut from the training frames."""
        assert self.index is not None
        folder = database.objects_folder(self.index, str(self.train_split))
        reading = database.cut_reading(database.open_database(folder).manifest.num_sweeps)
        source = dataclasses.replace(frames, reading=reading).fingerprint()
        return database.open_database(folder, fingerprint=source)

    def score(self, config: Config, seed: int, folder: Path) -> dict[str, Any]:
        """Train and evaluate like the benchmark; the results file stays in the folder."""
        frames, tests = self.frames(self.train_split, config), self.frames(self.val_split, config)
        steps = self.steps or config.optimizer.epochs * steps_per_epoch(frames, config)
        objects = None if config.copy_paste is None else self.objects(frames)
        options = {"devices": jax.devices(), "threads": self.threads, "workers": self.workers}
        options |= {"schedule": Schedule()}  # saves like fcos-lidar train, since a cell takes hours
        detector = trained(folder, config, frames, steps=steps, seed=seed, objects=objects, **options)
        file = folder / f"results_{self.val_split}.json"
        write_submission(detector, tests, file)
        truth = split_truth(tests.nuscenes, list(tests.tokens))
        return _scores(evaluate(read_results(file, truth.tokens).boxes, truth).summary)


Scale = Simulated | NuScenesLayout


def write_submission(detector: CloudDetector, frames: NuScenesFrames, file: Path) -> None:
    """Detect in keyframes and write the benchmark's results file; resumes after an interruption."""
    data, tokens = frames.nuscenes, frames.tokens
    file.parent.mkdir(parents=True, exist_ok=True)

    def entries(found: Prediction) -> tuple[list[dict[str, Any]], str]:
        token = tokens[found.index]
        return result_entries(found.detections, token, data.sensor_to_global(token), detector.classes), ""

    write_predictions(detector, frames, file, entries=entries, write=write_results)


def _scores(summary: dict[str, Any]) -> dict[str, Any]:
    aps = {name: round(ap, 5) for name, ap in summary["mean_dist_aps"].items()}
    errors = {"mean": summary["tp_errors"], "car": summary["label_tp_errors"].get("car", {})}
    shown = {
        kind: {name: round(value, 4) for name, value in own.items() if math.isfinite(value)}
        for kind, own in errors.items()
    }
    return {"mAP": round(summary["mean_ap"], 5), "NDS": round(summary["nd_score"], 5), "AP": aps, "errors": shown}


small_network = change(
    model__backbone_blocks=(1, 1, 1, 1),
    model__backbone_widths=(8, 8, 8, 8),
    model__fpn_channels=8,
    model__head_channels=8,
    model__head_convs=1,
)
_TOY = change(
    name="toy",
    num_sweeps=10,
    max_points=10_240,
    copy_paste=None,
    class_balanced=False,
    augment=None,
    projection=dataclasses.replace(NUSCENES.projection, remove_close="all", close_m=BONNET_M),
    # Table 3 needs at least as many channels per type as rounds.
    model__stem=StemConfig(channels_per_type=5, out_channels=8),
    inference=InferenceConfig(max_detections=50, candidates_per_level=100),
    optimizer__epochs=2,
)(small_network(QUICKSTART))


def smoke(cache: Path) -> Simulated:
    """Create the scale ``smoke``."""
    sensor = dataclasses.replace(TINY, name="toy", num_columns=64)
    return Simulated("smoke", _TOY, sensor, train_frames=16, test_frames=6, cache=cache)


_SECTOR = change(
    name="sector",
    num_sweeps=10,
    max_points=81_920,
    **AHEAD,
    model__local_geometry=False,
    # Wider than SLIM, for the 45 inputs of five rounds.
    model__stem__channels_per_type=8,
    model__stem__out_channels=24,
    optimizer__ema_decay=0.998,
    optimizer__epochs=2,
)(SLIM(COMPACT))


def quarter(cache: Path) -> Simulated:
    """Create the scale ``sector``, which the ledger's verdicts rest on."""
    extent = {"num_objects": 60, "reach_m": NUSCENES_HDL32E.limit_xy_m, "min_points": 1}
    ahead = sector(NUSCENES_HDL32E, math.pi / 2, 272)
    sizes = {"train_frames": 4000, "test_frames": 400, "cache": cache, "evaluations": 8}
    return Simulated("sector", _SECTOR, ahead, **sizes, streets=CITY, **extent)

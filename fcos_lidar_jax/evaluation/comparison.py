"""Metric, results file and ground truth of an evaluation."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.evaluation.boxes import BoxColumns, GroundTruth
from fcos_lidar_jax.evaluation.frames import frame_columns, read_detections, write_detections
from fcos_lidar_jax.evaluation.metrics import NUSCENES_METRIC, Metric
from fcos_lidar_jax.evaluation.records import as_records
from fcos_lidar_jax.evaluation.results import read_results, result_entries, write_results
from fcos_lidar_jax.types import Detections


class Compared(NamedTuple):
    """Predictions beside the truth."""

    predictions: BoxColumns
    truth: GroundTruth
    meta: dict[str, Any]  # of the results file
    warnings: Sequence[str] = ()
    detections: Sequence[Detections] = ()  # by frame; empty with the benchmark's metric


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A metric with its results file."""

    file: str  # name of the results file
    metric: Metric
    entries: Callable[[int, Detections], list[dict[str, Any]]]
    """Index of a frame and its detections -> its boxes as the file has them."""
    write: Callable[[Path, Iterable[tuple[str, bytes]]], None]  # names of the frames with their boxes as JSON
    read: Callable[[Path], Compared]


RESULT_FILES = ("results_nusc.json", "detections.json")


def compare_by_benchmark(
    truth: GroundTruth, of: str, classes: Sequence[str] = NUSCENES_CLASSES, frames: FrameSet | None = None
) -> Comparison:
    """Compare by the metric of nuScenes.

    ``of`` describes the samples in messages. The labels of detections index ``classes``. Detections can only be
    written if the samples are ``frames``, whose poses lead to the global frame.
    """

    def entries(index: int, detections: Detections) -> list[dict[str, Any]]:
        pose = None if frames is None else frames.pose(index)
        assert pose is not None
        return result_entries(detections, truth.tokens[index], pose, classes)

    def read(file: Path) -> Compared:
        results = read_results(file, truth.tokens, of=of)
        return Compared(results.boxes, truth, results.meta, results.warnings)

    return Comparison(RESULT_FILES[0], NUSCENES_METRIC, entries, write_results, read)


def compare_by_distance(frames: FrameSet, ranges_m: dict[str, float]) -> Comparison:
    """Compare by average precision and errors, matched by centre distance, over the classes of ``ranges_m``."""
    classes, names = tuple(ranges_m), [frames.name(index) for index in range(len(frames))]

    def read(file: Path) -> Compared:
        truths = (frames.truth(index) for index in range(len(frames)))
        detections = read_detections(file, names, classes)
        return Compared(*frame_columns(detections, truths, names), {}, detections=detections)

    return Comparison(
        RESULT_FILES[1],
        Metric(ranges_m),
        lambda _, detections: as_records(detections, classes),
        partial(write_detections, classes=classes),
        read,
    )

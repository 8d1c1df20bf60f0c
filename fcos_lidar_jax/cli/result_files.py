"""The formats in which ``detect`` and ``stream`` write boxes, beside their own JSON."""

import contextlib
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli.checks import check_out_folder, check_outputs, check_outside
from fcos_lidar_jax.data.kitti import TO_NUSCENES, read_calibration
from fcos_lidar_jax.data.point_files import ENDINGS
from fcos_lidar_jax.evaluation.kitti_results import kitti_types, write_result
from fcos_lidar_jax.evaluation.openlabel import write_openlabel
from fcos_lidar_jax.evaluation.records import read_boxes
from fcos_lidar_jax.evaluation.results import result_entries, write_results
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.types import Detections

Format = Literal["json", "nuscenes", "kitti", "openlabel"]
Write = Callable[[dict[str, Any]], None]


class ResultFormat(NamedTuple):
    """Properties of an output format."""

    calibrated: bool = False  # in the frame of a camera, one file per cloud; --out is a folder
    in_world: bool = False  # in the global frame


FORMATS: dict[Format, ResultFormat] = {
    "json": ResultFormat(),
    "nuscenes": ResultFormat(in_world=True),
    "kitti": ResultFormat(calibrated=True),
    "openlabel": ResultFormat(),
}
_LABEL_COLUMNS = 15  # Results have a score after them.
_TYPES = kitti_types(TO_NUSCENES) | kitti_types()


def check_result_files(args: Any, keep: Sequence[Path]) -> None:
    """Reject a ``calibration`` without KITTI's format, and an ``out`` that cannot be written in the format."""
    calibrated = FORMATS[args.output_format].calibrated
    if args.calibration is not None and not calibrated:
        raise ValueError("--calibration: expected only with --output-format kitti")
    if calibrated:
        check_outside("--out", args.out, args.checkpoint)
        check_out_folder(args.out)
        for file in sorted(args.out.glob("*.txt")):
            if any(len(line.split()) == _LABEL_COLUMNS for line in file.read_text(errors="replace").splitlines()):
                raise ValueError(f"--out: {file}: found labels, which have no score, expected results or nothing")
    else:
        check_outputs(args.checkpoint, keep, out=args.out)


def check_results(args: Any, classes: Sequence[str], *, posed: bool, clouds: Sequence[Path] = ()) -> None:
    """Reject classes and clouds for which the format has no place, before anything is detected."""
    for name in args.labels or ():
        if name not in classes:
            raise ValueError(f"--labels: got {name!r}, expected some of {', '.join(classes)}")
    option, row = f"--output-format {args.output_format}", FORMATS[args.output_format]
    if row.in_world:
        if others := [name for name in classes if name not in NUSCENES_CLASSES]:
            raise ValueError(f"{option}: got the classes {', '.join(others)}, expected only classes of nuScenes")
        if not posed:
            raise ValueError(f"{option}: found no poses, expected some: the boxes are in the global frame")
    if row.calibrated:
        if not any(name.lower() in _TYPES for name in classes):
            raise ValueError(f"{option}: got the classes {', '.join(classes)}, expected some of KITTI's")
        for number, cloud in enumerate(clouds):
            read_calibration(_calibration(args.calibration, cloud, _stem(cloud, number)))
        if len({_stem(cloud, number) for number, cloud in enumerate(clouds)}) < len(clouds):
            raise ValueError(f"{option}: got clouds of the same name, expected different names")


@contextlib.contextmanager
def result_files(
    output_format: Format, out: Path, classes: Sequence[str], *, annotator: str, calibration: Path | None = None
) -> Iterator[Write]:
    """A function that takes lines of ``stream``. KITTI's files are written at once, one file at the end."""
    if FORMATS[output_format].calibrated:
        with _kitti(out, classes, calibration) as write:
            yield write
        return
    with tempfile.TemporaryFile() as stream:
        records = _Lines(stream)
        yield records.write
        if FORMATS[output_format].in_world:
            write_results(out, (_sample(record, classes) for record in records))
        else:
            write_openlabel(out, records, annotator=annotator)


class _Lines:
    """Records in a file of lines, which can be read repeatedly."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, record: dict[str, Any]) -> None:
        self._stream.write(json.dumps(record).encode() + b"\n")

    def __iter__(self) -> Iterator[dict[str, Any]]:
        self._stream.seek(0)
        return map(json.loads, self._stream)


def _sample(record: dict[str, Any], classes: Sequence[str]) -> tuple[str, bytes]:
    """The sample of a results file, called by its token or by its cloud."""
    boxes, labels, scores = read_boxes(record, classes)
    arrays: Any = boxes, scores, labels, np.ones(len(boxes), bool), np.int32(0)
    token = record.get("token") or Path(record["file"]).name
    entries = result_entries(Detections(*arrays), token, np.array(record["sensor_to_world"]), classes)
    return token, json.dumps(entries).encode()


@contextlib.contextmanager
def _kitti(folder: Path, classes: Sequence[str], calibration: Path | None) -> Iterator[Write]:
    number = num_boxes = num_left_out = 0
    written = set[str]()

    def write(record: dict[str, Any]) -> None:
        nonlocal number, num_boxes, num_left_out
        cloud, stem = Path(record["file"]), _stem(record["file"], number)
        if stem in written:
            raise ValueError(f"{cloud}: got a second cloud named {stem}, expected different names")
        written.add(stem)
        boxes, labels, scores = read_boxes(record, classes)
        types = np.array([_TYPES.get(classes[int(label)].lower(), "") for label in labels], object)
        kept = types != ""
        rows = boxes[kept], types[kept].tolist(), scores[kept]
        calibrated = read_calibration(_calibration(calibration, cloud, stem))
        num_left_out += int((~kept).sum()) + write_result(folder / f"{stem}.txt", *rows, calibrated)
        num_boxes += len(boxes)
        number += 1

    yield write
    if num_left_out:
        why = "outside of the image, or of a class without a type of KITTI"
        tell(f"{folder}: {num_left_out} of {num_boxes} boxes left out: {why}")
    if others := [file.name for file in sorted(folder.glob("*.txt")) if file.stem not in written]:
        tell(f"{folder}: also contains {len(others)} .txt of other clouds, such as {others[0]}")


def _stem(cloud: str | Path, number: int) -> str:
    """Name of a cloud's results file: the name of its point file, or the number of the sweep."""
    name = Path(cloud).name
    ending = next((ending for ending in ENDINGS if name.lower().endswith(ending)), None)
    return name[: -len(ending)] if ending else f"{number:06d}"


def _calibration(given: Path | None, cloud: Path, stem: str) -> Path:
    """The given file, or the cloud's in the given folder or in ``calib`` beside the folder of the cloud."""
    if given is not None and not given.is_dir():
        return given
    file = (given or cloud.absolute().parent.parent / "calib") / f"{stem}.txt"
    if not file.is_file():
        raise ValueError(f"--output-format kitti: {file}: no such file, expected --calibration FILE or DIR")
    return file

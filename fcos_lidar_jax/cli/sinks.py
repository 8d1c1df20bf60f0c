"""The outputs of ``detect`` and ``stream``: boxes in several formats, pictures, a page, and a recording."""

import contextlib
import dataclasses
import itertools
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence, Sized
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli.checks import check_out_file
from fcos_lidar_jax.data.kitti import TO_NUSCENES, read_calibration
from fcos_lidar_jax.data.point_files import ENDINGS
from fcos_lidar_jax.evaluation.json_io import write_lines
from fcos_lidar_jax.evaluation.kitti_results import kitti_types, write_result
from fcos_lidar_jax.evaluation.openlabel import write_openlabel
from fcos_lidar_jax.evaluation.records import SHOWN_SCORE, ScoredBoxes, read_boxes
from fcos_lidar_jax.evaluation.results import result_entries, write_results
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.files import expect_file, line_writer
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import Detections
from fcos_lidar_jax.visualization.page import PageFrame, page_frame, write_page
from fcos_lidar_jax.visualization.rerun_recording import rerun_recording

Format = Literal["json", "nuscenes", "kitti", "openlabel"]
Record = dict[str, Any]  # a line of ``stream``, or an entry of ``detect``
Write = Callable[[Record], object]
Add = Callable[[Record, np.ndarray], None]


_LABEL_COLUMNS = 15  # Results have a score after them.
_LARGEST_PAGE = 5e8  # Characters; the longest text of browsers has 2**29.
_TYPES = kitti_types(TO_NUSCENES) | kitti_types()


def check_results(args: Any, classes: Sequence[str], *, posed: bool, clouds: Sequence[Path] = ()) -> None:
    """Reject what the format has no place for, before anything is detected."""
    for name in args.labels or ():
        check(name in classes, "--labels", name, f"some of {', '.join(classes)}")
    option = f"--output-format {args.output_format}"
    if args.output_format == "nuscenes":
        if others := [name for name in classes if name not in NUSCENES_CLASSES]:
            raise ValueError(f"{option}: got the classes {', '.join(others)}, expected only classes of nuScenes")
        if not posed:
            raise ValueError(f"{option}: found no poses, expected some: the boxes are in the global frame")
    if args.output_format == "kitti":
        check(any(name.lower() in _TYPES for name in classes), option, ", ".join(classes), "some classes of KITTI")
        stems = [_stem(cloud, number) for number, cloud in enumerate(clouds)]
        if len(set(stems)) < len(stems):
            raise ValueError(f"{option}: got clouds of the same name, expected different names")
        for cloud, stem in zip(clouds, stems, strict=True):
            read_calibration(_calibration(args.calibration, cloud, stem))
        check_out_file("--out", args.out / "000000.txt", [])
        for file in sorted(args.out.glob("*.txt")):
            lines = [line.split() for line in file.read_text(errors="replace").splitlines()]
            if any(len(words) == _LABEL_COLUMNS or words[:1] == ["P2:"] for words in lines):
                raise ValueError(f"--out: {file}: found labels or a calibration, expected results or nothing")


@contextlib.contextmanager
def open_sinks(
    args: Any,
    classes: Sequence[str],
    sensor: Sensor,
    *,
    title: str,
    in_lines: bool = False,
    more: Record | None = None,
) -> Iterator[Add]:
    """A function that adds a record and its points to all outputs; the end of the context closes them.

    JSON ``in_lines`` and KITTI's files are written at once, other files at the end, and not after a failure.
    ``more`` completes the records of ``out``.
    """
    result, views = _result(args, classes, in_lines=in_lines), list[Callable[..., object]]()
    frames, min_score = list[PageFrame](), SHOWN_SCORE if args.min_score is None else args.min_score
    tracked = getattr(args, "track", False)
    with contextlib.ExitStack() as stack:
        write = stack.enter_context(result)
        if args.page is not None:
            views.append(_collect(frames))
        if args.rrd is not None:
            views.append(stack.enter_context(rerun_recording(args.rrd, classes, min_score=min_score)))
        if getattr(args, "pictures", None) is not None:
            views.append(_pictures(args.pictures, classes, sensor.limit_xy_m, min_score))

        def add(record: Record, points: np.ndarray) -> None:
            write({**record, **(more or {})})
            if views:
                found, details = read_boxes(record, classes), _details(record, tracked=tracked)
                for view in views:
                    view(points, found, **details)

        yield add
        if args.page is not None:
            write_page(args.page, frames, sensor, classes=classes, title=title, min_score=min_score)


@contextlib.contextmanager
def closing_at_failure(sinks: contextlib.ExitStack, done: Sized) -> Iterator[None]:
    """If the block fails after the first sweep, close the sinks, which then write the sweeps that are ``done``."""
    try:
        yield
    except BaseException:
        if done:
            sinks.pop_all().close()
            tell(f"the outputs have the {len(done)} sweeps before the failure")
        raise


def _collect(frames: list[PageFrame]) -> Callable[..., None]:
    """A function that collects the frames of a page, as many as a browser can read."""

    size = 0

    def add(*given: Any, **details: Any) -> None:
        nonlocal size
        if size < _LARGEST_PAGE:
            frames.append(frame := page_frame(*given, **details))
            size += len(json.dumps(dataclasses.asdict(frame)))
        else:
            tell(f"note: --page ends after {len(frames)} clouds: browsers cannot read more", once="page")

    return add


def _details(record: Record, *, tracked: bool) -> dict[str, Any]:
    """The name and, in a drive, time, pose and track numbers, as pages and recordings take them."""
    details: dict[str, Any] = {"name": Path(record["file"]).name}
    if (time_us := record.get("timestamp_us")) is not None:
        details["time_us"] = time_us
    if (pose := record.get("sensor_to_world")) is not None:
        details["pose"] = np.array(pose)
    if tracked:
        details["ids"] = np.array([box["track"] for box in record["boxes"]], np.int64)
    return details


def _pictures(folder: Path, classes: Sequence[str], limit_m: float, min_score: float) -> Callable[..., None]:
    from fcos_lidar_jax.visualization.bev import draw_bev

    numbers = itertools.count(1)

    def draw(points: np.ndarray, found: ScoredBoxes, *, name: str) -> None:
        path, shown = folder / f"{next(numbers):04d}_{name}.png", found[2] >= min_score
        path.parent.mkdir(parents=True, exist_ok=True)
        title = f"{path.stem}: boxes of score {min_score:g} and more"
        boxes, labels, scores = (part[shown] for part in found)
        how: dict[str, Any] = {"limit_m": limit_m, "classes": classes, "title": title}
        draw_bev(points, path, detections=(boxes, labels, scores), **how)

    return draw


def _result(args: Any, classes: Sequence[str], *, in_lines: bool) -> contextlib.AbstractContextManager[Write]:
    """A function that writes a record to ``out`` in the ``output_format``."""
    out, annotator = args.out, f"fcos-lidar, {args.checkpoint.name}"
    if args.output_format == "kitti":
        return _kitti(out, classes, args.calibration)
    if args.output_format == "nuscenes":
        return _whole_file(lambda lines: write_results(out, (_sample(record, classes) for record in lines)))
    if args.output_format == "openlabel":
        return _whole_file(lambda lines: write_openlabel(out, lines, annotator=annotator))
    if in_lines:
        return _json_lines(out)
    return _whole_file(lambda lines: write_lines(out, b'{"files": [', lines.encoded(), b"]}\n"))


@contextlib.contextmanager
def _json_lines(out: Path) -> Iterator[Write]:
    """One line per record, written at once. The first line replaces an earlier file."""
    with contextlib.ExitStack() as stack:
        opened: list[Callable[[bytes], None]] = []

        def write(record: Record) -> None:
            if not opened:
                opened.append(stack.enter_context(line_writer(out)))
            opened[0](json.dumps(record).encode())

        yield write


@contextlib.contextmanager
def _whole_file(write: Callable[["_Lines"], None]) -> Iterator[Write]:
    """Records in a temporary file until the end."""
    with tempfile.TemporaryFile() as stream:
        yield lambda record: stream.write(json.dumps(record).encode() + b"\n")
        write(_Lines(stream))


class _Lines:
    """Records in a file of lines, which can be read repeatedly."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def encoded(self) -> Iterator[bytes]:
        self._stream.seek(0)
        return (line.rstrip(b"\n") for line in self._stream)

    def __iter__(self) -> Iterator[Record]:
        return map(json.loads, self.encoded())


def _sample(record: Record, classes: Sequence[str]) -> tuple[str, bytes]:
    """The sample of a results file, called by its token or by its cloud."""
    boxes, labels, scores = read_boxes(record, classes)
    arrays: Any = boxes, scores, labels, np.ones(len(boxes), bool), np.int32(0)
    token = record.get("token") or Path(record["file"]).name
    entries = result_entries(Detections(*arrays), token, np.array(record["sensor_to_world"]), classes)
    return token, json.dumps(entries).encode()


@contextlib.contextmanager
def _kitti(folder: Path, classes: Sequence[str], calibration: Path | None) -> Iterator[Write]:
    """KITTI's result files, each written at once."""
    number = num_boxes = num_left_out = 0
    written = set[str]()

    def write(record: Record) -> None:
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
    expect_file(file, "--calibration FILE or DIR for --output-format kitti")
    return file

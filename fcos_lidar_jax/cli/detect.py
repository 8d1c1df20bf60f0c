"""``fcos-lidar detect``: the boxes of point files, or of a recording."""

import dataclasses
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tyro

from fcos_lidar_jax.cli import options
from fcos_lidar_jax.cli.checks import Excludes, Or, Output
from fcos_lidar_jax.cli.options import alignment_of, option
from fcos_lidar_jax.cli.sinks import check_results, open_sinks
from fcos_lidar_jax.data.cloud_policy import truncation
from fcos_lidar_jax.data.clouds import CloudFiles, find_clouds
from fcos_lidar_jax.data.frame import no_points
from fcos_lidar_jax.data.point_files import ENDINGS, MAX_POINTS
from fcos_lidar_jax.data.recorded import usual_sensor
from fcos_lidar_jax.data.sweeps import ListedSweep, read_list
from fcos_lidar_jax.evaluation.records import SHOWN_SCORE, cloud_record, select
from fcos_lidar_jax.inference import Prediction, load_detector
from fcos_lidar_jax.inference.prediction_log import write_predictions
from fcos_lidar_jax.inference.stream import only_older
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import KITTI_HDL64E

_LISTED = Excludes(("files", "full_turn"), "the list names the files, which keep all points")
_INPUT = (
    f"Point files ({', '.join(ENDINGS)}), one cloud per file, or folders of them; or one recording that "
    "`fcos-lidar stream` reads. Sweeps of KITTI raw and Argoverse 2 are fused; for poses or a topic of a ROS "
    "recording, use `stream`."
)


@dataclasses.dataclass(frozen=True)
class Detect:
    """Detect boxes in point files, or a recording, and write them as JSON, or in the format of an annotation
    tool.

    A box is [x, y, z, l, w, h, yaw, vx, vy]: centre, length along the heading, width and height in metres, yaw in
    radians counter-clockwise from +x, velocity in m/s, all in the frame of the points.

    After Ctrl-C or a kill, the same command resumes and repeats only a few clouds, even if files were added or
    removed since; a recording starts again. A file that is given twice is processed once.
    """

    files: tyro.conf.Positional[
        Annotated[tuple[Path, ...], Or("sweeps"), option("INPUT", default="the list of --sweeps", text=_INPUT)]
    ]
    checkpoint: options.Detector
    out: Annotated[Path, Output.RESULT, option("FILE")]  # File to write.
    output_format: options.OutputFormat = "json"
    calibration: options.Calibration = None
    sweeps: Annotated[Path | None, _LISTED, option("FILE.json")] = None
    """Sweeps to fuse, instead of INPUT: [{"file", "timestamp_us", "sensor_to_world": 4x4}, ...], newest first."""
    data_sensor: options.DataSensor = None
    yaw_deg: options.Yaw = None
    intensity_scale: options.IntensityScale = None
    full_turn: options.FullTurn = False
    min_score: options.MinScore = None
    labels: options.Labels = None
    remove_close: options.Close = None
    pictures: Annotated[Path | None, Output.FOLDER, option("DIR")] = None
    """Also draw every cloud with its boxes, in bird's-eye view."""
    page: options.Page = None
    rrd: options.Rrd = None
    columns: options.Columns = None
    dtype: options.Dtype = None
    viewpoint: options.Viewpoint = False
    max_file_points: options.MaxFilePoints = MAX_POINTS
    batch_size: options.BatchSize = 1
    backend: options.Backend = "xla"


def run(args: Detect) -> None:
    """Detect in all files, then write; finished files are kept in a log beside the output until then."""
    files, sweeps = _inputs(args.files, args.sweeps)
    if args.full_turn and not any(usual_sensor(file) == KITTI_HDL64E for file in files):
        raise ValueError(f"--full-turn: expected none for {files[0]}: only files of KITTI are cropped")
    parts = [Path(sweep.file) for sweep in sweeps]
    detector = load_detector(args.checkpoint, backend=args.backend)
    classes, config = detector.classes, detector.config
    check_results(args, classes, posed=bool(sweeps), clouds=parts[:1] or files)
    aligned = alignment_of(args, detector.sensor, parts or files)
    notes = aligned.notes
    if len(parts) > config.num_sweeps:
        line = f"fuses the first {config.num_sweeps} of {len(parts)} sweeps, as the detector was trained"
        notes = (*notes, f"{args.sweeps}: {line}")
    reading = dataclasses.replace(config.reading, remove_close=args.remove_close or config.reading.remove_close)
    layout: dict[str, Any] = {name: getattr(args, name) for name in ("columns", "dtype", "full_turn", "viewpoint")}
    clouds = CloudFiles(files, aligned.data, reading, max_points=args.max_file_points, **layout)
    shown_score = SHOWN_SCORE if args.min_score is None else args.min_score
    place = msgspec.to_builtins(sweeps[0]) if sweeps and args.output_format != "json" else None

    def entries(found: Prediction) -> tuple[list[dict[str, Any]], str]:
        assert found.cloud is not None
        note = found.note
        if sweeps and note is None and (note := only_older(files[0], found.cloud, detector.sensor)):
            tell(f"note: {note}")
        min_score = args.min_score if note is None else math.inf  # without usable points, no boxes
        kept = select(found.detections, classes, min_score=min_score, labels=args.labels)
        record = {"file": str(files[found.index]), **cloud_record(kept, found.cloud, classes)}
        clear = sum(box["score"] >= shown_score for box in record["boxes"])
        boxes = f"{len(record['boxes'])} boxes, {clear} of score {shown_score:g} and more"
        return [record], f"{record['file']}: {boxes}"

    def write(_: Path, lines: Iterator[tuple[str, bytes]]) -> None:
        """Write all outputs. Pictures need the clouds again, since an interrupted call may have read some."""
        pictured = any(path is not None for path in (args.pictures, args.page, args.rrd))
        with open_sinks(args, classes, clouds.sensor, title=f"Boxes of {args.checkpoint.name}", more=place) as add:
            for index, record in enumerate(json.loads(line)[0] for _, line in lines):
                add(record, clouds.frame(index).points if pictured else no_points(clouds.sensor))

    how: dict[str, Any] = {"batch_size": args.batch_size, "yaw_rad": aligned.yaw_rad, "notes": notes}
    how |= {"options": [args.min_score, args.labels], "unit": "files"}
    removed = write_predictions(detector, clouds, args.out, entries=entries, write=write, **how)
    if line := truncation(removed["truncated"], config):
        tell(line)


def _inputs(inputs: tuple[Path, ...], listed: Path | None) -> tuple[tuple[Path, ...], list[ListedSweep]]:
    """The files, each once; or the list of sweeps, and its entries with the paths of their files."""
    for file in inputs:
        if file.suffix.lower() == ".json":
            raise ValueError(f"{file}: expected a point file, or --sweeps before a list of sweeps")
    if listed is None:
        distinct = dict[str, Path]()
        for file in find_clouds(inputs):
            distinct.setdefault(os.path.abspath(file), file)
        return tuple(distinct.values()), []
    if listed.suffix != ".json":
        raise ValueError(f"--sweeps: {listed}: expected a file that ends in .json")
    sweeps = read_list(listed)
    return (listed,), [msgspec.structs.replace(each, file=str(listed.parent / each.file)) for each in sweeps]

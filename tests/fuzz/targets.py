"""The targets: valid files, and the reader of each with checks of its result."""

import dataclasses
import functools
import io
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from made_argoverse2 import START_NS, STEP_NS, write_boxes, write_poses, write_sweep
from made_bags import Messages, structured, write_recording
from made_kitti import calibration_text, label_text
from made_nuscenes import VERSION, make_tables
from made_nuscenes import write as write_nuscenes

from fcos_lidar_jax.checkpoints.storage import read_description
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli.data import read_class_map
from fcos_lidar_jax.config import CloudReading, config_to_json
from fcos_lidar_jax.data import argoverse2
from fcos_lidar_jax.data.argoverse2 import Argoverse2Frames
from fcos_lidar_jax.data.box_geometry import check_boxes
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.data.drives import read_tum
from fcos_lidar_jax.data.folder import FolderFrames
from fcos_lidar_jax.data.frame import Frame, FrameSet, drop_close
from fcos_lidar_jax.data.kitti import KittiFrames
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.point_files import read_points
from fcos_lidar_jax.data.ros_bags import ros_bag_drive
from fcos_lidar_jax.data.sweeps import read_sweeps
from fcos_lidar_jax.evaluation.boxes import BoxColumns
from fcos_lidar_jax.evaluation.frames import read_detections
from fcos_lidar_jax.evaluation.results import LIDAR_META, read_results
from fcos_lidar_jax.evaluation.resume_log import ResumeLog
from fcos_lidar_jax.evaluation.truth import read_truth, split_truth
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.geometry import pose_matrix
from fcos_lidar_jax.input_pipeline.open import READERS
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import (
    ARGOVERSE2,
    KITTI_HDL64E,
    NUSCENES_HDL32E,
    TINY,
    Sensor,
    load_sensor,
    sensor_from_json,
    sensor_to_json,
)
from fcos_lidar_jax.training.metrics_log import read_metrics

CONFIG = dataclasses.replace(QUICKSTART, max_points=64)
_RNG = np.random.default_rng(0)
POINTS = np.column_stack([_RNG.uniform(-20, 20, (60, 2)), _RNG.uniform(-2, 1, 60), _RNG.uniform(0, 90, 60)])
POSE = np.eye(4).tolist()

NAMES = (
    *("raw points", "raw points of KITTI", "npy", "npz", "pcd", "feather", "Argoverse 2", "KITTI"),
    *("folder", "nuScenes", "list of sweeps", "sensor", "poses", "recordings of ROS", "class map"),
    *("results", "ground truth", "detections", "metrics.jsonl", "resume log", "checkpoint.json"),
)
"""Of all targets, in the order of :func:`make_targets`."""

Files = Mapping[str, bytes]
Read = Callable[[Path, str], None]
"""Reads a folder, given the name of the changed file in it, and asserts that the result is valid."""


@dataclasses.dataclass(frozen=True)
class Target:
    """A kind of file."""

    name: str
    files: Files  # path below the folder -> content
    read: Read
    alone: bool = False  # messages must name the file, not only the folder


def check_points(points: np.ndarray, sensor: Sensor) -> None:
    assert (points.dtype, points.shape) == (np.float32, (len(points), sensor.point_columns))
    kept, num_close = drop_close(points, sensor, CONFIG.reading)
    config = dataclasses.replace(CONFIG, num_sweeps=100)
    cloud = make_cloud(kept, config, sensor=sensor, num_close=num_close)
    assert np.isfinite(cloud.points[cloud.valid]).all(), "points that are not finite"
    assert cloud.valid.sum() + cloud.num_removed == len(points), "points that are not counted"


def check_frame(frame: Frame, frames: FrameSet) -> None:
    check_points(frame.points, frames.sensor)
    check_boxes(frame.boxes, "box {}".format)
    assert frame.boxes.dtype == np.float32, "boxes that are not float32"
    for column in (frame.labels, frame.num_points):
        assert (column.dtype, column.shape) == (np.int32, (len(frame.boxes),)), "a column of another shape"
    assert ((frame.labels >= 0) & (frame.labels < len(frames.classes))).all(), "a label that is no class"
    assert (frame.num_points >= 0).all(), "a negative number of points"


def check_first(frames: FrameSet) -> None:
    check_frame(frames.frame(0), frames)


def check_columns(boxes: BoxColumns) -> None:
    for name in ("translation", "size", "yaw", "score"):
        assert np.isfinite(getattr(boxes, name)).all(), f"{name} that is not finite"
    assert (boxes.size > 0).all(), "sizes that are not positive"
    assert not np.isinf(boxes.velocity).any(), "infinite velocities"
    assert ((boxes.label >= 0) & (boxes.label < len(NUSCENES_CLASSES))).all(), "a label that is no class"


def _cloud(sensor: Sensor, **options: dict) -> Read:
    def read(folder: Path, name: str) -> None:
        check_points(read_points(folder / name, sensor, **options.get(name.partition(".")[0], {})), sensor)

    return read


def _raw(dtype: str, *columns: np.ndarray) -> bytes:
    return np.column_stack([POINTS[:, :3], *columns]).astype(dtype).tobytes()


def _saved(save: Callable, *arrays: np.ndarray, **named: np.ndarray) -> bytes:
    stream = io.BytesIO()
    save(stream, *arrays, **named)
    return stream.getvalue()


def _json(value: object) -> bytes:
    return json.dumps(value).encode()


def _files(write: Callable[[Path], object]) -> dict[str, bytes]:
    """The files that a function writes into a folder."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder))
        found = sorted(file for file in Path(folder).rglob("*") if file.is_file())
        return {file.relative_to(folder).as_posix(): file.read_bytes() for file in found}


def _pcd_files() -> dict[str, bytes]:
    rows = POINTS[:12].astype("<f4")

    def header(form: str, fields: str = "x y z intensity") -> bytes:
        words = fields.split()
        lines = f"SIZE{' 4' * len(words)}\nTYPE{' F' * len(words)}\nCOUNT{' 1' * len(words)}\nWIDTH 12\nHEIGHT 1\n"
        return f"# .PCD v0.7\nFIELDS {fields}\n{lines}POINTS 12\nDATA {form}\n".encode()

    plain = rows.T.tobytes() + bytes(48)
    packed = b"".join(bytes([31]) + plain[i : i + 32] for i in range(0, 192, 32)) + bytes([0, 0, 0xE0, 38, 0])
    sizes = np.array([len(packed), len(plain)], "<u4").tobytes()
    return {
        "ascii.pcd": header("ascii") + "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode(),
        "binary.pcd": header("binary") + rows.tobytes(),
        "packed.pcd": header("binary_compressed", "x y z intensity time_lag") + sizes + packed,
    }


def _argoverse2_files(folder: Path) -> None:
    times = (START_NS, START_NS + STEP_NS)
    for time in times:
        write_sweep(folder, time, np.column_stack([POINTS, np.arange(60) % 64]))
    write_poses(folder, np.array(times), np.tile(np.eye(4), (2, 1, 1)))
    box = {"box": [8, 1, 0, 4, 2, 2, 0.3], "category": "BUS", "count": 3}
    write_boxes(folder, [{**box, "time_ns": time, "track": track} for time in times for track in "ab"])


def _read_argoverse2(folder: Path, name: str) -> None:
    argoverse2._cached_log.cache_clear()  # files change faster than their times
    frames = Argoverse2Frames(folder, reading=CloudReading(2))
    check_frame(frames.frame(len(frames) - 1), frames)


def _kitti_files() -> dict[str, bytes]:
    box = label_text([12, 1, -0.5, 4, 1.6, 1.5, 0.3]) + label_text([15, -4, -0.5, 4, 1.6, 1.5, -3], "Pedestrian")
    return {
        "training/velodyne/000000.bin": _raw("f4", POINTS[:, 3] / 100),
        "training/label_2/000000.txt": (
            box + "DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n"
        ).encode(),
        "training/calib/000000.txt": calibration_text().encode(),
        "ImageSets/train.txt": b"000000\n",
    }


def _folder_files() -> dict[str, bytes]:
    box = {"label": "car", "box": [8, 1, -1, 4, 2, 1.5, 0.3, None, None]}
    times_us = {"a": 9000, "b": 5000}
    listed = [
        {"file": f"../clouds/{n}.npy", "timestamp_us": t, "sensor_to_world": POSE} for n, t in times_us.items()
    ]
    clouds = {f"clouds/{name}.npy": _saved(np.save, POINTS.astype("f4")) for name in "ab"}
    return clouds | {
        "boxes/a.json": _json({"boxes": [box, {**box, "label": "sign", "score": 0.5}]}),
        "boxes/b.json": _json({"boxes": []}),
        "sweeps/a.json": _json(listed),
        "sensor.json": _json(sensor_to_json(TINY)),
        "classes.json": _json({"car": "car", "sign": None, "lorry": "truck"}),
        "splits.json": _json({"train": ["a"], "val": ["b"]}),
    }


def _read_folder(folder: Path, name: str) -> None:
    frames = FolderFrames(folder, split="train", reading=CloudReading(2))
    check_first(frames)
    frames.fingerprint()


def _read_poses(folder: Path, name: str) -> None:
    times_us, rotations, translations = read_tum(folder / name)
    assert (np.diff(times_us) > 0).all(), "times that do not increase"
    assert np.isfinite(pose_matrix(rotations, translations)).all(), "a pose that is not finite"


def _recordings(folder: Path) -> None:
    def content(make: Messages) -> Iterator[tuple[str, object]]:
        yield "/tf_static", make.transform(0, "base_link", "lidar", (0, 0, 1), (0, 0, 0, 1))
        for time_ns in (0, 10**8):
            yield "/odom", make.odometry(time_ns, (time_ns / 1e8, 0, 0), (0, 0, 0, 1))
        yield "/points", make.cloud(5 * 10**7, structured(POINTS[:12].astype("f4")))

    for form in ("ros1", "sqlite", "mcap"):
        write_recording(folder / form, form, content)
    (folder / "mcap" / "mcap.mcap").rename(folder / "a.mcap")
    (folder / "mcap" / "metadata.yaml").unlink()


def _read_recording(folder: Path, name: str) -> None:
    path = folder / name
    for sweep in ros_bag_drive(path.parent if path.parent != folder else path, TINY, odometry="/odom").sweeps:
        check_points(sweep.points, TINY)
        assert np.isfinite(sweep.sensor_to_world).all(), "a pose that is not finite"


def _read_nuscenes(folder: Path, name: str) -> None:
    data = NuScenes(folder, VERSION)
    tokens = data.split("all")
    check_points(data.fuse_sweeps(tokens[0], CloudReading(2, "none"))[0], NUSCENES_HDL32E)
    boxes = data.boxes(tokens[0])
    check_boxes(boxes.boxes, "box {}".format)
    truth = split_truth(data, tokens)
    check_columns(truth.boxes)


def _box(**more: object) -> dict[str, object]:
    plain = {"translation": [1.0, 2, 3], "size": [2.0, 4, 1.5], "rotation": [1.0, 0, 0, 0], "velocity": [0.5, 0]}
    return {**plain, "detection_name": "car", "attribute_name": "vehicle.moving", **more}


def _read_truth(folder: Path, name: str) -> None:
    truth = read_truth(folder / name)
    check_columns(truth.boxes)
    for values in (truth.ego_translation, truth.rack_axes):
        assert np.isfinite(values).all(), "values that are not finite"


def _read_detections(folder: Path, name: str) -> None:
    for found in read_detections(folder / name, ("a", "b"), ("car", "sign")):
        boxes = np.asarray(found.boxes)
        assert np.isfinite(boxes[:, :7]).all(), "boxes that are not finite"
        assert not np.isinf(boxes).any(), "infinite velocities"
        assert (boxes[:, 3:6] > 0).all(), "sizes that are not positive"
        assert (np.isfinite(found.scores) & (found.scores >= 0)).all(), "a score that is none"


def _read_sweeps(folder: Path, name: str) -> None:
    points, _ = read_sweeps(folder / "a.json", TINY, CloudReading(99, "all"))
    if len(points):
        check_points(points, TINY)


def _read_sensor(folder: Path, name: str) -> None:
    sensor = load_sensor(folder / name)
    assert sensor_from_json(json.loads(json.dumps(sensor_to_json(sensor)))) == sensor, "another sensor"
    assert len(sensor.row_edges_rad) == sensor.num_rows + 1, "no rows"
    assert sensor.point_columns in (5, 6)


def _read_class_map(folder: Path, name: str) -> None:
    found = read_class_map(str(folder / name), READERS[0])
    assert all(name is None or isinstance(name, str) for name in found.values()), "no map"


def _read_metrics(folder: Path, name: str) -> None:
    for line in read_metrics(folder):
        assert isinstance(line["step"], int), "a line without a step"


def _read_resume_log(folder: Path, name: str) -> None:
    with ResumeLog(folder / name, "this detector") as log:
        log.add("new", [])
        entries = {token: log.entry(token) for token in log.places}
        assert entries["new"] == b"[]", "other entries"
    with ResumeLog(folder / name, "this detector") as log:
        assert "new" in log, "an entry that was lost"


def _resume_log(folder: Path) -> None:
    with ResumeLog(folder / "a.resume_log", "this detector") as log:
        for token in "abc":
            log.add(token, [_box()])


def _description() -> bytes:
    description = {"format": 3, "step": 4, "files": {"a": "0"}, "data": "", "score": None}
    description |= {"config": config_to_json(CONFIG), "sensor": sensor_to_json(TINY)}
    return _json(description | {"hash": checksum(json.dumps(description, sort_keys=True).encode())})


def make_targets() -> list[Target]:
    """All targets, with files that their readers accept."""
    lag, ring = np.zeros(60), np.arange(60) % 32
    raw = {
        "a.pcd.bin": _raw("f4", POINTS[:, 3], ring),
        "three.bin": _raw("f8"),
        "five.bin": _raw("f4", POINTS[:, 3], lag),
        "half.pcd.bin": _raw("f2", POINTS[:, 3], ring, lag),
    }
    layouts = {"three": {"columns": 3, "dtype": "float64"}, "five": {"columns": 5}}
    layouts["half"] = {"columns": 6, "dtype": "float16"}
    arrays = {
        "a.npy": _saved(np.save, POINTS[:12].astype("f4")),
        "b.npy": _saved(np.save, np.column_stack([POINTS, lag, ring])[:12]),
    }
    archives = {
        "a.npz": _saved(np.savez_compressed, POINTS[:12].astype("f4")),
        "b.npz": _saved(np.savez, points=POINTS[:12].astype("f4"), other=ring),
    }
    sweep = _files(lambda folder: write_sweep(folder, 0, np.column_stack([POINTS, np.arange(60) % 64])))
    drive = _files(_argoverse2_files)
    tables = _files(lambda folder: write_nuscenes(folder, *make_tables(1)))
    listed = [{"file": "a.npy", "timestamp_us": t, "sensor_to_world": POSE} for t in (9000, 5000)]
    found = {"a": [], "b": [{**_box(), "sample_token": "b", "detection_score": 0.5}] * 2}
    truth = {t: {"ego_translation": [0.0, 0, 0], "boxes": [_box(num_pts=3)] * 2} for t in "ab"}
    truth["b"]["boxes"] = [_box(detection_name="static_object.bicycle_rack", attribute_name="", num_pts=-1)]
    detection = {"label": "car", "score": 0.5, "box": [1, 2, 3, 4, 2, 1.5, 0, None, None]}
    frames = [{"name": "a", "boxes": [detection] * 2}, {"name": "b", "boxes": []}]
    lines = [{"step": step, "seconds": 0.1, "loss": [0.5, float("nan")]} for step in range(1, 5)]
    sensors = {"a.json": sensor_to_json(TINY)}
    sensors["b.json"] = {
        "name": "b",
        "num_columns": 9,
        "inclinations_deg": {"lowest": -9, "highest": 3, "rows": 4},
    }
    file_target = functools.partial(Target, alone=True)
    return [
        file_target("raw points", raw, _cloud(NUSCENES_HDL32E, **layouts)),
        file_target("raw points of KITTI", {"a.bin": _raw("f4", POINTS[:, 3] / 100)}, _cloud(KITTI_HDL64E)),
        file_target("npy", arrays, _cloud(NUSCENES_HDL32E)),
        file_target("npz", archives, _cloud(NUSCENES_HDL32E)),
        file_target("pcd", _pcd_files(), _cloud(NUSCENES_HDL32E)),
        file_target("feather", {"a.feather": next(iter(sweep.values()))}, _cloud(ARGOVERSE2)),
        Target("Argoverse 2", drive, _read_argoverse2),
        Target("KITTI", _kitti_files(), lambda folder, _: check_first(KittiFrames(folder, "train"))),
        Target("folder", _folder_files(), _read_folder),
        Target("nuScenes", tables, _read_nuscenes),
        Target("list of sweeps", {"a.json": _json(listed), "a.npy": arrays["a.npy"]}, _read_sweeps),
        file_target("sensor", {name: _json(record) for name, record in sensors.items()}, _read_sensor),
        file_target("poses", {"a.txt": b"# t\n0.5 1 2 3 0 0 0 1\n1.25 2 2 3 0.6 0 0 0.8\n"}, _read_poses),
        Target("recordings of ROS", _files(_recordings), _read_recording),
        file_target("class map", {"a.json": _json({"Car": "car", "Misc": None})}, _read_class_map),
        file_target(
            "results",
            {"a.json": _json({"meta": LIDAR_META, "results": found})},
            lambda folder, name: check_columns(read_results(folder / name, ("a", "b")).boxes),
        ),
        file_target("ground truth", {"a.json": _json(truth)}, _read_truth),
        file_target(
            "detections", {"a.json": _json({"classes": ["car", "sign"], "frames": frames})}, _read_detections
        ),
        file_target(
            "metrics.jsonl", {"metrics.jsonl": b"".join(_json(line) + b"\n" for line in lines)}, _read_metrics
        ),
        file_target("resume log", _files(_resume_log), _read_resume_log),
        Target(
            "checkpoint.json", {"checkpoint.json": _description()}, lambda folder, name: read_description(folder)
        ),
    ]

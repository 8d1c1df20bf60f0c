"""Argoverse 2: logs written by hand in the official layout against plain geometry; one-line errors."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from made_argoverse2 import START_NS, write_boxes, write_poses, write_sweep, write_table
from refusal import refused
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.argoverse2 import Argoverse2Frames
from fcos_lidar_jax.data.point_files import read_points
from fcos_lidar_jax.sensors import ARGOVERSE2
from fcos_lidar_jax.simulation.frames import make_frame

STEP_NS = 100_000_000
WORLD = np.array([[712.0, 1310, -20], [706, 1322, -21.5], [731, 1301, -22], [700, 1290, -23]])
"""Static points in the city frame."""
MEASURED = np.array([[0, 0], [1, 31], [200, 32], [255, 63]])
"""Intensity and laser number of these points."""
SPEED = np.array([3.0, -4.0, 0.0])
"""Velocity of a car in the city frame."""


def ego(i: int) -> np.ndarray:
    """Pose of the ego vehicle at sweep i: it turns, climbs and drives."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("zyx", [0.4 + 0.1 * i, 0.02 * i, -0.01]).as_matrix()
    pose[:3, 3] = 705 + 1.5 * i, 1305 + 0.5 * i, -22 + 0.1 * i
    return pose


def in_ego(points: np.ndarray, i: int) -> np.ndarray:
    return (points - ego(i)[:3, 3]) @ ego(i)[:3, :3]


def row(i: int, track: object = "car", category: str = "REGULAR_VEHICLE", **changes) -> dict:
    """An annotation at sweep i of a car that drives on straight."""
    place = in_ego(np.array([715.0, 1315, -21]) + SPEED * i * STEP_NS * 1e-9, i)
    box = [*place, 4.5, 1.9, 1.6, 0.3]
    time_ns = START_NS + i * STEP_NS
    return {"time_ns": time_ns, "track": track, "category": category, "box": box, "count": 7 + i} | changes


def write_log(log: Path, rows: list[dict], sweeps: int = 4) -> Path:
    times = START_NS + STEP_NS * np.arange(sweeps)
    for i, time_ns in enumerate(times.tolist()):
        write_sweep(log, time_ns, np.hstack([in_ego(WORLD, i), MEASURED]))
    write_poses(log, times, np.array([ego(i) for i in range(sweeps)]))
    write_boxes(log, rows)
    return log


@pytest.fixture
def root(tmp_path):
    """A log of four sweeps with a car in all of them, a cone in the third and an animal, which is no class."""
    still = {"track": "cone", "category": "CONSTRUCTION_CONE", "count": 1}
    write_log(tmp_path / "train" / "log-a", [row(2, **still), *map(row, (3, 1, 0, 2)), row(1, "cat", "ANIMAL")])
    return tmp_path


def test_static_points_coincide_in_fused_sweeps_of_a_log(root):
    frames = Argoverse2Frames(root, reading=CloudReading(3, "none"))
    assert len(frames) == 4
    for i in range(4):
        points = frames.frame(i).points
        ages = min(i, 2) + 1
        assert points.shape == (4 * ages, 6)
        np.testing.assert_array_equal(points[:, 4], np.repeat(np.arange(ages) * 0.1, 4).astype(np.float32))
        # Half floats hold 30 m to 2 cm.
        np.testing.assert_allclose(points[:, :3], np.tile(in_ego(WORLD, i), (ages, 1)), atol=0.03)
        np.testing.assert_array_equal(points[:, 3], np.tile(MEASURED[:, 0], ages))


def test_lasers_are_rows_from_the_highest_down_in_any_numbering(tmp_path):
    points = make_frame(0, ARGOVERSE2, reading=CloudReading(1, "none")).points
    points[:, :3] = points[:, :3].astype(np.float16)
    x, y, z = (points[:, :3] - ARGOVERSE2.origin_m).T
    slopes = {laser: np.median((z / np.hypot(x, y))[points[:, 5] == laser]) for laser in np.unique(points[:, 5])}
    row = {laser: 63 - sum(other < own for other in slopes.values()) for laser, own in slopes.items()}
    for seed in range(3):
        number = np.random.default_rng(seed).permutation(64)[points[:, 5].astype(int)]
        write_sweep(tmp_path, seed, np.column_stack([points[:, :4], number]))
        read = read_points(tmp_path / f"sensors/lidar/{seed}.feather", ARGOVERSE2)
        assert read[:, 5].tolist() == [row[laser] for laser in points[:, 5]]
        assert np.abs(read[:, 5] - points[:, 5]).max() <= 1  # the simulated lasers are numbered from the top


def test_boxes_are_in_the_ego_frame_with_velocities_from_their_tracks(root):
    frames = Argoverse2Frames(root)
    for i in range(4):
        frame = frames.frame(i)
        names = [frames.classes[label] for label in frame.labels]
        assert names == (["CONSTRUCTION_CONE"] if i == 2 else []) + ["REGULAR_VEHICLE"]
        np.testing.assert_array_equal(frames.labels(i), frame.labels)
        car = frame.boxes[-1]
        np.testing.assert_allclose(car[:7], row(i)["box"], atol=1e-5)
        # The car's velocity in the city, seen along the ego vehicle's axes at that moment.
        np.testing.assert_allclose(car[7:], (ego(i)[:3, :3].T @ SPEED)[:2], atol=1e-4)
        assert frame.num_points.tolist() == ([1] if i == 2 else []) + [7 + i]
    assert np.isnan(frames.frame(2).boxes[0, 7:]).all()  # seen once


def test_labels_are_of_boxes_with_a_point(root):
    write_boxes(root / "train" / "log-a", [row(0, "seen"), row(0, "hidden", "BICYCLE", count=0)])
    frames = Argoverse2Frames(root)
    assert frames.frame(0).num_points.tolist() == [7, 0]
    assert [frames.classes[label] for label in frames.labels(0)] == ["REGULAR_VEHICLE"]


def test_yaw_is_wrapped(root):
    yaws = [np.pi, -np.pi, 3.5, -7.0]
    log = root / "train" / "log-a"
    write_boxes(log, [row(0, k, box=[9, k, 0, 4, 2, 1.5, yaw]) for k, yaw in enumerate(yaws)])
    found = Argoverse2Frames(root).frame(0).boxes[:, 6].astype(np.float64)
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * np.array(yaws)), atol=1e-6)
    assert ((found >= -np.pi - 1e-6) & (found < np.pi)).all()


@pytest.mark.parametrize(
    ("rows", "unknown"),
    [
        # From 0 to 10 is one second, from 0 to 35 more than three.
        ([row(0), row(10), row(35), row(60)], [False, True, True, True]),
        ([row(0), row(1, box=[900, 0, 0, 4, 2, 1.5, 0]), row(2, 1), row(3, 1)], [True, True, False, False]),
    ],
    ids=["gaps", "jump"],
)
def test_velocities_after_gaps_and_jumps_are_unknown(tmp_path, rows, unknown):
    """Central if both neighbours are within 3 s, one-sided within 1.5 s, otherwise unknown."""
    moments = [(row["time_ns"] - START_NS) // STEP_NS for row in rows]
    frames = Argoverse2Frames(write_log(tmp_path / "log", rows, sweeps=moments[-1] + 1))
    assert [np.isnan(frames.frame(i).boxes[0, 7]) for i in moments] == unknown


def test_frames_of_several_logs_have_scene_name_time_and_pose(root):
    write_log(root / "val" / "log-b", [row(0)], sweeps=2)
    frames = Argoverse2Frames(root)
    assert [frames.scene(i) for i in range(6)] == ["log-a"] * 4 + ["log-b"] * 2
    assert (frames.name(1), frames.time_us(1)) == (f"log-a_{START_NS + STEP_NS}", (START_NS + STEP_NS) // 1000)
    np.testing.assert_allclose(frames.pose(5), ego(1), atol=1e-12)
    assert len(frames.frame(4).points) == 4  # not fused with the log before
    for split, number in (("train", 4), ("val", 2)):
        assert len(Argoverse2Frames(root, split)) == number
    assert len(Argoverse2Frames(root / "val")) == len(Argoverse2Frames(root / "val" / "log-b")) == 2
    with refused(f"{root}/vall: no log in it, expected folders with sensors/lidar"):
        Argoverse2Frames(root, "vall")


def test_annotations_are_read_again_after_a_change_and_may_be_missing(root):
    frames = Argoverse2Frames(root)
    assert len(frames.labels(0)) == 1
    write_boxes(root / "train" / "log-a", [row(0), row(0, "bus", "BUS")])
    assert len(frames.labels(0)) == 2
    (root / "train" / "log-a" / A).unlink()
    frame = frames.frame(1)
    assert (len(frame.points), frame.boxes.shape, frame.labels.tolist()) == (4, (0, 9), [])


FIRST, ZERO = "sensors/lidar/first.feather", f"sensors/lidar/0{START_NS}.feather"
A, P, S = "annotations.feather", "city_SE3_egovehicle.feather", f"sensors/lidar/{START_NS}.feather"


def change(file, **columns):
    """Rewrite a table with other columns, or without those that are None."""

    def edit(log):
        with pa.OSFile(str(log / file)) as source:
            table = pa.ipc.open_file(source).read_all()
        table = {name: table.column(name).to_numpy() for name in table.column_names} | columns
        write_table(log / file, {name: column for name, column in table.items() if column is not None})

    return edit


def rewrite(file, edit):
    return lambda log: (log / file).write_bytes(edit((log / file).read_bytes()))


def boxes(**changes):
    return lambda log: write_boxes(log, [row(0), row(1, **changes)])


def late(log):
    """The first sweep has no pose, and no boxes."""
    write_poses(log, np.array([START_NS + STEP_NS]), ego(1)[None])
    write_boxes(log, [row(1)])


ONE = np.array([1, 0, 0, 0.0])
BAD = {
    "no poses": (lambda log: (log / P).unlink(), P, "cannot be read: No such file or directory"),
    "empty": (rewrite(P, lambda _: b""), P, "got 0 bytes, expected 1 to"),
    "cut": (rewrite(A, lambda content: content[:-40]), A, "not a readable .feather file: "),
    "no column": (change(P, qz=None), P, 'Field "qz" does not exist'),
    "text": (change(S, x=["one"] * 4), S, "x: got string, expected numbers"),
    "missing value": (change(S, y=[1.0, None, 2, 3]), S, "y: got 1 rows without a value, expected numbers"),
    "fraction": (change(A, timestamp_ns=[0.5, 1.0]), A, "timestamp_ns: got double, expected whole numbers"),
    "no rotation": (change(P, qw=2 * ONE), P, "row 0: rotation: got [2.0, "),
    "no size": (boxes(box=[9, 0, 0, 4, 0, 1.5, 0]), A, "row 1: w: got 0, expected a size above 0 m"),
    "laser": (change(S, laser_number=np.array([0, 1, 64, 2], np.uint8)), S, "laser number: got 64 in row 2"),
    "box without a pose": (boxes(time_ns=5), P, "no pose at 5 ns, expected one for every"),
    "sweep without a pose": (late, P, f"no pose at {START_NS} ns, expected one for every sweep"),
    "name": (lambda log: (log / S).rename(log / FIRST), FIRST, "expected a name of whole nanosec"),
    "leading zero": (lambda log: shutil.copy(log / S, log / ZERO), ZERO, "expected a name of whole nanosec"),
}


@pytest.mark.parametrize("case", BAD)
def test_damaged_files_of_a_log_are_refused(tmp_path, case):
    log = write_log(tmp_path / "train" / "log-a", [row(0), row(1)])
    edit, file, message = BAD[case]
    edit(log)
    with refused(message, log / file):
        Argoverse2Frames(tmp_path).frame(0)


def test_without_pyarrow_the_error_names_the_extra(root, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with refused("pyarrow is not installed", "pip install -e '.[argoverse2]' in the repository"):
        Argoverse2Frames(root).frame(0)

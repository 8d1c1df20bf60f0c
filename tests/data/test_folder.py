"""Folders of your own data: frames, classes, splits and sweeps; one-line errors."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from refusal import refused

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.box_geometry import LIMITS
from fcos_lidar_jax.data.folder import FolderFrames
from fcos_lidar_jax.evaluation.records import as_records
from fcos_lidar_jax.sensors import KITTI_HDL64E, TINY, sensor_to_json
from fcos_lidar_jax.types import Detections

ALL = CloudReading(10, "all")
CAR = {"label": "car", "box": [8, 1, -1, 4, 2, 1.5, 0.25, 1.5, -0.5]}


def write(path: Path, content) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = content if isinstance(content, str | bytes) else json.dumps(content)
    path.write_bytes(text.encode() if isinstance(text, str) else text)


@pytest.fixture
def root(tmp_path):
    """Two frames: b with a car of two points, a with nothing but the own car."""
    root = tmp_path / "own"
    write(root / "sensor.json", sensor_to_json(TINY))
    write(root / "clouds" / ".DS_Store", "")  # hidden files are skipped
    points = np.array([[8, 1, -1, 30], [7, 1.5, -1.2, 9], [8, 4, -1, 0], [0.5, 0.5, 0, 1]])
    np.save(root / "clouds" / "b.npy", points)
    np.save(tmp_path / "secret.npy", points)  # outside the folder
    np.array([[9, 1, -1, 30, 2], [0.2, -0.9, 0, 1, 3]], np.float32).tofile(root / "clouds" / "a.pcd.bin")
    write(root / "boxes" / "b.json", {"boxes": [CAR]})
    write(root / "boxes" / "a.json", '\ufeff{"boxes": []}')  # as editors of Windows write it
    return root


def test_frames_of_a_folder_are_sorted_by_name(root):
    frames = FolderFrames(root, reading=ALL)
    assert (len(frames), frames.names, frames.sensor) == (2, ("a", "b"), TINY)
    empty, full = frames.frame(0), frames.frame(1)
    assert (empty.boxes.shape, empty.labels.tolist(), empty.num_points.tolist()) == ((0, 9), [], [])
    np.testing.assert_array_equal(empty.points, np.array([[9, 1, -1, 30, 0]], np.float32))
    np.testing.assert_array_equal(full.boxes, np.array([CAR["box"]], np.float32))
    assert (full.labels.tolist(), full.num_points.tolist(), len(full.points)) == ([0], [2], 3)
    (root / "clouds" / "b.npy").unlink()
    assert frames.labels(1).tolist() == [0]  # without the points


def test_the_sensor_can_be_a_preset_or_an_argument(root):
    write(root / "sensor.json", '"kitti_hdl64e"')
    assert FolderFrames(root, reading=ALL).sensor is KITTI_HDL64E
    assert FolderFrames(root, reading=ALL).frame(1).points[0, 3] == 30 * 255
    (root / "sensor.json").unlink()
    assert FolderFrames(root, TINY).frame(1).points[0, 3] == 30


def test_labels_are_translated_or_dropped(root, capsys):
    write(root / "classes.json", {"lorry": "truck", "sign": None, "car": "bus", "lory": "truck"})
    box = [*CAR["box"][:6], 0.25 + 4 * np.pi, None, None]  # two turns too many, and an unknown velocity
    records = [{"label": label, "box": box} for label in ("sign", "lorry", "car", "barrier")]
    write(root / "boxes" / "b.json", {"boxes": records})
    frames = FolderFrames(root, reading=ALL)
    assert frames.classes == ("barrier", "bus", "truck")
    assert (
        "classes.json: no box has the label 'lory'; labels: barrier, car, lorry, sign\n" in capsys.readouterr().err
    )
    assert [frames.classes[i] for i in frames.frame(1).labels] == ["truck", "bus", "barrier"]
    boxes = frames.frame(1).boxes
    assert np.isnan(boxes[:, 7:]).all()
    np.testing.assert_allclose(boxes[:, 6], 0.25, atol=1e-6)


def test_classes_are_the_labels_of_all_frames_unless_listed(root):
    write(root / "boxes" / "a.json", {"boxes": [{**CAR, "label": label} for label in ("zebra", "ant", "zebra")]})
    frames = FolderFrames(root, reading=ALL)
    assert frames.classes == ("ant", "car", "zebra")
    assert (frames.labels(0).tolist(), frames.labels(1).tolist()) == ([2, 0, 2], [1])
    write(root / "classes.json", ["zebra", "yak", "car", "ant"])
    frames = FolderFrames(root, reading=ALL)
    assert frames.classes == ("zebra", "yak", "car", "ant")
    assert (frames.labels(0).tolist(), frames.labels(1).tolist()) == ([0, 3, 0], [2])


def test_a_split_determines_frames_and_order_but_not_classes(root):
    write(root / "splits.json", {"train": ["b"], "both": ["b", "a"]})
    frames = FolderFrames(root, split="both")
    assert (frames.names, frames.name(1), len(frames.frame(0).boxes)) == (("b", "a"), "a", 1)
    write(root / "boxes" / "a.json", {"boxes": [{**CAR, "label": "ant"}]})
    frames = FolderFrames(root, split="train")
    assert (frames.names, frames.classes) == (("b",), ("ant", "car"))
    write(root.parent / "own.json", {"x": ["a"]})
    assert FolderFrames(root, split="x", splits=root.parent / "own.json").names == ("a",)
    for splits, message in (
        ({"train": []}, "train: no frame in it"),
        ({"train": ["b", "c"]}, "train[1]: got 'c', expected the name of a cloud"),
        ({"train": ["b", "b"]}, "train[1]: got 'b', expected the name of a cloud, each once"),
        ({"trian": ["b"]}, "split: got 'train', expected trian"),
    ):
        write(root / "splits.json", splits)
        with refused(message):
            FolderFrames(root, split="train")


def test_predictions_can_be_read_as_labels(root):
    """The boxes that ``detect`` writes are read back bit-identical."""
    rng = np.random.default_rng(0)
    boxes = rng.normal(size=(1, 9)).astype(np.float32)
    boxes[:, 3:6] = np.abs(boxes[:, 3:6])
    one = np.ones(1, np.float32)
    found = Detections(*map(jnp.asarray, (boxes, one, np.array([6], np.int32), np.ones(1, bool), np.int32(0))))
    write(root / "boxes" / "b.json", {"boxes": as_records(found, NUSCENES_CLASSES)})
    frames = FolderFrames(root, reading=ALL)
    frame = frames.frame(1)
    np.testing.assert_array_equal(frame.boxes, boxes)
    assert [frames.classes[i] for i in frame.labels] == ["motorcycle"]


def sweep(name: str, stamp_us: int, forward_m: float) -> dict:
    pose = np.eye(4)
    pose[0, 3] = forward_m
    return {"file": f"../{name}", "timestamp_us": stamp_us, "sensor_to_world": pose.tolist()}


@pytest.fixture
def sweeps(root):
    """Frame b with two older clouds of one point each; the ego vehicle drives at 10 m/s."""
    (root / "older").mkdir()
    for i in (1, 2):
        np.save(root / "older" / f"{i}.npy", np.array([[8 + i, 1, -1, 30]]))
    files = ("clouds/b.npy", "older/1.npy", "older/2.npy")
    listed = [sweep(file, 900_000 - 100_000 * age, 2 - age) for age, file in enumerate(files)]
    write(root / "sweeps" / "b.json", listed)
    return listed


@pytest.mark.parametrize(("num_sweeps", "lags"), [(1, [0, 0, 0]), (2, [0, 0, 0, 0.1]), (9, [0, 0, 0, 0.1, 0.2])])
def test_at_most_the_requested_number_of_sweeps_is_fused(root, sweeps, num_sweeps, lags):
    frame = FolderFrames(root, reading=CloudReading(num_sweeps, "all")).frame(1)
    np.testing.assert_array_equal(frame.points[:, 4], np.array(lags, np.float32))
    # All older points move to the car's first point, but only points of the current sweep are counted.
    np.testing.assert_allclose(frame.points[3:, :3], np.tile([8.0, 1, -1], (len(lags) - 3, 1)), atol=1e-6)
    assert frame.num_points.tolist() == [2]


def test_the_fingerprint_depends_on_older_sweeps_too(root, sweeps):
    before = FolderFrames(root, reading=ALL).fingerprint()
    np.save(root / "older" / "1.npy", np.array([[8, 1, -1, 30], [9, 1, -1, 30]]))
    assert FolderFrames(root, reading=ALL).fingerprint() != before


def test_a_list_of_sweeps_determines_pose_and_time(root, sweeps):
    (root / "older" / "1.npy").unlink()
    frames = FolderFrames(root, reading=CloudReading(1, "all"))
    np.testing.assert_array_equal(frames.pose(1), np.array(sweeps[0]["sensor_to_world"]))
    assert (frames.time_us(1), frames.pose(0), frames.time_us(0)) == (900_000, None, None)
    assert len(frames.frame(1).points) == 3


def box_with(**values):
    box = dict(zip(LIMITS, CAR["box"], strict=True)) | values
    return {"boxes": [CAR, {**CAR, "box": list(box.values())}]}


B, C = "boxes/b.json", "clouds/c.npy"


def holding(content):
    return lambda root: write(root / B, content)


BAD = {
    "no boxes": (lambda r: (r / B).unlink(), "clouds/b.npy", "b.json, expected one for every cloud"),
    "orphan": (lambda r: write(r / "boxes/c.json", {"boxes": []}), "boxes/c.json", "no cloud named c in"),
    "same name": (lambda r: write(r / "clouds/b.pcd", ""), "clouds/b.pcd", "a second file named b beside b.npy"),
    "extension": (lambda r: write(r / "clouds/b.txt", ""), "clouds/b.txt", "unknown extension '.txt', expected"),
    "link outside": (lambda r: (r / C).symlink_to("../../secret.npy"), C, "secret.npy, expected a file inside"),
    "link to itself": (lambda r: (r / C).symlink_to("c.npy"), C, "no such file"),
    "empty": (lambda r: [file.unlink() for file in (r / "clouds").iterdir()], "clouds", "found no file, expected"),
    "no folder": (lambda r: (r / "boxes").rename(r / "box"), "boxes", "found no file, expected a folder of .json"),
    "no sensor": (lambda r: (r / "sensor.json").unlink(), "sensor.json", "no such file, expected a sensor file o"),
    "class": (lambda r: write(r / "classes.json", ["carr"]), B, "$.boxes[0].label: got 'car', expected carr"),
    "class twice": (lambda r: write(r / "classes.json", ["car", "car"]), "classes.json", "2 names, expected at"),
    "a bare list": (holding([]), B, "$: got [], expected object"),
    "unknown key": (holding({"boxes": [{**CAR, "x": 1}]}), B, "$.boxes[0]: Object contains unknown field `x`"),
    "text": (holding(box_with(w="2")), B, "$.boxes[1].box[4]: got '2', expected float"),
    "NaN": (holding(box_with(yaw=np.nan)), B, "$.boxes[1].box: yaw: got nan, expected a finite number"),
    "NaN velocity": (holding(box_with(vx=np.nan, vy=np.nan)), B, "$.boxes[1].box[7]: got nan, expected fl"),
}


@pytest.mark.parametrize("case", BAD)
def test_damaged_missing_and_surplus_files_are_refused(root, case):
    spoil, file, message = BAD[case]
    spoil(root)
    with refused(message, root / file):
        FolderFrames(root, reading=ALL).frame(1)


@pytest.mark.parametrize(
    ("index", "name", "message"),
    [
        (1, "../../secret.npy", "$[1].file: resolves to"),
        (1, "{root}/../secret.npy", "$[1].file: resolves to"),
        (1, "../older/9.npy", "$[1].file: no such file"),
        (0, "../older/1.npy", "$[0].file: got '../older/1.npy', expected the frame's own cloud, '../clouds/b.np"),
    ],
)
def test_wrong_files_in_a_list_of_sweeps_are_refused(root, sweeps, index, name, message):
    sweeps[index]["file"] = name.format(root=root)
    write(root / "sweeps" / "b.json", sweeps)
    frames = FolderFrames(root, reading=CloudReading(3, "all"))
    for read in (lambda: frames.frame(1), lambda: frames.check_files([1])):
        with refused(message, root / "sweeps/b.json"):
            read()


def test_more_time_lags_than_sweeps_are_refused(root):
    """Otherwise all points but the first would belong to older sweeps, and no box would contain any."""
    points = np.tile(np.load(root / "clouds" / "b.npy"), (40, 1))
    np.save(root / "clouds" / "b.npy", np.column_stack([points, np.repeat([0, 0.05, 0.1, np.nan], 40)]))
    with refused("fifth column: got 3 different values up to 0.1, expected the time lag", root / "clouds/b.npy"):
        FolderFrames(root, reading=CloudReading(2)).frame(1)
    assert len(FolderFrames(root, reading=CloudReading(3, "none")).frame(1).points) == 160

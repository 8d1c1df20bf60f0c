"""The reader of nuScenes: joins, poses, velocities, index, bad tables; the real scene and the official devkit."""

import json
import pickle
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_nuscenes import BETWEEN, KEYFRAMES, STEP_US, VERSION, make_tables, token, write
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.build import build_index, velocities
from fcos_lidar_jax.data.nuscenes.index import open_index, save_index
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames, default_index
from fcos_lidar_jax.data.nuscenes.splits import SplitError, scenes_of_split
from fcos_lidar_jax.data.nuscenes.tables import SampleData, TableError, read_table
from fcos_lidar_jax.data.point_files import PointFileError
from fcos_lidar_jax.types import CLASSES


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("made"), *make_tables())


def test_what_stands_still_in_the_world_is_at_one_place_from_every_sweep(made):
    data = NuScenes(made, VERSION)
    cloud = data.sweeps(token("sample", 1, 3), 8, remove_close="none").reshape(8, 50, 5)
    _, clouds = make_tables()
    np.testing.assert_array_equal(cloud[0, :, :3], clouds[f"samples/LIDAR_TOP/1-{3 * BETWEEN}.pcd.bin"][:, :3])
    assert np.abs(cloud[..., :3] - cloud[:1, :, :3]).max() < 1e-5
    np.testing.assert_allclose(cloud[..., 4], (np.arange(8) * STEP_US / 1e6)[:, None] * np.ones(50), rtol=1e-6)
    assert (cloud[0, :, 4] == 0).all()


def test_chains_end_at_the_start_of_the_scene(made):
    data = NuScenes(made, VERSION)
    sizes = [len(data.sweeps(token("sample", 1, k), 10, remove_close="none")) for k in range(KEYFRAMES)]
    assert sizes == [50 * min(1 + k * BETWEEN, 10) for k in range(KEYFRAMES)]


def test_close_points_are_judged_in_their_own_sweep(tmp_path):
    tables, clouds = make_tables(1)
    for points in clouds.values():
        points[:5, :2] = 0.999, -0.999
        points[5:8, :2] = 1.0, 0.5
    data = NuScenes(write(tmp_path, tables, clouds), VERSION)
    sample = token("sample", 0, 2)
    sizes = {mode: len(data.sweeps(sample, 3, remove_close=mode)) for mode in ("none", "sweeps", "all")}
    assert sizes == {"none": 150, "sweeps": 140, "all": 135}
    assert len(data.sweeps(sample, 3, close_m=1.01)) == 126
    with pytest.raises(ValueError, match="remove_close: got 'some'"):
        data.sweeps(sample, 3, remove_close="some")


def test_boxes_in_the_lidar_frame_by_explicit_matrices(made):
    data, (tables, _) = NuScenes(made, VERSION), make_tables()
    sample = token("sample", 1, 2)
    found = data.boxes(sample)
    rows = {row["token"]: row for row in tables["sample_annotation"]}
    assert found.tokens == (token("box", 1, 0, 2), token("box", 1, 1, 2))  # animal and rack are background
    assert [CLASSES[k] for k in found.labels] == ["car", "pedestrian"]
    assert found.attributes == ("vehicle.moving", "")
    assert found.num_lidar_pts.tolist() == [2, 3]
    matrix = data.sensor_to_global(sample)
    for box, name in zip(found.boxes, found.tokens, strict=True):
        row = rows[name]
        np.testing.assert_allclose((matrix @ [*box[:3].astype(float), 1])[:3], row["translation"], atol=2e-5)
        assert box[3:6].tolist() == [4.0, 1.5, 2.0]
        turn = Rotation.from_quat(row["rotation"], scalar_first=True).as_matrix()
        heading = matrix[:3, :3].T @ turn @ [1, 0, 0]
        np.testing.assert_allclose(
            [np.cos(box[6]), np.sin(box[6])], heading[:2] / np.hypot(*heading[:2]), atol=1e-6
        )
        before, after = (rows[token("box", 1, name[6], k)]["translation"] for k in (1, 3))
        speed = (np.array(after) - before) / (2 * BETWEEN * STEP_US / 1e6)
        np.testing.assert_allclose(box[7:9], (matrix[:3, :3].T @ speed)[:2], atol=1e-5)
    assert data.labels(token("sample", 1, 0)).tolist() == [CLASSES.index("pedestrian")]  # the car has no point yet


def test_velocities_by_the_central_difference_rule():
    where = np.array([[0.0, 0, 0], [1, 0, 0], [4, 0, 0], [9, 0, 0], [0, 0, 0]])
    seconds = np.array([0.0, 1.0, 2.9, 4.6, 0.0])
    before, after = np.array([-1, 0, 1, 2, -1]), np.array([1, 2, 3, -1, -1])
    found = velocities(where, (seconds * 1e6).astype(int), before, after)[:, 0]
    # one-sided 1 s; two-sided 2.9 s; two-sided 3.6 s is too long; one-sided 1.7 s likewise; alone.
    np.testing.assert_allclose(found, [1, 4 / 2.9, np.nan, np.nan, np.nan])


def test_splits_and_scenes(made, tmp_path):
    data = NuScenes(made, VERSION)
    assert data.split("scene-1") == [token("sample", 1, k) for k in range(KEYFRAMES)]
    assert data.split("all") == data.sample_tokens
    assert data.scene_of(token("sample", 1, 2)) == "scene-1"
    file = tmp_path / "mine.json"
    file.write_text('{"half": ["scene-0"]}')
    assert data.split("half", file=file) == [token("sample", 0, k) for k in range(KEYFRAMES)]


def test_official_splits_are_read_from_the_source_of_the_devkit(tmp_path, monkeypatch):
    folder = tmp_path / "nuscenes" / "utils"
    folder.mkdir(parents=True)
    source = "raise_if_imported = 1 / 0\ntrain_detect = ['b']\ntrain_track = ['a']\n"
    source += "train = list(sorted(set(train_detect + train_track)))\nval = ['c', 'd']\nother = ['x']\n"
    (folder / "splits.py").write_text(source)
    (folder.parent / "__init__.py").write_text("raise ImportError('must not be imported')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "nuscenes", raising=False)  # the real one, where another test imported it
    assert scenes_of_split("train", tmp_path) == ["a", "b"]
    assert scenes_of_split("val", tmp_path) == ["c", "d"]
    with pytest.raises(SplitError, match="split 'other': not found"):
        scenes_of_split("other", tmp_path)


def test_tables_are_the_same_in_one_piece_and_in_many(made):
    whole = [row for piece in read_table(made / VERSION, SampleData) for row in piece]
    pieces = list(read_table(made / VERSION, SampleData, piece_bytes=700))
    assert len(pieces) > 5
    assert [row for piece in pieces for row in piece] == whole
    compact = json.dumps(json.loads((made / VERSION / "sample_data.json").read_text()), separators=(",", ":"))
    other = made / "compact"
    other.mkdir(exist_ok=True)
    (other / "sample_data.json").write_text(compact)
    assert [row for piece in read_table(other, SampleData, piece_bytes=700) for row in piece] == whole


def test_index_opens_to_what_was_saved_and_frames_are_the_same(made, tmp_path):
    index = build_index(made / VERSION)
    save_index(index, tmp_path / "a", tables=made / VERSION)
    save_index(index, tmp_path / "b", tables=made / VERSION)
    files = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)
    opened = open_index(tmp_path / "a", tables=made / VERSION)
    for name in vars(index):
        np.testing.assert_array_equal(getattr(index, name), getattr(opened, name))
    plain, indexed = NuScenes(made, VERSION), NuScenes(made, VERSION, index=tmp_path / "a")
    for data in (plain, indexed, pickle.loads(pickle.dumps(indexed))):
        frames = NuScenesFrames(data, tuple(data.split("scene-0")), num_sweeps=4)
        frame = frames.frame(2)
        assert (len(frames), frame.points.shape[1], len(frame.boxes)) == (KEYFRAMES, 5, 2)
        np.testing.assert_array_equal(frame.points, plain.sweeps(token("sample", 0, 2), 4))
        assert frames.labels(2).tolist() == frame.labels[frame.num_points > 0].tolist()


def test_an_older_sweep_may_be_missing_when_allowed(tmp_path):
    tables, clouds = make_tables(1)
    root = write(tmp_path, tables, clouds)
    (root / "samples/LIDAR_TOP/0-5.pcd.bin").unlink()
    sample = token("sample", 0, 2)  # sweep 6
    with pytest.raises(ValueError, match=r"0-5\.pcd\.bin: no such file.*--allow-missing-sweeps"):
        NuScenes(root, VERSION).sweeps(sample, 4)
    data = NuScenes(root, VERSION, allow_missing_sweeps=True)
    cloud = data.sweeps(sample, 4, remove_close="none")
    np.testing.assert_allclose(np.unique(cloud[:, 4]), [0, 0.1, 0.15], rtol=1e-6)
    assert data.missing_sweeps(data.sample_tokens, 4) == 1
    (root / "samples/LIDAR_TOP/0-6.pcd.bin").unlink()
    with pytest.raises(ValueError, match=r"0-6\.pcd\.bin: no such file"):
        data.sweeps(sample, 4)


def change(table: str, row: int, field: str, value: Any):
    def edit(root: Path) -> None:
        file = root / VERSION / f"{table}.json"
        rows = json.loads(file.read_text())
        if value is None:
            del rows[row][field]
        else:
            rows[row][field] = value
        file.write_text(json.dumps(rows))

    return edit


def replace(table: str, text: str | None):
    def edit(root: Path) -> None:
        file = root / VERSION / f"{table}.json"
        file.unlink()
        if text is not None:
            file.write_text(text)

    return edit


def swap(table: str, old: str, new: str):
    def edit(root: Path) -> None:
        file = root / VERSION / f"{table}.json"
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new, 1))

    return edit


def truncate(table: str):
    def edit(root: Path) -> None:
        file = root / VERSION / f"{table}.json"
        file.write_bytes(file.read_bytes()[:-200])

    return edit


def link(root: Path) -> None:
    outside = root.parent / "outside.pcd.bin"
    np.zeros((4, 5), "f4").tofile(outside)
    (root / "samples/LIDAR_TOP/0-3.pcd.bin").unlink()
    (root / "samples/LIDAR_TOP/0-3.pcd.bin").symlink_to(outside)


def points(content: bytes):
    return lambda root: (root / "samples/LIDAR_TOP/0-3.pcd.bin").write_bytes(content)


def first_rotation(root: Path) -> None:
    file = root / VERSION / "ego_pose.json"
    text = file.read_text()
    file.write_text(re.sub(r'("rotation": \[\s*)[^,]+', r"\1NaN", text, count=1))


BAD = {
    "missing table": (replace("instance", None), ["instance.json", "no such file"]),
    "empty table": (replace("scene", ""), ["scene.json", "empty file"]),
    "truncated table": (truncate("sample_annotation"), ["sample_annotation.json", "not JSON", "box-1-3-3"]),
    "not a list": (replace("category", "{}"), ["category.json", "array", "object"]),
    "binary table": (replace("sensor", "\x00\x01"), ["sensor.json", "not JSON"]),
    "field missing": (change("sample", 3, "timestamp", None), ["sample.json", "[3]", "timestamp"]),
    "text for a number": (change("sample", 3, "timestamp", "1"), ["sample.json", "[3].timestamp", "int", "str"]),
    "two lengths": (change("sample_annotation", 2, "size", [1, 2]), ["sample_annotation.json", "[2].size", "3"]),
    "negative size": (
        change("sample_annotation", 2, "size", [1, -2, 1]),
        ["sample_annotation.json", "box-0-0-2", "size", "[1.0, -2.0, 1.0]", "positive"],
    ),
    "absurd size": (change("sample_annotation", 2, "size", [1, 1e30, 1]), ["box-0-0-2", "1e+30", "at most 500 m"]),
    "absurd place": (
        change("sample_annotation", 2, "translation", [1, 1e30, 1]),
        ["sample_annotation.json", "box-0-0-2", "translation", "1e+30", "at most 1e+08 m"],
    ),
    "zero size": (change("sample_annotation", 1, "size", [0, 2, 1]), ["box-0-0-1", "size", "[0.0, 2.0, 1.0]"]),
    "NaN rotation": (first_rotation, ["ego_pose.json", "pose-0-0", "rotation", "not JSON"]),
    "zero rotation": (
        change("ego_pose", 1, "rotation", [0, 0, 0, 0]),
        ["ego_pose.json", "pose-0-1", "rotation", "[0.0, 0.0, 0.0, 0.0]", "unit quaternion"],
    ),
    "rotation of a box": (
        change("sample_annotation", 4, "rotation", [1, 1, 0, 0]),
        ["sample_annotation.json", "box-0-1-0", "rotation", "unit quaternion"],
    ),
    "mount": (
        change("calibrated_sensor", 0, "rotation", [2, 0, 0, 0]),
        ["calibrated_sensor.json", "mount", "rotation"],
    ),
    "huge translation": (
        swap("ego_pose", '"translation": [', '"translation": [\n1e999,'),
        ["ego_pose.json", "[0].translation[0]", "out of range"],
    ),
    "dangling sample": (
        change("sample_annotation", 2, "sample_token", "gone"),
        ["sample_annotation.json", "box-0-0-2", "sample_token", "'gone'"],
    ),
    "dangling instance": (change("sample_annotation", 2, "instance_token", "gone"), ["instance_token", "'gone'"]),
    "dangling attribute": (
        change("sample_annotation", 0, "attribute_tokens", ["gone"]),
        ["attribute_tokens", "'gone'"],
    ),
    "dangling neighbour": (change("sample_annotation", 0, "next", "gone"), ["box-0-0-0", "next", "'gone'"]),
    "dangling category": (
        change("instance", 0, "category_token", "gone"),
        ["instance.json", "category_token", "'gone'"],
    ),
    "dangling scene": (change("sample", 0, "scene_token", "gone"), ["sample.json", "scene_token", "'gone'"]),
    "dangling pose": (
        change("sample_data", 1, "ego_pose_token", "gone"),
        ["data-0-1", "ego_pose_token", "'gone'"],
    ),
    "dangling mount": (
        change("sample_data", 1, "calibrated_sensor_token", "gone"),
        ["sample_data.json", "data-0-1", "calibrated_sensor_token", "'gone'"],
    ),
    "dangling sweep": (change("sample_data", 1, "prev", "gone"), ["data-0-1", "prev", "'gone'"]),
    "dangling keyframe": (
        change("sample_data", 1, "sample_token", "gone"),
        ["data-0-1", "sample_token", "'gone'"],
    ),
    "chain against time": (change("sample_data", 1, "prev", token("data", 0, 2)), ["data-0-1", "prev", "earlier"]),
    "keyframe without a sweep": (
        change("sample_data", 3, "is_key_frame", False),
        ["sample.json", "sample-0-1", "LIDAR_TOP"],
    ),
    "token twice": (
        change("sample_data", 1, "token", token("data", 0, 2)),
        ["sample_data.json", "data-0-2", "twice"],
    ),
    "path above the root": (
        change("sample_data", 3, "filename", "../x.pcd.bin"),
        ["data-0-3", "filename", "'../x.pcd.bin'"],
    ),
    "absolute path": (
        change("sample_data", 3, "filename", "/etc/passwd"),
        ["data-0-3", "filename", "'/etc/passwd'"],
    ),
    "link out of the root": (link, ["0-3.pcd.bin", "leads to", "outside.pcd.bin"]),
    "zero-length sweep": (points(b""), ["0-3.pcd.bin", "an empty file"]),
    "truncated sweep": (points(bytes(1999)), ["0-3.pcd.bin", "1999 bytes", "20"]),
    "scene unknown": (lambda root: None, ["scene-99", "scene.json"]),
    "split without scenes": (lambda root: None, ["splits.json", "none", "no scene"]),
    "unknown split": (lambda root: None, ["'vall'", "splits.json", "scene-0"]),
    "splits not JSON": (replace("splits", "{"), ["splits.json", "not JSON"]),
    "splits of numbers": (replace("splits", '{"all": [1]}'), ["splits.json", "all", "scene names"]),
}


def read_all(root: Path, split: str) -> None:
    data = NuScenes(root, VERSION)
    data.split(split)
    data.sweeps(token("sample", 0, 1), 2)


@pytest.mark.parametrize("case", BAD)
def test_bad_tables_get_one_line(case, tmp_path):
    root = write(tmp_path / "root", *make_tables(2))
    edit, expected = BAD[case]
    edit(root)
    split = {"scene unknown": "lost", "split without scenes": "none", "unknown split": "vall"}.get(case, "all")
    with pytest.raises((TableError, SplitError, PointFileError)) as caught:
        read_all(root, split)
    message = str(caught.value)
    assert "\n" not in message
    for fragment in expected:
        assert fragment in message, message


def test_bad_roots_and_indexes_get_one_line(made, tmp_path):
    with pytest.raises(ValueError, match="no such folder, expected a data root"):
        NuScenes(made / "gone", VERSION)
    with pytest.raises(ValueError, match=rf"v1\.0-other: no such folder, expected one of {VERSION}"):
        NuScenes(made, "v1.0-other")
    with pytest.raises(ValueError, match=r"sample\.json: 'gone': no such token"):
        NuScenes(made, VERSION).boxes("gone")
    with pytest.raises(ValueError, match=r"index\.json: no such file"):
        NuScenes(made, VERSION, index=tmp_path / "gone")
    folder = tmp_path / "index"
    save_index(build_index(made / VERSION), folder, tables=made / VERSION)
    manifest = json.loads((folder / "index.json").read_text())

    def refused(pattern: str, **changes: Any) -> None:
        (folder / "index.json").write_text(json.dumps({**manifest, **changes}))
        with pytest.raises(ValueError, match=pattern):
            NuScenes(made, VERSION, index=folder)

    refused(r"index\.json: format_version: got 99, expected 2: run prepare again", format_version=99)
    refused(r"index\.json: format: expected", format="pickle")
    refused(
        r"sample\.json: the index was made when it had 3 bytes", tables={**manifest["tables"], "sample.json": 3}
    )
    refused(r"index\.json: columns: expected an object", columns=3)
    (folder / "index.json").write_text("{")
    with pytest.raises(ValueError, match=r"index\.json: not JSON"):
        open_index(folder, tables=made / VERSION)
    (folder / "index.json").write_text(json.dumps(manifest))
    column = folder / "box_size.npy"
    content = bytearray(column.read_bytes())
    content[-1] ^= 1
    column.write_bytes(content)
    with pytest.raises(ValueError, match=r"box_size\.npy: other content than index\.json tells"):
        open_index(folder, tables=made / VERSION)
    column.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"box_size\.npy: cannot be read"):
        open_index(folder, tables=made / VERSION)
    assert not default_index(made, VERSION).exists()


@pytest.mark.real_data
def test_real_scene_counts_exactly(real_data):
    data = NuScenes(real_data / "nuscenes_scene0523", "v1.0-scene0523")
    index = data.index
    assert len(index.box_token) == 2625
    assert sum(len(data.boxes(sample).labels) for sample in data.sample_tokens) == 2465
    assert int((index.box_lidar_points == 0).sum()) == 1016
    assert int(np.isnan(index.box_velocity[:, 0]).sum()) == 9
    wrong = 0
    for i, sample in enumerate(data.sample_tokens):
        cloud = data.sweeps(sample, 1, remove_close="none")
        matrix = data.sensor_to_global(sample)
        world = cloud[:, :3].astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        for row in range(index.sample_first[i], index.sample_first[i + 1]):
            turn = Rotation.from_quat(index.box_rotation[row], scalar_first=True)
            local = turn.inv().apply(world - index.box_translation[row])
            w, l, h = index.box_size[row]
            inside = (np.abs(local) <= np.array([l, w, h]) / 2).all(axis=1)
            wrong += int(inside.sum()) != index.box_lidar_points[row]
    assert wrong == 0


@pytest.mark.real_data
def test_real_static_structure_lines_up(real_data):
    """Voxels of 0.3 m above the ground, shared by a keyframe and the three before it."""
    data = NuScenes(real_data / "nuscenes_scene0523", "v1.0-scene0523")

    def overlap(cloud: np.ndarray) -> float:
        cloud = cloud[(cloud[:, 2] > -1.2) & (np.abs(cloud[:, :2]) < 30).all(axis=1)]
        current = cloud[:, 4] == 0
        now, before = (
            set(map(tuple, np.floor(part[:, :3] / 0.3).astype(int))) for part in (cloud[current], cloud[~current])
        )
        return len(now & before) / len(now)

    aligned, apart = [], []
    for sample in data.sample_tokens[5:35:6]:
        aligned.append(overlap(data.sweeps(sample, 4)))
        chain = data.sample_tokens.index(sample)
        parts = []
        for lag, one in enumerate(data.sample_tokens[chain - 3 : chain + 1][::-1]):
            part = data.sweeps(one, 1)
            part[:, 4] = lag
            parts.append(part)
        apart.append(overlap(np.concatenate(parts)))
    print(f"overlap of static voxels: {np.mean(aligned):.3f} with poses, {np.mean(apart):.3f} without")
    assert np.mean(aligned) > 1.5 * np.mean(apart)


@pytest.mark.real_data
def test_real_scene_equals_the_official_devkit(real_data):
    official = pytest.importorskip("nuscenes.nuscenes", reason="the official devkit is not installed")
    from nuscenes.utils.data_classes import LidarPointCloud

    root = real_data / "nuscenes_scene0523"
    theirs = official.NuScenes("v1.0-scene0523", str(root), verbose=False)
    ours = NuScenes(root, "v1.0-scene0523")
    sample = ours.sample_tokens[15]
    cloud, lag = LidarPointCloud.from_file_multisweep(
        theirs, theirs.get("sample", sample), "LIDAR_TOP", "LIDAR_TOP", nsweeps=10
    )
    fused = ours.sweeps(sample, 10)
    np.testing.assert_allclose(fused[:, :4], cloud.points[:4].T, atol=1e-4)
    np.testing.assert_allclose(fused[:, 4], lag[0], atol=1e-6)
    for sample in ours.sample_tokens[::8]:
        found = ours.boxes(sample)
        _, boxes, _ = theirs.get_sample_data(theirs.get("sample", sample)["data"]["LIDAR_TOP"])
        by_token = {box.token: box for box in boxes}
        for box, name in zip(found.boxes, found.tokens, strict=True):
            np.testing.assert_allclose(box[:3], by_token[name].center, atol=2e-5)
            heading = by_token[name].orientation.rotation_matrix[:, 0]
            assert abs(np.angle(np.exp(1j * (np.arctan2(heading[1], heading[0]) - box[6])))) < 1e-6
            speed = theirs.box_velocity(name)
            row = int(np.flatnonzero(ours.index.box_token == name.encode())[0])
            np.testing.assert_allclose(ours.index.box_velocity[row], speed, atol=1e-5)

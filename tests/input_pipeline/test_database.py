"""The ground-truth database: which objects are cut, resumption after kills, and detection of damage."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import oracles
import pytest
from commands import contents, cut, flip
from refusal import refused
from toy_frames import ListedFrames, SceneFrames, ToyFrames, toy_frame

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.frame import InMemoryFrames
from fcos_lidar_jax.input_pipeline.database import objects_folder, open_database, prepare_database, shards_by_scene
from fcos_lidar_jax.sensors import ARGOVERSE2

SCENES = (("scene-b", (0, 1, 2)), ("scene-a", (3,)), ("scene-c", (6, 4)))


def build(folder, frames=None, *, scenes=SCENES, source="f", **options):
    return prepare_database(SceneFrames(frames or ToyFrames(), scenes, source), folder, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Contents of all files of an uninterrupted build."""
    folder = tmp_path_factory.mktemp("whole")
    build(folder)
    return contents(folder)


def test_every_box_of_enough_points_is_cut_with_its_points(tmp_path):
    objects = build(tmp_path)
    expected = []
    for index, toy in enumerate((0, 1, 2, 3, 6, 4)):
        frame = toy_frame(toy)
        for box, label in zip(frame.boxes, frame.labels, strict=True):
            inside = frame.points[[oracles.inside(p[:3].astype(float), box.astype(float)) for p in frame.points]]
            if len(inside) >= 5:
                expected.append((index, label, box, inside))
    assert len(objects) == len(expected) > 30
    for i, (index, label, box, inside) in enumerate(expected):
        row = objects.table[i]
        assert (row["frame"], row["label"], row["count"]) == (index, label, len(inside))
        assert row["newest"][:3].tolist() == [(inside[:, 4] <= lag).sum() for lag in np.float32([0, 0.05, 0.1])]
        assert (row["newest"][3:] == len(inside)).all()
        np.testing.assert_array_equal(row["box"], box)
        np.testing.assert_array_equal(objects.points(i), inside)
    assert {len(p[3]) for p in expected} != {5}
    assert (objects.num_points(1) < objects.num_points(2)).any()
    assert objects.manifest.classes == list(NUSCENES_CLASSES)


def test_points_beyond_physical_limits_are_not_cut(tmp_path):
    """An invalid time lag would also be counted as a sweep of its own."""
    frame = toy_frame(0)
    points = frame.points.copy()
    first = np.flatnonzero([oracles.inside(p[:3].astype(float), frame.boxes[0].astype(float)) for p in points])
    points[first[:2], 3], points[first[2], 4] = 1e30, -1.0
    for name, cloud in (("a", points), ("b", np.delete(frame.points, first[:3], axis=0))):
        frames = ListedFrames((dataclasses.replace(frame, points=cloud),))
        assert len(build(tmp_path / name, frames, scenes=(("s", (0,)),)))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_clouds_without_usable_points_are_counted_also_if_they_were_read_before(tmp_path, capsys):
    frames = [toy_frame(seed) for seed in range(3)]
    for frame in frames[:2]:
        frame.points[:, :3] *= 1000  # millimetres
    scenes = (("s", (0, 1)), ("t", (2,)))
    for _ in range(2):
        build(tmp_path / "a", ListedFrames(tuple(frames)), scenes=scenes)
        told = capsys.readouterr().err
        note = "note: 2 of 3 clouds without usable points, and so without objects: the first is frame 0: none of"
        assert told.count("note: ") == told.count(note) == 1
        with refused("frame 0: none of its 1500 points is usable"):
            build(tmp_path / "b", ListedFrames(tuple(frames[:2])), scenes=scenes[:1])
        assert "manifest.json" not in contents(tmp_path / "b")


def test_boxes_are_counted_and_most_of_them_without_points_give_a_warning(tmp_path, capsys):
    frame = toy_frame(0)
    away = dataclasses.replace(frame, boxes=frame.boxes + np.float32([0, 0, 90, 0, 0, 0, 0, 0, 0]))
    number = len(frame.boxes)
    for frames, empty in (((frame,), 0), ((frame, away, away), 2 * number)):
        for _ in range(2):  # the second time from the tables
            objects = build(
                tmp_path, ListedFrames(frames), scenes=(("s", tuple(range(len(frames)))),), min_points=1
            )
            told = capsys.readouterr().err
            boxes = number * len(frames)
            assert f"{boxes} boxes, {len(objects)} with at least 1 points\n" in told
            line = f"warning: {empty} of {boxes} boxes contain no point, expected few: are points and boxes in"
            assert (line in told) == bool(empty)


def test_a_split_name_cannot_lead_out_of_the_index():
    for name in ("../elsewhere", "..", ".", "a/b", "/tmp"):
        with refused("expected a name that a folder can have"):
            objects_folder(Path("index"), name)


def test_the_fingerprint_depends_on_the_objects_only(tmp_path):
    first, again = build(tmp_path / "a"), build(tmp_path / "b", source="g")
    assert first.fingerprint() == again.fingerprint()
    assert build(tmp_path / "c", min_points=6).fingerprint() != first.fingerprint()


def test_more_sweeps_than_are_counted_are_refused_before_the_build(tmp_path):
    with pytest.raises(ValueError, match=r"^num_sweeps: got 21, expected 1 to 20$"):
        prepare_database(ToyFrames(), tmp_path, num_sweeps=21)
    assert not list(tmp_path.iterdir())


def test_an_implausible_box_is_refused(tmp_path):
    frame = toy_frame(0)
    frame.boxes[3, 4] = 0
    with refused("frame 'frame 1': box 3: w: got 0, expected a size above 0 m"):
        build(tmp_path, ListedFrames((toy_frame(1), frame)), scenes=(("s", (0, 1)),))


def test_each_scene_is_a_shard(tmp_path):
    """Frames without a scene form shards of a hundred; scene names become valid file names."""
    frames = SceneFrames(
        ToyFrames(), (("", (0,)), ("a/b", (1, 2)), ("", (3,)), (".c", (4,)), ("a/b", (5,)), ("..", (6,)))
    )
    shards = {"frames_000000": [0, 3], "a_b": [1, 2, 5], "_c": [4], "_.": [6]}
    assert shards_by_scene(frames) == shards
    assert list(shards_by_scene(ToyFrames(201))) == [f"frames_000{i}00" for i in range(3)]
    objects = prepare_database(frames, tmp_path)
    assert [shard.name for shard in objects.manifest.shards] == list(shards)
    assert objects.manifest.source == frames.fingerprint()
    assert list(dict.fromkeys(objects.table["frame"].tolist())) == [0, 3, 1, 2, 5, 4, 6]


def test_objects_have_min_points_and_shards_may_be_empty(tmp_path):
    scenes = (("one", (1,)), ("bare", (0,)))
    bare = toy_frame(1)
    frames = ListedFrames((type(bare)(bare.points, bare.boxes[:0], bare.labels[:0], bare.num_points[:0]), bare))
    objects = build(tmp_path, frames, scenes=scenes, min_points=25)
    assert [s.objects for s in objects.manifest.shards] == [len(objects), 0]
    assert objects.table["count"].min() >= 25
    assert len(objects) < len(build(tmp_path / "more", frames, scenes=scenes, min_points=5))
    assert len(build(tmp_path / "empty", frames, scenes=())) == 0


def stamps(folder):
    return {p.name: p.stat().st_mtime_ns for p in folder.iterdir() if p.name != "manifest.json"}


class Interrupted(Exception):
    pass


def interrupt_after(count):
    def report(done, _):
        if done >= count:
            raise Interrupted

    return report


@pytest.mark.parametrize(("done", "over_an_older_one"), [(1, True), (4, False)])
def test_an_interrupted_build_has_no_manifest_and_resumes_to_the_same_bytes(
    tmp_path, whole, done, over_an_older_one
):
    if over_an_older_one:
        build(tmp_path, source="old")
    with pytest.raises(Interrupted):
        build(tmp_path, report=interrupt_after(done))
    with refused("manifest.json: no such file"):
        open_database(tmp_path)
    before = stamps(tmp_path)
    reports = []
    build(tmp_path, report=lambda d, _: reports.append(d))
    assert contents(tmp_path) == whole
    assert reports[0] >= done
    if not over_an_older_one:
        assert before.items() <= stamps(tmp_path).items()  # finished shards are not written again


def test_a_build_from_other_data_replaces_the_old_shards(tmp_path):
    build(tmp_path / "a", source="old")
    (tmp_path / "a" / ".0123456789ab.f32").write_bytes(b"half")
    build(tmp_path / "a", scenes=SCENES[:2], source="new", min_points=9)
    build(tmp_path / "b", scenes=SCENES[:2], source="new", min_points=9)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert len(contents(tmp_path / "a")) == 5


def edit(file, **changes):
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


SHARD = {"name": "a", "objects": 0, "points": 0, "table_blake2b": ""}


MANIFEST, TABLE, POINTS = "manifest.json", "scene-b.objects.npz", "scene-c.points.f32"
DAMAGE = {
    "no manifest": (MANIFEST, Path.unlink, "no such file, expected a finished"),
    "truncated manifest": (MANIFEST, lambda f: cut(f, 100), "not JSON"),
    "older version": (MANIFEST, lambda f: edit(f, version=2), "version: got 2, expected int >= 5; rebuild it"),
    "path": (MANIFEST, lambda f: edit(f, shards=[SHARD | {"name": "/etc/x"}]), "name: got '/etc/x', expected"),
    "altered table": (TABLE, lambda f: flip(f, 700), "rebuild it with"),
    "truncated table": (TABLE, lambda f: cut(f, 700), "not a table of objects"),
    "no table": (TABLE, Path.unlink, "No such file"),
    "no points": (POINTS, Path.unlink, "got no file, expected"),
    "truncated points": (POINTS, lambda f: cut(f, 700), "got 700 bytes, expected"),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_a_damaged_database_is_refused_when_opened_and_repaired_when_built_again(tmp_path, whole, case):
    name, damage, *fragments = DAMAGE[case]
    build(tmp_path)
    damage(tmp_path / name)
    with refused(f"{tmp_path / name}: ", *fragments):
        open_database(tmp_path)
    build(tmp_path)
    assert contents(tmp_path) == whole


def test_an_altered_point_is_refused_when_its_object_is_read(tmp_path):
    objects = build(tmp_path)
    flip(tmp_path / "scene-b.points.f32", 20 * int(objects.table["start"][2]) + 7)
    objects = open_database(tmp_path)
    objects.points(1)
    with refused(f"{tmp_path}/scene-b.points.f32: object 2: checksum"):
        objects.points(2)
    build(tmp_path).points(2)  # building again repairs it


def test_a_database_of_other_data_is_refused(tmp_path):
    build(tmp_path)
    open_database(tmp_path, fingerprint="f")
    with refused("source: got 'f', expected 'g': built from other data"):
        open_database(tmp_path, fingerprint="g")


def test_objects_of_changed_clouds_are_cut_again(tmp_path, monkeypatch):
    points = []
    for size in (1.0, 2.0):  # The frames change, and with them only the state of their files.
        monkeypatch.setattr(SceneFrames, "clouds_fingerprint", lambda *_, size=size: f"{size:g}")
        frame = toy_frame(0)
        frames = ListedFrames((dataclasses.replace(frame, points=frame.points * np.float32([1, 1, 1, size, 1])),))
        points.append(build(tmp_path, frames, scenes=(("s", (0,)),)).points(0))
    np.testing.assert_allclose(points[1], points[0] * [1, 1, 1, 2, 1])


def test_objects_have_the_columns_of_the_sensor(tmp_path):
    frames = InMemoryFrames((toy_frame(1, columns=6),), ARGOVERSE2, NUSCENES_CLASSES)
    assert build(tmp_path, frames, scenes=(("s", (0,)),)).points(0).shape[1] == 6

"""The object database: what is cut, that it survives kills, and that damage is seen."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from toy_frames import ListedFrames, ToyFrames, toy_frame

import oracles
from fcos_lidar_jax.data.object_builder import build_objects
from fcos_lidar_jax.data.objects import ObjectDatabaseError, open_objects

PLAN = [("scene-b", (0, 1, 2)), ("scene-a", (3,)), ("scene-c", (6, 4))]


def build(folder, frames=None, **options):
    return build_objects(frames or ToyFrames(), folder, **{"shards": PLAN, "fingerprint": "f", **options})


def contents(folder):
    return {p.name: p.read_bytes() for p in sorted(Path(folder).iterdir())}


def test_every_box_of_enough_points_is_cut_with_its_points(tmp_path):
    objects = build(tmp_path)
    expected = []
    for index in (0, 1, 2, 3, 6, 4):
        frame = toy_frame(index)
        for box, label in zip(frame.boxes, frame.labels, strict=True):
            inside = frame.points[[oracles.inside(p[:3].astype(float), box.astype(float)) for p in frame.points]]
            if len(inside) >= 5:
                expected.append((index, label, box, inside))
    assert len(objects) == len(expected) > 30
    for i, (index, label, box, inside) in enumerate(expected):
        row = objects.table[i]
        assert (row["frame"], row["label"], row["count"]) == (index, label, len(inside))
        assert row["current"] == (inside[:, 4] == 0).sum()
        np.testing.assert_array_equal(row["box"], box)
        np.testing.assert_array_equal(objects.points(i), inside)
    assert {len(p[3]) for p in expected} != {5}
    assert (objects.table["current"] < objects.table["count"]).any()


def test_min_points_and_empty_shards(tmp_path):
    plan = [("none", ()), ("one", (1,)), ("bare", (0,))]
    bare = toy_frame(1)
    frames = ListedFrames((type(bare)(bare.points, bare.boxes[:0], bare.labels[:0], bare.num_points[:0]), bare))
    objects = build(tmp_path, frames, shards=plan, min_points=25)
    assert [s.objects for s in objects.manifest.shards] == [0, len(objects), 0]
    assert objects.table["count"].min() >= 25
    assert len(objects) < len(build(tmp_path / "more", frames, shards=plan, min_points=5))
    assert len(build(tmp_path / "empty", frames, shards=[])) == 0


def test_same_bytes_for_any_number_of_workers(tmp_path):
    build(tmp_path / "one")
    reports = []
    build(tmp_path / "two", workers=2, report=lambda done, total: reports.append((done, total)))
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert reports[0] == (0, 6)
    assert reports[-1] == (6, 6)
    assert len(reports) == 4


class Interrupted(Exception):
    pass


def interrupt_after(count):
    def report(done, _):
        if done >= count:
            raise Interrupted

    return report


@pytest.mark.parametrize("done", [0, 1, 4, 6])
def test_an_interrupted_build_goes_on_to_the_same_bytes(tmp_path, done):
    build(tmp_path / "whole")
    with pytest.raises(Interrupted):
        build(tmp_path / "parts", report=interrupt_after(done))
    with pytest.raises(ObjectDatabaseError, match=r"manifest\.json: no such file"):
        open_objects(tmp_path / "parts")
    before = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "parts").iterdir()}
    reports = []
    build(tmp_path / "parts", report=lambda d, _: reports.append(d))
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    assert reports[0] >= done
    for name, stamp in before.items():  # what was there is not made again
        assert (tmp_path / "parts" / name).stat().st_mtime_ns == stamp


def ends(group):
    """Whether no process of a group is left, soon."""
    for _ in range(200):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def test_a_build_over_an_older_one_has_no_manifest_until_it_is_finished(tmp_path):
    build(tmp_path, fingerprint="old")
    with pytest.raises(Interrupted):
        build(tmp_path, report=interrupt_after(1))
    with pytest.raises(ObjectDatabaseError, match=r"manifest\.json: no such file"):
        open_objects(tmp_path)


KILLED = """
import sys
from fcos_lidar_jax.data.object_builder import build_objects
from toy_frames import ToyFrames
if __name__ == "__main__":
    plan = [(f"scene-{i}", (i, i + 1)) for i in range(99)]
    print("began", flush=True)
    build_objects(ToyFrames(99, 0.03), sys.argv[1], shards=plan, fingerprint="f", workers=int(sys.argv[2]))
"""


@pytest.mark.parametrize(("workers", "sent"), [(1, signal.SIGKILL), (2, signal.SIGKILL), (2, signal.SIGINT)])
def test_a_killed_build_goes_on_to_the_same_bytes(tmp_path, workers, sent):
    script = tmp_path / "build.py"
    script.write_text(KILLED)
    folder = tmp_path / "objects"
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    process = subprocess.Popen(
        [sys.executable, str(script), str(folder), str(workers)],
        env=environment,
        start_new_session=True,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 60
    while len(list(folder.glob("*.npz"))) < 4 and time.monotonic() < deadline:
        time.sleep(0.005)
    if sent == signal.SIGINT:  # as a terminal does: to all of them
        os.killpg(process.pid, sent)
    else:
        process.send_signal(sent)
    error = process.communicate(timeout=60)[1]
    assert 4 <= len(list(folder.glob("*.npz"))) < 99
    assert not (folder / "manifest.json").exists()
    assert error.count("Traceback") <= 1  # the workers say nothing
    assert ends(process.pid)
    plan = [(f"scene-{i}", (i, i + 1)) for i in range(99)]
    build(folder, ToyFrames(99), shards=plan)
    build(tmp_path / "whole", ToyFrames(99), shards=plan)
    assert contents(folder) == contents(tmp_path / "whole")


def test_other_data_or_another_plan_replace_what_was_there(tmp_path):
    build(tmp_path / "a", fingerprint="old")
    (tmp_path / "a" / ".0123456789ab.f32").write_bytes(b"half")
    build(tmp_path / "a", shards=PLAN[:2], fingerprint="new", min_points=9)
    build(tmp_path / "b", shards=PLAN[:2], fingerprint="new", min_points=9)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert len(contents(tmp_path / "a")) == 5


def test_a_finished_build_is_left_as_it_is(tmp_path):
    build(tmp_path)
    stamps = {p.name: p.stat().st_mtime_ns for p in tmp_path.iterdir() if p.name != "manifest.json"}
    build(tmp_path)
    assert stamps == {p.name: p.stat().st_mtime_ns for p in tmp_path.iterdir() if p.name != "manifest.json"}


def flip(file, position):
    data = bytearray(file.read_bytes())
    data[position] ^= 1
    file.write_bytes(data)


def cut(file, size):
    file.write_bytes(file.read_bytes()[:size])


def edit(file, **changes):
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def recount(file, field):
    shards = json.loads(file.read_text())["shards"]
    shards[0][field] += 1
    edit(file, shards=shards)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "manifest.json").unlink(), r"manifest.json: no such file, expected a finished"),
        (lambda f: cut(f / "manifest.json", 100), r"manifest.json: .*truncated"),
        (
            lambda f: edit(f / "manifest.json", version=2),
            r"manifest.json: got .* version 2, expected .* version 1",
        ),
        (lambda f: edit(f / "manifest.json", format="x"), r"manifest.json: got 'x' version 1"),
        (lambda f: edit(f / "manifest.json", shards=3), r"manifest.json: Expected `array`, got `int`"),
        (lambda f: edit(f / "manifest.json", shards=[{}]), r"missing required field `name` - at `\$.shards\[0\]`"),
        (lambda f: edit(f / "manifest.json", classes=["car"]), r"manifest.json: classes: got \['car'\]"),
        (
            lambda f: recount(f / "manifest.json", "objects"),
            r"manifest.json: scene-b: got \d+ objects of \d+ points",
        ),
        (lambda f: recount(f / "manifest.json", "points"), r"expected \d+ of \d+ as in its table; build it anew"),
        (lambda f: flip(f / "scene-b.objects.npz", 700), r"scene-b.objects.npz: checksum differs"),
        (lambda f: cut(f / "scene-b.objects.npz", 700), r"scene-b.objects.npz: checksum differs"),
        (lambda f: (f / "scene-a.objects.npz").unlink(), r"scene-a.objects.npz: No such file"),
        (lambda f: (f / "scene-c.points.f32").unlink(), r"scene-c.points.f32: got no file, expected \d+ bytes"),
        (lambda f: cut(f / "scene-c.points.f32", 700), r"scene-c.points.f32: got 700 bytes, expected \d+ bytes"),
    ],
)
def test_damage_is_one_line_when_opened(tmp_path, damage, message):
    build(tmp_path)
    damage(tmp_path)
    with pytest.raises(ObjectDatabaseError, match=message) as caught:
        open_objects(tmp_path)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    build(tmp_path)  # and building again repairs it
    build(tmp_path.with_name("other"))
    assert contents(tmp_path) == contents(tmp_path.with_name("other"))


def test_an_altered_point_is_one_line_when_its_object_is_read(tmp_path):
    objects = build(tmp_path)
    flip(tmp_path / "scene-b.points.f32", 20 * int(objects.table["start"][2]) + 7)
    objects = open_objects(tmp_path)
    objects.points(1)
    with pytest.raises(ObjectDatabaseError, match=re.escape(f"{tmp_path}/scene-b.points.f32: object 2: checksum")):
        objects.points(2)
    build(tmp_path).points(2)  # building again repairs it


def test_other_data_are_refused(tmp_path):
    build(tmp_path)
    open_objects(tmp_path, fingerprint="f")
    with pytest.raises(ObjectDatabaseError, match=r"source: got 'f', expected 'g': built from other data"):
        open_objects(tmp_path, fingerprint="g")


@pytest.mark.parametrize("plan", [[("a/b", ())], [("..", ())], [(".a", ())], [("", ())], [("a", ()), ("a", ())]])
def test_shard_names_stay_in_the_folder(tmp_path, plan):
    with pytest.raises(ValueError, match="shard name"):
        build(tmp_path, shards=plan)


def test_columns_must_agree(tmp_path):
    frames = ListedFrames((toy_frame(0), toy_frame(1, columns=6)))
    with pytest.raises(ValueError, match="frame 1: points: got 6 columns, expected 5"):
        build(tmp_path / "a", frames, shards=[("s", (0, 1))])
    with pytest.raises(ValueError, match="shard 't': points: got 6 columns, expected 5"):
        build(tmp_path / "b", frames, shards=[("s", (0,)), ("t", (1,))])
    assert build(tmp_path / "c", frames, shards=[("t", (1,))]).points(0).shape[1] == 6


def test_workers_pass_on_errors(tmp_path):
    with pytest.raises(IndexError):
        build(tmp_path, ListedFrames((toy_frame(0),)), shards=[("s", (0,)), ("t", (1,))], workers=2)
    assert {p.name for p in tmp_path.iterdir()} <= {"s.points.f32", "s.objects.npz"}

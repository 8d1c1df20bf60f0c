"""``prepare``: the same bytes whenever it was killed, one line for what goes wrong."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from made_nuscenes import VERSION, make_tables, write

from fcos_lidar_jax import cli
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.input_pipeline.database import DatabaseError, objects_folder, open_database

SCENES = 6


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    tables, clouds = make_tables(SCENES)
    for row in tables["sample_annotation"]:  # so large that they hold points
        row["size"] = [40.0, 40.0, 40.0]
    return write(tmp_path_factory.mktemp("root"), tables, clouds)


def prepare(root: Path, index: Path, *more: str) -> list[str]:
    where = ["--data-root", str(root), "--version", VERSION, "--index", str(index)]
    return ["prepare", *where, "--train-split", "all", "--num-sweeps", "2", *more]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def test_says_what_there_is_and_a_second_run_changes_nothing(root, tmp_path, capsys):
    assert cli.main(prepare(root, tmp_path / "i")) == 0
    record = json.loads(capsys.readouterr().out)
    assert {k: record[k] for k in ("scenes", "keyframes", "sweeps", "annotations", "frames")} == {
        "scenes": SCENES,
        "keyframes": 4 * SCENES,
        "sweeps": 12 * SCENES,
        "annotations": 16 * SCENES,
        "frames": 4 * SCENES,
    }
    # Two of the four categories are no class.
    assert record["objects"] == len(open_database(tmp_path / "i" / "objects" / "all")) > 4 * SCENES
    before = contents(tmp_path / "i")
    stamps = {f: f.stat().st_mtime_ns for f in (tmp_path / "i").rglob("*.npy")}
    assert cli.main(prepare(root, tmp_path / "i")) == 0
    assert contents(tmp_path / "i") == before
    assert all(f.stat().st_mtime_ns == stamp for f, stamp in stamps.items())


KILLED = """
import os, random, signal, sys, time
from fcos_lidar_jax.cli import main
index, command, draw = sys.argv[1], sys.argv[2:], random.Random(0)
def start(name):
    child = os.fork()
    if not child:
        os._exit(main([*command, "--index", f"{index}-{name}"]))
    return child
whole_s = 9.0
for i in range(3):
    began = time.monotonic()
    os.waitpid(start(f"whole-{i}"), 0)
    whole_s = min(whole_s, time.monotonic() - began)
for trial in range(12):
    for _ in range(1 + trial // 8):
        child = start(trial)
        time.sleep(draw.uniform(0.1, 1) * whole_s)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
"""


def test_workers_and_kills_end_in_the_same_bytes(root, tmp_path):
    assert cli.main(prepare(root, tmp_path / "whole")) == 0
    wanted = contents(tmp_path / "whole")
    # Forked from a process that has imported everything, so that the kills hit the work.
    command = [sys.executable, "-c", KILLED, str(tmp_path / "killed"), *prepare(root, tmp_path / "none")]
    subprocess.run(command, check=True, capture_output=True)
    states = set()
    for trial in range(12):
        folder = tmp_path / f"killed-{trial}"
        states.add(tuple(contents(folder)) if folder.exists() else ())
        assert cli.main(prepare(root, folder, *(["--workers", "2"] if trial == 0 else []))) == 0
        assert contents(folder) == wanted
    assert len(states - {(), tuple(wanted)}) >= 3  # they were killed at work


def test_objects_come_from_the_training_split_alone(root, tmp_path):
    assert cli.main(prepare(root, tmp_path / "i", "--train-split", "scene-1")) == 0
    objects = open_database(tmp_path / "i" / "objects" / "scene-1")
    data = NuScenes(root, VERSION)
    own, other = (
        {box.tobytes() for token in data.split(split) for box in data.boxes(token).boxes}
        for split in ("scene-1", "scene-2")
    )
    found = {row["box"].tobytes() for row in objects.table}
    assert len(found) == len(objects) > 4
    assert found <= own
    assert not found & other
    assert [shard.name for shard in objects.manifest.shards] == ["scene-1"]


def test_objects_of_other_keyframes_or_boxes_are_refused(root, tmp_path):
    assert cli.main(prepare(root, tmp_path / "i", "--train-split", "scene-1")) == 0
    data = NuScenes(root, VERSION)

    def frames(split: str, num_sweeps: int) -> NuScenesFrames:
        return NuScenesFrames(data, tuple(data.split(split)), num_sweeps)

    folder = objects_folder(tmp_path / "i", "scene-1")
    open_database(folder, fingerprint=frames("scene-1", 2).fingerprint())
    for other in (frames("scene-2", 2), frames("all", 2), frames("scene-1", 1)):
        with pytest.raises(DatabaseError, match=r"manifest.json: source: got .* built from other data"):
            open_database(folder, fingerprint=other.fingerprint())
    copy = shutil.copytree(root, tmp_path / "copy")
    file = copy / VERSION / "sample_annotation.json"
    file.write_text(json.dumps([{**row, "size": [30.0, 40.0, 40.0]} for row in json.loads(file.read_text())]))
    assert cli.main(prepare(copy, tmp_path / "larger", "--train-split", "scene-1")) == 0
    data = NuScenes(copy, VERSION, index=tmp_path / "larger")
    with pytest.raises(DatabaseError, match="built from other data"):
        open_database(folder, fingerprint=frames("scene-1", 2).fingerprint())


def test_a_stale_index_is_made_anew_and_said(root, tmp_path, capsys):
    copy = shutil.copytree(root, tmp_path / "copy")
    assert cli.main(prepare(copy, tmp_path / "i")) == 0
    file = copy / VERSION / "sample_annotation.json"
    rows = json.loads(file.read_text())
    file.write_text(json.dumps([{**r, "next": "", "prev": ""} for r in rows][:-1]))
    capsys.readouterr()
    assert cli.main(prepare(copy, tmp_path / "i")) == 0
    out, err = capsys.readouterr()
    assert "sample_annotation.json: the index was made when" in err
    assert json.loads(out)["annotations"] == 16 * SCENES - 1
    assert cli.main(prepare(copy, tmp_path / "new")) == 0
    assert contents(tmp_path / "i") == contents(tmp_path / "new")


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda text: re.sub(r'"format_version": \d+', '"format_version": 99', text), "format_version: got 99"),
        (lambda text: text[:100], "index.json: not JSON"),
        (lambda text: text.replace("fcos_lidar_index", "other"), "index.json: format: expected"),
    ],
)
def test_an_index_of_another_version_is_made_anew_and_said(root, tmp_path, capsys, damage, expected):
    assert cli.main(prepare(root, tmp_path / "i")) == 0
    before = contents(tmp_path / "i")
    file = tmp_path / "i" / "index.json"
    file.write_text(damage(file.read_text()))
    assert cli.main(prepare(root, tmp_path / "i")) == 0
    said = next(line for line in capsys.readouterr().err.splitlines() if expected in line)
    assert said.endswith(": making it anew")
    assert contents(tmp_path / "i") == before


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (["--workers", "0"], "--workers: got 0, expected at least 1"),
        (["--num-sweeps", "0"], "--num-sweeps: got 0, expected at least 1"),
        (["--train-split", "other"], "split 'other': not found"),
        (["--splits", "gone.json"], "gone.json: no such file"),
        (["--version", "v0"], "v0: no such folder"),
        (["--data-root", "gone"], "gone"),
    ],
)
def test_bad_arguments_get_one_line(root, tmp_path, capsys, more, expected):
    assert cli.main(prepare(root, tmp_path / "i", *more)) == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("fcos-lidar: error: ")
    assert expected in error


@pytest.mark.parametrize(("size", "finished"), [("16k", set()), ("152k", {"index.json"})])
def test_a_full_disk_gets_one_line_and_nothing_half_written(root, tmp_path, size, finished):
    small = tmp_path / "small"
    small.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "t", str(small)]
    if os.geteuid() or subprocess.run(mount, check=False, stderr=subprocess.DEVNULL).returncode:
        pytest.skip("no right to mount a small tmpfs")
    try:
        command = [sys.executable, "-m", "fcos_lidar_jax", *prepare(root, small / "i")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        left = [file for file in small.rglob(".*") if file.name != ".lock"]
        manifests = {file.name for file in small.rglob("*.json")}
    finally:
        subprocess.run(["umount", small], check=True)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1].startswith("fcos-lidar: error: ")
    assert "No space left on device" in done.stderr
    assert "Traceback" not in done.stderr
    assert (left, manifests) == ([], finished)

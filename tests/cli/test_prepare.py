"""``fcos-lidar prepare``: the same bytes after any kill, and one line per mistake."""

import json
import os
import shutil
from pathlib import Path

import pytest
from commands import assert_one_line_error, command, contents, cut
from kills import killed_twice
from made_nuscenes import VERSION, make_tables, write

from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.input_pipeline.database import open_database

SCENES = 6


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    tables, clouds = make_tables(SCENES)
    for row in tables["sample_annotation"]:  # large enough to hold points
        row["size"] = [40.0, 40.0, 40.0]
    return write(tmp_path_factory.mktemp("root"), tables, clouds)


def prepare(root: Path, index: Path, *more: str) -> list[str]:
    where = ["--data-root", str(root), "--version", VERSION, "--index", str(index)]
    return ["prepare", *where, "--train-split", "all", "--num-sweeps", "2", *more]


def test_prints_a_record_and_a_second_run_changes_nothing(root, tmp_path, capsys):
    command(*prepare(root, tmp_path / "i"))
    record = json.loads(capsys.readouterr().out)
    per_scene = {"scenes": 1, "keyframes": 4, "sweeps": 12, "annotations": 16, "frames": 4}
    assert per_scene.items() <= {k: v / SCENES for k, v in record.items() if isinstance(v, int)}.items()
    # Two of the four categories have no class.
    assert record["objects"] == len(open_database(tmp_path / "i" / "objects" / "all")) > 4 * SCENES
    before = contents(tmp_path / "i")
    stamps = {f: f.stat().st_mtime_ns for f in (tmp_path / "i").rglob("*.npy")}
    command(*prepare(root, tmp_path / "i"))
    assert contents(tmp_path / "i") == before
    assert all(f.stat().st_mtime_ns == stamp for f, stamp in stamps.items())


def test_objects_come_only_from_the_training_split(root, tmp_path):
    command(*prepare(root, tmp_path / "i", "--split", "scene-1"))
    data = NuScenes(root, VERSION)
    own, other = (
        {b.tobytes() for t in data.split(s) for b in data.boxes(t).boxes} for s in ("scene-1", "scene-2")
    )
    boxes = {row["box"].tobytes() for row in open_database(tmp_path / "i" / "objects" / "scene-1").table}
    assert boxes
    assert boxes <= own - other


@pytest.mark.slow
def test_workers_and_kills_end_in_the_same_bytes(root, tmp_path):
    command(*prepare(root, tmp_path / "whole"))
    expected = contents(tmp_path / "whole")
    states = set()
    for trial, folder in enumerate(killed_twice(tmp_path / "killed", "--index", prepare(root, tmp_path / "none"))):
        states.add(tuple(contents(folder)) if folder.exists() else ())
        command(*prepare(root, folder, *(["--workers", "2"] if trial == 0 else [])))
        assert contents(folder) == expected
    assert len(states - {(), tuple(expected)}) >= 4  # kills at different stages


def change_tables(root: Path, index: Path) -> None:
    file = root / VERSION / "sample_annotation.json"
    rows = json.loads(file.read_text())
    file.write_text(json.dumps([{**r, "next": "", "prev": ""} for r in rows][:-1]))


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (change_tables, "sample_annotation.json: the index was made from another table"),
        (lambda root, index: cut(index / "index.json", 100), "index.json: not JSON"),
    ],
)
def test_an_index_that_cannot_be_used_is_rebuilt_with_a_message(root, tmp_path, capsys, spoil, told):
    copy = shutil.copytree(root, tmp_path / "copy")
    command(*prepare(copy, tmp_path / "i"))
    spoil(copy, tmp_path / "i")
    command(*prepare(copy, tmp_path / "i"))
    (line,) = (line for line in capsys.readouterr().err.splitlines() if told in line)
    assert line.endswith(": rebuilding it")
    command(*prepare(copy, tmp_path / "new"))
    assert contents(tmp_path / "i") == contents(tmp_path / "new")


def test_the_folder_is_told_before_it_is_written_and_asked_for_otherwise(root, tmp_path, monkeypatch, capsys):
    copy = shutil.copytree(root, tmp_path / "copy")
    line = ["prepare", "--data-root", str(copy), "--train-split", "all"]
    with monkeypatch.context() as patch:  # root may write anywhere
        patch.setattr(os, "access", lambda *_: False)
        found = f"--index: {copy}: found a folder without write permission, expected a folder to write to"
        assert_one_line_error(capsys, line, f"{found}; name one by --index, here and for train$")
    monkeypatch.setattr("fcos_lidar_jax.cli.prepare.build_index", lambda *_: pytest.fail(capsys.readouterr().err))
    with pytest.raises(pytest.fail.Exception, match=f"writing to {copy}/.fcos_lidar/{VERSION}; --index names"):
        command(*line)


def test_a_version_without_annotations_only_gets_an_index(root, tmp_path, capsys):
    copy = shutil.copytree(root, tmp_path / "copy")
    for table in ("sample_annotation", "instance"):
        (copy / VERSION / f"{table}.json").write_text("[]")
    (copy / VERSION / "splits.json").unlink()
    command(*prepare(copy, tmp_path / "i"))
    record = json.loads(capsys.readouterr().out)
    assert (record["annotations"], "objects" in record) == (0, False)
    assert not (tmp_path / "i" / "objects").exists()
    assert len(NuScenes(copy, VERSION, index=tmp_path / "i").sample_tokens) == 4 * SCENES

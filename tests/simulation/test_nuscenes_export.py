"""Check synthetic data sets: official layout, exact annotations, and identical bytes after interruptions."""

import dataclasses
import errno
import json
from pathlib import Path

import numpy as np
import pytest
from commands import assert_one_line_error, contents, in_use
from kills import killed_twice
from scipy.spatial.transform import Rotation

from fcos_lidar_jax import cli
from fcos_lidar_jax.config import WHOLE_SWEEP
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.sensors import TINY, sensor_to_json

VERSION = "v1.0-synthetic"
ORDER = ["--scenes", "2", "--keyframes", "2", "--sensor", "tiny", "--seed", "4"]

KEYS = {  # of the official tables
    "attribute": "token name description",
    "calibrated_sensor": "token sensor_token translation rotation camera_intrinsic",
    "category": "token name description index",
    "ego_pose": "token timestamp rotation translation",
    "instance": "token category_token nbr_annotations first_annotation_token last_annotation_token",
    "log": "token logfile vehicle date_captured location",
    "map": "token log_tokens category filename",
    "sample": "token timestamp prev next scene_token",
    "sample_annotation": "token sample_token instance_token visibility_token attribute_tokens translation size "
    "rotation prev next num_lidar_pts num_radar_pts",
    "sample_data": "token sample_token ego_pose_token calibrated_sensor_token timestamp fileformat is_key_frame "
    "height width filename prev next",
    "scene": "token log_token nbr_samples first_sample_token last_sample_token name description",
    "sensor": "token channel modality",
    "visibility": "token level description",
}


def command(out: Path, *more: str) -> list[str]:
    return ["synthesize", "--out", str(out), *ORDER, *more]


def synthesize(out: Path, *more: str) -> Path:
    assert cli.main(command(out, *more)) == 0
    return out


def tables(root: Path) -> dict[str, list[dict]]:
    return {file.stem: json.loads(file.read_text()) for file in (root / VERSION).glob("*.json")}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return synthesize(tmp_path_factory.mktemp("made") / "data")


def test_the_layout_is_official(made):
    found = tables(made)
    keys = {name: {" ".join(sorted(row)) for row in rows} for name, rows in found.items() if name != "splits"}
    assert keys == {name: {" ".join(sorted(of.split()))} for name, of in KEYS.items()}
    train, val = ["scene-0001"], ["scene-0002"]
    assert found["splits"] == {"train": train, "synthetic_train": train, "val": val, "synthetic_val": val}
    for row in found["sample_data"]:
        size = (made / row["filename"]).stat().st_size
        assert size == TINY.num_rows * TINY.num_columns * 5 * 4
        assert row["filename"].startswith("samples/" if row["is_key_frame"] else "sweeps/")
    stamps = np.array([row["timestamp"] for row in found["sample_data"]]).reshape(2, 11)
    np.testing.assert_array_equal(np.diff(stamps), 50_000)
    assert [row["is_key_frame"] for row in found["sample_data"][:11]] == [i % 10 == 0 for i in range(11)]
    assert (made / found["map"][0]["filename"]).is_file()


def test_a_sweep_that_was_cut_by_a_full_disk_is_made_again(made, tmp_path, monkeypatch):
    write, sizes = Path.write_bytes, []

    def until_full(file: Path, data: bytes) -> int:
        sizes.append(len(data))
        if len(sizes) < 23:
            return write(file, data)
        write(file, data[:-20])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", until_full)
        assert cli.main(command(tmp_path / "data")) == 1
    assert len(sizes) == 23
    assert contents(synthesize(tmp_path / "data")) == contents(made)


def test_tokens_and_chains_refer_to_existing_rows(made):
    found = tables(made)
    by_token = {name: {row["token"]: row for row in rows} for name, rows in found.items() if name != "splits"}
    for name, rows in by_token.items():
        assert len(rows) == len(found[name]) > 0, name
        for row in rows.values():
            for table in by_token:
                if f"{table}_token" in row:
                    assert row[f"{table}_token"] in by_token[table], (name, table)
            if "prev" in row:
                assert not row["prev"] or rows[row["prev"]]["next"] == row["token"]
                assert not row["next"] or rows[row["next"]]["prev"] == row["token"]
    for row in found["instance"]:
        chain = [by_token["sample_annotation"][row["first_annotation_token"]]]
        while chain[-1]["next"]:
            chain.append(by_token["sample_annotation"][chain[-1]["next"]])
        assert len(chain) == row["nbr_annotations"]
        assert chain[-1]["token"] == row["last_annotation_token"]
        assert all(link["instance_token"] == row["token"] for link in chain)
        assert chain[0]["num_lidar_pts"] > 0 < chain[-1]["num_lidar_pts"]


def test_annotated_point_counts_are_exact(made):
    """Counts points of a rolling shutter in the global frame with the quaternions of the files."""
    found, data = tables(made), NuScenes(made, VERSION)
    counted = 0
    for sample in data.sample_tokens:
        points = data.fuse_sweeps(sample, WHOLE_SWEEP)[0][:, :3].astype(np.float64)
        pose = data.sensor_to_global(sample)
        world = points @ pose[:3, :3].T + pose[:3, 3]
        for row in (row for row in found["sample_annotation"] if row["sample_token"] == sample):
            local = Rotation.from_quat(row["rotation"], scalar_first=True).inv().apply(world - row["translation"])
            inside = (np.abs(local) <= np.array(row["size"])[[1, 0, 2]] / 2).all(axis=1)
            assert inside.sum() == row["num_lidar_pts"], row["token"]
            counted += 1
    assert counted == len(found["sample_annotation"]) > 15
    assert sum(row["num_lidar_pts"] for row in found["sample_annotation"]) > 200


@pytest.mark.slow
def test_bytes_depend_on_seed_and_shutter_but_not_on_workers_or_the_number_of_scenes(made, tmp_path):
    expected, short = contents(made), ("--scenes", "1")
    assert contents(synthesize(tmp_path / "again", "--workers", "2")) == expected
    alone = contents(synthesize(tmp_path / "one", *short))
    points = {name: data for name, data in alone.items() if name.endswith(".bin")}
    assert len(points) == 11
    assert points.items() <= expected.items()
    still = contents(synthesize(tmp_path / "still", *short, "--no-rolling-shutter"))
    assert still.keys() == alone.keys()
    assert all(still[name] != points[name] for name in points)
    synthesize(tmp_path / "other", *short, "--seed", "5")
    assert tables(tmp_path / "other")["ego_pose"] != tables(tmp_path / "one")["ego_pose"]


def test_a_second_run_reports_that_the_data_set_is_complete(made, capsys):
    stamps = {file: file.stat().st_mtime_ns for file in made.rglob("*")}
    synthesize(made)
    printed = capsys.readouterr()
    assert "was there already" in printed.err
    record = json.loads(printed.out)
    assert (record["keyframes"], record["sweeps"]) == (4, 22)
    assert record["splits"] == {"train": 1, "synthetic_train": 1, "val": 1, "synthetic_val": 1}
    assert {file: file.stat().st_mtime_ns for file in made.rglob("*")} == stamps


@pytest.mark.slow
def test_killed_runs_resume_to_the_same_bytes(tmp_path):
    (tmp_path / "coarse.json").write_text(json.dumps(sensor_to_json(dataclasses.replace(TINY, num_columns=16))))
    quick = ["--keyframes", "1", "--streets", "plain", "--no-rolling-shutter", "--workers", "1"]
    quick += ["--sensor", str(tmp_path / "coarse.json")]
    killed = killed_twice(tmp_path / "killed", "--out", command(tmp_path / "none", *quick))
    whole, states = tmp_path / "killed-whole", set()
    for root in killed:
        states.add(tuple(contents(root)))
        if (root / VERSION).is_dir():  # tables appear last
            assert contents(root / VERSION) == contents(whole / VERSION)
        assert contents(synthesize(root, *quick)) == contents(whole)
    assert len(states) >= 4  # kills at different stages


def test_folders_with_other_contents_are_refused(made, tmp_path, capsys):
    before = contents(made)
    (tmp_path / "near.json").write_text(json.dumps({**sensor_to_json(TINY), "limit_xy_m": 9.0}))
    for option, value in (("seed", 5), ("streets", "plain"), ("sensor", tmp_path / "near.json")):
        line = command(made, f"--{option}", str(value))
        assert_one_line_error(capsys, line, f"{made}: found a data set begun with another {option}")
    own = tmp_path / "own"
    with in_use(own / ".synthesize"):
        assert_one_line_error(capsys, command(own), " is at work, expected no other process")
    (own / "thesis.txt").write_text("mine")
    assert_one_line_error(capsys, command(own), "found other files, expected an empty folder")
    assert (own / "thesis.txt").read_text() == "mine"
    moved = {"forward_rad": 0.0, "origin_m": [1, 0, 2], "limit_z_m": [-3, 5]}  # the layout's own are written
    (tmp_path / "moved.json").write_text(json.dumps({**sensor_to_json(TINY), **moved}))
    synthesize(made, "--sensor", str(tmp_path / "moved.json"))
    assert contents(made) == before

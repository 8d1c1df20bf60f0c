"""Synthetic data sets: the official layout, exact annotations, the same bytes whatever happens on the way."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fcos_lidar_jax import cli
from fcos_lidar_jax.data.box_geometry import inside_box
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, TINY
from fcos_lidar_jax.types import CLASSES

VERSION = "v1.0-synthetic"
ORDER = ["--scenes", "3", "--keyframes", "2", "--sensor", "tiny", "--seed", "4"]
FIELDS = ("boxes", "tokens", "labels", "attributes")
MOVING = ("vehicle.moving", "pedestrian.moving", "cycle.with_rider")
KEYS = {  # of the official tables, where the devkit and others look for them
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


def synthesize(out: Path, *more: str) -> list[str]:
    return ["synthesize", "--out", str(out), *ORDER, *more]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def tables(root: Path) -> dict[str, list[dict]]:
    return {file.stem: json.loads(file.read_text()) for file in (root / VERSION).glob("*.json")}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("made") / "data"
    assert cli.main(synthesize(root)) == 0
    return root


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> Path:
    """One scene with the full sensor, long enough for ten sweeps."""
    root = tmp_path_factory.mktemp("street") / "data"
    order = ["--scenes", "2", "--keyframes", "4", "--sensor", "nuscenes_hdl32e", "--seed", "1"]
    assert cli.main(["synthesize", "--out", str(root), *order]) == 0
    return root


def test_layout_is_the_official_one(made):
    found = tables(made)
    assert set(found) == {*KEYS, "splits"}
    for name, keys in KEYS.items():
        assert found[name], name
        assert all(set(row) == set(keys.split()) for row in found[name]), name
        tokens = [row["token"] for row in found[name]]
        assert len(set(tokens)) == len(tokens)
    assert found["splits"] == {
        "train": ["scene-0001", "scene-0002"],
        "synthetic_train": ["scene-0001", "scene-0002"],
        "val": ["scene-0003"],
        "synthetic_val": ["scene-0003"],
    }
    for row in found["sample_data"]:
        size = (made / row["filename"]).stat().st_size
        assert size == TINY.num_rows * TINY.num_columns * 5 * 4
        assert row["filename"].startswith("samples/" if row["is_key_frame"] else "sweeps/")
    stamps = np.array([row["timestamp"] for row in found["sample_data"]]).reshape(3, 11)
    np.testing.assert_array_equal(np.diff(stamps), 50_000)
    assert [row["is_key_frame"] for row in found["sample_data"][:11]] == [i % 10 == 0 for i in range(11)]
    assert (made / found["map"][0]["filename"]).is_file()


def test_tokens_and_chains_refer_to_what_is_there(made):
    found = tables(made)
    by_token = {name: {row["token"]: row for row in rows} for name, rows in found.items() if name != "splits"}
    kinds = {"instance_token": "instance", "visibility_token": "visibility", "ego_pose_token": "ego_pose"}
    kinds |= {"sample_token": "sample", "calibrated_sensor_token": "calibrated_sensor", "scene_token": "scene"}
    kinds |= {"log_token": "log", "category_token": "category", "sensor_token": "sensor"}
    for name, rows in by_token.items():
        for row in rows.values():
            for field in set(row) & set(kinds):
                assert row[field] in by_token[kinds[field]], (name, field)
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


def test_points_inside_every_box_number_exactly_what_is_annotated(street):
    """By the quaternions of the files, the cloud in the global frame; no-returns lie about the sensor."""
    found, data = tables(street), NuScenes(street, VERSION)
    counted = 0
    for sample in data.sample_tokens:
        points = data.sweeps(sample, 1, remove_close="none")[:, :3].astype(np.float64)
        pose = data.sensor_to_global(sample)
        world = points @ pose[:3, :3].T + pose[:3, 3]
        for row in found["sample_annotation"]:
            if row["sample_token"] == sample:
                turn = Rotation.from_quat(row["rotation"], scalar_first=True)
                local = turn.inv().apply(world - row["translation"])
                w, l, h = row["size"]
                inside = (np.abs(local) <= np.array([l, w, h]) / 2).all(axis=1)
                assert inside.sum() == row["num_lidar_pts"], row["token"]
                counted += 1
    assert counted == len(found["sample_annotation"]) > 300
    assert sum(row["num_lidar_pts"] for row in found["sample_annotation"]) > 10_000


def test_our_reader_sees_all_boxes_with_velocities_by_the_central_rule(street):
    data, found = NuScenes(street, VERSION), tables(street)
    rows = {row["token"]: row for row in found["sample_annotation"]}
    attribute_of = {row["token"]: row["name"] for row in found["attribute"]}
    seen, kinds, fastest = set(), set(), 0.0
    for sample in data.sample_tokens:
        boxes, matrix = data.boxes(sample), data.sensor_to_global(sample)[:3, :3]
        seen |= set(boxes.tokens)
        for box, token, label, attribute in zip(*(getattr(boxes, n) for n in FIELDS), strict=True):
            row, name = rows[token], CLASSES[label]
            assert [attribute_of[t] for t in row["attribute_tokens"]] == ([attribute] if attribute else [])
            before, after = (rows[row[side]] if row[side] else row for side in ("prev", "next"))
            if before is after:
                assert np.isnan(box[7:9]).all()
                continue
            steps = (before is not row) + (after is not row)
            moved = np.subtract(after["translation"], before["translation"]) / (0.5 * steps)
            np.testing.assert_allclose(box[7:9], (matrix.T @ moved)[:2], atol=1e-4)
            speed = np.hypot(*box[7:9])
            if attribute in MOVING:
                assert speed > 0.05
            elif attribute != "vehicle.stopped":  # which may have come to rest just now
                assert speed < 0.01, (name, attribute)
            assert (attribute == "") == (name in ("traffic_cone", "barrier"))
            kinds.add(attribute)
            fastest = max(fastest, speed)
    assert seen == set(rows)
    assert fastest > 3
    assert len(kinds) >= 6
    assert {row["visibility_token"] for row in found["sample_annotation"]} == {"1", "2", "3", "4"}


def test_old_points_stay_in_the_boxes_of_what_stands_and_leave_those_of_what_moves(street):
    """Points of the tenth sweep against those of the first, off the ground."""
    data = NuScenes(street, VERSION)
    stands, unposed, moves = [], [], []
    for scene in ("train", "val"):
        for last, token in itertools.pairwise(data.split(scene)):
            cloud = data.sweeps(token, 10)
            np.testing.assert_allclose(np.unique(cloud[:, 4]), np.arange(10) * 0.05, atol=1e-6)
            newest, oldest = (cloud[cloud[:, 4] == lag, :3] for lag in (0, cloud[:, 4].max()))
            motion = np.linalg.inv(data.sensor_to_global(last)) @ data.sensor_to_global(token)
            assert np.linalg.norm(motion[:3, 3]) > 1
            wrong = oldest @ motion[:3, :3].T + motion[:3, 3]  # about undoes what the reader composed
            truth = data.boxes(token)
            for box in truth.boxes[truth.num_lidar_pts > 50]:
                box = box + np.array([0, 0, 0.3, 0.2, 0.2, -0.6, 0, 0, 0])
                speed = np.hypot(*box[7:9])
                if speed > 4:  # the part that it has just driven into
                    gone = min(0.45 * speed, box[3])
                    box[:2] += (box[3] - gone) / 2 * box[7:9] / speed
                    box[3] = gone
                now, then, unmoved = (inside_box(points, box).sum() for points in (newest, oldest, wrong))
                if speed < 0.01:
                    stands.append(then / now)
                    unposed.append(unmoved / now)
                elif speed > 4 and now > 20:
                    moves.append(then / now)
    assert min(len(stands), len(moves)) >= 5
    assert 0.7 < np.median(stands) < 1.4
    assert np.median(unposed) < 0.7 * np.median(stands)
    assert np.median(moves) < 0.4 * np.median(stands), moves


def test_seed_and_workers(made, tmp_path):
    wanted = contents(made)
    assert cli.main(synthesize(tmp_path / "again", "--workers", "2")) == 0
    assert contents(tmp_path / "again") == wanted
    assert cli.main(synthesize(tmp_path / "other", "--seed", "5")) == 0
    other = contents(tmp_path / "other")
    assert all(other[name] != wanted[name] for name in wanted if name in other and name.endswith(".bin"))
    assert tables(tmp_path / "other")["sample"] != tables(made)["sample"]


def test_a_scene_does_not_depend_on_how_many_there_are(made, tmp_path):
    assert cli.main(synthesize(tmp_path / "one", "--scenes", "1")) == 0
    alone = {name: data for name, data in contents(tmp_path / "one").items() if name.endswith(".bin")}
    assert len(alone) == 11
    assert alone.items() <= contents(made).items()


def test_a_second_run_changes_nothing_and_says_so(made, capsys):
    stamps = {file: file.stat().st_mtime_ns for file in made.rglob("*")}
    assert cli.main(synthesize(made)) == 0
    printed = capsys.readouterr()
    assert "was there already" in printed.err
    record = json.loads(printed.out)
    assert (record["keyframes"], record["sweeps"]) == (6, 33)
    assert record["splits"] == {"train": 2, "synthetic_train": 2, "val": 1, "synthetic_val": 1}
    assert {file: file.stat().st_mtime_ns for file in made.rglob("*")} == stamps


KILLED = """
import os, signal, sys, time
from pathlib import Path
from fcos_lidar_jax.cli import main
out, command = sys.argv[1], sys.argv[2:]
def written(root):
    folders = [Path(root, kind, "LIDAR_TOP") for kind in ("samples", "sweeps")]
    return sum(len(os.listdir(folder)) for folder in folders if folder.is_dir())
for trial, moments in enumerate([(1, 14), (8, 19), (11, 25), (33, 33)]):
    for moment in moments:  # files that there are when it is killed
        child = os.fork()
        if not child:
            os._exit(main([*command, "--out", f"{out}-{trial}"]))
        while written(f"{out}-{trial}") < moment:
            time.sleep(0.001)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
"""


def test_killed_runs_end_in_the_same_bytes(made, tmp_path):
    wanted = contents(made)
    # Forked from a process that has imported everything, so that the kills hit the work.
    command = [sys.executable, "-c", KILLED, str(tmp_path / "killed"), *synthesize(tmp_path / "none")]
    subprocess.run(command, check=True, capture_output=True)
    states = set()
    for trial in range(4):
        root = tmp_path / f"killed-{trial}"
        states.add(len(list(root.rglob("*.bin"))))
        assert not (root / VERSION).is_dir() or contents(root) == wanted  # tables only when all is there
        assert cli.main(synthesize(root)) == 0
        assert contents(root) == wanted
    assert len(states) >= 3  # the kills came at different moments


def test_workers_die_with_the_command_and_the_rest_is_done_later(made, tmp_path):
    root = tmp_path / "data"
    command = [sys.executable, "-m", "fcos_lidar_jax", *synthesize(root, "--workers", "2")]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        until = time.monotonic() + 60
        while not list(root.rglob("*.bin")) and time.monotonic() < until:
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGKILL)
    time.sleep(0.5)
    before = contents(root)
    time.sleep(0.5)
    assert before
    assert contents(root) == before  # nobody writes any more
    assert cli.main(synthesize(root)) == 0
    assert contents(root) == contents(made)


def refusal(capsys, *command: str) -> str:
    """The one line of a command that fails."""
    assert cli.main(list(command)) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--scenes", "0"], "--scenes: got 0, expected at least 1"),
        (["--keyframes", "-3"], "--keyframes: got -3, expected at least 1"),
        (["--workers", "0"], "--workers: got 0, expected at least 1"),
        (["--seed", "-1"], "--seed: got -1, expected at least 0"),
        (["--version", "../x"], "--version: got '../x', expected a folder's name"),
        (["--version", ".x"], "--version: got '.x', expected a folder's name"),
        (["--version", "samples"], "--version: got 'samples', which is the name of another folder"),
        (["--sensor", "none.json"], "none.json: no such sensor file, and no preset"),
    ],
)
def test_bad_options_get_one_line(options, message, tmp_path, capsys):
    assert message in refusal(capsys, *synthesize(tmp_path / "new", *options))
    assert not (tmp_path / "new").exists()


def test_another_order_in_the_same_folder_is_refused(made, tmp_path, capsys):
    before = contents(made)
    for option, value in (("--seed", "5"), ("--scenes", "4"), ("--keyframes", "4"), ("--version", "v2")):
        line = refusal(capsys, *synthesize(made, option, value))
        assert f"{option[2:]}: got {value}, but the data set there was begun with" in line
    line = refusal(capsys, *synthesize(made, "--sensor", NUSCENES_HDL32E.name))
    assert "sensor: got nuscenes_hdl32e, but the data set there was begun with tiny" in line
    line = refusal(capsys, *synthesize(made, "--rolling-shutter"))
    assert "rolling_shutter: got True, but the data set there was begun with False" in line
    assert contents(made) == before
    own = tmp_path / "own"
    own.mkdir()
    (own / "thesis.txt").write_text("mine")
    assert "not empty, and not begun by this command" in refusal(capsys, *synthesize(own))
    assert contents(own) == {"thesis.txt": b"mine"}
    assert "thesis.txt: found a file, expected a folder" in refusal(capsys, *synthesize(own / "thesis.txt"))
    copy = tmp_path / "copy"
    shutil.copytree(made / ".synthesize", copy / ".synthesize")
    for text, message in (("{", "not JSON"), ("[]", "expected a JSON object")):
        (copy / ".synthesize" / "order.json").write_text(text)
        assert message in refusal(capsys, *synthesize(copy))


def test_a_full_disk_gets_one_line_and_the_rest_is_done_later(made, tmp_path):
    small = tmp_path / "small"
    small.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1500k", "t", str(small)]
    if os.geteuid() or subprocess.run(mount, check=False, stderr=subprocess.DEVNULL).returncode:
        pytest.skip("no right to mount a small tmpfs")
    try:
        command = [sys.executable, "-m", "fcos_lidar_jax", *synthesize(small / "data")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 1
        assert not (small / "data" / VERSION).exists()
        sizes = {file.stat().st_size for file in small.rglob("*.bin")}
        assert sizes == {TINY.num_rows * TINY.num_columns * 5 * 4}
        subprocess.run(["mount", "-o", "remount,size=64m", small], check=True)
        again = subprocess.run(command, capture_output=True, text=True, check=False)
        assert again.returncode == 0, again.stderr
        whole = contents(small / "data")
    finally:
        subprocess.run(["umount", small], check=True)
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("fcos-lidar: error: ")
    assert "No space left on device" in last
    assert "Traceback" not in done.stderr
    assert whole == contents(made)


def test_a_rolling_shutter_gives_other_points_and_exact_counts(tmp_path):
    roots = []
    for name, more in (("still", []), ("rolling", ["--rolling-shutter"])):
        roots.append(tmp_path / name)
        assert cli.main(synthesize(roots[-1], "--scenes", "1", *more)) == 0
    still, rolling = map(contents, roots)
    assert still.keys() == rolling.keys()
    assert all(still[name] != rolling[name] for name in still if name.endswith(".bin"))
    data = NuScenes(roots[1], VERSION)
    sample = data.sample_tokens[-1]
    counts = {row["token"]: row["num_lidar_pts"] for row in tables(roots[1])["sample_annotation"]}
    boxes = data.boxes(sample)
    assert [counts[t] for t in boxes.tokens] == boxes.num_lidar_pts.tolist()
    assert boxes.num_lidar_pts.sum() > 50

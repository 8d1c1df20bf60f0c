"""One line per bad input of a command, which leaves nothing. Readers and checkpoints are asked for their messages
where they are tested."""

import dataclasses
import json
import sys

import numpy as np
import pytest
from commands import assert_one_line_error, command, contents, in_use, mistakes
from made_kitti import calibration_text
from made_nuscenes import VERSION, make_tables, write
from tiny_run import TINY_CONFIG, save_untrained

from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Clouds, poses, a checkpoint, its export and a data set in the nuScenes layout."""
    folder = tmp_path_factory.mktemp("home")
    save_untrained(folder / "checkpoint")
    save_untrained(folder / "cranes", dataclasses.replace(TINY_CONFIG, classes=("crane",)))
    command("export --checkpoint", folder / "checkpoint", "--out", folder / "detector.fcos")
    points = make_frame(0, TINY).points
    drive = folder / "training" / "velodyne"
    drive.mkdir(parents=True)
    for place in (folder / "good.npy", drive / "0.npy", drive / "1.npy"):
        np.save(place, points)
    np.save(folder / "away.npy", points + np.array([500, 500, 0, 0, 0], np.float32))
    np.save(folder / "no_rows.npy", points[:0])
    (folder / "link.json").symlink_to("good.npy")
    (folder / "a.bag").touch()
    (folder / "calibration.txt").write_text(calibration_text())
    (folder / "training" / "calib").mkdir()
    (folder / "training" / "calib" / "0.txt").write_text(calibration_text())
    (folder / "labels").mkdir()
    (folder / "labels" / "0.txt").write_text("Car 0.00 0 0.1 10 20 30 40 1.5 1.6 3.9 1 2 9 0.2\n")
    entry = {"sensor_to_world": np.eye(4).tolist()}
    poses = [{**entry, "file": f"training/velodyne/{i}.npy", "timestamp_us": 50_000 * i} for i in (1, 0)]
    (folder / "poses.json").write_text(json.dumps(poses))
    (folder / "truth").mkdir()
    for place in (folder / "truth.json", folder / "truth" / "results_nusc.json"):
        place.write_text('{"a": {"ego_translation": [0, 0, 0], "boxes": []}}')
    (folder / "results_nusc.json").write_text('{"meta": {}, "results": {"a": []}}')
    write(folder / "data", *make_tables(1))
    return folder


# With "--out OUT" unless the line says otherwise, and for some commands with "--checkpoint HOME/checkpoint".
BAD = mistakes(r"""
detect HOME/good.npy --sweeps HOME/poses.json => --sweeps: got .*, expected none with INPUT: 
detect HOME/good.npy HOME/none.npy => none.npy: no such file
detect HOME/away.npy HOME/no_rows.npy => away.npy: none of its .* points is usable
detect HOME/training => training: no point file in it, expected [^;]*$
detect HOME/good.npy --max-file-points 10 => good.npy: .*points, expected at most 10$
detect HOME/good.npy --checkpoint HOME/none => none: found nothing, expected a check.*weights: hdl32e, 
detect HOME/a.bag => a.bag: cannot be read: 
detect HOME/good.npy HOME/a.bag => a.bag: got a recording beside other inputs, expected only the recording$
detect HOME/a.bag --full-turn => --full-turn: .*a.bag: got a recording, expected point files$
detect HOME/s.json => s.json: expected a point file, or --sweeps before a list of sweeps
detect --sweeps HOME/good.npy => good.npy: expected a file that ends in .json
detect --sweeps HOME/s.json --full-turn => --sweeps: got .*, expected none with --full-turn: 
detect HOME/good.npy --full-turn => --full-turn: expected none for .*good.npy: only files of KITTI are cropped
detect HOME/good.npy --min-score 50 => --min-score: got 50.0, expected within \[0, 1\]$
detect HOME/good.npy --labels submarine => --labels: got 'submarine', expected some of
detect HOME/good.npy --calibration HOME => --calibration: got .*, expected only with --output-format kitti$
detect HOME/good.npy --output-format kitti => good.txt: no such file, expected --calibration
detect LABELLED --output-format kitti --out HOME/labels => 0.txt: found labels or a calibration
detect --sweeps HOME/poses.json --output-format nuscenes --checkpoint HOME/cranes => got the classes crane
detect LABELLED --output-format kitti --checkpoint HOME/cranes => got .crane., expected some classes of KITTI
detect HOME/good.npy --output-format nuscenes => --output-format nuscenes: found no poses
detect HOME/good.npy --out HOME/good.npy => --out: .*the same file as .*good.npy
detect HOME/good.npy --out OUT --page OUT => --page: .*the same file as .*out
detect HOME/training/velodyne --out HOME/training/velodyne/0.npy => --out: .*found a point file
detect HOME/good.npy --out OUT --page HOME/training/velodyne/0.npy => --page: .*found a point file
detect LABELLED --output-format kitti --out HOME/training/calib => 0.txt: found labels or a calibration
stream HOME/training/velodyne --output-format kitti --out HOME/training/calib => 0.txt: found labels or a cal
detect HOME/good.npy gs://b/run => gs://b/run: got a URL, expected a path: copy
detect HOME/none.npy --out HOME/link.json => link.json: found a link to .*good
detect HOME/none.npy --out HOME/good.npy/x => good.npy: found a file, expected a fol
detect HOME/none.npy --out HOME/checkpoint/boxes.json => --out: .*the place of the checkpoint
detect HOME/good.npy --checkpoint HOME/detector.fcos --batch-size 2 => batch size: got 2, expected 1
detect HOME/none.npy --pictures HOME/good.npy => good.npy: found a file, expected a folder
stream HOME/nowhere --out OUT/x => nowhere: no such file or folder
stream HOME/training/velodyne --track => --track: found no poses
stream HOME/training/velodyne --keyframes => --keyframes: expected only with --data-root
stream HOME/training/velodyne --output-format nuscenes => --output-format nuscenes: found no poses
stream HOME/a.bag --odometry tf --poses HOME/poses.json => --poses: got .*, expected none with --odometry: a drive
stream --data-root HOME => --data-root: got .*, expected only with --scene$
stream --data-root HOME --scene a --intensity-scale 9 => --intensity-scale: got 9.0, expected none with
stream --data-root HOME/data --scene scene-0 --output-format nuscenes => expected --keyframes with --data-root
evaluate --checkpoint x --ground-truth HOME/truth.json => --ground-truth: .* expected none with --checkpoint
evaluate --results x --ground-truth HOME/truth.json --version v1 => --ground-truth: .* none with --version
evaluate --results x --ground-truth HOME/truth.json --batch-size 2 => --results: .* none with --batch-size
evaluate --results x --ground-truth HOME/truth/results_nusc.json --out HOME/truth => --out: .*: the same file as
evaluate --results x --ground-truth HOME/truth/curves.json --out HOME/truth => --out: .*: the same file as
evaluate DATA --results x --class-map y => --results: x: expected --checkpoint too, for the classes
evaluate DATA --split all --results x --checkpoint HOME/checkpoint => got --checkpoint too, expected one of
evaluate DATA --checkpoint HOME/checkpoint --sensor tiny => --sensor: got tiny, expected none with --checkpoint
evaluate DATA --checkpoint quickstart --out quickstart => --out: quickstart: the place of the checkpoint, expected
evaluate DATA --checkpoint quickstart --coordinator a:1 => --coordinator: got a:1, expected only with --num-
evaluate DATA --distributed --results x => --results: got x, expected none with --distributed: nothing is detected
evaluate DATA --distributed --checkpoint quickstart --backend openvino => --backend: got openvino, expected none
train quickstart --data-root gs://b/run => gs://b/run: got a URL, expected a path: copy
train quickstart --format simulated => all 100000 frames .* --no-class-balanced --no-copy-paste, or at most
train quickstart DATA --train-split all --val-split none => made: no index here, .* run fcos-lidar prepare$
prepare --format simulated --index OUT => simulated frames need no preparation
project HOME/away.npy => away.npy: none of its
project HOME/good.npy --png HOME/good.npy => --png: .*the same file as
synthesize --scenes 1 --sensor argoverse2 => --sensor: got argoverse2, whose rows come from laser numbers
synthesize --scenes 1 --version samples => --version: got 'samples', expected a name for the folder of the tables
synthesize --scenes 1 --version ../a => --version: got '../a', expected a name for the folder of the tables
export --checkpoint HOME/checkpoint --out HOME => found a folder
export --checkpoint HOME/detector.fcos => found a file, expected a checkpoint folder
export --checkpoint HOME/checkpoint --network-only => --network-only: got True, expected only with --format onnx$
benchmark --checkpoint HOME/checkpoint --batch 0 => --batch: got \(0,\), expected at least 1
benchmark --checkpoint HOME/detector.fcos --batch 2 => batch size: got 2
benchmark --checkpoint HOME/detector.fcos --backend openvino => found a file, expected a checkpoint folder
demo --out HOME/good.npy => good.npy: found a file, expected a folder
""")


@pytest.mark.parametrize(("line", "message"), BAD)
def test_a_bad_input_gets_one_line_and_leaves_nothing(home, tmp_path, monkeypatch, capsys, line, message):
    monkeypatch.chdir(tmp_path)
    line += "" if any(word in line for word in ("OUT", "--out ", "--index ")) else " --out OUT"
    own = line.split()[0] in ("detect", "stream") and "--checkpoint" not in line
    line += " --checkpoint HOME/checkpoint" if own else ""
    line = line.replace("DATA", f"--data-root HOME/data --version {VERSION}")
    line = line.replace("LABELLED", "HOME/good.npy --calibration HOME/calibration.txt")
    before = contents(home)
    args = line.replace("HOME", str(home)).replace("OUT", str(tmp_path / "out")).split()
    assert_one_line_error(capsys, args, message)
    assert [*tmp_path.iterdir()] == []
    assert contents(home) == before


@pytest.mark.parametrize(
    "line",
    [
        f"prepare --data-root HOME/data --version {VERSION} --train-split all --index",
        f"evaluate --data-root HOME/data --version {VERSION} --split all --checkpoint HOME/checkpoint --out",
        "evaluate --results HOME/results_nusc.json --ground-truth HOME/truth.json --out",
    ],
)
def test_a_folder_in_use_is_left_alone(home, tmp_path, capsys, line):
    with in_use(tmp_path):
        words = [*line.replace("HOME", str(home)).split(), str(tmp_path)]
        assert_one_line_error(capsys, words, "in use: process .* is at work")
        assert [path.name for path in tmp_path.iterdir()] == [".lock"]


def test_recordings_need_rerun(home, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    words = ["detect", str(home / "good.npy"), "--out", str(tmp_path / "out")]
    words += ["--checkpoint", str(home / "checkpoint"), "--rrd", str(tmp_path / "a.rrd")]
    assert_one_line_error(capsys, words, "--rrd: rerun is not installed")

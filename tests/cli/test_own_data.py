"""The scripts and commands of docs/own_data.md run as written, with a smaller network."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from commands import assert_one_line_error, command
from linear_network import linear_network
from made_folder import CLASSES, make_folder
from tiny_run import NETWORK_OPTIONS

from fcos_lidar_jax.cli import main
from fcos_lidar_jax.data.folder import FolderFrames

PAGE = (Path(__file__).parents[2] / "docs" / "own_data.md").read_text()


@pytest.mark.slow
def test_the_page_leads_from_an_empty_folder_to_an_evaluated_detector(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    namespace: dict = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(block, namespace)
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("('person', 'rider', 'vehicle') 40 frames; 0 boxes")
    filled, cells, dropped = (int(word) for word in re.findall(r"\d+", printed[1]))
    assert cells / 3 < filled
    assert dropped < filled / 50
    assert printed[2] == "the points are this sensor's"
    options = printed[3].split()
    most = max(len(namespace["frames"].frame(i).points) for i in range(40))
    assert options[:3] == ["--max-points", str(most + most // 8), "--model.channel-mean"]
    mean, scale = np.array(options[3:12], float), np.array(options[13:], float)
    assert len(scale) == 9
    assert (scale > 0).all()
    points = np.concatenate([namespace["frames"].frame(i).points for i in range(40)])
    points = points[(np.abs(points[:, :2]) < namespace["frames"].sensor.limit_xy_m).all(axis=1)]
    # Nearly every point has its own cell.
    np.testing.assert_allclose(mean[:3], points[:, :3].mean(axis=0), atol=0.15)
    np.testing.assert_allclose(scale[:3], points[:, :3].std(axis=0), rtol=0.05)

    commands = [shlex.split(line) for line in re.findall(r"^fcos-lidar .*", PAGE, re.MULTILINE)]
    assert [command[1] for command in commands] == ["prepare", "train", "evaluate", "detect"]
    smaller = {"train": [*NETWORK_OPTIONS, "--steps 2 --save-every 2 --evaluate-every 2"]}
    with linear_network():
        for _, name, *args in commands:
            command(name, *args, *smaller.get(name, []))
    summary = json.loads(Path("evaluation/metrics_summary.json").read_text())
    assert set(summary["mean_dist_aps"]) == {"person", "rider", "vehicle"}
    assert Path("evaluation/report.html").exists()
    assert list(Path("pictures").iterdir())

    # The last step of the page turns detections into labels.
    namespace["as_annotations"](Path("boxes.json"), Path("my_lidar/boxes"))
    [detected] = json.loads(Path("boxes.json").read_text())["files"]
    relabelled = FolderFrames("my_lidar").frame(35)
    np.testing.assert_allclose(
        relabelled.boxes, np.array([box["box"] for box in detected["boxes"]]).reshape(-1, 9)
    )


def test_own_data_define_the_sensor_whatever_the_name_of_the_configuration(tmp_path, capsys):
    args = ["train", "quickstart", "--data-root", str(make_folder(tmp_path / "data", train=2, val=1))]
    args += ["--out", str(tmp_path / "out"), "--classes", *CLASSES, "--steps", "4"]
    args += ["--copy-paste.targets", "2", "2", "2"]
    rejected = r"--sensor: got '\w+', expected none: .*/sensor.json has 'tiny'"
    for name, sensor, message in (
        ([], [], "no objects here"),  # refused after the sensor
        ([], ["--sensor", "kitti_hdl64e"], rejected),
        (["--name", "mine"], [], "no objects here"),
        (["--name", "mine"], ["--sensor", "waymo_top"], rejected),
    ):
        assert_one_line_error(capsys, [*args, *name, *sensor], message)
    (tmp_path / "data" / "splits.json").unlink()
    message = "--evaluate-every: got 4, expected frames to evaluate on"
    assert_one_line_error(capsys, [*args, "--evaluate-every", "4"], message)
    assert not (tmp_path / "out").exists()


def test_objects_of_changed_frames_without_splits_are_refused(tmp_path, capsys):
    data = make_folder(tmp_path / "data", train=1, val=0)
    (data / "splits.json").unlink()
    command("prepare --data-root", data)
    np.save(data / "clouds" / "000.npy", np.load(data / "clouds" / "000.npy")[1:])
    train = (
        f"train quickstart --data-root {data} --out {tmp_path}/out --steps 1 --copy-paste.targets 2 2 2 --classes"
    )
    message = "all_frames: cut from other frames than all frames, or with other options, .* or --full-turn"
    assert_one_line_error(capsys, [*train.split(), *CLASSES], message)


def test_an_index_is_refused_where_it_would_be_ignored_or_spoil_the_data(tmp_path, capsys):
    more = (
        f"--data-root {make_folder(tmp_path / 'data', train=1, val=1)} --out {tmp_path}/out --index {tmp_path}/i"
    )
    train = f"train quickstart {more} --steps 1 --no-copy-paste --classes".split()
    assert_one_line_error(capsys, [*train, *CLASSES], "--index: got .*, expected none: no prepared objects")
    evaluate = f"evaluate {more} --checkpoint quickstart".split()
    assert_one_line_error(capsys, evaluate, "--index: got .*, expected none: only the tables of nuScenes have an")
    spoilt = f"prepare --data-root {tmp_path}/data --index {tmp_path}/data/clouds".split()
    assert_one_line_error(capsys, spoilt, "--index: .*clouds: a folder of own data, expected another one")
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_classes_that_the_data_do_not_have_are_named_in_a_warning(tmp_path, capsys):
    data = make_folder(tmp_path / "data", train=1, val=0)
    for name, warned in (("vehicel", True), ("vehicle", False)):
        train = f"train quickstart --data-root {data} --out {tmp_path}/out --classes person {name} post"
        assert main(f"{train} --copy-paste.targets 2 2 2 --steps 1".split()) == 1  # without prepare
        line = f"warning: --classes: the data have no example of {name}, only of person, post, vehicle\n"
        assert (line in capsys.readouterr().err) == warned

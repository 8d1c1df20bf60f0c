"""The official devkit has the same splits, and reads synthetic data sets: tables, fused sweeps, evaluation."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from made_evaluation import devkit_summary

from fcos_lidar_jax.cli.synthesize import Synthesize, run
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.names import CATEGORY_TO_CLASS
from fcos_lidar_jax.data.nuscenes.splits import official_splits
from fcos_lidar_jax.evaluation.results import LIDAR_META

pytestmark = pytest.mark.slow

pytest.importorskip("nuscenes")

VERSION = "v1.0-synthetic"


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("devkit") / "data"
    run(Synthesize(out, scenes=2, seed=2, keyframes=3, streets="plain"))
    return out


@pytest.fixture(scope="module")
def official(root):
    from nuscenes import NuScenes as Official

    return Official(VERSION, str(root), verbose=False)


def test_official_splits_equal_the_devkits():
    from nuscenes.utils import splits as theirs

    splits = official_splits()
    assert list(splits) == ["train", "val", "test", "mini_train", "mini_val"]
    assert splits == {name: getattr(theirs, name) for name in splits}


def test_the_devkit_loads_every_table(official):
    tables = official.scene, official.log, official.sample, official.sample_data
    assert [len(table) for table in tables] == [2, 2, 6, 42]
    for annotation in official.sample_annotation:
        assert annotation["category_name"] in CATEGORY_TO_CLASS
        box = official.get_box(annotation["token"])
        assert (box.wlh > 0).all()
        if annotation["prev"] or annotation["next"]:
            assert np.isfinite(official.box_velocity(annotation["token"])[:2]).all()
    official.list_scenes()
    official.get_sample_data_path(official.sample[0]["data"]["LIDAR_TOP"])


def test_fused_sweeps_equal_the_devkits(root, official):
    """``from_file_multisweep`` removes close points of every sweep, and keeps the ring instead of the lag."""
    from nuscenes.utils.data_classes import LidarPointCloud

    data = NuScenes(root, VERSION)
    for number, sample in itertools.product((1, 2, 10), (data.split("train")[-1], data.split("val")[1])):
        arguments = official, official.get("sample", sample), "LIDAR_TOP", "LIDAR_TOP", number
        cloud, times = LidarPointCloud.from_file_multisweep(*arguments, min_distance=1.0)
        ours = data.sweeps(sample, number)
        assert len(np.unique(ours[:, 4])) == number
        np.testing.assert_allclose(ours[:, :3], cloud.points[:3].T, atol=1e-4)
        np.testing.assert_array_equal(ours[:, 3], cloud.points[3])
        np.testing.assert_allclose(ours[:, 4], times[0], atol=1e-5)


def test_boxes_equal_the_devkits(root, official):
    data = NuScenes(root, VERSION)
    for sample in data.sample_tokens:
        boxes = data.boxes(sample)
        _, theirs, _ = official.get_sample_data(official.get("sample", sample)["data"]["LIDAR_TOP"])
        by_token = {box.token: box for box in theirs}
        assert set(by_token) == set(boxes.tokens)
        for own, token in zip(boxes.boxes, boxes.tokens, strict=True):
            np.testing.assert_allclose(own[:3], by_token[token].center, atol=1e-4)
            np.testing.assert_allclose(own[[4, 3, 5]], by_token[token].wlh, atol=1e-6)
            heading = by_token[token].orientation.rotation_matrix[:, 0]
            assert abs(np.angle(np.exp(1j * (np.arctan2(heading[1], heading[0]) - own[6])))) < 1e-6
            row = int(np.flatnonzero(data.index.box_token == token.encode())[0])
            np.testing.assert_allclose(data.index.box_velocity[row], official.box_velocity(token), atol=1e-5)


def test_the_devkit_evaluates_on_the_splits_of_its_own_file(root, official, tmp_path):
    """Truth with an offset of 0.1 m, as detections, has the expected scores."""
    data, results = NuScenes(root, VERSION), {}
    for sample in data.split("val"):
        results[sample] = []
        for token in data.boxes(sample).tokens:
            row = official.get("sample_annotation", token)
            if row["num_lidar_pts"] == 0:  # not evaluated by the devkit
                continue
            x, y, z = row["translation"]
            box = {"sample_token": sample, "translation": [x + 0.1, y, z], "detection_score": 0.5}
            box |= {"size": row["size"], "rotation": row["rotation"]}
            box["velocity"] = np.nan_to_num(official.box_velocity(token)[:2]).tolist()
            box["detection_name"] = CATEGORY_TO_CLASS[row["category_name"]]
            box["attribute_name"] = "".join(official.get("attribute", t)["name"] for t in row["attribute_tokens"])
            results[sample].append(box)
    file = tmp_path / "results.json"
    file.write_text(json.dumps({"meta": LIDAR_META, "results": results}))
    summary = devkit_summary(official, file, "synthetic_val", tmp_path)
    present = [ap for ap in summary["mean_dist_aps"].values() if ap > 0]
    assert len(present) >= 8
    assert present == pytest.approx([1] * len(present), abs=0.05)
    car = summary["label_tp_errors"]["car"]
    assert car["trans_err"] == pytest.approx(0.1, abs=1e-3)
    assert (car["scale_err"], car["attr_err"]) == (pytest.approx(0, abs=1e-6), 0)

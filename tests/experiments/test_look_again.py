"""A second look trained on the boxes of a frozen detector."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from linear_network import linear_network
from test_experiments import tiny_smoke
from tiny_run import FRAMES, LOOK, REFINED, SENSOR, bits, weights

from experiments.changes import change
from experiments.second_look import look_again
from fcos_lidar_jax.checkpoints import load_checkpoint
from fcos_lidar_jax.config import AugmentConfig
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.models import build_detector


@pytest.mark.slow
def test_the_search_for_boxes_resumes_and_the_detector_stays(tmp_path):
    config = dataclasses.replace(REFINED, augment=AugmentConfig())
    with linear_network():
        first = TrainedDetector(build_detector(config, SENSOR), weights(config))
        args = {"samples": 4, "updates": 3, "folder": tmp_path}
        before = look_again(first, config, FRAMES, seed=1, **args).variables["params"]
        done = tmp_path / "done.json"
        done.write_text(json.dumps(json.loads(done.read_text()) | {"done": 2}))
        for file in tmp_path.glob("*.npy"):
            np.lib.format.open_memmap(file, "r+")[2:] = 0
        after = look_again(first, config, FRAMES, seed=1, **args).variables["params"]
        assert bits(after) == bits(before)
        assert bits({**after, "refinement": ()}) == bits({**first.variables["params"], "refinement": ()})
        drawn = weights(config)["params"]["refinement"]
        assert jax.tree.all(jax.tree.map(lambda old, new: bool((old != new).any()), drawn, after["refinement"]))
        with pytest.raises(ValueError, match=r"found the boxes of another training, expected another folder"):
            look_again(first, config, FRAMES, seed=2, **args)


@pytest.mark.slow
def test_a_cell_trains_its_second_look_afterwards(tmp_path):
    scale = tiny_smoke(tmp_path / "frames")
    frozen = dataclasses.replace(LOOK, freeze_detector=True)
    with linear_network():
        scores = scale.score(change(refinement=frozen)(scale.base), 0, tmp_path)
        assert load_checkpoint(tmp_path).config == scale.base
    assert 0 <= scores["mAP"] <= 1
    assert json.loads((tmp_path / "boxes" / "done.json").read_text())["done"] == scale.train_frames

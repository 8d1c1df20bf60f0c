"""A detector of one's own trains, evaluates, detects and is exported without a change of any other file."""

import dataclasses
import json
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import command
from tiny_run import CONFIG, SENSOR

import fcos_lidar_jax as fcos
from fcos_lidar_jax.config import Config, config_from_json, config_to_json
from fcos_lidar_jax.data.frame import Frame, InMemoryFrames
from fcos_lidar_jax.inference import evaluate
from fcos_lidar_jax.models import Detector
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training import train
from fcos_lidar_jax.types import Sums

BOX = np.array([6, -3, 0.5, 4, 2, 1.5, 0.3, 0, 0], np.float32)


class Seen(NamedTuple):
    """What the toy sees of a cloud: the mean of its points."""

    mean: jax.Array
    num_dropped: jax.Array


@dataclasses.dataclass(frozen=True)
class ToyConfig(Config):
    """A detector of one box per class, at a learned offset from the mean of the points within reach."""

    reach_m: float = 30.0

    def build(self, sensor):
        def prepare(points, valid):
            near = valid & (jnp.abs(points[:, :2]) < self.reach_m).all(axis=1)
            mean = jnp.where(near[:, None], points[:, :3], 0).sum(axis=0) / near.sum()
            return Seen(mean, (valid & ~near).sum())

        def init(key):
            return {"params": {"boxes": jnp.ones((len(self.classes), 9))}, "batch_stats": {}}

        def apply(variables, seen, *, train=False):
            boxes = jnp.pad(seen.mean, ((0, 0), (0, 6)))[:, None] + variables["params"]["boxes"]
            return boxes, variables["batch_stats"]

        def sums(variables, boxes, seen, batch):
            predicted = jnp.take_along_axis(boxes, batch.labels[..., None], axis=1)
            off = jnp.where(batch.box_valid[..., None], jnp.abs(predicted - batch.boxes), 0)
            return Sums({"boxes": {"distance": off.sum()}}, {"boxes": batch.box_valid.sum()})

        def candidates(boxes, seen):
            number = len(self.classes)
            return boxes, 1 / (1 + jnp.arange(number)), jnp.arange(number), jnp.ones(number, bool)

        return Detector(prepare, init, apply, sums, candidates, self, sensor)


OPTIMIZER = dataclasses.replace(CONFIG.optimizer, peak_learning_rate=0.5, batch_size=4, accumulate=2)
TOY = ToyConfig.of(CONFIG, name="toy", classes=("car", "truck"), augment=None, optimizer=OPTIMIZER)


@pytest.fixture(scope="module")
def frames():
    points = make_frame(0, SENSOR).points
    frame = Frame(points, BOX[None], np.zeros(1, np.int32), np.full(1, 9))
    return InMemoryFrames((frame,) * 4, SENSOR, TOY.classes)


@pytest.fixture(scope="module")
def run(frames, tmp_path_factory):
    folder = tmp_path_factory.mktemp("toy") / "run"
    train(TOY, frames, folder, steps=60, tests=frames, threads=0)
    return folder


def test_it_trains_and_its_checkpoint_gives_it_back(run, frames):
    detector = fcos.load_detector(run)
    assert detector.config == TOY
    found = detector(frames.frame(0).points)
    assert found.labels.tolist() == [0, 1]
    np.testing.assert_allclose(found.boxes[0], BOX, atol=0.3)
    metrics = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert metrics[0]["loss/total"] == metrics[0]["loss/distance"] > 5
    assert [line["boxes"] for line in metrics if "boxes" in line] == [4] * 60
    with pytest.raises(ValueError, match=r"^toy\.json: colour: unknown field"):
        config_from_json({**config_to_json(TOY), "colour": "red"}, "toy.json")


def test_it_is_evaluated(run, frames):
    assert evaluate(fcos.load_detector(run), frames).summary["mean_dist_aps"]["car"] == pytest.approx(1.0)


@pytest.mark.slow
def test_the_commands_detect_export_and_time_it(run, frames, tmp_path):
    np.save(tmp_path / "cloud.npy", frames.frame(0).points)
    command("export --checkpoint", run, "--batch any --out", tmp_path / "toy.fcos")
    for checkpoint, name in ((run, "a.json"), (tmp_path / "toy.fcos", "b.json")):
        command("detect", tmp_path / "cloud.npy", "--checkpoint", checkpoint, "--out", tmp_path / name)
    given, again = (
        json.loads((tmp_path / name).read_text())["files"][0]["boxes"] for name in ("a.json", "b.json")
    )
    assert [box["label"] for box in given] == [box["label"] for box in again] == ["car", "truck"]
    np.testing.assert_allclose(*([box["box"] for box in boxes] for boxes in (given, again)), atol=1e-4)
    command("benchmark --repeats 1 --checkpoint", run, "--out", tmp_path / "times.json")

"""Figures of shipped weights: by distance, as float16, and in their model card."""

import dataclasses
import json
import math
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from linear_network import linear_network
from tiny_run import TINY_CONFIG, untrained

from experiments.changes import change
from experiments.real_frames import SPANS_M, scores_by_range, within
from experiments.studies import model_card, shipped_weights, transfer
from experiments.studies.shipped_weights import MixedFrames, with_adjusted_logits
from fcos_lidar_jax.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from fcos_lidar_jax.checkpoints.storage import read_description
from fcos_lidar_jax.config import AugmentConfig
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.types import Detections

CONFIG = dataclasses.replace(TINY_CONFIG, sensor="tiny")
SCORES = ("name", "hash", "unseen_frames", "mAP", "interval", "AP")


def random_frames(seed: int, number: int = 6):
    """Frames with detections a little off their boxes, some at whole distances, some without a point."""
    rng = np.random.default_rng(seed)
    frames, found = [], []
    for _ in range(number):
        boxes = np.pad(rng.uniform(1, 4, (30, 6)), ((0, 0), (0, 3))).astype(np.float32)
        distance, angle = rng.uniform(0, 45, 30), rng.uniform(-math.pi, math.pi, 30)
        boxes[:, :2] = np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=1)
        boxes[:3, :2] = [[20, 0], [0, -40], [12, 16]]
        labels, counts = rng.integers(0, 10, 30), rng.integers(0, 3, 30)
        frames.append(Frame(np.zeros((0, 5), np.float32), boxes, labels, counts))
        moved = boxes + np.pad(rng.normal(0, 0.7, (30, 2)), ((0, 0), (0, 7))).astype(np.float32)
        scores = rng.uniform(0.05, 1, 30).astype(np.float32)
        found.append(Detections(moved, scores, labels, rng.random(30) < 0.8, np.zeros((), np.int32)))
    return found, frames


@pytest.mark.parametrize(("near", "far"), SPANS_M)
def test_a_span_holds_the_boxes_of_its_distances(near, far):
    found, frames = random_frames(0)
    chosen, rest = within(found, frames, near, far)

    def inside(boxes):
        return np.array([near <= math.hypot(x, y) < far for x, y in boxes[:, :2].tolist()])

    for before, after, d, e in zip(frames, rest, found, chosen, strict=True):
        for name in ("boxes", "labels", "num_points"):
            np.testing.assert_array_equal(getattr(after, name), getattr(before, name)[inside(before.boxes)])
        np.testing.assert_array_equal(e.valid, d.valid & inside(d.boxes))


def test_every_third_training_street_has_matt_cars_like_the_tests():
    shown, unseen = shipped_weights.streets(shipped_weights.CONFIGS["hdl32e"], steps=6, seed=2)
    assert (len(shown), shown.name(0), shown.period) == (6, "seed 12", 3)
    assert [frames.streets.gloss for frames in (shown.frames, shown.other, unseen)] == [1, 0, 0]


def test_frames_of_two_sets_are_mixed():
    first, other = SimulatedFrames(TINY, 4), SimulatedFrames(TINY, 4, num_objects=3)
    mixed = MixedFrames(first, other, 3)
    for index in range(4):
        expected = (first if index % 3 else other).frame(index)
        assert (mixed.frame(index).points == expected.points).all()
        assert (mixed.truth(index).boxes == expected.boxes).all()
        assert mixed.labels(index).tolist() == expected.labels.tolist()
    assert (len(mixed), mixed.name(3)) == (4, first.name(3))


def test_logits_are_adjusted_for_the_class_frequencies_of_nuscenes():
    """Closed form: the training's frequencies are nuScenes' to the power of 0.25, up to a constant factor."""
    weights = {"heads": {"logits_bias": np.zeros(11), "iou_bias": np.zeros(1)}}
    after = with_adjusted_logits(Checkpoint(CONFIG, TINY, weights, 1), 0.4).variables["heads"]
    assert after["iou_bias"] == 0
    *classes, background = after["logits_bias"]
    nuscenes = np.array([0.36, 0.08, 0.02, 0.04, 0.015, 0.17, 0.015, 0.02, 0.09, 0.19])
    slopes = np.array(classes) - 0.4 * 0.75 * np.log(nuscenes)
    np.testing.assert_allclose(slopes, slopes.mean(), atol=1e-6)
    assert background == 0
    shares = nuscenes**0.25 / np.sum(nuscenes**0.25)
    assert np.sum(shares * np.exp(np.array(classes) / 0.4)) == pytest.approx(1)  # objects stay as frequent


@pytest.mark.slow
def test_weights_are_exported_scored_and_described(tmp_path, monkeypatch):
    """A run of three steps, in a package and with results elsewhere."""
    run, package, results = (tmp_path / name for name in ("run", "weights", "results"))
    package.mkdir()
    for module in (shipped_weights, model_card):
        monkeypatch.setattr(module, "SHIPPED", package)
    monkeypatch.setattr(shipped_weights, "RESULTS", results)
    monkeypatch.setattr(shipped_weights, "_CURVE_FRAMES", 1)
    args = shipped_weights.Args(name="hdl32e", test_frames=2, out=tmp_path / "scores.json")
    with linear_network():
        ours = untrained(CONFIG, TINY)
        (run / "checkpoints").mkdir(parents=True)
        save_checkpoint(run / "checkpoints" / "00000003", Checkpoint(CONFIG, TINY, ours, 3))
        (run / "run.json").write_text(json.dumps({"seed": 4, "weights": None, "steps": 9}))
        lines = ({"step": s, "loss/total": 1.0, "seconds": 2.0} for s in (1, 2, 3))
        (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        exporting = dataclasses.replace(args, work=run, export=True, out=None)
        shipped_weights.main(exporting)
        shipped_weights.main(args)
        exported = load_checkpoint(package / "hdl32e").variables
        own = read_description(package / "hdl32e")["hash"]
        record, scored = (json.loads(file.read_text()) for file in (results / "hdl32e.json", args.out))
        assert {name: scored[name] for name in SCORES} == {name: record[name] for name in SCORES}
        training = record["training"]
        assert (training["steps"], training["steps_planned"], training["frames_seen"]) == (3, 9, 6)
        assert (training["seconds_of_steps"], training["logit_adjustment"]) == (6, 0.5)
        assert record["hash"] == own
        for old, new in zip(*map(jax.tree.leaves, (ours, exported)), strict=True):
            np.testing.assert_allclose(new, old, rtol=1e-3, atol=1e-3)
            np.testing.assert_array_equal(new, new.astype(np.float16).astype(np.float32))
        # The card has only the figures of its weights.
        card = (package / "hdl32e" / "README.md").read_text()
        assert "Not measured yet" in card
        assert f"mAP {record['mAP']:.3f}" in card
        part = {"keyframes": 6, **scores_by_range(*random_frames(2), repeats=20)}
        ap, boxes = part["all"]["AP"]["car"], part["all"]["truths"]["car"]
        for weights in (own, "other"):
            measured = {"checkpoint": {"hash": weights}, "scene-0523, odd": part}
            (results / "transfer.json").write_text(json.dumps(measured))
            text = model_card.write_card("hdl32e", results).read_text()
            assert (f"| car | {ap:.3f} ({boxes}) |" in text) is (weights == own)
    # Scores alone are no training to go on from, nor to write a card of.
    args.out.rename(results / "hdl32e.json")
    warm = dataclasses.replace(args, work=tmp_path / "new", warm_start=Path("hdl32e"))
    for again in (lambda: shipped_weights.main(warm), lambda: model_card.write_card("hdl32e", results)):
        with pytest.raises(ValueError, match=r"hdl32e\.json: training: missing"):
            again()
    assert not warm.work.exists()


@pytest.mark.slow
def test_fine_tuning_trains_the_network_and_keeps_the_augmentation_of_its_checkpoint(tmp_path, monkeypatch):
    """Other weights of the same name are another run."""
    runs = []
    monkeypatch.setattr(transfer, "real_data", lambda *_: tmp_path)
    monkeypatch.setattr(transfer, "open_frames", lambda *_, **__: SimulatedFrames(TINY, 40))
    monkeypatch.setattr(
        transfer, "trained", lambda folder, config, *_, **options: runs.append((folder, config, options))
    )
    monkeypatch.setattr(transfer, "applied", lambda args, _: args.mirrored)
    monkeypatch.setattr(transfer, "measured", lambda changed, _: {"mirrored": changed})
    weights = tmp_path / "weights"
    given = change(augment=AugmentConfig(flip_y_probability=0.0))(CONFIG)
    for value in (0.0, 1.0):
        variables = jax.tree.map(lambda leaf, v=value: leaf + np.float32(v), untrained(CONFIG, TINY))
        shutil.rmtree(weights, ignore_errors=True)
        save_checkpoint(weights, Checkpoint(given, TINY, variables, 3))
        args = transfer.Args(data=tmp_path, checkpoint=weights, work=tmp_path, mirrored=bool(value))
        records = list(transfer.fine_tuning(args))
        assert len(records) == 2
        assert records[1]["from scratch"] == {"mirrored": bool(value)}  # options of detection apply here, too
    assert len({folder for folder, _, _ in runs}) == 4
    assert all(config.model == given.model for _, config, _ in runs)
    assert all(config.augment == given.augment for _, config, _ in runs)
    assert [options["weights"] for _, _, options in runs] == [weights, None] * 2
    rates = [config.optimizer.peak_learning_rate for _, config, _ in runs]
    assert rates[0] == rates[1] / 3

"""The second look as a stage of a detector, and trained in its step."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_peer
import tiny_run
from linear_network import linear_network
from tiny_run import SENSOR, bits, host_batch, untrained

from fcos_lidar_jax.checkpoints import Checkpoint, save_checkpoint
from fcos_lidar_jax.config import RefinementConfig
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.refinement.network import REACH_M
from fcos_lidar_jax.refinement.stage import look_inputs, refinement_sums, trainable
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step, plan
from fcos_lidar_jax.training.step import make_gradient

pytestmark = pytest.mark.slow

SMALL = dataclasses.replace(tiny_run.LOOK, first_score_weight=0.25)
ALONE = dataclasses.replace(SMALL, num_neighbours=0)
FROZEN = dataclasses.replace(SMALL, freeze_detector=True)


@pytest.fixture(scope="module", autouse=True)
def _quick_network():
    """FCOS-LiDAR has the linear network, because the question is what surrounds the network."""
    with linear_network():
        yield


@functools.cache
def detector(refinement: RefinementConfig | None):
    """A detector, and random weights of it."""
    config = dataclasses.replace(tiny_run.CONFIG, refinement=refinement)
    return build_detector(config, SENSOR), jax.tree.map(jnp.asarray, untrained(config, SENSOR))


@functools.cache
def detect(refinement: RefinementConfig | None):
    return jax.jit(make_detect(detector(refinement)[0]))


@functools.cache
def gradient(refinement: RefinementConfig | None):
    return jax.jit(make_gradient(detector(refinement)[0]))


def found(refinement: RefinementConfig | None, variables=None):
    batch, variables = host_batch(), variables or detector(refinement)[1]
    return jax.device_get(detect(refinement)(variables, batch.points[0], batch.valid[0]))


def test_boxes_are_the_detectors_best_with_the_weighted_geometric_mean_of_both_scores():
    """With zero weights all classes are equally probable and no box moves."""
    _, variables = detector(SMALL)
    zero = jax.tree.map(jnp.zeros_like, variables["params"]["refinement"])
    after = found(SMALL, variables | {"params": variables["params"] | {"refinement": zero}})
    before = found(None)
    number = int(before.valid.sum())
    assert number > 8
    assert after.valid.sum() == 8
    weight = SMALL.first_score_weight
    expected = np.exp(weight * np.log(before.scores[:8]) + (1 - weight) * np.log(1 / 11))
    np.testing.assert_allclose(after.scores[:8], expected, rtol=1e-5)
    np.testing.assert_allclose(after.boxes[:8], before.boxes[:8], rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(after.labels[:8], before.labels[:8])
    assert not after.boxes[8:].any()
    assert after.boxes.shape == before.boxes.shape


def test_the_detectors_own_losses_and_gradients_stay():
    _, variables = detector(None)
    _, both = detector(SMALL)
    batch, own = host_batch(), variables["params"]
    alone, _, metrics = gradient(None)(own, variables["batch_stats"], batch)
    params = own | {"refinement": both["params"]["refinement"]}
    joint, _, with_look = gradient(SMALL)(params, variables["batch_stats"], batch)
    for name, of_part in alone.items():
        for a, b in zip(*map(jax.tree.leaves, (of_part, joint[name])), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4 * max(1.0, float(jnp.abs(a).max())))
    assert float(with_look["loss/refined_class"]) > 0
    assert max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(joint["refinement"])) > 0
    for key in metrics.keys() - {"loss/total"}:
        np.testing.assert_allclose(with_look[key], metrics[key], rtol=1e-5)


def test_a_frozen_detector_is_not_changed():
    model, variables = detector(FROZEN)
    optimizer = make_optimizer(model.config.optimizer, 10)
    state = make_state(model, optimizer, jax.random.key(0), variables=variables)
    after, metrics = jax.jit(make_train_step(model, optimizer))(state, host_batch())
    assert bits(after.batch_stats) == bits(state.batch_stats)
    for trained in (after.params, after.ema):
        assert bits({k: v for k, v in trained.items() if k != "refinement"}) == bits(
            {k: v for k, v in variables["params"].items() if k != "refinement"}
        )
    assert bits(after.params["refinement"]) != bits(variables["params"]["refinement"])
    assert sorted(m for m in metrics if m.startswith("loss/")) == [
        "loss/refined_box",
        "loss/refined_class",
        "loss/total",
    ]
    # The optimizer's state has nothing of the detector either.
    size = sum(leaf.size for leaf in jax.tree.leaves(trainable(variables["params"], model.config)))
    assert sum(leaf.size for leaf in jax.tree.leaves(after.opt_state)) < 2 * size + 20


def test_losses_equal_sums_over_the_samples():
    """Two samples are processed in a loop, one sample without it."""
    model, variables = detector(SMALL)  # of whose network nothing is asked
    batch = host_batch()
    boxes = jnp.concatenate([batch.boxes[0, :4], batch.boxes[1, :3] + 0.3]), jnp.linspace(0.9, 0.1, 7)
    labels = jnp.concatenate([batch.labels[0, :4], batch.labels[1, :3]])
    model = model._replace(candidates=lambda outputs, image: (*boxes, labels, jnp.ones(7, bool)))

    @jax.jit
    def sums(batch):
        nothing = jnp.zeros((len(batch.points), 1))
        return refinement_sums(model, variables, nothing, nothing, batch)

    whole = sums(batch)
    parts = [sums(jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], batch)) for i in range(2)]
    total = jax.tree.map(jnp.add, *parts)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4), whole, total)
    assert 8 <= int(whole.counts["refined_boxes"]) <= 14
    assert int(whole.counts["refined_objects"]) > 4


def test_a_cloud_without_points_has_finite_gradients_and_no_boxes():
    variables = detector(SMALL)[1]
    batch = dataclasses.replace(host_batch(), valid=np.zeros((2, 1024), bool))
    gradients, _, metrics = gradient(SMALL)(variables["params"], variables["batch_stats"], batch)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    assert float(metrics["refined_boxes"]) == 0
    empty = detect(SMALL)(variables, batch.points[0], batch.valid[0])
    assert not empty.valid.any()


def test_points_of_boxes_decide_the_scores():
    """The same boxes with other points: the network sees the cloud, not only the boxes."""
    model, variables = detector(SMALL)
    batch = host_batch()
    boxes = batch.boxes[0], np.linspace(0.9, 0.1, len(batch.boxes[0])), batch.labels[0], batch.box_valid[0]
    refine = jax.jit(model.refine)
    _, scores, *_ = refine(variables, batch.points[0], batch.valid[0], *boxes)
    _, others, *_ = refine(variables, batch.points[1], batch.valid[1], *boxes)
    order = np.random.default_rng(0).permutation(1024)
    _, same, *_ = refine(variables, batch.points[0][order], batch.valid[0][order], *boxes)
    np.testing.assert_array_equal(scores, same)
    assert float(jnp.abs(scores - others).max()) > 0.1 * float(scores.max())


def test_several_sweeps_correct_velocities():
    """With zero weights but one bias, each box is faster by 3 m/s along its heading."""
    config = dataclasses.replace(tiny_run.CONFIG, refinement=SMALL, num_sweeps=2)
    model, batch = build_detector(config, SENSOR), host_batch()
    variables = model.init(jax.random.key(0))
    look = jax.tree.map(jnp.zeros_like, variables["params"]["refinement"])
    look["out"]["bias"] = look["out"]["bias"].at[-4].set(3.0)
    boxes = batch.boxes[0], np.linspace(0.9, 0.1, len(batch.boxes[0])), batch.labels[0], batch.box_valid[0]
    fast = {"params": variables["params"] | {"refinement": look}}
    after = jax.jit(model.refine)(fast, batch.points[0], batch.valid[0], *boxes)
    number = int(after[3].sum())
    assert number > 2
    places = np.linalg.norm(after[0][:number, None, :3] - batch.boxes[0][:, :3], axis=2)
    before = batch.boxes[0][places.argmin(axis=1)]
    faster = before[:, 7:] + 3 * np.stack([np.cos(before[:, 6]), np.sin(before[:, 6])], axis=1)
    np.testing.assert_allclose(after[0][:number, 7:], faster, atol=1e-4)


def test_only_boxes_nearby_decide_a_score():
    model, variables = detector(SMALL)
    batch, refine = host_batch(), jax.jit(model.refine)
    nothing, labels = (batch.points[0], np.zeros(1024, bool)), np.array([0, 1])
    place, scores = np.tile(batch.boxes[0][:1], (2, 1)), {}
    for distance, valid in ((2.0, True), (3.0, True), (2 * REACH_M, True), (2.0, False)):
        place[1, 0] = place[0, 0] + distance
        found = refine(variables, *nothing, place, np.array([0.9, 0.5]), labels, np.array([True, valid]))
        scores[distance, valid] = float(found[1][found[3] & (found[2] == 0)][0])
    assert scores[2 * REACH_M, True] == scores[2.0, False]
    assert len({*scores.values()}) == 3


def test_a_sensor_off_the_origin_sees_the_same():
    batch, shift = host_batch(), np.array([3.0, -2.0, 0.5])
    found = []
    for origin in (np.zeros(3), shift):
        points, boxes = batch.points[0].copy(), batch.boxes[0][:2].copy()
        points[:, :3] += origin
        boxes[:, :3] += origin
        sensor = dataclasses.replace(SENSOR, origin_m=tuple(origin))
        seen = boxes, np.array([0.9, 0.5], np.float32), np.array([0, 1]), np.ones(2, bool)
        given = jax.tree.map(jnp.asarray, (points, batch.valid[0], seen))
        found.append(look_inputs(detector(SMALL)[0].config, sensor, *given).boxes)
    np.testing.assert_allclose(*found, atol=1e-5)


def test_centerpoint_takes_a_second_look_too():
    config = dataclasses.replace(tiny_peer.CONFIG, refinement=SMALL)
    model, batch = build_detector(config, SENSOR), host_batch()
    variables = jax.eval_shape(model.init, jax.random.key(0))
    assert jax.eval_shape(make_detect(model), variables, batch.points[0], batch.valid[0]).boxes.shape == (20, 9)
    _, _, metrics = jax.eval_shape(make_gradient(model), variables["params"], variables["batch_stats"], batch)
    assert {"loss/classification", "loss/refined_class", "loss/refined_box"} <= metrics.keys()


def test_training_starts_from_weights_with_or_without_a_second_look(tmp_path, capsys):
    def of_detector(variables):
        return bits({name: part for name, part in variables["params"].items() if name != "refinement"})

    anew = "arrays start with random weights"
    for given, own, told in (
        (None, SMALL, f"21 of 21 {anew}, 0 are left out"),
        (SMALL, None, "the second look is left out"),
        (ALONE, SMALL, f"9 of 21 {anew}, 0 are left out"),
        (SMALL, ALONE, f"0 of 12 {anew}, 9 are left out"),
    ):
        model, variables = detector(given)
        save_checkpoint(tmp_path / "weights", Checkpoint(model.config, SENSOR, variables, 1))
        initial = plan._initial_weights(detector(own)[0], tmp_path / "weights")
        assert told in capsys.readouterr().err
        assert of_detector(initial) == of_detector(variables)
        assert ("refinement" in initial["params"]) == (own is not None)

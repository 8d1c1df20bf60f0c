"""The training step: finite, compiled once, exact schedules; a short run learns a simulated frame."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fcos_lidar_jax.config import QUICKSTART, OptimizerConfig
from fcos_lidar_jax.data.batching import make_batch
from fcos_lidar_jax.data.pipeline import HostBatch
from fcos_lidar_jax.data.synthetic.frame_set import SimulatedFrames
from fcos_lidar_jax.evaluation.matching import match_frame
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.locations import image_layout, location_cells, look
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.training import NonFiniteLossError, fit, make_loss, make_optimizer, make_state, make_train_step
from fcos_lidar_jax.training.objective import location_owners
from fcos_lidar_jax.training.optimizer import learning_rate_schedule, momentum_schedule
from fcos_lidar_jax.types import Batch

STEPS = 60
CONFIG = dataclasses.replace(
    QUICKSTART,
    augment=None,
    optimizer=dataclasses.replace(QUICKSTART.optimizer, batch_size=1),
    loss=dataclasses.replace(QUICKSTART.loss, l1_weight=1.0),
)
SIZES = {"max_points": CONFIG.max_points, "max_boxes": CONFIG.max_boxes}


FRAMES = SimulatedFrames(TINY, 1000)


def fed(batch, count=STEPS):
    """The same batch again and again, as the loop takes it."""
    return [HostBatch(batch, i, {"overflow_points": 0}, ("a", "b")) for i in range(count)]


def frame(seed: int):
    return FRAMES.frame(seed)


@pytest.fixture(scope="module")
def trainer():
    """Detector, state and a jitted step that counts its traces."""
    detector = build_detector(CONFIG, TINY)
    optimizer = make_optimizer(CONFIG.optimizer, STEPS)
    key = jax.random.key(0)
    state = make_state(detector.init(key), optimizer, key)
    traces = []
    pure = make_train_step(detector, CONFIG, TINY, optimizer)

    def counted(state, batch):
        traces.append(1)
        return pure(state, batch)

    return detector, state, jax.jit(counted), traces


def test_learns_one_simulated_frame_and_compiles_once(trainer):
    """The short form of experiments/overfit_keyframe.py: a minute of training finds the large objects."""
    detector, state, step, traces = trainer
    scene = next(f for f in map(frame, range(100)) if (f.num_points >= 30).sum() >= 5)
    batch = make_batch([scene], **SIZES)
    records = []
    final = fit(step, state, fed(batch), num_steps=STEPS, report=lambda _, record: records.append(record))
    assert int(final.step) == STEPS
    assert len(records) == STEPS
    assert records[-1]["loss/total"] < 0.25 * records[0]["loss/total"]
    assert records[-1]["positive_iou"] > records[0]["positive_iou"] + 0.2

    detect_traces = []
    pure = make_detect(detector, CONFIG, TINY)

    def counted(variables, points, valid):
        detect_traces.append(1)
        return pure(variables, points, valid)

    detect = jax.jit(counted)
    variables = {"params": final.params, "batch_stats": final.batch_stats}
    found = detect(variables, batch.points[0], batch.valid[0])
    confident = np.asarray(found.valid) & (np.asarray(found.scores) >= 0.3)
    boxes, labels, scores = (np.asarray(a)[confident] for a in (found.boxes, found.labels, found.scores))
    large = scene.num_points >= 30
    match = match_frame(boxes, labels, scores, scene.boxes, scene.labels, max_distance_m=1.0)
    assert large[match.truth].sum() >= 0.75 * large.sum()

    # No recompilation over other frames, for the step and for detection.
    for seed in range(10):
        other = make_batch([frame(seed)], **SIZES)
        step(state, other)
        detect(variables, other.points[0], other.valid[0])
    assert len(traces) == 1
    assert len(detect_traces) == 1


def empty_batch(num_points: int) -> Batch:
    points = np.zeros((1, CONFIG.max_points, 5), np.float32)
    points[0, :num_points] = [3.0, 4.0, -0.5, 20.0, 0.0]
    valid = np.arange(CONFIG.max_points)[None] < num_points
    boxes = np.zeros((1, CONFIG.max_boxes, 9), np.float32)
    return Batch(
        points, valid, boxes, np.zeros((1, CONFIG.max_boxes), np.int32), np.zeros((1, CONFIG.max_boxes), bool)
    )


@pytest.mark.parametrize("num_points", [0, 1])
@pytest.mark.parametrize("with_box", [False, True])
def test_step_is_finite_without_boxes_points_or_anything(trainer, num_points, with_box):
    _, state, step, _ = trainer
    batch = empty_batch(num_points)
    if with_box:
        batch.boxes[0, 0] = [3, 4, -0.5, 4, 2, 1.5, 0.3, np.nan, np.nan]
        batch.box_valid[0, 0] = True
    after, metrics = step(state, batch)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(after.params))
    assert all(bool(jnp.isfinite(v).all()) for v in jax.tree.leaves(metrics))
    assert (int(metrics["positives"]) > 0) == (with_box and num_points == 1)


def test_losses_are_divided_by_the_positives_of_the_whole_batch():
    """A batch of an empty and a full sample has the full sample's box losses, not half of them."""
    detector = build_detector(CONFIG, TINY)
    variables = detector.init(jax.random.key(0))
    # Without batch statistics the samples do not see each other.
    frozen = detector._replace(apply=lambda v, f, train: detector.apply(v, f, train=False))
    loss = jax.jit(make_loss(frozen, CONFIG, TINY))
    full = make_batch([frame(3)], **SIZES)
    empty = empty_batch(1)
    both = jax.tree.map(lambda a, b: np.concatenate([a, b]), full, empty)
    args = variables["params"], variables["batch_stats"]
    alone, together = loss(*args, full)[1][1], loss(*args, both)[1][1]
    assert int(alone["positives"]) == int(together["positives"]) > 0
    for part in ("l1", "iou", "iou_prediction"):
        np.testing.assert_allclose(alone[f"loss/{part}"], together[f"loss/{part}"], rtol=1e-4)


def test_owner_of_a_location_is_the_owner_of_its_first_round_point():
    scene = frame(5)
    layout = image_layout(TINY, CONFIG.model)
    image = project_points(scene.points, np.ones(len(scene.points), bool), TINY, num_rounds=2)
    locations = look(image, layout)
    box_valid = np.ones(len(scene.boxes), bool)
    owner = np.asarray(location_owners(image, locations, jnp.asarray(scene.boxes), jnp.asarray(box_valid)))
    index = np.asarray(image.point_index)[..., 0].reshape(-1)
    cells = location_cells(layout)
    checked = 0
    for l in np.random.default_rng(0).choice(len(cells), 400, replace=False):
        row = index[cells[l]] if cells[l] >= 0 else -1
        expected, least = -1, np.inf
        for m, (x, y, z, length, width, height, yaw) in enumerate(scene.boxes[:, :7].astype(float)):
            dx, dy, dz = scene.points[row, :3] - np.array([x, y, z])
            along, across = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
            inside = abs(along) <= length / 2 and abs(across) <= width / 2 and abs(dz) <= height / 2
            if row >= 0 and inside and length * width * height < least:
                expected, least = m, length * width * height
        assert owner[l] == expected
        checked += expected >= 0
    assert checked > 10


def test_state_has_no_weak_types_and_survives_a_step_in_kind(trainer):
    _, state, step, _ = trainer
    after, _ = step(state, make_batch([frame(1)], **SIZES))

    def kinds(tree):
        return [jax.typeof(leaf) for leaf in jax.tree.leaves(tree)]

    assert kinds(state) == kinds(after)
    assert not any(getattr(kind, "weak_type", False) for kind in kinds(state))


def test_schedules_have_the_papers_end_points():
    rate, momentum = (f(OptimizerConfig(), 5000) for f in (learning_rate_schedule, momentum_schedule))
    np.testing.assert_allclose([rate(0), rate(2000), rate(5000)], [1e-3, 1e-2, 1e-7], rtol=1e-4)
    np.testing.assert_allclose([momentum(0), momentum(2000), momentum(5000)], [0.95, 0.85, 0.95], rtol=1e-5)
    # Half way up, a cosine is half way.
    np.testing.assert_allclose(rate(1000), (1e-3 + 1e-2) / 2, rtol=1e-4)
    np.testing.assert_allclose(momentum(1000), 0.9, rtol=1e-5)


def test_optimizer_clips_decays_and_reports():
    """First step of AdamW by hand: the clipped gradient's direction, plus decay."""
    config = OptimizerConfig()
    optimizer = make_optimizer(config, 10)
    params = {"w": jnp.array([2.0, -1.0])}
    state = optimizer.init(params)
    grads = {"w": jnp.array([300.0, -400.0])}
    updates, state = optimizer.update(grads, state, params)
    clipped = np.array([300.0, -400.0]) * 35 / 500
    expected = -1e-3 * (clipped / (np.abs(clipped) + 1e-8) + 0.01 * np.array([2.0, -1.0]))
    np.testing.assert_allclose(updates["w"], expected, rtol=1e-5)
    np.testing.assert_allclose(state[1].hyperparams["learning_rate"], 1e-3, rtol=1e-6)
    np.testing.assert_allclose(state[1].hyperparams["b1"], 0.95, rtol=1e-6)


def test_a_loss_that_is_not_finite_stops_the_run_and_names_the_step(trainer):
    _, state, _, _ = trainer

    def broken(state, batch):
        state = dataclasses.replace(state, step=state.step + 1)
        value = jnp.where(state.step == 2, jnp.nan, 1.0)
        one = jnp.float32(1)
        metrics = {
            "loss/total": value,
            "loss/l1": value,
            "loss/iou": one,
            "gradient_norm": one,
            "positive_iou": one,
        }
        return state, metrics

    told = r"step 2: not finite: total nan, l1 nan; samples: a, b$"
    with pytest.raises(NonFiniteLossError, match=told):
        fit(broken, state, fed(empty_batch(0), 5), num_steps=5)


def test_the_loop_pauses_with_all_read_and_stops_when_asked(trainer):
    _, state, _, _ = trainer
    seen = []

    def count(state, batch):
        one = jnp.float32(1)
        metrics = {"loss/total": one, "gradient_norm": one, "positive_iou": one}
        return dataclasses.replace(state, step=state.step + 1), metrics

    final = fit(
        count,
        state,
        fed(empty_batch(0), 9),
        num_steps=9,
        report=lambda number, record: seen.append((number, record["overflow_points"])),
        pause_at=lambda number: number % 2 == 0,
        pause=lambda number, state: seen.append(("pause", number, int(state.step))),
        stopping=lambda number: number == 5,
    )
    assert int(final.step) == 5
    assert seen == [(1, 0), (2, 0), ("pause", 2, 2), (3, 0), (4, 0), ("pause", 4, 4), (5, 0)]


def test_augmentation_depends_on_seed_step_and_sample_alone():
    config = dataclasses.replace(CONFIG, augment=QUICKSTART.augment)
    detector = build_detector(config, TINY)
    optimizer = make_optimizer(config.optimizer, STEPS)
    key = jax.random.key(0)
    state = make_state(detector.init(key), optimizer, key)
    step = jax.jit(make_train_step(detector, config, TINY, optimizer))
    batch = make_batch([frame(3)], **SIZES)
    first, again = (step(state, batch)[1]["loss/total"] for _ in range(2))
    later = step(dataclasses.replace(state, step=state.step + 1), batch)[1]["loss/total"]
    assert float(first) == float(again) != float(later)

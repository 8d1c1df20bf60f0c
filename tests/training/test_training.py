"""The training step is finite and compiled once, its schedules are exact, and a short run learns a frame."""

import collections
import dataclasses
import functools
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import oracles
import pytest
import tiny_peer
from tiny_run import SENSOR, TINY_CONFIG, TINY_REFINED, weights

from experiments.studies.overfit_keyframe import match_frame
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.coding import encode
from fcos_lidar_jax.config import OptimizerConfig
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.locations import image_layout, locate, location_cells
from fcos_lidar_jax.models import Detector, build_detector, objective
from fcos_lidar_jax.models.objective import location_owners, make_sums, sample_losses
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.training import NonFiniteLossError, fit, make_optimizer, make_state, make_train_step, plan
from fcos_lidar_jax.training.optimizer import learning_rate_schedule, momentum_schedule
from fcos_lidar_jax.training.step import detection_variables, make_gradient
from fcos_lidar_jax.types import Batch, HostBatch, Outputs, Sums, TrainState

STEPS = 75
CONFIG = dataclasses.replace(
    QUICKSTART,
    model=TINY_CONFIG.model,
    augment=None,
    optimizer=dataclasses.replace(QUICKSTART.optimizer, batch_size=1),
    loss=dataclasses.replace(QUICKSTART.loss, l1_weight=1.0),
)
SIZES = {"max_points": CONFIG.max_points, "max_boxes": CONFIG.max_boxes}
FRAMES = SimulatedFrames(SENSOR, 1000)


def host_batches(batch, count=STEPS):
    """The same batch several times, as input of the loop."""
    return [HostBatch(batch, {"truncated_points": 0}, ("a", "b"))] * count


def frame(seed: int):
    return FRAMES.frame(seed)


def counted(function):
    """A jitted function, and a list that grows with each of its traces."""
    traces = []

    def call(*args):
        traces.append(1)
        return function(*args)

    return jax.jit(call), traces


@pytest.fixture(scope="module")
def trainer():
    """Detector, state and a jitted step that counts its traces."""
    detector = build_detector(CONFIG, SENSOR)
    optimizer, key = make_optimizer(CONFIG.optimizer, STEPS), jax.random.key(0)
    return detector, make_state(detector, optimizer, key), *counted(make_train_step(detector, optimizer))


@pytest.mark.slow
def test_a_short_run_learns_one_simulated_frame_and_compiles_once(trainer):
    """Finds the large objects; experiments/studies/overfit_keyframe.py trains for longer."""
    detector, state, step, traces = trainer
    scene = next(f for f in map(frame, range(100)) if (f.num_points >= 30).sum() >= 5)
    batch = make_batch([scene], **SIZES)
    records = []
    batches = host_batches(batch)
    final = fit(step, state, batches, num_steps=STEPS, report=lambda _, record: records.append(record))
    assert int(final.step) == STEPS
    assert len(records) == STEPS
    assert records[-1]["loss/total"] < 0.25 * records[0]["loss/total"]
    assert records[-1]["positive_iou"] > records[0]["positive_iou"] + 0.2

    detect, detect_traces = counted(make_detect(detector))
    variables = {"params": final.params, "batch_stats": final.batch_stats}
    found = detect(variables, batch.points[0], batch.valid[0])
    confident = np.asarray(found.valid) & (np.asarray(found.scores) >= 0.3)
    boxes, labels, scores = (np.asarray(a)[confident] for a in (found.boxes, found.labels, found.scores))
    large = scene.num_points >= 30
    match = match_frame(boxes, labels, scores, scene.boxes, scene.labels, max_distance_m=1.0)
    assert large[match.truth].sum() >= 0.75 * large.sum()

    # Other frames need no recompilation of step or detection.
    for seed in range(3):
        other = make_batch([frame(seed)], **SIZES)
        step(state, other)
        detect(variables, other.points[0], other.valid[0])
    assert len(traces) == len(detect_traces) == 1


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
def test_a_step_is_finite_without_boxes_and_points(trainer, num_points, with_box):
    _, state, step, _ = trainer
    batch = empty_batch(num_points)
    if with_box:
        batch.boxes[0, 0] = [3, 4, -0.5, 4, 2, 1.5, 0.3, np.nan, np.nan]
        batch.box_valid[0, 0] = True
    after, metrics = step(state, batch)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(after.params))
    assert all(bool(jnp.isfinite(v).all()) for v in jax.tree.leaves(metrics))
    assert (int(metrics["positives"]) > 0) == (with_box and num_points == 1)


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("labels", (1, 6), r"labels: got shape \(6,\), expected \(32,\)"),
        ("boxes", (2, 32, 9), "vmap got inconsistent sizes for array axes"),
    ],
)
def test_a_step_refuses_a_batch_whose_arrays_do_not_fit_each_other(trainer, name, shape, message):
    detector, state, _, _ = trainer
    step = make_train_step(detector, make_optimizer(CONFIG.optimizer, STEPS))
    batch = empty_batch(1)
    batch = dataclasses.replace(batch, **{name: np.zeros(shape, getattr(batch, name).dtype)})
    with pytest.raises(ValueError, match=f"^{message}"):
        jax.eval_shape(step, state, batch)


def test_the_owner_of_a_location_is_the_owner_of_its_first_round_point():
    scene = frame(5)
    box_valid = np.ones(len(scene.boxes), bool)
    layout = image_layout(SENSOR, CONFIG.model)
    image = project_points(scene.points, np.ones(len(scene.points), bool), SENSOR, num_rounds=2)
    locations = locate(image, layout)
    owner = np.asarray(location_owners(image, locations, jnp.asarray(scene.boxes), jnp.asarray(box_valid)))
    index = np.asarray(image.point_index)[..., 0].reshape(-1)
    cells = location_cells(layout)
    sample = np.random.default_rng(0).choice(len(cells), 400, replace=False)
    rows = np.where(cells[sample] >= 0, index[cells[sample]], -1)
    boxes = scene.boxes.astype(float)
    expected = [oracles.owner(scene.points[row, :3], boxes, box_valid) if row >= 0 else -1 for row in rows]
    np.testing.assert_array_equal(owner[sample], expected)
    assert sum(box >= 0 for box in expected) > 10


def test_the_optimizer_is_adamw_of_clipped_gradients():
    """A large and a small gradient: AdamW's first step does not depend on the length of the gradient."""
    config, params = OptimizerConfig(), np.array([2.0, -1.0])
    optimizer = make_optimizer(config, 10)
    state, mean, square = optimizer.init({"w": jnp.asarray(params)}), np.zeros(2), np.zeros(2)
    for step, gradient in enumerate(np.array([[300.0, -400.0], [3.0, 4.0]])):
        updates, state = optimizer.update({"w": jnp.asarray(gradient)}, state, {"w": jnp.asarray(params)})
        b1, rate = (float(of(config, 10)(step)) for of in (momentum_schedule, learning_rate_schedule))
        clipped = gradient * min(1.0, 35 / np.linalg.norm(gradient))
        mean, square = b1 * mean + (1 - b1) * clipped, 0.99 * square + 0.01 * clipped**2
        scaled = mean / (1 - b1 ** (step + 1)), square / (1 - 0.99 ** (step + 1))
        expected = -rate * (scaled[0] / (np.sqrt(scaled[1]) + 1e-8) + 0.01 * params)
        np.testing.assert_allclose(updates["w"], expected, rtol=1e-5)
        params = params + expected


@pytest.mark.parametrize(
    "config",
    [
        OptimizerConfig(),
        OptimizerConfig(
            peak_learning_rate=0.003,
            initial_divisor=4,
            final_divisor=100,
            warmup_fraction=0.3,
            b1_range=(0.8, 0.9),
        ),
    ],
)
def test_schedules_are_cosines_between_the_values_of_the_configuration(config):
    peak, (low, high), turn = config.peak_learning_rate, config.b1_range, 1000 * config.warmup_fraction
    rates = peak / config.initial_divisor, peak, peak / config.initial_divisor / config.final_divisor
    for make, values in ((learning_rate_schedule, rates), (momentum_schedule, (high, low, high))):
        schedule = make(config, 1000)
        for step in (*range(0, 1000, 37), 1000):
            risen = step < turn
            begin, end = values[:2] if risen else values[1:]
            share = step / turn if risen else (step - turn) / (1000 - turn)
            expected = end + (begin - end) * (1 + np.cos(np.pi * share)) / 2
            assert float(schedule(step)) == pytest.approx(expected, rel=1e-4)


def test_the_loop_reads_all_metrics_before_a_pause_and_stops_when_asked(trainer):
    _, state, _, _ = trainer
    calls, asked = [], []

    def count(state, batch):
        one = jnp.float32(1)
        metrics = {"loss/total": one, "gradient_norm": one, "positive_iou": one}
        return dataclasses.replace(state, step=state.step + 1), metrics

    final = fit(
        count,
        state,
        host_batches(empty_batch(0), 9),
        num_steps=9,
        report=lambda number, record: calls.append((number, record["truncated_points"])),
        pause_at=lambda number: asked.append(number) or number % 2 == 0,
        pause=lambda number, state: calls.append(("pause", number, int(state.step))),
        stopping=lambda number: number == 5,
    )
    assert int(final.step) == 5
    assert calls == [(1, 0), (2, 0), ("pause", 2, 2), (3, 0), (4, 0), ("pause", 4, 4), (5, 0)]
    assert asked == [1, 2, 3, 4, 5]


def toy_detector(config=CONFIG) -> Detector:
    """A network with one weight per output, scaled by a mean of the sample: no batch norm, quick to compile."""
    layout = image_layout(SENSOR, CONFIG.model)
    kinds, rows = len(CONFIG.classes), layout.num_locations
    shapes = {"logits": (rows, kinds + 1), "regression": (rows, 10, kinds), "iou_logits": (rows, kinds)}

    def init(key):
        keys = jax.random.split(key, len(shapes))
        named = zip(keys, shapes.items(), strict=True)
        params = {name: 0.1 * jax.random.normal(key, shape) for key, (name, shape) in named}
        return {"params": params, "batch_stats": {}}

    def apply(variables, images, train):
        size = 1 + 0.01 * images.features.mean(axis=(1, 2, 3, 4))
        outputs = {n: jnp.einsum("b,...->b...", size, leaf) for n, leaf in variables["params"].items()}
        return Outputs(**outputs), {}

    return build_detector(config, SENSOR)._replace(init=init, apply=apply)


def with_optimizer(**changes):
    return dataclasses.replace(CONFIG, optimizer=dataclasses.replace(CONFIG.optimizer, **changes))


def four_frames() -> Batch:
    """A batch with very different numbers of positives, and none in the second frame."""
    batch = make_batch([frame(seed) for seed in (3, 4, 5, 6)], **SIZES)
    batch.box_valid[1] = False
    batch.box_valid[2, 2:] = False
    return batch


@pytest.mark.slow
@pytest.mark.parametrize(("axes", "accumulate"), [("lidar", 2), ("ray", 1)])
def test_each_loss_is_divided_by_the_number_of_its_locations(axes, accumulate):
    """Compares with NumPy, with and without micro-batches: cross-entropy over positives, L1 over candidates."""
    choices = dataclasses.replace(
        CONFIG.loss, regress_on="candidates", l1_weight=0.5, iou_weight=0.0, iou_prediction_weight=0.0
    )
    detector = toy_detector()
    params, batch = detector.init(jax.random.key(0))["params"], jax.tree.map(jnp.asarray, four_frames())
    layout = image_layout(SENSOR, CONFIG.model)
    expected = {name: np.zeros(leaf.shape) for name, leaf in params.items()}
    losses, positives, candidates = {"classification": 0.0, "l1": 0.0}, 0, 0
    project = jax.jit(project_points, static_argnames=("sensor", "num_rounds"))
    targets_of = jax.jit(lambda *sample: sample_losses(*sample, config=choices, layout=layout, axes=axes)[1])
    for points, valid, boxes, labels, box_valid in zip(*jax.tree.leaves(batch), strict=True):
        image = project(points, valid, SENSOR, num_rounds=CONFIG.projection.num_rounds)
        outputs, _ = detector.apply({"params": params}, jax.tree.map(lambda leaf: leaf[None], image), train=True)
        outputs = jax.tree.map(lambda leaf: leaf[0], outputs)
        targets = targets_of(outputs, image, boxes, labels, box_valid)
        locations = locate(image, layout)
        size = 1 + 0.01 * np.asarray(image.features).mean()
        owned = boxes[targets.owner], locations.points, locations.azimuth_rad
        encoded = np.asarray(encode(*owned, axes=axes))
        owner, positive, labels = (np.asarray(a) for a in (targets.owner, targets.positive, labels))
        logits, regression = (np.asarray(a, np.float64) for a in (outputs.logits, outputs.regression))
        for l in np.flatnonzero(locations.occupied):
            label = labels[owner[l]] if positive[l] else -1
            odds = np.exp(logits[l])
            losses["classification"] -= np.log(odds[label] / odds.sum())
            expected["logits"][l] += size * (odds / odds.sum() - np.eye(len(odds))[label])
            positives += label >= 0
        for l in np.flatnonzero(owner >= 0):
            label = labels[owner[l]]
            off = regression[l, :, label] - encoded[l]
            weights = np.where(np.isnan(off), 0.0, [1.0] * 8 + [0.2] * 2)
            losses["l1"] += (weights * np.abs(np.nan_to_num(off))).sum()
            expected["regression"][l, :, label] += 0.5 * size * weights * np.sign(np.nan_to_num(off))
            candidates += 1
    assert candidates > 2 * positives > 20
    model = dataclasses.replace(CONFIG.model, regression_axes=axes)
    config = dataclasses.replace(with_optimizer(batch_size=4, accumulate=accumulate), loss=choices, model=model)
    gradient, _, metrics = jax.jit(make_gradient(toy_detector(config)))(params, {}, batch)
    assert (int(metrics["positives"]), int(metrics["candidates"])) == (positives, candidates)
    np.testing.assert_allclose(metrics["loss/classification"], losses["classification"] / positives, rtol=1e-4)
    np.testing.assert_allclose(metrics["loss/l1"], losses["l1"] / candidates, rtol=1e-4)
    np.testing.assert_allclose(gradient["logits"], expected["logits"] / positives, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(gradient["regression"], expected["regression"] / candidates, rtol=1e-3, atol=1e-8)


def test_every_weight_of_the_configuration_has_a_loss(trainer):
    detector, state, _, _ = trainer
    step = make_train_step(detector, make_optimizer(CONFIG.optimizer, STEPS))
    _, metrics = jax.eval_shape(step, state, empty_batch(1))
    found = {f"{name.removeprefix('loss/')}_weight" for name in metrics if name.startswith("loss/")}
    named = {field.name for field in dataclasses.fields(CONFIG.loss) if field.name.endswith("_weight")}
    # The velocity's is a weight within the L1 loss; the others belong to the second look.
    assert found - {"total_weight"} == named - {"velocity_weight", "refined_class_weight", "refined_box_weight"}


def test_a_new_loss_is_divided_by_the_locations_of_the_regression(monkeypatch):
    def with_height(*sample, **options):
        parts, *rest = sample_losses(*sample, **options)
        return {**parts, "height": parts["l1"]}, *rest

    def losses(detector, params, batch):
        images = jax.vmap(detector.prepare)(batch.points, batch.valid)
        outputs, _ = detector.apply({"params": params}, images, train=True)
        return detector.sums({}, outputs, images, batch).losses

    monkeypatch.setattr(objective, "sample_losses", with_height)
    for regress_on in ("positives", "candidates"):
        config = dataclasses.replace(CONFIG, loss=dataclasses.replace(CONFIG.loss, regress_on=regress_on))
        detector = toy_detector(config)._replace(sums=make_sums(config, SENSOR))
        params = detector.init(jax.random.key(0))["params"]
        found = jax.eval_shape(functools.partial(losses, detector), params, four_frames())
        assert {"l1", "height"} <= set(found[regress_on])


@pytest.mark.slow
def test_assignment_and_losses_of_a_sample_equal_numpy():
    """Predictions are half a metre above the truth: centreness is constant, and IoU depends on the height."""
    detector, batch = toy_detector(), jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], four_frames())
    params, layout = detector.init(jax.random.key(0))["params"], image_layout(SENSOR, CONFIG.model)
    image = project_points(batch.points, batch.valid, SENSOR, num_rounds=CONFIG.projection.num_rounds)
    outputs, _ = detector.apply({"params": params}, jax.tree.map(lambda leaf: leaf[None], image), train=True)
    outputs, locations = jax.tree.map(lambda leaf: leaf[0], outputs), locate(image, layout)
    owner = location_owners(image, locations, batch.boxes, batch.box_valid)
    box = np.asarray(batch.boxes)[np.asarray(owner)]
    exact = np.nan_to_num(encode(jnp.asarray(box), locations.points, locations.azimuth_rad, axes="lidar"))
    exact[:, 2] += 0.5
    regression = jnp.asarray(np.repeat(exact[..., None], outputs.regression.shape[-1], axis=2))
    outputs = dataclasses.replace(outputs, regression=regression)
    inside = np.asarray(owner) >= 0
    label = np.asarray(batch.labels)[np.asarray(owner)]
    logits = np.take_along_axis(np.asarray(outputs.iou_logits, np.float64), label[:, None], axis=1)[:, 0]
    overlap = np.maximum(box[:, 5] - 0.5, 0) / (box[:, 5] + 0.5)
    for quality, target in (("centreness", np.exp(-((0.5 / 0.75) ** 2))), ("iou", overlap)):
        choices = dataclasses.replace(CONFIG.loss, regress_on="candidates", quality=quality)
        sample = outputs, image, batch.boxes, batch.labels, batch.box_valid
        parts, _, _ = sample_losses(*sample, config=choices, layout=layout, axes="lidar")
        total, count = parts["iou_prediction"]
        expected = (np.log1p(np.exp(logits)) - target * logits)[inside].sum()
        np.testing.assert_allclose(total, expected, rtol=1e-3)
        assert int(count) == inside.sum() > 10
    odds, rows = np.exp(np.asarray(outputs.logits, np.float64)), np.arange(len(label))
    cost = -np.log(odds[rows, label] / odds.sum(1))
    positive, _ = oracles.assign(np.asarray(owner), cost, overlap, len(batch.boxes), 5)
    for regress_on, mask in (("positives", positive), ("candidates", inside)):
        choices = dataclasses.replace(CONFIG.loss, regress_on=regress_on, iou_loss="log_iou", top_q=5)
        parts, targets, counts = sample_losses(*sample, config=choices, layout=layout, axes="lidar")
        np.testing.assert_array_equal(targets.positive, positive)
        np.testing.assert_allclose(parts["l1"][0], 0.5 * mask.sum(), rtol=1e-4)
        np.testing.assert_allclose(parts["iou"][0], -np.log(np.maximum(overlap, 1e-6))[mask].sum(), rtol=1e-3)
        assert int(parts["l1"][1]) == mask.sum()
        assert int(counts["unique_positives"]) == len(np.unique(location_cells(layout)[positive])) < positive.sum()
        levels = np.split(positive, np.cumsum(layout.level_sizes)[:-1])
        assert counts["positives_per_level"].tolist() == [level.sum() for level in levels]


ZERO = {"params": {"w": jnp.float32(0)}, "batch_stats": {}}


@pytest.fixture
def squares():
    """A detector whose loss is the squared distance of its weight from the boxes, and the rows of its batches."""
    row_lists = []

    def apply(variables, images, train):
        return jnp.broadcast_to(variables["params"]["w"], images.num_dropped.shape), {}

    def sums(_variables, outputs, _, batch):
        jax.debug.callback(lambda rows: row_lists.append(rows.tolist()), batch.boxes[:, 0, 0], ordered=True)
        count = batch.box_valid.sum(dtype=jnp.int32)
        total = jnp.where(batch.box_valid, jnp.square(outputs[:, None] - batch.boxes[..., 0]), 0.0).sum()
        return Sums({"positives": {"classification": total}}, {"positives": count}, {"positives": {"mean": total}})

    def detector(config=CONFIG):
        return build_detector(config, SENSOR)._replace(apply=apply, sums=sums)

    batch = empty_batch(0)
    batch = jax.tree.map(lambda leaf: np.repeat(leaf, 8, axis=0), batch)
    batch.boxes[:, :, 0] = np.arange(8)[:, None]
    batch.box_valid[...] = np.arange(CONFIG.max_boxes) < np.array([1, 0, 5, 2, 0, 0, 9, 3])[:, None]
    return detector, batch, row_lists


def test_augmentation_depends_only_on_seed_step_and_place_in_the_batch(squares):
    config = dataclasses.replace(with_optimizer(ema_decay=0.0, batch_size=8), augment=QUICKSTART.augment)
    detector, optimizer, batch = squares[0](config), optax.sgd(0.0), squares[1]
    batch.boxes[:, :, 0] = 8  # eight equal samples
    state = make_state(detector, optimizer, jax.random.key(0), variables=ZERO)
    later = dataclasses.replace(state, step=state.step + 1)
    other = dataclasses.replace(state, key=jax.random.key(1))
    step, states = jax.jit(make_train_step(detector, optimizer)), (state, state, later, other)
    first, again, later, other = (float(step(each, batch)[1]["loss/total"]) for each in states)
    assert first == again
    assert len({first, later, other}) == 3
    jax.effects_barrier()
    assert len({*next(filter(None, squares[2]))}) == 8


RATE = optax.inject_hyperparams(optax.sgd)(learning_rate=0.125)
OPTIMIZERS = {  # the steps until the first update, and the hyperparameters that are reported
    "adam": (optax.adam(0.1), 1, {}),
    "MultiSteps": (optax.MultiSteps(RATE, 2), 2, {"learning_rate": 0.125}),
    "inject_hyperparams": (RATE, 1, {"learning_rate": 0.125}),
    "partition": (optax.partition({"all": RATE}, {"w": "all"}), 1, {"all/learning_rate": 0.125}),
    "reduce_on_plateau": (optax.chain(optax.sgd(0.1), optax.contrib.reduce_on_plateau()), 1, {}),
    "make_optimizer": (make_optimizer(OptimizerConfig(), 10), 1, {"learning_rate": 1e-3, "b1": 0.95}),
}


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_a_step_works_with_any_optimizer_and_reports_its_hyperparameters(squares, name):
    optimizer, until, expected = OPTIMIZERS[name]
    detector, batch = squares[0](with_optimizer(ema_decay=0.0, batch_size=8)), squares[1]
    state = make_state(detector, optimizer, jax.random.key(0), variables=ZERO)
    step, traces = counted(make_train_step(detector, optimizer))
    for number in range(1, until + 1):
        state, metrics = step(state, batch)
        assert (float(state.params["w"]) > 0) == (number == until)
    assert len(traces) == 1
    assert metrics.keys() - {"loss/total", "loss/classification", "mean", "gradient_norm"} == {
        "positives",
        "dropped_points",
        *expected,
    }
    for key, value in expected.items():
        assert float(metrics[key]) == pytest.approx(value)
    if until == 1:  # the weight was zero
        gradient = np.mean(2 * batch.boxes[..., 0][batch.box_valid])
        assert float(metrics["gradient_norm"]) == pytest.approx(gradient)


@pytest.mark.parametrize("num_micro", [1, 2])
def test_gradients_are_divided_by_all_positives_and_micro_batches_are_strided(squares, num_micro):
    """By hand: the gradient is the mean of 2 (w - x) over all boxes."""
    detector, batch, row_lists = squares
    config = with_optimizer(batch_size=8, accumulate=num_micro)
    gradient, _, metrics = jax.jit(make_gradient(detector(config)))({"w": jnp.float32(3.5)}, {}, batch)
    jax.effects_barrier()
    x = batch.boxes[..., 0][batch.box_valid]
    np.testing.assert_allclose(gradient["w"], np.mean(2 * (3.5 - x)), rtol=1e-6)
    assert int(metrics["positives"]) == len(x) == 20
    np.testing.assert_allclose(metrics["mean"], np.mean((3.5 - x) ** 2), rtol=1e-6)
    assert [rows for rows in row_lists if rows] == [list(range(i, 8, num_micro)) for i in range(num_micro)]


def test_the_running_mean_of_the_weights_matches_a_loop(squares):
    decay, (make, batch, _) = 0.2, squares
    config = with_optimizer(ema_decay=decay, batch_size=8)
    detector, optimizer = make(config), make_optimizer(CONFIG.optimizer, STEPS)
    state = make_state(detector, optimizer, jax.random.key(0), variables=ZERO)
    step = jax.jit(make_train_step(detector, optimizer))
    mean, kept = 0.0, []
    for number in range(5):
        state, _ = step(state, batch)
        kept.append(min(decay, (1 + number) / (10 + number)))
        mean = kept[-1] * mean + (1 - kept[-1]) * float(state.params["w"])
    assert kept[0] < kept[1] < kept[2] == decay  # EMA warm-up
    np.testing.assert_allclose(state.ema["w"], mean, rtol=1e-6)
    assert abs(mean - float(state.params["w"])) > 1e-5
    assert detection_variables(state) == {"params": state.ema, "batch_stats": {}}
    plain = dataclasses.replace(state, ema=None)
    assert detection_variables(plain) == {"params": plain.params, "batch_stats": {}}


def test_boxes_and_points_that_are_left_out_are_reported_once(capsys):
    def step(state, _):
        return state, {"loss/total": 1.0}

    state = TrainState(np.int32(0), {}, {}, (), None, jax.random.key(0))
    counts = ({}, {"truncated_boxes": 0, "truncated_points": 0}, {"truncated_boxes": 2}, {"truncated_boxes": 7})
    counts += ({"truncated_points": 9}, {"truncated_points": 9})
    fit(step, state, [HostBatch(None, found, ("a",)) for found in counts], num_steps=6)
    boxes, points = (line for line in capsys.readouterr().err.splitlines() if line.startswith("note: "))
    assert boxes.startswith("note: step 3: 2 boxes left out, since samples have more than max_boxes;")
    assert points.startswith("note: step 5: 9 points left out, since samples have more than max_points;")


def test_a_loss_that_is_not_finite_stops_the_run_before_a_pause(squares):
    """The first update of a huge learning rate makes the loss of the second step infinite."""
    config = with_optimizer(peak_learning_rate=1e30, batch_size=8)
    detector, optimizer = squares[0](config), make_optimizer(config.optimizer, STEPS)
    state = make_state(detector, optimizer, jax.random.key(0), variables=ZERO)
    step, paused = jax.jit(make_train_step(detector, optimizer)), []
    options = {"pause_at": lambda number: True, "pause": lambda number, _: paused.append(number)}
    with pytest.raises(NonFiniteLossError, match=r"^step 2: not finite: .*total inf.*; samples: a, b$"):
        fit(step, state, host_batches(squares[1]), num_steps=STEPS, **options)
    assert paused == [1]


GROUPED = dataclasses.replace(
    tiny_peer.CONFIG, pillars=dataclasses.replace(tiny_peer.CONFIG.pillars, groups=(0,) * 5 + (1,) * 5)
)
CLASSES = {  # the weights, and the part of the network and its arrays that other classes start anew
    "the network": (TINY_CONFIG, NUSCENES_CLASSES[::-1], {"heads": 12}),
    "a second look": (TINY_REFINED, ("car",), {"heads": 12, "refinement": 3}),
    "groups of CenterPoint": (GROUPED, NUSCENES_CLASSES[::-1], {"heads": 4}),
}


@pytest.mark.parametrize("case", CLASSES)
def test_weights_for_other_classes_keep_all_arrays_that_do_not_depend_on_them(capsys, case):
    config, classes, anew = CLASSES[case]
    given = weights(config)
    detector = build_detector(dataclasses.replace(config, classes=classes), SENSOR)
    taken = plan._for_other_classes(Path("start"), config.classes, given, detector, 0)
    assert jax.tree.structure(taken) == jax.tree.structure(given)
    pairs = zip(jax.tree.leaves_with_path(given), jax.tree.leaves(taken), strict=True)
    changed = [path[1].key for (path, old), new in pairs if not np.array_equal(old, new)]
    assert collections.Counter(changed) == anew
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"start: weights for other classes ({', '.join(NUSCENES_CLASSES)}): these start with")
    assert re.findall(r"(\w+) \((\d+) of \d+ arrays\)", line) == [(k, str(v)) for k, v in anew.items()]
    shapes = jax.tree.map(jnp.shape, jax.eval_shape(detector.init, jax.random.key(0)))
    assert jax.tree.map(jnp.shape, taken) == shapes

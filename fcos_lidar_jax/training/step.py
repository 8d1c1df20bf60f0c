"""One training step as a pure function: raw points in, new state and metrics out."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array

from fcos_lidar_jax.augment import augment, sample_key
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.models import Detector
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.training.objective import Metrics, finish, make_sums
from fcos_lidar_jax.training.optimizer import current_hyperparameters
from fcos_lidar_jax.types import Batch, TrainState

TrainStep = Callable[[TrainState, Batch], tuple[TrainState, Metrics]]


def make_state(
    variables: dict[str, Any], optimizer: optax.GradientTransformation, key: jax.Array, *, ema: bool = False
) -> TrainState:
    """The state before the first step.

    Args:
        variables: ``params`` and ``batch_stats`` of a detector.
        optimizer: whose state to begin.
        key: the run's random key.
        ema: keep a running mean of the weights.
    """
    state = TrainState(
        step=jnp.zeros((), jnp.int32),
        params=variables["params"],
        batch_stats=variables["batch_stats"],
        opt_state=optimizer.init(variables["params"]),
        # A copy: the step gives its input's buffers away, and none twice.
        ema=jax.tree.map(jnp.copy, variables["params"]) if ema else None,
        key=key,
    )
    # Strong types throughout: a weakly typed leaf would compile the step a second time.
    return jax.tree.map(lambda leaf: lax.convert_element_type(leaf, leaf.dtype) if _numeric(leaf) else leaf, state)


def _numeric(leaf: Any) -> bool:
    return not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def make_gradient(
    detector: Detector, config: Config, sensor: Sensor
) -> Callable[[Any, Any, Batch], tuple[Any, Any, Metrics]]:
    """The gradient of the loss of a batch, in ``config.optimizer.accumulate`` micro-batches.

    The gradients of the sums are summed and divided once by the positives of all micro-batches, so their number
    does not change what is weighed how; only batch norm sees smaller batches.

    Args:
        detector: the network.
        config: all choices.
        sensor: the image's geometry.

    Returns:
        pure ``(params, batch_stats, batch) -> (gradient, batch_stats, metrics)``.
    """
    of_sums = jax.value_and_grad(make_sums(detector, config, sensor), has_aux=True)
    pieces = config.optimizer.accumulate

    def gradient(params: Any, batch_stats: Any, batch: Batch) -> tuple[Any, Any, Metrics]:
        def visit(batch_stats: Any, micro: Batch) -> tuple[Any, tuple[Any, Metrics, Metrics]]:
            (_, (batch_stats, parts, counts)), grads = of_sums(params, batch_stats, micro)
            return batch_stats, (grads, parts, counts)

        if pieces == 1:
            batch_stats, (grads, parts, counts) = visit(batch_stats, batch)
        else:

            def add(carry: Any, micro: Batch) -> tuple[Any, None]:
                batch_stats, summed = carry
                batch_stats, new = visit(batch_stats, micro)
                return (batch_stats, jax.tree.map(jnp.add, summed, new)), None

            # Strided, so that every device has its share of every micro-batch.
            micros = jax.tree.map(lambda leaf: leaf.reshape(-1, pieces, *leaf.shape[1:]).swapaxes(0, 1), batch)
            shapes = jax.eval_shape(visit, batch_stats, jax.tree.map(lambda leaf: leaf[0], micros))[1]
            nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
            (batch_stats, (grads, parts, counts)), _ = lax.scan(add, (batch_stats, nothing), micros)
        scale = 1 / jnp.maximum(counts["positives"], 1)
        grads = jax.tree.map(lambda leaf: leaf * scale.astype(leaf.dtype), grads)
        return grads, batch_stats, finish(parts, counts, config)

    return gradient


def make_train_step(
    detector: Detector, config: Config, sensor: Sensor, optimizer: optax.GradientTransformation
) -> TrainStep:
    """A training step: augment, project, predict, assign, differentiate, update.

    Args:
        detector: the network.
        config: all choices; ``config.augment`` None for none.
        sensor: the image's geometry.
        optimizer: from :func:`fcos_lidar_jax.training.make_optimizer`.

    Returns:
        pure ``(state, batch) -> (state, metrics)``, to be jitted by the caller. The metrics are scalars but
        for ``positives_per_level`` i32[6].
    """
    gradient = make_gradient(detector, config, sensor)
    decay = config.optimizer.ema_decay

    def augmented(state: TrainState, batch: Batch) -> Batch:
        if config.augment is None:
            return batch
        recipe = config.augment

        def one(index: Array, points: Array, boxes: Array) -> tuple[Array, Array]:
            key = sample_key(state.key, state.step, index)
            return augment(key, points, boxes, recipe, origin_m=sensor.origin_m)

        index = jnp.arange(batch.points.shape[0], dtype=jnp.int32)
        points, boxes = jax.vmap(one)(index, batch.points, batch.boxes)
        return Batch(points, batch.valid, boxes, batch.labels, batch.box_valid)

    def step(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        grads, batch_stats, metrics = gradient(state.params, state.batch_stats, augmented(state, batch))
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        metrics["gradient_norm"] = optax.tree.norm(grads)
        metrics.update(current_hyperparameters(opt_state))
        ema = state.ema
        if ema is not None:
            # Young means follow faster, or they would remember the random start.
            kept = jnp.minimum(decay, (1 + state.step) / (10 + state.step)).astype(jnp.float32)
            ema = jax.tree.map(lambda old, new: old + (1 - kept.astype(old.dtype)) * (new - old), ema, params)
        new_state = TrainState(
            step=state.step + 1,
            params=params,
            batch_stats=batch_stats,
            opt_state=opt_state,
            ema=ema,
            key=state.key,
        )
        return new_state, metrics

    return step


def detection_variables(state: TrainState) -> dict[str, Any]:
    """What to detect with: the running mean of the weights where there is one, and the batch statistics."""
    return {"params": state.params if state.ema is None else state.ema, "batch_stats": state.batch_stats}

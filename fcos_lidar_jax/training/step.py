"""The training step as a pure function from state and raw points to new state and metrics."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from fcos_lidar_jax.augment import augment, sample_key
from fcos_lidar_jax.collectives import device_index, sum_over_devices, varying
from fcos_lidar_jax.models import Detector, Variables
from fcos_lidar_jax.refinement import trainable
from fcos_lidar_jax.training.objective import Metrics, batch_metrics, make_objective
from fcos_lidar_jax.training.optimizer import current_hyperparameters
from fcos_lidar_jax.types import Batch, Sums, TrainState, check_rows

Optimizer = optax.GradientTransformation | optax.MultiSteps
TrainStep = Callable[[TrainState, Batch], tuple[TrainState, Metrics]]


def make_state(
    detector: Detector,
    optimizer: Optimizer,
    key: jax.Array,
    *,
    variables: Variables | None = None,
) -> TrainState:
    """Make the state before the first step, with a running mean of the weights if ``ema_decay`` is not 0.

    Args:
        key: random key of the run.
        variables: initial ``params`` and ``batch_stats``; random by default.
    """
    variables = detector.init(key) if variables is None else variables
    state = TrainState(
        step=jnp.zeros((), jnp.int32),
        params=variables["params"],
        batch_stats=variables["batch_stats"],
        # Compiled, since each array is a program of its own otherwise.
        opt_state=jax.jit(optimizer.init)(trainable(variables["params"], detector.config)),
        # A copy, because the step donates its buffers and cannot donate one twice.
        ema=_copied(variables["params"]) if detector.config.optimizer.ema_decay > 0 else None,
        key=key,
    )
    # A weakly typed leaf would compile the step a second time.
    state = jax.tree.map(lambda x: lax.convert_element_type(x, x.dtype), dataclasses.replace(state, key=None))
    return dataclasses.replace(state, key=key)


@jax.jit
def _copied(params: Any) -> Any:
    return jax.tree.map(jnp.copy, params)


def make_gradient(detector: Detector) -> Callable[[Any, Any, Batch], tuple[Any, Any, Metrics]]:
    """Make the gradient of the loss of a batch, in ``config.optimizer.accumulate`` micro-batches.

    Sums of losses are divided by the counts over all micro-batches and devices, so the number of micro-batches
    does not change any weight, except with several groups of CenterPoint; batch norm sees smaller batches. With
    several micro-batches, the counts are known only after the last one, so each count, such as positives and boxes
    of the second look, has a gradient of its own.

    Returns:
        pure ``(params, batch_stats, batch) -> (gradient, batch_stats, metrics)``. The gradient has the trainable
        part of the parameters, see :func:`fcos_lidar_jax.refinement.trainable`.
    """
    config, objective = detector.config, make_objective(detector)
    num_micro = config.optimizer.accumulate

    def differentiate(params: Any, batch_stats: Any, micro: Batch) -> tuple[Metrics, Any, tuple[Any, Sums]]:
        part = trainable(params, config)
        return jax.vjp(lambda part: objective(params | part, batch_stats, micro), part, has_aux=True)

    def divided(tree: Any, count: Array) -> Any:
        scale = 1 / jnp.maximum(count, 1)
        return jax.tree.map(lambda leaf: leaf * scale.astype(leaf.dtype), tree)

    def at_once(params: Any, batch_stats: Any, batch: Batch) -> tuple[Any, Any, Sums]:
        totals, pull_back, (batch_stats, sums) = differentiate(params, batch_stats, batch)
        sums = sum_over_devices(sums)
        ones = jax.tree.map(jnp.ones_like, totals)
        (grads,) = pull_back({name: varying(divided(one, sums.counts[name])) for name, one in ones.items()})
        return sum_over_devices(grads), batch_stats, sums

    def accumulated(params: Any, batch_stats: Any, batch: Batch) -> tuple[Any, Any, Sums]:
        def visit(batch_stats: Any, micro: Batch) -> tuple[Any, tuple[Any, Sums]]:
            totals, pull_back, (batch_stats, sums) = differentiate(params, batch_stats, micro)
            zero = jax.tree.map(jnp.zeros_like, totals)
            grads = {name: pull_back(zero | {name: jnp.ones_like(t)})[0] for name, t in totals.items()}
            return batch_stats, (grads, sums)

        def add(carry: Any, micro: Batch) -> tuple[Any, None]:
            batch_stats, summed = carry
            batch_stats, new = visit(batch_stats, micro)
            return (batch_stats, jax.tree.map(jnp.add, summed, new)), None

        # Strided, so that every device holds a part of every micro-batch.
        micros = jax.tree.map(lambda leaf: leaf.reshape(-1, num_micro, *leaf.shape[1:]).swapaxes(0, 1), batch)
        shapes = jax.eval_shape(visit, batch_stats, jax.tree.map(lambda leaf: leaf[0], micros))[1]
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        # XLA runs convolutions in a loop several times slower on CPUs.
        carry, _ = lax.platform_dependent(
            (batch_stats, zeros),
            micros,
            cpu=functools.partial(lax.scan, add, unroll=True),
            default=functools.partial(lax.scan, add),
        )
        batch_stats, summed = carry
        grads, sums = sum_over_devices(summed)
        parts = [divided(part, sums.counts[name]) for name, part in grads.items()]
        return functools.reduce(optax.tree.add, parts), batch_stats, sums

    def gradient(params: Any, batch_stats: Any, batch: Batch) -> tuple[Any, Any, Metrics]:
        step = at_once if num_micro == 1 else accumulated
        grads, batch_stats, sums = step(varying(params), batch_stats, batch)
        return grads, batch_stats, batch_metrics(sums, config.loss)

    return gradient


def make_train_step(detector: Detector, optimizer: Optimizer) -> TrainStep:
    """Make a training step: augment unless ``config.augment`` is None, predict, differentiate, update.

    Args:
        detector: the detector; replace its functions to change the loss or the network's input.
        optimizer: any optimizer of optax. Its update also gets the loss, as ``value``.

    Returns:
        pure ``(state, batch) -> (state, metrics)``, to be jitted by the caller.
        Metrics are scalars except ``positives_per_level`` i32[6], with hyperparameters of the optimizer. Raises
        a ValueError at trace time if the arrays of the batch have different numbers of samples or boxes.

    >>> from fcos_lidar_jax.inference import load_trained
    >>> from fcos_lidar_jax.training import make_optimizer
    >>> detector = load_trained("quickstart").model
    >>> optimizer = make_optimizer(detector.config.optimizer, 100)
    >>> state = jax.eval_shape(functools.partial(make_state, detector, optimizer), jax.random.key(0))
    >>> clouds = jnp.zeros((2, 4096, 5)), jnp.zeros((2, 4096), bool)
    >>> batch = Batch(*clouds, jnp.zeros((2, 32, 9)), jnp.zeros((2, 32), int), jnp.zeros((2, 32), bool))
    >>> _, metrics = jax.eval_shape(make_train_step(detector, optimizer), state, batch)
    >>> metrics["loss/total"].shape, metrics["positives_per_level"].shape
    ((), (6,))
    """
    config, sensor = detector.config, detector.sensor
    gradient = make_gradient(detector)
    update = optax.with_extra_args_support(optimizer).update  # type: ignore[arg-type]
    decay = config.optimizer.ema_decay

    def augmented(state: TrainState, batch: Batch) -> Batch:
        if config.augment is None:
            return batch
        augment_one = functools.partial(augment, config=config.augment, origin_m=sensor.origin_m)
        size = batch.points.shape[0]
        index = device_index() * size + jnp.arange(size, dtype=jnp.int32)
        keys = jax.vmap(lambda i: sample_key(state.key, state.step, i))(index)
        points, boxes = jax.vmap(augment_one)(keys, batch.points, batch.boxes)
        return dataclasses.replace(batch, points=points, boxes=boxes)

    def step(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        # JAX refuses different numbers of samples, but would clamp the index of a box.
        check_rows(batch.boxes.shape[1], labels=batch.labels[0], box_valid=batch.box_valid[0])
        batch = augmented(state, batch)
        grads, batch_stats, metrics = gradient(state.params, state.batch_stats, batch)
        part = trainable(state.params, config)
        updates, opt_state = update(grads, state.opt_state, part, value=metrics["loss/total"])
        params = state.params | optax.apply_updates(part, updates)
        # The norm of one vector, as in the optimizer: a norm per leaf takes hundreds of small programs to compile.
        metrics["gradient_norm"] = optax.tree.norm(ravel_pytree(grads)[0])
        metrics.update(current_hyperparameters(opt_state))
        ema = state.ema
        if ema is not None:
            # EMA warm-up: a slow mean would retain the random initial weights.
            kept = jnp.minimum(decay, (1 + state.step) / (10 + state.step)).astype(jnp.float32)
            ema = jax.tree.map(lambda old, new: old + (1 - kept.astype(old.dtype)) * (new - old), ema, params)
        return TrainState(state.step + 1, params, batch_stats, opt_state, ema, state.key), metrics

    return step


def detection_variables(state: TrainState) -> dict[str, Any]:
    """Variables for detection: batch statistics, and the running mean of the weights if there is one."""
    return {"params": state.params if state.ema is None else state.ema, "batch_stats": state.batch_stats}

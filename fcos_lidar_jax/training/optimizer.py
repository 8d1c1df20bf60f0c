"""AdamW with one-cycle schedules of learning rate and momentum (paper, section 4)."""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from fcos_lidar_jax.config import OptimizerConfig

_FIXED = ("b2", "eps", "eps_root", "mu_dtype", "weight_decay", "mask", "nesterov")
"""Arguments of AdamW that are not stored in the state."""


def learning_rate_schedule(config: OptimizerConfig, num_steps: int) -> optax.Schedule:
    """Cosine schedule: up from a fraction of the peak during the warm-up, then down towards the final rate.

    The final rate belongs to step ``num_steps``, so the last update, the step before, has a slightly higher rate.

    >>> schedule = learning_rate_schedule(OptimizerConfig(), 1000)
    >>> [f"{float(schedule(step)):.1e}" for step in (0, 200, 400, 999, 1000)]
    ['1.0e-03', '5.5e-03', '1.0e-02', '1.7e-07', '1.0e-07']
    """
    return optax.cosine_onecycle_schedule(
        num_steps,
        config.peak_learning_rate,
        pct_start=config.warmup_fraction,
        div_factor=config.initial_divisor,
        final_div_factor=config.final_divisor,
    )


def momentum_schedule(config: OptimizerConfig, num_steps: int) -> optax.Schedule:
    """Cosine schedule of AdamW's b1: from high to low while the learning rate rises, then back.

    >>> schedule = momentum_schedule(OptimizerConfig(), 1000)
    >>> [round(float(schedule(step)), 3) for step in (0, 200, 400, 1000)]
    [0.95, 0.9, 0.85, 0.95]
    """
    low, high = config.b1_range
    turn = int(config.warmup_fraction * num_steps)
    return optax.piecewise_interpolate_schedule("cosine", high, {turn: low / high, num_steps: high / low})


def make_optimizer(config: OptimizerConfig, num_steps: int) -> optax.GradientTransformation:
    """Global-norm clipping, then AdamW with weight decay on all parameters, for a run of ``num_steps`` updates."""
    adamw = optax.inject_hyperparams(optax.adamw, static_args=_FIXED, hyperparam_dtype=jnp.float32)
    chain = optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm),
        adamw(
            learning_rate=learning_rate_schedule(config, num_steps),
            b1=momentum_schedule(config, num_steps),
            b2=config.b2,
            weight_decay=config.weight_decay,
        ),
    )
    # One vector of all leaves gives the same numbers and halves the compile time of a step.
    return optax.flatten(chain)


def current_hyperparameters(opt_state: Any) -> dict[str, Any]:
    """Hyperparameters of the last update, from every ``optax.inject_hyperparams`` in the state of an optimizer.

    Names begin with the keys of the dicts around them, such as the labels of ``optax.partition``.
    """
    nodes = jax.tree.leaves_with_path(opt_state, is_leaf=lambda node: hasattr(node, "hyperparams"))
    return {
        "/".join([*(key.key for key in path if isinstance(key, jax.tree_util.DictKey)), name]): value
        for path, node in nodes
        for name, value in getattr(node, "hyperparams", {}).items()
    }

"""Sums over devices for code under ``jax.pmap`` or ``jax.shard_map``, where a program sees its part of the batch.

Under ``jax.jit`` a program sees the global batch, and all functions here are identities.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

_Tree = TypeVar("_Tree")


def mapped_axes() -> tuple[str, ...]:
    """Names of the device axes of ``jax.pmap`` or ``jax.shard_map`` around the caller; empty outside of both."""
    return tuple(jax.sharding.get_abstract_mesh().manual_axes)


def device_index() -> Array | int:
    """Position of the device along the mapped axes; 0 outside of a map."""
    axes = mapped_axes()
    return lax.axis_index(axes) if axes else 0


def sum_over_devices(tree: _Tree) -> _Tree:
    """Add the leaves of a tree over the mapped axes.

    >>> jax.pmap(lambda x: sum_over_devices(x), devices=jax.devices()[:1])(jnp.ones((1, 2)))
    Array([[1., 1.]], dtype=float32)
    """
    axes = mapped_axes()
    return lax.psum(tree, axes) if axes else tree


def varying(tree: _Tree) -> _Tree:
    """Mark replicated leaves as device-varying, so that each device computes its own gradient.

    Without the mark, ``jax.shard_map`` adds up the gradients of replicated leaves by itself, unlike ``jax.pmap``.
    """
    axes = mapped_axes()
    return lax.pcast(tree, axes, to="varying") if axes else tree


def mean_over_devices(x: Array, axis: tuple[int, ...], where: Array | None = None) -> Array:
    """Mean over array axes and all devices of the values that ``where`` selects, by default all.

    >>> float(mean_over_devices(jnp.array([1.0, 3.0, 9.0]), (0,), where=jnp.array([True, True, False])))
    2.0
    """
    if not mapped_axes():
        return x.mean(axis, where=where)
    number = jnp.ones_like(x) if where is None else jnp.broadcast_to(where, x.shape).astype(x.dtype)
    return sum_over_devices(x.sum(axis, where=where)) / sum_over_devices(number.sum(axis))

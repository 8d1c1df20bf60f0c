"""Data parallelism: the batch is split over a mesh of devices, and the state is replicated.

The step is written for the global batch. Under ``jit``, sums and batch statistics cover all devices, so results
depend on the number of devices only by rounding. Under ``pmap`` and ``shard_map``, the functions of
:mod:`fcos_lidar_jax.collectives` in the step add them up.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

Tree = TypeVar("Tree")
Step = Callable[[Any, Any], tuple[Any, Any]]
"""A training step: ``(state, batch) -> (state, metrics)``."""

_AXIS = "data"


def make_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """Create a mesh with one axis, by default over all devices of all processes."""
    devices = jax.devices() if devices is None else devices
    return jax.make_mesh((len(devices),), (_AXIS,), axis_types=(AxisType.Auto,), devices=devices)


def replicate(tree: Tree, mesh: Mesh) -> Tree:
    """Copy arrays to every device; all processes must pass the same values.

    The arguments stay valid when the copies are donated.
    """
    everywhere = NamedSharding(mesh, PartitionSpec())

    def place(leaf: Any) -> jax.Array:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(place(jax.random.key_data(leaf)), impl=jax.random.key_impl(leaf))
        host = np.asarray(leaf)
        # In new memory, because the step donates the result.
        return jax.make_array_from_callback(host.shape, everywhere, lambda index: host[index].copy())

    return jax.tree.map(place, tree)


def shard_batch(batch: Tree, mesh: Mesh) -> Tree:
    """Split a batch along its first axis; each process passes its own rows of the global batch, in order.

    Raises:
        ValueError: the devices of this process cannot share the rows evenly.
    """
    sharding = NamedSharding(mesh, PartitionSpec(_AXIS))
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(sharding, np.asarray(leaf)), batch)


def jit_step(step: Step, mesh: Mesh) -> Step:
    """Compile a step for a mesh; the buffers of the state are donated.

    >>> step = jit_step(lambda state, batch: (state + batch.sum(), {"count": batch.size}), mesh := make_mesh())
    >>> state, metrics = step(replicate(np.float32(1), mesh), shard_batch(np.ones((4 * mesh.size, 2)), mesh))
    >>> float(state) == 1 + 8 * mesh.size
    True
    """
    everywhere = NamedSharding(mesh, PartitionSpec())
    return jax.jit(step, donate_argnums=0, out_shardings=(everywhere, everywhere))


def pmap_step(step: Step, mesh: Mesh) -> Callable[[Any, Any], Any]:
    """Map a step over the devices of a mesh with ``jax.pmap``; the buffers of the state are donated.

    State, batch and results have a leading axis with one entry per device. The step must reduce over the mapped
    axis, like the step of :func:`fcos_lidar_jax.training.make_train_step`. New code should use :func:`jit_step`.

    >>> from fcos_lidar_jax.collectives import sum_over_devices
    >>> def step(state, batch):
    ...     return state + sum_over_devices(batch.sum()), {}
    >>> mesh = make_mesh()
    >>> state, _ = pmap_step(step, mesh)(np.ones(mesh.size, np.float32), np.ones((mesh.size, 3), np.float32))
    >>> bool((state == 1 + 3 * mesh.size).all())
    True
    """
    return jax.pmap(step, axis_name=_AXIS, devices=list(mesh.devices.flat), donate_argnums=0)

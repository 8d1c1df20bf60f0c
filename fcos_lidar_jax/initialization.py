"""Initial weights of networks, which compile few programs."""

import math
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.extend.core import Literal, jaxpr_as_fun
from jaxtyping import Array


def normal(key: Array, shape: Sequence[int], stddev: Any) -> Array:
    """``stddev * jax.random.normal(key, shape)``, bit-identical.

    Compiled for powers of four instead of every shape, since XLA takes tenths of a second to compile each.
    """
    size = math.prod(shape)
    drawn = jax.random.normal(key, (4 ** (-(-(size - 1).bit_length() // 2)),)) * stddev
    return drawn[:size].reshape(shape)


def kernel_init(key: Array, shape: Sequence[int]) -> Array:
    """He initialisation over the outputs, as in ResNet."""
    return normal(key, shape, jnp.sqrt(jnp.float32(2.0 / math.prod((*shape[:-2], shape[-1])))))


def init_variables(network: nn.Module, key: Any, inputs: Any) -> Any:
    """``network.init(key, inputs, train=False)`` without the forward pass, bit-identical.

    Flax's ``lazy_init`` also runs the operations of the forward pass on parameters only, and compiles hundreds of
    small programs for them. Here, only the operations on which a variable depends run.

    Args:
        inputs: shapes and dtypes of the network's input.
    """

    def init(key: Any) -> Any:
        return network.init(key, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), inputs), train=False)

    program, shapes = jax.make_jaxpr(init, return_shape=True)(key)
    needed, kept = {x for x in program.jaxpr.outvars if not isinstance(x, Literal)}, []
    for operation in reversed(program.jaxpr.eqns):
        if needed.intersection(operation.outvars):
            kept.insert(0, operation)
            needed.update(x for x in operation.invars if not isinstance(x, Literal))
    program = program.replace(jaxpr=program.jaxpr.replace(eqns=kept))
    return jax.tree.unflatten(jax.tree.structure(shapes), jaxpr_as_fun(program)(*jax.tree.leaves(key)))

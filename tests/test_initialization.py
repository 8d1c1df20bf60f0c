"""Initial weights equal those of the libraries."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fcos_lidar_jax.initialization import init_variables, kernel_init, normal
from fcos_lidar_jax.models import layers


@pytest.mark.parametrize("shape", [(3, 3, 5, 7), (1,), (4, 16)])
def test_random_weights_equal_the_librarys(shape):
    key = jax.random.key(7)
    np.testing.assert_array_equal(normal(key, shape, 0.01), jax.random.normal(key, shape) * 0.01)
    he = nn.initializers.variance_scaling(2.0, "fan_out", "normal")
    if len(shape) > 1:
        np.testing.assert_array_equal(kernel_init(key, shape), he(key, shape))
        assert float(jnp.std(kernel_init(key, (3, 3, 64, 64)))) == pytest.approx((2 / 576) ** 0.5, rel=0.02)


def test_variables_equal_those_of_flax_without_its_forward_pass():
    class Small(nn.Module):
        @nn.compact
        def __call__(self, x, *, train):
            x = layers.Conv(4, use_bias=True)(x)
            (x,) = layers.BatchNorm()([x], train=train)
            kernel = self.param("kernel", lambda key: jax.random.normal(key, (4, 4)))
            jax.debug.callback(lambda: ran.append(1))
            return x @ (kernel * 2.0)

    ran = []
    shape, key = jax.ShapeDtypeStruct((1, 8, 8, 3), jnp.float32), jax.random.key(5)
    variables = init_variables(Small(), key, shape)
    jax.effects_barrier()
    assert not ran
    expected = Small().init(key, jnp.zeros(shape.shape), train=False)
    jax.tree.map(np.testing.assert_array_equal, variables, expected)
    compiled = jax.jit(lambda key: init_variables(Small(), key, shape))(key)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-9), compiled, expected)

"""Sums over mapped devices against NumPy, on two devices and without a map."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import run_python

from fcos_lidar_jax.collectives import device_index, mapped_axes, mean_over_devices, sum_over_devices, varying


def test_all_are_identities_without_mapped_devices():
    tree = {"a": jnp.arange(3.0), "b": jnp.int32(2)}
    for function in (sum_over_devices, varying):
        for run in (
            function,
            jax.jit(function),
            jax.vmap(function, in_axes=({"a": 0, "b": None},), axis_name="v"),
        ):
            out = run(tree)
            np.testing.assert_array_equal(out["a"], tree["a"])
    assert (mapped_axes(), device_index()) == ((), 0)


@pytest.mark.parametrize("masked", [False, True])
def test_the_mean_is_that_of_numpy_with_a_finite_gradient(masked):
    x = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    where = jnp.array([True, False, True, True])[:, None] if masked else None
    expected = np.mean(x, axis=0, where=True if where is None else np.broadcast_to(where, x.shape))
    np.testing.assert_allclose(mean_over_devices(jnp.asarray(x), (0,), where), expected, rtol=1e-6)
    gradient = jax.grad(lambda x: mean_over_devices(x, (0,), where).sum())(jnp.asarray(x))
    assert np.isfinite(gradient).all()


TWO = """
import jax, jax.numpy as jnp, numpy as np
from fcos_lidar_jax.collectives import device_index, mapped_axes, mean_over_devices, sum_over_devices, varying
x = np.random.default_rng(0).normal(size=(2, 5, 3)).astype(np.float32)
where = np.array([[True, False, True, True, False], [False] * 5])[..., None]  # nothing on the second device
every = lambda f, *args: np.asarray(jax.pmap(f, axis_name="x")(*args))
assert (every(lambda x: device_index() + 0 * x[0, 0].astype(int), x) == [0, 1]).all()
np.testing.assert_array_equal(every(sum_over_devices, x), np.stack([x[0] + x[1]] * 2))
mean = x.reshape(10, 3).mean(0)
np.testing.assert_allclose(every(lambda x: mean_over_devices(x, (0,)), x), np.stack([mean] * 2), rtol=1e-5)
mean = x[0][where[0, :, 0]].mean(0)
found = every(lambda x, where: mean_over_devices(x, (0,), where), x, where)
np.testing.assert_allclose(found, np.stack([mean] * 2), rtol=1e-5)
mesh = jax.make_mesh((2,), ("x",), axis_types=(jax.sharding.AxisType.Auto,))
def gradient(w, part):  # the gradient of a replicated value, added up once
    return sum_over_devices(jax.grad(lambda w: (w * part).sum())(varying(w)))
for check in (True, False):
    P = jax.sharding.PartitionSpec
    mapped = jax.shard_map(gradient, mesh=mesh, in_specs=(P(), P("x")), out_specs=P(), check_vma=check)
    np.testing.assert_allclose(mapped(jnp.float32(1), x), x.sum(), rtol=1e-5)
"""


@pytest.mark.slow
def test_sums_means_and_gradients_on_two_devices():
    done = run_python("-c", TWO, JAX_NUM_CPU_DEVICES="2")
    assert done.returncode == 0, done.stderr[-2000:]

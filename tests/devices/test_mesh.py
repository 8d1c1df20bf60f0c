"""Data parallelism on one or two devices; tests/equivalence and test_own_loop.py compare several."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import run_python

from fcos_lidar_jax.devices.mesh import jit_step, make_mesh, replicate, shard_batch


@pytest.fixture
def mesh():
    return make_mesh(jax.devices()[:1])


def tree():
    return {"w": np.arange(6, dtype=np.float32).reshape(2, 3), "step": jnp.int32(3), "key": jax.random.key(5)}


def toy_step(state, batch):
    return {**state, "w": state["w"] + batch["x"].sum(axis=0)}, {}


@pytest.mark.parametrize("convert", [np.asarray, jnp.asarray])
def test_a_step_donates_replicated_copies_and_leaves_the_originals(mesh, convert):
    original = {**tree(), "w": convert(tree()["w"])}
    placed = replicate(original, mesh)
    for name in ("w", "step"):
        np.testing.assert_array_equal(placed[name], original[name])
        assert placed[name].dtype == original[name].dtype
        assert placed[name].sharding.is_fully_replicated
    assert placed["key"].dtype == original["key"].dtype
    assert jax.random.uniform(placed["key"]) == jax.random.uniform(original["key"])
    jit_step(toy_step, mesh)(placed, shard_batch({"x": np.ones((4, 3), np.float32)}, mesh))
    assert placed["w"].is_deleted()
    np.testing.assert_array_equal(original["w"], tree()["w"])


@pytest.mark.slow
def test_two_devices_share_a_batch_and_own_what_they_are_given():
    code = (
        "import jax, numpy as np, test_mesh as t; mesh = t.make_mesh(); assert mesh.size == 2; "
        "x = t.shard_batch({'x': np.arange(12.).reshape(4, 3)}, mesh)['x']; "
        "assert [s.data.shape for s in x.addressable_shards] == [(2, 3)] * 2; "
        "np.testing.assert_array_equal(x, np.arange(12).reshape(4, 3)); "
        "add = jax.jit(lambda w: w + 1, donate_argnums=0); "
        "x = np.zeros(10**5, np.float32); placed = [add(t.replicate({'w': x}, mesh)['w']) for _ in range(20)]; "
        "assert all((np.asarray(s.data) == 1).all() for p in placed for s in p.addressable_shards) and not x.any()"
    )
    done = run_python("-c", code, JAX_NUM_CPU_DEVICES="2")
    assert done.returncode == 0, done.stderr[-2000:]

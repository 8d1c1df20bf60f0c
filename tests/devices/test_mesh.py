"""Data parallelism on one or two devices; tests/equivalence compares one with eight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import run_python

from fcos_lidar_jax.collectives import sum_over_devices
from fcos_lidar_jax.devices.mesh import jit_step, make_mesh, pmap_step, replicate, shard_batch


@pytest.fixture
def mesh():
    return make_mesh(jax.devices()[:1])


def tree():
    return {"w": np.arange(6, dtype=np.float32).reshape(2, 3), "step": jnp.int32(3), "key": jax.random.key(5)}


def toy_step(state, batch):
    """Sums over the whole batch; the state keeps its structure."""
    noise = jax.random.uniform(jax.random.fold_in(state["key"], state["step"]))
    columns = sum_over_devices(batch["x"].sum(axis=0))
    new = {"w": state["w"] + columns + noise, "step": state["step"] + 1, "key": state["key"]}
    return new, {"total": columns.sum(), "per_level": columns.astype(jnp.int32)}


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


def check_pmap_form(mesh) -> None:
    """Two steps of the pmap form equal two steps of the jit form."""
    rng = np.random.default_rng(0)
    state = replicate(tree(), mesh)
    stacked = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (mesh.size, *leaf.shape)), tree())
    by_jit, by_pmap = jit_step(toy_step, mesh), pmap_step(toy_step, mesh)
    for _ in range(2):
        batch = {"x": rng.normal(size=(4, 3)).astype(np.float32)}
        state, metrics = by_jit(state, shard_batch(batch, mesh))
        stacked, stacked_metrics = by_pmap(stacked, {"x": batch["x"].reshape(mesh.size, -1, 3)})
        for i in range(mesh.size):
            np.testing.assert_array_equal(stacked["w"][i], state["w"])
            for name, value in metrics.items():
                np.testing.assert_array_equal(stacked_metrics[name][i], value)
        assert stacked["w"].shape == (mesh.size, 2, 3)


@pytest.mark.slow
def test_two_devices_share_a_batch_in_both_forms():
    code = (
        "import jax, numpy as np, test_mesh as t; mesh = t.make_mesh(); assert mesh.size == 2; "
        "t.check_pmap_form(mesh); "
        "x = t.shard_batch({'x': np.arange(12.).reshape(4, 3)}, mesh)['x']; "
        "assert [s.data.shape for s in x.addressable_shards] == [(2, 3)] * 2; "
        "np.testing.assert_array_equal(x, np.arange(12).reshape(4, 3)); "
        "add = jax.jit(lambda w: w + 1, donate_argnums=0); "
        "x = np.zeros(10**5, np.float32); placed = [add(t.replicate({'w': x}, mesh)['w']) for _ in range(20)]; "
        "assert all((np.asarray(s.data) == 1).all() for p in placed for s in p.addressable_shards) and not x.any()"
    )
    done = run_python("-c", code, JAX_NUM_CPU_DEVICES="2")
    assert done.returncode == 0, done.stderr[-2000:]

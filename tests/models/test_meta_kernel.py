"""The Meta-Kernel: its definition in loops, its borders, and its place in the network."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_run import CONFIG, SENSOR

from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.models.layers import EPSILON
from fcos_lidar_jax.models.meta_kernel import Geometry, MetaKernel, geometry_of
from fcos_lidar_jax.types import CHANNELS

SHAPE = (2, 4, 5)


def given(seed: int = 0):
    """An image of three channels and its geometry, with gaps."""
    rng = np.random.default_rng(seed)
    exists = rng.random((*SHAPE, 1)) < 0.7
    points = np.where(exists, rng.uniform(-30, 30, (*SHAPE, 3)), 0)
    arrays = rng.normal(size=(*SHAPE, 3)), points, exists
    x, points, exists = (jnp.asarray(array, jnp.float32) for array in arrays)
    return x, Geometry(points, exists)


def variables_of(module, x, geometry, seed: int = 1):
    shapes = jax.eval_shape(lambda: module.init(jax.random.key(0), x, geometry, train=False))
    rng = np.random.default_rng(seed)
    params = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(0, 0.3, leaf.shape), jnp.float32), shapes["params"])
    stats = jax.tree.map(
        lambda leaf: jnp.asarray(rng.uniform(0.5, 2, leaf.shape), jnp.float32), shapes["batch_stats"]
    )
    return {"params": params, "batch_stats": stats}


def by_loops(variables, x, geometry, *, circular: bool):
    """The definition, pixel by pixel."""
    p, norm = (jax.tree.map(lambda a: np.asarray(a, np.float64), variables[k]) for k in ("params", "batch_stats"))
    x, points, exists = (np.asarray(a, np.float64) for a in (x, *geometry))
    height, width = x.shape[1:3]
    out = np.zeros((*x.shape[:3], p["kernel"].shape[-1]))
    for b, i, j in np.ndindex(*x.shape[:3]):
        for di, dj in np.ndindex(3, 3):
            row, column = i + di - 1, j + dj - 1
            if circular:
                column %= width
            if not (0 <= row < height and 0 <= column < width and exists[b, i, j] and exists[b, row, column]):
                continue
            offset = points[b, row, column] - points[b, i, j]
            hidden = np.maximum(offset @ p["hidden"] + p["hidden_bias"], 0)
            weight = hidden @ p["weigh"] + p["weigh_bias"]
            out[b, i, j] += (weight * x[b, row, column]) @ p["kernel"][di, dj]
    norm, affine = norm["norm"], p["norm"]
    out = (out - norm["mean"]) / np.sqrt(norm["var"] + EPSILON) * affine["scale"] + affine["bias"]
    return np.maximum(out, 0)


@pytest.mark.parametrize("circular", [False, True])
def test_it_is_its_definition_in_loops_also_under_jit_and_vmap(circular):
    module, (x, geometry) = MetaKernel(4, circular), given()
    variables = variables_of(module, x, geometry)
    expected = by_loops(variables, x, geometry, circular=circular)

    def apply(x, geometry):
        return module.apply(variables, x, geometry, train=False)

    np.testing.assert_allclose(apply(x, geometry), expected, rtol=2e-4, atol=1e-4)
    np.testing.assert_allclose(jax.jit(apply)(x, geometry), expected, rtol=2e-4, atol=1e-4)
    one = jax.tree.map(lambda array: array[:, None], (x, geometry))
    np.testing.assert_allclose(jax.vmap(apply)(*one)[:, 0], expected, rtol=2e-4, atol=1e-4)
    assert (expected > 0).any()


def test_gradients_are_finite_where_no_point_is_and_where_all_are_one():
    module, (x, geometry) = MetaKernel(4), given()
    variables = variables_of(module, x, geometry)
    empty = jax.tree.map(jnp.zeros_like, geometry)
    same = Geometry(jnp.ones_like(geometry.points), jnp.ones_like(geometry.exists))

    def loss(params, x, geometry):
        stats = {"batch_stats": variables["batch_stats"]}
        y, _ = module.apply({"params": params, **stats}, x, geometry, train=True, mutable=["batch_stats"])
        return jnp.square(y).sum()

    for where in (empty, same):
        gradients = jax.grad(loss, argnums=(0, 1))(variables["params"], x, where)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))


def test_the_geometry_is_that_of_the_first_round_in_metres():
    rounds, scale = 2, tuple(range(2, 11))
    image = np.random.default_rng(0).normal(size=(1, 2, 3, 9, rounds)).astype(np.float32)
    geometry = geometry_of(jnp.asarray(image.reshape(1, 2, 3, -1)), scale)
    places = [CHANNELS.index(name) for name in ("x", "y", "z")]
    metres = [image[..., place, 0] * scale[place] for place in places]
    np.testing.assert_array_equal(geometry.points, np.stack(metres, axis=-1))
    np.testing.assert_array_equal(geometry.exists[..., 0], image[..., 7, 0] > 0)


def test_in_bfloat16_it_differs_by_rounding():
    module, (x, geometry) = MetaKernel(4), given()
    variables = variables_of(module, x, geometry)
    found = module.apply(variables, x.astype(jnp.bfloat16), geometry, train=False)
    assert found.dtype == jnp.bfloat16
    expected = np.asarray(module.apply(variables, x, geometry, train=False))
    np.testing.assert_allclose(found.astype(jnp.float32), expected, rtol=0, atol=0.02 * expected.max())


def test_positions_are_multiplied_in_full_float32_precision():
    """On GPUs and TPUs the default has fewer bits, too few for differences of positions."""
    module, (x, geometry) = MetaKernel(4), given()
    variables = variables_of(module, x, geometry)
    lowered = jax.jit(lambda x, g: module.apply(variables, x, g, train=False)).lower(x, geometry).as_text()
    products = [line for line in lowered.splitlines() if "dot_general" in line]
    assert sum("HIGHEST" in line for line in products) == 1
    assert all("x3xf32>, tensor<3x3xf32>" in line for line in products if "HIGHEST" in line)


def test_with_remat_the_network_gives_the_same_loss_and_gradients():
    model = dataclasses.replace(CONFIG.model, meta_kernel=True)
    image = np.zeros((1, SENSOR.num_rows, SENSOR.num_columns, 9, CONFIG.projection.num_rounds), np.float32)
    image[..., 7, :] = 1
    image[..., :3, :] = np.random.default_rng(0).uniform(-10, 10, image[..., :3, :].shape)
    found = []
    for remat in (False, True):
        config = dataclasses.replace(CONFIG, model=dataclasses.replace(model, remat=remat))
        detector = build_detector(config, SENSOR)
        variables = detector.init(jax.random.key(0))
        assert "meta_kernel" in variables["params"]["backbone"]["stage0_block0"]

        def loss(params, detector=detector, stats=variables["batch_stats"]):
            outputs, _ = detector.apply({"params": params, "batch_stats": stats}, jnp.asarray(image), train=True)
            return jnp.square(outputs.logits).sum()

        found.append(jax.jit(jax.value_and_grad(loss))(variables["params"]))
    for one, other in zip(*(jax.tree.leaves(values) for values in found), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3 * float(np.abs(one).max()))

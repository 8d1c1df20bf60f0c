"""Forms of the network that save memory: their outputs and gradients are those of the plain one."""

import dataclasses
import functools
import os
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_run

from fcos_lidar_jax.models import build_detector


@functools.cache
def forward_and_backward(**model):
    """Outputs, statistics and gradient of a variant of the tiny network, and the bytes kept for the gradient."""
    config = dataclasses.replace(tiny_run.CONFIG, model=dataclasses.replace(tiny_run.CONFIG.model, **model))
    detector, variables = build_detector(config, tiny_run.SENSOR), tiny_run.weights()
    batch = tiny_run.host_batch()
    images = jax.jit(jax.vmap(detector.prepare))(batch.points, batch.valid)

    def loss(params):
        outputs, statistics = detector.apply({**variables, "params": params}, images, train=True)
        return jnp.square(outputs.logits).mean() + jnp.square(outputs.regression).mean(), (outputs, statistics)

    gradient, (outputs, statistics) = jax.jit(jax.grad(loss, has_aux=True))(variables["params"])
    kept = jax.eval_shape(lambda params: jax.vjp(loss, params, has_aux=True)[1], variables["params"])
    found = jax.tree.map(np.asarray, {"outputs": outputs, "statistics": statistics, "gradient": gradient})
    return found, sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(kept))


@pytest.mark.slow
def test_remat_changes_what_is_kept_for_the_backward_pass_and_nothing_else():
    """Outputs and statistics are equal to the bit, gradients up to rounding; half as much is kept."""
    (plain, kept), (remat, kept_less) = forward_and_backward(), forward_and_backward(remat=True)
    if len(os.sched_getaffinity(0)) > 1:  # On one core, XLA rounds the two programs differently.
        for name in ("outputs", "statistics"):
            jax.tree.map(np.testing.assert_array_equal, plain[name], remat[name])
    assert jax.tree.structure(plain) == jax.tree.structure(remat)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(remat), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * np.abs(a).max())
    assert kept_less < 0.6 * kept


@pytest.mark.slow
def test_bfloat16_stays_inside_the_network_and_close_to_float32():
    """What goes in and comes out is float32, forwards and backwards. A number of eight bits is wrong by 0.2 % in
    the mean, ten layers of them by less than ten times that. The gradients of random weights are off by more, most
    in the first layers: those of the whole and of every part point the same way, and are as long."""
    (exact, _), (rough, _) = forward_and_backward(), forward_and_backward(precision="bfloat16")
    assert {leaf.dtype.name for leaf in jax.tree.leaves(rough)} == {"float32"}

    def flat(tree):
        return np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(tree)])

    for name in ("outputs", "statistics"):
        a, b = flat(exact[name]), flat(rough[name])
        error = np.linalg.norm(a - b) / np.linalg.norm(a)
        assert 1e-5 < error < 0.02, (name, error)
    a, b = flat(exact["gradient"]), flat(rough["gradient"])
    assert a @ b > 0.9 * np.linalg.norm(a) * np.linalg.norm(b)
    least = {"stem": 0.8, "backbone": 0.97, "fpn": 0.98, "heads": 0.999}
    for part, cosine in least.items():
        a, b = flat(exact["gradient"][part]), flat(rough["gradient"][part])
        assert a @ b > cosine * np.linalg.norm(a) * np.linalg.norm(b), part
        assert 0.9 < np.linalg.norm(b) / np.linalg.norm(a) < 1.1, part


def test_positions_are_taken_in_full_float32_precision_on_every_platform():
    """On GPUs and TPUs the default has fewer bits: x at 50 m would come in steps of centimetres or more.

    What that costs the predictions, which count from the points, is in ``tests/inference/test_rounding.py``.
    """
    detector = build_detector(tiny_run.CONFIG, tiny_run.SENSOR)
    variables = jax.eval_shape(detector.init, jax.random.key(0))
    image = jax.ShapeDtypeStruct((1, tiny_run.SENSOR.num_rows, tiny_run.SENSOR.num_columns, 9, 1), np.float32)
    image = jax.eval_shape(tiny_run.images_of, image)
    program = jax.jit(lambda v, x: detector.apply(v, x, train=False)).lower(variables, image).as_text()
    lines = [line for line in program.splitlines() if "stablehlo.convolution" in line]
    kernels = [(re.findall(r"3x3x\d+x(\d+)xf32>\)", line), "HIGHEST" in line) for line in lines]
    full = sorted(int(found[0]) for found, highest in kernels if highest)
    assert full == [18]  # The stem's first layer.
    assert sum(not highest for _, highest in kernels) > 20

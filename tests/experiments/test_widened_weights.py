"""Weights for a larger network: it detects the same, and all of its parameters learn."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_run import CONFIG, SENSOR, images_of

from experiments.studies.widened_weights import widened
from fcos_lidar_jax.models import build_detector

MODEL = dataclasses.replace(CONFIG.model, local_geometry=True, backbone_widths=(4, 4, 4, 4))
LARGER = dataclasses.replace(
    MODEL,
    stem=dataclasses.replace(MODEL.stem, out_channels=12),
    backbone_blocks=(2, 1, 1, 1),
    backbone_widths=(6, 4, 4, 8),
    fpn_channels=10,
    head_channels=12,
)
SMALL, LARGE = (build_detector(dataclasses.replace(CONFIG, model=model), SENSOR) for model in (MODEL, LARGER))


def drawn(detector, seed):
    """Random variables; statistics and norms are not those of an untrained network either."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda leaf: np.asarray(leaf) + rng.uniform(0.1, 0.5, leaf.shape).astype(np.float32),
        detector.init(jax.random.key(seed)),
    )


@pytest.fixture(scope="module")
def both():
    old = drawn(SMALL, 0)
    return jax.tree.map(jnp.asarray, (old, widened(old, LARGE.init(jax.random.key(1)))))


@pytest.fixture(scope="module")
def images():
    features = np.random.default_rng(2).normal(size=(2, SENSOR.num_rows, SENSOR.num_columns, 9, 1))
    return images_of(jnp.asarray(features, jnp.float32).at[..., 7, :].set(1.0))


def test_the_larger_network_predicts_the_same(both, images):
    old, new = (
        detector.apply(variables, images)[0] for detector, variables in zip((SMALL, LARGE), both, strict=True)
    )
    for own, other in zip(*map(jax.tree.leaves, (old, new)), strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-3, atol=1e-3 * np.abs(own).max())


def test_every_new_array_changes_the_larger_network_or_learns(both, images):
    """New channels are ignored at first by weights of zero, which have a gradient."""
    _, variables = both

    def total(params):
        outputs, _ = LARGE.apply({**variables, "params": params}, images, train=True)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(outputs))

    gradients = jax.jit(jax.grad(total))(variables["params"])
    ignored = {
        jax.tree_util.keystr(path)
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradients)
        if not np.any(np.abs(leaf) > 0)
    }
    # The new block adds zero, so what it computes gets a gradient once its last scale has changed.
    assert all("stage0_block1" in name for name in ignored), ignored
    assert np.any(gradients["backbone"]["stage0_block1"]["expand"]["norm"]["scale"])


def test_a_smaller_network_is_refused(both):
    old, _ = both
    with pytest.raises(ValueError, match=r"linear1'\]: got \(32, 8\), expected at most \(32, 4\)"):
        widened(
            {"linear1": old["params"]["local_geometry"]["linear1"]}, {"linear1": np.zeros((32, 4), np.float32)}
        )
    with pytest.raises(ValueError, match=r"'more'.*not in the larger network"):
        widened({"more": np.zeros(2)}, {"other": np.zeros(2)})

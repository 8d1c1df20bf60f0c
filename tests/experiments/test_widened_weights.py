"""Weights for a larger network: it detects the same, and can learn to use its new channels."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_run import CONFIG, SENSOR, images_of

from experiments.studies import widened_weights
from experiments.studies.widened_weights import widened
from fcos_lidar_jax.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
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


@pytest.mark.slow
def test_the_larger_network_predicts_the_same(both, images):
    old, new = (
        detector.apply(variables, images)[0] for detector, variables in zip((SMALL, LARGE), both, strict=True)
    )
    for own, other in zip(*map(jax.tree.leaves, (old, new)), strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-3, atol=1e-3 * np.abs(own).max())


@pytest.mark.slow
def test_the_weights_that_ignore_new_channels_have_gradients(both, images):
    """Otherwise no new channel could ever be used."""
    old, variables = both

    def total(params):
        outputs, _ = LARGE.apply({**variables, "params": params}, images, train=True)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(outputs))

    gradients = jax.jit(jax.grad(total))(variables["params"])
    shapes = {path: leaf.shape for path, leaf in jax.tree_util.tree_leaves_with_path(old["params"])}
    checked = 0
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradients):
        if path not in shapes or leaf.ndim < 2 or leaf.shape[-2] == shapes[path][-2]:
            continue
        inputs, outputs = shapes[path][-2:]
        name = jax.tree_util.keystr(path)
        assert not np.any(variables_at(variables["params"], path)[..., inputs:, :outputs]), name
        assert np.all(np.any(leaf[..., inputs:, :outputs], axis=tuple(range(leaf.ndim - 2)))), name
        checked += 1
    assert checked > 20
    # The new block adds zero to the old channels.
    assert np.all(
        gradients["backbone"]["stage0_block1"]["expand"]["norm"]["scale"][: 4 * MODEL.backbone_widths[0]]
    )


def variables_at(tree, path):
    for key in path:
        tree = tree[key.key]
    return np.asarray(tree)


@pytest.mark.slow
def test_the_command_replaces_the_weights_only_if_they_predict_the_same(tmp_path, monkeypatch, capsys):
    config = dataclasses.replace(CONFIG, model=MODEL)
    before = Checkpoint(config, SENSOR, jax.tree.map(np.float16, drawn(SMALL, 3)), 5)
    save_checkpoint(tmp_path / "hdl32e", before)
    monkeypatch.setattr(widened_weights, "SHIPPED", tmp_path)
    wrong = dataclasses.replace(LARGER, stem=dataclasses.replace(LARGER.stem, channels_per_type=4))
    files = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    monkeypatch.setitem(widened_weights.CONFIGS, "hdl32e", dataclasses.replace(config, model=wrong))
    with pytest.raises(ValueError, match="hdl32e: the larger network predicts otherwise, by"):
        widened_weights.main(widened_weights.Args(name="hdl32e"))
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == files
    monkeypatch.setitem(widened_weights.CONFIGS, "hdl32e", dataclasses.replace(config, model=LARGER))
    widened_weights.main(widened_weights.Args(name="hdl32e"))
    after = load_checkpoint(tmp_path / "hdl32e")
    assert (after.step, after.config.model) == (5, LARGER)
    assert "parameters became" in capsys.readouterr().err


def test_a_smaller_network_is_refused(both):
    old, _ = both
    with pytest.raises(ValueError, match=r"linear1'\]: got \(32, 8\), expected at most \(32, 4\)"):
        widened(
            {"linear1": old["params"]["local_geometry"]["linear1"]}, {"linear1": np.zeros((32, 4), np.float32)}
        )
    with pytest.raises(ValueError, match=r"'more'.*not in the larger network"):
        widened({"more": np.zeros(2)}, {"other": np.zeros(2)})

"""The network: the stem is the paper's, locations are centred, variants and sizes are the paper's."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from tiny_run import CONFIG, SENSOR, images_of

from fcos_lidar_jax.config import ModelConfig, StemConfig
from fcos_lidar_jax.locations import STRIDES, image_layout
from fcos_lidar_jax.models import build_detector, count_parameters, layers
from fcos_lidar_jax.models import detector as module
from fcos_lidar_jax.models.detector import Network, network_input
from fcos_lidar_jax.models.fpn import FeaturePyramid
from fcos_lidar_jax.models.layers import BatchNorm, GroupNorm
from fcos_lidar_jax.models.lidar_net import Backbone
from fcos_lidar_jax.models.modality import Stem, channel_groups
from fcos_lidar_jax.presets import COMPACT, NUSCENES, NUSCENES_TEST, PRESETS, QUICKSTART
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, TINY
from fcos_lidar_jax.types import CHANNELS


def normal(seed: int, *shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def with_model(config, **changes):
    return dataclasses.replace(config, model=dataclasses.replace(config.model, **changes))


SMALL_STEM = StemConfig(channels_per_type=4, out_channels=8, dilations=(1, 2))


def test_images_and_groups_have_the_named_channels():
    number, rounds = len(CHANNELS), 5
    image = project_points(np.zeros((1, 5)), np.zeros(1, bool), TINY, num_rounds=1)
    assert image.features.shape[2] == number
    for groups in ("types", "modalities", "all"):
        assert sum(inputs for inputs, _ in channel_groups(StemConfig(groups=groups), rounds)) == number * rounds
    assert channel_groups(StemConfig(group_rounds=False, channels_per_type=5), rounds) == [(1, 1)] * (
        number * rounds
    )
    for preset in PRESETS.values():
        assert 9 <= len(preset.model.channel_mean) == len(preset.model.channel_scale) <= number


TEN = {
    "channel_mean": (*QUICKSTART.model.channel_mean, 0.5),
    "channel_scale": (*QUICKSTART.model.channel_scale, 0.3),
}


@pytest.mark.parametrize(
    ("changes", "first_kernels"),
    [
        ({"stem": SMALL_STEM}, 10),
        ({"stem": dataclasses.replace(SMALL_STEM, group_rounds=False)}, 20),
        ({"local_geometry": True, "round_offsets": True, "stem": SMALL_STEM}, 10),
    ],
)
def test_a_channel_of_your_own_takes_two_numbers_and_a_function(changes, first_kernels):
    """tests/training/test_own_loop.py trains with one."""
    config = with_model(CONFIG, **TEN, **changes)
    config = dataclasses.replace(config, projection=dataclasses.replace(config.projection, num_rounds=2))
    detector = build_detector(config, SENSOR)
    variables = jax.eval_shape(detector.init, jax.random.key(0))
    first = [name for name in variables["params"]["stem"]["branch0"] if name.startswith("conv0_")]
    assert len(first) == first_kernels
    cloud = jnp.zeros((1, 4, 5)), jnp.zeros((1, 4), bool)
    images = jax.eval_shape(jax.vmap(detector.prepare), *cloud)
    with pytest.raises(ValueError, match=r"^features: got \(1, 16, 64, 9, 2\), expected 10 channels, as in ch"):
        jax.eval_shape(detector.apply, variables, images)
    own = jax.ShapeDtypeStruct((*images.features.shape[:3], 10, 2), jnp.float32)
    outputs, _ = jax.eval_shape(detector.apply, variables, dataclasses.replace(images, features=own))
    assert outputs.logits.shape[-1] == len(CONFIG.classes) + 1


def test_a_detector_without_the_last_channel_still_runs(monkeypatch):
    """What a channel at the end of CHANNELS does to older checkpoints."""

    def with_another(*args, **options):
        image = project_points(*args, **options)
        return dataclasses.replace(image, features=jnp.pad(image.features, ((0, 0), (0, 0), (0, 1), (0, 0))))

    monkeypatch.setattr(module, "CHANNELS", (*CHANNELS, "own"))
    monkeypatch.setattr(module, "project_points", with_another)
    build = build_detector.__wrapped__
    for more, number in (({}, 9), (TEN, 10)):
        image = build(with_model(CONFIG, **more), SENSOR).prepare(jnp.zeros((4, 5)), jnp.zeros(4, bool))
        assert image.features.shape[2] == number


def fill(tree, seed: int = 0):
    """Parameters of an abstract tree: normal kernels, so that nothing cancels or vanishes."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape) * 0.1, leaf.dtype), tree)


def variables_of(module, *inputs):
    """Normal parameters and untouched statistics, without computing anything."""
    shapes = jax.eval_shape(lambda key: module.init(key, *inputs, train=False), jax.random.key(0))
    ones = jax.tree.map(lambda leaf: jnp.ones(leaf.shape), shapes["batch_stats"])
    zeros = jax.tree_util.tree_map_with_path(lambda path, leaf: leaf * (path[-1].key == "var"), ones)
    return {"params": fill(shapes["params"]), "batch_stats": zeros}


@functools.cache
def parameters(config, sensor=NUSCENES_HDL32E):
    return count_parameters(jax.eval_shape(build_detector(config, sensor).init, jax.random.key(0))["params"])


def stem_of_groups(params, image, config):
    """The stem by its definition: one library convolution per group."""
    layout = ("NHWC", "HWIO", "NHWC")

    def norm(x):
        return (x - x.mean((0, 1, 2))) / jnp.sqrt(x.var((0, 1, 2)) + layers.EPSILON)

    groups, merged = channel_groups(config, image.shape[-1] // 9), jnp.zeros(())
    for index, d in enumerate(config.dilations):
        branch = params[f"branch{index}"]
        features = jnp.split(image, np.cumsum([i for i, _ in groups])[:-1], axis=-1)
        ends = np.cumsum([o for _, o in groups])[:-1]
        for layer in range(config.num_convs):
            scales, biases = (jnp.split(branch[f"norm{layer}"][name], ends) for name in ("scale", "bias"))
            for g, x in enumerate(features):
                kernel, pad, dilation = branch[f"conv{layer}_group{g}"], [(d, d)] * 2, (d, d)
                x = lax.conv_general_dilated(x, kernel, (1, 1), pad, (1, 1), dilation, layout)
                features[g] = jax.nn.relu(norm(x) * scales[g] + biases[g])
        merged = merged + jnp.concatenate(features, axis=-1) @ params[f"merge{index}"]
    return jax.nn.relu(norm(merged) * params["norm"]["scale"] + params["norm"]["bias"])


@pytest.mark.parametrize(
    "choices",
    [
        {"num_convs": 2, "dilations": (2,)},
        {"num_convs": 1, "group_rounds": False, "dilations": (1,)},
        {"num_convs": 2, "groups": "modalities"},
    ],
)
def test_the_stem_convolves_each_group_separately(choices):
    config = dataclasses.replace(SMALL_STEM, channels_per_type=12, **choices)  # several bundles
    image = normal(0, 2, 6, 8, 18)
    params = variables_of(Stem(config), image)["params"]
    cotangent = np.asarray(normal(1, 2, 6, 8, 8))

    def value(params, image, stem):
        out = stem(params, image)
        return (out * cotangent).sum(), out

    def stem(params, image):
        return Stem(config).apply({"params": params}, image, train=True, mutable=["batch_stats"])[0]

    gradient = jax.jit(jax.value_and_grad(value, argnums=(0, 1), has_aux=True), static_argnums=2)
    with jax.enable_x64(True):  # in float32 a ReLU at its edge opens in one formulation and not in the other
        arguments = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, np.float64)), (params, image))
        (_, found), found_grads = gradient(*arguments, stem)
        (_, expected), expected_grads = gradient(*arguments, functools.partial(stem_of_groups, config=config))
        np.testing.assert_allclose(found, expected, atol=1e-12)
        for a, b in zip(jax.tree.leaves(found_grads), jax.tree.leaves(expected_grads), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-10 * float(np.abs(b).max() + 1))


def test_batch_norm_is_the_library_one_over_parts():
    x = normal(0, 3, 4, 5, 6) * 3 + 50
    library = nn.BatchNorm(use_running_average=False, momentum=0.9, epsilon=1e-5, use_fast_variance=False)
    variables = library.init(jax.random.key(0), x)
    expected, expected_stats = library.apply(variables, x, mutable=["batch_stats"])
    parts, stats = BatchNorm().apply(variables, [x[..., :2], x[..., 2:]], train=True, mutable=["batch_stats"])
    np.testing.assert_allclose(jnp.concatenate(parts, -1), expected, atol=1e-4)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), stats, expected_stats)


@pytest.mark.parametrize(("channels", "groups"), [(64, 32), (6, 3)])
def test_group_norm_is_the_library_one(channels, groups):
    x = normal(0, 2, 4, 6, channels) * 0.01 + 0.03  # of a small variance, which shows the epsilon
    library = nn.GroupNorm(num_groups=groups, epsilon=1e-5, use_fast_variance=False)
    params = fill(library.init(jax.random.key(0), x))
    np.testing.assert_allclose(GroupNorm().apply(params, x), library.apply(params, x), atol=1e-6)


def _averaging(tree):
    """Positive kernels that average and norms that do nothing: gradients show the receptive field."""

    def leaf(path, value):
        name = path[-1].key
        if name in ("bias", "mean") or name.endswith("_bias"):
            return jnp.zeros(value.shape)
        return jnp.full(value.shape, 1.0 if name in ("scale", "var") else 1 / np.prod(value.shape[:-1]))

    return jax.tree_util.tree_map_with_path(leaf, tree)


@pytest.fixture(scope="module")
def receptive_profiles():
    """Of an output of P2..P7 at pixel (128, 128), the gradient's profiles along both axes of the image.

    Two cases: through the level's own lateral alone, and through all of them.
    """
    size, centre = 256, 128
    stem = Stem(StemConfig(channels_per_type=1, out_channels=2))
    backbone = Backbone((2, 2, 1, 1), (1, 1, 1, 1))
    fpn = FeaturePyramid(2)

    def averaging(module, *args, **kwargs):
        return _averaging(jax.eval_shape(lambda k: module.init(k, *args, **kwargs), jax.random.key(0)))

    stem_vars = averaging(stem, jnp.ones((1, 32, 32, 9)), train=False)
    backbone_vars = averaging(backbone, jnp.ones((1, 32, 32, 2)), train=False)
    fpn_vars = averaging(fpn, [jnp.ones((1, 32 // s, 32 // s, 4)) for s in (1, 2, 4, 8)])

    def pyramid(image, open_laterals):
        weights = dict(fpn_vars["params"])
        for i in range(4):
            lateral = weights[f"lateral{i + 2}"]
            weights[f"lateral{i + 2}"] = jax.tree.map(lambda leaf, i=i: leaf * open_laterals[i], lateral)
        x = stem.apply(stem_vars, image, train=False)
        levels = fpn.apply({"params": weights}, backbone.apply(backbone_vars, x, train=False))
        return [p[0, centre // s, centre // s].sum() for p, s in zip(levels, STRIDES, strict=True)]

    image = jnp.ones((1, size, size, 9))

    @jax.jit
    def gradients(open_laterals):
        # One backward pass a level; the forward pass is shared.
        _, pull = jax.vjp(lambda image: jnp.stack(pyramid(image, open_laterals)), image)
        return jax.vmap(lambda seed: pull(seed)[0][0].sum(-1))(jnp.eye(6))

    by_lateral = [gradients(lateral) for lateral in jnp.eye(4)]
    own = [by_lateral[min(level, 3)][level] for level in range(6)]
    every = gradients(jnp.ones(4))
    return {"own": np.abs(np.asarray(own)), "all": np.abs(np.asarray(every))}


@pytest.mark.slow
@pytest.mark.parametrize("level", range(6))
def test_level_outputs_are_centred_on_index_times_stride(level, receptive_profiles):
    """Alignment: the gradient with respect to the image is symmetric about index * stride.

    Through a level's own path exactly. Nearest upsampling adds a lean of its own to P2..P4, since the fine
    index i sees the coarse i // 2: at most half a pixel of P5, which is 4.
    """
    for case, bound in (("own", 1e-3), ("all", 4.0 if level < 3 else 1e-3)):
        gradient = receptive_profiles[case][level]
        assert gradient[0].max() == 0, "the receptive field must fit into the image"
        for axis in (0, 1):
            profile = gradient.sum(axis=1 - axis)
            centroid = (profile * np.arange(256)).sum() / profile.sum()
            seen = np.flatnonzero(profile)
            assert abs(centroid - 128) <= bound
            if case == "own":
                assert seen[0] + seen[-1] == 2 * 128


@pytest.mark.slow
def test_circular_network_commutes_with_a_turn():
    """With circular width, rolling the input by 32 columns rolls every output."""
    network = Network(with_model(CONFIG, circular_width=True, stem=SMALL_STEM).model, 10)
    image = normal(0, 1, 32, 96, 9)
    variables = variables_of(network, image)
    apply = jax.jit(lambda x: network.apply(variables, x, train=False))
    plain, turned = apply(image), apply(jnp.roll(image, 32, axis=2))
    first = 0
    for stride in STRIDES:
        height, width = 32 // stride, 96 // stride
        count = height * width
        for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(turned), strict=True):
            a = a[:, first : first + count].reshape(height, width, -1)
            b = b[:, first : first + count].reshape(height, width, -1)
            scale = float(jnp.abs(a).max())
            np.testing.assert_allclose(jnp.roll(a, 32 // stride, axis=1), b, atol=1e-4 * scale)
        first += count


@pytest.mark.parametrize(
    ("config", "total", "tolerance"),
    [
        (NUSCENES, 10_661_558, 0),
        (NUSCENES_TEST, 16_836_662, 0),
        (COMPACT, 2_033_041, 0),
        (with_model(NUSCENES, fpn_channels=64), 5.7e6, 6e4),
        (with_model(NUSCENES, fpn_channels=128), 6.9e6, 6e4),
    ],
)
def test_networks_have_the_papers_size(config, total, tolerance):
    assert abs(parameters(config)["total"] - total) <= tolerance


def test_background_starts_at_its_prior_and_shapes_are_the_contracts():
    detector = build_detector(CONFIG, SENSOR)
    features = normal(0, 1, 16, 64, 9, 1).at[..., 7, :].set(1.0)
    outputs, _ = jax.jit(detector.apply)(detector.init(jax.random.key(0)), images_of(features))
    layout = image_layout(SENSOR, CONFIG.model)
    assert outputs.logits.shape == (1, layout.num_locations, 11)
    assert outputs.regression.shape == (1, layout.num_locations, 10, 10)
    assert outputs.iou_logits.shape == (1, layout.num_locations, 10)
    background = jax.nn.softmax(outputs.logits)[..., -1]
    np.testing.assert_allclose(background.mean(), 0.99, atol=0.005)


def test_network_input_normalises_joins_by_type_and_keeps_empty_slots_zero():
    config = ModelConfig(row_upscale=2)
    layout = image_layout(TINY, config)
    features = np.random.default_rng(0).normal(size=(1, 16, 256, 9, 3)).astype(np.float32)
    features[:, :, :, 7] = np.random.default_rng(1).random((1, 16, 256, 3)) < 0.5
    features *= features[:, :, :, 7:8]
    image = np.asarray(network_input(jnp.asarray(features), config, layout))
    for row, column, kind, r in [(0, 0, 0, 0), (5, 100, 4, 2), (31, 255, 8, 1), (8, 3, 6, 0)]:
        raw = features[0, row // 2, column, :, r]
        expected = (raw[kind] - config.channel_mean[kind]) / config.channel_scale[kind] if raw[7] else 0.0
        assert image[0, row, column, kind * 3 + r] == pytest.approx(expected, rel=1e-5, abs=1e-6)

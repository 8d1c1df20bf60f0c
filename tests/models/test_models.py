"""The network: formulations agree, locations are centred, variants and sizes are the paper's."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export, lax

from fcos_lidar_jax.config import ModelConfig, StemConfig
from fcos_lidar_jax.locations import STRIDES, image_layout
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.models.detector import Network, network_input
from fcos_lidar_jax.models.fpn import FeaturePyramid
from fcos_lidar_jax.models.layers import BatchNorm, GroupNorm, convolve
from fcos_lidar_jax.models.lidar_net import Backbone
from fcos_lidar_jax.models.modality import Stem, channel_groups
from fcos_lidar_jax.presets import NUSCENES, NUSCENES_TEST, QUICKSTART
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, TINY


def normal(seed: int, *shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def fill(tree, seed: int = 0):
    """Parameters of an abstract tree: normal kernels, so that nothing cancels or vanishes."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape) * 0.1, leaf.dtype), tree)


SMALL_STEM = StemConfig(channels_per_type=4, out_channels=8, dilations=(1, 2))


@pytest.mark.parametrize("form", ["grouped", "dense"])
@pytest.mark.parametrize(
    "choices",
    [
        {"num_convs": 2},
        {"num_convs": 1, "group_rounds": False},
        {"num_convs": 2, "group_rounds": False},
        {"num_convs": 2, "groups": "modalities"},
        {"num_convs": 2, "groups": "all"},
    ],
)
def test_forms_of_the_stem_are_equal_in_values_and_gradients(form, choices):
    config = dataclasses.replace(SMALL_STEM, channels_per_type=12, **choices)  # several bundles
    image = normal(0, 2, 8, 12, 27)
    stems = {f: Stem(config, form=f) for f in ("split", form)}
    params = fill(stems["split"].init(jax.random.key(0), image, train=True)["params"])
    weights = np.asarray(normal(1, 2, 8, 12, 8))

    def value(params, image, form):
        out, _ = stems[form].apply({"params": params}, image, train=True, mutable=["batch_stats"])
        return (out * weights).sum(), out

    with jax.enable_x64(True):  # in float32 a ReLU at its edge opens in one form and not in the other
        arguments = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, np.float64)), (params, image))
        results = {f: jax.value_and_grad(value, argnums=(0, 1), has_aux=True)(*arguments, f) for f in stems}
    (_, split), split_grads = results["split"]
    (_, other), other_grads = results[form]
    np.testing.assert_allclose(split, other, atol=1e-12)
    for a, b in zip(jax.tree.leaves(split_grads), jax.tree.leaves(other_grads), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-10 * float(np.abs(b).max() + 1))


def test_the_form_of_the_stem_is_that_of_the_platform_also_in_exported_programs():
    config = dataclasses.replace(SMALL_STEM, channels_per_type=12, num_convs=1, dilations=(1,))
    image = normal(0, 2, 8, 12, 27)
    variables = fill(jax.eval_shape(lambda key: Stem(config).init(key, image, train=True), jax.random.key(0)))

    def of(form):
        stem = Stem(config, form=form)
        return jax.jit(lambda v, x: stem.apply(v, x, train=True, mutable=["batch_stats"]))

    platforms = [("cpu",), ("cuda",), ("cpu", "cuda")]
    programs = {p: export.export(of(None), platforms=p)(variables, image) for p in platforms}
    kernels = {"split": "tensor<3x3x6x24xf32>", "dense": "tensor<3x3x27x108xf32>"}  # two groups, all nine
    forms = {p: {f for f, k in kernels.items() if k in program.mlir_module()} for p, program in programs.items()}
    assert forms == {("cpu",): {"split"}, ("cuda",): {"dense"}, ("cpu", "cuda"): {"split", "dense"}}
    weights = normal(1, 2, 8, 12, 8)

    def gradient(form):
        def total(variables):
            found = of(form)(variables, image)
            return (found[0] * weights).sum(), found

        gradient, found = jax.jit(jax.grad(total, has_aux=True))(variables)
        return jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(gradient)]), found

    (chosen, found), (split, expected) = gradient(None), gradient("split")
    assert float(jnp.abs(chosen - split).max()) < 1e-6 * float(jnp.abs(split).max())
    for other in (found, programs["cpu", "cuda"].call(variables, image)):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-6), other, expected)


def test_grouped_stem_is_one_library_convolution_per_layer():
    """The groups are the channel types: an impulse in one type reaches only that type's features."""
    config = dataclasses.replace(SMALL_STEM, num_convs=1, dilations=(1,))
    stem = Stem(config)
    image = jnp.zeros((1, 8, 8, 18)).at[0, 4, 4, 2 * 5 + 1].set(1.0)  # type 5, round 1
    params = fill(stem.init(jax.random.key(0), image, train=False)["params"])
    params["branch0"]["norm0"] = {"scale": jnp.ones(36), "bias": jnp.zeros(36)}
    params["norm"] = {"scale": jnp.ones(8), "bias": jnp.full(8, 100.0)}  # keeps the last ReLU open
    variables = {
        "params": params,
        "batch_stats": stem.init(jax.random.key(0), image, train=False)["batch_stats"],
    }
    out = stem.apply(variables, image, train=False)
    kernel = params["branch0"]["conv0_group5"][:, :, 1]  # 3, 3, 4: of round 1
    expected = np.zeros((8, 8, 8))
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            features = np.maximum(np.asarray(kernel[1 - dy, 1 - dx]) / np.sqrt(1 + 1e-5), 0)
            expected[4 + dy, 4 + dx] = features @ np.asarray(params["merge0"][20:24]) / np.sqrt(1 + 1e-5)
    np.testing.assert_allclose(np.asarray(out[0]) - 100, expected, atol=2e-5)


@pytest.mark.parametrize(
    ("config", "groups", "width"),
    [
        (StemConfig(), 9, 288),
        (StemConfig(groups="modalities"), 5, 288),
        (StemConfig(groups="all"), 1, 288),
        (StemConfig(group_rounds=False), 45, 270),
    ],
)
def test_stem_variants_of_table_3(config, groups, width):
    sizes = channel_groups(config, 5)
    assert len(sizes) == groups
    assert sum(i for i, _ in sizes) == 45
    assert sum(o for _, o in sizes) == width


@pytest.mark.parametrize(
    "config",
    [
        dataclasses.replace(SMALL_STEM, groups="modalities"),
        dataclasses.replace(SMALL_STEM, groups="all"),
        dataclasses.replace(SMALL_STEM, num_convs=3),
        dataclasses.replace(SMALL_STEM, dilations=(1,)),
        dataclasses.replace(SMALL_STEM, dilations=(1, 3)),
        dataclasses.replace(SMALL_STEM, dilations=(1, 1, 1)),
        dataclasses.replace(SMALL_STEM, merge="shared"),
    ],
)
def test_stem_variants_of_tables_3_4_5_keep_the_size(config):
    image = jnp.zeros((1, 8, 8, 18))
    shapes = jax.eval_shape(lambda k: Stem(config).init_with_output(k, image, train=False), jax.random.key(0))
    out, variables = shapes
    assert out.shape == (1, 8, 8, 8)
    merges = [name for name in variables["params"] if name.startswith("merge")]
    assert len(merges) == (1 if config.merge == "shared" else len(config.dilations))


@pytest.mark.parametrize(("stride", "dilation", "size"), [(1, 1, 1), (2, 1, 1), (1, 6, 3), (2, 1, 3), (1, 1, 7)])
def test_convolve_is_the_library_convolution_with_symmetric_padding(stride, dilation, size):
    x, kernel = normal(0, 2, 12, 16, 3), normal(1, size, size, 3, 4)
    pad = size // 2 * dilation
    expected = lax.conv_general_dilated(
        x,
        kernel,
        (stride, stride),
        [(pad, pad)] * 2,
        rhs_dilation=(dilation, dilation),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    np.testing.assert_allclose(convolve(x, kernel, stride=stride, dilation=dilation), expected, atol=1e-5)


def test_batch_norm_is_the_library_one_over_parts():
    x = normal(0, 3, 4, 5, 6) * 3 + 50
    library = nn.BatchNorm(use_running_average=False, momentum=0.9, epsilon=1e-5, use_fast_variance=False)
    variables = library.init(jax.random.key(0), x)
    expected, expected_stats = library.apply(variables, x, mutable=["batch_stats"])
    parts, stats = BatchNorm().apply(variables, [x[..., :2], x[..., 2:]], train=True, mutable=["batch_stats"])
    np.testing.assert_allclose(jnp.concatenate(parts, -1), expected, atol=1e-4)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), stats, expected_stats)


@pytest.mark.parametrize(("channels", "groups"), [(64, 32), (128, 32), (32, 16), (6, 3)])
def test_group_norm_is_the_library_one(channels, groups):
    x = normal(0, 2, 4, 6, channels) * 2 + 3
    library = nn.GroupNorm(num_groups=groups, epsilon=1e-5, use_fast_variance=False)
    params = fill(library.init(jax.random.key(0), x))
    np.testing.assert_allclose(GroupNorm().apply(params, x), library.apply(params, x), atol=1e-5)


def _averaging(tree):
    """Positive kernels that average and norms that do nothing: gradients show the receptive field."""

    def leaf(path, value):
        name = path[-1].key
        if name in ("bias", "mean") or name.endswith("_bias"):
            return jnp.zeros_like(value)
        if name in ("scale", "var"):
            return jnp.ones_like(value)
        return jnp.full_like(value, 1 / np.prod(value.shape[:-1]))

    return jax.tree_util.tree_map_with_path(leaf, tree)


@pytest.fixture(scope="module")
def receptive_profiles():
    """Of an output of P2..P7 at pixel (128, 128), the gradient's profiles along both axes of the image.

    Two cases: through the level's own lateral alone, and through all of them.
    """
    size, centre = 256, 128
    stem = Stem(StemConfig(channels_per_type=1, out_channels=2))
    backbone = Backbone((4, 4, 1, 1), (1, 1, 1, 1))
    fpn = FeaturePyramid(2)

    def averaging(module, *args, **kwargs):
        shapes = jax.eval_shape(lambda k: module.init(k, *args, **kwargs), jax.random.key(0))
        return _averaging(jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes))

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

    own = [gradients(jnp.eye(4)[min(level, 3)])[level] for level in range(6)]
    every = gradients(jnp.ones(4))
    return {"own": np.abs(np.asarray(own)), "all": np.abs(np.asarray(every))}


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
            print(f"P{level + 2} {case} axis {axis}: {centroid:.3f} of 128, support {seen[0]}..{seen[-1]}")
            assert abs(centroid - 128) <= bound
            if case == "own":
                assert seen[0] + seen[-1] == 2 * 128


@pytest.mark.slow
def test_circular_network_commutes_with_a_turn():
    """With circular width, rolling the input by 32 columns rolls every output."""
    config = dataclasses.replace(QUICKSTART.model, circular_width=True, fpn_channels=8, head_channels=8)
    network = Network(config, 10)
    image = normal(0, 1, 32, 96, 9)
    variables = network.init(jax.random.key(0), image[:, :, :32], train=False)
    variables["params"] = fill(variables["params"])
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


def test_paper_presets_have_the_papers_size():
    shapes = jax.eval_shape(build_detector(NUSCENES, NUSCENES_HDL32E).init, jax.random.key(0))
    counts = count_parameters(shapes["params"])
    print(counts)
    assert counts["total"] == 10_661_558
    shapes = jax.eval_shape(build_detector(NUSCENES_TEST, NUSCENES_HDL32E).init, jax.random.key(0))
    assert count_parameters(shapes["params"])["total"] == 16_836_662


@pytest.mark.parametrize(("fpn", "millions"), [(64, 5.7), (128, 6.9)])
def test_narrow_pyramids_have_the_expected_size(fpn, millions):
    config = dataclasses.replace(NUSCENES, model=dataclasses.replace(NUSCENES.model, fpn_channels=fpn))
    shapes = jax.eval_shape(build_detector(config, NUSCENES_HDL32E).init, jax.random.key(0))
    assert count_parameters(shapes["params"])["total"] / 1e6 == pytest.approx(millions, abs=0.06)


def test_tied_heads_share_everything_between_levels():
    tied = dataclasses.replace(QUICKSTART, model=dataclasses.replace(QUICKSTART.model, tied_heads=True))
    untied, shared = (
        count_parameters(jax.eval_shape(build_detector(c, TINY).init, jax.random.key(0))["params"])
        for c in (QUICKSTART, tied)
    )
    assert untied["heads"] == 6 * shared["heads"]


def test_background_starts_at_its_prior_and_shapes_are_the_contracts():
    detector = build_detector(QUICKSTART, TINY)
    variables = detector.init(jax.random.key(0))
    features = normal(0, 1, 16, 256, 9, 1).at[..., 7, :].set(1.0)
    outputs, _ = jax.jit(detector.apply)(variables, features)
    layout = image_layout(TINY, QUICKSTART.model)
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


def test_networks_seed_decides_the_parameters():
    init = build_detector(QUICKSTART, TINY).init
    a, b, c = (jax.tree.leaves(init(jax.random.key(seed))["params"]) for seed in (0, 0, 1))
    assert all(bool((x == y).all()) for x, y in zip(a, b, strict=True))
    assert any(bool((x != y).any()) for x, y in zip(a, c, strict=True))

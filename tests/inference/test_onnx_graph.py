"""The ONNX graph of the network equals Flax, for every configuration field that changes the network."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from tiny_run import CONFIG, SENSOR, images_of

from fcos_lidar_jax.config import StemConfig
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.inference.onnx_graph import network_graph
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import COMPACT, NUSCENES
from fcos_lidar_jax.sensors import sector

pytestmark = pytest.mark.slow

onnx = pytest.importorskip("onnx", reason="onnx, of the extra cpu, is not installed")
openvino = pytest.importorskip("openvino", reason="openvino, of the extra cpu, is not installed")


def with_model(config, **changes):
    return dataclasses.replace(config, model=dataclasses.replace(config.model, **changes))


def with_stem(rounds=2, **changes):
    """Configuration of the tiny network with a different stem."""
    config = with_model(CONFIG, stem=StemConfig(channels_per_type=4, out_channels=8, dilations=(1, 2), **changes))
    return dataclasses.replace(config, projection=dataclasses.replace(config.projection, num_rounds=rounds))


SLIM = {"backbone_blocks": (2, 1, 1, 1), "backbone_widths": (8, 8, 8, 8), "fpn_channels": 16, "head_channels": 16}
ODD = dataclasses.replace(SENSOR, num_columns=50)  # padded to 64 columns
CASES = {
    "compact, circular": (with_model(COMPACT, **SLIM), SENSOR),
    "paper": (with_model(NUSCENES, **SLIM), SENSOR),
    "modalities, a shared merge, three convolutions, padded columns": (
        with_stem(groups="modalities", merge="shared", num_convs=3),
        ODD,
    ),
    "rounds apart, untied heads, a turn that pads itself twice": (
        with_model(with_stem(group_rounds=False), tied_heads=False),
        dataclasses.replace(SENSOR, num_columns=12),
    ),
    "one group, three classes, a sector padded with empty columns": (
        dataclasses.replace(with_stem(groups="all"), classes=("a", "b", "c")),
        sector(SENSOR, np.pi / 2, 40),
    ),
    "local geometry, circular, padded columns and rows, remat": (
        with_model(CONFIG, local_geometry=True, circular_width=True, row_upscale=3, remat=True),
        ODD,
    ),
    "local geometry with the offsets of three rounds, a tenth channel": (
        with_model(
            with_stem(rounds=3),
            local_geometry=True,
            round_offsets=True,
            channel_mean=(1, 2, -1, 12, 0.3, -0.2, 20, 0, 0.1, 3),
            channel_scale=(12.0, 11.5, 0.9, 8.0, 0.3, 0.2, 20.0, 2.0, 0.16, 5.0),
        ),
        ODD,
    ),
}


def made_detector(config, sensor):
    """Random parameters of every kind, so that any omission or exchange changes the outputs."""
    rng = np.random.default_rng(0)

    def fill(path, leaf):
        positive = path[-1].key in ("scale", "var")
        values = rng.uniform(0.5, 2, leaf.shape) if positive else rng.normal(0, 0.15, leaf.shape)
        return values.astype(np.float32)

    model = build_detector(config, sensor)
    shapes = jax.eval_shape(model.init, jax.random.key(0))
    return TrainedDetector(model, jax.tree_util.tree_map_with_path(fill, shapes))


def made_features(detector):
    """Features of two clouds, with a third of the cells empty."""
    rng, model = np.random.default_rng(1), detector.config.model
    layout, rounds = image_layout(detector.sensor, model), detector.config.projection.num_rounds
    shape = 2, layout.rows, layout.columns, len(model.channel_mean), rounds
    mean, scale = (np.array(values)[:, None] for values in (model.channel_mean, model.channel_scale))
    features = rng.normal(size=shape) * scale + mean
    features[..., 7, :] = rng.random(shape[:3] + shape[4:]) > 0.3
    return np.where(features[..., 7:8, :] > 0, features, 0).astype(np.float32)


@pytest.mark.parametrize("name", CASES)
def test_the_graph_equals_the_network(name):
    """In OpenVINO; tests/inference/test_onnx_program.py asks it of onnxruntime."""
    detector = made_detector(*CASES[name])
    content, features = network_graph(detector), made_features(detector)
    onnx.checker.check_model(onnx.load_model_from_string(content), full_check=True)
    core = openvino.Core()
    program = core.compile_model(core.read_model(content), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    found = {output.any_name: value for output, value in program([features]).items()}
    apply = jax.jit(functools.partial(detector.model.apply, train=False))
    expected = vars(apply(detector.variables, images_of(features))[0])
    assert found.keys() == expected.keys()
    for output, value in expected.items():
        assert found[output].shape == value.shape
        assert np.abs(found[output] - value).max() <= 1e-4 * np.abs(value).max(), output


def test_unknown_parameters_are_refused():
    detector = made_detector(CONFIG, SENSOR)
    detector.variables["params"]["neck"] = {"kernel": np.zeros(3, np.float32)}
    with pytest.raises(ValueError, match=r"ONNX: found the parameters params/neck/kernel"):
        network_graph(detector)

"""A run so small that its step compiles in seconds. Tests share it, and its compiled program."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from fcos_lidar_jax.checkpoints import Checkpoint, save_checkpoint
from fcos_lidar_jax.config import Config, InferenceConfig, RefinementConfig, StemConfig
from fcos_lidar_jax.input_pipeline.loader import make_batches
from fcos_lidar_jax.models import Detector, build_detector
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import TINY, Sensor
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.training import Schedule, train
from fcos_lidar_jax.types import Batch, RangeImage, TrainState

STEPS = 4
SENSOR = dataclasses.replace(TINY, num_columns=64)
CONFIG = dataclasses.replace(
    QUICKSTART,
    max_points=1024,
    copy_paste=None,
    class_balanced=False,
    model=dataclasses.replace(
        QUICKSTART.model,
        row_upscale=1,
        stem=StemConfig(channels_per_type=2, out_channels=8, dilations=(1,), num_convs=1),
        backbone_blocks=(1, 1, 1, 1),
        backbone_widths=(8, 8, 8, 8),
        fpn_channels=8,
        head_channels=8,
        head_convs=1,
        tied_heads=True,
    ),
    inference=InferenceConfig(max_detections=20, candidates_per_level=20),
    optimizer=dataclasses.replace(QUICKSTART.optimizer, batch_size=2, ema_decay=0.9),
)
LOOK = RefinementConfig(
    num_boxes=8, num_points=16, point_channels=(8, 8), box_channels=(8,), num_neighbours=3, pair_channels=(8, 8)
)
REFINED = dataclasses.replace(CONFIG, refinement=LOOK)
"""The run with a second look."""
NETWORK_OPTIONS = """
    --no-class-balanced --inference.max-detections 20 --inference.candidates-per-level 20
    --optimizer.batch-size 2 --optimizer.ema-decay 0.9 --projection.num-rounds 1 --model.row-upscale 1
    --model.stem.channels-per-type 2 --model.stem.out-channels 8 --model.stem.dilations 1
    --model.stem.num-convs 1 --model.backbone-blocks 1 1 1 1 --model.backbone-widths 8 8 8 8
    --model.fpn-channels 8 --model.head-channels 8 --model.head-convs 1 --model.tied-heads
""".split()  # noqa: SIM905
"""Options of ``fcos-lidar train`` that reduce a preset to this network."""
FRAMES = SimulatedFrames(SENSOR, 12)
TESTS = SimulatedFrames(SENSOR, 2, 1000)
TINY_CONFIG = dataclasses.replace(CONFIG, max_points=4096)
"""The configuration for complete clouds of the sensor TINY."""
TINY_REFINED = dataclasses.replace(TINY_CONFIG, refinement=LOOK)


def images_of(features: jax.Array) -> RangeImage:
    """Range images with features only, which is all that the network uses."""
    batch, rows, columns, _, rounds = features.shape
    index = jnp.zeros((batch, rows, columns, rounds), jnp.int32)
    return RangeImage(jnp.asarray(features), index, jnp.zeros(batch, jnp.int32))


def weights(config: Config = CONFIG):
    """Random weights of the run's network, made without compiling."""
    return _weights(build_detector(config, SENSOR))


@functools.cache
def _weights(detector: Detector):
    shapes = jax.eval_shape(detector.init, jax.random.key(0))
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda leaf: rng.normal(0, 0.3, leaf.shape).astype(leaf.dtype), shapes["params"])
    statistics = jax.tree.map(lambda leaf: np.ones(leaf.shape, leaf.dtype), shapes["batch_stats"])
    return jax.tree.map(jax.numpy.asarray, {"params": params, "batch_stats": statistics})


def untrained(config: Config, sensor: Sensor):
    """Random kernels that preserve the scale of their input, without a bias towards the background, so that the
    network predicts different boxes everywhere."""

    def fill(path, leaf):
        rng = np.random.default_rng(leaf.size)
        if leaf.ndim > 1:
            return rng.normal(0, (2 / np.prod(leaf.shape[:-1])) ** 0.5, leaf.shape).astype(leaf.dtype)
        # All different, because XLA folds a constant factor into the kernel, which changes the rounding.
        centre = float(path[-1].key in ("scale", "var"))
        return rng.uniform(centre - 0.1, centre + 0.1, leaf.shape).astype(leaf.dtype)

    shapes = jax.eval_shape(build_detector(config, sensor).init, jax.random.key(0))
    return jax.tree_util.tree_map_with_path(fill, shapes)


def save_untrained(folder: Path, config: Config = TINY_CONFIG, sensor: Sensor = TINY) -> None:
    """Save a checkpoint with :func:`untrained` weights."""
    save_checkpoint(folder, Checkpoint(config, sensor, untrained(config, sensor), 7))


def train_tiny(folder: Path, *, save: int = 1, evaluate: int = 100, **options) -> TrainState:
    """Run four steps on simulated frames, saving after each step."""
    options = {"config": CONFIG, "frames": FRAMES, "steps": STEPS, **options}
    return train(out=folder, schedule=Schedule(save, evaluate), threads=0, **options)


def batches(first_step: int = 0):
    return make_batches(FRAMES, CONFIG, seed=0, num_steps=STEPS, first_step=first_step, threads=0)


def host_batch(step: int = 0) -> Batch:
    with batches(step) as stream:
        return next(stream).batch


def bits(tree) -> list[bytes]:
    """Bytes of all leaves, for comparison; random keys as numbers."""
    key, leaves = jax.dtypes.prng_key, jax.tree.leaves(tree)
    raw = [jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, key) else x for x in leaves]
    return [np.asarray(leaf).tobytes() for leaf in raw]

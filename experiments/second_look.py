"""The second look trained on the boxes of a frozen detector, which are found only once per frame.

``train --weights`` with ``refinement.freeze_detector`` runs the detector in each step. Here each update sees four
frames whose boxes are in memory, and a frame is used several times.
"""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
import optax

from fcos_lidar_jax.augment import augment
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.input_pipeline.loader import make_batches
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.refinement.stage import SECOND_LOOK, look_samples, look_sums
from fcos_lidar_jax.training import make_optimizer
from fcos_lidar_jax.training.objective import batch_metrics

FRAMES = 4  # Frames per update.


def look_again(
    first: TrainedDetector, config: Config, frames: FrameSet, *, samples: int, updates: int, seed: int
) -> TrainedDetector:
    """Train a second look for a detector.

    Args:
        first: the detector, which stays as it is.
        config: its configuration with ``refinement``; its schedule has ``updates`` steps here.
        samples: number of augmented frames, in the order in which ``train`` takes them.
    """
    detector = build_detector(config, first.sensor)
    looked = _found(first, config, frames, samples, seed)
    optimizer = make_optimizer(config.optimizer, updates)
    variables = detector.init(jax.random.key(seed))
    look = variables["params"][SECOND_LOOK]

    @jax.jit
    def update(look: Any, state: Any, some: Any) -> tuple[Any, Any, Any]:
        def loss(look: Any) -> Any:
            sums = look_sums(config, {"params": {SECOND_LOOK: look}}, *some)
            return batch_metrics(sums, config.loss)["loss/total"]

        value, gradient = jax.value_and_grad(loss)(look)
        changes, state = optimizer.update(gradient, state, look)
        return optax.apply_updates(look, changes), state, value

    state, order = jax.jit(optimizer.init)(look), np.random.default_rng(seed)
    progress = Progress("updates", updates)
    for step in range(updates):
        chosen = order.choice(samples, min(FRAMES, samples), replace=False)
        look, state, value = update(look, state, jax.tree.map(lambda leaf, i=chosen: leaf[i], looked))
        progress.show(step + 1, f"loss {value:.3f}" if step % 100 == 0 else "")
    params = {**first.variables["params"], SECOND_LOOK: jax.device_get(look)}
    return TrainedDetector(detector, {**first.variables, "params": params})


def _found(first: TrainedDetector, config: Config, frames: FrameSet, samples: int, seed: int) -> Any:
    """What the second look sees in each sample, and its targets, stacked."""
    detector = build_detector(config, first.sensor)
    assert config.augment is not None  # as in all trials
    augment_one = functools.partial(augment, config=config.augment, origin_m=first.sensor.origin_m)

    @jax.jit
    def find(key: Any, batch: Any) -> Any:
        points, boxes = jax.vmap(augment_one)(key[None], batch.points, batch.boxes)
        batch = dataclasses.replace(batch, points=points, boxes=boxes)
        inputs = jax.vmap(detector.prepare)(points, batch.valid)
        outputs, _ = detector.apply(first.variables, inputs)
        return jax.tree.map(lambda leaf: leaf[0], look_samples(detector, outputs, inputs, batch))

    one = dataclasses.replace(config, optimizer=dataclasses.replace(config.optimizer, batch_size=1))
    found, progress = [], Progress("frames", samples)
    with make_batches(frames, one, seed=seed, num_steps=samples, threads=1) as batches:
        for number, host in enumerate(batches):
            found.append(jax.device_get(find(jax.random.fold_in(jax.random.key(seed), number), host.batch)))
            progress.show(number + 1)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)

"""The second look trained on the boxes of a frozen detector, which are found only once per frame.

``train --weights`` with ``refinement.freeze_detector`` runs the detector in each step. Here each frame is used
several times, since a second look needs more updates than a detector (``experiments/LOG.md``, 2026-11-30).
"""

import dataclasses
import functools
import itertools
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
from numpy.lib.format import open_memmap

from fcos_lidar_jax.augment import augment
from fcos_lidar_jax.config import Config, OptimizerConfig, RefinementConfig, config_to_json
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.files import atomic_write, checksum, read_json
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.input_pipeline.loader import make_batches
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.refinement.stage import SECOND_LOOK, look_samples, look_sums
from fcos_lidar_jax.training import make_optimizer
from fcos_lidar_jax.training.loop import NonFiniteLossError
from fcos_lidar_jax.training.objective import batch_metrics

USES = 12  # Updates that see each frame: with half as many the score is lower, twice as many do not help.
_DONE = "done.json"
_SAVE_EVERY = 50  # Samples.


def look_config(config: Config, look: RefinementConfig, *, batch_size: int = 1) -> Config:
    """Configuration of a second look that is trained on the boxes of a frozen detector."""
    own = {"peak_learning_rate": 2e-3, "max_gradient_norm": 5.0, "batch_size": batch_size}
    return dataclasses.replace(
        config,
        refinement=dataclasses.replace(look, freeze_detector=True),
        optimizer=dataclasses.replace(config.optimizer, **own),
    )


def look_again(
    first: TrainedDetector,
    config: Config,
    frames: FrameSet,
    *,
    samples: int,
    updates: int,
    seed: int,
    folder: Path,
) -> TrainedDetector:
    """Train a second look for a detector.

    Args:
        first: the detector, which stays as it is.
        config: its :func:`look_config`. Its schedule has ``updates`` steps here, and its batch size is the number
            of frames per update.
        samples: number of augmented frames, in the order in which ``train`` takes them.
        folder: folder of the boxes that the detector finds, up to a megabyte per sample. The same folder resumes
            the search for boxes; the updates start again.
    """
    detector = build_detector(config, first.sensor)
    looked = _found(first, config, frames, samples, seed, folder)
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
    number, value = min(config.optimizer.batch_size, samples), np.nan
    progress = Progress("updates", updates)
    for step in range(updates):
        chosen = order.choice(samples, number, replace=False)
        look, state, value = update(look, state, jax.tree.map(lambda leaf, i=chosen: leaf[i], looked))
        progress.show(step + 1, f"loss {value:.3f}" if step % 100 == 0 else "")
    if not np.isfinite(value):
        raise NonFiniteLossError(f"second look: loss {value} after {updates} updates")
    params = {**first.variables["params"], SECOND_LOOK: jax.device_get(look)}
    return TrainedDetector(detector, {**first.variables, "params": params})


def _found(first: TrainedDetector, config: Config, frames: FrameSet, samples: int, seed: int, folder: Path) -> Any:
    """What the second look sees in each sample, and its targets, stacked in files of a folder."""
    detector = build_detector(config, first.sensor)
    augment_one = lambda _, points, boxes: (points, boxes)  # noqa: E731
    if config.augment is not None:
        augment_one = functools.partial(augment, config=config.augment, origin_m=first.sensor.origin_m)

    @jax.jit
    def find(key: Any, batch: Any) -> Any:
        points, boxes = jax.vmap(augment_one)(key[None], batch.points, batch.boxes)
        batch = dataclasses.replace(batch, points=points, boxes=boxes)
        inputs = jax.vmap(detector.prepare)(points, batch.valid)
        outputs, _ = detector.apply(first.variables, inputs)
        return jax.tree.map(lambda leaf: leaf[0], look_samples(detector, outputs, inputs, batch))

    one = dataclasses.replace(config, optimizer=OptimizerConfig(batch_size=1))
    weights = checksum(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(first.variables)))
    of = checksum(repr((weights, config_to_json(one), frames.fingerprint(), samples, seed)).encode())
    done = _done(folder, of)
    progress = Progress("frames", samples)
    start = min(done, samples - 1)  # one frame in any case, for the shapes
    with make_batches(frames, one, seed=seed, num_steps=samples, first_step=start, threads=1) as batches:
        first_batch = next(batches)
        shapes = jax.eval_shape(find, jax.random.key(seed), first_batch.batch)
        leaves, tree = jax.tree.flatten(shapes)
        folder.mkdir(parents=True, exist_ok=True)
        mode = "r+" if done else "w+"  # an existing file knows its type and shape
        stored = [
            open_memmap(folder / f"{i}.npy", mode, leaf.dtype, (samples, *leaf.shape))
            for i, leaf in enumerate(leaves)
        ]
        for number, host in zip(range(done, samples), itertools.chain([first_batch], batches), strict=False):
            found = jax.device_get(find(jax.random.fold_in(jax.random.key(seed), number), host.batch))
            for array, leaf in zip(stored, jax.tree.leaves(found), strict=True):
                array[number] = leaf
            if (number + 1) % _SAVE_EVERY == 0 or number + 1 == samples:
                for array in stored:
                    array.flush()
                atomic_write(folder / _DONE, f'{{"of": "{of}", "done": {number + 1}}}\n')
            progress.show(number + 1)
    return jax.tree.unflatten(tree, stored)


def _done(folder: Path, of: str) -> int:
    """Number of samples that are in the folder."""
    file = folder / _DONE
    if not file.exists():
        return 0
    stored = read_json(file, dict[str, Any])
    if stored["of"] != of:
        raise ValueError(f"{folder}: found the boxes of another training, expected another folder")
    return int(stored["done"])

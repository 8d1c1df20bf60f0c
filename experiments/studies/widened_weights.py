"""Weights in the package for a preset whose layers became wider or more, with the same detections.

    python -m experiments.studies.widened_weights --name hdl32e

Training can then continue in the larger network with what the smaller one has learned, instead of from random
weights (Chen et al., "Net2Net", ICLR 2016). Old channels keep their weights and ignore the new channels, whose
weights are random. New blocks of the backbone add zero. Run it after one of these sizes of the preset has grown:
``stem.out_channels``, ``backbone_blocks``, ``backbone_widths``, ``fpn_channels`` and ``head_channels``, the latter
to even numbers up to 64. The command replaces the weights in the package, unless the larger network predicts
otherwise on a simulated frame.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from experiments.script import run_script
from experiments.studies.model_card import SHIPPED
from experiments.studies.shipped_weights import CONFIGS, half_precision
from fcos_lidar_jax import open_frames
from fcos_lidar_jax.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.progress import tell

_ADDED_BY_A_BLOCK = ("expand", "norm", "scale")
"""End of the path of the factors of what a block adds to its shortcut."""
_TOLERANCE = 1e-3
"""Differences from rounding, relative to the largest output."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args:
    """Options of the widening."""

    name: Literal["quickstart", "hdl32e"]  # Weights in the package.
    seed: int = 0  # Seed of the new channels.


def widened(old: Any, new: Any) -> Any:
    """Put the variables of a network into the randomly initialised variables of a larger one.

    Args:
        old, new: nested dicts of arrays. Kernels have inputs on the last axis but one and outputs on the last. All
            arrays of ``old`` must be in ``new``, with axes at least as long.

    >>> old = {"kernel": np.ones((1, 1)), "bias": np.ones(1)}
    >>> both = widened(old, {"kernel": np.full((2, 2), 5.0), "bias": np.full(2, 5.0)})
    >>> both["kernel"].tolist(), both["bias"].tolist()  # the old output ignores the new input
    ([[1.0, 5.0], [0.0, 5.0]], [1.0, 5.0])
    """
    arrays = dict(jax.tree_util.tree_leaves_with_path(old))

    def fill(path: tuple[Any, ...], drawn: Any) -> np.ndarray:
        filled = np.array(drawn)
        if path not in arrays:
            names = tuple(key.key for key in path)
            return np.zeros_like(filled) if names[-3:] == _ADDED_BY_A_BLOCK else filled
        own = np.asarray(arrays.pop(path))
        if own.ndim != filled.ndim or any(a > b for a, b in zip(own.shape, filled.shape, strict=True)):
            raise ValueError(f"{jax.tree_util.keystr(path)}: got {own.shape}, expected at most {filled.shape}")
        filled[..., : own.shape[-1]] = 0
        filled[tuple(map(slice, own.shape))] = own
        return filled

    both = jax.tree_util.tree_map_with_path(fill, new)
    if arrays:
        raise ValueError(f"{jax.tree_util.keystr(next(iter(arrays)))}: not in the larger network")
    return both


def difference(checkpoints: Sequence[Checkpoint]) -> float:
    """Compare the outputs of two checkpoints for a simulated frame, relative to the largest output."""
    outputs = []
    for checkpoint in checkpoints:
        detector = build_detector(checkpoint.config, checkpoint.sensor)
        frames = open_frames(format="simulated", split="val", sensor=checkpoint.sensor)
        points = jnp.asarray(frames.frame(0).points[: checkpoint.config.max_points, :5])
        image = jax.tree.map(lambda leaf: leaf[None], detector.prepare(points, jnp.ones(len(points), bool)))
        variables = jax.tree.map(jnp.asarray, checkpoint.variables)
        outputs.append(jax.tree.leaves(jax.jit(detector.apply)(variables, image)[0]))
    return max(float(jnp.abs(a - b).max() / jnp.abs(a).max()) for a, b in zip(*outputs, strict=True))


def main(args: Args) -> None:
    """Widen and replace the weights in the package."""
    folder, config = SHIPPED / args.name, CONFIGS[args.name]
    checkpoint = load_checkpoint(folder)
    detector = build_detector(config, checkpoint.sensor)
    variables = widened(checkpoint.variables, detector.init(jax.random.key(args.seed)))
    before, after = (count_parameters(v["params"])["total"] for v in (checkpoint.variables, variables))
    kept = dataclasses.replace(checkpoint.config, model=config.model)
    larger = dataclasses.replace(checkpoint, variables=variables, config=kept)
    if (most := difference((checkpoint, larger))) > _TOLERANCE:
        raise ValueError(
            f"{folder}: the larger network predicts otherwise, by {most:.2g} of the largest output, expected"
            " larger sizes of those that `--help` lists"
        )
    save_checkpoint(folder, half_precision(larger))
    tell(f"{args.name}: {before} parameters became {after}")


if __name__ == "__main__":
    run_script(main, Args, __doc__)

"""Weights in the package for a preset whose layers became wider or more, with the same detections.

    python -m experiments.studies.widened_weights --name hdl32e

Training can then continue in the larger network with what the smaller one has learned, instead of from random
weights (Chen et al., "Net2Net", ICLR 2016). Old channels keep their weights and ignore the new channels, whose
weights are random. New blocks of the backbone add zero. The command replaces the weights in the package; run it
after the sizes of the preset have been changed.
"""

import dataclasses
from typing import Any, Literal

import jax
import numpy as np

from experiments.script import Options, run_script
from experiments.studies.model_card import SHIPPED
from experiments.studies.shipped_weights import CONFIGS, half_precision
from fcos_lidar_jax.checkpoints import load_checkpoint, save_checkpoint
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import load_sensor

_ADDED_BY_A_BLOCK = ("expand", "norm", "scale")
"""End of the path of the factor that multiplies the sum of a block with its shortcut."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """Options of the widening."""

    name: Literal["quickstart", "hdl32e"]  # Weights in the package.
    seed: int = 0  # Seed of the new channels.


def widened(old: Any, new: Any) -> Any:
    """Put the variables of a network into the randomly initialised variables of a larger one.

    Args:
        old, new: nested dicts of arrays whose last axis are the outputs of a layer, and whose last but one are its
            inputs. All arrays of ``old`` must be in ``new``, with axes at least as long.

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


def main(args: Args) -> None:
    """Widen and replace the weights in the package."""
    checkpoint = load_checkpoint(SHIPPED / args.name)
    config = CONFIGS[args.name]
    detector = build_detector(config, load_sensor(config.sensor))
    variables = widened(checkpoint.variables, detector.init(jax.random.key(args.seed)))
    before, after = (count_parameters(v["params"])["total"] for v in (checkpoint.variables, variables))
    kept = dataclasses.replace(checkpoint.config, model=config.model)
    larger = dataclasses.replace(checkpoint, variables=variables, config=kept)
    save_checkpoint(SHIPPED / args.name, half_precision(larger))
    tell(f"{args.name}: {before} parameters became {after}")


if __name__ == "__main__":
    run_script(main, Args, __doc__)

"""Times of the modality-wise convolutions in the variants of tables 3, 4 and 5.

    python -m experiments.benchmarks.module_latency  # only the stem, at full size: 64x1088x45

All variants run in turns. ``needed`` counts the operations of the definition, ``executed`` the operations that XLA
counts in the compiled program: without the zero padding, but with the zeros of block-diagonal kernels. Cost: 15
repeats take some minutes on two CPU cores. README.md has the result.
"""

import dataclasses
from collections.abc import Collection
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from experiments.paper import PAPER
from experiments.script import Options, run_measurement
from fcos_lidar_jax.config import StemConfig
from fcos_lidar_jax.inference.timing import Call, interleaved
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models.modality import Stem, channel_groups
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.sensors import NUSCENES_HDL32E

BASE = NUSCENES.model.stem
_LAYOUT = image_layout(NUSCENES_HDL32E, NUSCENES.model)
SHAPE = (1, _LAYOUT.height, _LAYOUT.width, 9 * NUSCENES.projection.num_rounds)  # Shape of the network's input.


class Variant(NamedTuple):
    """A timed stem, and the paper's rows with this stem: table -> row."""

    stem: StemConfig
    rows: dict[str, str]


def _variant(rows: dict[str, str], **changes: Any) -> Variant:
    return Variant(dataclasses.replace(BASE, **changes), rows)


VARIANTS = {
    "one group": _variant({"table3": "1 group"}, groups="all"),
    "5 modalities": _variant({"table3": "5 groups"}, groups="modalities"),
    "9 types": _variant({"table3": "9 groups", "table4": "2", "table5": "(1, 3, 6)"}),
    "9 types, rounds apart": _variant({"table3": "9 groups, rounds not grouped"}, group_rounds=False),
    "1 convolution": _variant({"table4": "1"}, num_convs=1),
    "3 convolutions": _variant({"table4": "3"}, num_convs=3),
    "dilation (1,)": _variant({"table5": "(1,)"}, dilations=(1,)),
    "dilations (1, 3)": _variant({"table5": "(1, 3)"}, dilations=(1, 3)),
    "dilations (1, 1, 1)": _variant({"table5": "(1, 1, 1)"}, dilations=(1, 1, 1)),
}
REFERENCE = "9 types"  # The paper's stem, to which ratios are relative.


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Options of the measurement."""

    precision: Literal["float32", "bfloat16"] = "float32"  # Precision of the convolutions after the first.
    repeats: int = 15  # Timed calls per variant.


def needed_gflop(stem: StemConfig) -> float:
    """Count the multiplications and additions of a stem's convolutions, in 10^9.

    >>> round(needed_gflop(StemConfig(num_convs=1, dilations=(1,))), 2)
    4.37
    """
    _, height, width, channels = SHAPE
    groups = channel_groups(stem, channels // 9)
    first = sum(size * out for size, out in groups)
    later = sum(out * out for _, out in groups) * (stem.num_convs - 1)
    merge = sum(out for _, out in groups) * stem.out_channels
    return 2 * height * width * len(stem.dilations) * (9 * (first + later) + merge) / 1e9


def compiled(stem: StemConfig, precision: str) -> tuple[Call, float]:
    """Compile a stem with random weights and input; returns a call and its executed 10^9 operations."""
    module = Stem(stem, precision=precision)
    image = jax.random.normal(jax.random.key(0), SHAPE, jnp.float32)
    variables = jax.jit(lambda: module.init(jax.random.key(1), jnp.zeros((1, 8, 8, SHAPE[-1])), train=False))()
    program = jax.jit(lambda v, x: module.apply(v, x, train=False)).lower(variables, image).compile()
    cost: Any = program.cost_analysis()
    return lambda: program(variables, image), float(cost.get("flops", 0.0)) / 1e9


def _paper_times(variant: Variant) -> dict[str, dict[str, float]]:
    times = {}
    for table, row in variant.rows.items():
        rows = PAPER["tables"][table]["rows"]
        if "time_ms" in rows[row]:
            ms, base = rows[row]["time_ms"], rows[VARIANTS[REFERENCE].rows[table]]["time_ms"]
            times[f"{table}, {row}"] = {"time_ms": ms, "ratio": round(ms / base, 3)}
    return times


def measure(args: Args, only: Collection[str] = VARIANTS) -> dict[str, Any]:
    """Time the reference and other variants.

    Returns:
        ``variants``, for each: ``median_ms``, ``p99_ms``, ``ratio`` to the reference, ``needed_gflop``,
        ``executed_gflop``, ``executed_gflop_per_s``; ``paper``, ``{"table, row": {"time_ms", "ratio"}}`` if it has
        any. Beside them the options.
    """
    variants = {name: variant for name, variant in VARIANTS.items() if name in (*only, REFERENCE)}
    compiled_stems = {name: compiled(variant.stem, args.precision) for name, variant in variants.items()}
    found = interleaved({name: call for name, (call, _) in compiled_stems.items()}, args.repeats)
    records = {}
    for name, variant in variants.items():
        ms, executed = found[name]["median_ms"], compiled_stems[name][1]
        records[name] = {
            **found[name],
            "ratio": round(ms / found[REFERENCE]["median_ms"], 3),
            "needed_gflop": round(needed_gflop(variant.stem), 2),
            "executed_gflop": round(executed, 2),
            "executed_gflop_per_s": round(1e3 * executed / ms, 1),
            "paper": _paper_times(variant),
        }
    return {"variants": records, "precision": args.precision, "repeats": args.repeats}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

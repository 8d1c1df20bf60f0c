"""How long do the modality-wise convolutions take, by the variants of tables 3, 4 and 5?

    python -m experiments.benchmarks.module_latency  # the stem alone, at full size: 64x1088x45
    python -m experiments.benchmarks.module_latency --repeats 3  # a look
    python -m experiments.benchmarks.module_latency --include-grouped  # feature_group_count too, slow on a CPU

Every variant is computed in the fastest of its formulations (see ``Stem``), found by a short run of all of
them; then all variants run turn by turn, so that ratios hold on a machine whose speed drifts. ``needed`` are the
operations of the mathematics, ``executed`` what XLA counts in the compiled program: without those on the zero
padding, with those on the zeros of a block-diagonal kernel. Every convolution of ``"split"`` is also timed by
itself: what a variant's convolutions take one by one explains its place.

Cost: 15 turns take about six minutes on two CPU cores.

Result (``results/module_latency.json``, two CPU cores): the paper's order and nearly its ratios, but for one pair.
Rounds that are not grouped are faster here and slower in the paper. Grouping the rounds needs three times the
multiplications, and executes 1.3 times as many; on a CPU they cost time; why less on the paper's GPU was not
measured. The merging 1x1 reads no more channels when rounds are apart, but in more and narrower pieces; it takes
longer, and eats most of what the 3x3 save.
"""

import dataclasses
import functools
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from experiments.benchmarks.latency import STEM_FORMS
from experiments.hardware import hardware_line
from experiments.paper import PAPER
from experiments.script import run_script, save
from experiments.statistics import interleaved
from fcos_lidar_jax.config import StemConfig
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models.layers import convolve
from fcos_lidar_jax.models.modality import Form, Stem, bundles, channel_groups
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.sensors import NUSCENES_HDL32E

BASE = NUSCENES.model.stem
_LAYOUT = image_layout(NUSCENES_HDL32E, NUSCENES.model)
SHAPE = (1, _LAYOUT.height, _LAYOUT.width, 9 * NUSCENES.projection.num_rounds)
"""Of the network's input."""


@dataclasses.dataclass(frozen=True)
class Variant:
    """A row of the paper's tables."""

    stem: StemConfig
    """What is timed."""
    rows: tuple[tuple[str, str], ...]
    """(table, row) of the paper that this is."""


VARIANTS = {
    "one group": Variant(dataclasses.replace(BASE, groups="all"), (("table3", "1 group"),)),
    "5 modalities": Variant(dataclasses.replace(BASE, groups="modalities"), (("table3", "5 groups"),)),
    "9 types": Variant(BASE, (("table3", "9 groups"), ("table4", "2"), ("table5", "(1, 3, 6)"))),
    "9 types, rounds apart": Variant(
        dataclasses.replace(BASE, group_rounds=False), (("table3", "9 groups, rounds not grouped"),)
    ),
    "1 convolution": Variant(dataclasses.replace(BASE, num_convs=1), (("table4", "1"),)),
    "3 convolutions": Variant(dataclasses.replace(BASE, num_convs=3), (("table4", "3"),)),
    "dilation (1,)": Variant(dataclasses.replace(BASE, dilations=(1,)), (("table5", "(1,)"),)),
    "dilations (1, 3)": Variant(dataclasses.replace(BASE, dilations=(1, 3)), (("table5", "(1, 3)"),)),
    "dilations (1, 1, 1)": Variant(dataclasses.replace(BASE, dilations=(1, 1, 1)), (("table5", "(1, 1, 1)"),)),
}
REFERENCE = "9 types"
"""The paper's stem: ratios are to it."""


@dataclasses.dataclass(frozen=True)
class Args:
    """What to time, and how often."""

    only: tuple[str, ...] = ()
    """Of the variants, by name, beside "9 types"; default: all."""
    include_grouped: bool | None = None
    """Try feature_group_count as well; default: not on a CPU."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the convolutions behind the first."""
    repeats: int = 15
    """Turns."""
    out: Path = Path("outputs/module_latency.json")
    """Where the figures go."""


def needed_gflop(stem: StemConfig) -> float:
    """Multiplications and additions of a stem's convolutions, each counted as one, in 10^9.

    >>> round(needed_gflop(StemConfig(num_convs=1, dilations=(1,))), 2)
    4.37
    """
    _, height, width, channels = SHAPE
    groups = channel_groups(stem, channels // 9)
    first = sum(size * out for size, out in groups)
    later = sum(out * out for _, out in groups) * (stem.num_convs - 1)
    merge = sum(out for _, out in groups) * stem.out_channels
    return 2 * height * width * len(stem.dilations) * (9 * (first + later) + merge) / 1e9


def forms_of(stem: StemConfig, include_grouped: bool) -> tuple[Form, ...]:
    """Formulations that differ: one group has one, groups of different sizes have no feature_group_count."""
    sizes = channel_groups(stem, SHAPE[-1] // 9)
    if len(sizes) == 1:
        return ("split",)
    return STEM_FORMS if include_grouped and len(set(sizes)) == 1 else STEM_FORMS[:2]


class Compiled:
    """One formulation of a variant, compiled, with random weights and input."""

    def __init__(self, stem: StemConfig, precision: str, form: Form) -> None:
        """Compile it."""
        module, image = (
            Stem(stem, precision=precision, form=form),
            jax.random.normal(jax.random.key(0), SHAPE, jnp.float32),
        )
        variables = jax.jit(lambda: module.init(jax.random.key(1), jnp.zeros((1, 8, 8, SHAPE[-1])), train=False))()
        program = jax.jit(lambda v, x: module.apply(v, x, train=False)).lower(variables, image).compile()
        cost: Any = program.cost_analysis()
        self.executed_gflop = float(cost.get("flops", 0.0)) / 1e9
        self.run = lambda: program(variables, image)


def module_latency(
    names: tuple[str, ...] = (),
    *,
    repeats: int = 15,
    include_grouped: bool | None = None,
    precision: str = "float32",
) -> dict[str, dict[str, Any]]:
    """The variants' times, by name.

    Args:
        names: of :data:`VARIANTS`, beside the reference; all if empty.
        repeats: turns.
        include_grouped: try feature_group_count as well; None for not on a CPU.
        precision: of the convolutions behind the first.

    Returns:
        for each variant: ``form`` (the fastest), ``forms_ms`` (the short run of all), ``median_ms``, ``p99_ms``,
        ``ratio`` to the reference, ``needed_gflop``, ``executed_gflop``, ``executed_gflop_per_s``; ``pieces``,
        count, time and speed of each convolution by itself, and their sum ``pieces_ms``; ``paper``, ``{"table,
        row": {"time_ms", "ratio"}}`` if it has any.
    """
    if include_grouped is None:
        include_grouped = jax.default_backend() != "cpu"
    variants = {name: v for name, v in VARIANTS.items() if not names or name in names or name == REFERENCE}
    forms, chosen, programs = {}, {}, {}
    for name, variant in variants.items():
        tried = {form: Compiled(variant.stem, precision, form) for form in forms_of(variant.stem, include_grouped)}
        times = interleaved({form: program.run for form, program in tried.items()}, 2 if len(tried) > 1 else 1)
        forms[name] = {form: ms["median_ms"] for form, ms in times.items()}
        chosen[name] = min(tried, key=lambda form: times[form]["median_ms"])
        programs[name] = tried[chosen[name]]
        print(f"{name}: " + ", ".join(f"{form} {ms:.1f} ms" for form, ms in forms[name].items()), flush=True)
    found = interleaved({name: program.run for name, program in programs.items()}, repeats)
    alone = piece_times(variants.values(), repeats)
    records = {}
    for name, variant in variants.items():
        ms, executed = found[name]["median_ms"], programs[name].executed_gflop
        needed, pieces = needed_gflop(variant.stem), sorted(pieces_of(variant.stem).items())
        records[name] = {
            "form": chosen[name],
            "forms_ms": forms[name],
            **found[name],
            "ratio": round(ms / found[REFERENCE]["median_ms"], 3),
            "needed_gflop": round(needed, 2),
            "executed_gflop": round(executed, 2),
            "executed_gflop_per_s": round(1e3 * executed / ms, 1),
            "pieces": [{**piece._asdict(), "count": count, **alone[piece]} for piece, count in pieces],
            "pieces_ms": round(sum(count * alone[piece]["median_ms"] for piece, count in pieces), 3),
            "paper": paper_times(variant),
        }
    return records


class Piece(NamedTuple):
    """One convolution of ``"split"``."""

    size: int
    """Input channels."""
    out: int
    """Output channels."""
    dilation: int
    """Of the 3x3; 0 for the 1x1 that adds a group to the merged image."""


def pieces_of(stem: StemConfig) -> Counter[Piece]:
    """How many convolutions of which kind ``"split"`` makes of a stem.

    >>> pieces_of(StemConfig())[Piece(5, 32, 6)], pieces_of(StemConfig())[Piece(32, 64, 0)]
    (9, 27)
    """
    groups = channel_groups(stem, SHAPE[-1] // 9)
    together = [groups[cut] for cut in bundles(groups, "split")]
    groups = [(sum(size for size, _ in some), sum(out for _, out in some)) for some in together]
    layers = [*groups, *[(out, out) for _, out in groups] * (stem.num_convs - 1)]
    spatial = [Piece(*channels, dilation) for dilation in stem.dilations for channels in layers]
    return Counter(spatial + [Piece(out, stem.out_channels, 0) for _, out in groups] * len(stem.dilations))


def piece_times(variants: Iterable[Variant], repeats: int) -> dict[Piece, dict[str, float]]:
    """Every different convolution of the variants by itself: ``median_ms``, ``p99_ms`` and ``gflop_per_s``."""
    calls, gflop = {}, {}
    merged = jnp.zeros((*SHAPE[:3], BASE.out_channels))
    for piece in sorted({piece for variant in variants for piece in pieces_of(variant.stem)}):
        size = 3 if piece.dilation else 1
        image = jax.random.normal(jax.random.key(0), (*SHAPE[:3], piece.size))
        kernel = jax.random.normal(jax.random.key(1), (size, size, piece.size, piece.out))
        if piece.dilation:
            convolved = functools.partial(convolve, dilation=piece.dilation)
            program = functools.partial(jax.jit(convolved), image, kernel)
        else:
            program = functools.partial(jax.jit(lambda x, k, sum: sum + convolve(x, k)), image, kernel, merged)
        calls[str(piece)], gflop[piece] = program, 2e-9 * SHAPE[1] * SHAPE[2] * kernel.size
    found = interleaved(calls, repeats)
    return {
        piece: {**found[str(piece)], "gflop_per_s": round(1e3 * count / found[str(piece)]["median_ms"], 1)}
        for piece, count in gflop.items()
    }


def paper_times(variant: Variant) -> dict[str, dict[str, float]]:
    """Times of a variant in the paper, and their ratios to its stem's in the same table."""
    tables, of_base = PAPER["tables"], dict(VARIANTS[REFERENCE].rows)
    times = {}
    for table, row in variant.rows:
        rows = tables[table]["rows"]
        if "time_ms" in rows[row]:
            ms = rows[row]["time_ms"]
            times[f"{table}, {row}"] = {
                "time_ms": ms,
                "ratio": round(ms / rows[of_base[table]]["time_ms"], 3),
            }
    return times


def order_differences(records: dict[str, dict[str, Any]]) -> list[str]:
    """Pairs that one table of the paper orders the other way, a line each with the numbers of both."""
    lines = []
    for table in ("table3", "table4"):
        ours = {
            row: (name, records[name])
            for name, variant in VARIANTS.items()
            for of, row in variant.rows
            if of == table and name in records
        }
        rows = PAPER["tables"][table]["rows"]
        for a, (first, one) in ours.items():
            for b, (second, other) in ours.items():
                if rows[a]["time_ms"] < rows[b]["time_ms"] and one["median_ms"] > other["median_ms"]:
                    told = "; ".join(
                        f"{n} {r['needed_gflop']:.1f} GFLOP needed, {r['executed_gflop']:.1f} executed as "
                        f"{r['form']!r} at {r['executed_gflop_per_s']:.0f} GFLOP/s ({told_of(r)})"
                        for n, r in ((first, one), (second, other))
                    )
                    lines.append(f"{table}: {first} is faster than {second} in the paper, slower here: {told}")
    return lines


def told_of(record: dict[str, Any]) -> str:
    """The convolutions of a variant by kind, dilations taken together, and what they take one by one."""
    counts: Counter[str] = Counter()
    times: Counter[str] = Counter()
    for piece in record["pieces"]:
        kind = f"{piece['size']} to {piece['out']}" + ("" if piece["dilation"] else " merges")
        counts[kind] += piece["count"]
        times[kind] += piece["count"] * piece["median_ms"]
    return ", ".join(f"{counts[kind]} of {kind}: {ms:.1f} ms" for kind, ms in times.items())


def as_text(record: dict[str, Any]) -> str:
    """The table, ours beside the paper's."""
    lines = [
        f"stem alone, {'x'.join(map(str, SHAPE[1:]))}, {record['precision']}, {record['repeats']} turns, "
        f"{hardware_line()}",
        f"{'':24s}{'form':>8s}{'ms':>10s}{'p99':>10s}{'ratio':>7s}{'needed':>9s}{'executed':>10s}{'GFLOP/s':>9s}"
        f"{'one by one':>12s}   paper, ms (ratio)",
    ]
    for name, r in record["variants"].items():
        theirs = ", ".join(f"{where}: {p['time_ms']} ({p['ratio']:.2f})" for where, p in r["paper"].items())
        lines.append(
            f"{name:24s}{r['form']:>8s}{r['median_ms']:10.2f}{r['p99_ms']:10.2f}{r['ratio']:7.2f}"
            f"{r['needed_gflop']:9.1f}{r['executed_gflop']:10.1f}{r['executed_gflop_per_s']:9.0f}"
            f"{r['pieces_ms']:12.0f}   {theirs or '-'}"
        )
    lines.append("needed, executed: GFLOP; GFLOP/s of the executed; one by one: ms of its convolutions")
    lines.append(f"paper: {PAPER['times']}: compare the ratios, not the times")
    return "\n".join(lines + record["order_differences"])


def measure(args: Args) -> dict[str, Any]:
    """Times of the variants."""
    variants = module_latency(
        args.only, repeats=args.repeats, include_grouped=args.include_grouped, precision=args.precision
    )
    return {
        "variants": variants,
        "order_differences": order_differences(variants),
        "precision": args.precision,
        "repeats": args.repeats,
    }


def figures(names: Mapping[str, str], args: Args) -> dict[str, Any]:
    """For a table of the paper.

    Args:
        names: label of a row -> its variant.
        args: how often and how precisely; the variants are those of the names.
    """
    measured = measure(dataclasses.replace(args, only=tuple(names.values())))
    columns: dict[str, dict[str, float]] = {}
    for label, name in names.items():
        found = measured["variants"][name]
        theirs = next(iter(found["paper"].values()))
        columns[label] = {
            "module, ms": found["median_ms"],
            "ratio": found["ratio"],
            "module, ms, paper": theirs["time_ms"],
            "ratio, paper": theirs["ratio"],
        }
    return {"columns": columns, "lines": ["```", as_text(measured), "```"], "measured": measured}


def main(args: Args) -> None:
    """Measure, print, write."""
    for name in args.only:
        if name not in VARIANTS:
            raise ValueError(f"--only: got {name!r}, expected some of {', '.join(VARIANTS)}")
    record = measure(args)
    save(record, args.out, as_text(record))


if __name__ == "__main__":
    run_script(main, Args, __doc__)

"""How long do the modality-wise convolutions take, by the variants of tables 3, 4 and 5?

    python -m experiments.benchmarks.module_latency  # the stem alone, at full size: 64x1088x45
    python -m experiments.benchmarks.module_latency --include-grouped  # feature_group_count too, slow on a CPU

Every variant is computed in the fastest of its formulations (see ``Stem``), found by a short run of all of them;
then all variants run turn by turn. ``needed`` are the operations of the mathematics, ``executed`` what XLA counts
in the compiled program: without those on the zero padding, with those on the zeros of a block-diagonal kernel.
Every convolution of ``"split"`` is also timed by itself: what a variant's convolutions take one by one explains
its place. Cost: 15 turns take about six minutes on two CPU cores. The result is in README.md.
"""

import dataclasses
import functools
import itertools
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from experiments.benchmarks.latency import STEM_FORMS
from experiments.hardware import hardware_line
from experiments.paper import PAPER
from experiments.script import Options, run_measurement
from fcos_lidar_jax.config import StemConfig
from fcos_lidar_jax.inference.timing import Call, interleaved
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models.convolution import convolve
from fcos_lidar_jax.models.modality import Form, Stem, bundles, channel_groups
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.sensors import NUSCENES_HDL32E

BASE = NUSCENES.model.stem
_LAYOUT = image_layout(NUSCENES_HDL32E, NUSCENES.model)
SHAPE = (1, _LAYOUT.height, _LAYOUT.width, 9 * NUSCENES.projection.num_rounds)  # Of the network's input.


class Variant(NamedTuple):
    """What is timed, and the rows of the paper that it is: table -> row."""

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
REFERENCE = "9 types"  # The paper's stem: ratios are to it.


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """What to time, and how often."""

    only: tuple[str, ...] = ()  # Of the variants, by name, beside "9 types"; default: all.
    include_grouped: bool | None = None  # Try feature_group_count as well; default: not on a CPU.
    precision: Literal["float32", "bfloat16"] = "float32"  # Of the convolutions behind the first.
    repeats: int = 15  # Turns.


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


def compiled(stem: StemConfig, precision: str, form: Form) -> tuple[Call, float]:
    """One formulation of a variant, with random weights and input, and the 10^9 operations that it executes."""
    module = Stem(stem, precision=precision, form=form)
    image = jax.random.normal(jax.random.key(0), SHAPE, jnp.float32)
    variables = jax.jit(lambda: module.init(jax.random.key(1), jnp.zeros((1, 8, 8, SHAPE[-1])), train=False))()
    program = jax.jit(lambda v, x: module.apply(v, x, train=False)).lower(variables, image).compile()
    cost: Any = program.cost_analysis()
    return lambda: program(variables, image), float(cost.get("flops", 0.0)) / 1e9


class Piece(NamedTuple):
    """One convolution of ``"split"``: a 3x3, or, of dilation 0, the 1x1 that adds a group to the merged image."""

    size: int  # Input channels.
    out: int  # Output channels.
    dilation: int


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
            calls[piece] = functools.partial(jax.jit(convolved), image, kernel)
        else:
            added = jax.jit(lambda x, k, sum: sum + convolve(x, k))
            calls[piece] = functools.partial(added, image, kernel, merged)
        gflop[piece] = 2e-9 * SHAPE[1] * SHAPE[2] * kernel.size
    found = interleaved(calls, repeats)
    return {p: {**ms, "gflop_per_s": round(1e3 * gflop[p] / ms["median_ms"], 1)} for p, ms in found.items()}


def _paper_times(variant: Variant) -> dict[str, dict[str, float]]:
    times = {}
    for table, row in variant.rows.items():
        rows = PAPER["tables"][table]["rows"]
        if "time_ms" in rows[row]:
            ms, base = rows[row]["time_ms"], rows[VARIANTS[REFERENCE].rows[table]]["time_ms"]
            times[f"{table}, {row}"] = {"time_ms": ms, "ratio": round(ms / base, 3)}
    return times


def measure(args: Args) -> dict[str, Any]:
    """The variants' times.

    Returns:
        ``variants``, for each: ``form`` (the fastest), ``forms_ms`` (the short run of all), ``median_ms``,
        ``p99_ms``, ``ratio`` to the reference, ``needed_gflop``, ``executed_gflop``, ``executed_gflop_per_s``;
        ``pieces``, count, time and speed of each convolution by itself, and their sum ``pieces_ms``; ``paper``,
        ``{"table, row": {"time_ms", "ratio"}}`` if it has any. Beside them ``order_differences`` and options.

    Raises:
        ValueError: there is no variant of a name that is asked for.
    """
    for name in args.only:
        if name not in VARIANTS:
            raise ValueError(f"--only: got {name!r}, expected some of {', '.join(VARIANTS)}")
    grouped = jax.default_backend() != "cpu" if args.include_grouped is None else args.include_grouped
    variants = {n: v for n, v in VARIANTS.items() if not args.only or n in (*args.only, REFERENCE)}
    forms, chosen, programs, executed = {}, {}, {}, {}
    for name, variant in variants.items():
        tried = {form: compiled(variant.stem, args.precision, form) for form in forms_of(variant.stem, grouped)}
        times = interleaved({form: call for form, (call, _) in tried.items()}, 2 if len(tried) > 1 else 1)
        forms[name] = {form: ms["median_ms"] for form, ms in times.items()}
        chosen[name] = min(tried, key=lambda form: times[form]["median_ms"])
        programs[name], executed[name] = tried[chosen[name]]
        print(f"{name}: " + ", ".join(f"{form} {ms:.1f} ms" for form, ms in forms[name].items()), flush=True)
    found = interleaved(programs, args.repeats)
    alone = piece_times(variants.values(), args.repeats)
    records = {}
    for name, variant in variants.items():
        ms, pieces = found[name]["median_ms"], sorted(pieces_of(variant.stem).items())
        records[name] = {
            "form": chosen[name],
            "forms_ms": forms[name],
            **found[name],
            "ratio": round(ms / found[REFERENCE]["median_ms"], 3),
            "needed_gflop": round(needed_gflop(variant.stem), 2),
            "executed_gflop": round(executed[name], 2),
            "executed_gflop_per_s": round(1e3 * executed[name] / ms, 1),
            "pieces": [{**piece._asdict(), "count": count, **alone[piece]} for piece, count in pieces],
            "pieces_ms": round(sum(count * alone[piece]["median_ms"] for piece, count in pieces), 3),
            "paper": _paper_times(variant),
        }
    measured = {"variants": records, "order_differences": order_differences(records)}
    return {**measured, "precision": args.precision, "repeats": args.repeats}


def order_differences(records: dict[str, dict[str, Any]]) -> list[str]:
    """Pairs that one table of the paper orders the other way, a line each with the numbers of both."""

    def described(name: str) -> str:
        r = records[name]
        return (
            f"{name} {r['needed_gflop']:.1f} GFLOP needed, {r['executed_gflop']:.1f} executed as "
            f"{r['form']!r} at {r['executed_gflop_per_s']:.0f} GFLOP/s ({told_of(r)})"
        )

    lines = []
    for table in ("table3", "table4"):
        rows, known = PAPER["tables"][table]["rows"], [name for name in records if table in VARIANTS[name].rows]
        for first, second in itertools.permutations(known, 2):
            a, b = (rows[VARIANTS[name].rows[table]]["time_ms"] for name in (first, second))
            if a < b and records[first]["median_ms"] > records[second]["median_ms"]:
                both = f"{described(first)}; {described(second)}"
                lines.append(f"{table}: {first} is faster than {second} in the paper, slower here: {both}")
    return lines


def told_of(record: dict[str, Any]) -> str:
    """The convolutions of a variant by kind, dilations taken together, and what they take one by one."""
    counts, times = Counter[str](), Counter[str]()
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


def figures(names: Mapping[str, str], args: Args) -> dict[str, Any]:
    """For a table of the paper, from its rows' labels with their variants, whatever ``args.only`` says."""
    measured = measure(dataclasses.replace(args, only=tuple(names.values())))
    columns: dict[str, dict[str, float]] = {}
    for label, name in names.items():
        ours = measured["variants"][name]
        theirs = next(iter(ours["paper"].values()))
        columns[label] = {"module, ms": ours["median_ms"], "ratio": ours["ratio"]}
        columns[label] |= {"module, ms, paper": theirs["time_ms"], "ratio, paper": theirs["ratio"]}
    return {"columns": columns, "lines": ["```", as_text(measured), "```"]}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__, as_text)

"""Tables 1 to 7 of the paper: their rows, and their figures that need no training (``--only-figures``)."""

from functools import partial
from typing import Any

from experiments.benchmarks import latency, module_latency, mrv_figures
from experiments.changes import change
from experiments.paper import TIMES_NOTE
from experiments.paper_tables.tables import Args, Row, Table, simulated_scale

_SWEEPS = {"single": 1, "multi": 10}  # Setting -> fused sweeps.
_GROUPS = ("one group", "5 modalities", "9 types", "9 types, rounds apart")
_DILATIONS = ((1,), (1, 3), (1, 3, 6), (1, 1, 1))


def _rounds_label(setting: str, rounds: int) -> str:
    return f"{setting}, {rounds} round" + ("s" if rounds > 1 else "")


def _points_and_times(args: Args) -> dict[str, Any]:
    """Points kept per number of rounds, of a real cloud and of the scale's clouds, and times of the projection."""
    repeats = 10 if args.scale == "smoke" else 100
    measured = mrv_figures.measure(mrv_figures.Args(data=args.data, repeats=repeats))
    scale, columns = simulated_scale(args), {}
    for setting, sweeps in _SWEEPS.items():
        kept = measured["kept"][f"{'ten sweeps' if sweeps > 1 else 'one sweep'}, without close points"]
        here = mrv_figures.mean_kept(scale.clouds(sweeps), scale.sensor) if scale else None
        for rounds in mrv_figures.ROUNDS:
            r, column = str(rounds), columns.setdefault(_rounds_label(setting, rounds), {})
            column["points kept, %"] = kept["prioritized"]["percent"][r]
            column["MRV, ms"] = measured["times"][setting][r]["median_ms"]
            if setting == "multi":  # The paper's times are understood as times of ten sweeps.
                column["MRV, ms, paper"] = measured["paper_times"][r]["median_ms"]
            if here:
                column["points kept, %, this scale"] = here["prioritized"]["percent"][r]
    return {"columns": columns, "lines": [f"Measured on a {measured['cloud']}.", TIMES_NOTE]}


def _current_points(args: Args) -> dict[str, Any]:
    """Kept points of the current sweep, of simulated clouds."""
    scale = simulated_scale(args)
    if scale is None:
        return {}
    mean = mrv_figures.mean_kept(scale.clouds(scale.base.num_sweeps), scale.sensor)
    rows = {"without priority": "not prioritized", "with priority": "prioritized"}
    current = {row: mean[name]["current"][str(scale.base.projection.num_rounds)] for row, name in rows.items()}
    return {"columns": {row: {"current points kept, this scale": number} for row, number in current.items()}}


def _stem_times(variants: dict[str, str], args: Args) -> dict[str, Any]:
    """Times of the stem; ``variants`` maps the labels of rows to variants of ``module_latency.py``."""
    options = module_latency.Args(repeats=2 if args.scale == "smoke" else 15, precision=args.nuscenes.precision)
    measured, columns = module_latency.measure(options, variants.values())["variants"], {}
    for label, name in variants.items():
        ours = measured[name]
        theirs = next(iter(ours["paper"].values()))
        columns[label] = {"module, ms": ours["median_ms"], "ratio": ours["ratio"]}
        columns[label] |= {"module, ms, paper": theirs["time_ms"], "ratio, paper": theirs["ratio"]}
    return {"columns": columns, "lines": [TIMES_NOTE]}


def _stage_times(args: Args) -> dict[str, Any]:
    """Times of the stages of the paper's preset, see ``latency.py``."""
    preset, repeats = ("quickstart", 3) if args.scale == "smoke" else ("nuscenes", 15)
    measured = latency.measure(
        latency.Args(preset=preset, precision=args.nuscenes.precision, data=args.data, repeats=repeats)
    )
    columns = {}
    for setting, times in measured["times"].items():
        columns[f"{setting}-frame"] = column = {f"{stage}, ms": ms["median_ms"] for stage, ms in times.items()}
        paper = measured["paper"][setting]
        column |= {f"{stage}, ms, paper": paper[name] for stage, name in latency.PAPER_STAGES.items()}
    return {"columns": columns, "lines": [f"Measured on a {measured['cloud']}.", TIMES_NOTE]}


PAPER_TABLES = (
    # The paper: on ten sweeps, five rounds gain 2.1 mAP over one; on one sweep, three gain 0.6 and five 0.3.
    Table(
        "table1",
        "Table 1: multi-round projection",
        tuple(
            Row(
                _rounds_label(setting, rounds),
                change(num_sweeps=sweeps, projection__num_rounds=rounds),
                f"{setting}, {rounds}",
                reference=_rounds_label(setting, 1),
            )
            for setting, sweeps in _SWEEPS.items()
            for rounds in mrv_figures.ROUNDS
        ),
        reference="multi, 1 round",
        figures=_points_and_times,
    ),
    # The paper: without priority, ten sweeps lose 2.8 mAP.
    Table(
        "table2",
        "Table 2: priority of the current sweep",
        (
            Row("without priority", change(projection__prioritize_current=False), "not prioritized"),
            Row("with priority", change(), "prioritized"),
        ),
        reference="without priority",
        figures=_current_points,
    ),
    # The paper: nine groups gain 0.7 mAP over one group in half the time; ungrouped rounds lose 0.25.
    Table(
        "table3",
        "Table 3: modality-wise convolutions",
        (
            Row("one group", change(model__stem__groups="all"), "1 group"),
            Row("5 modalities", change(model__stem__groups="modalities"), "5 groups"),
            Row("9 types", change(), "9 groups"),
            Row("9 types, rounds apart", change(model__stem__group_rounds=False), "9 groups, rounds not grouped"),
        ),
        reference="one group",
        figures=partial(_stem_times, {name: name for name in _GROUPS}),
    ),
    # The paper: two convolutions gain 1.3 mAP over one; a third gains nothing.
    Table(
        "table4",
        "Table 4: layers of modality-wise convolutions",
        tuple(Row(f"{n}", change(model__stem__num_convs=n), str(n)) for n in (1, 2, 3)),
        reference="1",
        figures=partial(_stem_times, {"1": "1 convolution", "2": "9 types", "3": "3 convolutions"}),
    ),
    # The paper: (1, 3, 6) gains 1.2 mAP over (1,) and 0.45 over three equal branches.
    Table(
        "table5",
        "Table 5: dilations",
        tuple(Row(str(rates), change(model__stem__dilations=rates), str(rates)) for rates in _DILATIONS),
        reference="(1,)",
    ),
    # The paper: one head per level gains 0.6 mAP.
    Table(
        "table6",
        "Table 6: heads of the levels",
        (Row("tied", change(model__tied_heads=True), "tied"), Row("untied", change(), "untied")),
        reference="tied",
    ),
    # The paper: the projection takes a fiftieth of the time, and ten sweeps cost no more than one. Its times are
    # of a 3090Ti, so only the shares can be compared on other hardware.
    Table(
        "table7",
        "Table 7: one sweep and ten",
        (
            Row("single-frame", change(num_sweeps=1), "FCOS-LiDAR, single"),
            Row("multi-frame", change(), "FCOS-LiDAR, multi"),
        ),
        reference="single-frame",
        figures=_stage_times,
    ),
)

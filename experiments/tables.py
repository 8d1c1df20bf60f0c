"""The paper's tables, one after the other or all: ``python experiments/tables.py --scale smoke``.

Every table prints our figure beside the paper's, writes Markdown, JSON and a picture below ``--out``, and can be
stopped and started again; the same command in several processes shares their cells. On two CPU cores ``--scale
smoke`` takes a quarter of an hour. ``--scale simulated`` wants a GPU or a night, ``--scale nuscenes`` the data.
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import tyro
from grid import Change, interval, run_cells
from hardware import hardware
from scales import NuScenesLayout, Simulated, simulated, smoke

from fcos_lidar_jax.config import NUSCENES
from fcos_lidar_jax.files import write_beside

PAPER = json.loads(Path(__file__).with_name("paper.json").read_text(encoding="utf-8"))
SCORES = ("mAP", "NDS")


@dataclasses.dataclass(frozen=True)
class Args:
    """At which scale, and where the results go."""

    scale: Literal["smoke", "simulated", "nuscenes"] = "smoke"
    """Minutes on a toy; the quickstart on hurried simulated streets; the real thing."""
    seeds: tuple[int, ...] = ()
    """Of every cell; default: 0 for smoke, else 0, 1 and 2."""
    out: Path = Path("outputs/tables")
    """Folder of tables and cells; a folder of the scale's name below it."""
    runs: Path = Path("outputs/runs")
    """Folder of the training runs and of the simulated frames."""
    data: Path | None = None
    """Folder with ten_sweep_cloud/ for the figures of a real cloud; default: the environment's
    FCOS_LIDAR_REAL_DATA, else a simulated one."""
    data_root: Path | None = None
    """Of --scale nuscenes."""
    version: str = "v1.0-trainval"
    """Of --scale nuscenes."""
    test_version: str | None = None
    """Of --scale nuscenes: version whose split test table 8 writes a results file for, such as v1.0-test."""
    only_figures: bool = False
    """Without training."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of a table."""

    label: str
    """As it is printed."""
    change: Change
    """What it changes in the scale's base."""
    paper: str | None = None
    """Key of the paper's row."""
    gain: str | None = None
    """Key among the paper's texts of a gain in mAP that it states without a row."""
    reference: str | None = None
    """Label of the row that its differences are taken from; default: the table's."""


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of the paper, as an experiment."""

    name: str
    """Key in ``paper.json``, if it is one of the paper's."""
    title: str
    """What it asks."""
    rows: tuple[Row, ...]
    """In the paper's order."""
    reference: str
    """Label of the row that differences are taken from, unless a row names its own."""
    figures: Callable[[Args], dict[str, Any]] | None = None
    """Measured without training: ``{"columns": {label: {column: value}}, "lines": [text], ...}``."""


def simulated_scale(args: Args) -> Simulated | None:
    """The scale that is asked for, if its frames are simulated."""
    make = {"smoke": smoke, "simulated": simulated}.get(args.scale)
    return make(args.runs / "frames") if make else None


def make_scale(args: Args) -> Simulated | NuScenesLayout:
    """The scale that is asked for."""
    scale = simulated_scale(args)
    if scale is not None:
        return scale
    if args.data_root is None:
        raise SystemExit("error: --data-root: missing, expected the data set for --scale nuscenes")
    return NuScenesLayout("nuscenes", NUSCENES, args.data_root, args.version)


def run_table(table: Table, args: Args) -> dict[str, Any]:
    """Train what is missing, measure, print, write; the record."""
    folder = args.out / args.scale
    seeds = args.seeds or ((0,) if args.scale == "smoke" else (0, 1, 2))
    scores: dict[str, list[dict[str, Any]]] = {}
    if not args.only_figures:
        scale = make_scale(args)
        cells = [(row.change(scale.base), seed) for row in table.rows for seed in seeds]
        found = iter(run_cells(cells, scale, results=folder / "cells", runs=args.runs / args.scale))
        scores = {row.label: [next(found) for _ in seeds] for row in table.rows}
    figures = table.figures(args) if table.figures else {}
    record = {
        "table": table.name,
        "scale": args.scale,
        "seeds": list(seeds) if scores else [],
        "rows": [_row_record(table, row, scores) for row in table.rows],
        "figures": figures,
        **hardware(),
    }
    text = as_markdown(table, record)
    print(text, flush=True)
    write_beside(folder / f"{table.name}.json", lambda path: path.write_text(json.dumps(record, indent=1)))
    write_beside(folder / f"{table.name}.md", lambda path: path.write_text(text, encoding="utf-8"))
    if len(seeds) > 1 and scores:
        draw(table, record, folder / f"{table.name}.png")
    return record


def _row_record(table: Table, row: Row, scores: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Scores of a row, their difference to the reference, seed by seed, and the paper's."""
    paper = PAPER["tables"].get(table.name, {"rows": {}})["rows"]
    reference = next(r for r in table.rows if r.label == (row.reference or table.reference))
    theirs, base_of_theirs = paper.get(row.paper, {}), paper.get(reference.paper, {})
    record: dict[str, Any] = {"label": row.label, "reference": reference.label, "paper": theirs}
    record["paper_difference"] = {
        s: round(theirs[s] - base_of_theirs[s], 2) for s in SCORES if s in theirs and s in base_of_theirs
    }
    if row.gain is not None:
        record["paper_difference"] = {"mAP": PAPER["text"][row.gain]["value"]}
    if row.label in scores:
        mine, base = scores[row.label], scores[reference.label]
        record["scores"] = mine
        for s in SCORES:
            values = [100 * cell[s] for cell in mine]
            differences = [v - 100 * cell[s] for v, cell in zip(values, base, strict=True)]
            record[s] = {"mean": sum(values) / len(values), "interval": interval(values)}
            record[f"{s}_difference"] = {
                "mean": sum(differences) / len(differences),
                "interval": interval(differences),
            }
    return record


def as_markdown(table: Table, record: dict[str, Any]) -> str:
    """The table, ours beside the paper's."""
    columns = record["figures"].get("columns", {})
    extra = list(dict.fromkeys(name for values in columns.values() for name in values))
    trained = any("mAP" in row for row in record["rows"])
    header = [""]
    for s in SCORES:
        header += [f"{s}, ours", "difference, ours"] if trained else []
        header += [f"{s}, paper", "difference, paper"]
    lines = [f"### {table.title}", "", f"Scale `{record['scale']}`, seeds {record['seeds'] or 'none'}.", ""]
    lines += ["| " + " | ".join([*header, *extra]) + " |", "|---" * (len(header) + len(extra)) + "|"]
    for row in record["rows"]:
        cells = [row["label"]]
        for s in SCORES:
            if trained:
                cells += [_told(row.get(s)), _told(row.get(f"{s}_difference"), sign=True)]
            cells += [_number(row["paper"].get(s)), _number(row["paper_difference"].get(s), sign=True)]
        cells += [_number(columns.get(row["label"], {}).get(name)) for name in extra]
        lines.append("| " + " | ".join(cells) + " |")
    references = " or ".join(f'"{name}"' for name in _references(record))
    drawn = ", seed by seed; 95 % intervals of Student's t" if trained else ""
    lines += ["", f"Differences are to {references}{drawn}.", ""]
    return "\n".join(lines + [str(line) for line in record["figures"].get("lines", [])]) + "\n"


def _references(record: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(row["reference"] for row in record["rows"]))


def _number(value: Any, sign: bool = False) -> str:
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    return f"{value:+.2f}" if sign else f"{value:.2f}"


def _told(value: dict[str, Any] | None, sign: bool = False) -> str:
    if value is None:
        return "-"
    text = _number(value["mean"], sign)
    if value["interval"] is None:
        return text
    _, low, high = value["interval"]
    return f"{text} [{_number(low, sign)}, {_number(high, sign)}]"


def draw(table: Table, record: dict[str, Any], path: Path) -> None:
    """Our differences in mAP with their intervals, and the paper's."""
    from fcos_lidar_jax.visualization.figure import new_figure, save_png

    rows = record["rows"]
    figure = new_figure(7.5, 1.2 + 0.45 * len(rows))
    axis = figure.add_subplot()
    for i, row in enumerate(rows):
        ours = row["mAP_difference"]
        if ours["interval"] is not None:
            _, low, high = ours["interval"]
            axis.plot([low, high], [i, i], color="#0072b2", linewidth=2, solid_capstyle="butt")
        axis.plot(ours["mean"], i, "o", color="#0072b2", label="ours, 95 % interval" if i == 0 else None)
        if "mAP" in row["paper_difference"]:
            theirs = row["paper_difference"]["mAP"]
            axis.plot(theirs, i, "D", color="#d55e00", markersize=5, label="paper" if i == 0 else None)
    axis.axvline(0, color="#888888", linewidth=0.8)
    axis.set_yticks(range(len(rows)), [row["label"] for row in rows])
    axis.invert_yaxis()
    axis.set_xlabel("mAP, points more than " + " or ".join(f'"{name}"' for name in _references(record)))
    axis.set_title(f"{table.title} ({record['scale']}, {len(record['seeds'])} seeds)", fontsize=11)
    axis.legend(fontsize=9, frameon=False)
    axis.spines[["top", "right"]].set_visible(False)
    save_png(figure, path)


def main(args: Args) -> None:
    """All tables."""
    from table1_mrv_rounds import TABLE as TABLE_1
    from table2_priority import TABLE as TABLE_2
    from table3_modality_groups import TABLE as TABLE_3
    from table4_num_convs import TABLE as TABLE_4
    from table5_dilations import TABLE as TABLE_5
    from table6_untied_heads import TABLE as TABLE_6
    from table7_latency import TABLE as TABLE_7
    from table8_test_submission import TABLE as TABLE_8

    for table in (TABLE_1, TABLE_2, TABLE_3, TABLE_4, TABLE_5, TABLE_6, TABLE_7, TABLE_8):
        run_table(table, args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

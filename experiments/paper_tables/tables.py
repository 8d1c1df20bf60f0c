"""Tables: rows, training of their cells, record, Markdown and curves. ``cells.csv`` has the other scores."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from experiments.benchmarks.latency import real_cloud
from experiments.changes import Change
from experiments.hardware import hardware
from experiments.paper import PAPER
from experiments.paper_tables.cells import Cell
from experiments.paper_tables.grid import run_cells
from experiments.paper_tables.scales import NuScenesLayout, Scale, Simulated, quarter, smoke
from experiments.script import compact_json, markdown_table
from experiments.statistics import gain, interval, seeds_needed
from fcos_lidar_jax.config import config_to_json
from fcos_lidar_jax.files import atomic_write, file_lock

SCORES = ("mAP", "NDS")


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of a table."""

    scale: Literal["smoke", "sector", "nuscenes"] = "smoke"
    """smoke: a toy network, in minutes. sector: a small network on simulated streets,
    in a quarter of the view of the nuScenes sensor. nuscenes: the paper's detector on nuScenes."""
    rows: tuple[str, ...] = ()  # Labels of the rows to train, in addition to the reference; default: all.
    seeds: tuple[int, ...] = ()  # Seeds of each row; default: 0 for smoke, otherwise 0, 1 and 2.
    out: Path = Path("outputs/tables")  # Folder of tables and cells, with one subfolder per scale.
    runs: Path = Path("outputs/runs")  # Folder of training runs and simulated frames.
    data: Path | None = None
    """Folder with ten_sweep_cloud/ for figures of a real cloud; default: the environment's FCOS_LIDAR_REAL_DATA,
    otherwise a simulated cloud."""
    simulators: int = 0
    """Processes that simulate the training frames of smoke and sector during the training, for a GPU. One more
    simulates the test frames."""
    only_figures: bool = False  # Only measure what needs no training, into separate files.
    nuscenes: tyro.conf.OmitArgPrefixes[NuScenesLayout] = dataclasses.field(default_factory=NuScenesLayout)
    """Options of --scale nuscenes."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of a table."""

    label: str  # Printed label.
    change: Change  # Change of the scale's base configuration.
    paper: str | None = None  # Key of the paper's row.
    gain: str | None = None  # Key in the paper's texts of a gain in mAP that is stated without a row.
    reference: str | None = None  # Label of the row that differences are relative to; default: the table's.


@dataclasses.dataclass(frozen=True)
class Table:
    """A table whose rows are trained and measured."""

    name: str  # Key in ``paper.json``, for a table of the paper.
    title: str  # Printed title.
    rows: tuple[Row, ...]  # Rows in the paper's order.
    reference: str  # Label of the row that differences are relative to, unless a row names its own.
    figures: Callable[[Args], dict[str, Any]] | None = None
    """Measures what needs no training: ``{"columns": {label: {column: value}}, "lines": [text], ...}``."""
    lines: Callable[[dict[str, Any]], Iterator[str]] | None = None  # Makes more lines from the table's record.

    def __post_init__(self) -> None:
        labels = [row.label for row in self.rows]
        references = [self.reference, *(row.reference for row in self.rows if row.reference)]
        if len({*labels}) < len(labels) or not {*references} <= {*labels}:
            raise ValueError(f"table {self.name}: got rows {labels}, expected different ones, with {references}")

    def only(self, labels: tuple[str, ...]) -> "Table":
        """Select the rows with these labels and their references; all rows without labels."""
        if unknown := [label for label in labels if label not in [row.label for row in self.rows]]:
            known = ", ".join(row.label for row in self.rows)
            raise ValueError(f"--rows: got {unknown[0]!r}, expected some of: {known}")
        if not labels:
            return self
        needed = {self.reference, *labels, *(r.reference for r in self.rows if r.label in labels)}
        return dataclasses.replace(self, rows=tuple(row for row in self.rows if row.label in needed))

    def reference_of(self, row: Row) -> Row:
        """Return the row that a row's differences are relative to."""
        return next(r for r in self.rows if r.label == (row.reference or self.reference))

    def paper_difference(self, row: Row) -> dict[str, float]:
        """Score -> gain over the reference in the paper, if stated there."""
        if row.gain is not None:
            return {"mAP": PAPER["text"][row.gain]["value"]}
        own, base = (self.paper_rows.get(r.paper, {}) for r in (row, self.reference_of(row)))
        return {s: round(own[s] - base[s], 2) for s in SCORES if s in own and s in base}

    @property
    def paper_rows(self) -> dict[Any, Any]:
        """Rows of the paper's table; empty for other tables."""
        return PAPER["tables"].get(self.name, {"rows": {}})["rows"]


def simulated_scale(args: Args) -> Simulated | None:
    """Create the selected scale if its frames are simulated."""
    make = {"smoke": smoke, "sector": quarter}.get(args.scale)
    return make(args.runs / "frames") if make else None


def make_scale(args: Args) -> Simulated | NuScenesLayout:
    """Create the selected scale."""
    return simulated_scale(args) or args.nuscenes.checked()


def run_table(table: Table, args: Args) -> dict[str, Any]:
    """Train missing cells, measure, print and write a table; returns its record."""
    _check(args)
    table = table.only(args.rows)
    here, folder = hardware(), args.out / args.scale
    seeds = args.seeds or ((0,) if args.scale == "smoke" else (0, 1, 2))
    scale = None if args.only_figures else make_scale(args)
    cells = {} if scale is None else _cells(table, scale, seeds, folder, args)
    file = folder / f"{table.name}{'_figures' if args.only_figures else ''}"
    # One process at a time, so that processes of the same table do not disturb each other's times.
    with file_lock(args.runs / args.scale / f"{file.name}.lock", wait=True):
        record = make_record(table, args.scale, scale, cells, table.figures(args) if table.figures else {})
        if table.lines is not None:
            record["figures"]["lines"] = [*record["figures"].get("lines", ()), *table.lines(record)]
        text = as_markdown(table, record)
        print(text, flush=True)
        # Scores and training data are in the files of the cells.
        rows = [{name: value for name, value in row.items() if name != "scores"} for row in record["rows"]]
        written = {**{name: value for name, value in record.items() if name != "trained_on"}, "rows": rows, **here}
        atomic_write(file.with_suffix(".json"), compact_json(written, 3) + "\n")
        atomic_write(file.with_suffix(".md"), text)
        if any(cell and "curve" in cell for row in record["rows"] for cell in row.get("scores", ())):
            draw_learning(table, record, file.with_name(f"{file.name}_curves.png"))
    return record


def make_record(
    table: Table, scale_name: str, scale: Scale | None, cells: dict[str, list[Cell]], figures: dict[str, Any]
) -> dict[str, Any]:
    """Combine the cells of a table's rows with the figures that need no training."""
    trained_on = None
    if scale is not None:
        reference = next(row for row in table.rows if row.label == table.reference)
        trained_on = {**scale.describe(), "reference": config_to_json(reference.change(scale.base))}
    return {
        "table": table.name,
        "scale": scale_name,
        "seeds": [cell["seed"] for cell in next(iter(cells.values()), [])],
        "trained_on": trained_on,
        "rows": [_row_record(table, row, cells) for row in table.rows],
        "figures": figures,
        "cells_of": sorted({f"{cell['git']} on {cell['device']}" for row in cells.values() for cell in row}),
    }


def _check(args: Args) -> None:
    if len({*args.seeds}) < len(args.seeds):
        raise ValueError(f"--seeds: got {args.seeds}, expected different seeds")
    real_cloud(args.data)
    if args.scale == "nuscenes" and args.simulators:
        raise ValueError("--simulators: expected none with --scale nuscenes: its frames are real")
    if args.scale != "nuscenes":
        for field in dataclasses.fields(NuScenesLayout):
            if getattr(args.nuscenes, field.name) != field.default:
                option = field.name.replace("_", "-")
                raise ValueError(f"--{option}: only for --scale nuscenes, got --scale {args.scale}")


def _cells(table: Table, scale: Scale, seeds: tuple[int, ...], results: Path, args: Args) -> dict[str, list[Cell]]:
    """Train or read the cells of each row, by label and in the order of the seeds."""
    configs = {row.label: row.change(scale.base) for row in table.rows}
    if isinstance(scale, Simulated):
        for config in configs.values():
            scale.check(config)
    # Seed by seed, so that an interrupted table has whole seeds.
    pairs = [(config, seed) for seed in seeds for config in configs.values()]
    labels = [f"{label}, seed {seed}" for seed in seeds for label in configs]
    with scale.simulating(args.simulators) if isinstance(scale, Simulated) else contextlib.nullcontext():
        cells = run_cells(pairs, scale, results=results, runs=args.runs / args.scale, labels=labels)
    return {label: cells[row :: len(configs)] for row, label in enumerate(configs)}


def _row_record(table: Table, row: Row, cells: dict[str, list[Cell]]) -> dict[str, Any]:
    """Scores of a row, differences to its reference, and the paper's scores."""
    reference = table.reference_of(row)
    record: dict[str, Any] = {"label": row.label, "reference": reference.label}
    record |= {"paper": table.paper_rows.get(row.paper, {}), "paper_difference": table.paper_difference(row)}
    if row.label in cells:
        own, base = cells[row.label], [cell.get("scores") for cell in cells[reference.label]]
        record["scores"] = scores = [cell.get("scores") for cell in own]
        record["diverged"] = [f"seed {cell['seed']}: {cell['diverged']}" for cell in own if "diverged" in cell]
        for s in SCORES:
            record[s] = _summary([100 * cell[s] for cell in scores if cell])
            arms = [[100 * cell[s] for cell in arm if cell] for arm in (scores, base)]
            record[f"{s}_difference"] = _difference(*arms) if all(arms) and row is not reference else None
    return record


def _summary(values: list[float]) -> dict[str, Any] | None:
    return {"mean": sum(values) / len(values), "interval": interval(values)} if values else None


def _difference(own: list[float], base: list[float]) -> dict[str, Any]:
    seeds = seeds_needed(own, base)
    known = {"mean": float(np.mean(own) - np.mean(base)), "interval": gain(own, base)}
    return known if seeds == "-" else known | {"seeds": seeds}


def as_markdown(table: Table, record: dict[str, Any]) -> str:
    """Format a table with our scores beside the paper's."""
    columns = record["figures"].get("columns", {})
    extra = list(dict.fromkeys(name for values in columns.values() for name in values))
    trained, of_paper = bool(record["seeds"]), any(row["paper_difference"] for row in record["rows"])
    header = [""]
    for s in SCORES:
        header += [f"{s}, ours", "difference, ours"] if trained else []
        header += [f"{s}, paper", "difference, paper"] if of_paper else []
    note = f"; {_training_text(record['trained_on'])}" if trained else ""
    lines = [f"### {table.title}", "", f"Scale `{record['scale']}`, seeds {record['seeds'] or 'none'}{note}.", ""]
    rows = []
    for row in record["rows"]:
        cells, itself = [row["label"]], row["label"] == row["reference"]
        for s in SCORES:
            if trained:
                cells += [_text(row.get(s)), "-" if itself else _text(row.get(f"{s}_difference"), sign=True)]
            if of_paper:
                difference = row["paper_difference"].get(s)
                cells += [_number(row["paper"].get(s)), "-" if itself else _number(difference, sign=True)]
        cells += [_number(columns.get(row["label"], {}).get(name)) for name in extra]
        rows.append(cells)
    lines += markdown_table([*header, *extra], rows)
    drawn = "; 95 % intervals of Student's t, of differences Welch's" if len(record["seeds"]) > 1 else ""
    references = " or ".join(dict.fromkeys(f'"{row["reference"]}"' for row in record["rows"]))
    lines += ["", f"Differences are to {references}{drawn}.", *_notes(record), ""]
    lines += [f"{row['label']}: {line}" for row in record["rows"] for line in row.get("diverged", ())]
    if trained:
        lines += [f"Trained by revision {'; '.join(record['cells_of'])}.", ""]
    return "\n".join(lines + [str(line) for line in record["figures"].get("lines", [])]) + "\n"


def _notes(record: dict[str, Any]) -> Iterator[str]:
    """Seeds that each difference would need, and warnings."""
    for s in SCORES:
        differences = {row["label"]: row.get(f"{s}_difference") or {} for row in record["rows"]}
        shown = [f"{n}: {d['seeds']}" for n, d in differences.items() if "seeds" in d]
        if shown:
            stay = "if means and deviations stay"
            yield f"Seeds with which the interval of {s} would exclude zero, {stay}: {'; '.join(shown)}."
    if record["scale"] == "smoke":
        yield "At this scale the scores mean nothing: they only show that the rows run."
    if len(record["seeds"]) == 2:
        yield "Two seeds can agree by chance: an interval of two says nothing about their spread."


def _training_text(trained_on: dict[str, Any]) -> str:
    """Describe the training of the table's reference row."""
    optimizer, model = trained_on["reference"]["optimizer"], trained_on["reference"]["model"]
    shown = {name: value for name, value in trained_on.items() if isinstance(value, int | float | str)}
    shown |= {
        "scale": None,
        **{name: trained_on[name]["name"] for name in ("streets", "sensor") if name in trained_on},
        "splits": " and ".join(trained_on.get("splits", ())) or None,
        "epochs": None if trained_on.get("steps") else optimizer["epochs"],
        "batch_size": optimizer["batch_size"],
        "accumulate": optimizer["accumulate"],
        "precision": model["precision"],
    }
    return "; ".join(f"{n.replace('_', ' ')} {str(v).lower()}" for n, v in shown.items() if v is not None)


def _number(value: Any, sign: bool = False) -> str:
    if value is None or np.isnan(value):
        return "-"
    return f"{value:+.2f}" if sign else f"{value:.2f}"


def _text(value: dict[str, Any] | None, sign: bool = False) -> str:
    if value is None:
        return "-"
    mean, *bounds = (_number(v, sign) for v in (value["interval"] or [value["mean"]]))
    return f"{mean} [{', '.join(bounds)}]" if bounds else mean


def draw_learning(table: Table, record: dict[str, Any], path: Path) -> None:
    """Draw the mAP of each row over the training samples: thin lines per seed, thick lines for the mean."""
    from fcos_lidar_jax.visualization.figure import new_figure, save_png

    figure = new_figure(7.5, 4)
    axis = figure.add_subplot()
    for i, row in enumerate(record["rows"]):
        curves = [np.array(cell["curve"]) for cell in row["scores"] if cell]
        if not curves:  # All seeds diverged.
            continue
        for curve in curves:
            axis.plot(curve[:, 0], 100 * curve[:, 1], color=f"C{i}", linewidth=0.5)
        mean = np.mean(curves, axis=0)
        axis.plot(mean[:, 0], 100 * mean[:, 1], color=f"C{i}", linewidth=2, label=row["label"])
    looked = record["trained_on"]["reference"]["refinement"] is not None  # trained on the finished detector
    score = f"mAP{' before the second look' if looked else ''}"
    axis.set(xlabel="samples seen", ylabel=score, ylim=(0, None))
    number = len(record["seeds"])
    trained = f"{record['scale']}, {number} seed{'s' if number > 1 else ''}"
    axis.set_title(f"{table.title}\n({trained})", fontsize=11)
    axis.legend(fontsize=9, frameon=False)
    axis.spines[["top", "right"]].set_visible(False)
    save_png(figure, path)

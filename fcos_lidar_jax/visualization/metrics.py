"""Pictures and report of an evaluation, from the numbers that it wrote."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.visualization.figure import new_figure, save_png
from fcos_lidar_jax.visualization.report import Cell, Picture, write_report

_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")
ERROR_NAMES = {
    "trans_err": "translation [m]",
    "scale_err": "scale [1 - IoU]",
    "orient_err": "orientation [rad]",
    "vel_err": "velocity [m/s]",
    "attr_err": "attribute [1 - accuracy]",
}
"""Errors of the hits and their units."""
_MEANS = ("mATE", "mASE", "mAOE", "mAVE", "mAAE")


def draw_precision(path: str | Path, recall: Sequence[float], precision: Mapping[str, Sequence[float]]) -> None:
    """Draw precision over recall of one class.

    Args:
        path: PNG to write.
        recall: 0 to 1.
        precision: matching distance -> values at these recalls.
    """
    figure, axis = _axis()
    for rank, (distance, values) in enumerate(precision.items()):
        # What is beyond the highest recall is not drawn along the bottom. Curves that coincide still all show: the
        # larger the distance, the wider the line and the lower.
        end = int(np.max(np.flatnonzero(values), initial=0)) + 1
        label = f"{float(distance):g} m"
        axis.plot(
            recall[:end], values[:end], color=_COLORS[rank], linewidth=1.2 + rank, label=label, zorder=9 - rank
        )
    axis.set_ylim(0, 1.02)
    axis.set_ylabel("precision")
    _save(figure, path, columns=4, title="match within")


def draw_errors(
    path: str | Path, recall: Sequence[float], errors: Mapping[str, Sequence[float]], *, last: int, first: int
) -> None:
    """Draw the mean errors of the hits of one class up to each recall.

    Args:
        path: PNG to write.
        recall: 0 to 1.
        errors: keys of :data:`ERROR_NAMES` -> values at these recalls.
        last: index of the highest recall that was reached.
        first: index of the lowest that counts.
    """
    figure, axis = _axis()
    if last >= first:
        for color, (error, name) in zip(_COLORS, ERROR_NAMES.items(), strict=True):
            if error in errors:
                span = slice(first, last + 1)
                marker = "o" if last == first else None
                axis.plot(recall[span], errors[error][span], color=color, linewidth=1.5, label=name, marker=marker)
    else:
        axis.text(0.5, 0.5, "recall never above 0.1", ha="center", transform=axis.transAxes, color="#555555")
    axis.set_ylim(bottom=0)
    axis.set_ylabel("mean error of the hits")
    _save(figure, path, columns=2)


def _axis() -> tuple[Any, Any]:
    figure = new_figure(4.2, 3.5)
    axis = figure.add_subplot()
    axis.set_xlim(0, 1)
    axis.set_xlabel("recall")
    axis.grid(color="#e5e5e5", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)
    return figure, axis


def _save(figure: Any, path: str | Path, *, columns: int, title: str | None = None) -> None:
    """With the legend below, where no curve runs."""
    handles = figure.axes[0].get_lines()
    if handles:
        where = "outside lower center"
        figure.legend(
            handles=handles, loc=where, ncols=columns, title=title, title_fontsize=9, fontsize=9, frameon=False
        )
    save_png(figure, path)


def draw_class_curves(
    folder: Path, summary: Mapping[str, Any], curves: Mapping[str, Any]
) -> tuple[list[Picture], list[Picture]]:
    """Precision and error curves of every class, as pictures with captions.

    Args:
        folder: for the PNG files.
        summary: as in ``metrics_summary.json``.
        curves: as in ``curves.json``.
    """
    recall, distance = curves["recall"], str(summary["cfg"]["dist_th_tp"])
    first = round(100 * summary["cfg"]["min_recall"]) + 1
    precisions: list[Picture] = []
    errors: list[Picture] = []
    for name, curve in curves["classes"].items():
        title, ap = _words(name), summary["mean_dist_aps"][name]
        draw_precision(folder / f"precision_{name}.png", recall, curve["precision"])
        precisions.append((f"{title}: AP {ap:.3f}", folder / f"precision_{name}.png"))
        own = {
            error: values
            for error, values in curve["errors"].items()
            if not np.isnan(summary["label_tp_errors"][name][error])
        }
        last = int(np.max(np.flatnonzero(curve["confidence"][distance]), initial=0))
        draw_errors(folder / f"errors_{name}.png", recall, own, last=last, first=first)
        errors.append((title, folder / f"errors_{name}.png"))
    return precisions, errors


def write_evaluation_report(
    path: Path,
    *,
    title: str,
    lead: str,
    summary: Mapping[str, Any],
    intervals: Mapping[str, Any] | None,
    precisions: Sequence[Picture],
    errors: Sequence[Picture],
    views: Sequence[Picture],
    images: Sequence[Picture],
) -> None:
    """Write the report of an evaluation as one file that needs nothing else.

    Args:
        path: HTML file to write.
        title: heading.
        lead: what was evaluated, a paragraph.
        summary: as in ``metrics_summary.json``; all scores and errors that are shown come from it.
        intervals: as in ``bootstrap.json``.
        precisions: precision curves.
        errors: error curves.
        views: samples from above.
        images: their range images.
    """
    scores: dict[str, Cell] = {"NDS": summary["nd_score"], "mAP": summary["mean_ap"]}
    if intervals is not None:
        for score, key in (("NDS", "nd_score"), ("mAP", "mean_ap")):
            span = intervals[key]
            scores[f"{score}, {intervals['level']:.0%} interval"] = f"{span['low']:.3f} to {span['high']:.3f}"
    scores |= {
        f"{short}, {ERROR_NAMES[name]}": summary["tp_errors"][name]
        for name, short in zip(ERROR_NAMES, _MEANS, strict=True)
    }
    distances = [str(distance) for distance in summary["cfg"]["dist_ths"]]
    header = ("class", "AP", *(f"AP {float(d):g} m" for d in distances), "ATE", "ASE", "AOE", "AVE", "AAE")
    rows = [
        (
            _words(name),
            summary["mean_dist_aps"][name],
            *(aps[distance] for distance in distances),
            *(summary["label_tp_errors"][name][error] for error in ERROR_NAMES),
        )
        for name, aps in summary["label_aps"].items()
    ]
    write_report(
        path,
        title=title,
        lead=lead,
        summary=scores,
        tables=[
            (
                "By class",
                header,
                rows,
            )
        ],
        galleries=[
            ("Precision over recall", precisions),
            ("Mean errors of the hits, up to each recall", errors),
        ],
        pictures=views,
        wide_pictures=images,
    )


def _words(name: str) -> str:
    return name.replace("_", " ")

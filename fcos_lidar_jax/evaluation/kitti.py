"""KITTI's own metric: average precision at 40 recall positions, by overlap from above, in 3D and in the image."""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.data.kitti import CLASSES, read_objects
from fcos_lidar_jax.files import some_files

MIN_OVERLAP = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
"""Class that KITTI evaluates -> overlap that a detection must exceed, from above, in 3D and in the image."""
DIFFICULTIES = {"easy": (40, 0, 0.15), "moderate": (25, 1, 0.30), "hard": (25, 2, 0.50)}
"""Minimum image height (pixels), maximum occlusion and truncation of the evaluated objects."""
KINDS = ("bev", "3d", "image", "aos")
"""Average precision from above, in 3D and of image boxes; average orientation similarity of image boxes."""
TABLE_HEAD = (*DIFFICULTIES, f"objects: {' / '.join(DIFFICULTIES)}")

_NEIGHBOURS = {"Car": "Van", "Pedestrian": "Person_sitting"}
_POSITIONS = 40
_LOWEST = min(height for height, *_ in DIFFICULTIES.values())
_NO_ALPHA = -10

_Pairs = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Objects and detections that overlap enough to match: rows i64[n, 2], ascending; overlaps f64[n]; what a true
positive counts, f64[n]; and the share of each detection that a DontCare region covers, f64[m]."""


def evaluate_kitti(
    results_dir: str | Path, label_dir: str | Path, *, classes: Sequence[str] = tuple(MIN_OVERLAP)
) -> dict[str, Any]:
    """The average precision of result files, in percent, by the rules of KITTI's development kit.

    Every file of the results is a frame; labels of other frames are not read. An object counts if it has the class
    and is within the limits of the difficulty. Other objects of the class, and its neighbours (vans for cars,
    sitting persons for pedestrians), are ignored: they may be detected or missed. Detections that are lower in the
    image than the difficulty's limit are ignored, too. In the image, so are detections without an object that a
    DontCare region covers by more than the class's overlap; these regions have no position in 3D.

    The average orientation similarity (AOS) is the average precision in the image, with true positives counting
    ``(1 + cos(error of alpha)) / 2``.

    The mean is over 40 of 41 positions, without the first. With fewer than 41 objects that count, perfect
    detections therefore stay below 100, as in the development kit.

    Args:
        results_dir: folder of files ``NAME.txt``, a detection per line, with a score, or of their folder ``data``.
        label_dir: folder of the label files of the same names, such as ``training/label_2``.
        classes: of :data:`MIN_OVERLAP`.

    Returns:
        ``{"metric": "AP_R40", "num_frames", "classes": {class: {"min_overlap", "num_truth", "bev", "3d", "image",
        "aos"}}}``; the last five by difficulty. An average precision without an object that counts is None. If the
        left side of all image boxes is negative, ``"image"`` and ``"aos"`` are left out; if any alpha is -10,
        ``"aos"`` is. If no detection has a box in 3D, ``"bev"`` and ``"3d"`` are left out. Also
        ``"unknown_types": {type: lines}``, and the numbers of detections without a box in 3D (``"image_only"``)
        and lower than every difficulty's limit (``"low"``).

    Raises:
        ValueError: naming the file, the line and the field, what was found and what was expected.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> cars = [f"Car 0 0 0 100 100 200 135 1.5 1.6 4 {x} 1.7 20 0 0.9\\n" for x in range(0, 250, 5)]
    >>> folder.joinpath("000000.txt").write_text("".join(cars)) > 0
    True
    >>> evaluate_kitti(folder, folder)["classes"]["Car"]["3d"]  # 35 pixels high
    {'easy': None, 'moderate': 100.0, 'hard': 100.0}
    """
    files = some_files(results_folder(results_dir), ".txt", "one for every frame")
    truth, found = _Objects([Path(label_dir) / file.name for file in files]), _Objects(files, scored=True)
    named = np.isin(found.types, CLASSES)
    flat, low = np.isnan(found.reach)[named], (found.height < _LOWEST)[named]
    kinds = _overlapping(truth, found)
    if flat.all() and len(flat):
        kinds = {kind: pairs for kind, pairs in kinds.items() if kind not in ("bev", "3d")}
    scores = {name: _evaluate_class(name, truth, found, kinds) for name in classes}
    skipped = Counter(name for name in found.types.tolist() if name not in (*CLASSES, "DontCare"))
    told = {"unknown_types": dict(sorted(skipped.items())), "image_only": int(flat.sum()), "low": int(low.sum())}
    return {"metric": "AP_R40", "num_frames": len(files), "classes": scores, **told}


def results_folder(folder: str | Path) -> Path:
    """The folder of the result files: ``data`` in the given one, if there are any, else the given one."""
    inner = Path(folder) / "data"
    return inner if any(inner.glob("*.txt")) else Path(folder)


def describe_kitti(metrics: dict[str, Any]) -> str:
    """What :func:`evaluate_kitti` returns, as lines of text."""
    rows = [(f"KITTI AP_R40 on {metrics['num_frames']} frames", [*TABLE_HEAD])]
    for name, kind, values, counts in table_rows(metrics):
        cells = ["-" if value is None else f"{value:.2f}" for value in values]
        rows.append((f"{name} {MIN_OVERLAP[name]} {kind}", [*cells, counts]))
    widths = [max(9, len(head) + 1) for head in TABLE_HEAD]
    lines = [title.ljust(28) + "".join(map(str.rjust, values, widths)) for title, values in rows]
    few = [n for n, scores in metrics["classes"].items() if 0 < scores["num_truth"]["moderate"] <= _POSITIONS]
    if not any(n for scores in metrics["classes"].values() for n in scores["num_truth"].values()):
        lines.append("no object is evaluated: the difficulty needs labels with boxes in the image, 25 pixels high")
    if few:
        lines.append(f"few objects of {', '.join(few)}: with fewer than 41 even perfect detections stay below 100")
    if skipped := [f"{count} {name}" for name, count in metrics["unknown_types"].items()]:
        lines.append(f"skipped, none of KITTI's types: {', '.join(skipped)}")
    if metrics["image_only"] and any("3d" in scores for scores in metrics["classes"].values()):
        lines.append(f"without a box in 3D, and therefore false in bev and 3d: {metrics['image_only']} detections")
    if low := metrics["low"]:
        lines.append(f"lower than {_LOWEST} pixels in the image, and therefore ignored: {low} detections")
    if metrics.get("left_out"):
        lines.append(f"left out, not in both the detector and KITTI's metric: {', '.join(metrics['left_out'])}")
    return "\n".join(lines)


def table_rows(metrics: dict[str, Any]) -> list[tuple[str, str, list[float | None], str]]:
    """Class, one of :data:`KINDS`, and the cells under :data:`TABLE_HEAD`: values, and numbers of objects."""
    return [
        (name, kind, [*scores[kind].values()], " / ".join(map(str, scores["num_truth"].values())))
        for name, scores in metrics["classes"].items()
        for kind in KINDS
        if kind in scores
    ]


class _Objects:
    """The lines of files as arrays, in their order."""

    def __init__(self, files: Sequence[Path], *, scored: bool = False) -> None:
        read = [read_objects(file, scored=scored) for file in files]
        fields = np.concatenate([fields for _, fields in read])
        self.ends = np.cumsum([len(types) for types, _ in read])
        self.types = np.array([name for types, _ in read for name in types], np.str_)
        self.truncation, self.occlusion, self.boxes, self.scores = *fields[:, :2].T, fields[:, 7:14], fields[:, 14]
        self.alpha, self.image = fields[:, 2], fields[:, 3:7]
        self.height = np.abs(self.image[:, 3] - self.image[:, 1])
        self.reach = np.hypot(self.boxes[:, 1], self.boxes[:, 2]) / 2


def _overlapping(truth: _Objects, found: _Objects) -> dict[str, _Pairs]:
    """What may match, for each of :data:`KINDS` that the results have."""
    near, seen = [np.zeros((0, 2), np.int64)], [np.zeros((0, 2), np.int64)]
    least, covered = min(MIN_OVERLAP.values()), np.zeros(len(found.types))
    for (i, j), (k, l) in pairwise([(0, 0), *zip(truth.ends, found.ends, strict=True)]):
        a, b = truth.boxes[i:k, None], found.boxes[j:l]
        distance = np.hypot(a[..., 3] - b[..., 3], a[..., 5] - b[..., 5])
        near.append(np.argwhere(distance < truth.reach[i:k, None] + found.reach[j:l]) + np.array([i, j]))
        overlap, share = _image_overlaps(truth.image[i:k, None], found.image[j:l])
        seen.append(np.argwhere(overlap > least) + np.array([i, j]))
        covered[j:l] = share[truth.types[i:k] == "DontCare"].max(axis=0, initial=0.0)
    pairs = np.concatenate(near)
    bev, volume = overlaps(truth.boxes[pairs[:, 0]], found.boxes[pairs[:, 1]])
    kept = bev > least  # the overlap in space is never greater
    others = np.ones(kept.sum()), np.zeros(len(found.types))
    kinds = {"bev": (pairs[kept], bev[kept], *others), "3d": (pairs[kept], volume[kept], *others)}
    if not len(covered) or (found.image[:, 0] >= 0).any():
        pairs = np.concatenate(seen)
        overlap, _ = _image_overlaps(truth.image[pairs[:, 0]], found.image[pairs[:, 1]])
        kinds["image"] = pairs, overlap, np.ones(len(pairs)), covered
        if (found.alpha != _NO_ALPHA).all():
            similarity = (1 + np.cos(truth.alpha[pairs[:, 0]] - found.alpha[pairs[:, 1]])) / 2
            kinds["aos"] = pairs, overlap, similarity, covered
    return kinds


def _image_overlaps(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """IoU of image boxes f64[..., 4], and the share of b that a covers."""
    sides = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    shared = np.maximum(sides, 0.0).prod(axis=-1)
    area_a, area_b = ((box[..., 2:] - box[..., :2]).prod(axis=-1) for box in (a, b))
    some = shared > 0  # boxes without an area share none
    return shared / np.where(some, area_a + area_b - shared, 1.0), shared / np.where(some, area_b, 1.0)


def overlaps(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """IoU from above and in 3D, f64[n] each, of boxes f64[n, 7]: ``height`` to ``rotation_y`` of the files."""
    (ha, wa, la, _, ya, _, _), (hb, wb, lb, _, yb, _, _) = a.T, b.T
    area = _shared_area(a, b)
    volume = area * np.maximum(np.minimum(ya, yb) - np.maximum(ya - ha, yb - hb), 0.0)
    return area / (wa * la + wb * lb - area), volume / (wa * la * ha + wb * lb * hb - volume)


def _shared_area(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Overlap area of boxes from above, in float64; see :mod:`fcos_lidar_jax.iou`."""
    half = a[:, None, [2, 1]] / 2
    cos, sin = np.cos(a[:, 6]), np.sin(a[:, 6])
    dx, dz = b[:, 3] - a[:, 3], b[:, 5] - a[:, 5]
    centre = np.stack([cos * dx - sin * dz, sin * dx + cos * dz], -1)
    turn = a[:, 6] - b[:, 6]
    along = np.stack([np.cos(turn), np.sin(turn)], -1) * b[:, 2:3] / 2
    across = np.stack([-np.sin(turn), np.cos(turn)], -1) * b[:, 1:2] / 2
    corners = (along - across, along + across, across - along, -along - across)
    start = np.stack([centre + corner for corner in corners], axis=1)
    step = np.roll(start, -1, axis=1) - start
    slope = np.where(np.abs(step) < 1e-12, 1e-12, step)
    into, out = np.sort(np.stack([(-half - start) / slope, (half - start) / slope]), axis=0)
    low, high = np.clip(into[..., 1], 0, 1), np.clip(out[..., 1], 0, 1)
    enter, leave = np.clip(into[..., 0], low, high), np.clip(out[..., 0], low, high)
    times = np.stack([low, enter, leave, high])
    at = np.clip(start[..., 0] + times * step[..., 0], -half[..., 0], half[..., 0])
    return (step[..., 1] / 2 * ((at[1:] + at[:-1]) * np.diff(times, axis=0)).sum(axis=0)).sum(axis=1)


def _evaluate_class(name: str, truth: _Objects, found: _Objects, kinds: dict[str, _Pairs]) -> dict[str, Any]:
    """Number of objects that count and average precisions of a class, by difficulty."""
    scores: dict[str, Any] = {"min_overlap": MIN_OVERLAP[name], "num_truth": {}, **{kind: {} for kind in kinds}}
    ours, neighbour = truth.types == name, truth.types == _NEIGHBOURS.get(name, name)
    for difficulty, (height, occlusion, truncation) in DIFFICULTIES.items():
        within = (truth.height > height) & (truth.occlusion <= occlusion) & (truth.truncation <= truncation)
        counted, high = ours & within, found.height >= height
        scores["num_truth"][difficulty] = int(counted.sum())
        # Low detections of any class may be taken by an object, as in the development kit.
        found_counted, found_taken = high & (found.types == name), ~high | (found.types == name)
        for kind, (pairs, overlap, worth, covered) in kinds.items():
            possible = overlap > MIN_OVERLAP[name]
            possible &= (ours | neighbour)[pairs[:, 0]] & found_taken[pairs[:, 1]]
            found_false = found_counted & (covered <= MIN_OVERLAP[name])
            given = pairs[possible], overlap[possible], worth[possible], counted, found_counted, found_false
            scores[kind][difficulty] = _average_precision(*given, found.scores) if counted.any() else None
    return scores


def _average_precision(
    pairs: np.ndarray,
    overlap: np.ndarray,
    worth: np.ndarray,
    counted: np.ndarray,
    found_counted: np.ndarray,
    found_false: np.ndarray,
    scores: np.ndarray,
) -> float:
    """Percent, from the pairs that may match; which objects and which detections count, which of these are false
    without an object, and all scores."""
    truth, (rows, column) = pairs[:, 0], np.unique(pairs[:, 1], return_inverse=True)
    valid = found_counted[pairs[:, 1]]
    true_positive = valid & counted[truth]
    # First, each object takes the detection of the highest score: their scores are the thresholds.
    taken = _match(truth, column, scores[rows][column], np.ones((len(rows), 1), bool))[:, 0]
    thresholds = _thresholds(scores[pairs[taken & true_positive, 1]], int(counted.sum()))
    # Then, at each threshold, the one with the greatest overlap; ignored detections only if no other is left.
    present = scores[rows][:, None] >= thresholds
    taken = _match(truth, column, np.where(valid, overlap, 0.0), present)
    hits = taken & true_positive[:, None]
    ordered = np.sort(scores[found_false])
    num_taken = (taken & found_false[pairs[:, 1], None]).sum(axis=0)
    num_found = hits.sum(axis=0) + len(ordered) - np.searchsorted(ordered, thresholds) - num_taken
    precision = np.zeros(_POSITIONS + 1)
    # Where nothing counts the development kit has 0 / 0; here the precision is 0.
    precision[: len(thresholds)] = worth @ hits / np.maximum(num_found, 1)
    return float(100 * np.maximum.accumulate(precision[::-1])[::-1][1:].mean())


def _match(truth: np.ndarray, found: np.ndarray, priority: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Which pairs match, bool[n, t]: each object takes the free detection of the highest priority, of equals the
    first. Objects and pairs are in ascending order; ``present`` bool[detections, t] differs in the t matchings."""
    free, taken = present.copy(), np.zeros((len(found), present.shape[1]), bool)
    matching = np.arange(present.shape[1])
    for first, last in pairwise([*np.flatnonzero(np.diff(truth, prepend=-1)).tolist(), len(truth)]):
        rivals = found[first:last]
        best = np.where(free[rivals], priority[first:last, None], -np.inf).argmax(axis=0)
        hit = free[rivals[best], matching]
        taken[first + best[hit], matching[hit]] = True
        free[rivals[best[hit]], matching[hit]] = False
    return taken


def _thresholds(scores: np.ndarray, num_truth: int) -> np.ndarray:
    """The scores of true positives whose recall is nearest to each position, descending, 41 at most."""
    kept, position = list[float](), 0.0
    recall = np.arange(1, len(scores) + 2) / num_truth
    for i, score in enumerate(np.sort(scores)[::-1].tolist()):
        is_last = i == len(scores) - 1
        if is_last or recall[i + 1] - position >= position - recall[i]:
            kept.append(score)
            position += 1 / _POSITIONS
    return np.array(kept[: _POSITIONS + 1])

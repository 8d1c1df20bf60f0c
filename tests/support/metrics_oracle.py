"""The detection metric by plain loops over boxes, from its description: nothing shared with the package."""

import itertools
import math

import numpy as np

RANGES = dict(
    zip(
        ("car", "truck", "bus", "trailer", "construction_vehicle", "pedestrian", "motorcycle", "bicycle"),
        (50, 50, 50, 50, 50, 40, 40, 40),
        strict=True,
    ),
    traffic_cone=30,
    barrier=30,
)
NONE = {"traffic_cone": ("orient_err", "vel_err", "attr_err"), "barrier": ("vel_err", "attr_err")}
ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")


def unit(rotation):
    norm = math.sqrt(sum(v * v for v in rotation))
    return [v / norm for v in rotation]


def turned(rotation, vector):
    """A vector rotated by a quaternion: v + 2 u x (u x v + w v)."""
    w, *u = unit(rotation)
    u, v = np.array(u), np.array(vector, float)
    return v + 2 * np.cross(u, np.cross(u, v) + w * v)


def yaw(box):
    x, y, _ = turned(box["rotation"], (1, 0, 0))
    return math.atan2(y, x)


def in_rack(box, rack):
    w, x, y, z = rack["rotation"]
    local = turned((w, -x, -y, -z), np.array(box["translation"]) - rack["translation"])
    width, length, height = rack["size"]
    return abs(local[0]) <= length / 2 and abs(local[1]) <= width / 2 and abs(local[2]) <= height / 2


def kept(boxes, ego, racks, ranges=RANGES):
    result = []
    for box in boxes:
        away = math.dist(box["translation"][:2], ego[:2])
        cycle = box["detection_name"] in ("bicycle", "motorcycle")
        stowed = cycle and any(in_rack(box, rack) for rack in racks)
        if away < ranges[box["detection_name"]] and box.get("num_pts", -1) != 0 and not stowed:
            result.append(box)
    return result


def errors_of(found, true):
    inner = math.prod(min(a, b) for a, b in zip(found["size"], true["size"], strict=True))
    union = math.prod(found["size"]) + math.prod(true["size"]) - inner
    period = math.pi if true["detection_name"] == "barrier" else 2 * math.pi
    turn = abs(yaw(found) - yaw(true)) % period
    speeds = [[math.nan if v is None else v for v in box["velocity"] or (None, None)] for box in (found, true)]
    attribute = true["attribute_name"]
    return {
        "trans_err": math.dist(found["translation"][:2], true["translation"][:2]),
        "scale_err": 1 - inner / union,
        "orient_err": min(turn, period - turn),
        "vel_err": math.hypot(speeds[0][0] - speeds[1][0], speeds[0][1] - speeds[1][1]),
        "attr_err": math.nan if attribute == "" else float(attribute != found["attribute_name"]),
    }


def curve(points, x):
    """The line through points of rising x, first value before them, zero behind them."""
    if x < points[0][0]:
        return points[0][1]
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        if x0 <= x < x1:
            return y0 + (y1 - y0) * (x - x0) / (x1 - x0)
    return points[-1][1] if x == points[-1][0] else 0.0


def score_class(name, truth, found, distance_m):
    """AP and errors of one class."""
    total = sum(box["detection_name"] == name for boxes in truth.values() for box in boxes)
    ranked = [(token, box) for token, boxes in found.items() for box in boxes if box["detection_name"] == name]
    # Of equal scores the later one first.
    ranked = sorted(reversed(ranked), key=lambda entry: -entry[1]["detection_score"])
    free = {token: [box for box in boxes if box["detection_name"] == name] for token, boxes in truth.items()}
    hits, pairs = [], []
    for token, box in ranked:
        near = min(
            free[token], key=lambda t: math.dist(t["translation"][:2], box["translation"][:2]), default=None
        )
        hit = near is not None and math.dist(near["translation"][:2], box["translation"][:2]) < distance_m
        if hit:
            free[token] = [other for other in free[token] if other is not near]
            pairs.append((box["detection_score"], errors_of(box, near)))
        hits.append(hit)
    if not pairs:
        return 0.0, dict.fromkeys(ERRORS, 1.0)
    recalls = [sum(hits[: i + 1]) / total for i in range(len(hits))]
    precisions = [sum(hits[: i + 1]) / (i + 1) for i in range(len(hits))]
    grid = [float(v) for v in np.linspace(0, 1, 101)]
    precision = [curve(list(zip(recalls, precisions, strict=True)), r) for r in grid]
    confidence = [
        curve(list(zip(recalls, [b["detection_score"] for _, b in ranked], strict=True)), r) for r in grid
    ]
    ap = sum(max(p - 0.1, 0) for p in precision[11:]) / 90 / 0.9
    last = max((i for i, c in enumerate(confidence) if c != 0), default=0)
    return ap, {error: error_of(error, pairs, confidence, last) for error in ERRORS}


def error_of(error, pairs, confidence, last):
    if last < 11:
        return 1.0
    so_far, means = [], []
    for _, values in pairs:
        if not math.isnan(values[error]):
            so_far.append(values[error])
        means.append(sum(so_far) / len(so_far) if so_far else 0.0)
    if not so_far:
        return 1.0
    # Over rising score; before the lowest and behind the highest the outermost mean.
    rising = [(score, mean) for (score, _), mean in zip(pairs, means, strict=True)][::-1]
    values = [rising[-1][1] if c >= rising[-1][0] else curve(rising, c) for c in confidence[11 : last + 1]]
    return sum(values) / len(values)


def score(results, ground_truth):
    """The numbers of the official summary."""
    truth, found = {}, {}
    for token, boxes in results.items():
        sample = ground_truth[token]
        racks = [box for box in sample["boxes"] if box["detection_name"].endswith("rack")]
        true = [box for box in sample["boxes"] if not box["detection_name"].endswith("rack")]
        truth[token] = kept(true, sample["ego_translation"], racks)
        found[token] = kept(boxes, sample["ego_translation"], racks)
    aps, errors = {}, {}
    for name in RANGES:
        by_distance = {str(d): score_class(name, truth, found, d) for d in (0.5, 1.0, 2.0, 4.0)}
        aps[name] = {distance: ap for distance, (ap, _) in by_distance.items()}
        errors[name] = by_distance["2.0"][1] | dict.fromkeys(NONE.get(name, ()), math.nan)
    mean_ap = sum(sum(row.values()) / 4 for row in aps.values()) / 10
    means = {}
    for error in ERRORS:
        known = [row[error] for row in errors.values() if not math.isnan(row[error])]
        means[error] = sum(known) / len(known)
    return {
        "label_aps": aps,
        "mean_ap": mean_ap,
        "label_tp_errors": errors,
        "tp_errors": means,
        "nd_score": (5 * mean_ap + sum(max(0, 1 - value) for value in means.values())) / 10,
    }


def score_frames(found, truth, ranges):
    """The numbers of the summary by centre distance: boxes by frame, in the sensor's own frame."""
    truth = {name: kept(boxes, (0, 0), [], ranges) for name, boxes in truth.items()}
    found = {name: kept(boxes, (0, 0), [], ranges) for name, boxes in found.items()}
    aps, errors, absent = {}, {}, []
    for name in ranges:
        own = [box for boxes in truth.values() for box in boxes if box["detection_name"] == name]
        if not own:
            absent.append(name)
            continue
        by_distance = {str(d): score_class(name, truth, found, d) for d in (0.5, 1.0, 2.0, 4.0)}
        aps[name] = {distance: ap for distance, (ap, _) in by_distance.items()}
        without = {*NONE.get(name, ()), "attr_err"}
        if not any(all(math.isfinite(v) for v in box["velocity"]) for box in own):
            without.add("vel_err")
        errors[name] = {error: value for error, value in by_distance["2.0"][1].items() if error not in without}
    means = {}
    for error in ERRORS:
        known = [row[error] for row in errors.values() if error in row]
        if known:
            means[error] = sum(known) / len(known)
    return {
        "label_aps": aps,
        "mean_dist_aps": {name: sum(row.values()) / 4 for name, row in aps.items()},
        "mean_ap": sum(sum(row.values()) / 4 for row in aps.values()) / len(aps),
        "label_tp_errors": errors,
        "tp_errors": means,
        "absent_classes": absent,
    }

"""The detection metric as plain loops over boxes, written from its description without the package."""

import itertools
import math

import numpy as np

RANGES = {
    **dict.fromkeys(("car", "truck", "bus", "trailer", "construction_vehicle"), 50),
    **dict.fromkeys(("pedestrian", "motorcycle", "bicycle"), 40),
    **dict.fromkeys(("traffic_cone", "barrier"), 30),
}
NONE = {"traffic_cone": ("orient_err", "vel_err", "attr_err"), "barrier": ("vel_err", "attr_err")}
ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")


def turned(rotation, vector):
    """A vector rotated by a quaternion: v + 2 u x (u x v + w v)."""
    w, *u = np.array(rotation) / math.sqrt(sum(v * v for v in rotation))
    u, v = np.array(u), np.array(vector, float)
    return v + 2 * np.cross(u, np.cross(u, v) + w * v)


def yaw(box):
    x, y, _ = turned(box["rotation"], (1, 0, 0))
    return math.atan2(y, x)


def away(a, b):
    return math.dist(a["translation"][:2], b["translation"][:2])


def in_rack(box, rack):
    w, x, y, z = rack["rotation"]
    local = turned((w, -x, -y, -z), np.array(box["translation"]) - rack["translation"])
    width, length, height = rack["size"]
    return abs(local[0]) <= length / 2 and abs(local[1]) <= width / 2 and abs(local[2]) <= height / 2


def kept(boxes, ego, racks, ranges=RANGES):
    def counts(box):
        cycle = box["detection_name"] in ("bicycle", "motorcycle")
        near = math.dist(box["translation"][:2], ego[:2]) < ranges[box["detection_name"]]
        return near and box.get("num_pts", -1) != 0 and not (cycle and any(in_rack(box, rack) for rack in racks))

    return [box for box in boxes if counts(box)]


def errors_of(found, true):
    inner = math.prod(min(a, b) for a, b in zip(found["size"], true["size"], strict=True))
    union = math.prod(found["size"]) + math.prod(true["size"]) - inner
    period = math.pi if true["detection_name"] == "barrier" else 2 * math.pi
    turn = abs(yaw(found) - yaw(true)) % period
    speeds = [[math.nan if v is None else v for v in box["velocity"] or (None, None)] for box in (found, true)]
    attribute = true["attribute_name"]
    return {
        "trans_err": away(found, true),
        "scale_err": 1 - inner / union,
        "orient_err": min(turn, period - turn),
        "vel_err": math.dist(*speeds),
        "attr_err": math.nan if attribute == "" else float(attribute != found["attribute_name"]),
    }


def curve(points, x):
    """Interpolate between points of rising x; the first value before them, zero after them."""
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
    # The last of equal scores comes first.
    ranked = sorted(reversed(ranked), key=lambda entry: -entry[1]["detection_score"])
    free = {token: [box for box in boxes if box["detection_name"] == name] for token, boxes in truth.items()}
    hits, pairs = [], []
    for token, box in ranked:
        near = min(free[token], key=lambda true: away(true, box), default=None)
        hit = near is not None and away(near, box) < distance_m
        if hit:
            free[token] = [other for other in free[token] if other is not near]
            pairs.append((box["detection_score"], errors_of(box, near)))
        hits.append(hit)
    if not pairs:
        return 0.0, dict.fromkeys(ERRORS, 1.0)
    recalls = [sum(hits[: i + 1]) / total for i in range(len(hits))]
    precisions = [sum(hits[: i + 1]) / (i + 1) for i in range(len(hits))]
    scores = [box["detection_score"] for _, box in ranked]
    precision, confidence = (
        [curve(list(zip(recalls, values, strict=True)), float(r)) for r in np.linspace(0, 1, 101)]
        for values in (precisions, scores)
    )
    ap = sum(max(p - 0.1, 0) for p in precision[11:]) / 90 / 0.9
    last = max((i for i, c in enumerate(confidence) if c != 0), default=0)
    return ap, {error: error_of(error, pairs, confidence, last) for error in ERRORS}


def error_of(error, pairs, confidence, last):
    so_far, means = [], []
    for _, values in pairs:
        if not math.isnan(values[error]):
            so_far.append(values[error])
        means.append(sum(so_far) / len(so_far) if so_far else 0.0)
    if last < 11 or not so_far:
        return 1.0
    # Interpolated over rising score; constant outside.
    rising = [(score, mean) for (score, _), mean in zip(pairs, means, strict=True)][::-1]
    values = [rising[-1][1] if c >= rising[-1][0] else curve(rising, c) for c in confidence[11 : last + 1]]
    return sum(values) / len(values)


def summarise(found, truth, ranges, *, benchmark):
    """The summary of the given boxes by sample."""
    aps, errors = {}, {}
    for name in ranges:
        own = [box for boxes in truth.values() for box in boxes if box["detection_name"] == name]
        if not own and not benchmark:
            continue
        by_distance = {str(d): score_class(name, truth, found, d) for d in (0.5, 1.0, 2.0, 4.0)}
        aps[name] = {distance: ap for distance, (ap, _) in by_distance.items()}
        without = set(NONE.get(name, ()))
        if not benchmark:
            moving = any(all(math.isfinite(v) for v in box["velocity"]) for box in own)
            without |= {"attr_err"} if moving else {"attr_err", "vel_err"}
        errors[name] = by_distance["2.0"][1] | dict.fromkeys(without, math.nan)
        if not benchmark:
            errors[name] = {error: value for error, value in errors[name].items() if error not in without}
    mean_aps = {name: sum(row.values()) / 4 for name, row in aps.items()}
    mean_ap = sum(mean_aps.values()) / len(aps)
    means = {}
    for error in ERRORS:
        known = [row[error] for row in errors.values() if not math.isnan(row.get(error, math.nan))]
        if known:
            means[error] = sum(known) / len(known)
    parts = {"label_aps": aps, "mean_dist_aps": mean_aps, "mean_ap": mean_ap}
    parts |= {"label_tp_errors": errors, "tp_errors": means}
    if benchmark:
        return {**parts, "nd_score": (5 * mean_ap + sum(max(0, 1 - value) for value in means.values())) / 10}
    return {**parts, "absent_classes": [name for name in ranges if name not in aps]}


def score(results, ground_truth):
    """The values of the official summary."""
    truth, found = {}, {}
    for token, boxes in results.items():
        ego, there = ground_truth[token]["ego_translation"], ground_truth[token]["boxes"]
        racks = [box for box in there if box["detection_name"].endswith("rack")]
        truth[token] = kept([box for box in there if box not in racks], ego, racks)
        found[token] = kept(boxes, ego, racks)
    return summarise(found, truth, RANGES, benchmark=True)


def score_frames(found, truth, ranges):
    """The values of the summary by centre distance, for boxes by frame in sensor coordinates."""
    found, truth = ({i: kept(boxes, (0, 0), [], ranges) for i, boxes in part.items()} for part in (found, truth))
    return summarise(found, truth, ranges, benchmark=False)


def leaves(value, path=()):
    """All values of nested dictionaries, by path of keys."""
    if isinstance(value, dict):
        return {name: leaf for key, part in value.items() for name, leaf in leaves(part, (*path, key)).items()}
    return {path: value}


def assert_numbers(ours, theirs, tolerance=1e-12):
    """Assert that ``ours`` has all values of ``theirs``, floats within a tolerance and NaN equal to NaN."""
    ours = leaves(ours)
    for path, value in leaves(theirs).items():
        if isinstance(value, float):
            same = math.isnan(ours[path]) if math.isnan(value) else abs(ours[path] - value) <= tolerance
            assert same, (path, ours[path], value)
        else:
            assert ours[path] == value, path

"""KITTI's metric by plain loops and Shapely, from its description: nothing shared with the package."""

import math

from shapely import Polygon

OVERLAP = {"car": 0.7, "pedestrian": 0.5, "cyclist": 0.5}
NEIGHBOUR = {"car": "van", "pedestrian": "person_sitting", "cyclist": None}
METRICS = ("bev", "3d", "image", "aos")
LIMITS = {"easy": (40, 0, 0.15), "moderate": (25, 1, 0.3), "hard": (25, 2, 0.5)}


def read(text):
    """Objects of a file: type in lower case, and numbers by name."""
    names = ("truncation", "occlusion", "alpha", "left", "top", "right", "bottom", *"hwlxyz", "ry", "score")
    lines = [line.split() for line in text.splitlines() if line.strip()]
    return [{"type": w[0].lower()} | {n: float(v) for n, v in zip(names, w[1:], strict=False)} for w in lines]


def footprint(o):
    c, s = math.cos(o["ry"]), math.sin(o["ry"])
    around = [(1, 1), (1, -1), (-1, -1), (-1, 1)]
    corners = [(a * o["l"] / 2, b * o["w"] / 2) for a, b in around]
    return Polygon([(o["x"] + c * a + s * b, o["z"] - s * a + c * b) for a, b in corners])


def shared_pixels(a, b):
    wide = min(a["right"], b["right"]) - max(a["left"], b["left"])
    high = min(a["bottom"], b["bottom"]) - max(a["top"], b["top"])
    return wide * high if wide > 0 and high > 0 else 0.0


def pixels(o):
    return (o["right"] - o["left"]) * (o["bottom"] - o["top"])


def overlap(a, b, metric):
    if metric in ("image", "aos"):
        shared = shared_pixels(a, b)
        return shared / (pixels(a) + pixels(b) - shared) if shared else 0.0
    p, q = footprint(a), footprint(b)
    shared = p.intersection(q).area
    if metric == "bev":
        return shared / p.union(q).area if shared else 0.0
    high = min(a["y"], b["y"]) - max(a["y"] - a["h"], b["y"] - b["h"])
    shared *= max(high, 0.0)
    volumes = [o["h"] * o["w"] * o["l"] for o in (a, b)]
    return shared / (sum(volumes) - shared)


def truth_state(o, name, difficulty):
    """0 counts, 1 is ignored, -1 is of another class."""
    height, occlusion, truncation = LIMITS[difficulty]
    if o["type"] == NEIGHBOUR[name]:
        return 1
    if o["type"] != name:
        return -1
    low = o["bottom"] - o["top"] <= height
    return int(low or o["occlusion"] > occlusion or o["truncation"] > truncation)


def detection_state(o, name, difficulty):
    if int(abs(o["bottom"] - o["top"])) < LIMITS[difficulty][0]:
        return 1
    return 0 if o["type"] == name else -1


def in_dont_care(detection, truths, least):
    areas = [o for o in truths if o["type"] == "dontcare"]
    return any(shared_pixels(detection, area) > least * pixels(detection) for area in areas)


def match(truths, found, shared, states, least, metric, threshold=None):
    """Pairs of scores and similarities of the true positives, and the number of false ones; the first pass has no
    threshold."""
    truth_states, found_states = states
    taken, hits = set(), []
    present = [threshold is None or o["score"] >= threshold for o in found]
    for i in range(len(truths)):
        if truth_states[i] == -1:
            continue
        best = None
        for j in range(len(found)):
            if found_states[j] == -1 or j in taken or not present[j] or not shared[i][j] > least:
                continue
            if best is None:
                best = j
            elif threshold is None:
                best = j if found[j]["score"] > found[best]["score"] else best
            elif found_states[j] == 0 and (found_states[best] == 1 or shared[i][j] > shared[i][best]):
                best = j
        if best is None:
            continue
        taken.add(best)
        if truth_states[i] == 0 and found_states[best] == 0:
            similarity = (1 + math.cos(truths[i]["alpha"] - found[best]["alpha"])) / 2
            hits.append((found[best]["score"], similarity if metric == "aos" else 1))
    false = 0
    for j in range(len(found)):
        if found_states[j] == 0 and present[j] and j not in taken:
            excused = metric in ("image", "aos") and in_dont_care(found[j], truths, least)
            false += not excused
    return hits, false


def scores_at_positions(scores, number):
    kept, position = [], 0.0
    scores = sorted(scores, reverse=True)
    for i, score in enumerate(scores):
        here, after = (i + 1) / number, (i + 2) / number
        if i + 1 < len(scores) and after - position < position - here:
            continue
        kept.append(score)
        position += 1 / 40
    return kept


def average_precision(frames, name, difficulty, metric):
    """Number of objects that count, and percent.

    Args:
        frames: pairs of objects and detections with their overlaps by metric, see :func:`score`.
    """
    states = [
        ([truth_state(o, name, difficulty) for o in truths], [detection_state(o, name, difficulty) for o in found])
        for truths, found, _ in frames
    ]
    number = sum(truth.count(0) for truth, _ in states)
    least, all_scores = OVERLAP[name], []
    for (truths, found, shared), state in zip(frames, states, strict=True):
        hits, _ = match(truths, found, shared[metric], state, least, metric)
        all_scores += [score for score, _ in hits]
    precision = [0.0] * 41
    for k, threshold in enumerate(scores_at_positions(all_scores, number) if number else []):
        true = false = worth = 0
        for (truths, found, shared), state in zip(frames, states, strict=True):
            hits, wrong = match(truths, found, shared[metric], state, least, metric, threshold)
            true, false = true + len(hits), false + wrong
            worth += sum(similarity for _, similarity in hits)
        precision[k] = worth / (true + false) if true + false else 0.0
    return number, sum(max(precision[k:]) for k in range(1, 41)) / 40 * 100


def score(texts):
    """{(class, metric, difficulty): (number, percent)} of frames, each a label file's and a result file's text."""
    frames = []
    for label, result in texts:
        truths, found = read(label), read(result)
        shared = {m: [[overlap(t, d, m) for d in found] for t in truths] for m in METRICS}
        frames.append((truths, found, shared))
    detections = [o for _, found, _ in frames for o in found]
    metrics = [m for m in METRICS if m != "aos" or all(o["alpha"] != -10 for o in detections)]
    kinds = ((n, m, d) for n in OVERLAP for m in metrics for d in LIMITS)
    return {(n, m, d): average_precision(frames, n, d, m) for n, m, d in kinds}

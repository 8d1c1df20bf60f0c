"""Slow references in NumPy and Shapely, written from the definitions and not from the tested code."""

import numpy as np
from shapely import area, intersection, polygons


def project(cell, older, range_m, num_cells, num_rounds):
    """Index of the point of each cell and round, i32[cells, rounds]: points sorted by (older, range, index)."""
    out = np.full((num_cells, num_rounds), -1, np.int32)
    waiting = {}
    for i, c in enumerate(cell):
        if c < num_cells:
            waiting.setdefault(int(c), []).append((bool(older[i]), float(range_m[i]), i))
    for c, points in waiting.items():
        for r, (_, _, i) in enumerate(sorted(points)[:num_rounds]):
            out[c, r] = i
    return out


def turns(yaw):
    """Rotations about z, f64[n, 3, 3]."""
    c, s, zero, one = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw)), np.ones(len(yaw))
    return np.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).reshape(-1, 3, 3)


def corners(boxes):
    """Corners of boxes x, y, z, l, w, h, yaw: bottom, counter-clockwise from the front right, then top."""
    boxes = np.asarray(boxes, np.float64)
    signs = np.array([(*xy, z) for z in (-1, 1) for xy in ((1, -1), (1, 1), (-1, 1), (-1, -1))])
    return boxes[:, None, :3] + np.einsum("nij,ncj->nci", turns(boxes[:, 6]), signs * boxes[:, None, 3:6] / 2)


def rectangles(boxes):
    """Footprints of boxes as polygons."""
    return polygons(corners(boxes)[:, :4, :2])


def iou(a, b, *, vertical):
    """IoU of pairs of boxes, in space or in the ground plane."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    shared = area(intersection(rectangles(a), rectangles(b)))
    size_a, size_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    if vertical:
        top = np.minimum(a[:, 2] + a[:, 5] / 2, b[:, 2] + b[:, 5] / 2)
        bottom = np.maximum(a[:, 2] - a[:, 5] / 2, b[:, 2] - b[:, 5] / 2)
        shared = shared * np.maximum(top - bottom, 0)
        size_a, size_b = size_a * a[:, 5], size_b * b[:, 5]
    union = size_a + size_b - shared
    return np.where(union > 0, shared / np.where(union > 0, union, 1), 0)


def nms(boxes, scores, valid, labels, threshold, max_outputs, *, vertical=False):
    """Indices kept by greedy suppression, in order of score, then index."""
    order = [i for i in np.argsort(-scores, kind="stable") if valid[i] and not np.isnan(scores[i])]
    kept = []
    for i in order:
        rivals = [j for j in kept if labels[j] == labels[i]]
        if rivals:
            overlap = iou(np.repeat(boxes[i : i + 1], len(rivals), 0), boxes[rivals], vertical=vertical)
            if (overlap > threshold).any():
                continue
        kept.append(int(i))
        if len(kept) == max_outputs:
            break
    return kept


def inside(point, box):
    """Whether a point is in an upright box, including its boundary."""
    dx, dy, dz = point - box[:3]
    c, s = np.cos(box[6]), np.sin(box[6])
    along, across = c * dx + s * dy, c * dy - s * dx
    return abs(along) <= box[3] / 2 and abs(across) <= box[4] / 2 and abs(dz) <= box[5] / 2


def owner(point, boxes, valid):
    """Index of the smallest box that contains a point, -1 for none."""
    best, least = -1, np.inf
    for m, box in enumerate(boxes):
        if valid[m] and inside(point, box) and box[3] * box[4] * box[5] < least:
            best, least = m, box[3] * box[4] * box[5]
    return best


def assign(owners, classification, ious, num_boxes, top_q):
    """Positive locations and K of each box, by dynamic K."""
    positive, ks = np.zeros(len(owners), bool), np.zeros(num_boxes, int)
    for m in range(num_boxes):
        mine = np.flatnonzero(owners == m)
        if len(mine) == 0:
            continue
        total = float(np.sort(ious[mine])[::-1][:top_q].sum())
        k = min(max(int(np.floor(total + 0.5)), 1), len(mine))
        cost = classification[mine] + 1 - ious[mine]
        cost = np.where(np.isnan(cost), np.inf, cost)
        cheapest = sorted(range(len(mine)), key=lambda i: (cost[i], mine[i]))[:k]
        positive[mine[cheapest]] = True
        ks[m] = k
    return positive, ks


def random_boxes(rng, number, spread=3.0):
    """Boxes x, y, z, l, w, h, yaw, many of which overlap."""
    boxes = np.zeros((number, 7))
    boxes[:, :2] = rng.normal(0, spread, (number, 2))
    boxes[:, 2] = rng.normal(0, 0.5, number)
    boxes[:, 3:6] = rng.uniform(0.4, 5, (number, 3))
    boxes[:, 6] = rng.uniform(-np.pi, np.pi, number)
    return boxes

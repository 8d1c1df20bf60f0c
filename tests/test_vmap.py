"""Pure functions are the same for each sample of a batch under ``jit`` and ``vmap`` as for the sample alone.

The projection, rotated_nms and others are compared in tests of their own.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import tiny_run

from fcos_lidar_jax.assignment import assign, owners
from fcos_lidar_jax.augment import flip_x, flip_y, rotate, scale
from fcos_lidar_jax.centerpoint.centres import decode_centres, encode_centres
from fcos_lidar_jax.centerpoint.pillars import Grid, cell_maxima
from fcos_lidar_jax.coding import decode, decode_oriented, encode
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.geometry import image_columns, points_in_box, spherical
from fcos_lidar_jax.iou import oriented
from fcos_lidar_jax.losses import classification_loss, iou_loss, iou_prediction_loss, l1_loss
from fcos_lidar_jax.nms import merge_boxes, suppress
from fcos_lidar_jax.projection import remove_close
from fcos_lidar_jax.refinement.targets import encode_residual, match_boxes, move_boxes

N, M, C = 40, 6, 3  # points or locations, boxes, classes
GRID = Grid(8, 2.0, (-8.0, -8.0))
MATCH = {"num_classes": C, "radius_range_m": (1.0, 2.0), "between_weight": 0.25}
INFERENCE = tiny_run.CONFIG.inference


def sample(seed: int) -> dict[str, np.ndarray]:
    """Points among boxes, and numbers of all kinds that fit them."""
    rng = np.random.default_rng(seed)

    def boxes(number: int) -> np.ndarray:
        return np.concatenate([oracles.random_boxes(rng, number, 4.0), rng.normal(0, 3, (number, 2))], axis=1)

    values = {
        "points": rng.normal(0, 3, (N, 5)) * [1, 1, 0.3, 1, 0],
        "boxes": boxes(M),
        "others": boxes(M),
        "of_points": boxes(N),
        "regression": rng.normal(0, 0.5, (N, 10)),
        "residual": rng.normal(0, 0.5, (M, 8)),
        "logits": rng.normal(0, 2, (N, C + 1)),
        "number": rng.normal(0, 2, N),
        "share": rng.random(N),
        "scores": rng.random(M),
        "angle": rng.normal(),
    }
    values = {name: np.asarray(value, np.float32) for name, value in values.items()}
    whole = {
        "label": (C + 1, N),
        "owner": (M, N),
        "cell": (GRID.num_cells, N),
        "box_label": (C, M),
        "kept": (M, M),
    }
    values |= {name: rng.integers(0, limit, number).astype(np.int32) for name, (limit, number) in whole.items()}
    return values | {"mask": rng.random(N) < 0.8, "valid": rng.random(M) < 0.8}


def xyz(points):
    return points[:, :3]


CASES = {
    "owners by boxes": (lambda p, *a: owners(xyz(p), *a, form="loop"), "points mask boxes valid"),
    "owners by rank": (lambda p, *a: owners(xyz(p), *a, form="reduction"), "points mask boxes valid"),
    "assign": (functools.partial(assign, num_boxes=M), "owner number share"),
    "encode": (lambda b, p, n: encode(b, xyz(p), n), "of_points points number"),
    "encode by rays": (lambda b, p, n: encode(b, xyz(p), n, axes="ray"), "of_points points number"),
    "decode": (lambda r, p, n: decode(r, xyz(p), n), "regression points number"),
    "decode by rays": (lambda r, p, n: decode(r, xyz(p), n, axes="ray"), "regression points number"),
    "decode_oriented": (lambda r, p, n: decode_oriented(r, xyz(p), n), "regression points number"),
    "classification_loss": (classification_loss, "logits label mask"),
    "l1_loss": (lambda r, m: l1_loss(r, r[::-1], m, velocity_weight=0.2), "regression mask"),
    "iou_loss": (lambda b, m: iou_loss(oriented(b), oriented(b)[::-1], m), "of_points mask"),
    "iou_prediction_loss": (iou_prediction_loss, "number share mask"),
    "flip_x": (flip_x, "points boxes"),
    "flip_y": (flip_y, "points boxes"),
    "rotate": (rotate, "points boxes angle"),
    "scale": (scale, "points boxes angle"),
    "remove_close": (
        lambda p, m: remove_close(p, m, tiny_run.SENSOR, CloudReading(1, "all", 1.0)),
        "points mask",
    ),
    "points_in_box": (lambda p, b: points_in_box(xyz(p)[:, None], b), "points boxes"),
    "spherical": (lambda p: spherical(xyz(p)), "points"),
    "image_columns": (lambda n: image_columns(n, tiny_run.SENSOR), "number"),
    "merge_boxes": (
        lambda b, s, v, k: merge_boxes(b, s, v, k, v, labels=k, iou_threshold=0.1),
        "boxes scores valid kept",
    ),
    "suppress": (lambda *a: suppress(*a, INFERENCE), "boxes scores box_label valid"),
    "encode_centres": (lambda b, c: encode_centres(b, c, GRID), "of_points cell"),
    "decode_centres": (lambda r, c: decode_centres(r, c, GRID), "regression cell"),
    "cell_maxima": (lambda r, c: cell_maxima(r, c, GRID.num_cells), "regression cell"),
    "match_boxes": (
        functools.partial(match_boxes, **MATCH),
        "boxes box_label valid others kept valid",
    ),
    "encode_residual": (encode_residual, "boxes others"),
    "move_boxes": (move_boxes, "boxes residual"),
}


@pytest.mark.parametrize("case", CASES)
def test_samples_of_a_batch_are_as_alone(case):
    function, names = CASES[case]
    args = [[jnp.asarray(sample(seed)[name]) for name in names.split()] for seed in range(2)]
    together = jax.jit(jax.vmap(function))(*map(jnp.stack, zip(*args, strict=True)))
    for i, one in enumerate(args):
        expected, found = function(*one), jax.tree.map(lambda leaf, i=i: leaf[i], together)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, atol=2e-5, rtol=2e-5)

"""Compare the ray caster with ray marching through level functions of the shapes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.simulation.ground import Ground
from fcos_lidar_jax.simulation.raycast import Fan, cast
from fcos_lidar_jax.simulation.solids import BALL, BOX, DRUM, WHEEL, make_solids

FAR_BELOW = Ground(np.array([[0, 0, -500.0]]), 7, 900, 7, 0.0, 3, (0.1, 0.2, 0.2))
HILLS = Ground(
    np.array([[0.01, -0.008, -1.8], [0.03, -0.008, -2.6], [0.01, 0.02, -2.3]]), 6, 15, 5, 0.13, 3, (0.1, 0.2, 0.3)
)
SLACK_M = 4e-3


def level(solid, points):
    """Level function of a solid at points [n, 3] in float64: 1 on the surface, smaller inside."""
    offset = points - solid["center"]
    c, s = np.cos(solid["yaw"]), np.sin(solid["yaw"])
    along, across = c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]
    u, v, w = np.stack([along - solid["lean"] * offset[:, 2], across, offset[:, 2]]) / solid["half"][:, None]
    if solid["kind"] == BALL:
        return np.sqrt(u**2 + v**2 + w**2)
    if solid["kind"] == WHEEL:
        return np.maximum(np.hypot(u, w), np.abs(v))
    # From 1 at the base (w = -1) to the taper at the top.
    wide, deep = (1 + (t - 1) * (np.clip(w, -1, 1) + 1) / 2 for t in solid["taper"])
    round_, flat = np.hypot(u, v) / wide, np.maximum(np.abs(u) / wide, np.abs(v) / deep)
    return np.maximum(round_ if solid["kind"] == DRUM else flat, np.abs(w))


def ground_height(ground, x, y):
    """Height of the highest plane, plus the kerb off the two carriageways."""
    plane = np.max([a * x + b * y + c for a, b, c in ground.planes], axis=0)
    road = (np.abs(y) < ground.half_width) | (np.abs(x - ground.crossing_x) < ground.crossing_half_width)
    return plane + np.where(road, 0, ground.kerb)


def random_solids(rng, number):
    angle, far = rng.uniform(-np.pi, np.pi, number), rng.uniform(3, 20, number)
    center = np.stack([far * np.cos(angle), far * np.sin(angle), far * rng.uniform(-0.8, 0.8, number)], axis=1)
    solids = make_solids(BOX, center, rng.uniform(0.2, 2.0, (number, 3)))
    solids["kind"] = rng.integers(0, 4, number)
    solids["yaw"] = rng.uniform(-4, 4, number)
    solids["lean"] = rng.choice([0, 0.3, -0.6], number)
    solids["taper"] = rng.choice([1.0, 0.8, 0.3, 1.2], (number, 2))
    flat = rng.random(number) < 0.3  # flat cones, so that some rays are steeper
    solids["half"][flat] *= [2, 2, 0.2]
    return solids


@pytest.mark.parametrize("ground", [FAR_BELOW, HILLS], ids=["air", "hills"])
def test_first_hits_match_ray_marching(ground):
    rng = np.random.default_rng(0)
    solids, eye = random_solids(rng, 25), np.array([0.3, -0.4, 0.2])
    turn = Rotation.from_euler("XZ", [0.05, 1.0]).as_matrix()
    # The fan spans more than a full turn, and its lasers fire one after another.
    fan = Fan(np.radians(np.linspace(50, -50, 12)), 90, 2.9, 2 * np.pi / 90 * 1.02, np.linspace(0, 0.8, 12))
    hits = cast(fan, turn, eye, solids, ground, rng)
    directions = turn @ fan.directions.astype(np.float64)
    way = np.arange(0.02, 45, 0.02)
    met = 0
    for ray in rng.permutation(directions.shape[1])[:450]:
        d, reach, winner = directions[:, ray], hits.range_m[ray], hits.solid[ray]
        path = eye + way[:, None] * d
        full = np.array([level(s, path) <= 1 for s in solids])
        full = np.vstack([full, path[:, 2] <= ground_height(ground, *path[:, :2].T)]).any(axis=0)
        first = way[np.argmax(full)] if full.any() else np.inf
        assert reach <= first + SLACK_M, (ray, reach, first)
        if reach > way[-1]:
            continue
        met += 1
        end = (eye + reach * d)[None]
        if winner >= 0:
            # Convert the level to metres: it changes by at least distance / (largest half extent with lean).
            assert abs(level(solids[winner], end)[0] - 1) < SLACK_M / solids["half"][winner].min() * 2
        else:
            drop = end[0, 2] - ground_height(ground, *end.T[:2])[0]
            beside, along = abs(end[0, 1]), abs(end[0, 0] - ground.crossing_x)
            edge = min(abs(beside - ground.half_width), abs(along - ground.crossing_half_width))
            on_kerb_face = edge < SLACK_M and abs(drop) < ground.kerb + SLACK_M
            assert abs(drop) < SLACK_M or on_kerb_face, drop
    assert met > 30


@pytest.mark.parametrize("kind", [BOX, DRUM])
def test_solids_that_are_wider_at_the_top_stop_all_rays_through_them(kind):
    solids = make_solids(kind, [8, 0, 0], [0.4, 0.5, 0.8], taper=(1.4, 1.3), yaw=0.4, lean=0.2)
    fan = Fan(np.radians(np.linspace(8, -8, 33)), 90, 0.15, 0.3 / 90, np.zeros(33))
    hits = cast(fan, np.eye(3), np.zeros(3), solids, FAR_BELOW, np.random.default_rng(0))
    way = np.arange(6, 10, 0.01)[:, None]
    through = [(level(solids[0], way * d) < 0.99).any() for d in fan.directions.T.astype(float)]
    assert 300 < np.sum(through) <= np.sum(hits.solid == 0)
    assert (hits.solid[through] == 0).all()


@pytest.mark.parametrize("kind", [BOX, DRUM, BALL, WHEEL])
def test_incidence_matches_the_gradient_of_the_level_function(kind):
    rng = np.random.default_rng(kind)
    checked = 0
    for solid in (random_solids(rng, 1) for _ in range(12)):
        solid["kind"] = kind
        if kind == WHEEL:
            solid["taper"] = 1
        start = np.arctan2(*solid["center"][0, 1::-1]) + 0.5
        fan = Fan(np.radians(np.linspace(20, -20, 21)), 60, start, 1 / 60, np.zeros(21))
        hits = cast(fan, np.eye(3), np.zeros(3), solid, FAR_BELOW, rng)
        ends = fan.directions.T.astype(float)
        for ray in np.flatnonzero(hits.solid == 0)[::7]:
            at = ends[ray] * hits.range_m[ray]
            here, ahead, behind = (level(solid[0], at + s * 1e-4 * np.eye(3)) for s in (0, 1, -1))
            slopes = [ahead - here, here - behind]
            if np.abs(np.subtract(*slopes)).max() > 0.01 * np.abs(slopes).max():
                continue  # at an edge
            expected = abs(slopes[0] @ ends[ray]) / np.linalg.norm(slopes[0])
            assert hits.cosine[ray] == pytest.approx(expected, abs=0.02)
            checked += 1
    assert checked > 50


def test_porous_solids_stop_rays_according_to_depth():
    ball = make_solids(BALL, [10, 0, 0], 2.0, density=0.4)
    fan = Fan(np.zeros(1), 4000, 1e-3, 1e-9, np.zeros(1))
    hits = cast(fan, np.eye(3), np.zeros(3), ball, FAR_BELOW, np.random.default_rng(0))
    stopped = np.isfinite(hits.range_m)
    expected = 1 - np.exp(-0.4 * 4)
    assert stopped.mean() == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / 4000))
    assert hits.range_m[stopped].min() >= 8 - 1e-3
    assert hits.range_m[stopped].max() <= 12 + 1e-3

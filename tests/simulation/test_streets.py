"""Check the randomisations of varied streets, and that frames are unchanged."""

import dataclasses

import numpy as np
import pytest
from numpy.random import default_rng

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, SHORT_RANGE, TINY, sector
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.simulation.ground import Ground, Relief, Side
from fcos_lidar_jax.simulation.objects import (
    CLUTTER_MODELS,
    OBJECT_MODELS,
    object_solids,
    sample_size,
    vary_shape,
)
from fcos_lidar_jax.simulation.scenery import sample_side
from fcos_lidar_jax.simulation.solids import WHEEL, corners
from fcos_lidar_jax.simulation.streets import CITY, PLAIN

SENSOR = NUSCENES_HDL32E
VARIED = dataclasses.replace(CITY, gloss=1.0, patchwork=0.4, walls=0.35, bends=0.03, depots=0.5)  # as for hdl32e
QUARTER = sector(SENSOR, np.pi / 2, 272)
FRAMES = {  # sensor, options; seed, number of points, objects by label, mean x, y, z, intensity
    "plain": (
        *(TINY, {}),
        (0, 3294, [1, 1, 1, 2, 1, 2, 0, 0, 0, 1], (0.92492, -0.79278, -1.12002, 18.78081)),
        (3, 3592, [1, 1, 2, 1, 1, 1, 2, 0, 0, 1], (-0.20851, -0.18856, -0.9564, 14.11192)),
    ),
    "city": (
        *(QUARTER, {"streets": CITY, "num_objects": 60, "reach_m": 54.0}),
        (0, 4881, [5, 1, 0, 0, 0, 0, 0, 0, 0, 0], (0.40181, 13.56072, -0.5747, 16.08605)),
        (1, 5500, [12, 2, 0, 0, 0, 2, 0, 1, 0, 1], (-1.06243, 15.26934, -0.55856, 15.78145)),
    ),
    "varied": (
        *(QUARTER, {"streets": VARIED, "num_objects": 120, "reach_m": 54.0}),
        (0, 5269, [7, 3, 0, 4, 0, 1, 0, 2, 0, 0], (1.50326, 11.15075, -0.83532, 13.67318)),
        (1, 5629, [19, 0, 1, 0, 0, 2, 0, 1, 1, 0], (-1.08263, 15.40816, -0.39658, 18.89714)),
        (2, 6256, [5, 4, 4, 0, 2, 0, 0, 0, 1, 6], (1.06828, 8.18378, -0.45203, 22.04748)),
        (3, 6136, [4, 5, 1, 1, 1, 0, 1, 0, 0, 4], (-0.72841, 9.41445, -0.28606, 14.13429)),
    ),
    "a sector across the end of the turn": (
        *(sector(SENSOR, -3.0, 272), {"streets": CITY}),
        (0, 6695, [3, 0, 0, 0, 0, 0, 0, 0, 0, 0], (-13.45164, -2.24581, -0.91406, 12.57625)),
    ),
    "large offsets of the lasers": (
        *(QUARTER, {"streets": dataclasses.replace(CITY, ring_range_m=0.2)}),
        (0, 4794, [1, 0, 0, 0, 0, 0, 0, 0, 0, 0], (0.41177, 12.20327, -0.99364, 14.79683)),
    ),
    "a full turn": (
        *(SENSOR, {"streets": VARIED, "num_objects": 60}),
        (4, 23293, [12, 1, 0, 4, 1, 7, 1, 2, 3, 8], (-1.09973, 0.10707, -0.75626, 17.68493)),
    ),
    "fused sweeps of fast traffic": (
        *(SHORT_RANGE, {"reading": CloudReading(10, "none"), "fast_traffic": True}),
        (0, 35498, [0, 1, 1, 2, 1, 0, 0, 1, 0, 1], (1.57952, -3.6008, -0.73849, 18.96065)),
        (1, 33304, [1, 1, 1, 1, 2, 1, 1, 0, 1, 1], (-0.33975, -5.12296, -0.8153, 14.8272)),
    ),
}
WAVE_M, HEIGHT_M, CROWN_M = 32.0, 0.08, 0.12
PLANE = np.array([[0.01, -0.02, -1.8]])


def wave(x):
    return HEIGHT_M * np.sin(2 * np.pi * x / WAVE_M)


def wavy_ground() -> Ground:
    """Ground of one plane with waves along x, a crowned street and kerbs."""
    grid = np.arange(256) * 0.5
    relief = Relief(np.tile(wave(grid)[:, None], (1, 256)).astype(np.float32))
    return Ground(PLANE, 6, 900, 5, 0.13, 3, (0.1, 0.2, 0.3), crown=CROWN_M, relief=relief)


def wavy_height(x, y):
    """Expected height of :func:`wavy_ground` in float64."""
    side = np.minimum(np.abs(y) / 6, 1)
    return 0.01 * x - 0.02 * y - 1.8 + wave(x) - CROWN_M * side**2 + 0.13 * (np.abs(y) >= 6)


def test_hits_on_uneven_ground_match_ray_marching():
    rng, eye = default_rng(1), np.array([0.3, -0.4, 0.2])
    x, y = rng.uniform(-150, 150, (2, 2000))
    np.testing.assert_allclose(wavy_ground().height(x, y), wavy_height(x, y), atol=2e-4)
    azimuth, falling = rng.uniform(-np.pi, np.pi, 400), np.radians(rng.uniform(-30, 3, 400))
    d = np.stack([np.cos(falling) * np.cos(azimuth), np.cos(falling) * np.sin(azimuth), np.sin(falling)])
    found, cosine = wavy_ground().first_hits(d.astype(np.float32), eye)
    steps = np.linspace(1.2, 118, 40_000)
    for ray in range(400):
        path = eye[:, None] + d[:, ray : ray + 1] * steps / np.cos(falling[ray])
        under = np.flatnonzero(wavy_height(path[0], path[1]) > path[2])
        if not len(under):
            assert found[ray] > 100
            continue
        # A ray that grazes a crest may end on either side of it.
        end = eye + d[:, ray].astype(float) * found[ray]
        clear = (path[2] - wavy_height(path[0], path[1]))[: under[0]]
        assert abs(end[2] - wavy_height(*end[:2])) < 0.02 or abs(abs(end[1]) - 6) < 0.05
        if len(clear) and clear[: int(0.9 * len(clear))].min(initial=1) > 0.05:
            assert found[ray] == pytest.approx(steps[under[0]] / np.cos(falling[ray]), rel=0.02, abs=0.05)
    assert np.isfinite(found).mean() > 0.6
    assert ((cosine >= 0) & (cosine <= 1)).all()


@pytest.mark.parametrize("name", OBJECT_MODELS)
def test_varied_shapes_keep_the_box_tight(name):
    rng = default_rng(1)
    for model in OBJECT_MODELS[name]:
        size = sample_size(rng, model, CITY.sizes)
        usual = object_solids(model, size, 0.2)
        straight = (usual["lean"] == 0) & (usual["taper"] <= 1).all(axis=1)
        varied = usual.copy()
        vary_shape(rng, varied, size, CITY.shape)
        before, after = corners(usual[straight]), corners(varied[straight])
        for end in (np.min, np.max):
            slack = 0.05 + 0.02 * size.max()
            np.testing.assert_allclose(end(after, axis=(0, 1)), end(before, axis=(0, 1)), atol=slack)
        assert (varied["half"] > 0).all()
        wheels = usual["kind"] == WHEEL
        for field in ("center", "half"):
            np.testing.assert_allclose(varied[field][wheels], usual[field][wheels])
        assert (wheels.all() or (varied["half"] != usual["half"]).any()) or len(usual) == 2


@pytest.mark.parametrize("place", CLUTTER_MODELS)
def test_clutter_stands_on_the_ground_within_its_size(place):
    for model in CLUTTER_MODELS[place]:
        size = np.array(model.size_m)
        solids = object_solids(model, size, 0.2)
        ends = corners(solids)
        assert ends[..., 2].min() < 0.1 * size[2], model.category
        assert 0.8 * size[2] < ends[..., 2].max() < 1.02 * size[2], model.category
        assert (np.abs(ends[..., :2]).max(axis=(0, 1)) <= 0.75 * size[:2] + 0.3).all(), model.category


@pytest.mark.parametrize("streets", [CITY, dataclasses.replace(PLAIN, walls=1.0)], ids=["city", "walls"])
@pytest.mark.parametrize(("along", "side"), [(0, -1), (0, 1), (1, -1), (1, 1)])
def test_surroundings_are_beside_their_street_and_off_both_carriageways(along, side, streets):
    ground = Ground(np.zeros((1, 3)), 7, 30, 6, 0.13, 3, (0.1, 0.1, 0.1))
    here = Side(ground, along, side, (-60.0, 80.0))
    found = np.concatenate([sample_side(default_rng(s), here, streets, "city") for s in range(12)])
    assert len(found) > 200
    assert (found["owner"] == -1).all()
    low = found[(found["center"][:, 2] - found["half"][:, 2] < 2) & (found["density"] > 5)]
    beside, half = (low["center"][:, 1], 7) if along == 0 else (low["center"][:, 0] - 30, 6)
    assert (np.sign(beside) == side).all()
    assert (np.abs(beside) >= half - 0.5).all()


def test_streets_are_part_of_fingerprints():
    streets = PLAIN, CITY, dataclasses.replace(CITY, clutter=0.2)
    assert len({SimulatedFrames(TINY, 3, streets=own).fingerprint() for own in streets}) == 3


@pytest.mark.parametrize("kind", FRAMES)
def test_frames_are_unchanged(kind):
    """The shipped weights were trained on such frames, and studies compare their scores with earlier ones."""
    sensor, options, *rows = FRAMES[kind]
    for seed, num_points, labels, mean in rows:
        frame = make_frame(seed, sensor, **options)
        assert len(frame.points) == num_points
        assert np.bincount(frame.labels, minlength=10).tolist() == labels
        np.testing.assert_allclose(frame.points[:, :4].mean(axis=0), mean, atol=1e-3)

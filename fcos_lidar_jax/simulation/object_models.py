"""What objects of the ten classes look like, and how often each of their varieties occurs."""

import dataclasses

import numpy as np

from fcos_lidar_jax.simulation.shapes import ObjectModel, Part, ball, box, drum, wheels
from fcos_lidar_jax.simulation.vehicles import VEHICLES

_RIDER = (  # on a saddle at mid-length: trunk, head, arms to the bar, thighs
    box(-0.08, 0, 0.17, 0.62, 0.55, 0.88, "cloth", (0.8, 1), 0.06),
    ball(-0.01, 0, 0.13, 0.34, 0.86, 1, "skin"),
    box(0.08, 0.3, 0.2, 0.16, 0.62, 0.74, "cloth", lean=-0.06),
    box(0.08, -0.3, 0.2, 0.16, 0.62, 0.74, "cloth", lean=-0.06),
    box(0.0, 0.18, 0.09, 0.18, 0.2, 0.56, "cloth", lean=-0.05),
    box(0.04, -0.18, 0.09, 0.18, 0.26, 0.58, "cloth", lean=-0.08),
)


def _squeeze(parts: tuple[Part, ...], top: float) -> tuple[Part, ...]:
    """The same parts in the lower part of a taller box, as a cycle under its rider."""
    return tuple(dataclasses.replace(p, low=p.low * top, high=p.high * top) for p in parts)


_BICYCLE = (
    *wheels((-0.31, 0.31), 0.62, 0, 0.08),
    box(-0.12, 0, 0.04, 0.08, 0.3, 0.88, "steel", lean=-0.08),
    box(0.22, 0, 0.04, 0.08, 0.3, 0.92, "steel", lean=-0.08),
    box(0.02, 0, 0.36, 0.07, 0.66, 0.72, "steel"),
    box(0.05, 0, 0.05, 0.09, 0.3, 0.68, "paint", lean=0.26),
    box(0.2, 0, 0.05, 1, 0.93, 1, "steel"),
    box(-0.17, 0, 0.14, 0.25, 0.86, 0.93, "rubber"),
)
_MOTORCYCLE = (
    *wheels((-0.34, 0.35), 0.44, 0, 0.2),
    box(0.02, 0, 0.46, 0.4, 0.16, 0.5, "steel"),
    box(0.08, 0, 0.3, 0.42, 0.5, 0.72, taper=(0.8, 0.7)),
    box(-0.2, 0, 0.4, 0.34, 0.52, 0.66, "rubber"),
    box(0.3, 0, 0.06, 0.24, 0.25, 0.88, "steel", lean=-0.08),
    box(0.22, 0, 0.05, 1, 0.86, 0.92, "steel"),
    box(0.3, 0, 0.06, 0.4, 0.76, 1, "glass", (1, 0.7)),
)
_PERSON_TOP = (
    box(0, 0, 0.36, 0.56, 0.46, 0.82, "cloth", (0.95, 1.12)),
    ball(0.02, 0, 0.3, 0.3, 0.85, 1, "skin"),
    drum(0, 0, 0.16, 0.16, 0.8, 0.88, "skin"),
)
_WALKING = (
    *_PERSON_TOP,
    drum(0.14, 0.17, 0.2, 0.22, 0, 0.48, "cloth", 1.3, -0.26),
    drum(-0.2, -0.17, 0.2, 0.22, 0, 0.48, "cloth", 1.3, 0.32),
    drum(-0.08, 0.41, 0.15, 0.15, 0.42, 0.8, "cloth", 1.2, 0.2),
    drum(0.12, -0.41, 0.15, 0.15, 0.42, 0.8, "cloth", 1.2, -0.2),
)
_STANDING = (
    *_PERSON_TOP,
    drum(0, 0.16, 0.22, 0.24, 0, 0.48, "cloth", 1.25),
    drum(0, -0.16, 0.22, 0.24, 0, 0.48, "cloth", 1.25),
    drum(0, 0.41, 0.16, 0.16, 0.42, 0.8, "cloth", 1.2),
    drum(0.03, -0.41, 0.16, 0.16, 0.42, 0.8, "cloth", 1.2),
)
_BAG = (box(-0.3, 0.1, 0.26, 0.5, 0.55, 0.8, "rubber"),)
_CONCRETE = (box(0, 0, 1, 1, 0, 0.3, taper=(0.62, 1)), box(0, 0, 0.62, 1, 0.3, 1, taper=(0.55, 1)))
_GREY = (0.14, 0.3)

LOOKS: dict[str, tuple[ObjectModel, ...]] = {
    **VEHICLES,
    "pedestrian": (
        ObjectModel("human.pedestrian.adult", (0.72, 0.68, 1.76), (0.1, 0.07, 0.09), _WALKING, 0.5, (0.7, 1.8)),
        ObjectModel("human.pedestrian.adult", (0.66, 0.7, 1.74), (0.08, 0.07, 0.09), _STANDING, 0.2),
        ObjectModel(
            "human.pedestrian.adult", (0.84, 0.72, 1.76), (0.1, 0.07, 0.09), (*_WALKING, *_BAG), 0.15, (0.7, 1.6)
        ),
        ObjectModel("human.pedestrian.construction_worker", (0.7, 0.72, 1.78), (0.1, 0.07, 0.07), _STANDING, 0.08),
        ObjectModel("human.pedestrian.child", (0.52, 0.5, 1.3), (0.07, 0.05, 0.13), _WALKING, 0.07, (0.7, 1.5)),
    ),
    "motorcycle": (
        ObjectModel("vehicle.motorcycle", (2.1, 0.76, 1.15), (0.15, 0.07, 0.07), _MOTORCYCLE, 0.55),
        ObjectModel(
            "vehicle.motorcycle",
            (2.1, 0.8, 1.65),
            (0.15, 0.07, 0.08),
            (*_squeeze(_MOTORCYCLE, 0.66), *_RIDER),
            0.45,
            (2, 13),
            True,
        ),
    ),
    "bicycle": (
        ObjectModel("vehicle.bicycle", (1.72, 0.58, 1.08), (0.1, 0.06, 0.06), _BICYCLE, 0.55),
        ObjectModel(
            "vehicle.bicycle",
            (1.76, 0.62, 1.72),
            (0.1, 0.06, 0.08),
            (*_squeeze(_BICYCLE, 0.6), *_RIDER),
            0.45,
            (2, 6.5),
            True,
        ),
    ),
    "traffic_cone": (
        ObjectModel(
            "movable_object.trafficcone",
            (0.4, 0.4, 0.78),
            (0.05, 0.05, 0.12),
            (box(0, 0, 1, 1, 0, 0.05, "rubber"), drum(0, 0, 0.78, 0.78, 0.05, 1, top=0.22)),
            0.5,
        ),
        ObjectModel(  # slim post
            "movable_object.trafficcone",
            (0.45, 0.45, 1.15),
            (0.05, 0.05, 0.08),
            (drum(0, 0, 1, 1, 0, 0.05, "rubber"), drum(0, 0, 0.36, 0.36, 0.05, 1, top=0.6)),
            0.35,
        ),
        ObjectModel(  # drum
            "movable_object.trafficcone",
            (0.5, 0.5, 1.1),
            (0.05, 0.05, 0.08),
            (drum(0, 0, 1, 1, 0, 0.1, "rubber"), drum(0, 0, 0.8, 0.8, 0.1, 1, top=0.8)),
            0.15,
        ),
    ),
    "barrier": (  # the width is the long side, as in nuScenes
        ObjectModel("movable_object.barrier", (0.65, 2.8, 0.95), (0.06, 0.35, 0.08), _CONCRETE, 0.4, paint=_GREY),
        ObjectModel(  # with a fence on top, which is no part of the box
            "movable_object.barrier",
            (0.7, 3.0, 0.95),
            (0.06, 0.2, 0.05),
            (*_CONCRETE, box(0, 0, 0.05, 1, 1, 2.1, "screen")),
            0.3,
            paint=_GREY,
        ),
        ObjectModel(
            "movable_object.barrier",
            (0.55, 2.1, 1.1),
            (0.06, 0.3, 0.08),
            (
                *(box(0, y, 1, 0.05, 0, 0.08, "steel") for y in (-0.4, 0.4)),
                *(box(0, y, 0.14, 0.05, 0.08, 1, "steel") for y in (-0.4, 0.4)),
                box(0, 0, 0.12, 1, 0.72, 0.98, "plate"),
                box(0, 0, 0.12, 1, 0.3, 0.52, "plate"),
            ),
            0.3,
        ),
    ),
}
"""The varieties of every class, near the class means of nuScenes."""


def sample_object_model(rng: np.random.Generator, name: str) -> ObjectModel:
    """A variety of a class, by their shares."""
    looks = LOOKS[name]
    shares = np.cumsum([look.share for look in looks])
    return looks[int(np.searchsorted(shares, rng.random() * shares[-1], side="right"))]

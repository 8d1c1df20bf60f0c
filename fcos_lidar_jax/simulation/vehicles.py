"""What cars, trucks, buses, trailers and construction vehicles look like."""

from fcos_lidar_jax.simulation.shapes import ObjectModel, Part, ball, box, wheels
from fcos_lidar_jax.simulation.solids import WHEEL

_TRUCK_WHEELS = 0.3
_CAR_PAINT = (0.02, 1.1)
"""Lacquer reflects past the sensor."""


def _car(bonnet: float, rear: float, belt: float, roof: float) -> tuple[Part, ...]:
    """A body, a glazed cabin from ``rear`` to ``bonnet`` that narrows upwards, its roof and pillars."""
    middle, length = (rear + bonnet) / 2, bonnet - rear
    return (
        box(0, 0, 1, 1, 0.14, 0.40, taper=(0.99, 1)),
        box(-0.005, 0, 0.97, 0.97, 0.40, belt, taper=(0.93, 0.93)),
        box(middle, 0, length, 0.9, belt, roof - 0.02, "glass", (0.72, 0.8)),
        box(middle, 0, length * 0.74, 0.74, roof - 0.05, 1, taper=(0.9, 0.88)),
        box(middle - 0.28 * length, 0, 0.05, 0.84, belt, roof - 0.02),
        box(middle + 0.02 * length, 0, 0.04, 0.86, belt, roof - 0.02, taper=(1, 0.85)),
        box(-0.497, 0, 0.006, 0.26, 0.42, 0.50, "plate"),
        *wheels((-0.29, 0.31), 0.38),
    )


VEHICLES: dict[str, tuple[ObjectModel, ...]] = {
    "car": (
        ObjectModel(
            "vehicle.car",
            (4.7, 1.87, 1.48),
            (0.22, 0.07, 0.05),
            _car(0.2, -0.42, 0.6, 0.97),
            0.45,
            (2, 14),
            paint=_CAR_PAINT,
        ),
        ObjectModel(
            "vehicle.car",
            (4.2, 1.82, 1.55),
            (0.25, 0.07, 0.06),
            _car(0.24, -0.49, 0.6, 0.97),
            0.2,
            (2, 14),
            paint=_CAR_PAINT,
        ),
        ObjectModel(
            "vehicle.car",
            (4.75, 1.98, 1.78),
            (0.25, 0.09, 0.09),
            _car(0.2, -0.49, 0.6, 0.97),
            0.25,
            (2, 14),
            paint=_CAR_PAINT,
        ),
        ObjectModel(
            "vehicle.car",
            (5.1, 2.03, 2.0),
            (0.25, 0.08, 0.15),
            _car(0.32, -0.495, 0.55, 0.98),
            0.1,
            (2, 12),
            paint=_CAR_PAINT,
        ),
    ),
    "truck": (
        ObjectModel(  # box truck
            "vehicle.truck",
            (7.4, 2.5, 3.2),
            (1.2, 0.2, 0.4),
            (
                box(0.39, 0, 0.22, 0.9, 0.14, 0.45),
                box(0.38, 0, 0.19, 0.88, 0.45, 0.74, "paint", (0.75, 0.95)),
                box(0.475, 0, 0.03, 0.8, 0.48, 0.66, "glass"),
                box(-0.12, 0, 0.76, 1, 0.3, 1),
                box(-0.05, 0, 0.85, 0.35, 0.16, 0.28, "steel"),
                *wheels((-0.28, 0.36), _TRUCK_WHEELS, 0.41, 0.15),
            ),
            0.4,
            (2, 11),
        ),
        ObjectModel(  # pick-up
            "vehicle.truck",
            (5.6, 2.05, 1.9),
            (0.35, 0.1, 0.1),
            (
                box(0.33, 0, 0.33, 0.96, 0.2, 0.58, taper=(0.98, 0.94)),
                box(0.04, 0, 0.3, 1, 0.18, 0.6),
                box(0.06, 0, 0.32, 0.92, 0.6, 0.96, "glass", (0.7, 0.85)),
                box(0.05, 0, 0.24, 0.8, 0.92, 1),
                box(-0.29, 0, 0.41, 0.96, 0.2, 0.36),
                *(box(-0.29, y, 0.41, 0.05, 0.36, 0.64) for y in (-0.46, 0.46)),
                box(-0.485, 0, 0.02, 0.94, 0.36, 0.64),
                *wheels((-0.31, 0.33), 0.42),
            ),
            0.3,
            (2, 13),
        ),
        ObjectModel(  # semi tractor
            "vehicle.truck",
            (6.9, 2.6, 3.5),
            (0.7, 0.1, 0.3),
            (
                box(0.24, 0, 0.5, 0.92, 0.2, 0.55),
                box(0.12, 0, 0.28, 0.95, 0.5, 1, taper=(0.8, 0.95)),
                box(0.26, 0, 0.03, 0.8, 0.58, 0.78, "glass"),
                box(-0.2, 0, 0.6, 0.35, 0.2, 0.3, "steel"),
                box(-0.02, 0.36, 0.12, 0.2, 0.16, 0.3, "steel"),
                *wheels((-0.37, -0.2, 0.36), 0.29, 0.41, 0.16),
            ),
            0.15,
            (2, 12),
        ),
        ObjectModel(  # dump truck
            "vehicle.truck",
            (8.2, 2.6, 3.1),
            (0.8, 0.15, 0.3),
            (
                box(0.38, 0, 0.22, 0.92, 0.2, 0.9, taper=(0.85, 0.95)),
                box(0.475, 0, 0.03, 0.8, 0.56, 0.78, "glass"),
                box(-0.13, 0, 0.7, 0.8, 0.36, 0.86, "steel", (1.05, 1.22)),
                ball(-0.13, 0, 0.6, 0.85, 0.7, 1, "dirt"),
                box(-0.1, 0, 0.8, 0.35, 0.18, 0.36, "steel"),
                *wheels((-0.36, -0.2, 0.35), 0.33, 0.41, 0.16),
            ),
            0.15,
            (2, 9),
        ),
    ),
    "bus": (
        ObjectModel(
            "vehicle.bus.rigid",
            (11.6, 2.9, 3.4),
            (1.2, 0.12, 0.25),
            (
                box(0, 0, 1, 1, 0.09, 0.42),
                box(0, 0, 0.99, 0.97, 0.42, 0.78, "glass"),
                *(box(x, 0, 0.02, 0.985, 0.42, 0.78) for x in (-0.47, -0.3, -0.13, 0.04, 0.21, 0.38)),
                box(0, 0, 0.99, 0.99, 0.78, 0.96, taper=(0.99, 0.93)),
                box(-0.2, 0, 0.3, 0.6, 0.94, 1, "steel"),
                *wheels((-0.25, 0.28), 0.29, 0.43),
            ),
            0.8,
            (2, 11),
        ),
        ObjectModel(
            "vehicle.bus.bendy",
            (17.8, 2.95, 3.4),
            (0.4, 0.1, 0.15),
            (
                *(box(x, 0, l, 1, 0.09, 0.42) for x, l in ((0.23, 0.54), (-0.29, 0.42))),
                *(box(x, 0, l, 0.97, 0.42, 0.78, "glass") for x, l in ((0.23, 0.53), (-0.29, 0.41))),
                *(box(x, 0, 0.012, 0.985, 0.42, 0.78) for x in (-0.48, -0.36, -0.22, 0.05, 0.2, 0.35, 0.48)),
                *(box(x, 0, l, 0.99, 0.78, 1) for x, l in ((0.23, 0.53), (-0.29, 0.41))),
                box(-0.06, 0, 0.05, 0.88, 0.12, 0.96, "rubber"),
                *wheels((-0.33, 0.06, 0.36), 0.29, 0.43),
            ),
            0.2,
            (2, 9),
        ),
    ),
    "trailer": (
        ObjectModel(
            "vehicle.trailer",
            (13.5, 2.75, 4.0),
            (1.5, 0.1, 0.15),
            (
                box(0, 0, 1, 1, 0.29, 1),
                box(-0.05, 0, 0.9, 0.4, 0.2, 0.29, "steel"),
                *(box(0.28, y, 0.02, 0.06, 0, 0.25, "steel") for y in (-0.3, 0.3)),
                box(-0.495, 0, 0.01, 0.9, 0.12, 0.16, "steel"),
                *wheels((-0.4, -0.3), 0.25, 0.41, 0.16),
            ),
            0.65,
            (2, 11),
        ),
        ObjectModel(  # flatbed with a container
            "vehicle.trailer",
            (12.4, 2.6, 3.9),
            (0.8, 0.1, 0.2),
            (
                box(0, 0, 1, 0.96, 0.28, 0.34, "steel"),
                box(-0.03, 0, 0.9, 0.94, 0.35, 1),
                *wheels((-0.4, -0.3), 0.26, 0.41, 0.16),
            ),
            0.2,
            (2, 10),
        ),
        ObjectModel(  # behind a car
            "vehicle.trailer",
            (4.6, 2.1, 2.2),
            (0.7, 0.15, 0.3),
            (
                box(-0.12, 0, 0.75, 1, 0.22, 1),
                box(0.36, 0, 0.28, 0.08, 0.2, 0.26, "steel"),
                *wheels((-0.12,), 0.3, 0.44),
            ),
            0.15,
            (2, 10),
        ),
    ),
    "construction_vehicle": (
        ObjectModel(  # excavator
            "vehicle.construction",
            (7.8, 2.85, 3.2),
            (1.0, 0.2, 0.3),
            (
                *(box(-0.2, y, 0.52, 0.2, 0, 0.26, "rubber", (0.86, 1)) for y in (-0.38, 0.38)),
                box(-0.27, 0, 0.42, 0.9, 0.3, 0.6),
                box(-0.16, 0.25, 0.2, 0.36, 0.6, 0.94, "glass", (0.85, 0.9)),
                box(-0.16, 0.25, 0.2, 0.36, 0.92, 0.97),
                box(0.1, -0.05, 0.1, 0.14, 0.45, 0.97, lean=0.28),
                box(0.34, -0.05, 0.09, 0.12, 0.2, 0.97, lean=-0.2),
                box(0.42, -0.05, 0.14, 0.42, 0, 0.24, "steel", (0.7, 1)),
            ),
            0.4,
            (0, 1.5),
        ),
        ObjectModel(  # wheel loader
            "vehicle.construction",
            (7.0, 2.7, 3.25),
            (0.8, 0.2, 0.2),
            (
                box(-0.28, 0, 0.42, 0.7, 0.25, 0.66, taper=(0.9, 0.9)),
                box(-0.05, 0, 0.2, 0.55, 0.5, 0.95, "glass", (0.85, 0.9)),
                box(-0.05, 0, 0.18, 0.52, 0.94, 1),
                *(box(0.2, y, 0.08, 0.1, 0.2, 0.5, lean=-0.2) for y in (-0.22, 0.22)),
                box(0.41, 0, 0.18, 1, 0.02, 0.36, "steel", (0.6, 1)),
                *wheels((-0.3, 0.12), 0.46, 0.38, 0.2),
            ),
            0.4,
            (1, 4),
        ),
        ObjectModel(  # roller
            "vehicle.construction",
            (4.8, 2.1, 2.9),
            (0.5, 0.15, 0.15),
            (
                Part(WHEEL, 0.32, 0, 0, 0.9, 0, 0.5, "steel"),
                box(-0.2, 0, 0.5, 0.75, 0.25, 0.55),
                *(box(x, y, 0.03, 0.04, 0.55, 0.96, "steel") for x in (-0.2, 0.04) for y in (-0.3, 0.3)),
                box(-0.08, 0, 0.34, 0.8, 0.95, 1),
                *wheels((-0.28,), 0.5, 0.35, 0.2),
            ),
            0.2,
            (0.5, 2),
        ),
    ),
}
"""The varieties of the five classes of vehicles, near the class means of nuScenes."""

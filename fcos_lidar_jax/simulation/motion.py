"""Motions along a straight line, one bend and another straight line, with constant acceleration."""

import numpy as np

MOTION = np.dtype(
    [
        ("x", np.float64),  # position at time 0, metres
        ("y", np.float64),
        ("yaw", np.float64),  # heading at time 0, radians
        ("speed", np.float64),  # at time 0, m/s
        ("acceleration", np.float64),  # m/s^2; a braking motion stops at speed 0
        ("straight", np.float64),  # distance before the bend, metres
        ("curvature", np.float64),  # curvature of the bend, 1/m, positive to the left; 0 without a bend
        ("turn", np.float64),  # angle of the whole bend, radians
    ]
)


def make_motion(**fields: float) -> np.ndarray:
    """Create one motion, [1] of :data:`MOTION`. Fields default to 0."""
    motion = np.zeros(1, MOTION)
    for name, value in fields.items():
        motion[name] = value
    return motion


def travelled(motion: np.ndarray, time_s: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Distance travelled in metres and speed at a non-negative time."""
    speed, change = motion["speed"], motion["acceleration"]
    rest = np.where(change < 0, speed / np.maximum(-change, 1e-9), np.inf)
    t = np.minimum(time_s, rest)
    return speed * t + change * t * t / 2, speed + change * t


def pose_at(motion: np.ndarray, time_s: np.ndarray | float) -> np.ndarray:
    """Positions and headings ``x, y, yaw``, f64[..., 3]. Motions [...] and times broadcast."""
    distance, _ = travelled(motion, time_s)
    curvature = motion["curvature"]
    bends = curvature != 0
    c, s = np.cos(motion["yaw"]), np.sin(motion["yaw"])
    if not bends.any():  # shortcut for the many straight motions, bit-identical with the general case
        x, y, yaw = np.broadcast_arrays(motion["x"] + c * distance, motion["y"] + s * distance, motion["yaw"])
        return np.stack([x, y, yaw], axis=-1)
    safe = np.where(bends, curvature, 1.0)
    length = np.where(bends, motion["turn"] / safe, 0.0)
    before = np.where(bends, np.minimum(distance, motion["straight"]), distance)
    angle = curvature * np.clip(distance - before, 0, length)
    after = np.maximum(distance - before - length, 0)
    along = before + np.sin(angle) / safe + after * np.cos(angle)
    across = (1 - np.cos(angle)) / safe + after * np.sin(angle)
    x, y = motion["x"] + c * along - s * across, motion["y"] + s * along + c * across
    return np.stack([x, y, motion["yaw"] + angle], axis=-1)


def velocity_at(motion: np.ndarray, time_s: np.ndarray | float) -> np.ndarray:
    """Velocities ``vx, vy`` in m/s, f64[..., 2]."""
    yaw = pose_at(motion, time_s)[..., 2]
    _, speed = travelled(motion, time_s)
    return np.stack([speed * np.cos(yaw), speed * np.sin(yaw)], axis=-1)

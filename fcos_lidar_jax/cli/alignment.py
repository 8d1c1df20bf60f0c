"""How the clouds of a command are read and turned: by its options, or by the sensor that recorded the files."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.data.recorded import check_scale
from fcos_lidar_jax.inference.alignment import Alignment, align, align_files
from fcos_lidar_jax.sensors import Sensor, load_sensor


def radians(degrees: float | None) -> float | None:
    """Radians; None stays None."""
    return None if degrees is None else float(np.deg2rad(degrees))


def alignment_of(args: Any, detector: Sensor, clouds: Iterable[Path]) -> Alignment:
    """The alignment by ``data_sensor``, ``yaw_deg`` and ``intensity_scale``, else by where the clouds are."""
    clouds = list(clouds)
    check_scale(args.intensity_scale, clouds)
    how: dict[str, Any] = {"yaw_rad": radians(args.yaw_deg), "intensity_scale": args.intensity_scale}
    if args.data_sensor is None:
        return align_files(clouds, detector, **how)
    return align(detector, load_sensor(args.data_sensor), **how)

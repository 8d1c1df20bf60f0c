"""LiDAR sensors as data: beams, columns and limits, with presets and a JSON format."""

import dataclasses
import math
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from fcos_lidar_jax.fields import Bounds, Checked, check, check_name, from_json
from fcos_lidar_jax.files import read_json

_MAX_NUMBER = 1e9  # Keeps squares in float32 finite.
_ROUNDING_RAD = 1e-9  # of the ends of a whole turn
_SAME_HEADING_RAD = 1e-3  # headings typed with few digits are the same
# Far more than any LiDAR has, so that a corrupt number cannot exhaust the memory.
_MAX_ROWS = 4096
_MAX_COLUMNS = 65536
_Place = Bounds(-_MAX_NUMBER, _MAX_NUMBER)
_Positive = Annotated[float, Bounds(0.0, _MAX_NUMBER, above=True)]


@dataclasses.dataclass(frozen=True)
class Sensor(Checked):
    """A rotating LiDAR, described as far as the range view needs it (paper, section 3.1).

    Raises:
        ValueError: at construction, naming the field, the found and the expected value.
    """

    name: str
    inclinations_rad: Annotated[tuple[float, ...], Bounds(-math.pi / 2, math.pi / 2)]
    """Inclination of each beam in radians, one per image row and strictly decreasing: row 0 is the highest beam.
    The table is nominal for sensors with ``row_source="laser"``."""
    num_columns: Annotated[int, Bounds(2, _MAX_COLUMNS)]
    """Azimuth bins of one turn, or of the covered sector. Columns run clockwise; column 0 starts at azimuth pi, or
    at the left end of the sector."""
    origin_m: Annotated[tuple[float, float, float], _Place] = (0.0, 0.0, 0.0)
    """In the points' frame; subtracted before equation 1."""
    limit_xy_m: _Positive = 54.0  # Points with ``|x|`` or ``|y|`` at or beyond this limit are dropped.
    limit_z_m: Annotated[tuple[float, float], Bounds(-_MAX_NUMBER, _MAX_NUMBER, ascending=True)] = (-5.0, 3.0)
    """Points with z outside this open interval are dropped."""
    intensity_scale: _Positive = 1.0  # Factor from the intensity in files to the scale 0-255.
    row_source: Literal["inclination", "laser"] = "inclination"
    """``"inclination"`` bins the inclination of each point; ``"laser"`` reads the row from a sixth point column,
    for stacked sensors whose inclinations overlap. Its lasers are numbered from the highest down."""
    azimuth_limits_rad: tuple[float, float] | None = None
    """Right and left end of the covered sector, counter-clockwise and at most a turn apart, with the right end in
    [-pi, pi]; None for a full turn. Points outside the sector are dropped."""
    # Not in `repr`, which fingerprints of frames contain: it changes no point that is read.
    forward_rad: Annotated[float | None, Bounds(-math.pi, math.pi)] = dataclasses.field(default=None, repr=False)
    """Azimuth of the ego vehicle's heading in the frame of the points, in [-pi, pi]: 0 where x points forward,
    pi/2 where y points forward. None if unknown; clouds are then never rotated."""

    def __post_init__(self) -> None:
        super().__post_init__()
        table, ends = self.inclinations_rad, self.azimuth_limits_rad
        decreasing = 2 <= len(table) <= _MAX_ROWS and all(above > below for above, below in pairwise(table))
        expected = f"2 to {_MAX_ROWS} strictly decreasing values, the highest beam first"
        check(decreasing, "inclinations_rad", table, expected)
        if ends is not None:
            within = abs(ends[0]) <= math.pi and 0 < ends[1] - ends[0] <= 2 * math.pi + _ROUNDING_RAD
            expected = "(right, left) with right in [-pi, pi] and left at most one turn further"
            check(within, "azimuth_limits_rad", ends, expected)

    @property
    def first_azimuth_rad(self) -> float:
        """Azimuth at which column 0 starts."""
        return math.pi if self.azimuth_limits_rad is None else self.azimuth_limits_rad[1]

    @property
    def column_rad(self) -> float:
        """Width of a column in azimuth."""
        right, left = self.azimuth_limits_rad or (-math.pi, math.pi)
        return (left - right) / self.num_columns

    @property
    def is_full_turn(self) -> bool:
        """Whether the columns cover all azimuths: without limits, or with limits a turn apart."""
        return self.num_columns * self.column_rad > 2 * math.pi - _ROUNDING_RAD

    @property
    def num_rows(self) -> int:
        """Number of image rows, one per beam."""
        return len(self.inclinations_rad)

    @property
    def point_columns(self) -> int:
        """Number of columns of point arrays: five, or six with the laser number."""
        return 6 if self.row_source == "laser" else 5

    @property
    def even_step_rad(self) -> float | None:
        """Spacing of evenly spaced beams, which lets the projection compute rows by arithmetic; otherwise None."""
        steps = -np.diff(np.asarray(self.inclinations_rad, np.float64))
        return float(steps.mean()) if np.abs(steps - steps.mean()).max() < 1e-9 else None

    @property
    def row_edges_rad(self) -> tuple[float, ...]:
        """Upper edges of all rows and lower edge of the last row, decreasing: midpoints between beams."""
        table = np.asarray(self.inclinations_rad, np.float64)
        middle = (table[1:] + table[:-1]) / 2
        first = table[0] + (table[0] - table[1]) / 2
        last = table[-1] - (table[-2] - table[-1]) / 2
        return tuple(float(v) for v in (first, *middle, last))


def even_inclinations(lowest_deg: float, highest_deg: float, num_rows: int) -> tuple[float, ...]:
    """Inclinations of evenly spaced beams in radians, highest first, both ends included.

    >>> [round(math.degrees(v), 2) for v in even_inclinations(-30.67, 10.67, 3)]
    [10.67, -10.0, -30.67]
    """
    return tuple(float(v) for v in np.radians(np.linspace(highest_deg, lowest_deg, num_rows)))


def sector(sensor: Sensor, middle_rad: float, num_columns: int) -> Sensor:
    """Sensor that covers a sector of a full turn, around the azimuth ``middle_rad``, with columns of the same
    width.

    >>> ahead = sector(NUSCENES_HDL32E, math.pi / 2, 272)
    >>> ahead.num_columns, [round(math.degrees(v), 2) for v in ahead.azimuth_limits_rad]
    (272, [44.92, 135.08])
    """
    half = sensor.column_rad * num_columns / 2
    right = math.remainder(middle_rad - half, 2 * math.pi)
    limits = (right, right + 2 * half)
    name = f"{sensor.name}_{num_columns}_columns"
    return dataclasses.replace(sensor, name=name, num_columns=num_columns, azimuth_limits_rad=limits)


def turn_between(data: Sensor, other: Sensor) -> float:
    """Rotation about z, radians, from one sensor's frame to another's.

    Maps the ego vehicle's heading in the first frame to its heading in the second; 0 if a heading is unknown.
    """
    if data.forward_rad is None or other.forward_rad is None:
        return 0.0
    turn = math.remainder(other.forward_rad - data.forward_rad, 2 * math.pi)
    return turn if abs(turn) > _SAME_HEADING_RAD else 0.0


def in_frame_of(sensor: Sensor, data: Sensor) -> Sensor:
    """Combine rows, columns and limits of ``sensor`` with frame and intensity scale of ``data``, which recorded
    the points.

    >>> image = in_frame_of(NUSCENES_HDL32E, KITTI_HDL64E)
    >>> image.num_rows, image.intensity_scale, image.forward_rad
    (32, 255.0, 0.0)
    """
    turn, rise = turn_between(data, sensor), data.origin_m[2] - sensor.origin_m[2]
    if (limits := sensor.azimuth_limits_rad) is not None and turn:
        right = math.remainder(limits[0] - turn, 2 * math.pi)
        limits = right, right + limits[1] - limits[0]
    return dataclasses.replace(
        sensor,
        origin_m=data.origin_m,
        limit_z_m=(sensor.limit_z_m[0] + rise, sensor.limit_z_m[1] + rise),
        intensity_scale=data.intensity_scale,
        azimuth_limits_rad=limits,
        forward_rad=data.forward_rad,
    )


NUSCENES_HDL32E = Sensor("nuscenes_hdl32e", even_inclinations(-30.67, 10.67, 32), 1086, forward_rad=math.pi / 2)
"""nuScenes ``LIDAR_TOP`` (paper, section 3.1): frame x right, y forward, z up."""

KITTI_HDL64E = Sensor(
    "kitti_hdl64e",
    # Two blocks of lasers: the upper 32 beams are 1/3 degree apart, the lower 32 beams 1/2 degree.
    tuple(float(v) for v in np.radians([*(2.0 - np.arange(32) / 3), *(-8.83 - np.arange(32) / 2)])),
    2048,
    limit_xy_m=75.0,
    intensity_scale=255.0,
    forward_rad=0.0,
)
"""KITTI's HDL-64E, nominal beam table; intensity in the files is 0-1."""

KITTI_CAMERA = dataclasses.replace(sector(KITTI_HDL64E, 0.0, 512), name="kitti_camera")
"""The quarter turn ahead, which contains the view of KITTI's camera, where objects are labelled."""

WAYMO_TOP = Sensor(
    "waymo_top",
    even_inclinations(-17.6, 2.4, 64),
    2650,
    origin_m=(1.43, 0.0, 2.184),
    limit_xy_m=75.0,
    limit_z_m=(-3.0, 5.0),
    intensity_scale=255.0,
    forward_rad=0.0,
)
"""Waymo's top LiDAR, points in the vehicle frame, nominal beam table. Put the table of a real calibration in a
sensor file. Waymo's intensity has no upper limit: store its tanh, which is 0-1 as in KITTI's files."""

ARGOVERSE2 = Sensor(
    "argoverse2",
    even_inclinations(-25.0, 15.0, 64),
    1800,
    origin_m=(1.35, 0.0, 1.64),
    limit_xy_m=100.0,
    limit_z_m=(-3.0, 5.0),
    row_source="laser",
    forward_rad=0.0,
)
"""Argoverse 2: two stacked 32-beam sensors with overlapping inclinations; the row is the rank of the laser, which
the reader finds in each sweep, because the logs number their lasers differently and in no order."""

VLP16 = Sensor("vlp16", even_inclinations(-15.0, 15.0, 16), 1800)
"""Velodyne VLP-16 (Puck) at 10 Hz: 2 degrees between beams, 0.2 degrees between columns (data sheet)."""

OS1_64 = Sensor("os1_64", even_inclinations(-16.6, 16.6, 64), 1024)
"""Ouster OS1-64 in mode 1024x10: field of view of 33.2 degrees, nominal (data sheet of the first generation).
Intensity is the reflectivity, 0-255, not the signal."""

OS1_128 = Sensor("os1_128", even_inclinations(-22.5, 22.5, 128), 1024)
"""Ouster OS1-128 in mode 1024x10: field of view of 45 degrees, nominal (data sheet). Intensity as for OS1-64."""

# Every sixth of a degree from 2 to -6 degrees, coarser above and below.
_PANDAR64_DEG = [15, 11, 8, 5, 3, *(2 - np.arange(49) / 6), *range(-7, -15, -1), -19, -25]
PANDAR64 = Sensor("pandar64", tuple(float(v) for v in np.radians(_PANDAR64_DEG)), 1800)
"""Hesai Pandar64 at 10 Hz: nominal channel distribution, 0.2 degrees between columns (user manual)."""

_SIMULATED: dict[str, Any] = {"limit_xy_m": 25.0, "forward_rad": math.pi / 2}
TINY = Sensor("tiny", even_inclinations(-24.0, 6.0, 16), 256, **_SIMULATED)
"""A 16-beam sensor with a short reach, for tests."""

SHORT_RANGE = Sensor("short_range", even_inclinations(-30.0, 10.0, 32), 128, **_SIMULATED)
"""The quickstart's sensor: 32 beams, few columns, for short range."""

_REAL = (NUSCENES_HDL32E, KITTI_HDL64E, KITTI_CAMERA, WAYMO_TOP, ARGOVERSE2, VLP16, OS1_64, OS1_128, PANDAR64)
PRESETS: dict[str, Sensor] = {s.name: s for s in (*_REAL, TINY, SHORT_RANGE)}
"""Sensors by name."""


def sensor_to_json(sensor: Sensor) -> dict[str, Any]:
    """Convert a sensor to the JSON object that :func:`sensor_from_json` reads."""
    return dataclasses.asdict(sensor)


@dataclasses.dataclass(frozen=True)
class _EvenBeams(Checked):
    """Evenly spaced beams, in degrees, of a sensor file."""

    lowest: Annotated[float, _Place]
    highest: Annotated[float, _Place]
    rows: Annotated[int, Bounds(2, _MAX_ROWS)]


def sensor_from_json(record: Any, where: str = "sensor") -> Sensor:
    """Create a sensor from a JSON object with the fields of :class:`Sensor`.

    ``inclinations_rad`` and ``inclinations_deg`` are lists of beams, highest first. Evenly spaced beams can be
    given as ``inclinations_deg: {"lowest": .., "highest": .., "rows": ..}`` instead. Without ``forward_rad``, the
    heading is the heading of the preset with the same name, or unknown.

    Raises:
        ValueError: naming ``where``, the field, the found and the expected value.

    >>> beams = {"lowest": -25, "highest": 3, "rows": 64}
    >>> sensor_from_json({"name": "mine", "num_columns": 1024, "inclinations_deg": beams}).num_rows
    64
    """
    if not isinstance(record, dict):
        return from_json(Sensor, record, where)  # refused
    if ("inclinations_deg" in record) == ("inclinations_rad" in record):
        found = "both" if "inclinations_deg" in record else "missing"
        raise ValueError(f"{where}: inclinations_deg, inclinations_rad: {found}, expected one of them")
    preset = PRESETS.get(str(record.get("name")))
    record = {"forward_rad": None if preset is None else preset.forward_rad, **record}
    if "inclinations_deg" in record:
        given = record.pop("inclinations_deg")
        kind = tuple[float, ...] if isinstance(given, list) else _EvenBeams
        beams = from_json(kind, given, f"{where}: inclinations_deg")
        if isinstance(beams, _EvenBeams):
            record["inclinations_rad"] = even_inclinations(beams.lowest, beams.highest, beams.rows)
        else:
            record["inclinations_rad"] = tuple(math.radians(beam) for beam in beams)
    return from_json(Sensor, record, where, defaults=True)


def load_sensor(path: str | Path) -> Sensor:
    """Load a sensor by preset name, or from a JSON file in the format of :func:`sensor_from_json` or with a name.

    Raises:
        ValueError: naming the file, the field, the found and the expected value.
    """
    if str(path) in PRESETS:
        return PRESETS[str(path)]
    record = read_json(Path(path), what=f"a sensor file or a preset ({', '.join(PRESETS)})")
    if not isinstance(record, str):
        return sensor_from_json(record, str(path))
    check_name(str(path), record, PRESETS)
    return PRESETS[record]

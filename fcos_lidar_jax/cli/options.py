"""Options that several commands have, with one help text for each."""

import math
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from fcos_lidar_jax import inference, sensors
from fcos_lidar_jax.cli import sinks
from fcos_lidar_jax.cli.checks import Needs, Output
from fcos_lidar_jax.fields import Bounds, Count
from fcos_lidar_jax.inference.alignment import Alignment, align
from fcos_lidar_jax.progress import tell


def option(
    metavar: str | None = None,
    *,
    default: str | None = None,
    text: str | None = None,
    aliases: tuple[str, ...] = (),
) -> Any:
    """Describe an option in the help: the placeholder of its value, and the text shown for a default of None.

    Without ``default``, the help calls an option optional if its default is None. By default, the text is the
    comment or docstring of the field. ``aliases`` are further names.
    """

    def hint(label: str) -> str:
        shown = default or ("" if label in ("None", "") else label)
        return f"(default: {shown})" if shown else "(optional)"

    return tyro.conf.arg(metavar=metavar, help=text, help_behavior_hint=hint, aliases=aliases)


_DETECTOR = (
    "Trained detector: a checkpoint; the folder of a run, for its last checkpoint; RUN/best, for its best one; "
    "{}hdl32e or quickstart, the shipped weights."
)
_RAW = "in raw files of another layout"

Trained = Annotated[Path, option("C", text=_DETECTOR.format(""))]
DETECTOR_TEXT = _DETECTOR.format("a file written by `fcos-lidar export`; ")
Detector = Annotated[Path, option("C", text=DETECTOR_TEXT)]
Backend = Annotated[
    inference.Backend,
    option(
        text="Runtime of the network. openvino is faster on CPUs, uses bfloat16 where the processor supports it, "
        "and needs pip install -e '.[cpu]' in the repository."
    ),
]
BatchSize = Annotated[
    Count, option(text="Clouds per device and call. Another size changes boxes and scores by rounding.")
]
Close = Annotated[
    Literal["all", "sweeps", "none"] | None,
    option(
        "{all,sweeps,none}",
        default="as the detector was trained",
        text="Drop points near the sensor (usually within a metre in x and y): all sweeps, older sweeps, or none.",
    ),
]
Columns = Annotated[
    int | None,
    option("N", default="by ending", text=f"Values per point {_RAW}: 3, 4, 5 (the fifth is the time lag) or 6."),
]
Dtype = Annotated[
    Literal["float16", "float32", "float64"] | None,
    option("{float16,float32,float64}", default="float32", text=f"Number type {_RAW}."),
]
Viewpoint = Annotated[bool, option(text="Move the points of .pcd files by the VIEWPOINT of their headers.")]
MaxFilePoints = Annotated[Count, option(text="Refuse point files with more points than this.")]
Score = Annotated[float | None, Bounds(0, 1)]
MinScore = Annotated[
    Score,
    option(
        "SCORE",
        default="0 in files; pictures, pages and Rerun files show boxes from 0.3",
        text="Leave out boxes with a lower score.",
    ),
]
Labels = Annotated[
    tuple[str, ...] | None, option("NAME...", default="all classes", text="Leave out boxes of other classes.")
]
OutputFormat = Annotated[
    sinks.Format,
    option(
        text="Format of --out: JSON; a nuScenes results file, in the global frame; KITTI result files, for which "
        "--out is a folder; or an ASAM OpenLABEL 1.0 file."
    ),
]
Calibration = Annotated[
    Path | None,
    Needs("output_format", "kitti"),
    option(
        "PATH",
        default="calib beside the folder of the clouds",
        text="For --output-format kitti: KITTI calibration file, or a folder with one per cloud.",
    ),
]
Rrd = Annotated[
    Path | None,
    Output.FILE,
    option(
        "FILE.rrd",
        text="Also write a recording for the Rerun viewer. Needs pip install -e '.[viz]' in the repository.",
    ),
]
Page = Annotated[
    Path | None,
    Output.FILE,
    option("FILE.html", text="Also write a page for a browser, one file that works offline."),
]
Sensor = Annotated[str, option("SENSOR", text="Sensor preset, or a sensor file.")]
DataSensor = Annotated[
    str | None,
    option(
        "SENSOR",
        default="KITTI's, Argoverse 2's or the sensor.json of own data for files in their folders, else the "
        "detector's",
        text="Sensor of the data, a preset or a sensor file; gives heading, position and intensity scale.",
    ),
]
Yaw = Annotated[
    float | None,
    Bounds(-360, 360),
    option(
        "DEGREES",
        default="the angle between the headings of the two sensors, if known",
        text="Rotate the clouds by this angle about z before detection, and the boxes back. Use 90 if x points "
        "forward and the detector expects y forward, as hdl32e does.",
    ),
]
IntensityScale = Annotated[
    float | None, option("FACTOR", default="the sensor's", text="Factor that scales intensities to 0-255.")
]


FullTurn = Annotated[
    bool,
    option(text="KITTI: keep the points outside the camera image, where nothing is labelled."),
]


def radians(degrees: float | None) -> float | None:
    """The angle of ``yaw_deg`` in radians; None stays None."""
    octants = round((degrees or 0.0) * 4 / math.pi)
    if degrees and abs(octants) <= 8 and abs(degrees - octants * math.pi / 4) < 0.005:
        tell(f"note: --yaw-deg {degrees:g} is in degrees; are {45 * octants} meant?", once=True)
    return None if degrees is None else math.radians(degrees)


def alignment_of(
    args: Any, detector: sensors.Sensor, paths: Collection[Path], sensor: sensors.Sensor | None = None
) -> Alignment:
    """The alignment of point files, or a recording, by the three options above, else by a sensor or the paths."""
    sensor = sensor if args.data_sensor is None else sensors.load_sensor(args.data_sensor)
    how = {"yaw_rad": radians(args.yaw_deg), "intensity_scale": args.intensity_scale}
    return align(detector, sensor, paths=paths, **how)

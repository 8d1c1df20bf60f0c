"""``fcos-lidar synthesize``: a simulated data set in the official nuScenes layout."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Literal

from fcos_lidar_jax.cli import options
from fcos_lidar_jax.cli.checks import Output
from fcos_lidar_jax.cli.options import option
from fcos_lidar_jax.fields import Count, Natural
from fcos_lidar_jax.progress import Progress, tell
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, in_frame_of, load_sensor
from fcos_lidar_jax.simulation.nuscenes_export import splits, write_dataset
from fcos_lidar_jax.simulation.render import DatasetSpec
from fcos_lidar_jax.simulation.streets import STREETS


@dataclasses.dataclass(frozen=True)
class Synthesize:
    """Simulate drives through streets with objects of the ten nuScenes classes, seen by a rotating LiDAR, and
    write them in the official nuScenes layout.

    The same options give the same bytes, and a scene does not depend on the number of scenes. After Ctrl-C or a
    kill, the same command resumes and repeats one scene per worker. The last fifth of the scenes is the split val,
    the rest is train. For the official devkit, which reserves these names, they are synthetic_val and
    synthetic_train.
    """

    out: Annotated[Path, Output.FOLDER, option("DIR")]
    """Folder of the data set: new or empty, or of an interrupted call."""
    scenes: Count  # Number of scenes. By default a scene lasts 19.5 s and takes 272 MB.
    seed: Natural = 0  # Seed of the streets.
    keyframes: Count = 40  # Annotated keyframes per scene, at 2 Hz, with nine sweeps between two keyframes.
    sensor: options.Sensor = "nuscenes_hdl32e"
    streets: Literal["city", "plain"] = "city"
    """Varied streets (city), or streets with little besides the objects (plain)."""
    rolling_shutter: bool = True
    """Move the ego vehicle and objects while the sensor turns, as in real data. Takes about twice as long."""
    workers: Count = 1  # Processes that simulate.
    version: Annotated[str, option("NAME")] = "v1.0-synthetic"  # Folder of the tables.


def run(args: Synthesize) -> None:
    """Write the data set, and print a record of it."""
    is_name = Path(args.version).name == args.version and not args.version.startswith(".")
    if not is_name or args.version in ("", "samples", "sweeps", "maps"):
        raise ValueError(f"--version: got {args.version!r}, expected a name for the folder of the tables")
    sensor = in_frame_of(load_sensor(args.sensor), NUSCENES_HDL32E)  # as all readers of this layout expect
    if sensor.row_source == "laser":
        raise ValueError(
            f"--sensor: got {sensor.name}, whose rows come from laser numbers, expected another one: the nuScenes "
            "layout has no laser numbers"
        )
    fields = args.scenes, args.seed, args.keyframes, sensor, args.rolling_shutter, args.version
    spec = DatasetSpec(*fields, STREETS[args.streets])
    sweeps = args.scenes * spec.sweeps
    progress = Progress("sweeps", sweeps)
    if not write_dataset(spec, args.out, workers=args.workers, report=progress.show):
        tell(f"{args.out}: was there already")
    record = {
        "data_root": str(args.out),
        "version": args.version,
        "splits": {name: len(scenes) for name, scenes in splits(args.scenes).items()},
        "keyframes": args.scenes * args.keyframes,
        "sweeps": sweeps,
    }
    print(json.dumps(record))

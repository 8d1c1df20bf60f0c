"""``fcos-lidar synthesize``: a simulated data set in the official nuScenes layout."""

import dataclasses
import json
import sys
from pathlib import Path

from fcos_lidar_jax.cli.checks import check_at_least, check_out_folder
from fcos_lidar_jax.data.class_mapping import unknown_name
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.simulation.nuscenes_export import splits, write_dataset
from fcos_lidar_jax.simulation.render import SWEEPS_PER_KEYFRAME, DatasetSpec
from fcos_lidar_jax.simulation.streets import STREETS


@dataclasses.dataclass(frozen=True)
class Synthesize:
    """Simulate streets with objects of all ten classes, seen by a turning LiDAR, and write them as a data set in
    the official nuScenes layout.

    The same options give the same bytes, and a scene does not depend on how many there are. Ctrl-C, or a kill,
    loses the scene at hand: the same command resumes. The last fifth of the scenes is the split val, the others
    are train; the official devkit, which reserves those names, knows them as synthetic_val and synthetic_train.
    """

    out: Path  # Folder of the data set: new or empty, or where the same command was stopped.
    scenes: int  # How many; with the defaults a scene lasts 19.5 s and takes 272 MB.
    seed: int = 0  # Another seed gives other streets.
    keyframes: int = 40  # Annotated keyframes a scene, at 2 Hz, with nine sweeps between two of them.
    sensor: str = "nuscenes_hdl32e"  # Sensor preset, or a sensor file.
    streets: str = "city"  # Varied streets (city), or such with few things besides objects (plain).
    rolling_shutter: bool = True
    """Car and objects move while the sensor turns, as they do in real data; takes about twice as long."""
    workers: int = 1  # Processes.
    version: str = "v1.0-synthetic"  # Folder of the tables.


def run(args: Synthesize) -> None:
    """Write the data set, and print what it holds."""
    check_at_least(args, 1, "scenes", "keyframes", "workers")
    check_at_least(args, 0, "seed")
    if not args.version or args.version.startswith(".") or Path(args.version).name != args.version:
        raise ValueError(f"--version: got {args.version!r}, expected a folder's name")
    if args.version in ("samples", "sweeps", "maps"):
        raise ValueError(f"--version: got {args.version!r}, which is the name of another folder")
    if args.streets not in STREETS:
        raise ValueError(f"--streets: {unknown_name(args.streets, STREETS)}")
    check_out_folder(args.out)
    sensor = load_sensor(args.sensor)
    if sensor.row_source == "laser":
        found = f"{sensor.name}, whose rows come from laser numbers"
        raise ValueError(f"--sensor: got {found}, expected one without: the layout of nuScenes has none")
    fields = args.scenes, args.seed, args.keyframes, sensor, args.rolling_shutter, args.version
    order = DatasetSpec(*fields, STREETS[args.streets])
    sweeps = args.scenes * ((args.keyframes - 1) * SWEEPS_PER_KEYFRAME + 1)
    progress = Progress("sweeps", sweeps)
    if not write_dataset(order, args.out, workers=args.workers, report=progress.show):
        print(f"{args.out}: was there already", file=sys.stderr)
    record = {
        "data_root": str(args.out),
        "version": args.version,
        "splits": {name: len(scenes) for name, scenes in splits(args.scenes).items()},
        "keyframes": args.scenes * args.keyframes,
        "sweeps": sweeps,
    }
    print(json.dumps(record))

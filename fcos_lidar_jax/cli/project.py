"""``fcos-lidar project``: the multi-round range image of a point file."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro

from fcos_lidar_jax.cli import options
from fcos_lidar_jax.cli.checks import Output
from fcos_lidar_jax.cli.options import option
from fcos_lidar_jax.config import MAX_ROUNDS, Config, ProjectionConfig
from fcos_lidar_jax.data.cloud_policy import make_cloud, no_usable_points, sensor_mismatch
from fcos_lidar_jax.data.point_files import ENDINGS, MAX_POINTS, read_points
from fcos_lidar_jax.fields import Bounds
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import load_sensor


@dataclasses.dataclass(frozen=True)
class Project:
    """Project a point file to its multi-round range image.

    Writes point_index i32[h,w,r] (row in the file, -1 for empty), features f32[h,w,9,r] (x, y, z, range, azimuth,
    inclination, intensity, existence, time lag) and the counts to a .npz file, and prints the counts as JSON.
    """

    file: tyro.conf.Positional[Annotated[Path, option("FILE", text=f"Point file: {', '.join(ENDINGS)}.")]]
    out: Annotated[Path, Output.CLOUD, option("FILE.npz")]  # File for the range image.
    png: Annotated[Path | None, Output.FILE, option("FILE.png")] = None
    """Also draw the range image, one panel per round."""
    sensor: options.Sensor = "nuscenes_hdl32e"
    rounds: Annotated[int, Bounds(1, MAX_ROUNDS)] = 5  # Rounds of the projection.
    prioritize_current: bool = True  # Let points of the current sweep win every collision with older points.
    remove_close: Literal["all", "sweeps", "none"] = ProjectionConfig.remove_close
    """Drop points within a metre of the sensor in x and y: all sweeps, only older sweeps, or none."""
    columns: options.Columns = None
    dtype: options.Dtype = None
    viewpoint: options.Viewpoint = False
    max_file_points: options.MaxFilePoints = MAX_POINTS


def run(args: Project) -> None:
    """Project the file, write the image, and print the counts."""
    sensor = load_sensor(args.sensor)
    layout = {name: getattr(args, name) for name in ("columns", "dtype", "viewpoint")}
    limit, num_sweeps = args.max_file_points, Config.num_sweeps
    points = read_points(args.file, sensor, max_points=limit, num_sweeps=num_sweeps, **layout)
    projection = ProjectionConfig(remove_close=args.remove_close)
    config = Config(max_points=max(len(points), 1), projection=projection)
    cloud = make_cloud(points, config, sensor=sensor)
    rounds = {"num_rounds": args.rounds, "prioritize_current": args.prioritize_current}
    image = jax.device_get(project_points(cloud.points, cloud.valid, sensor, **rounds))
    dropped = int(image.num_dropped)
    if line := no_usable_points(args.file, cloud, dropped, sensor):
        raise ValueError(line)
    if line := sensor_mismatch(points, sensor):
        tell(f"warning: {args.file}: {line}")
    counts: dict[str, Any] = {"num_points": cloud.num_points, "num_dropped": dropped + cloud.num_removed}
    kept = (image.point_index >= 0).sum(axis=(0, 1)).tolist()
    counts |= {"num_close": cloud.num_close, "kept_by_round": kept}

    def save(path: Path) -> None:
        with path.open("wb") as stream:
            np.savez_compressed(stream, point_index=image.point_index, features=image.features, **counts)

    atomic_write(args.out, save)
    if args.png is not None:
        from fcos_lidar_jax.visualization.range_image import draw_range_image

        limits = sensor.azimuth_limits_rad
        draw_range_image(image, args.png, title=f"{args.file.name}, {sensor.name}", azimuth_limits_rad=limits)
    print(json.dumps({"file": str(args.file), **counts}))

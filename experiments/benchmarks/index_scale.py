"""What does the index of a full-size nuScenes cost: time, memory, and the time to open it again?

    python -m experiments.benchmarks.index_scale

Generates tables of the size of ``v1.0-trainval`` (850 scenes, 34,000 keyframes, 2.6 million rows of sample_data
and of ego_pose, 1.17 million annotations; no point files), builds, saves and opens the index in processes of
their own, and prints times and peak memory.

Cost: two to three minutes and 3 GB of disk below --folder, removed at the end.
"""

import dataclasses
import json
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from experiments.script import run_script, save
from fcos_lidar_jax.data.nuscenes.build import build_index
from fcos_lidar_jax.data.nuscenes.index import open_index, save_index
from fcos_lidar_jax.data.nuscenes.names import CATEGORY_TO_CLASS

CHANNELS = ("LIDAR_TOP", *(f"CAM_{i}" for i in range(6)), *(f"RADAR_{i}" for i in range(5)))
KEYFRAMES = 40
INSTANCES = 76
"""A scene; 18 keyframes each give 1.17 million annotations in 850 scenes."""
SEEN = 18
ROWS = {"LIDAR_TOP": 390, "CAM": 230, "RADAR": 260}
"""Files a scene and sensor: 850 * (390 + 6 * 230 + 5 * 260) = 2.6 million."""


@dataclasses.dataclass(frozen=True)
class Args:
    """How large, and where."""

    scenes: int = 850
    """Scenes to generate."""
    folder: Path | None = None
    """For the generated tables, removed at the end; by default that of temporary files."""
    out: Path = Path("outputs/index_scale.json")
    """Where the figures go."""


def token(kind: str, *numbers: int) -> str:
    """32 characters, as real tokens have."""
    return (kind.encode().hex() + "".join(f"{n:06x}" for n in numbers)).ljust(32, "0")[:32]


def write_table(folder: Path, name: str, rows: Iterator[dict[str, Any]]) -> None:
    """One record after the other, one field a line, as the official tables are written."""
    with (folder / f"{name}.json").open("w") as stream:
        between = "[\n"
        for row in rows:
            stream.write(between + json.dumps(row, indent=0))
            between = ",\n"
        stream.write("\n]" if between != "[\n" else "[]")


def sample_data(scenes: int) -> Iterator[dict[str, Any]]:
    """All files of all sensors."""
    for scene in range(scenes):
        for c, channel in enumerate(CHANNELS):
            number = ROWS[channel.split("_")[0] if c else channel]
            for i in range(number):
                key = i % (number // KEYFRAMES) == 0 and i // (number // KEYFRAMES) < KEYFRAMES
                sample = min(i // (number // KEYFRAMES), KEYFRAMES - 1)
                yield {
                    "token": token("d", scene, c, i),
                    "sample_token": token("s", scene, sample),
                    "ego_pose_token": token("d", scene, c, i),
                    "calibrated_sensor_token": token("m", scene, c),
                    "timestamp": 1_500_000_000_000_000 + scene * 100_000_000 + i * 50_000,
                    "fileformat": "pcd",
                    "is_key_frame": key,
                    "height": 0,
                    "width": 0,
                    "filename": f"sweeps/{channel}/n000-2018-01-01-00-00-00-0400__{channel}__{scene:08}{i:08}.bin",
                    "prev": token("d", scene, c, i - 1) if i else "",
                    "next": token("d", scene, c, i + 1) if i + 1 < number else "",
                }


def annotations(scenes: int) -> Iterator[dict[str, Any]]:
    """Boxes of all instances."""
    for scene in range(scenes):
        for k in range(INSTANCES):
            for i in range(SEEN):
                yield {
                    "token": token("a", scene, k, i),
                    "sample_token": token("s", scene, (k + i) % (KEYFRAMES - SEEN) + i),
                    "instance_token": token("i", scene, k),
                    "visibility_token": "4",
                    "attribute_tokens": [],
                    "translation": [373.256 + i, 1130.419 - k, 0.8],
                    "size": [0.621, 0.669, 1.642],
                    "rotation": [0.9831098797903927, 0.0, 0.0, -0.18301629506281616],
                    "prev": token("a", scene, k, i - 1) if i else "",
                    "next": token("a", scene, k, i + 1) if i + 1 < SEEN else "",
                    "num_lidar_pts": 5,
                    "num_radar_pts": 0,
                }


def generate(folder: Path, scenes: int) -> None:
    """The ten tables that the index reads."""
    folder.mkdir(parents=True)
    categories = [*CATEGORY_TO_CLASS, "animal"]
    pose = {"rotation": [0.5720320396729045, -0.0016977771610471074, 0.011798001930183783, -0.8201446642457809]}
    pose |= {"translation": [411.3039349319818, 1180.8903791765097, 0.0]}
    per_scene = range(scenes)
    write_table(folder, "category", ({"token": token("c", i), "name": n} for i, n in enumerate(categories)))
    write_table(folder, "attribute", iter(()))
    write_table(folder, "sensor", ({"token": token("e", i), "channel": c} for i, c in enumerate(CHANNELS)))
    mounts = ((s, c) for s in per_scene for c in range(len(CHANNELS)))
    write_table(
        folder,
        "calibrated_sensor",
        ({"token": token("m", s, c), "sensor_token": token("e", c), **pose} for s, c in mounts),
    )
    write_table(
        folder,
        "scene",
        (
            {"token": token("n", s), "name": f"scene-{s:04d}", "first_sample_token": token("s", s, 0)}
            for s in per_scene
        ),
    )
    write_table(
        folder,
        "sample",
        (
            {
                "token": token("s", s, i),
                "timestamp": 1_500_000_000_000_000 + s * 100_000_000 + i * 500_000,
                "scene_token": token("n", s),
                "next": token("s", s, i + 1) if i + 1 < KEYFRAMES else "",
            }
            for s in per_scene
            for i in range(KEYFRAMES)
        ),
    )
    write_table(
        folder,
        "instance",
        (
            {"token": token("i", s, k), "category_token": token("c", k % len(categories))}
            for s in per_scene
            for k in range(INSTANCES)
        ),
    )
    write_table(folder, "sample_data", sample_data(scenes))
    write_table(folder, "ego_pose", ({"token": r["token"], "timestamp": 0, **pose} for r in sample_data(scenes)))
    write_table(folder, "sample_annotation", annotations(scenes))


def build(tables: Path, folder: Path) -> dict[str, int]:
    """Build and save."""
    index = build_index(tables)
    save_index(index, folder, tables=tables)
    return {
        "scenes": len(index.scene_name),
        "keyframes": len(index.sample_token),
        "sweeps": len(index.sweep_file),
        "annotations": len(index.box_token),
    }


def reopen(tables: Path, folder: Path) -> dict[str, int]:
    """Open, all checks included."""
    return {"annotations": len(open_index(folder, tables=tables).box_token)}


def _child(work: Callable[..., dict[str, int]], pipe: Any, *args: Path) -> None:
    started = time.monotonic()
    counts = work(*args)
    seconds = time.monotonic() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    pipe.send({**counts, "seconds": round(seconds, 2), "peak_gib": round(peak, 2)})


def measured(work: Callable[..., dict[str, int]], *args: Path) -> dict[str, Any]:
    """What a function returns in a process of its own, with its time and the peak of its memory."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_child, args=(work, theirs, *args))
    process.start()
    result = ours.recv()
    process.join()
    return result


def main(args: Args) -> None:
    """Generate, measure, print, remove."""
    with tempfile.TemporaryDirectory(dir=args.folder) as work:
        root = Path(work)
        tables, folder = root / "v1.0-trainval", root / "index"
        print(f"generating tables of {args.scenes} scenes in {tables}", flush=True)
        generate(tables, args.scenes)
        sizes = {file.stem: file.stat().st_size for file in sorted(tables.iterdir())}
        result = {
            "tables_gib": round(sum(sizes.values()) / 2**30, 2),
            "build": measured(build, tables, folder),
            "index_mib": round(sum(f.stat().st_size for f in folder.iterdir()) / 2**20, 1),
            "open": measured(reopen, tables, folder),
        }
    save(result, args.out)


if __name__ == "__main__":
    run_script(main, Args, __doc__)

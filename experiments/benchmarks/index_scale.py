"""What does the index of a full-size nuScenes cost: time, memory, and the time to open it again?

    python -m experiments.benchmarks.index_scale

Generates tables of the size of ``v1.0-trainval`` (850 scenes, 34,000 keyframes, 2.6 million rows of sample_data
and of ego_pose, 1.17 million annotations; no point files), builds, saves and opens the index in processes of
their own, and prints times and peak memory. Cost: two to three minutes and 3 GB of temporary files.
"""

import dataclasses
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from experiments.benchmarks.made_tables import write_tables
from experiments.script import Options, run_measurement
from fcos_lidar_jax.data.nuscenes.build import build_index
from fcos_lidar_jax.data.nuscenes.index import open_index, save_index

FILES = {"LIDAR_TOP": 10, **{f"CAM_{i}": 6 for i in range(6)}, **{f"RADAR_{i}": 6 for i in range(5)}}
"""Of a keyframe: 34,000 * (10 + 6 * 6 + 5 * 6) = 2.6 million."""
KEYFRAMES, OBJECTS, SEEN = 40, 76, 18
"""Of a scene; 18 keyframes an object give 1.17 million annotations in 850 scenes."""


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """How large."""

    scenes: int = 850  # Scenes to generate.


def _build(tables: Path, folder: Path) -> dict[str, int]:
    index = build_index(tables)
    save_index(index, folder, tables=tables)
    found = {"scenes": len(index.scene_name), "keyframes": len(index.sample_token)}
    return {**found, "sweeps": len(index.sweep_file), "annotations": len(index.box_token)}


def _reopen(tables: Path, folder: Path) -> dict[str, int]:
    return {"annotations": len(open_index(folder, tables=tables).box_token)}


def _timed(work: Callable[..., dict[str, int]], *args: Path) -> dict[str, Any]:
    started = time.monotonic()
    counts, seconds = work(*args), time.monotonic() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {**counts, "seconds": round(seconds, 2), "peak_gib": round(peak, 2)}


def measured(work: Callable[..., dict[str, int]], *args: Path) -> dict[str, Any]:
    """What a function returns in a process of its own, with its time and the peak of its memory."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_timed, work, *args).result()


def measure(args: Args) -> dict[str, Any]:
    """Generate and time."""
    with tempfile.TemporaryDirectory() as work:
        tables, folder = Path(work, "v1.0-trainval"), Path(work, "index")
        print(f"generating tables of {args.scenes} scenes in {tables}", flush=True)
        scenes = {f"scene-{i:04d}": KEYFRAMES for i in range(args.scenes)}
        write_tables(tables, scenes, FILES, objects=OBJECTS, seen=SEEN)
        return {
            "tables_gib": round(sum(f.stat().st_size for f in tables.iterdir()) / 2**30, 2),
            "build": measured(_build, tables, folder),
            "index_mib": round(sum(f.stat().st_size for f in folder.iterdir()) / 2**20, 1),
            "open": measured(_reopen, tables, folder),
        }


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

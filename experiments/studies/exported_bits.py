"""Does an exported file find the boxes of its checkpoint elsewhere, bit for bit?

    python -m experiments.studies.exported_bits --out experiments/results/exported_bits.json

Makes a virtual environment with jax and flatbuffers alone, exports the shipped weights and the paper's preset with
random ones, runs the files there on simulated clouds, and compares the bits of all that is found with those of
``load_detector`` here. Says also whether another process exports the same bytes, whether a path of this machine
stands in a file, and what becomes of damaged and foreign ones. Cost: a minute for the environment, and the clouds
of the full size, some seconds each on two CPU cores, twice. Expected: no cloud that differs, no path.
"""

import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jaxlib
import numpy as np

from experiments.changes import change
from experiments.script import Options, run_measurement
from fcos_lidar_jax.checkpoints import Checkpoint, CheckpointError, save_checkpoint
from fcos_lidar_jax.inference import load_detector, load_trained
from fcos_lidar_jax.inference.export import export_detector
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.simulation.frames import make_frame

PAPER = "nuscenes, random weights"
_TRACES = (str(Path.cwd()), sys.prefix, str(Path.home()), "site-packages", ".py")
_ELSEWHERE = """
import importlib.util, json, sys
import jax, numpy as np
from jax import export

assert importlib.util.find_spec("fcos_lidar_jax") is None
file, clouds, out = sys.argv[1:]
with open(file, "rb") as stream:
    stream.readline()
    record = json.loads(stream.readline())
    program = jax.jit(export.deserialize(bytearray(stream.read())).call)
found = {}
with np.load(clouds) as given:
    for number in given:
        points = np.zeros((1, record["num_points"], record["num_columns"]), np.float32)
        points[0, : len(given[number])] = given[number]
        valid = np.arange(points.shape[1])[None] < len(given[number])
        boxes = jax.device_get(program(points, valid, True))
        found |= {f"{number} {name}": values[0] for name, values in boxes.items()}
np.savez(out, **found)
"""


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Which detectors, and on how many clouds."""

    detectors: tuple[str, ...] = ("quickstart", "hdl32e", PAPER)
    """Checkpoints, runs, shipped weights, or the paper's preset with random weights."""
    clouds: int = 50  # Simulated ones, for each detector.


def new_environment(folder: Path) -> Path:
    """The interpreter of a new environment with this version of jax, and flatbuffers."""
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    wanted = [f"jax=={jax.__version__}", f"jaxlib=={jaxlib.__version__}", "flatbuffers"]
    install = [python, "-m", "pip", "install", "-q", "--disable-pip-version-check", *wanted]
    subprocess.run(install, check=True, stdout=sys.stderr)
    return python


def paper_checkpoint(folder: Path) -> Path:
    """The paper's preset with random weights, and a prior with which they propose boxes everywhere."""
    config = change(model__background_prior=0.5)(NUSCENES)
    sensor = load_sensor(config.sensor)
    variables = jax.jit(build_detector(config, sensor).init)(jax.random.key(0))
    save_checkpoint(folder, Checkpoint(config, sensor, variables, 0))
    return folder


def some_clouds(number: int, sensor: Sensor) -> list[np.ndarray]:
    """Simulated ones, with rows that must not take part."""
    clouds = [make_frame(seed, sensor).points for seed in range(number)]
    for cloud in clouds:
        cloud[5:8, :2] = sensor.origin_m[:2]
        cloud[11, 1], cloud[12, 3] = np.nan, 1e30
    return clouds


def refusals(content: bytes, folder: Path) -> dict[str, str]:
    """What is said of files that are not as they were written."""
    middle = len(content) // 2
    damaged = {
        "flipped bit": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
        "cut": content[:-1000],
        "foreign": b"PK\x03\x04" + content,
    }
    found = {}
    for name, bad in damaged.items():
        (folder / "bad.fcos").write_bytes(bad)
        try:
            load_detector(folder / "bad.fcos")
            found[name] = "accepted"
        except CheckpointError as error:
            found[name] = str(error).removeprefix(f"{folder}/")
    return found


def compare(checkpoint: Path, python: Path, folder: Path, number: int) -> dict[str, Any]:
    """One detector, here and elsewhere."""
    file, clouds, out = folder / "detector.fcos", folder / "clouds.npz", folder / "found.npz"
    command = ["-m", "fcos_lidar_jax", "export", "--checkpoint", checkpoint, "--out", file]
    subprocess.run([sys.executable, *command], check=True, stdout=sys.stderr)
    content = file.read_bytes()
    detector = load_trained(checkpoint)
    same_bytes = export_detector(detector) == content
    given = some_clouds(number, detector.sensor)
    np.savez(clouds, *given)
    began = time.perf_counter()
    # Isolated: neither this folder nor the variables of the environment bring the package along.
    subprocess.run([python, "-I", "-c", _ELSEWHERE, file, clouds, out], check=True, cwd=folder)
    seconds = time.perf_counter() - began
    differ, boxes = 0, 0
    with np.load(out) as elsewhere:
        for index, cloud in enumerate(given):
            here = vars(detector(cloud))
            boxes += int(here["valid"].sum())
            differ += any(here[name].tobytes() != elsewhere[f"arr_{index} {name}"].tobytes() for name in here)
    return {
        "clouds": number,
        "boxes": boxes,
        "clouds_that_differ": differ,
        "bytes": len(content),
        "same_bytes_twice": same_bytes,
        "local_paths": [trace for trace in (*_TRACES, str(folder)) if trace.encode() in content],
        "seconds_elsewhere": round(seconds, 1),
        "refusals": refusals(content, folder),
    }


def measure(args: Args) -> dict[str, Any]:
    """All detectors."""
    record: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        python = new_environment(folder / "environment")
        listed = [python, "-m", "pip", "list", "--format", "json", "--disable-pip-version-check"]
        packages = json.loads(subprocess.run(listed, check=True, capture_output=True).stdout)
        record["packages"] = {package["name"]: package["version"] for package in packages}
        for each in args.detectors:
            checkpoint = paper_checkpoint(folder / "paper") if each == PAPER else Path(each)
            record[each] = compare(checkpoint, python, folder, args.clouds)
    return record


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

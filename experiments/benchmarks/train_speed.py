"""Time of a training step compared with PyTorch's forward and backward pass on the same CPU.

    python -m experiments.benchmarks.train_speed --torch-python PYTHON  # an interpreter that has torch

Ours is the whole step: augmentation, projection, network, assignment, losses, gradients, AdamW. The peer's is
only the network with a plain loss (``torch_net.py``). Both run in turns with batch size 1 in float32: ``slim``
(32x1088, one round, 0.9 M parameters) and ``full`` (64x1088, five rounds, the paper's channels). Cost: a quarter
of an hour on two CPU cores and 12 GB. Expected: at most 1.4 of the peer's time when slim, 1.25 at full size.
"""

import dataclasses
import json
import os
import statistics
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax

from experiments.changes import change
from experiments.runs import training_steps
from experiments.script import Options, run_measurement
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.inference.timing import Call
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.input_pipeline.database import cut_reading
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, Sensor
from fcos_lidar_jax.simulation.frames import make_frame

Size = Literal["slim", "full"]
Function = Literal["forward", "train"]
PEER = Path(__file__).with_name("torch_net.py")
_PEER_LOOP = """
import os, runpy, sys, time
real = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
sys.path.insert(0, os.path.dirname(sys.argv[1]))
run = runpy.run_path(sys.argv[1])["FNS"][sys.argv[2]]
run()
print("ready", file=real, flush=True)
for _ in sys.stdin:
    began = time.perf_counter()
    run()
    print(time.perf_counter() - began, file=real, flush=True)
"""


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Options of the comparison."""

    torch_python: Path  # Interpreter that has torch.
    sizes: tuple[Size, ...] = ("slim", "full")  # Which to compare.
    repeats: int = 15  # Turns.


_FULL = {"HEIGHT": 64, "ROUNDS": 5, "TYPE": 32, "STEM": 64, "WIDTHS": "64,128,128,128", "HEAD": 64, "PYRAMID": 256}
_SLIM = {"HEIGHT": 32, "ROUNDS": 1, "TYPE": 4, "STEM": 16, "WIDTHS": "16,32,32,32", "HEAD": 32, "PYRAMID": 32}
_SIZES: dict[Size, dict[str, Any]] = {"slim": _SLIM, "full": _FULL}


def of_size(size: dict[str, Any]) -> Config:
    """Configure the paper's detector for one sweep with given sizes."""
    return change(
        num_sweeps=1,
        max_points=40_000,
        projection__num_rounds=size["ROUNDS"],
        model__row_upscale=size["HEIGHT"] // NUSCENES_HDL32E.num_rows,
        model__stem__channels_per_type=size["TYPE"],
        model__stem__out_channels=size["STEM"],
        model__backbone_widths=tuple(map(int, size["WIDTHS"].split(","))),
        model__fpn_channels=size["PYRAMID"],
        model__head_channels=size["HEAD"],
    )(NUSCENES)


def turn_by_turn(
    ours: Call, repeats: int, *, environment: Mapping[str, object], python: Path, function: Function
) -> dict[str, float]:
    """Time our call and a peer's function in turns, because the speed of a machine drifts.

    The peer runs in a separate process with its own interpreter and environment.

    Returns:
        medians in seconds after one run of each, and their ratio.
    """
    variables = {**os.environ, **{key: str(value) for key, value in environment.items()}}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    times: dict[str, list[float]] = {"ours": [], "peer": []}
    with subprocess.Popen(
        [python, "-c", _PEER_LOOP, PEER, function], env=variables, bufsize=1, **pipes
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        if process.stdout.readline() != "ready\n":
            raise ValueError(f"--torch-python: {python}: {PEER.name} does not run there")
        jax.block_until_ready(ours())
        for _ in range(repeats):
            began = time.perf_counter()
            jax.block_until_ready(ours())
            times["ours"].append(time.perf_counter() - began)
            process.stdin.write("go\n")
            times["peer"].append(float(process.stdout.readline()))
    medians = {name: round(statistics.median(values), 4) for name, values in times.items()}
    return {**medians, "ratio": round(medians["ours"] / medians["peer"], 3), "repeats": repeats}


def forward_pass(config: Config, sensor: Sensor, frames: Sequence[Frame]) -> Call:
    """Make a call of the network, with random weights, on the range images of a batch of frames."""
    detector = build_detector(config, sensor)
    variables = jax.jit(detector.init)(jax.random.key(0))
    batch = make_batch(frames, max_points=config.max_points, max_boxes=config.max_boxes)
    images = jax.jit(jax.vmap(detector.prepare))(batch.points, batch.valid)
    network = jax.jit(lambda variables, images: detector.apply(variables, images)[0])
    return lambda: network(variables, images)


def compare(
    name: Size,
    repeats: int,
    *,
    python: Path,
    function: Function = "train",
    batch: int = 1,
    precision: Literal["float32", "bfloat16"] = "float32",
    **options: object,
) -> dict[str, float]:
    """Compare our training step, or our forward pass, with a peer's; options are of its environment."""
    size, sensor = _SIZES[name], NUSCENES_HDL32E
    config = change(model__precision=precision)(of_size(size))
    frames = [make_frame(0, sensor, num_objects=30, reading=cut_reading(1))] * batch
    ours = (training_steps if function == "train" else forward_pass)(config, sensor, frames)
    environment = {**size, "BATCH": batch, **options}
    return turn_by_turn(ours, repeats, environment=environment, python=python, function=function)


def measure(args: Args) -> dict[str, Any]:
    """Compare at the selected sizes."""
    record: dict[str, Any] = {"peer": PEER.name}
    for name in args.sizes:
        record[name] = compare(name, args.repeats, python=args.torch_python)
        print(f"{name}: {json.dumps(record[name])}", flush=True)
    return record


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

"""What does each number of the preset ``compact`` cost?

    python -m experiments.benchmarks.preset_cost
    python -m experiments.benchmarks.preset_cost --training

One simulated sweep of nuScenes' sensor, from its file to boxes: reading, padding, projection, network, decoding,
NMS, with random weights. The preset, the quickstart's network at the same image size, and the preset with one
choice changed run turn by turn. Figures are medians of the process's seconds on all cores, since machines are
shared, and of the clock's; with ``--training`` those of a training step of one sample as well. Cost: three minutes
on two CPU cores, fifteen with ``--training``.
"""

import dataclasses
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import jax

from experiments.benchmarks.training_steps import training_steps
from experiments.changes import Change, change
from experiments.script import Options, run_measurement
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.point_files import read_points
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.inference.timing import Call
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.models.detector import count_parameters
from fcos_lidar_jax.presets import COMPACT, QUICKSTART
from fcos_lidar_jax.sensors import NUSCENES_HDL32E as SENSOR
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.types import Detections

CHANGES: dict[str, Change] = {
    "compact": change(),
    "quickstart's network": change(model=dataclasses.replace(QUICKSTART.model, circular_width=True)),
    "rows doubled, as in the paper": change(model__row_upscale=2),
    "stem of 8 channels a type": change(model__stem__channels_per_type=8, model__stem__out_channels=32),
    "dilations 1, 3, 6, as in the paper": change(model__stem__dilations=(1, 3, 6)),
    "wider first stage": change(model__backbone_widths=(32, 48, 64, 64)),
    "wider later stages": change(model__backbone_widths=(16, 64, 96, 96)),
    "fewer blocks": change(model__backbone_blocks=(2, 2, 1, 1)),
    "pyramid of 32": change(model__fpn_channels=32),
    "heads of 48": change(model__head_channels=48),
    "heads of 4 convolutions, as in the paper": change(model__head_convs=4),
    "tied heads": change(model__tied_heads=True),
}
"""Name -> change of the preset."""


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """What to time, and how often."""

    only: tuple[str, ...] = ()  # Of the variants, by name; default: all.
    training: bool = False  # Training steps as well.
    repeats: int = 15  # Turns.


def from_file(config: Config, file: Path) -> Call:
    """The way from a point file to boxes, with random weights."""
    model = build_detector(config, SENSOR)
    detect, variables = jax.jit(make_detect(model)), model.init(jax.random.key(0))

    def once() -> Detections:
        cloud = make_cloud(read_points(file, SENSOR), config, sensor=SENSOR)
        return jax.device_get(detect(variables, cloud.points, cloud.valid))

    return once


def seconds(calls: dict[str, Call], repeats: int) -> dict[str, dict[str, float]]:
    """Median seconds of the process and of the clock, of calls that take turns, after one each that compiles."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for turn in range(repeats + 1):
        for name, call in calls.items():
            process, clock = time.process_time(), time.perf_counter()
            jax.block_until_ready(call())
            if turn:
                found[name].append((time.process_time() - process, time.perf_counter() - clock))
    medians = {name: [statistics.median(s) for s in zip(*times, strict=True)] for name, times in found.items()}
    return {name: {"process_s": round(p, 3), "clock_s": round(c, 3)} for name, (p, c) in medians.items()}


def measure(args: Args) -> dict[str, Any]:
    """Parameters and seconds of every variant."""
    if unknown := [name for name in args.only if name not in CHANGES]:
        raise ValueError(f"--only: got {unknown[0]!r}, expected one of {', '.join(CHANGES)}")
    chosen = args.only or CHANGES
    configs = {name: dataclasses.replace(CHANGES[name](COMPACT), name=COMPACT.name) for name in chosen}
    frame = make_frame(0, SENSOR, num_objects=40, reach_m=45.0)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "sweep.pcd.bin")
        file.write_bytes(frame.points.tobytes())
        found = seconds({name: from_file(config, file) for name, config in configs.items()}, args.repeats)
    record: dict[str, Any] = {"points": len(frame.points), "repeats": args.repeats}
    for name, config in configs.items():
        shapes = jax.eval_shape(build_detector(config, SENSOR).init, jax.random.key(0))
        record[name] = {"parameters": count_parameters(shapes["params"])["total"], "file to boxes": found[name]}
    if args.training:
        steps = {name: _step(config, frame) for name, config in configs.items()}
        for name, figures in seconds(steps, args.repeats).items():
            record[name]["training step"] = figures
    return record


def _step(config: Config, frame: Frame) -> Call:
    one = change(optimizer__batch_size=1)(config)
    return training_steps(one, SENSOR, [frame])


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

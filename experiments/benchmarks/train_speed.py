"""How long does a training step take beside PyTorch's forward and backward pass on the same CPU?

    python -m experiments.benchmarks.train_speed --torch-python PYTHON  # an interpreter that has torch
    python -m experiments.benchmarks.train_speed --torch-python PYTHON --peer FILE

Ours is the whole step: augmentation, projection, network, assignment, losses, gradients, AdamW. The peer's is the
network alone with a plain loss (``torch_net.py``, or any file with ``FNS["train"]``). Both run turn by turn, batch
1, float32, at full size (64x1088) and at a reduced one (32x288, a quarter of the channels). Cost: about ten
minutes on two CPU cores and 12 GB. Expected: at most 1.75 of the peer's time at full size, 2 at the reduced one.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

from experiments.benchmarks.peers import turn_by_turn
from experiments.benchmarks.stages import training_steps
from experiments.changes import change
from experiments.script import Options, run_measurement
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import without_close
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, Sensor
from fcos_lidar_jax.simulation.frames import make_frame

_PEER = Path(__file__).with_name("torch_net.py")


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Whom to run against, and how often."""

    torch_python: Path  # Interpreter that has torch.
    peer: Path = _PEER  # Program with FNS["train"].
    fpn: tuple[int, ...] = (64, 256)  # Channels of the pyramid at full size, a comparison each.
    repeats: int = 5  # Turns at full size; ten times as many at the reduced size.


def of_size(over: int, fpn: int) -> tuple[Config, Sensor]:
    """The paper's detector on one sweep, full size, or 32x288 with channels divided by ``over``."""
    model, stem = NUSCENES.model, NUSCENES.model.stem
    config = change(
        num_sweeps=1,
        max_points=40_000,
        model__row_upscale=2 if over == 1 else 1,
        model__stem__channels_per_type=stem.channels_per_type // over,
        model__stem__out_channels=stem.out_channels // over,
        model__backbone_widths=tuple(w // over for w in model.backbone_widths),
        model__fpn_channels=fpn // over,
        model__head_channels=model.head_channels // over,
    )(NUSCENES)
    return config, dataclasses.replace(NUSCENES_HDL32E, num_columns={1: 1086, 4: 288}[over])


def measure(args: Args) -> dict[str, Any]:
    """Compare at all sizes."""
    record: dict[str, Any] = {"peer": args.peer.name}
    for over, fpn in [(4, args.fpn[0]), *((1, fpn) for fpn in args.fpn)]:
        config, sensor = of_size(over, fpn)
        height, width = (64, 1088) if over == 1 else (32, 288)
        sizes = {"HEIGHT": height, "WIDTH": width, "WIDTHS_OVER": over, "FPN": fpn}
        sizes |= {"NH": height, "NW": width, "Q": over, "TRAIN": 1, "CL": 1}  # what other peers call them
        step = training_steps(config, sensor, [without_close(make_frame(0, sensor, num_objects=30), sensor)])
        repeats = args.repeats * (1 if over == 1 else 10)
        peer = {"peer": args.peer, "name": "train", "environment": sizes, "python": args.torch_python}
        figures = turn_by_turn(step, repeats, **peer)
        name = f"{height}x{width}, channels / {over}, pyramid {fpn // over}"
        record[name] = figures
        print(f"{name}: {json.dumps(figures)}", flush=True)
    return record


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

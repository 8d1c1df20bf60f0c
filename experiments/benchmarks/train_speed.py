"""How long does a training step take beside PyTorch's forward and backward pass on the same CPU?

    python -m experiments.benchmarks.train_speed --torch-python PYTHON  # an interpreter that has torch
    python -m experiments.benchmarks.train_speed --torch-python PYTHON --peer FILE

Ours is the whole step: augmentation, projection, network, assignment, losses, gradients, AdamW. The peer's is the
network alone with a plain loss (``torch_net.py``, or any file with ``FNS["train"]``). Both run turn by turn, batch
1, float32, at full size (64x1088) and at a reduced one (32x288, a quarter of the channels).

Cost: about ten minutes on two CPU cores and 12 GB. Expected: at most 1.75 of the peer's time at full size, 2 at
the reduced one.
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from experiments.benchmarks.peers import Peer, turn_by_turn
from experiments.script import run_script, save
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import without_close
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, Sensor
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step

_PEER = Path(__file__).with_name("torch_net.py")


@dataclasses.dataclass(frozen=True)
class Args:
    """Whom to run against, and how often."""

    torch_python: Path
    """Interpreter that has torch."""
    peer: Path = _PEER
    """Program with FNS["train"]."""
    fpn: tuple[int, ...] = (64, 256)
    """Channels of the pyramid at full size, a comparison each."""
    repeats: int = 5
    """Turns at full size; ten times as many at the reduced size."""
    out: Path = Path("outputs/train_speed.json")
    """Where the figures go."""


def of_size(over: int, fpn: int) -> tuple[Config, Sensor]:
    """The paper's detector on one sweep, full size, or 32x288 with channels divided by ``over``."""
    model, stem = NUSCENES.model, NUSCENES.model.stem
    width = {1: 1086, 4: 288}[over]
    model = dataclasses.replace(
        model,
        row_upscale=2 if over == 1 else 1,
        stem=dataclasses.replace(
            stem, channels_per_type=stem.channels_per_type // over, out_channels=stem.out_channels // over
        ),
        backbone_widths=tuple(w // over for w in model.backbone_widths),  # type: ignore[arg-type]
        fpn_channels=fpn // over,
        head_channels=model.head_channels // over,
    )
    sensor = dataclasses.replace(NUSCENES_HDL32E, num_columns=width)
    return dataclasses.replace(NUSCENES, model=model, num_sweeps=1, max_points=40_000), sensor


def step_of(config: Config, sensor: Sensor) -> Callable[[], Any]:
    """Training steps, one a call."""
    detector = build_detector(config, sensor)
    optimizer = make_optimizer(config.optimizer, 1000)
    step = jax.jit(make_train_step(detector, optimizer), donate_argnums=0)
    state = make_state(detector, optimizer, jax.random.key(1))
    frame = without_close(make_frame(0, sensor, num_objects=30), sensor)
    batch = jax.device_put(make_batch([frame], max_points=config.max_points, max_boxes=config.max_boxes))

    def once() -> Any:
        nonlocal state
        state, metrics = step(state, batch)
        return metrics["loss/total"]

    return once


def main(args: Args) -> None:
    """Measure, print, write."""
    record: dict[str, Any] = {"peer": args.peer.name}
    for over, fpn in [(4, args.fpn[0]), *((1, fpn) for fpn in args.fpn)]:
        config, sensor = of_size(over, fpn)
        height, width = (64, 1088) if over == 1 else (32, 288)
        sizes = {"HEIGHT": height, "WIDTH": width, "WIDTHS_OVER": over, "FPN": fpn}
        sizes |= {"NH": height, "NW": width, "Q": over, "TRAIN": 1, "CL": 1}  # what other peers call them
        environment = {name: str(value) for name, value in sizes.items()}
        with Peer(args.peer, "train", environment, args.torch_python) as peer:
            figures = turn_by_turn(step_of(config, sensor), peer, args.repeats * (1 if over == 1 else 10))
        record[f"{height}x{width}, channels / {over}, pyramid {fpn // over}"] = figures
        print(height, width, f"channels / {over}, pyramid {fpn // over}:", json.dumps(figures), flush=True)
    save(record, args.out)


if __name__ == "__main__":
    run_script(main, Args, __doc__)

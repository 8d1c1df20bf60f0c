"""What the paper's preset costs here: parameters, memory, the time of every stage, and of one training step.

    python -m experiments.benchmarks.full_size --data FOLDER  # on the real keyframe of scene-0061
    python -m experiments.benchmarks.full_size  # on a simulated frame
    python -m experiments.benchmarks.full_size --peer net_jax.py  # the forward pass against another program too

Of a peer (see ``peers.py``), ``fwd`` is timed; it is told the channels of the pyramid by the variable ``FPN``.

Cost: about five minutes on two CPU cores and 10 GB. Expected: 10.66 M parameters; the network is 99 % of the path.
"""

import dataclasses
import json
import resource
import time
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.peers import Peer, turn_by_turn
from experiments.benchmarks.stages import make_stages
from experiments.script import real_data, run_script, save
from experiments.statistics import Call, interleaved
from fcos_lidar_jax.data.frame import without_close
from fcos_lidar_jax.data.keyframe import read_keyframe
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.presets import PRESETS
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, load_sensor
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step
from fcos_lidar_jax.training.objective import sample_losses


@dataclasses.dataclass(frozen=True)
class Args:
    """What to measure."""

    preset: Literal["nuscenes", "nuscenes_single", "quickstart"] = "nuscenes"
    """Configuration preset."""
    data: Path | None = None
    """Folder with nuscenes_scene0061/; default: the environment's FCOS_LIDAR_REAL_DATA, else a simulated frame."""
    repeats: int = 15
    """Turns, of which the median counts."""
    peer: Path | None = None
    """Program to time the forward pass against, turn by turn."""
    out: Path = Path("outputs/full_size.json")
    """Where the figures go."""


def measure(args: Args) -> dict[str, Any]:
    """All figures of the preset on one frame."""
    config = PRESETS[args.preset]
    sensor = load_sensor(config.sensor)
    layout = image_layout(sensor, config.model)
    folder = real_data(args.data, "nuscenes_scene0061") if sensor == NUSCENES_HDL32E else None
    frame = read_keyframe(folder, sensor) if folder else make_frame(0, sensor)
    frame = without_close(frame, sensor)
    batch = jax.tree.map(
        jnp.asarray, make_batch([frame], max_points=config.max_points, max_boxes=config.max_boxes)
    )
    detector = build_detector(config, sensor)
    variables = detector.init(jax.random.key(0))
    record: dict[str, Any] = {
        "preset": config.name,
        "frame": "scene-0061, real" if folder else "simulated",
        "parameters": count_parameters(variables["params"]),
        "locations": layout.num_locations,
        "boxes": len(frame.boxes),
    }
    print(json.dumps(record), flush=True)

    stages = make_stages(config, sensor)
    image = stages.project(batch.points[0], batch.valid[0])
    seen = stages.preprocess(image.features[None])
    after_stem = stages.stem(variables, seen)
    levels = stages.backbone(variables, after_stem)
    pyramid = stages.fpn(variables, levels)
    outputs = jax.tree.map(lambda leaf: leaf[0], stages.heads(variables, pyramid))
    boxes, labels, box_valid = batch.boxes[0], batch.labels[0], batch.box_valid[0]

    def objective(outputs: Any, image: Any) -> Any:
        return sample_losses(outputs, image, boxes, labels, box_valid, config=config.loss, layout=layout)

    losses, assignment = (jax.jit(lambda o, i, part=part: objective(o, i)[part]) for part in (0, 1))
    # A trained detector is sure of little: as many candidates as the threshold lets through is the worst case.
    eager = dataclasses.replace(outputs, logits=outputs.logits.at[:, -1].add(-4.0))
    detect = jax.jit(make_detect(detector))
    forward = jax.jit(lambda v, f: detector.apply(v, f, train=False)[0])
    calls: dict[str, Call] = {
        "mrv": lambda: stages.project(batch.points[0], batch.valid[0]),
        "stem": lambda: stages.stem(variables, seen),
        "backbone": lambda: stages.backbone(variables, after_stem),
        "fpn": lambda: stages.fpn(variables, levels),
        "heads": lambda: stages.heads(variables, pyramid),
        "assignment": lambda: assignment(outputs, image),
        "assignment and losses": lambda: losses(outputs, image),
        "candidates and nms": lambda: stages.postprocess(eager, image),
        "forward": lambda: forward(variables, image.features[None]),
        "points to boxes": lambda: detect(variables, batch.points[0], batch.valid[0]),
    }
    times = interleaved(calls, args.repeats)
    record["milliseconds"] = {name: times[name]["median_ms"] for name in calls}
    if args.peer is not None:
        with Peer(args.peer, "fwd", {"FPN": str(config.model.fpn_channels)}) as peer:
            record["forward_against_peer_s"] = turn_by_turn(calls["forward"], peer, args.repeats)
        print(json.dumps(record["forward_against_peer_s"]), flush=True)

    key = jax.random.key(0)
    optimizer = make_optimizer(config.optimizer, 100)
    step = jax.jit(make_train_step(detector, optimizer), donate_argnums=0)
    state, metrics = jax.block_until_ready(step(make_state(detector, optimizer, key, variables=variables), batch))
    began = time.perf_counter()
    state, metrics = jax.block_until_ready(step(state, batch))
    record["milliseconds"]["train step"] = round(1e3 * (time.perf_counter() - began), 1)
    record["train_metrics"] = {name: np.asarray(value).tolist() for name, value in metrics.items()}
    record["peak_memory_gib"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2)
    return record


def main(args: Args) -> None:
    """Measure, print, write."""
    save(measure(args), args.out)


if __name__ == "__main__":
    run_script(main, Args, __doc__)

"""What the paper's preset costs here: parameters, memory, the time of every stage, and of one training step.

    python experiments/full_size.py --data FOLDER                 # on the real keyframe of scene-0061
    python experiments/full_size.py                               # on a simulated frame
    python experiments/full_size.py --peer net_jax.py             # also the forward pass against another program

Of a peer (see ``peers.py``), ``fwd`` is timed; it is told the channels of the pyramid by the variable ``FPN``.

Cost: about five minutes on two CPU cores and 10 GB. Expected: 10.66 M parameters; the network is 99 % of the path.
"""

import dataclasses
import json
import os
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from hardware import hardware
from peers import Peer, turn_by_turn

from fcos_lidar_jax.assignment import assign
from fcos_lidar_jax.coding import decode_oriented
from fcos_lidar_jax.config import PRESETS, Config
from fcos_lidar_jax.data.batching import make_batch
from fcos_lidar_jax.data.frame import without_close
from fcos_lidar_jax.data.keyframe import read_keyframe
from fcos_lidar_jax.data.synthetic.frames import make_frame
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.inference import make_detect, postprocess
from fcos_lidar_jax.iou import oriented, oriented_iou_3d
from fcos_lidar_jax.locations import image_layout, image_sensor, look
from fcos_lidar_jax.losses import cross_entropy
from fcos_lidar_jax.models import Variables, build_detector, count_parameters
from fcos_lidar_jax.models.detector import network_input
from fcos_lidar_jax.models.fpn import FeaturePyramid
from fcos_lidar_jax.models.heads import Heads
from fcos_lidar_jax.models.lidar_net import Backbone
from fcos_lidar_jax.models.modality import Stem
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step
from fcos_lidar_jax.training.objective import location_owners, sample_losses


@dataclasses.dataclass(frozen=True)
class Args:
    """What to measure."""

    preset: str = "nuscenes"
    """Configuration preset."""
    data: Path | None = None
    """Folder with nuscenes_scene0061/; default: the environment's FCOS_LIDAR_REAL_DATA, else a simulated frame."""
    repeats: int = 15
    """Runs of every stage, of which the median counts."""
    peer: Path | None = None
    """Program to time the forward pass against, turn by turn."""
    out: Path = Path("outputs/full_size.json")
    """Where the figures go."""


@dataclasses.dataclass(frozen=True)
class Stages:
    """The parts of the detector as jitted functions; those of the network take all its variables."""

    project: Callable[..., Any]
    """Points and their validity to a range image."""
    door: Callable[..., Any]
    """Features f32[b, h, w, 9, r] to the network's input."""
    stem: Callable[..., Any]
    backbone: Callable[..., Any]
    fpn: Callable[..., Any]
    heads: Callable[..., Any]
    finish: Callable[..., Any]
    """Outputs of one sample and its range image to boxes."""


def make_stages(config: Config, sensor: Sensor) -> Stages:
    """The parts of a configuration's detector."""
    model, binned, layout = config.model, image_sensor(sensor, config.model), image_layout(sensor, config.model)
    circular, projection = model.circular_width, config.projection
    rounds, current = projection.num_rounds, projection.prioritize_current
    stem = Stem(model.stem, circular, model.precision)
    backbone = Backbone(model.backbone_blocks, model.backbone_widths, circular)
    fpn = FeaturePyramid(model.fpn_channels, circular)
    heads = Heads(
        model.num_classes,
        model.head_channels,
        model.head_convs,
        model.background_prior,
        model.tied_heads,
        circular,
    )

    def of(part: str, v: Variables) -> Variables:
        return {kind: tree[part] for kind, tree in v.items() if part in tree}

    return Stages(
        project=jax.jit(
            lambda p, valid: project_points(p, valid, binned, num_rounds=rounds, prioritize_current=current)
        ),
        door=jax.jit(lambda features: network_input(features, model, layout)),
        stem=jax.jit(lambda v, x: stem.apply(of("stem", v), x, train=False)),
        backbone=jax.jit(lambda v, x: backbone.apply(of("backbone", v), x, train=False)),
        fpn=jax.jit(lambda v, x: fpn.apply(of("fpn", v), x)),
        heads=jax.jit(lambda v, x: heads.apply(of("heads", v), x)),
        finish=jax.jit(
            lambda outputs, image: postprocess(
                outputs, look(image, layout), config=config.inference, layout=layout
            )
        ),
    )


def timed(function: Callable[[], Any], repeats: int) -> float:
    """Median seconds of a call, after one that compiles."""
    jax.block_until_ready(function())
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def measure(args: Args) -> dict[str, Any]:
    """All figures of the preset on one frame."""
    config = PRESETS[args.preset]
    sensor = load_sensor(config.sensor)
    layout = image_layout(sensor, config.model)
    folder = args.data or os.environ.get("FCOS_LIDAR_REAL_DATA")
    frame = read_keyframe(Path(folder) / "nuscenes_scene0061", sensor) if folder else make_frame(0, sensor)
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
    seen = stages.door(image.features[None])
    after_stem = stages.stem(variables, seen)
    levels = stages.backbone(variables, after_stem)
    pyramid = stages.fpn(variables, levels)
    outputs = jax.tree.map(lambda leaf: leaf[0], stages.heads(variables, pyramid))
    locations = jax.jit(lambda i: look(i, layout))(image)
    boxes, labels, box_valid = batch.boxes[0], batch.labels[0], batch.box_valid[0]

    @jax.jit
    def assignment(outputs: Any, image: Any) -> Any:
        owner = location_owners(image, look(image, layout), boxes, box_valid)
        label = labels[jnp.maximum(owner, 0)]
        numbers = jnp.take_along_axis(outputs.regression, label[:, None, None], axis=2)[..., 0]
        predicted = decode_oriented(numbers, locations.points, locations.azimuth_rad)
        iou = oriented_iou_3d(predicted, oriented(boxes[jnp.maximum(owner, 0)]))
        return assign(
            owner, cross_entropy(outputs.logits, label), iou, num_boxes=config.max_boxes, top_q=config.loss.top_q
        )

    losses = jax.jit(
        lambda o, i: sample_losses(o, i, boxes, labels, box_valid, config=config.loss, layout=layout)[0]
    )
    # A trained detector is sure of little: as many candidates as the threshold lets through is the worst case.
    eager = dataclasses.replace(outputs, logits=outputs.logits.at[:, -1].add(-4.0))
    detect = jax.jit(make_detect(detector, config, sensor))
    forward = jax.jit(lambda v, f: detector.apply(v, f, train=False)[0])
    calls: dict[str, Callable[[], Any]] = {
        "mrv": lambda: stages.project(batch.points[0], batch.valid[0]),
        "stem": lambda: stages.stem(variables, seen),
        "backbone": lambda: stages.backbone(variables, after_stem),
        "fpn": lambda: stages.fpn(variables, levels),
        "heads": lambda: stages.heads(variables, pyramid),
        "assignment": lambda: assignment(outputs, image),
        "assignment and losses": lambda: losses(outputs, image),
        "candidates and nms": lambda: stages.finish(eager, image),
        "forward": lambda: forward(variables, image.features[None]),
        "points to boxes": lambda: detect(variables, batch.points[0], batch.valid[0]),
    }
    record["milliseconds"] = {}
    for name, call in calls.items():
        record["milliseconds"][name] = round(1e3 * timed(call, args.repeats), 2)
        print(f"{name:24s}{record['milliseconds'][name]:10.2f} ms", flush=True)
    if args.peer is not None:
        with Peer(args.peer, "fwd", {"FPN": str(config.model.fpn_channels)}) as peer:
            record["forward_against_peer_s"] = turn_by_turn(calls["forward"], peer, args.repeats)
        print(json.dumps(record["forward_against_peer_s"]), flush=True)

    key = jax.random.key(0)
    optimizer = make_optimizer(config.optimizer, 100)
    step = jax.jit(make_train_step(detector, config, sensor, optimizer), donate_argnums=0)
    state, metrics = jax.block_until_ready(step(make_state(variables, optimizer, key), batch))
    began = time.perf_counter()
    state, metrics = jax.block_until_ready(step(state, batch))
    record["milliseconds"]["train step"] = round(1e3 * (time.perf_counter() - began), 1)
    record["train_metrics"] = {name: np.asarray(value).tolist() for name, value in metrics.items()}
    record["peak_memory_gib"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2)
    print(f"{'train step':24s}{record['milliseconds']['train step']:10.1f} ms", flush=True)
    print(f"peak memory {record['peak_memory_gib']} GiB")
    return record


def main(args: Args) -> None:
    """Measure, print, write."""
    if args.preset not in PRESETS:
        raise SystemExit(f"error: --preset: got {args.preset!r}, expected one of {', '.join(PRESETS)}")
    record = {
        **measure(args),
        **hardware(),
    }
    write_beside(args.out, lambda path: path.write_text(json.dumps(record, indent=1)))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

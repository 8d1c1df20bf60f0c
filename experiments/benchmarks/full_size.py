"""Cost of the paper's preset: parameters, memory, and times of all stages and of one training step.

    python -m experiments.benchmarks.full_size --data FOLDER  # on the real keyframe of scene-0061
    python -m experiments.benchmarks.full_size  # on a simulated frame
    python -m experiments.benchmarks.full_size --memory-only --out experiments/results/training_memory.json

Cost: about five minutes on two CPU cores and 10 GB. Expected: 10.66 M parameters; the network takes 99 % of the
time.
"""

import dataclasses
import functools
import json
import resource
import time
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.training_steps import training_steps
from experiments.script import Options, find_real_data, run_measurement
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import without_close
from fcos_lidar_jax.data.keyframe import read_keyframe
from fcos_lidar_jax.inference import make_detect, make_stages
from fcos_lidar_jax.inference.timing import Call, interleaved
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.input_pipeline.database import cut_reading
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.models.detector import network_parts
from fcos_lidar_jax.models.objective import sample_losses
from fcos_lidar_jax.presets import PRESETS
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, load_sensor
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step
from fcos_lidar_jax.training.objective import make_objective
from fcos_lidar_jax.types import Batch


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Options of the measurement."""

    preset: Literal["nuscenes", "nuscenes_single", "quickstart"] = "nuscenes"  # Configuration preset.
    data: Path | None = None
    """Folder with nuscenes_scene0061/; default: the environment's FCOS_LIDAR_REAL_DATA, else a simulated frame."""
    repeats: int = 15  # Timed calls, for the median.
    memory_only: bool = False
    """Only compute the memory of a training step, without and with ``model.remat``, and run nothing."""


def training_memory(config: Config) -> dict[str, dict[str, float]]:
    """Compute the memory of a training step of one frame, without and with ``model.remat``, in GiB.

    ``kept`` is the memory kept for the backward pass, ``temporary`` the compiled program's in addition to state
    and batch.
    """
    sensor, found = load_sensor(config.sensor), {}
    points, boxes = (1, config.max_points), (1, config.max_boxes)
    shapes = (*points, sensor.point_columns), points, (*boxes, 9), boxes, boxes
    types = jnp.float32, jnp.bool_, jnp.float32, jnp.int32, jnp.bool_
    arrays: list[Any] = list(map(jax.ShapeDtypeStruct, shapes, types))
    batch = Batch(*arrays)
    for remat in (False, True):
        model = dataclasses.replace(config.model, remat=remat)
        detector = build_detector(dataclasses.replace(config, model=model), sensor)
        optimizer, objective = make_optimizer(config.optimizer, 100), make_objective(detector)
        state = jax.eval_shape(functools.partial(make_state, detector, optimizer), jax.random.key(0))

        def pull_back(params: Any, statistics: Any, batch: Batch, objective: Any = objective) -> Any:
            return jax.vjp(lambda params: objective(params, statistics, batch), params, has_aux=True)[1]

        kept = jax.tree.leaves(jax.eval_shape(pull_back, state.params, state.batch_stats, batch))
        step = jax.jit(make_train_step(detector, optimizer), donate_argnums=0)
        memory: Any = step.lower(state, batch).compile().memory_analysis()
        size = sum(leaf.size * leaf.dtype.itemsize for leaf in kept)
        sizes = {"kept": size, "temporary": memory.temp_size_in_bytes}
        found["remat" if remat else "plain"] = {name: round(size / 2**30, 2) for name, size in sizes.items()}
    return found


def measure(args: Args) -> dict[str, Any]:
    """Measure all figures of the preset on one frame."""
    config = PRESETS[args.preset]
    if args.memory_only:
        return {"preset": config.name, "training_gib": training_memory(config)}
    sensor = load_sensor(config.sensor)
    layout = image_layout(sensor, config.model)
    folder = find_real_data(args.data, "nuscenes_scene0061") if sensor == NUSCENES_HDL32E else None
    frame = read_keyframe(folder, sensor) if folder else make_frame(0, sensor)
    frame = without_close(frame, sensor, cut_reading(1))
    batch = jax.device_put(make_batch([frame], max_points=config.max_points, max_boxes=config.max_boxes))
    detector = build_detector(config, sensor)
    variables = detector.init(jax.random.key(0))
    record: dict[str, Any] = {"preset": config.name, "frame": "scene-0061, real" if folder else "simulated"}
    record |= {"parameters": count_parameters(variables["params"]), "locations": layout.num_locations}
    record["boxes"] = len(frame.boxes)
    print(json.dumps(record), flush=True)

    parts = network_parts(config, sensor)
    prepare, network, _, postprocess = map(jax.jit, make_stages(detector))
    image = prepare(batch.points[0], batch.valid[0])
    seen = parts.preprocess(image.features[None])
    after_stem = parts.stem(variables, seen)
    levels = parts.backbone(variables, after_stem)
    pyramid = parts.fpn(variables, levels)
    outputs = network(variables, image)
    truth = batch.boxes[0], batch.labels[0], batch.box_valid[0]
    axes = config.model.regression_axes
    objective = functools.partial(sample_losses, config=config.loss, layout=layout, axes=axes)
    losses, assignment = (jax.jit(lambda o, i, part=part: objective(o, i, *truth)[part]) for part in (0, 1))
    # The worst case for NMS: unlike a trained detector, many candidates above the threshold.
    eager = dataclasses.replace(outputs, logits=outputs.logits.at[:, -1].add(-4.0))
    detect = jax.jit(make_detect(detector))
    forward, images = jax.jit(lambda v, i: detector.apply(v, i)[0]), jax.tree.map(lambda leaf: leaf[None], image)
    calls: dict[str, Call] = {
        "mrv": lambda: prepare(batch.points[0], batch.valid[0]),
        "stem": lambda: parts.stem(variables, seen),
        "backbone": lambda: parts.backbone(variables, after_stem),
        "fpn": lambda: parts.fpn(variables, levels),
        "heads": lambda: parts.heads(variables, pyramid),
        "assignment": lambda: assignment(outputs, image),
        "assignment and losses": lambda: losses(outputs, image),
        "candidates and nms": lambda: postprocess(eager, image),
        "forward": lambda: forward(variables, images),
        "points to boxes": lambda: detect(variables, batch.points[0], batch.valid[0]),
    }
    times = interleaved(calls, args.repeats)
    record["milliseconds"] = {name: times[name]["median_ms"] for name in calls}
    step = training_steps(config, sensor, [frame])
    jax.block_until_ready(step())
    began = time.perf_counter()
    metrics = jax.block_until_ready(step())
    record["milliseconds"]["train step"] = round(1e3 * (time.perf_counter() - began), 1)
    record["train_metrics"] = {name: np.asarray(value).tolist() for name, value in metrics.items()}
    record["peak_memory_gib"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2)
    record["training_gib"] = training_memory(config)
    return record


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

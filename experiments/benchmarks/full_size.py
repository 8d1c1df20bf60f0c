"""Cost of training the paper's preset: parameters, memory, and time of a step of one frame.

    python -m experiments.benchmarks.full_size --data FOLDER  # on the real keyframe of scene-0061
    python -m experiments.benchmarks.full_size  # on a simulated frame
    python -m experiments.benchmarks.full_size --preset compact --weights hdl32e  # with and without second look
    python -m experiments.benchmarks.full_size --memory-only --out experiments/results/training_memory.json

``latency.py`` times the detection. Cost: about three minutes on two CPU cores and 10 GB. Expected: 10.66 M
parameters.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any, Literal

import jax

from experiments.hardware import peak_memory_gib
from experiments.real_frames import read_keyframe
from experiments.runs import training_steps
from experiments.script import Options, find_real_data, run_measurement
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.inference import load_trained
from fcos_lidar_jax.inference.timing import interleaved
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.input_pipeline.database import cut_reading
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.presets import PRESETS
from fcos_lidar_jax.refinement import without_second_look
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, load_sensor
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step
from fcos_lidar_jax.training.objective import make_objective
from fcos_lidar_jax.types import Batch


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Options of the measurement."""

    preset: Literal["nuscenes", "nuscenes_single", "compact", "quickstart"] = "nuscenes"  # Configuration preset.
    weights: Path | None = None  # Trained weights, whose boxes a second look sees; default: random weights.
    data: Path | None = None
    """Folder with nuscenes_scene0061/; default: the environment's FCOS_LIDAR_REAL_DATA, else a simulated frame."""
    repeats: int = 5  # Timed steps, for the median.
    memory_only: bool = False
    """Only compute the memory of a training step, without and with ``model.remat``, and run nothing."""


def training_memory(config: Config) -> dict[str, dict[str, float]]:
    """Compute the memory of a training step of one frame, without and with ``model.remat``, in GiB.

    ``kept`` is the memory kept for the backward pass, ``temporary`` the compiled program's in addition to state
    and batch.
    """
    sensor, found = load_sensor(config.sensor), {}
    frame = make_frame(0, sensor, reading=cut_reading(1))
    batch = make_batch([frame], max_points=config.max_points, max_boxes=config.max_boxes)
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
    folder = find_real_data(args.data, "nuscenes_scene0061") if sensor == NUSCENES_HDL32E else None
    reading = cut_reading(1)
    frame = read_keyframe(folder, sensor, reading=reading) if folder else make_frame(0, sensor, reading=reading)
    shapes = jax.eval_shape(build_detector(config, sensor).init, jax.random.key(0))
    # In NumPy, because each step gives its arrays away.
    variables = None if args.weights is None else jax.device_get(load_trained(args.weights).variables)
    calls = {"train step": training_steps(config, sensor, [frame], variables)}
    if config.refinement is not None:
        alone = dataclasses.replace(config, refinement=None)
        own = None if variables is None else without_second_look(variables)
        calls["train step without second look"] = training_steps(alone, sensor, [frame], own)
    times = interleaved(calls, args.repeats)
    return {
        "preset": config.name,
        "frame": "scene-0061, real" if folder else "simulated",
        "parameters": count_parameters(shapes["params"]),
        "boxes": len(frame.boxes),
        "milliseconds": {name: ms["median_ms"] for name, ms in times.items()},
        "peak_memory_gib": peak_memory_gib(),
        "training_gib": training_memory(config),
    }


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)

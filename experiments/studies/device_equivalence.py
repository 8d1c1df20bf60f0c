"""Equivalence of training steps on different numbers of devices and processes.

    python -m experiments.studies.device_equivalence

Computes one gradient and five steps in float32 and float64 from the same state, on meshes of 1, 2, 4 and 8 virtual
CPU devices in one process, and of 8 devices in two processes, on very unequal samples. In one process it also
computes one step under ``jax.pmap``; ``losses`` are the losses on one device, on the mesh and under ``pmap``. A
difference is the largest over all leaves, relative to the leaf's largest value. Expected: identical owners, labels
and K; differences of gradient, one step and five steps below 1e-9 in float64; in float32 a gradient that differs
by less than twice ``rounding``, the difference between float32 and float64 on one device. In float32 the steps are
only reported, because AdamW turns rounding noise of a gradient near zero into a full-size step. Cost: ten minutes
on two cores, mostly compilation.
"""

import dataclasses
import functools
import multiprocessing
import socket
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from experiments.changes import change
from experiments.paper_tables.scales import small_network
from experiments.script import Options, run_measurement
from fcos_lidar_jax.config import StemConfig
from fcos_lidar_jax.devices.mesh import jit_step, make_mesh, pmap_step, replicate, shard_batch
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models import Detector, build_detector
from fcos_lidar_jax.models.objective import sample_losses
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step
from fcos_lidar_jax.training.step import make_gradient
from fcos_lidar_jax.types import Batch, TrainState

SIZE, STEPS, POINTS = 8, 5, 2048
WEIGHTS = 1
"""Seed of weights without activations near the kink of ReLU, where rounding changes more than the last bits."""
SENSOR = dataclasses.replace(TINY, num_columns=64)
CONFIG = change(
    max_points=POINTS,
    model__row_upscale=1,
    model__stem=StemConfig(channels_per_type=2, out_channels=8, dilations=(1,)),
    optimizer__batch_size=SIZE,
    optimizer__ema_decay=0.9,
)(small_network(QUICKSTART))


def batch_of(step: int) -> Batch:
    """Make very unequal samples: the first without boxes, the second without points, the third with one box."""
    frames = []
    for i in range(SIZE):
        frame = make_frame(100 * step + i, SENSOR, num_objects=2 + 3 * i)
        boxes, points = {0: 0, 2: 1}.get(i), 0 if i == 1 else POINTS
        annotated = {name: getattr(frame, name)[:boxes] for name in ("boxes", "labels", "num_points")}
        frames.append(dataclasses.replace(frame, points=frame.points[:points], **annotated))
    return make_batch(frames, max_points=POINTS, max_boxes=32)


def _targets_of(detector: Detector, state: TrainState, batch: Batch) -> tuple[jax.Array, ...]:
    image = jax.vmap(detector.prepare)(batch.points, batch.valid)
    variables = {"params": state.params, "batch_stats": state.batch_stats}
    outputs, _ = detector.apply(variables, image, train=True)
    model = CONFIG.model
    options: dict[str, Any] = {"layout": image_layout(SENSOR, model), "axes": model.regression_axes}
    assign = functools.partial(sample_losses, config=CONFIG.loss, **options)
    targets = jax.vmap(assign)(outputs, image, batch.boxes, batch.labels, batch.box_valid)[1]
    return targets.owner, targets.positive, targets.num_positive


def draw_variables(detector: Detector, dtype: str) -> Any:
    """Draw realistic weights with NumPy, because Flax's initialisation takes long to compile."""
    rng = np.random.default_rng(WEIGHTS)

    def draw(path: Any, leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        if leaf.ndim > 1:
            predicts = path[-1].key.endswith("_kernel")
            scale = 0.01 if predicts else (2 / np.prod(leaf.shape[:-1])) ** 0.5
            return (scale * rng.normal(size=leaf.shape)).astype(dtype)
        # Headings away from zero, where their direction is well defined.
        return np.full(leaf.shape, path[-1].key in ("scale", "var", "heading_bias"), dtype)

    return jax.tree_util.tree_map_with_path(draw, jax.eval_shape(detector.init, jax.random.key(0)))


def measure(out: Path, mesh: Mesh, dtype: str) -> None:
    """Compute one gradient and five steps on one mesh."""
    detector, optimizer = build_detector(CONFIG, SENSOR), make_optimizer(CONFIG.optimizer, STEPS)
    start = make_state(detector, optimizer, jax.random.key(1), variables=draw_variables(detector, dtype))
    state, process, processes = replicate(start, mesh), jax.process_index(), jax.process_count()
    rows = slice(process * SIZE // processes, (process + 1) * SIZE // processes)
    batches = [shard_batch(jax.tree.map(lambda leaf: leaf[rows], batch_of(i)), mesh) for i in range(STEPS)]
    on_all = functools.partial(jax.jit, out_shardings=NamedSharding(mesh, PartitionSpec()))
    of_batch = on_all(make_gradient(detector))(state.params, state.batch_stats, batches[0])
    results: dict[str, Any] = dict(zip(("gradient", "statistics", "metrics"), of_batch, strict=True))
    results["targets"] = on_all(functools.partial(_targets_of, detector))(state, batches[0])
    if processes == 1:
        results["mapped"] = _mapped_step(make_train_step(detector, optimizer), start, mesh)
    step = jit_step(make_train_step(detector, optimizer), mesh)
    for i, batch in enumerate(batches):
        state, metrics = step(state, batch)
        # A copy, because the next step donates the state.
        results["after" if i else "step"] = jax.device_get(_outcome(state, metrics))
    arrays = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(results)[0]:
        copy = leaf.addressable_data(0) if isinstance(leaf, jax.Array) else leaf
        arrays[jax.tree_util.keystr(path)] = np.asarray(copy)
    if process == 0:
        np.savez(out, **arrays)  # type: ignore[arg-type]


def _outcome(state: TrainState, metrics: Any) -> tuple[Any, ...]:
    return state.params, state.batch_stats, state.ema, metrics["loss/total"]


def _mapped_step(step: Any, start: TrainState, mesh: Mesh) -> tuple[Any, ...]:
    """The outcome of one step under ``jax.pmap``, of the first device."""
    state = jax.tree.map(lambda leaf: jnp.stack([leaf] * mesh.size), start)
    batch = jax.tree.map(lambda leaf: leaf.reshape(mesh.size, -1, *leaf.shape[1:]), batch_of(0))
    return jax.tree.map(lambda leaf: leaf[0], _outcome(*pmap_step(step, mesh)(state, batch)))


def work(folder: Path, sizes: list[int], processes: int, port: int, dtype: str, process: int) -> None:
    """Measure on all meshes, as one of several processes."""
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_num_cpu_devices", max(sizes) // processes)
    jax.config.update("jax_enable_x64", dtype == "float64")
    if processes > 1:
        jax.distributed.initialize(f"localhost:{port}", processes, process)
    for size in sizes:
        mesh = make_mesh(jax.devices()[:size])
        measure(folder / f"{size}-{processes}-{dtype}.npz", mesh, dtype)


def launch(folder: Path, sizes: list[int], processes: int, dtype: str) -> None:
    """Measure in new processes, which write NPZ files into a folder."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = probe.getsockname()[1]
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        list(pool.map(functools.partial(work, folder, sizes, processes, port, dtype), range(processes)))


def _difference(one: dict[str, np.ndarray], many: dict[str, np.ndarray], part: str) -> float:
    """Largest difference over the leaves of a part, relative to the leaf's largest value."""
    leaves = [(one[name], many[name]) for name in one if name.startswith(f"['{part}']")]
    return max(float(np.abs(a - b).max() / max(float(np.abs(a).max()), 1e-12)) for a, b in leaves)


def _compare(folder: Path, devices: int, processes: int, dtype: str) -> dict[str, Any]:
    meshes = f"1-1-{dtype}", f"{devices}-{processes}-{dtype}", "1-1-float64"
    one, many, exact = (dict(np.load(folder / f"{mesh}.npz")) for mesh in meshes)
    record: dict[str, Any] = {"devices": devices, "processes": processes, "dtype": dtype}
    targets = [name for name in one if name.startswith("['targets']")]
    record["targets_identical"] = all(np.array_equal(one[name], many[name]) for name in targets)
    record["k_of_samples"] = one["['targets'][2]"].sum(axis=1).tolist()
    record |= {part: _difference(one, many, part) for part in ("gradient", "statistics", "metrics")}
    record["rounding"] = _difference(exact, one, "gradient")
    if mapped := {name.replace("mapped", "step"): many[name] for name in many if name.startswith("['mapped']")}:
        record["step"], record["step_by_pmap"] = (_difference(one, other, "step") for other in (many, mapped))
        record["losses"] = [float(each["['step'][3]"]) for each in (one, many, mapped)]
    return record | {"after_five_steps": _difference(one, many, "after")}


def measure_all(_: Options) -> dict[str, Any]:
    """Measure on all meshes and compare."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for dtype in ("float32", "float64"):
            launch(folder, [1, 2, 4, 8], 1, dtype)
            launch(folder, [8], 2, dtype)
        meshes = [file.stem.split("-") for file in sorted(folder.glob("*.npz"))]
        return {"meshes": [_compare(folder, int(d), int(p), dtype) for d, p, dtype in meshes if d != "1"]}


if __name__ == "__main__":
    run_measurement(measure_all, Options, __doc__)

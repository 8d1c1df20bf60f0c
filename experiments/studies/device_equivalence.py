"""Does a training step depend on the number of devices or processes?

    python -m experiments.studies.device_equivalence

One gradient in float32 and five steps in float32 and float64, from the same state, on meshes of 1, 2, 4 and 8
virtual CPU devices in one process, and of 8 in two. The samples of the batch are very unequal: one without boxes,
one without points, one with a single box. Differences are those of the worst leaf, relative to its largest value.

Expected: owners, labels and K identical; one gradient within 1e-5 in float32; five steps within 1e-9 in float64.
In float32 the five steps are told only: AdamW turns a rounding difference of a gradient near zero into a full
step.
Six minutes on two cores, nearly all of it compilation.
"""

import dataclasses
import json
import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from experiments.script import run_script, save
from fcos_lidar_jax.config import StemConfig
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models import Detector, build_detector
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step
from fcos_lidar_jax.training.objective import sample_losses
from fcos_lidar_jax.training.sharding import jit_step, make_mesh, replicate, shard_batch
from fcos_lidar_jax.training.step import make_gradient
from fcos_lidar_jax.types import Batch, TrainState

SIZE, STEPS, POINTS = 8, 5, 2048
WEIGHTS = 1
"""Seed of weights. Chosen, as is the grouped stem, so that float32 can tell: no activation near ReLU's kink, where
a whole gradient may differ, and gradients that hardly cancel. Other seeds, and wide convolutions, whose sums XLA
makes less exactly on a CPU, can differ by more than 1e-5 by rounding alone. In float64 none of this matters."""
SENSOR = dataclasses.replace(TINY, num_columns=64)
CONFIG = dataclasses.replace(
    QUICKSTART,
    max_points=POINTS,
    model=dataclasses.replace(
        QUICKSTART.model,
        row_upscale=1,
        stem=StemConfig(channels_per_type=2, out_channels=8, dilations=(1,)),
        backbone_blocks=(1, 1, 1, 1),
        backbone_widths=(8, 8, 8, 8),
        fpn_channels=8,
        head_channels=8,
        head_convs=1,
    ),
    optimizer=dataclasses.replace(QUICKSTART.optimizer, batch_size=SIZE, ema_decay=0.9),
)


@dataclasses.dataclass(frozen=True)
class Args:
    """How much, and where to."""

    quick: bool = False
    """Fewer meshes, 1 and 8, and no steps in float32."""
    out: Path = Path("outputs/device_equivalence.json")
    """Where the figures go."""


def batch_of(step: int) -> Batch:
    """Very unequal samples: the first without boxes, the second without points, the third with a single box."""
    frames = [make_frame(100 * step + i, SENSOR, num_objects=2 + 3 * i) for i in range(SIZE)]
    frames = [dataclasses.replace(f, points=f.points[:POINTS]) for f in frames]
    frames[0] = dataclasses.replace(frames[0], boxes=frames[0].boxes[:0], labels=frames[0].labels[:0])
    frames[2] = dataclasses.replace(frames[2], boxes=frames[2].boxes[:1], labels=frames[2].labels[:1])
    frames[1] = dataclasses.replace(frames[1], points=frames[1].points[:0])
    return make_batch(frames, max_points=POINTS, max_boxes=32)


def targets_of(detector: Detector, state: TrainState, batch: Batch) -> tuple[jax.Array, ...]:
    """Owners, labels and K of a batch."""
    image = jax.vmap(lambda p, v: project_points(p, v, SENSOR, num_rounds=1))(batch.points, batch.valid)
    variables = {"params": state.params, "batch_stats": state.batch_stats}
    outputs, _ = detector.apply(variables, image.features, train=True)
    layout = image_layout(SENSOR, CONFIG.model)

    def of_sample(*sample: Any) -> Any:
        return sample_losses(*sample, config=CONFIG.loss, layout=layout)[1]

    targets = jax.vmap(of_sample)(outputs, image, batch.boxes, batch.labels, batch.box_valid)
    return targets.owner, targets.positive, targets.num_positive


def draw_variables(detector: Detector, dtype: str) -> Any:
    """Weights as they might be, drawn by NumPy: Flax's own take longer to compile than the rest of a run."""
    rng = np.random.default_rng(WEIGHTS)

    def draw(path: Any, leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        if leaf.ndim > 1:
            predicts = path[-1].key.endswith("_kernel")
            scale = 0.01 if predicts else (2 / np.prod(leaf.shape[:-1])) ** 0.5
            return (scale * rng.normal(size=leaf.shape)).astype(dtype)
        # Headings far from zero, where their direction is well defined.
        return np.full(leaf.shape, path[-1].key in ("scale", "var", "heading_bias"), dtype)

    return jax.tree_util.tree_map_with_path(draw, jax.eval_shape(detector.init, jax.random.key(0)))


def measure(out: Path, mesh: Mesh, dtype: str, process: int, processes: int, *, with_steps: bool) -> None:
    """On one mesh, one gradient in float32, and five steps in float64 or where they are wanted."""
    detector, optimizer = build_detector(CONFIG, SENSOR), make_optimizer(CONFIG.optimizer, STEPS)
    start = make_state(detector, optimizer, jax.random.key(1), variables=draw_variables(detector, dtype))
    state = replicate(start, mesh)
    rows = slice(process * SIZE // processes, (process + 1) * SIZE // processes)
    batches = [shard_batch(jax.tree.map(lambda leaf: leaf[rows], batch_of(i)), mesh) for i in range(STEPS)]
    found: dict[str, Any] = {}
    if dtype == "float32":
        everywhere = NamedSharding(mesh, PartitionSpec())
        gradient = jax.jit(make_gradient(detector), out_shardings=everywhere)
        assigned = jax.jit(lambda state, batch: targets_of(detector, state, batch), out_shardings=everywhere)
        of_batch = gradient(state.params, state.batch_stats, batches[0])
        found = dict(zip(("gradient", "statistics", "metrics"), of_batch, strict=True))
        found["targets"] = assigned(state, batches[0])
    if dtype == "float64" or with_steps:
        step = jit_step(make_train_step(detector, optimizer), mesh)
        metrics = {}
        for batch in batches:
            state, metrics = step(state, batch)
        after = {"params": state.params, "statistics": state.batch_stats, "ema": state.ema}
        found |= {"after": after | {"loss": metrics["loss/total"]}}
    leaves = jax.tree_util.tree_flatten_with_path(found)[0]
    arrays = {jax.tree_util.keystr(path): np.asarray(leaf.addressable_data(0)) for path, leaf in leaves}
    if process == 0:
        np.savez(out, **arrays)  # type: ignore[arg-type]


def work(folder: str, sizes: list[int], processes: int, process: int, port: int, dtype: str, steps: bool) -> None:
    """Measure on all meshes of one process."""
    jax.config.update("jax_num_cpu_devices", max(sizes) // processes)
    jax.config.update("jax_enable_x64", dtype == "float64")
    if processes > 1:
        jax.distributed.initialize(f"localhost:{port}", processes, process)
    for size in sizes:
        out = Path(folder, f"{size}-{processes}-{dtype}.npz")
        measure(out, make_mesh(jax.devices()[:size]), dtype, process, processes, with_steps=steps)


def launch(folder: Path, sizes: list[int], processes: int, dtype: str, *, steps: bool) -> None:
    """Measure in processes of their own, which write NPZ files into a folder."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = probe.getsockname()[1]
    started = [
        subprocess.Popen(
            [
                sys.executable,
                "-c",
                f"from {__spec__.name} import work; "
                f"work(*{(str(folder), sizes, processes, number, port, dtype, steps)!r})",
            ],
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
            stderr=subprocess.PIPE,
            text=True,
        )
        for number in range(processes)
    ]
    errors = [process.communicate()[1] for process in started]
    for process, error in zip(started, errors, strict=True):
        if process.returncode:
            raise RuntimeError(error[-3000:])


def largest_difference(a: dict[str, np.ndarray], b: dict[str, np.ndarray], part: str) -> float:
    """Of all leaves of a part, each relative to its largest value."""
    names = [name for name in a if name.startswith(f"['{part}']")]
    return max(float(np.abs(a[n] - b[n]).max() / max(float(np.abs(a[n]).max()), 1e-12)) for n in names)


def compare(folder: Path, devices: int, processes: int, dtype: str) -> dict[str, Any]:
    """A mesh against one device."""
    one, many = (
        dict(np.load(folder / f"{size}.npz")) for size in (f"1-1-{dtype}", f"{devices}-{processes}-{dtype}")
    )
    record: dict[str, Any] = {"devices": devices, "processes": processes, "dtype": dtype}
    if dtype == "float32":
        targets = [name for name in one if name.startswith("['targets']")]
        record["targets_identical"] = all(np.array_equal(one[name], many[name]) for name in targets)
        record["k_of_samples"] = one["['targets'][2]"].sum(axis=1).tolist()
        record |= {part: largest_difference(one, many, part) for part in ("gradient", "statistics", "metrics")}
    if any(name.startswith("['after']") for name in many):
        record["after_five_steps"] = largest_difference(one, many, "after")
    return record


def main(args: Args) -> None:
    """Measure, compare, print, and write the figures."""
    single, double = ([1, 8], [1]) if args.quick else ([1, 2, 4, 8], [1, 2, 4, 8])
    records = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        launch(folder, single, 1, "float32", steps=not args.quick)
        launch(folder, double, 1, "float64", steps=True)
        if not args.quick:
            launch(folder, [8], 2, "float32", steps=True)
        launch(folder, [8], 2, "float64", steps=True)
        for file in sorted(folder.glob("*.npz")):
            devices, processes, dtype = file.stem.split("-")
            if devices != "1":
                records.append(compare(folder, int(devices), int(processes), dtype))
    save({"meshes": records}, args.out, "\n".join(map(json.dumps, records)))


if __name__ == "__main__":
    run_script(main, Args, __doc__)

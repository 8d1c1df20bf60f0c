"""``fcos-lidar benchmark``: how long a detector takes, per stage and for batches."""

import dataclasses
import functools
import itertools
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from fcos_lidar_jax.cli import options
from fcos_lidar_jax.cli.checks import Output
from fcos_lidar_jax.cli.options import option
from fcos_lidar_jax.data.cloud_policy import Cloud, make_cloud, sensor_mismatch
from fcos_lidar_jax.data.clouds import find_clouds
from fcos_lidar_jax.data.point_files import read_points
from fcos_lidar_jax.devices.mesh import make_mesh, shard_batch
from fcos_lidar_jax.fields import Bounds, Count
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.inference import CloudDetector, TrainedDetector, load_detector
from fcos_lidar_jax.inference.detect import make_stages
from fcos_lidar_jax.inference.export import ExportedDetector
from fcos_lidar_jax.inference.openvino import OpenVinoDetector
from fcos_lidar_jax.inference.timing import Call, Times, interleaved, machine
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.simulation.frames import make_frame

_NUM_SIMULATED = 3  # clouds, without files
_MATRIX_SIZE = 2048


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Time a detector on one device: each stage, the whole path from file to boxes, and batches.

    After a first run that compiles them, the stages are timed in turn. `detect` is a single program of all
    stages; an exported detector has only this program. The speed of the network, in operations per second, is
    compared with a product of two float32 matrices. Expect a small fraction of that speed, because narrow
    channels move more data than they multiply.
    """

    files: tyro.conf.Positional[
        Annotated[tuple[Path, ...], option("INPUT", default="simulated clouds of the detector's sensor")]
    ] = ()
    """Point files, one cloud per file, or folders of them."""
    checkpoint: options.Detector = tyro.MISSING
    out: Annotated[Path | None, Output.FILE, option("FILE")] = None  # Also write the times as JSON.
    batch: Annotated[
        tuple[int, ...], Bounds(1, empty=True), option("N...", default="1 2 4, or the exported size")
    ] = ()
    """Batch sizes."""
    repeats: Count = 20  # Timed runs of each stage.
    backend: options.Backend = "xla"


def run(args: Benchmark) -> None:
    """Measure, print, and write the times."""
    files = find_clouds(args.files)
    detector = load_detector(args.checkpoint, backend=args.backend)
    record = {
        "checkpoint": str(args.checkpoint),
        "backend": f"openvino {detector.precision}" if isinstance(detector, OpenVinoDetector) else "xla",
        **measure(detector, files, args.batch, args.repeats),
        **machine(),
    }
    print(as_text(record), flush=True)
    if args.out is not None:
        atomic_write(args.out, json.dumps(record, indent=1) + "\n")


def measure(
    detector: CloudDetector, files: tuple[Path, ...], batch: tuple[int, ...], repeats: int
) -> dict[str, Any]:
    """Times of the stages, of the whole path, and of batches.

    Without files the clouds are simulated, and reading is not timed. Without sizes the default sizes are timed.
    """
    sensor = detector.sensor
    read = functools.partial(read_points, sensor=sensor, num_sweeps=detector.config.num_sweeps)
    arrays = [read(file) for file in files] or [make_frame(seed, sensor).points for seed in range(_NUM_SIMULATED)]
    if line := sensor_mismatch(arrays[0], sensor):
        tell(f"warning: {line}")
    clean = functools.partial(make_cloud, config=detector.config, sensor=sensor)
    clouds = [clean(points) for points in arrays]
    takes = detector.record["batch"] if isinstance(detector, ExportedDetector) else "any"
    sizes = batch or ((1, 2, 4) if takes == "any" else (takes,))
    mesh = make_mesh(jax.local_devices()[:1])
    programs = {size: detector.program(mesh, size) for size in sizes}

    def detect(size: int, several: Iterable[Cloud]) -> Any:
        points, valid = (np.stack(parts) for parts in zip(*((c.points, c.valid) for c in several), strict=True))
        return jax.device_get(programs[size](*shard_batch((points, valid), mesh)))

    calls: dict[str, Call] = {"read": _in_turn(read, files)} if files else {}
    calls["clean"] = _in_turn(clean, arrays)
    if isinstance(detector, TrainedDetector):
        calls |= _stages(detector, clouds)
    if 1 in sizes:
        calls["detect"] = _in_turn(lambda cloud: detect(1, [cloud]), clouds)
        start: Callable[[Any], Cloud] = (lambda file: clean(read(file))) if files else clean
        calls["whole"] = _in_turn(lambda given: detect(1, [start(given)]), files or arrays)
    matrix = jnp.ones((_MATRIX_SIZE, _MATRIX_SIZE))
    calls["product"] = functools.partial(jax.jit(jnp.matmul), matrix, matrix)  # the speed within reach here
    stages = interleaved(calls, repeats, percentile=95)
    product_gflops = 2 * _MATRIX_SIZE**3 / 1e6 / stages.pop("product")["median_ms"]
    together = {
        size: functools.partial(detect, size, list(itertools.islice(itertools.cycle(clouds), size)))
        for size in sizes
    }
    throughput = {
        str(size): {**times, "clouds_per_s": round(1e3 * size / times["median_ms"], 2)}
        for size, times in interleaved(together, repeats, percentile=95).items()
    }
    number = {"clouds": len(clouds), "points": round(float(np.mean([len(points) for points in arrays])))}
    record = {**number, "repeats": repeats, "stages": stages, "throughput": throughput}
    if isinstance(detector, TrainedDetector) and (gflop := _network_gflop(detector)):
        gflops = 1e3 * gflop / stages["network"]["median_ms"]
        speed = {"gflop": gflop, "gflops": gflops, "product_gflops": product_gflops}
        rounded = {name: float(f"{value:.4g}") for name, value in speed.items()}
        record["network"] = {**rounded, "share": round(gflops / product_gflops, 3)}
    return record


def _network_gflop(detector: TrainedDetector) -> float:
    """Operations of the network for one cloud, counted by XLA before optimisation; 0 if it does not count."""
    stages, columns = make_stages(detector.model), detector.sensor.point_columns
    points = jax.ShapeDtypeStruct((detector.config.max_points, columns), jnp.float32)
    image = jax.eval_shape(stages.prepare, points, jax.ShapeDtypeStruct(points.shape[:1], bool))
    counted: Any = jax.jit(stages.network).lower(detector.variables, image).cost_analysis()
    return (counted or {}).get("flops", 0.0) / 1e9


def _in_turn(function: Callable[[Any], Any], values: Iterable[Any]) -> Call:
    turns = itertools.cycle(values)
    return lambda: function(next(turns))


def _stages(detector: TrainedDetector, clouds: list[Cloud]) -> dict[str, Call]:
    stages = make_stages(detector.model)
    prepare, postprocess, refine = map(jax.jit, (stages.prepare, stages.postprocess, stages.refine))
    run_by_xla = functools.partial(jax.jit(stages.network), jax.device_put(detector.variables))
    network = detector.network if isinstance(detector, OpenVinoDetector) else run_by_xla
    on_device = [jax.device_put((cloud.points, cloud.valid)) for cloud in clouds]
    images = [prepare(*cloud) for cloud in on_device]
    outputs = [network(image) for image in images]
    calls: dict[str, Call] = {
        "prepare": _in_turn(lambda cloud: prepare(*cloud), on_device),
        "network": _in_turn(network, images),
        "postprocess": _in_turn(lambda pair: postprocess(*pair), list(zip(outputs, images, strict=True))),
    }
    if detector.model.refine is not None:
        variables = jax.device_put(detector.variables)
        boxes = [postprocess(*pair) for pair in zip(outputs, images, strict=True)]
        looked = list(zip(on_device, boxes, strict=True))
        calls["refine"] = _in_turn(lambda pair: refine(variables, *pair[0], *pair[1]), looked)
    return calls


def as_text(record: dict[str, Any]) -> str:
    """Format the times as a table."""

    def line(name: str, times: Times) -> str:
        return f"{name:<12}{times['median_ms']:>12.2f}{times['p95_ms']:>12.2f}"

    lines = [
        f"{record['checkpoint']}: {record['clouds']} clouds of {record['points']} points, {record['repeats']} "
        f"turns, {record['backend']}, {record['device']} ({record['processor']}, {record['cores']} cores), "
        f"jax {record['jax']}",
        f"{'stage':<12}{'median ms':>12}{'95 % ms':>12}",
        *(line(name, times) for name, times in record["stages"].items()),
        f"{'batch':<12}{'median ms':>12}{'95 % ms':>12}{'clouds/s':>12}",
        *(f"{line(size, t)}{t['clouds_per_s']:>12.2f}" for size, t in record["throughput"].items()),
    ]
    if network := record.get("network"):
        lines.append(
            "network: {gflop:.4g} GFLOP per cloud, {gflops:.4g} GFLOP/s, {share:.2f} of the speed of a float32 "
            "matrix product ({product_gflops:.4g} GFLOP/s)".format(**network)
        )
    return "\n".join(lines)

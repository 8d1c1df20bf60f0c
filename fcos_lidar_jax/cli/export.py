"""``fcos-lidar export``: a detector as one file, with its weights and the whole path inside."""

import dataclasses
import json
import time
from pathlib import Path
from typing import Annotated, Literal

import tyro

from fcos_lidar_jax.checkpoints.retention import find_checkpoint
from fcos_lidar_jax.cli.checks import check_out_file, check_outside
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.inference import load_trained
from fcos_lidar_jax.inference.export import PLATFORMS, Size, export_detector, load_exported
from fcos_lidar_jax.inference.onnx_graph import network_graph


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a detector as one file that runs with jax and flatbuffers alone, on CPUs, GPUs and TPUs.

    Points go in and boxes come out; the other commands take it as their --checkpoint. Prints what was written as
    JSON, with the seconds that reading it took. With --network-only --format onnx, the network alone.
    """

    checkpoint: Annotated[Path, tyro.conf.arg(metavar="C")]
    """Trained detector: a checkpoint; a run, which stands for its last one, RUN/best for its best; or
    `hdl32e` or `quickstart`, which come with the package."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]  # Where the file goes.
    points: Annotated[Size | None, tyro.conf.arg(metavar="N|any")] = None
    """Rows of a cloud with its padding, or any, compiled anew for each number. Default: as the detector was
    trained."""
    batch: Annotated[Size, tyro.conf.arg(metavar="N|any")] = 1
    """Clouds at once, or any; more than one changes boxes and scores by rounding."""
    network_only: bool = False  # Without projection, decoding and NMS, for other runtimes; needs --format onnx.
    format: Literal["jax", "onnx"] = (
        "jax"  # Of the file: a program of jax.export, or an ONNX graph of the network.
    )


def run(args: Export) -> None:
    """Export and write."""
    found = find_checkpoint(args.checkpoint)
    check_out_file("--out", args.out, keep=())
    check_outside("--out", args.out, args.checkpoint)
    if args.network_only != (args.format == "onnx"):
        raise ValueError("export: expected --network-only and --format onnx together: the rest has no ONNX form")
    (_export_network if args.network_only else _export_program)(args, found)


def _export_network(args: Export, checkpoint: Path) -> None:
    if (args.points, args.batch) != (None, 1):
        raise ValueError("--points, --batch: expected without --network-only, whose batch is any")
    detector = load_trained(checkpoint)
    content = network_graph(detector)
    atomic_write(args.out, lambda path: path.write_bytes(content))
    print(json.dumps({"file": str(args.out), "bytes": len(content), "name": detector.config.name}))


def _export_program(args: Export, checkpoint: Path) -> None:
    """Write, and read what was written."""
    began = time.perf_counter()
    content = export_detector(load_trained(checkpoint), num_points=args.points, batch=args.batch)
    written = time.perf_counter()
    atomic_write(args.out, lambda path: path.write_bytes(content))
    read = time.perf_counter()
    record = load_exported(args.out).record
    described = {name: record[name] for name in ("name", "num_points", "batch", "weights")}
    took = {"export_s": round(written - began, 2), "load_s": round(time.perf_counter() - read, 3)}
    print(json.dumps({"file": str(args.out), "bytes": len(content), **described, "platforms": PLATFORMS, **took}))

"""``fcos-lidar export``: a detector as one file that holds its weights and all stages."""

import dataclasses
import json
import time
from pathlib import Path
from typing import Annotated, Literal

from fcos_lidar_jax.cli import options
from fcos_lidar_jax.cli.checks import Needs, Output
from fcos_lidar_jax.cli.options import option
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.inference import load_trained
from fcos_lidar_jax.inference.export import PLATFORMS, Size, export_detector, load_exported
from fcos_lidar_jax.inference.onnx_graph import network_graph
from fcos_lidar_jax.inference.onnx_program import program_graph


@dataclasses.dataclass(frozen=True)
class Export:
    """Export a detector to one file, from points to boxes, that runs with only jax and flatbuffers installed.

    The file runs on CPUs, GPUs and TPUs. detect, stream, evaluate and benchmark accept it as --checkpoint. With
    --format onnx, the command writes an ONNX graph for other runtimes instead.
    """

    checkpoint: options.Trained
    out: Annotated[Path, Output.FILE, option("FILE")]  # File to write.
    points: Annotated[Size | None, Needs("format", "jax"), option("N|any", default="as trained")] = None
    """Rows of a cloud including padding; `any` compiles once per number of rows."""
    batch: Annotated[Size, Needs("format", "jax"), option("N|any")] = 1
    """Clouds per call, or any number. Another size changes boxes and scores by rounding."""
    network_only: Annotated[bool, Needs("format", "onnx")] = False
    """Leave out projection, decoding, NMS and second look. Needs --format onnx."""
    format: Literal["jax", "onnx"] = "jax"  # A program of jax.export, or an ONNX graph.


def run(args: Export) -> None:
    """Export the detector, write the file, and print a record of it."""
    detector, began = load_trained(args.checkpoint), time.perf_counter()
    if args.format == "onnx":
        content = (network_graph if args.network_only else program_graph)(detector)
    else:
        content = export_detector(detector, num_points=args.points, batch=args.batch)
    written = time.perf_counter()
    atomic_write(args.out, content)
    record = {"file": str(args.out), "bytes": len(content), "name": detector.config.name}
    if args.format == "jax":
        read = time.perf_counter()
        loaded = load_exported(args.out).record
        record |= {name: loaded[name] for name in ("num_points", "batch", "weights")} | {"platforms": PLATFORMS}
        record |= {"export_s": round(written - began, 2), "load_s": round(time.perf_counter() - read, 3)}
    print(json.dumps(record))

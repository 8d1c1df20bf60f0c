"""Compile the programs for GPUs with XLA's complete pipeline, without a GPU.

    bash .ci/gpu  # fetches XLA's plugin (0.6 GB) into build/gpu/plugin, then runs this script with its arguments
    bash .ci/gpu --programs train-nuscenes detect-compact
    bash .ci/gpu --all  # all presets
    python -m experiments.benchmarks.gpu_programs --plugin build/gpu/plugin  # with the plugin fetched

Each program is compiled in a separate process, so that an abort of XLA does not end the check. Prints one line per
program: seconds, GFLOP per frame, temporary memory, kernels outside loops, and for each loop its iterations (``?``
if they depend on data) and kernels per iteration. ``slow`` counts weight gradients that became a convolution with
a kernel as large as the image, for which cuDNN has no good algorithm. The exit code is 1 if a program does not
compile, or if devices exchange anything but sums.

Programs are not run, so there are no times, and kernels are chosen without measurements. Cost: one minute per
training step and 15 seconds per detection on one core.
"""

import collections
import dataclasses
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import tyro
from jax.experimental import topologies
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxlib import _jax  # type: ignore[attr-defined]

from experiments.changes import change
from experiments.script import Options, run_script, save
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.inference.detect import make_detect
from fcos_lidar_jax.inference.export import export_detector, load_exported
from fcos_lidar_jax.inference.load import load_trained
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import PRESETS
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step
from fcos_lidar_jax.types import Batch

Card = Literal["h100", "a100"]
_CARDS = {  # compute capability, cores, shared memory per core and per block, bandwidth, L2, clock, name
    "h100": (9, 132, 233472, 232448, 3352320000000, 52428800, 1.98, "NVIDIA H100 80GB HBM3"),
    "a100": (8, 108, 167936, 166912, 2039000000000, 41943040, 1.41, "NVIDIA A100-SXM4-80GB"),
}
_TARGET = """
gpu_device_info {{
  threads_per_block_limit: 1024
  threads_per_warp: 32
  shared_memory_per_block: 49152
  shared_memory_per_core: {2}
  threads_per_core_limit: 2048
  core_count: {1}
  fpus_per_core: 128
  block_dim_limit_x: 2147483647
  block_dim_limit_y: 65535
  block_dim_limit_z: 65535
  memory_bandwidth: {4}
  l2_cache_size: {5}
  clock_rate_ghz: {6}
  device_memory_size: 84929347584
  shared_memory_per_block_optin: {3}
  cuda_compute_capability {{ major: {0} }}
  registers_per_core_limit: 65536
  registers_per_block_limit: 65536
}}
platform_name: "CUDA"
dnn_version_info {{ major: 9 minor: 10 }}
runtime_version {{ major: 12 minor: 9 patch: 0 }}
device_description_str: "{7}"
"""
_NO_KERNEL = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "iota"}
_EXCHANGES = ("all-gather", "all-to-all", "collective-permute", "reduce-scatter")


@dataclasses.dataclass(frozen=True)
class Program:
    """A program to compile."""

    kind: Literal["train", "detect", "export"]
    preset: str
    precision: str = "float32"
    batch: int = 1
    remat: bool = False
    card: Card = "h100"
    devices: int = 1
    frozen: bool = False  # train only the second look


PROGRAMS = {
    "train-nuscenes": Program("train", "nuscenes", batch=4),
    "train-nuscenes-bfloat16": Program("train", "nuscenes", "bfloat16", batch=4),
    "train-nuscenes-remat": Program("train", "nuscenes", batch=4, remat=True),
    "train-nuscenes-bfloat16-remat": Program("train", "nuscenes", "bfloat16", batch=4, remat=True),
    "train-nuscenes-8-devices": Program("train", "nuscenes", batch=32, devices=8),
    "train-kitti": Program("train", "kitti", batch=2),
    "train-compact": Program("train", "compact", batch=2),
    "train-compact-bfloat16": Program("train", "compact", "bfloat16", batch=4),
    "train-compact-second-look": Program("train", "compact", batch=2, frozen=True),
    "train-compact-a100": Program("train", "compact", batch=2, card="a100"),
    "train-centerpoint_compact": Program("train", "centerpoint_compact", batch=2),
    "detect-nuscenes": Program("detect", "nuscenes"),
    "detect-compact": Program("detect", "compact"),
    "export-quickstart": Program("export", "quickstart"),
}
"""Programs that are compiled without ``--all``."""


def all_programs() -> dict[str, Program]:
    """List the default programs, and training and detection of all presets in both precisions."""
    programs = dict(PROGRAMS)
    for name, config in PRESETS.items():
        for precision in ("float32", "bfloat16") if type(config) is Config else ("float32",):
            label = name + ("" if precision == "float32" else f"-{precision}") + "-1"
            programs[f"train-{label}"] = Program("train", name, precision)
            programs[f"detect-{label}"] = Program("detect", name, precision)
    return programs


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Options of the check."""

    plugin: Path  # Folder with XLA's plugin for CUDA, as fetched by `.ci/gpu`.
    programs: tuple[str, ...] = ()  # Names of programs; default: the check's.
    all: bool = False  # Also compile all presets.
    limit_s: int = 900  # Time limit per program, seconds.
    one: str | None = None  # Compile one program in this process and print its record (internal).


def check(args: Args) -> None:
    """Compile the programs one by one, print a line for each, save the record, and fail if one fails the check."""
    known = all_programs() if args.all or args.programs else PROGRAMS
    if unknown := [name for name in args.programs if name not in known]:
        raise ValueError(f"--programs: got {unknown[0]!r}, expected some of {', '.join(known)}")
    nvcc = args.plugin.resolve() / "nvidia" / "cuda_nvcc"
    if not nvcc.is_dir():
        raise ValueError(f"--plugin: {args.plugin}: no nvidia/cuda_nvcc there: run bash .ci/gpu")
    flags = f"--xla_gpu_cuda_data_dir={nvcc} --xla_gpu_autotune_level=0"
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": os.pathsep.join(filter(None, [str(args.plugin.resolve()), os.environ.get("PYTHONPATH")])),
        "PATH": f"{nvcc / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}",
        "TF_CPP_MIN_LOG_LEVEL": "2",
    }
    records = {}
    for name in args.programs or known:
        records[name] = _compiled(name, args, environment)
        print(_line(name, records[name]), flush=True)
    failed = [name for name, found in records.items() if found.get("failed") or found.get("exchanges")]
    said = f"{len(records) - len(failed)} of {len(records)} programs compile as they should"
    save({"programs": records, "run": False}, args.out, said)
    if failed:
        raise ValueError(f"not as they should be: {', '.join(failed)}")


def _compiled(name: str, args: Args, environment: dict[str, str]) -> dict[str, Any]:
    """Compile one program in a separate process."""
    command = [sys.executable, "-m", "experiments.benchmarks.gpu_programs", "--plugin", str(args.plugin)]
    options: dict[str, Any] = {"capture_output": True, "text": True, "timeout": args.limit_s}
    try:
        done = subprocess.run([*command, "--one", name], check=False, env=environment, **options)
    except subprocess.TimeoutExpired:
        return {"failed": f"not compiled after {args.limit_s} s"}
    if done.returncode == 0:
        return json.loads(done.stdout.splitlines()[-1])
    lines = done.stderr.splitlines() or ["nothing said"]
    why = next((line for line in lines if "Check failed" in line), lines[-1])
    return {"failed": f"exit code {done.returncode}: {why[-200:]}"}


def _line(name: str, record: dict[str, Any]) -> str:
    if "failed" in record:
        return f"{name:30} FAILED: {record['failed']}"
    loops = " ".join(f"{trips or '?'}x{kernels}" for trips, kernels in record["loops"]) or "none"
    return (
        f"{name:30} {record['seconds']:4.0f} s  {record['gflop_per_frame']:6.0f} GFLOP per frame  "
        f"{record['temporary_mib']:6} MiB  {record['kernels']:5} kernels  loops {loops}"
        + (f"  slow {record['slow']}" if record["slow"] else "")
        + (f"  exchanges {record['exchanges']}" if record.get("exchanges") else "")
        + (f"  {record['all_reduces']} all-reduces" if record.get("all_reduces") else "")
    )


def compile_program(program: Program) -> dict[str, Any]:
    """Compile in this process, in the environment set by :func:`check`."""
    jax.devices()  # Finds the plugin too.
    topology = topologies.get_topology_desc(
        platform="cuda",
        topology_name="",
        target_config=_TARGET.format(*_CARDS[program.card]),
        topology=f"{program.devices}x1x1",
    )
    mesh = Mesh(topology.devices, ("data",), axis_types=(AxisType.Auto,))
    everywhere, rows = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec("data"))
    function, given = _function(program)
    trains = program.kind == "train"
    inputs: Any = (everywhere, rows) if trains else everywhere  # Devices share a batch; all have the state.
    donated = (0,) if trains else ()
    jitted = jax.jit(function, in_shardings=inputs, out_shardings=everywhere, donate_argnums=donated)
    began = time.monotonic()
    lowered = jitted.lower(*given)
    compiled = lowered.compile()
    seconds = time.monotonic() - began
    hlo: Any = lowered.compiler_ir("hlo")  # before optimisation
    flops = _jax.hlo_module_cost_analysis(jax.devices()[0].client, hlo.get_hlo_module())["flops"]
    module = str(compiled.as_text())
    memory: Any = compiled.memory_analysis()
    kernels, loops = count_kernels(module)
    record = {
        **dataclasses.asdict(program),
        "seconds": round(seconds),
        "gflop_per_frame": round(flops / program.batch / 1e9, 1),
        "temporary_mib": memory.temp_size_in_bytes >> 20,
        "kernels": kernels,
        "loops": loops,
        "slow": len(re.findall(r"window=\{size=\d{2,}x\d{3,}.*__cudnn\$convForward", module)),
        "custom_calls": dict(collections.Counter(re.findall(r'custom_call_target="([^"]+)"', module))),
    }
    if program.devices > 1:
        found = re.findall(r" (all-reduce|" + "|".join(_EXCHANGES) + r")(?:-start)?\(", module)
        record["exchanges"] = dict(collections.Counter(found))
        record["all_reduces"] = record["exchanges"].pop("all-reduce", 0)
    return record


def _function(program: Program) -> tuple[Any, tuple[Any, ...]]:
    """Return a function and its arguments' shapes."""

    def spec(*shape: int, dtype: Any = jnp.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, dtype)

    config = PRESETS[program.preset]
    if type(config) is Config:
        config = change(model__precision=program.precision, model__remat=program.remat)(config)
    config = change(optimizer__batch_size=program.batch)(config)
    if program.frozen:
        config = change(refinement__freeze_detector=True)(config)
    sensor = load_sensor(config.sensor)
    b, n, m, c = program.batch, config.max_points, config.max_boxes, sensor.point_columns
    if program.kind == "export":
        file = Path("build", "exported")
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(export_detector(load_trained(program.preset)))
        exported = load_exported(file).exported
        return exported.call, (spec(1, n, c), spec(1, n, dtype=jnp.bool_), spec(dtype=jnp.bool_))
    detector = build_detector(config, sensor)
    optimizer = make_optimizer(config.optimizer, 1000)
    state = jax.eval_shape(lambda key: make_state(detector, optimizer, key), jax.random.key(0))
    if program.kind == "detect":
        variables = {"params": state.params, "batch_stats": state.batch_stats}
        return make_detect(detector), (variables, spec(n, c), spec(n, dtype=jnp.bool_))
    clouds = spec(b, n, c), spec(b, n, dtype=jnp.bool_)
    arrays: Any = (*clouds, spec(b, m, 9), spec(b, m, dtype=jnp.int32), spec(b, m, dtype=jnp.bool_))
    return make_train_step(detector, optimizer), (state, Batch(*arrays))


def count_kernels(module: str) -> tuple[int, list[tuple[int | None, int]]]:
    """Count the kernels of a compiled program outside loops, and list (iterations, kernels each) of all loops.

    Iterations are None if they depend on data. Nested loops are separate entries.
    """
    bodies: dict[str, list[tuple[str, str]]] = {}  # Operations of each computation, and their lines.
    name = entry = ""
    for line in module.splitlines():
        if head := re.match(r"(ENTRY )?(%[\w.\-]+) \(.*\{$", line):
            name, entry = head[2], head[2] if head[1] else entry
            bodies[name] = []
        elif line.startswith("}"):
            name = ""
        elif name and (found := re.search(r"= .*? ([a-z][a-z\-]*)\(", line)):
            bodies[name].append((found[1], line))
    loops: list[tuple[int | None, int]] = []

    def kernels(name: str) -> int:
        count = 0
        for operation, line in bodies.get(name, ()):
            if operation == "while":
                body, trips = re.search(r"body=(%[\w.\-]+)", line), re.search(r'trip_count":\{"n":"(\d+)"', line)
                assert body is not None
                slot = len(loops)
                loops.append((None, 0))
                loops[slot] = (int(trips[1]) if trips else None, kernels(body[1]))
            elif operation == "conditional":
                branches = re.search(r"branch_computations=\{([^}]*)\}", line)
                names = branches[1].split(", ") if branches else re.findall(r"_computation=(%[\w.\-]+)", line)
                count += max(map(kernels, names), default=0)
            elif operation == "call":
                called = re.search(r"to_apply=(%[\w.\-]+)", line)
                count += kernels(called[1]) if called else 0
            else:
                count += operation not in _NO_KERNEL
        return count

    return kernels(entry), loops


if __name__ == "__main__":
    if "--one" in sys.argv:
        print(json.dumps(compile_program(all_programs()[str(tyro.cli(Args).one)])))
    else:
        run_script(check, Args, __doc__)

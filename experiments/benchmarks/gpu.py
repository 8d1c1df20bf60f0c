"""Times, memory and scores on a GPU, in parts that can be interrupted.

    python -m experiments.benchmarks.gpu --out FOLDER  # again until nothing is left
    python -m experiments.benchmarks.gpu --out FOLDER --torch-python PYTHON  # an interpreter that has torch
    python -m experiments.benchmarks.gpu --out FOLDER --parts detection training
    python -m experiments.benchmarks.gpu --out FOLDER --toy  # small networks and few repeats, to try it on a CPU

A part is a JSON file with one record per row, with its hardware and revision, and the rows come in the order of
their worth. Each row runs in a process of its own, so that its memory is its own and a crash costs nothing else. A
row that is in the file is not repeated, unless it failed or lacked torch; such rows come last. No row starts that
could take longer than what is left of ``--limit-s``. ``FOLDER/work`` has the logs of the rows, compiled programs,
and the frames and runs of ``scores``.

- ``detection``: the paper's preset from points to boxes by stage, for one cloud.
- ``training``: its training step, with the largest memory of the process, and trainings fed from sweep files.
- ``torch``: forward pass and training step at full size compared with PyTorch, see ``train_speed.py``.
- ``projection``: one to seven rounds of projection, the transfer of a batch, the stages of CenterPoint and
  ``compact`` and their training steps.
- ``scores``: trials of ``ladder.py``.

``float32`` computes in full float32, ``tf32`` in the default precision, which on NVIDIA's GPUs is TF32, and
``bfloat16`` with ``model.precision``. Weights are random, in ``detection`` with the background prior of
``latency.py``. Expected: ``results/ladder.json`` has the scores of the trials on a CPU.
"""

import dataclasses
import json
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax

from experiments.benchmarks.latency import fused_cloud, padded, path_calls, simulated_sweeps, stage_calls
from experiments.benchmarks.mrv_figures import mrv_times
from experiments.benchmarks.train_speed import Function, Size, compare
from experiments.changes import change
from experiments.hardware import hardware, peak_memory_gib
from experiments.pool import simulating
from experiments.runs import trained, training_steps
from experiments.script import compact_json, run_script
from experiments.studies import ladder
from fcos_lidar_jax.centerpoint import CenterPointConfig
from fcos_lidar_jax.config import Config, RefinementConfig
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.files import atomic_write, read_json
from fcos_lidar_jax.inference.timing import interleaved
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.input_pipeline.database import cut_reading
from fcos_lidar_jax.input_pipeline.loader import default_threads
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import CENTERPOINT_COMPACT, CENTERPOINT_PILLARS, COMPACT, NUSCENES, QUICKSTART
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training import Schedule
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.workers import end_with_parent

Part = Literal["detection", "training", "torch", "projection", "scores"]
Precision = Literal["float32", "tf32", "bfloat16"]
_GRACE_S = 20  # For a row to save its state, after its time is up.
_TOY_PILLARS = dataclasses.replace(CENTERPOINT_COMPACT.pillars, range_m=12.8)
_TOY_PEER = CenterPointConfig.of(QUICKSTART, model=NUSCENES.model, loss=NUSCENES.loss, pillars=_TOY_PILLARS)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args:
    """Options of the measurement."""

    out: Path  # Folder of the JSON files; with the same folder, the command continues.
    parts: tuple[Part, ...] = ()  # Which to measure; default: all.
    toy: bool = False  # Small networks and few repeats, to try the script on a CPU.
    limit_s: float = 540  # Time limit of the command in seconds, three times as long for a toy.
    torch_python: Path = Path(sys.executable)  # Interpreter that has torch.

    def repeats(self, number: int) -> int:
        """Number of repeats, or steps, of a row."""
        return 2 if self.toy else number


class Row(NamedTuple):
    """A measurement with its time limit in seconds, three times as long for a toy, since CPUs compile slowly."""

    limit_s: int
    measure: Callable[[Args], dict[str, Any]]


def set_precision(precision: Precision) -> Literal["float32", "bfloat16"]:
    """Set the precision of multiplications of this process; returns the model's."""
    jax.config.update("jax_default_matmul_precision", "highest" if precision == "float32" else None)
    return "bfloat16" if precision == "bfloat16" else "float32"


def paper_preset(args: Args, precision: Precision = "tf32", **fields: Any) -> tuple[Config, Sensor]:
    """Choose the paper's preset, or a small one, with changed fields."""
    fields["model__precision"] = set_precision(precision)
    config = change(**fields)(QUICKSTART if args.toy else NUSCENES)
    return config, load_sensor(config.sensor)


def frame_of(config: Config, sensor: Sensor) -> Frame:
    """Simulate a frame with as many sweeps as a configuration fuses."""
    return make_frame(0, sensor, reading=cut_reading(config.num_sweeps))


def detection(args: Args, *, precision: Precision) -> dict[str, Any]:
    """Time the stages from points to boxes."""
    config, sensor = paper_preset(args, precision, model__background_prior=0.5)
    points, cloud = fused_cloud(None, sensor)
    variables = jax.jit(build_detector(config, sensor).init)(jax.random.key(0))
    calls = path_calls(config, sensor, variables, padded(points, "multi", sensor))
    return {"preset": config.name, "cloud": cloud, "times": interleaved(calls, args.repeats(50))}


def training(args: Args, *, batch: int, precision: Precision, remat: bool) -> dict[str, Any]:
    """Time a training step on a batch that is on the device."""
    config, sensor = paper_preset(args, precision, model__remat=remat)
    calls = {"step": training_steps(config, sensor, [frame_of(config, sensor)] * batch)}
    times = interleaved(calls, args.repeats(20))["step"]
    return {"preset": config.name, **times, "samples_per_second": round(1e3 * batch / times["median_ms"], 1)}


def training_from_files(args: Args) -> dict[str, Any]:
    """Train on keyframes that threads fuse from sweep files; the first third of the steps is not timed."""
    config, sensor = paper_preset(args, optimizer__batch_size=4, copy_paste=None)
    steps = 3 * args.repeats(20)
    with simulated_sweeps(sensor, keyframes=5) as (drive, _), tempfile.TemporaryDirectory() as folder:
        frames = NuScenesFrames(drive, tuple(drive.sample_tokens[1:]), config.reading, sensor)
        options: dict[str, Any] = {"threads": None, "schedule": Schedule(steps, steps)}
        run = Path(folder, "run")
        trained(run, config, frames, steps=steps, seed=0, **options)
        timed = [record for record in read_metrics(run) if "seconds" in record][steps // 3 :]
    seconds, waiting = (sum(record[name] for record in timed) for name in ("seconds", "waiting_seconds"))
    samples = {"samples_per_second": round(4 * len(timed) / seconds, 1), "waiting": round(waiting / seconds, 3)}
    return {"preset": config.name, "threads": default_threads(), **samples}


def beside_torch(args: Args, *, precision: Precision, compiled: bool) -> dict[str, Any]:
    """Compare a forward pass of one range image and a training step of four with PyTorch."""
    version = [args.torch_python, "-c", "import torch; print(torch.__version__)"]
    found = subprocess.run(version, capture_output=True, text=True, check=False)
    if found.returncode:
        return {"missing": f"torch in {args.torch_python}"}
    device = "cuda" if jax.devices()[0].platform == "gpu" else "cpu"
    options: dict[str, Any] = {"python": args.torch_python, "precision": set_precision(precision)}
    options |= {"DEVICE": device, "AUTOCAST": int(precision == "bfloat16"), "COMPILE": int(compiled)}
    size: Size = "slim" if args.toy else "full"
    cases: tuple[tuple[Function, int], ...] = (("forward", 1), ("train", 4))
    return {"torch": found.stdout.strip()} | {
        f"{f}, batch {n}, seconds": compare(size, args.repeats(20), function=f, batch=n, **options)
        for f, n in cases
    }


def rounds(args: Args) -> dict[str, Any]:
    """Time one to seven rounds of the projection."""
    _, sensor = paper_preset(args)
    cloud, label = fused_cloud(None, sensor)
    last = 2 if args.toy else 7
    return {"cloud": label, **mrv_times(cloud, sensor, rounds=range(1, last + 1), repeats=args.repeats(100))}


def transfer(args: Args) -> dict[str, Any]:
    """Time the transfer of 32 samples, and compare it with eight training steps of four samples."""
    config, sensor = paper_preset(args)
    frame = frame_of(config, sensor)
    batch = make_batch([frame] * 32, max_points=config.max_points, max_boxes=config.max_boxes)
    calls = {"transfer of 32": partial(jax.device_put, batch)}
    times = interleaved(calls | {"step of 4": training_steps(config, sensor, [frame] * 4)}, args.repeats(20))
    of_32, of_4 = (times[name]["median_ms"] for name in ("transfer of 32", "step of 4"))
    mib = sum(leaf.nbytes for leaf in jax.tree.leaves(batch)) >> 20
    return {"preset": config.name, "mib": mib, "times": times, "share_of_training": round(of_32 / (8 * of_4), 4)}


def stages(args: Args, *, config: Config, toy: Config) -> dict[str, Any]:
    """Time the stages of a detector and its training step of four samples."""
    config = toy if args.toy else config
    sensor = load_sensor(config.sensor)
    detector, frame = build_detector(config, sensor), frame_of(config, sensor)
    variables = jax.jit(detector.init)(jax.random.key(0))
    calls = stage_calls(detector, variables, make_cloud(frame.points, config, sensor=sensor, num_close=0))
    calls["training step of 4"] = training_steps(config, sensor, [frame] * 4)
    return {"preset": config.name, "times": interleaved(calls, args.repeats(50))}


def scores(args: Args, *, trial: str) -> dict[str, Any]:
    """Train a trial of the ladder and score it, while the other cores simulate its frames."""
    own = ladder.Args(steps=8 if args.toy else ladder.STEPS, work=args.out / "work" / "ladder")
    others = 0 if args.toy else max(len(os.sched_getaffinity(0)) - 2, 0)
    tests, frames = (ladder.frames(own.work, split) for split in ("test", "train"))
    with simulating(tests, min(others, 1)), simulating(frames, others):
        return ladder.trial(trial, 0, own)


_PRECISIONS: tuple[Precision, ...] = ("float32", "tf32", "bfloat16")
_LOOK = change(refinement=RefinementConfig())(QUICKSTART)
PARTS: dict[str, dict[str, Row]] = {
    "detection": {p: Row(120, partial(detection, precision=p)) for p in _PRECISIONS},
    "training": {
        "batch 4, tf32, from files": Row(120, training_from_files),
        **{
            f"batch {b}, {p}" + ", remat" * remat: Row(120, partial(training, batch=b, precision=p, remat=remat))
            for remat in (False, True)
            for b in (4, 8)
            for p in _PRECISIONS[1:]
        },
    },
    "torch": {
        p + ", compiled" * compiled: Row(180, partial(beside_torch, precision=p, compiled=compiled))
        for compiled in (False, True)
        for p in _PRECISIONS[1:]
    },
    "projection": {
        "rounds": Row(120, rounds),
        "transfer": Row(120, transfer),
        "CenterPoint": Row(120, partial(stages, config=CENTERPOINT_PILLARS, toy=_TOY_PEER)),
        "second look": Row(120, partial(stages, config=COMPACT, toy=_LOOK)),
    },
    "scores": {name: Row(300, partial(scores, trial=name)) for name in ("larger", "larger, joint")},
}
"""Part -> rows, in the order of their worth."""


def stored(args: Args, part: str) -> dict[str, Any]:
    """Read the file of a part, or begin it; that of another size is refused."""
    file = args.out / f"{part}.json"
    record = read_json(file, dict[str, Any]) if file.exists() else {"toy": args.toy, "rows": {}}
    if record["toy"] != args.toy:
        raise ValueError(f"{file}: toy: found {record['toy']}, expected {args.toy}: choose another folder")
    return record


def keep(args: Args, part: str, name: str, row: dict[str, Any]) -> None:
    """Write a row to the file of its part."""
    record = stored(args, part)
    whole = {**record, "rows": {**record["rows"], name: row}}
    atomic_write(args.out / f"{part}.json", compact_json(whole) + "\n")


def in_process(args: Args, part: str, name: str, measure: Callable[[Args], dict[str, Any]], log: Path) -> None:
    """Measure a row and keep it, in a process of its own, whose output goes to a log."""
    end_with_parent()
    with log.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    jax.config.update("jax_compilation_cache_dir", str(args.out.absolute() / "work" / "programs"))
    if args.toy:  # Compilation takes most of the time.
        jax.config.update("jax_disable_most_optimizations", True)
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"
    began = time.monotonic()
    row = measure(args)
    row |= {"peak_memory_gib": peak_memory_gib(), "seconds": round(time.monotonic() - began, 1)}
    keep(args, part, name, row | hardware())


def run_row(args: Args, part: str, name: str, row: Row) -> dict[str, Any]:
    """Run a row in a process of its own, at most for its limit; returns what is kept."""
    log = args.out / "work" / f"{part}_{re.sub('[^a-z0-9]+', '_', name.lower())}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    log.write_bytes(b"")
    given = args, part, name, row.measure, log
    process = multiprocessing.get_context("spawn").Process(target=in_process, args=given)
    process.start()
    try:
        process.join(row.limit_s)
        late = process.is_alive()
    finally:
        for end in (process.terminate, process.kill):
            if process.is_alive():
                end()
                process.join(_GRACE_S)
    if process.exitcode:  # a row that ended just after its limit has none
        said = log.read_text(encoding="utf-8", errors="replace").split("\n")
        last = next((line for line in reversed(said) if line.strip()), "nothing said")
        reason = f"not finished after {row.limit_s} s" if late else f"exit code {process.exitcode}: {last[-300:]}"
        keep(args, part, name, {"failed": reason})
    return stored(args, part)["rows"][name]


def measure(args: Args) -> None:
    """Measure the rows that are not in the files yet, as long as there is time."""
    longest = 2 * _GRACE_S + max(row.limit_s for part in args.parts or PARTS for row in PARTS[part].values())
    if args.limit_s < longest:
        raise ValueError(f"--limit-s: got {args.limit_s:g}, expected at least {longest}, for the longest row")
    began, todo, left, failed = time.monotonic(), [], [], []
    factor = 3 if args.toy else 1
    for part in args.parts or PARTS:
        rows = stored(args, part)["rows"]
        for name, row in PARTS[part].items():
            if name in rows and not {"failed", "missing"} & rows[name].keys():
                print(f"{part}, {name}: already in {args.out / part}.json", flush=True)
            else:
                todo.append((name in rows, part, name, row))
    for _, part, name, row in sorted(todo, key=lambda one: one[0]):
        row = row._replace(limit_s=factor * row.limit_s)
        if time.monotonic() - began + row.limit_s + 2 * _GRACE_S > factor * args.limit_s:
            left.append(f"{part}, {name}")
            continue
        record = run_row(args, part, name, row)
        print(f"{part}, {name}: {json.dumps(record)}", flush=True)
        failed += [f"{part}, {name}"] * ("failed" in record)
    if left:
        print(f"left, for the same command: {'; '.join(left)}", flush=True)
    if failed:
        raise ValueError(f"failed: {'; '.join(failed)}: see {args.out / 'work'}")


if __name__ == "__main__":
    run_script(measure, Args, __doc__)

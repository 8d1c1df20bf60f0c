"""Several processes: the options, and two processes on this machine that train and evaluate together."""

import functools
import json
import re
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import jax
import pytest
from commands import command, free_port
from forked import Forked, signal_at
from linear_network import linear_network, use
from tiny_run import CONFIG, NETWORK_OPTIONS, SENSOR, STEPS, untrained

from fcos_lidar_jax.checkpoints import Checkpoint, save_checkpoint
from fcos_lidar_jax.cli.processes import ProcessOptions, join_processes
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.training.metrics_log import read_metrics

pytestmark = pytest.mark.slow

SRUN = {
    "SLURM_JOB_ID": "7",
    "SLURM_STEP_NODELIST": "localhost",
    "SLURM_NTASKS": "2",
    "SLURM_STEP_NUM_NODES": "1",
    "SLURM_STEP_TASKS_PER_NODE": "2",
}
BY_HAND = ProcessOptions(coordinator="10.0.0.1:12345", num_processes=2, process_index=1)
BY_ADDRESS = ProcessOptions(coordinator="[::1]:65535", num_processes=1, process_index=0)
BY_LAUNCHER = ProcessOptions(distributed=True)


@pytest.mark.parametrize(
    ("options", "variables", "place", "ids"),
    [
        (BY_LAUNCHER, {"SLURM_STEP_TASKS_PER_NODE": "1(x2)"}, (None, None, None), ()),
        (BY_HAND, {}, ("10.0.0.1:12345", 2, 1), None),
        (BY_ADDRESS, {}, ("[::1]:65535", 1, 0), None),
    ],
)
def test_passes_the_process_and_its_gpus_to_jax(options, variables, place, ids, monkeypatch):
    monkeypatch.setattr(jax.distributed, "initialize", initialize := Mock())
    launched = SRUN | {"SLURM_PROCID": "1", "SLURM_LOCALID": "0"}
    join_processes(options, launched | variables if variables else {})
    initialize.assert_called_once_with(*place, local_device_ids=ids)


@pytest.mark.parametrize(
    ("options", "error", "line"),
    [
        (BY_HAND, RuntimeError("late"), "10.0.0.1:12345: the processes did not connect: late"),
        (BY_HAND, ValueError("bad"), "10.0.0.1:12345: this process cannot join: bad"),
        (
            BY_LAUNCHER,
            ValueError("bad"),
            "--distributed: this process cannot join: bad; expected Slurm, Open MPI, a TPU pod, or --coord.*",
        ),
    ],
)
def test_a_failed_connection_is_one_line(monkeypatch, options, error, line):
    monkeypatch.setattr(jax.distributed, "initialize", Mock(side_effect=error))
    with pytest.raises((OSError, ValueError), match=f"^{line}$"):
        join_processes(options, {})


@pytest.mark.parametrize("place", ["localhost", ":1", "localhost:x", "localhost:0", "localhost:65536"])
def test_a_coordinator_has_a_host_and_a_port(place):
    options = ProcessOptions(coordinator=place, num_processes=1, process_index=0)
    with pytest.raises(ValueError, match=re.escape(f"--coordinator: got {place!r}, expected HOST:PORT")):
        join_processes(options)


def start_two(how: str, *args: list[str], before: tuple[Callable[[], object], ...] = (int, int)) -> list[Forked]:
    """Start the command as two processes, each with its own arguments, connected by ``how``.

    Each process calls its function of ``before`` first.
    """
    port = free_port()

    def one(index: int) -> Forked:
        if how == "coordinator":
            place = ["--coordinator", f"localhost:{port}", "--num-processes", "2", "--process-index", str(index)]
            return Forked([*args[index], *place], before[index])
        own = {"SLURM_PROCID": str(index), "SLURM_LOCALID": str(index), "JAX_COORDINATOR_PORT": port}
        return Forked([*args[index], "--distributed"], before[index], **SRUN, **own)

    return [one(index) for index in range(2)]


def linear(root: Path) -> list[str]:
    """The checkpoint of the network of one layer, for tests that compare no boxes; processes call ``use``."""
    return ["--checkpoint", str(root.parent / "linear")]


def ended(processes: list[Forked]) -> list[tuple[int, str, str]]:
    """Wait for the end; returns exit codes and output."""
    try:
        return [process.end() for process in processes]
    finally:
        for process in processes:
            process.kill()


def evaluate(data: Path, out: Path, *more: str) -> list[str]:
    """The command on the six keyframes of the split val."""
    where = ["--data-root", str(data), "--checkpoint", str(data.parent / "start"), "--out", str(out)]
    return ["evaluate", *where, "--no-report", *more]


def contents(out: Path) -> dict[str, str]:
    """Content of all files, without the time in the summary."""
    texts = {path.name: path.read_text() for path in out.iterdir() if path.name != ".lock"}
    return {name: re.sub(r'"eval_time": [^,]*', "", text) for name, text in texts.items()}


@pytest.fixture(scope="module")
def alone(root, tmp_path_factory) -> dict[str, str]:
    """The files of a single process."""
    out = tmp_path_factory.mktemp("alone")
    command(*evaluate(root, out))
    return contents(out)


@pytest.mark.parametrize("how", ["coordinator", "slurm"])
def test_two_processes_evaluate_as_one(root, alone, tmp_path, how):
    first, second = ended(start_two(how, *[evaluate(root, tmp_path / "both")] * 2))
    assert (first[0], second[0]) == (0, 0), first[2] + second[2]
    assert "mAP" in first[1]
    assert [line for line in second[1].splitlines() if not line.startswith("[Gloo]")] == []
    assert "frames 6/6" in first[2]
    assert "frames" not in second[2]
    assert contents(tmp_path / "both") == alone
    assert alone.keys() == {"metrics_summary.json", "curves.json", "results_nusc.json"}
    boxes = json.loads(alone["results_nusc.json"])["results"]
    assert len(boxes) == 6
    assert min(map(len, boxes.values())) > 0


def error_lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("fcos-lidar: error: ")]


def test_an_unreadable_cloud_ends_both_processes_and_keeps_finished_frames(root, alone, tmp_path):
    """The second process has its own data, in which its cloud of the third pair of frames is cut.

    The first pair is finished then, and the second not yet written.
    """
    other = shutil.copytree(root, tmp_path / "home" / "data")
    shutil.copytree(root.parent / "start", other.parent / "start")
    data = NuScenes(other, "v1.0-synthetic")
    (file,) = data.sweep_files(data.split("val")[5], 1)
    whole = file.read_bytes()
    file.write_bytes(whole[:-1])
    both = [evaluate(data, tmp_path / "both") for data in (root, other)]
    first, second = ended(start_two("coordinator", *both))
    assert (first[0], second[0]) == (1, 1)
    line = "fcos-lidar: error: process 1: cannot read its frames, see its output"
    assert error_lines(first[2]) == [line]
    (line,) = error_lines(second[2])
    assert f"{file}: got {len(whole) - 1} bytes" in line
    assert {path.name for path in (tmp_path / "both").iterdir()} == {".results_nusc.json.resume_log", ".lock"}
    file.write_bytes(whole)
    first, second = ended(start_two("coordinator", *both))
    assert (first[0], second[0]) == (0, 0), first[2] + second[2]
    assert "frames 2/6" in first[2]
    assert contents(tmp_path / "both") == alone


def test_processes_with_different_detectors_are_refused(root, tmp_path):
    other = tmp_path / "other"
    with linear_network():
        changed = jax.tree.map(lambda leaf: leaf + 1, untrained(CONFIG, SENSOR))
        save_checkpoint(other, Checkpoint(CONFIG, SENSOR, changed, 1))
    both = [evaluate(root, tmp_path / "both", *which) for which in (linear(root), ["--checkpoint", str(other)])]
    line = "process 1: versions, detector, frames or batch size: different from process 0, expected the same"
    for code, _, errors in ended(start_two("coordinator", *both, before=(use, use))):
        assert (code, error_lines(errors)) == (1, [f"fcos-lidar: error: {line}"])


def use_and_signal_at(*where: object) -> None:
    use()
    signal_at(*where)


def test_sigterm_to_one_process_stops_all_after_the_same_frames(root, tmp_path):
    frames = ["--format", "simulated", "--samples", "0:400", "--no-report"]
    args = ["evaluate", *frames, *linear(root), "--out", str(tmp_path / "all")]
    stop = functools.partial(
        use_and_signal_at, f"{SimulatedFrames.__module__}.SimulatedFrames.frame", signal.SIGTERM, 40
    )
    for code, _, errors in ended(start_two("coordinator", args, args, before=(use, stop))):
        assert (code, error_lines(errors)) == (143, []), errors
    done = (tmp_path / "all" / ".detections.json.resume_log").read_bytes().count(b"\n") - 1
    assert 0 < done < 400


def test_sigterm_ends_the_scoring_too(root, tmp_path):
    stop = functools.partial(use_and_signal_at, "fcos_lidar_jax.evaluation.summary.bootstrap", signal.SIGTERM)
    args = evaluate(root, tmp_path / "alone", *linear(root), "--bootstrap", "9")
    place = ["--coordinator", f"localhost:{free_port()}", "--num-processes=1", "--process-index=0"]
    code, _, errors = Forked([*args, *place], stop).end()
    assert (code, error_lines(errors)) == (143, []), errors
    assert (tmp_path / "alone" / "results_nusc.json").exists()
    assert not (tmp_path / "alone" / "bootstrap.json").exists()


def train(data: Path, out: Path) -> list[str]:
    """Four steps of batches of two with objects cut from these frames, and an evaluation at the end."""
    where = ["--data-root", str(data), "--out", str(out), "--weights", str(data.parent / "linear")]
    sensor = ["--sensor", str(data.parent / "sensor.json"), "--max-points", "1024", "--samples", "0:6"]
    often = ["--steps", str(STEPS), "--save-every", str(STEPS), "--evaluate-every", str(STEPS)]
    return ["train", "quickstart", *where, *sensor, *NETWORK_OPTIONS, *often]


def test_data_that_one_process_cannot_open_end_both(root, tmp_path):
    both = [train(root, tmp_path / "run"), [*train(root, tmp_path / "run"), "--data-root", str(tmp_path / "gone")]]
    first, second = ended(start_two("coordinator", *both))
    assert (first[0], second[0]) == (1, 1)
    assert error_lines(first[2]) == ["fcos-lidar: error: process 1: cannot train, see its output"]
    assert "gone: no such folder" in error_lines(second[2])[0]
    assert list(tmp_path.iterdir()) == []


_NOT_SHARED = {"seconds", "waiting_seconds", "samples_per_second"}
_NOT_SHARED |= {"pasted_objects", "truncated_points", "truncated_boxes", "invalid_points"}  # per process


def use_two_devices() -> None:
    use()
    jax.config.update("jax_num_cpu_devices", 2)
    assert jax.device_count() == 2


def test_two_processes_train_like_one_with_two_devices(root, tmp_path):
    """With the linear network; ``tests/equivalence`` compares the gradients of the whole network."""
    code, _, errors = Forked(train(root, tmp_path / "alone"), use_two_devices).end()
    assert code == 0, errors
    first, second = ended(start_two("coordinator", *[train(root, tmp_path / "run")] * 2, before=(use, use)))
    assert (first[0], second[0]) == (0, 0), first[2] + second[2]
    metrics = read_metrics(tmp_path / "run")
    assert len(metrics) == STEPS + 1
    assert (tmp_path / "run" / "objects" / "manifest.json").is_file()
    for line, expected in zip(metrics, read_metrics(tmp_path / "alone"), strict=True):
        assert line.keys() == expected.keys()
        for name in line.keys() - _NOT_SHARED:
            assert line[name] == pytest.approx(expected[name], rel=1e-4), name

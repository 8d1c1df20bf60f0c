"""``fcos-lidar train`` on a small simulated data set, and one line per mistake."""

import dataclasses
import functools
import hashlib
import json
import signal
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import assert_one_line_error, command, free_port, in_use, mistakes, wait_until
from forked import Forked
from linear_network import use
from tiny_run import NETWORK_OPTIONS, STEPS

from fcos_lidar_jax import cli
from fcos_lidar_jax.checkpoints import load_checkpoint
from fcos_lidar_jax.config import RefinementConfig
from fcos_lidar_jax.input_pipeline import database
from fcos_lidar_jax.training import run
from fcos_lidar_jax.training.metrics_log import read_metrics

VERSION = "v1.0-synthetic"
MANY = 20_000  # steps of runs that are stopped


def train(root: Path, out: Path, *more: str) -> list[str]:
    where = ["--data-root", str(root), "--version", VERSION, "--out", str(out)]
    sensor = ["--sensor", str(root.parent / "sensor.json"), "--max-points", "1024"]
    often = ["--steps", str(STEPS), "--save-every", "1"]
    tests = [] if "none" in more else ["--evaluate-every", "4", "--val-samples", "0:1"]
    return ["train", "quickstart", *where, *sensor, *NETWORK_OPTIONS, *often, *tests, *more]


@pytest.mark.slow
@pytest.mark.usefixtures("linear")
def test_trains_evaluates_and_prints_the_best_checkpoint(root, tmp_path, capsys):
    start, out = root.parent / "linear", tmp_path / "run"
    options = ["--samples", "1:2", "--copy-paste.min-points", "3", "--second-look", "on"]
    command(*train(root, out, "--weights", str(start), *options))
    record = json.loads(capsys.readouterr().out)
    last = str(out / "checkpoints" / "00000004")
    assert record == {"run": str(out), "steps": STEPS, "checkpoint": last, "best": last}
    spec = json.loads((out / "run.json").read_text())
    assert (spec["weights"], spec["frames"], spec["steps"]) == (str(start), 1, STEPS)
    assert spec["config"]["refinement"] == json.loads(json.dumps(dataclasses.asdict(RefinementConfig())))
    lines = read_metrics(out)
    assert [line["step"] for line in lines if "test/mAP" in line] == [4]
    # Objects come only from the selected keyframes.
    manifest = json.loads((out / "objects" / "manifest.json").read_text())
    assert ([shard["name"] for shard in manifest["shards"]], manifest["min_points"]) == (["scene-0001"], 3)
    # Training started at the given weights: a step of AdamW moves a weight by the learning rate at most.
    trained = load_checkpoint(record["checkpoint"]).variables["params"]
    own = {name: part for name, part in trained.items() if name != "refinement"}
    given = load_checkpoint(start).variables["params"]
    moved = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), own, given)
    reach = 1.1 * sum(line["learning_rate"] for line in lines if "learning_rate" in line)
    assert 0 < max(jax.tree.leaves(moved)) < reach
    cloud = next((root / "samples" / "LIDAR_TOP").iterdir())
    command("detect", cloud, "--checkpoint", out, "--out", tmp_path / "boxes.json")


@pytest.fixture
def child():
    """``child(args)`` starts the command, with the linear network, as a process."""
    started = []

    def start(args: list[str]) -> Forked:
        started.append(Forked(args, use))
        return started[-1]

    yield start
    for process in started:
        process.kill()


def checkpoints(out: Path) -> list[str]:
    return sorted(path.name for path in (out / "checkpoints").glob("*"))


def wait_for_a_step(process: Forked, out: Path, beyond: int = 0) -> None:
    """Wait until the run has done more steps, or has ended."""
    metrics = out / "metrics.jsonl"
    wait_until(lambda: process.poll() is not None or (metrics.exists() and len(read_metrics(out)) > beyond))


def long(root: Path) -> list[str]:
    """Options of a run that the test stops."""
    steps = ["--steps", str(MANY), "--save-every", str(MANY), "--val-split", "none"]
    return ["--weights", str(root.parent / "linear"), "--no-copy-paste", *steps]


def stop(process: Forked, number: int, out: Path, beyond: int = 0) -> tuple[int, str, int]:
    """Send a signal after one more step; returns the exit code, the messages and the total steps."""
    wait_for_a_step(process, out, beyond)
    process.send_signal(number)
    code, _, errors = process.end()
    return code, errors, len(read_metrics(out))


@pytest.mark.slow
def test_signals_save_a_checkpoint_and_resume_continues(root, tmp_path, child):
    """tests/training/test_run.py compares the result of a resumed run."""
    out = tmp_path / "run"
    code, errors, stopped_at = stop(child(train(root, out, *long(root))), signal.SIGINT, out)
    resumed = child(train(root, out, *long(root), "--auto-resume"))
    resumed_code, resumed_errors, end = stop(resumed, signal.SIGTERM, out, stopped_at)
    assert (code, resumed_code) == (130, 143), errors + resumed_errors
    assert "no run to resume" not in resumed_errors
    stopping = "\nstopping after this step or evaluation, which is saved"
    assert f"{stopping}; press Ctrl-C again to stop now, without saving\n" in errors
    assert f"{stopping}\n" in resumed_errors
    assert f"stopped after step {stopped_at}, which is saved\nthe same command with --resume continues\n" in errors
    assert f"after step {end}, which is saved\nthe same command continues\n" in resumed_errors
    assert "Traceback" not in errors + resumed_errors
    assert 0 < stopped_at < end < MANY
    assert checkpoints(out) == [f"{step:08d}" for step in (stopped_at, end)]
    # No step was repeated or left out.
    assert [line["step"] for line in read_metrics(out)] == list(range(1, end + 1))


def compile_for_minutes(begun: Path) -> None:
    """Let the first call of the training step stay in C code, like a compilation."""

    def step(state, batch):
        begun.touch()
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)

    use()
    run.jit_step = lambda *_: step


def test_a_signal_during_the_compilation_ends_the_run_within_seconds(root, tmp_path):
    begun, out = tmp_path / "begun", tmp_path / "run"
    process = Forked(train(root, out, *long(root)), functools.partial(compile_for_minutes, begun))
    wait_until(lambda: process.poll() is not None or begun.exists())
    process.send_signal(signal.SIGINT)
    code, _, errors = process.end(timeout_s=10)
    assert code == 128 + signal.SIGINT, errors
    assert "Traceback" not in errors
    assert checkpoints(out) == []


@pytest.mark.slow
def test_a_signal_to_one_process_stops_both_after_the_same_step(root, tmp_path, child):
    """tests/cli/test_processes.py compares their steps with a single process."""
    cluster = ["--coordinator", f"localhost:{free_port()}", "--num-processes", "2"]
    out = tmp_path / "run"
    both = [child(train(root, out, *long(root), *cluster, "--process-index", str(i))) for i in range(2)]
    wait_for_a_step(both[0], out)
    both[1].send_signal(signal.SIGTERM)
    for process in both:
        code, _, errors = process.end()
        assert code == 143, errors
        assert "Traceback" not in errors
    steps = len(read_metrics(out))
    assert 0 < steps < MANY
    assert checkpoints(out) == [f"{steps:08d}"]


BAD = mistakes(r"""
--keep 0 => keep: got 0
--train-split other => split 'other': not found
--val-split other => split 'other': not found
--samples 1 => --samples: got '1', expected FIRST:LAST with FIRST < LAST within the 6 frames, without overlap$
--samples 0:2,1:2 => --samples: got '1:2', expected
--samples 0:99999999999999999999 => --samples: got '0:99999999999999999999', expected
--val-samples 2:2 => --val-samples: got '2:2', expected
--val-split none --evaluate-every 4 => --evaluate-every: got 4, expected frames to evaluate on
--val-split none --val-samples 0:1 => --val-samples: got '0:1', expected frames to evaluate on
--optimizer.accumulate 3 => --optimizer.accumulate: got 3, expected a divisor of the batch size 2$
--model.stem.channels-per-type 0 => --model.stem.channels-per-type: got 0, expected at least 1$
--num-sweeps 2 => num_sweeps: got 2, expected at most the 1 of .*/train: run fcos-lidar prepare --num-sweeps 2$
--train-split val => objects/val: no objects here, .* prepare --train-split val
""")


@pytest.mark.parametrize(("line", "message"), BAD)
def test_mistakes_get_one_line_and_leave_nothing(root, tmp_path, capsys, line, message):
    args = line.replace("HOME", str(root.parent)).split()
    assert_one_line_error(capsys, train(root, tmp_path / "out", *args), message)
    assert list(tmp_path.iterdir()) == []


def test_objects_of_more_sweeps_are_taken(root, tmp_path, monkeypatch, capsys):
    where = ["--data-root", root, "--version", VERSION, "--index", tmp_path / "index"]
    command("prepare --num-sweeps 3", *where)
    given = []
    monkeypatch.setattr("fcos_lidar_jax.cli.train.train", lambda *_, objects, **__: given.append(objects) or 1 / 0)
    args = train(root, tmp_path / "out", "--index", str(tmp_path / "index"), "--val-split", "none")
    cli.main(args)
    assert given[0].manifest.num_sweeps == 3
    (tmp_path / "map.json").write_text('{"car": "truck"}')
    renamed = [*args, "--class-map", str(tmp_path / "map.json")]
    assert_one_line_error(capsys, renamed, "cut from other frames than split 'train', .* as --class-map or --full")


@pytest.mark.slow
@pytest.mark.usefixtures("linear")
def test_a_refused_resume_leaves_the_objects_of_the_run(root, tmp_path, capsys):
    out = tmp_path / "run"
    command(*train(root, out, "--samples", "0:1", "--val-split", "none"))
    before = {path: path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}
    for more, field in (
        (["--samples", "0:2"], "objects: was "),
        (["--copy-paste.min-points", "3"], "config.copy_p"),
    ):
        args = train(root, out, "--resume", "--val-split", "none", "--samples", "0:1", *more)
        assert_one_line_error(capsys, args, f"run.json: {field}.*: only the same run can be resumed")
    assert {path: path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()} == before


def test_a_folder_in_use_is_left_alone(root, tmp_path, capsys):
    """Even before objects of --samples are cut, which happens in the run's folder."""
    with in_use(tmp_path / "run"):
        assert_one_line_error(capsys, train(root, tmp_path / "run", "--samples", "0:1"), "run: in use: process ")
        assert [path.name for path in (tmp_path / "run").iterdir()] == [".lock"]


def test_ctrl_c_while_objects_are_cut_leaves_the_folder_to_the_same_command(root, tmp_path, capsys, monkeypatch):
    prepare_database, out = database.prepare_database, tmp_path / "run"

    def interrupted(frames, folder, **options):
        prepare_database(frames, folder, **options)
        with pytest.raises(BlockingIOError, match=r"run: in use: process .* is training"), in_use(out):
            pass
        raise KeyboardInterrupt

    monkeypatch.setattr(database, "prepare_database", interrupted)
    args = train(root, out, "--samples", "0:1", "--val-split", "none")
    assert cli.main(args) == 130
    assert {path.name for path in out.iterdir()} == {".lock", "objects"}
    monkeypatch.setattr(database, "prepare_database", prepare_database)
    monkeypatch.setattr("fcos_lidar_jax.cli.train.train", lambda *_, objects, **__: print(len(objects)) or 1 / 0)
    capsys.readouterr()
    assert cli.main(args) == 1
    assert int(capsys.readouterr().out) > 0

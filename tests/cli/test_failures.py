"""Every failure ends in one line and an exit code: expected failures, bugs, signals, closed pipes."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import child_environment, run_python
from refusal import refused

import fcos_lidar_jax as fcos
from fcos_lidar_jax.cli import exit_code
from fcos_lidar_jax.cli.commands import _COMMANDS
from fcos_lidar_jax.data.point_files import read_points
from fcos_lidar_jax.files import folder_lock, local_path
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames


def fail_with(error):
    def work():
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ValueError("a.npy: two\n  lines"), "a.npy: two lines"),
        (FileNotFoundError(2, "No such file", "a"), "[Errno 2] No such file: 'a'"),
        (OverflowError(), "OverflowError without a message"),
        (RecursionError("maximum recursion depth"), "nested too deeply: expected a file or an option with fewer"),
        (MemoryError(), "out of memory: for training, --optimizer.accumulate"),
        (RuntimeError("RESOURCE_EXHAUSTED: 8 GiB"), "out of memory: for training, --optimizer.accumulate"),
        (
            RuntimeError("UNKNOWN: Gloo AllGather failed: Read error"),
            "another process ended, or the connection to it",
        ),
        (ValueError("x" * 120_000), "x" * 900),
    ],
)
def test_an_expected_failure_is_one_line(capsys, error, message):
    assert exit_code("program", fail_with(error)) == 1
    printed = capsys.readouterr()
    assert printed.err.startswith("program: error: ")
    assert message in printed.err
    assert (printed.err.count("\n"), printed.out) == (1, "")
    assert len(printed.err) < 1100


def test_a_bug_is_one_line_that_names_its_report(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert exit_code("program", fail_with(KeyError("lost"))) == 1
    (report,) = tmp_path.iterdir()
    line = f"unexpected KeyError: 'lost': this is a bug, please attach the full report {report} to an issue"
    assert capsys.readouterr().err == f"program: error: {line}\n"
    text = report.read_text()
    assert "Traceback (most recent call last)" in text
    assert "arguments: [" in text
    assert f"jax {__import__('jax').__version__}" in text


PLATFORM = "expected a platform of this machine, or, for NVIDIA GPUs, pip install -U"


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("JAX_PLATFORMS", "cuda", AssertionError()),
        ("JAX_PLATFORMS", "x", RuntimeError("Unable to initialize backend 'x'")),
        ("JAX_PLATFORM_NAME", "gpu", RuntimeError("Unknown backend: 'gpu' requested")),
    ],
)
def test_a_platform_that_jax_lacks_is_no_bug(capsys, monkeypatch, name, value, error):
    for each in ("JAX_PLATFORMS", "JAX_PLATFORM_NAME"):
        monkeypatch.delenv(each, raising=False)
    monkeypatch.setenv(name, value)
    monkeypatch.setattr("jax.devices", fail_with(AssertionError()))
    assert exit_code("program", fail_with(error)) == 1
    assert capsys.readouterr().err.startswith(f"program: error: {name}: got {value!r}, {PLATFORM}")


@pytest.mark.slow
def test_an_unusable_environment_is_one_line(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((9, 4)))
    words = ["project", tmp_path / "a.npy", "--out", tmp_path / "a.npz"]
    done = run_python("-m", "fcos_lidar_jax", *words, JAX_PLATFORMS="cuda", CUDA_VISIBLE_DEVICES="")
    assert done.returncode == 1
    assert done.stderr.startswith(f"fcos-lidar: error: JAX_PLATFORMS: got 'cuda', {PLATFORM}")
    assert done.stderr.count("\n") == 1


TERMINATED = """
import os, signal, sys, time
from pathlib import Path
from fcos_lidar_jax.cli import exit_code
from fcos_lidar_jax.files import atomic_write
def write(path):
    path.write_text("half")
    (other := path.with_name("other")).touch()
    try:
        os.kill(os.getpid(), int(sys.argv[2]))
        time.sleep(60)
    finally:
        os.kill(os.getpid(), int(sys.argv[2]))  # `timeout` sends it twice
        other.unlink()
sys.exit(exit_code("program", lambda: atomic_write(Path(sys.argv[1]), write)))
"""


INTERRUPTED = {signal.SIGINT: "program: interrupted\n"}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_no_temporary_file(tmp_path, number):
    done = run_python("-c", TERMINATED, tmp_path / "a.json", int(number))
    assert (done.returncode, done.stderr) == (128 + number, INTERRUPTED.get(number, ""))
    assert list(tmp_path.iterdir()) == []


BLOCKED = """
import contextlib, hashlib, sys, types
from fcos_lidar_jax import cli
from fcos_lidar_jax.checkpoints.preemption import stop_requests
from fcos_lidar_jax.cli import signals
signals._BLOCKED_S = 0.1
signals.time = types.SimpleNamespace(monotonic=iter([7.0, 8.9, 9.1]).__next__)
def work():
    with stop_requests("saving") if sys.argv[1] == "saves" else contextlib.nullcontext():
        print("working", flush=True)
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # minutes without any Python
sys.exit(cli.exit_code("program", work))
"""


@pytest.mark.parametrize(
    ("work", "times", "number"), [("compiles", 1, signal.SIGTERM), ("saves", 3, signal.SIGINT)]
)
def test_signals_end_the_process_while_c_code_blocks_the_main_thread(work, times, number):
    """The first one, or while a run is to be saved, the second; `timeout` sends the same one twice at once."""
    words = [sys.executable, "-c", BLOCKED, work]
    with subprocess.Popen(words, env=child_environment(), stdout=-1, stderr=-1, text=True) as process:
        try:
            assert process.stdout.readline() == "working\n"
            for sent in range(times):
                process.send_signal(number)
                if work == "saves" and sent == 0:
                    assert process.stderr.readline() == "saving; press Ctrl-C again to stop now, without saving\n"
                elif sent < times - 1:
                    with pytest.raises(subprocess.TimeoutExpired):
                        process.wait(0.5)
            assert process.wait(60) == 128 + number
        finally:
            process.kill()
        assert process.stderr.read() == INTERRUPTED.get(number, "")


ALL = """
import json, sys
from fcos_lidar_jax.cli import main
def code(words):
    try:
        return main(words)
    except SystemExit as leaving:
        return leaving.code or 0
codes = [code(words) for words in json.loads(sys.argv[1])]
print(json.dumps(codes))
"""
C_LOCALE = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}


@pytest.mark.slow
def test_helps_and_errors_are_shown_on_a_terminal_without_unicode():
    helps = [[*words, "--help"] for words in ([], *([name] for name in _COMMANDS))]
    done = run_python("-c", ALL, json.dumps([*helps, ["detect", "--grösse"], ["project", "grösse"]]), **C_LOCALE)
    assert json.loads(done.stdout.splitlines()[-1]) == [0] * len(helps) + [2, 2], done.stderr
    assert "? quickstart " in done.stdout
    assert "--gr" in done.stdout + done.stderr


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_closed_output_pipe_ends_in_silence(unbuffered):
    read, write = os.pipe()
    os.close(read)
    words = [sys.executable, "-c", "from fcos_lidar_jax.cli import main; raise SystemExit(main(['--version']))"]
    streams = {"stdout": write, "stderr": subprocess.PIPE, "text": True}
    environment = child_environment(PYTHONUNBUFFERED=unbuffered)
    done = subprocess.run(words, env=environment, check=False, **streams)
    os.close(write)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "")


@pytest.mark.parametrize("work", ["lambda: print('text')", "lambda: sys.exit(0)"])
def test_an_output_on_a_full_disk_is_one_line(tmp_path, work):
    script = tmp_path / "script.py"
    script.write_text(
        "import os, sys\nfrom fcos_lidar_jax.cli import exit_code\n"
        f"print('before')\nsys.exit(exit_code('program', {work}))\n"
    )
    environment = child_environment()
    environment.pop("PYTHONUNBUFFERED", None)
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, script], env=environment, stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    line = "program: error: standard output: cannot be written: No space left on device\n"
    assert (done.returncode, done.stderr) == (1, line)


@pytest.mark.parametrize("closed", [("stdout",), ("stderr",), ("stdout", "stderr")])
def test_closed_outputs_are_left_out(monkeypatch, capsys, closed):
    for name in closed:  # Python gives a process without a descriptor None
        monkeypatch.setattr(sys, name, None)
    assert exit_code("program", lambda: print("text")) == 0
    assert exit_code("program", fail_with(ValueError("message"))) == 1
    if "stderr" in closed:
        sys.stderr.close()
    printed = capsys.readouterr()
    assert printed.out == ("" if "stdout" in closed else "text\n")
    assert ("message" in printed.err) == ("stderr" not in closed)


URL_HINT = "got a URL, expected a path: copy the files (gsutil, aws s3) or mount the bucket (gcsfuse)"


FRONT_DOORS = {
    "train": lambda url: fcos.train(QUICKSTART, SimulatedFrames(TINY, 2), url, steps=1),
    "load_detector": lambda url: fcos.load_detector(url),
    "open_frames": lambda url: fcos.open_frames(url),
    "read_points": lambda url: read_points(f"{url}/a.bin", TINY),
    "folder_lock": lambda url: folder_lock(Path(url), "training").__enter__(),
}


@pytest.mark.parametrize("door", FRONT_DOORS)
def test_a_url_is_refused_by_every_function(door, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with refused("s3://b/run", URL_HINT):
        FRONT_DOORS[door]("s3://b/run")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_a_colon_is_no_url(tmp_path):
    for name in ("2026-11-25T10:00", "a:b/c", "c:/d"):
        assert local_path(name) == Path(name)
    assert local_path(tmp_path / "gs:" / "b") == tmp_path / "gs:" / "b"

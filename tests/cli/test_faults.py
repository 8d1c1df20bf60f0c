"""Commands that are killed, or meet a full disk or a read-only folder. Tests of single commands ask more."""

import hashlib
import json

import pytest
from commands import command, run_python

VERSION = "v1.0-synthetic"
SYNTHESIZE = ["synthesize", "--scenes", "2", "--keyframes", "3", "--sensor", "short_range"]
HELPERS = """
import ctypes, os, resource, signal, sys, time
from pathlib import Path
from fcos_lidar_jax.cli import commands, main

def give_up_privileges():  # file permissions do not restrict root
    if not os.geteuid():
        header, none = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
        assert not ctypes.CDLL(None).capset(header, none)
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A simulated data set, and the files of an undisturbed evaluation on it."""
    folder = tmp_path_factory.mktemp("faults")
    folder.chmod(0o755)
    command(*SYNTHESIZE, "--out", folder / "data")
    command(*evaluate(folder), "--out", folder / "evaluated")
    return folder


def evaluate(home):
    data = ["--data-root", home / "data", "--version", VERSION, "--split", "train"]
    return ["evaluate", *data, "--checkpoint", "quickstart", "--no-report", "--batch-size", "1"]


def prepare(home):
    return ["prepare", "--data-root", home / "data", "--version", VERSION, "--train-split", "train"]


def contents(folder):
    """Checksums of all files except the lock, leaving out the time in the summary."""
    files = (file for file in folder.rglob("*") if file.is_file() and file.name != ".lock")
    content_of = {str(file.relative_to(folder)): file.read_bytes() for file in files}
    if "metrics_summary.json" in content_of:
        summary = json.loads(content_of["metrics_summary.json"])
        content_of["metrics_summary.json"] = json.dumps({**summary, "eval_time": 0}).encode()
    return {name: hashlib.blake2b(content).hexdigest() for name, content in content_of.items()}


def error_line(done):
    """The error of a command that failed."""
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("fcos-lidar: error: ")]
    return line


@pytest.mark.parametrize("name", ["synthesize", "prepare", "evaluate"])
def test_a_read_only_folder_is_named(home, tmp_path, name):
    words = {"synthesize": SYNTHESIZE, "prepare": prepare(home), "evaluate": evaluate(home)}[name]
    folder = tmp_path / "read_only"
    folder.mkdir(mode=0o555)
    code = f"{HELPERS}\ngive_up_privileges()\nsys.exit(main(sys.argv[1:]))"
    line = error_line(run_python("-c", code, *words, "--index" if name == "prepare" else "--out", folder))
    assert str(folder) in line
    assert list(folder.iterdir()) == []


def test_synthesize_resumes_after_a_full_disk(home, tmp_path):
    limit = "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))"
    code = f"{HELPERS}\n{limit}\nsys.exit(main(sys.argv[1:]))"
    error_line(run_python("-c", code, *SYNTHESIZE, "--out", tmp_path / "data"))
    command(*SYNTHESIZE, "--out", tmp_path / "data")
    assert contents(tmp_path / "data") == contents(home / "data")


KILLED = """
log = Path(sys.argv[-1], "results_nusc.resume_log")
for lines in (1, 3):  # frames that the resume log holds when the command is killed
    child = os.fork()
    if not child:
        os._exit(main(sys.argv[1:]))
    while not log.exists() or log.read_bytes().count(b"\\n") < lines:
        assert os.waitpid(child, os.WNOHANG) == (0, 0)
        time.sleep(0.001)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
"""


def test_a_killed_evaluation_resumes_to_the_same_files(home, tmp_path):
    out = tmp_path / "evaluated"
    done = run_python("-c", HELPERS + KILLED, *evaluate(home), "--out", out)
    assert done.returncode == 0, done.stderr
    assert not (out / "results_nusc.json").exists()
    command(*evaluate(home), "--out", out)
    assert contents(out) == contents(home / "evaluated")

"""Commands that are killed, or meet a full disk or a read-only folder. Tests of single commands ask more."""

import ctypes
import functools
import hashlib
import json
import os
import resource
import signal

import pytest
from commands import command
from forked import Forked, signal_at

from fcos_lidar_jax.evaluation.resume_log import ResumeLog

pytestmark = pytest.mark.slow

VERSION = "v1.0-synthetic"
SYNTHESIZE = ["synthesize", "--scenes", "2", "--keyframes", "3", "--sensor", "short_range"]


def give_up_privileges() -> None:
    """File permissions do not restrict root."""
    if not os.geteuid():
        header, none = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
        assert not ctypes.CDLL(None).capset(header, none)


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


def error_line(args, before):
    """The error of a command that fails after a preparation of its process."""
    code, _, errors = Forked(args, before).end()
    assert code == 1, errors
    assert "Traceback" not in errors
    (line,) = [line for line in errors.splitlines() if line.startswith("fcos-lidar: error: ")]
    return line


@pytest.mark.parametrize("name", ["synthesize", "prepare"])
def test_a_read_only_folder_is_named(home, tmp_path, name):
    words = {"synthesize": SYNTHESIZE, "prepare": prepare(home)}[name]
    folder = tmp_path / "read_only"
    folder.mkdir(mode=0o555)
    line = error_line([*words, "--index" if name == "prepare" else "--out", folder], give_up_privileges)
    assert str(folder) in line
    assert list(folder.iterdir()) == []


def test_synthesize_resumes_after_a_full_disk(home, tmp_path):
    limit = functools.partial(resource.setrlimit, resource.RLIMIT_FSIZE, (20_000, 20_000))
    error_line([*SYNTHESIZE, "--out", tmp_path / "data"], limit)
    command(*SYNTHESIZE, "--out", tmp_path / "data")
    assert contents(tmp_path / "data") == contents(home / "data")


def test_a_killed_evaluation_resumes_to_the_same_files(home, tmp_path):
    out = tmp_path / "evaluated"
    killed = functools.partial(signal_at, f"{ResumeLog.__module__}.ResumeLog.add", signal.SIGKILL, 2)
    for finished in (1, 2):  # frames in the log: each process adds one
        code, _, errors = Forked([*evaluate(home), "--out", out], killed).end()
        assert code == -signal.SIGKILL, errors
        assert len((out / ".results_nusc.json.resume_log").read_bytes().splitlines()) == 1 + finished
    assert not (out / "results_nusc.json").exists()
    command(*evaluate(home), "--out", out)
    assert contents(out) == contents(home / "evaluated")

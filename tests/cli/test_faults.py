"""Commands that meet a full disk or a read-only folder. Tests of single commands ask more."""

import ctypes
import functools
import os
import resource

import pytest
from commands import command, contents
from forked import Forked

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
    """A simulated data set."""
    folder = tmp_path_factory.mktemp("faults")
    folder.chmod(0o755)
    command(*SYNTHESIZE, "--out", folder / "data")
    return folder


def prepare(home):
    return ["prepare", "--data-root", home / "data", "--version", VERSION, "--train-split", "train"]


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

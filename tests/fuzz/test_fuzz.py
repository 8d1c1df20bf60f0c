"""Each reader refuses a damaged file in one line, or returns valid data.

``FUZZ_INPUTS=30000 pytest tests/fuzz -k kitti`` reads more files than usual.
"""

import contextlib
import os
import resource
import warnings
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import get_args

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fcos_lidar_jax.input_pipeline.open import Format

from .mutations import damaged
from .targets import TARGETS, InvalidError, Target, plain_name

INPUTS = int(os.environ.get("FUZZ_INPUTS", "40"))  # per reader
LONGEST_MESSAGE = 20_000  # characters, without the file's name: room for a few of the longest values
MEMORY = 1 << 29  # bytes of address space that a reader may add
FUZZ = settings(
    max_examples=INPUTS,
    deadline=timedelta(seconds=10),
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)


@contextlib.contextmanager
def limited_memory() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def is_accepted(target: Target, folder: Path, name: str) -> bool:
    """Whether the reader accepts its file; a refusal must be one short line that names the file."""
    where = str(folder / name if target.alone else folder)
    try:
        with limited_memory():
            target.read(folder, name)
    except ValueError as error:
        message = str(error)
        assert where in message, f"a message that does not name the file: {message[:500]}"
        assert message.splitlines() == [message], f"a message of several lines: {message[:500]}"
        longest = LONGEST_MESSAGE + message.count(where) * len(where)
        assert len(message) <= longest, f"a message that is too long: {message[:500]}"
        return False
    return True


def write(files: dict[str, bytes], folder: Path) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: plain_name(target.name))
def test_damaged_files_are_refused_in_one_line_or_give_valid_data(target, tmp_path):
    files, refused = dict(target.files()), 0
    names = [name for name in files if name.startswith(target.changed)]
    write(files, tmp_path)
    assert all(is_accepted(target, tmp_path, name) for name in names)

    @FUZZ
    @given(st.data(), st.sampled_from(names), st.booleans())
    def read(data, name, sealed):
        nonlocal refused
        content = data.draw((target.damaged or damaged)(name, files[name]))
        (tmp_path / name).write_bytes(content)
        if sealed and target.seal is not None:
            with contextlib.suppress(ValueError, RecursionError):  # no longer JSON
                target.seal(tmp_path, name)
        try:
            refused += not is_accepted(target, tmp_path, name)
        finally:
            write(files, tmp_path)

    read()
    # Logs skip damaged lines.
    assert bool(refused) == (target.name not in ("metrics.jsonl", "resume log"))


def test_every_format_has_a_target():
    assert set(get_args(Format)) - {plain_name(target.name) for target in TARGETS} == {"simulated"}


def raise_(error: Exception) -> None:
    raise error


@pytest.mark.parametrize(
    ("read", "problem"),
    [
        (lambda file: {}["key"], "key"),
        (lambda file: warnings.warn("hm", stacklevel=1), "hm"),
        (lambda file: raise_(ValueError("wrong")), "does not name the file"),
        (lambda file: raise_(ValueError(f"{file}: wrong\nindeed")), "of several lines"),
        (lambda file: raise_(ValueError(f"{file}: {'wrong' * 5000}")), "too long"),
        (lambda file: raise_(InvalidError("half a result")), "half a result"),
        (lambda file: bytearray(1 << 30), None),
    ],
)
def test_every_kind_of_failure_is_noticed(read, problem, tmp_path):
    target = Target("a", dict, lambda folder, name: read(folder / name), alone=True)
    with pytest.raises((AssertionError, KeyError, UserWarning, InvalidError, MemoryError), match=problem):
        is_accepted(target, tmp_path, "a.txt")

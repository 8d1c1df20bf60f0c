"""Every reader refuses a changed file by a ``ValueError`` of one line that names it, or returns valid data.

Valid files of every kind that is not trusted, and logs that a crash may cut, are changed according to their
structure. ``FUZZ_EXAMPLES=30000 python -m pytest tests/fuzz`` tries that many inputs of each kind.
"""

import os
import re
import resource
import signal
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import get_args

import pytest

from fcos_lidar_jax.input_pipeline.open import Format

from .mutators import mutate
from .targets import NAMES, Target, make_targets

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "60"))
MEMORY_MIB, SECONDS = 512, 10  # that one input may take
LONGEST_MESSAGE = 20_000  # characters, not counting the file's name: room for a few of the longest values


@pytest.fixture(scope="module")
def targets() -> dict[str, Target]:
    return {target.name: target for target in make_targets()}


@pytest.fixture
def limits() -> Iterator[None]:
    """Limits of memory, and of the time until the alarm, which each input sets anew."""

    def late(number, frame):
        raise TimeoutError

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGALRM, late)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (MEMORY_MIB << 20), hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


def write_files(target: Target, folder: Path) -> None:
    for name, content in target.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def is_accepted(target: Target, folder: Path, seed: int) -> bool:
    """Whether the reader accepts a changed file; a refusal must be one short line that names the file."""
    rng = Random(f"{target.name} {seed}")
    name = rng.choice(list(target.files))
    write_files(target, folder)
    (folder / name).write_bytes(mutate(name, target.files[name], rng))
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        target.read(folder, name)
    except ValueError as error:
        message, where = str(error), str(folder / name if target.alone else folder)
        assert where in message
        assert message.splitlines() == [message]
        assert len(message) <= LONGEST_MESSAGE + message.count(where) * len(where)
        return False
    return True


@pytest.mark.parametrize("name", NAMES)
def test_a_changed_file_is_refused_in_one_line_or_gives_valid_data(name, targets, tmp_path, limits):
    accepted = set()
    for seed in range(EXAMPLES):
        try:
            accepted.add(is_accepted(targets[name], tmp_path, seed))
        except BaseException as error:
            error.add_note(f"target {name!r}, seed {seed}")
            raise
    if name in ("metrics.jsonl", "resume log"):
        assert accepted == {True}  # they skip damaged lines
    else:
        assert False in accepted


def test_every_format_is_tried(targets):
    assert tuple(targets) == NAMES
    formats = {name.lower().replace(" ", "") for name in NAMES}
    assert set(get_args(Format)) - formats == {"simulated"}


def test_the_targets_accept_their_own_files(targets, tmp_path):
    for target in targets.values():
        write_files(target, folder := tmp_path / re.sub(r"\W", "_", target.name))
        for name in target.files:
            target.read(folder, name)

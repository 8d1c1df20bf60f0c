"""Run commands of ``fcos-lidar`` in this process and in others."""

import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import jax
import quick

from fcos_lidar_jax.cli import main
from fcos_lidar_jax.files import folder_lock


def command(*args: object) -> None:
    """Run a command that must succeed. Strings are split at spaces; other arguments are one word each."""
    assert main([word for arg in args for word in (arg.split() if isinstance(arg, str) else [str(arg)])]) == 0


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder, by relative path."""
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def cut(file: Path, size: int) -> None:
    """Leave only the first bytes of a file; a negative size counts from its end."""
    file.write_bytes(file.read_bytes()[:size])


def flip(file: Path, position: int) -> None:
    """Change one bit of a byte of a file."""
    content = bytearray(file.read_bytes())
    content[position] ^= 1
    file.write_bytes(content)


def free_port() -> str:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return str(free.getsockname()[1])


def wait_until(holds: Callable[[], object], seconds: float = 200) -> None:
    until = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < until
        time.sleep(0.01)


def page_content(path: Path) -> dict[str, Any]:
    """The data in a page of ``visualization/page.py``."""
    match = re.search(r'<script type="application/json" id="drive">(.*?)</script>', path.read_text(), re.DOTALL)
    assert match is not None
    return json.loads(match[1])


def mistakes(table: str) -> list[tuple[str, str]]:
    """Parameters of a test from lines ``arguments => pattern of the error message``."""
    rows = (line.partition("=> ") for line in table.strip("\n").splitlines())
    return [(arguments.strip(), message) for arguments, _, message in rows]


def assert_one_line_error(capsys, args: list[str], message: str) -> None:
    """Assert that the command fails with one line on standard error, which matches a pattern."""
    capsys.readouterr()
    assert main(args) == 1
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("fcos-lidar: error: ")]
    assert len(errors) == 1
    assert re.search(message, errors[0]), errors[0]


def in_use(folder: Path) -> AbstractContextManager[None]:
    """Lock a folder, which commands of this process find like those of another one."""
    return folder_lock(folder, "at work")


def run_python(*words: object, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run another Python process, which may fail."""
    command_line = [sys.executable, *map(str, words)]
    environment = child_environment(**variables)
    return subprocess.run(command_line, env=environment, capture_output=True, text=True, check=False)


def child_environment(**more: str) -> dict[str, str]:
    """Environment of a Python process that imports the tests' modules and shares their compilation cache."""
    shared = {
        "PYTHONPATH": os.pathsep.join(sys.path),
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return os.environ | quick.environment(quick.is_quick()) | shared | more

"""Commands of ``fcos-lidar``, in this process and in others."""

import os
import re
import subprocess
import sys

import jax

from fcos_lidar_jax.cli import main


def command(*args: object) -> None:
    """Run a command that must succeed; each argument a word, or several with spaces between."""
    assert main([word for arg in args for word in (arg.split() if isinstance(arg, str) else [str(arg)])]) == 0


def assert_one_line_error(capsys, args: list[str], message: str) -> None:
    """The command fails, and one line on standard error, which matches the pattern, says why."""
    capsys.readouterr()
    assert main(args) == 1
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("fcos-lidar: error: ")]
    assert len(errors) == 1
    assert re.search(message, errors[0]), errors[0]


def run_python(*words: object, **variables: str) -> subprocess.CompletedProcess[str]:
    """Another Python process, which may fail."""
    command_line = [sys.executable, *map(str, words)]
    environment = child_environment(**variables)
    return subprocess.run(command_line, env=environment, capture_output=True, text=True, check=False)


def child_environment(**more: str) -> dict[str, str]:
    """Of a Python process that finds the tests' modules, compiles as they do and shares their cache."""
    shared = {
        "PYTHONPATH": os.pathsep.join(sys.path),
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.5",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": str(int(jax.config.read("jax_disable_most_optimizations"))),
    }
    return os.environ | shared | more

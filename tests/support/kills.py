"""Kill a command at chosen changes of the file system, instead of at random times."""

from pathlib import Path

from commands import run_python

TRIALS = 5
_KILLED = f"""
import importlib, os, signal, sys
from fcos_lidar_jax.cli import main
option, out, *command = sys.argv[1:]
importlib.import_module("fcos_lidar_jax.cli." + command[0])
def killed_at(step, folder):
    # Ends the process without any cleaning up before its step-th change of the file system.
    steps = 0
    def hook(event, arguments):
        nonlocal steps
        changes = event in ("os.mkdir", "os.rename", "os.remove")
        if changes or event == "open" and isinstance(arguments[1], str) and set("wxa+") & set(arguments[1]):
            steps += 1
            if steps == step:
                os.kill(os.getpid(), signal.SIGKILL)
    child = os.fork()
    if not child:
        sys.addaudithook(hook)
        main([*command, option, folder])
        os.write(pipe[1], steps.to_bytes(4, "little"))
        os._exit(0)
    return os.waitpid(child, 0)[1]
pipe = os.pipe()
assert killed_at(0, f"{{out}}-whole") == 0
whole = int.from_bytes(os.read(pipe[0], 4), "little")
for trial in range({TRIALS}):
    step = whole * trial // {TRIALS}
    assert killed_at(1 + step, f"{{out}}-{{trial}}") == signal.SIGKILL
    killed_at(1 + (whole - step) // 2, f"{{out}}-{{trial}}")  # the resumed work, if that takes so many steps
"""


def killed_twice(out: Path, option: str, command: list[str]) -> list[Path]:
    """Run a command in folders ``OUT-0``, ``OUT-1`` ..., given by an option, and kill it in each of them.

    It is killed again if enough work is left. ``OUT-whole`` has the result of a run that is not killed.

    The kills are spread over the steps of the whole work, so that they hit all of its stages. The processes are
    forked after all imports.
    """
    done = run_python("-c", _KILLED, option, out, *command)
    assert done.returncode == 0, done.stderr
    return [out.with_name(f"{out.name}-{trial}") for trial in range(TRIALS)]

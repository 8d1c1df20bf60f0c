"""The cache of compiled programs, with which a command starts faster the second time."""

import contextlib
import hashlib
import os
import re
import warnings
from pathlib import Path
from typing import Any

import jax
import jaxlib

from fcos_lidar_jax.progress import tell

_MAX_BYTES = 2**30
_SETTINGS = {
    "jax_persistent_cache_min_compile_time_secs": 0.1,
    "jax_persistent_cache_enable_xla_caches": "none",  # XLA fails at damaged files of its own caches
}
_NOT_READ, _NOT_WRITTEN = (f"Error {verb} persistent compilation cache" for verb in ("reading", "writing"))
_CPUINFO = r"(vendor_id|cpu family|model|model name|stepping|flags|Features|CPU \w+)\s*:"


def use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache folder, unless JAX is configured to use another folder or none.

    JAX runs the code that it finds there. If others can write to the folder, one line says so, and there is no
    cache.
    """
    config: Any = jax.config
    if config.jax_compilation_cache_dir is not None or not config.jax_enable_compilation_cache:
        return
    try:
        folder = _make_folder()
        _remove_oldest(folder.parent)
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home
        tell(f"note: no compilation cache: {error}; JAX_COMPILATION_CACHE_DIR names another folder")
        return
    config.update("jax_compilation_cache_dir", str(folder))
    for name, value in _SETTINGS.items():
        if name.upper() not in os.environ:
            config.update(name, value)
    _remove_damaged(folder)


def _make_folder() -> Path:
    """The folder for this version, this processor and this number of cores.

    Computers of several kinds may share a home, and XLA compiles other sums for other numbers of cores, which
    round differently.
    """
    given = os.environ.get("XDG_CACHE_HOME", "")
    root = (Path(given) if os.path.isabs(given) else Path.home() / ".cache") / "fcos_lidar_jax"
    if not root.exists():
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        off = "JAX_ENABLE_COMPILATION_CACHE=false turns this off"
        tell(f"compiled programs are kept in {root}, so that later commands start faster; {off}")
    folder = root / f"jax-{jax.__version__}-jaxlib-{jaxlib.__version__}-{_processor()}-{_cores()}"
    for each in (root, folder):
        each.mkdir(mode=0o700, exist_ok=True)
        status = each.stat()
        if status.st_uid != os.geteuid() or status.st_mode & 0o022:
            raise PermissionError(f"{each}: belongs to another user, or others can write to it")
    return folder


def _processor() -> str:
    try:
        first = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
    except OSError:  # not Linux
        return os.uname().machine
    lines = [line for line in first if re.match(_CPUINFO, line)]
    return hashlib.blake2b("\n".join(lines).encode(), digest_size=6).hexdigest()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _remove_oldest(root: Path) -> None:
    """Keep the programs that were used last, of all versions. JAX has a limit only with the package filelock."""
    files = []
    for file in root.glob("*/*-cache"):
        with contextlib.suppress(FileNotFoundError):  # removed by another process
            status = file.stat()
            files.append((max(status.st_atime, status.st_mtime), status.st_size, file))
    size = 0
    for _, num_bytes, file in sorted(files, reverse=True):
        size += num_bytes
        if size > _MAX_BYTES:
            file.unlink(missing_ok=True)


def _remove_damaged(folder: Path) -> None:
    """Start the cache again when JAX cannot read a program: JAX compiles it, but would never replace the file."""
    show = warnings.showwarning

    def show_others(message: Warning | str, *args, **kwargs) -> None:
        if str(message).startswith(_NOT_READ):
            for file in folder.glob("*-cache"):
                file.unlink(missing_ok=True)
        elif not str(message).startswith(_NOT_WRITTEN):  # a full disk
            show(message, *args, **kwargs)

    warnings.filterwarnings("always", _NOT_READ)
    warnings.showwarning = show_others

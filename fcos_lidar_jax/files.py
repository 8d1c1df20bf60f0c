"""Writing files whole or not at all."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path


def write_beside(path: str | Path, write: Callable[[Path], object]) -> None:
    """Write to a temporary file beside ``path`` and rename it: nobody ever sees half a file.

    Whatever fails, an interruption too, leaves the old file as it was and no temporary one behind.

    Args:
        path: where the file shall be; missing parent folders are made.
        write: writes the file it is given; that name ends like ``path``.

    >>> folder = Path(tempfile.mkdtemp())
    >>> write_beside(folder / "a.txt", lambda file: file.write_text("whole"))
    >>> (folder / "a.txt").read_text()
    'whole'
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: found a folder, expected a file to write")
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(0o644)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)

"""Writing files whole or not at all."""

import os
import secrets
from collections.abc import Callable
from pathlib import Path


def write_beside(path: str | Path, write: Callable[[Path], object]) -> None:
    """Write to a temporary file beside ``path`` and rename it: nobody ever sees half a file.

    Whatever fails, an interruption too, leaves the old file as it was and no temporary one behind.

    Args:
        path: where the file shall be; missing parent folders are made.
        write: creates and writes the file that it is given; that name ends like ``path``, for writers that go by
            the extension.

    Raises:
        OSError: a folder stands at ``path``, or what the file system and ``write`` raise.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "new" / "a.txt"
    >>> write_beside(file, lambda temporary: temporary.write_text("whole"))
    >>> file.read_text(), [f.name for f in file.parent.iterdir()]
    ('whole', ['a.txt'])
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: found a folder, expected a file to write")
    path.parent.mkdir(parents=True, exist_ok=True)
    # The writer itself creates the file, so that its permissions are those of any other new file.
    temporary = path.with_name(f".{secrets.token_hex(6)}{path.suffix}")
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)

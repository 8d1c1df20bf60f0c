"""Files that several processes may write: whole or not at all, locks between them, and checksums."""

import contextlib
import fcntl
import hashlib
import os
import secrets
import socket
from collections.abc import Callable, Iterator
from pathlib import Path


def atomic_write(path: str | Path, write: Callable[[Path], object]) -> None:
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
    >>> atomic_write(file, lambda temporary: temporary.write_text("whole"))
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


@contextlib.contextmanager
def file_lock(path: str | Path, *, wait: bool = False) -> Iterator[bool]:
    """Lock a file against all other processes of this machine and all other locks of this one.

    The lock ends with the context or with the process, whatever ends it; the file itself stays.

    Args:
        path: of the lock file; it and missing parent folders are made.
        wait: until nobody else holds the lock.

    Returns:
        within the context, whether this lock is held; always true with ``wait``.

    Raises:
        OSError: the file cannot be made.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "run.lock"
    >>> with file_lock(file) as first, file_lock(file) as second:
    ...     (first, second)
    (True, False)
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
        else:
            yield True


def checksum(data: bytes) -> str:
    """BLAKE2b of 16 bytes, in hexadecimal.

    >>> checksum(b"")
    'cae66941d9efbd404e4d88758ea67670'
    """
    return hashlib.blake2b(data, digest_size=16).hexdigest()


@contextlib.contextmanager
def folder_lock(folder: Path, doing: str) -> Iterator[None]:
    """Keep other processes from working in a folder, by a file ``.lock`` in it that names the process.

    Args:
        folder: made if missing.
        doing: what this process does there, for the message of another one.

    Raises:
        OSError: another process works there; with its number and its machine.
    """
    file = folder / ".lock"
    with file_lock(file) as held:
        if not held:
            owner = file.read_text(encoding="utf-8") or "another process"
            raise BlockingIOError(f"{folder}: in use: {owner}, expected no other process")
        file.write_text(f"process {os.getpid()} on {socket.gethostname()} is {doing}", encoding="utf-8")
        yield
        file.write_text("", encoding="utf-8")

"""Files: written whole or not at all, locked against other processes, JSON that is checked, and checksums."""

import contextlib
import fcntl
import hashlib
import json
import os
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec


def atomic_write(path: str | Path, write: Callable[[Path], object]) -> None:
    """Write to a temporary file beside ``path`` and rename it: nobody ever sees half a file.

    Whatever fails, an interruption too, leaves the old file as it was and no temporary one behind.

    Args:
        path: where the file shall be; missing parent folders are made.
        write: creates and writes the file that it is given; that name ends like ``path``, for writers that go by
            the extension.

    Raises:
        OSError: a folder, a link or a device stands at ``path``, or what the file system and ``write`` raise.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "new" / "a.txt"
    >>> atomic_write(file, lambda temporary: temporary.write_text("whole"))
    >>> file.read_text(), [f.name for f in file.parent.iterdir()]
    ('whole', ['a.txt'])
    """
    with atomic_path(path) as temporary:
        write(temporary)


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """As :func:`atomic_write`, for what is written bit by bit: the temporary file's name, within the context."""
    path = Path(path)
    _check_kind(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The writer itself creates the file, so that its permissions are those of any other new file.
    temporary = path.with_name(f".{secrets.token_hex(6)}{path.suffix}")
    try:
        with naming(path):
            yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


class FileState(msgspec.Struct, frozen=True):
    """What tells a file from an altered one: as build tools do, without reading it, and its checksum."""

    bytes: int
    mtime_ns: int
    inode: int
    blake2b: str

    @classmethod
    def of(cls, file: Path) -> "FileState":
        found = file.stat()
        return cls(found.st_size, found.st_mtime_ns, found.st_ino, file_checksum(file))

    def holds(self, file: Path) -> bool:
        """Whether the file is the same: by size, time and inode, else, as after a copy, by its content.

        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "a"
        >>> _ = file.write_text("one")
        >>> state = FileState.of(file)
        >>> file.touch(), state.holds(file)
        (None, True)
        >>> file.write_text("two"), state.holds(file)
        (3, False)
        """
        found = file.stat()
        if (found.st_size, found.st_mtime_ns, found.st_ino) == (self.bytes, self.mtime_ns, self.inode):
            return True
        return found.st_size == self.bytes and file_checksum(file) == self.blake2b


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Make errors of writing a file name it: where the disk is full, the system's own do not."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None


def check_writable(path: Path) -> None:
    """Refuse a path at which :func:`atomic_write` would fail, as far as can be told without writing.

    Raises:
        OSError: naming what stands in the way.

    >>> check_writable(Path("/dev/null/boxes.json"))
    Traceback (most recent call last):
    NotADirectoryError: /dev/null: found a file, expected a folder to write to
    """
    _check_kind(path)
    folder = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
    if not folder.is_dir():
        raise NotADirectoryError(f"{folder}: found a file, expected a folder to write to")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"{folder}: no right to write there")


def _check_kind(path: Path) -> None:
    """Refuse what must not be replaced by a file: folders, devices, and links, whose targets would stay."""
    if path.is_symlink():
        raise FileExistsError(f"{path}: found a link to {path.readlink()}, expected a file to write")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: found a folder, expected a file to write")
    if path.exists() and not path.is_file():
        raise FileExistsError(f"{path}: found a device or a pipe, expected a file to write")


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


@contextlib.contextmanager
def line_writer(path: Path) -> Iterator[Callable[[bytes], None]]:
    """Replace a file line by line: within the context, a function that appends a line, given without its newline.

    Whatever happens, such as an interruption or a full disk, the file holds only whole lines.

    Raises:
        OSError: naming the file: another process writes there, or a line cannot be written.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "a.jsonl"
    >>> with line_writer(file) as write_line:
    ...     write_line(b"{}")
    >>> file.read_bytes()
    b'{}\\n'
    """
    with path.open("ab", buffering=0) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BlockingIOError(
                f"{path}: in use: another process writes there, expected no other process"
            ) from None
        file.truncate(0)
        whole = 0  # Bytes of whole lines.

        def write(line: bytes) -> None:
            nonlocal whole
            left = memoryview(line + b"\n")
            try:
                with naming(path):
                    while left:  # One call may write a part.
                        left = left[file.write(left) :]
            except BaseException:
                file.truncate(whole)
                raise
            whole += len(line) + 1

        yield write


def read_json(path: Path, kind: Any = Any, *, what: str = "a JSON file") -> Any:
    """What a JSON file holds, checked against a type.

    Args:
        path: of the file, in UTF-8. NaN and infinities are let through, so that they can be refused by name.
        kind: any type that msgspec can check.
        what: is expected at the path, for the message where nothing is.

    Raises:
        ValueError: one line with the file and, where the type does not fit, the place, what was found there and
            what was expected.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "a.json"
    >>> _ = file.write_text('["a", 3]')
    >>> read_json(file, list[str])  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ValueError: ...a.json: $[1]: got 3, expected str
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file, expected {what}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not JSON: {error}") from None
    try:
        return msgspec.convert(content, kind)
    except (OverflowError, UnicodeError) as error:  # an integer that no float holds, half a pair of surrogates
        raise ValueError(f"{path}: {error}") from None
    except msgspec.ValidationError as error:
        raise ValueError(f"{path}: {_explain(str(error), content)}") from None


def _explain(message: str, content: Any) -> str:
    """msgspec's message with what was found at its place; as it is where the place names no key (``$[...]``)."""
    problem, _, place = message.partition(" - at `")
    place = place.removesuffix("`")
    if not re.fullmatch(r"(\$(\.\w+|\[\d+\])*)?", place):
        return message
    for key, index in re.findall(r"\.(\w+)|\[(\d+)\]", place):
        content = content[key or int(index)]
    found = shown if len(shown := repr(content)) <= 60 else f"{shown[:57]}..."
    wanted = re.fullmatch(r"Expected (.+?)(, got .*)?", problem.replace("`", ""))
    return f"{place or '$'}: {f'got {found}, expected {wanted[1]}' if wanted else f'{problem}, got {found}'}"


def checksum(data: bytes) -> str:
    """BLAKE2b of 16 bytes, in hexadecimal.

    >>> checksum(b"")
    'cae66941d9efbd404e4d88758ea67670'
    """
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def file_checksum(path: Path) -> str:
    """:func:`checksum` of a file of any size."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


_held: dict[Path, int] = {}  # folders that this process has locked -> the thread that did


@contextlib.contextmanager
def folder_lock(folder: Path, doing: str) -> Iterator[None]:
    """Keep other processes from working in a folder, by a file ``.lock`` in it that names the process.

    The thread that holds it may take it again. The lock ends with the process, whatever ends it.

    Args:
        folder: made if missing.
        doing: what this process does there, for the other processes' messages.

    Raises:
        OSError: another process works there; with its number and its machine.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with folder_lock(folder, "writing"), folder_lock(folder, "writing"):
    ...     (folder / ".lock").read_text().split()[-2:]
    ['is', 'writing']
    """
    file, key = folder / ".lock", folder.resolve()
    if _held.get(key) == threading.get_ident():
        yield
        return
    with file_lock(file) as held:
        if not held:
            owner = file.read_text(encoding="utf-8", errors="replace")[:200] or "another process"
            raise BlockingIOError(f"{folder}: in use: {owner}, expected no other process")
        _held[key] = threading.get_ident()
        try:
            file.write_text(f"process {os.getpid()} on {socket.gethostname()} is {doing}", encoding="utf-8")
            yield
        finally:
            del _held[key]
            with contextlib.suppress(OSError):  # the folder may be gone
                os.truncate(file, 0)

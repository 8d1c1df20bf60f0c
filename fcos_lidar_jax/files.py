"""Atomic writes, locks between processes, checked JSON, checksums of files, and packages of extras."""

import contextlib
import fcntl
import hashlib
import importlib
import json
import os
import re
import secrets
import shutil
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from fcos_lidar_jax.fields import printable


def atomic_write(path: str | Path, content: str | bytes | Callable[[Path], object]) -> None:
    """Write to a temporary file beside ``path`` and rename it, so that no reader sees a partial file.

    A failure or an interruption leaves the old file unchanged and removes the temporary file. Missing parent
    folders are created. ``content`` is text, bytes, or a function that writes to the temporary path, which has the
    extension of ``path``.

    Raises:
        OSError: ``path`` is a folder, a link or a device, or the file system or ``content`` raised it.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "new" / "a.txt"
    >>> atomic_write(file, "whole")
    >>> file.read_text(), [f.name for f in file.parent.iterdir()]
    ('whole', ['a.txt'])
    """
    with atomic_path(path) as temporary:
        if isinstance(content, str | bytes):
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        else:
            content(temporary)


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Context manager form of :func:`atomic_write`: yields the temporary path and renames it on exit."""
    path = Path(path)
    _check_kind(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The writer creates the file, so that it gets the default permissions.
    temporary = path.with_name(f".{secrets.token_hex(6)}{path.suffix}")
    try:
        with naming(path):
            yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder beside ``folder``, and rename it to ``folder`` on success.

    A failure or an interruption leaves the unfinished folder, which the next call replaces.
    """
    unfinished = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    yield unfinished
    os.replace(unfinished, folder)


class FileState(msgspec.Struct, frozen=True):
    """State of a file by which a later change is detected: size, time and inode, and a checksum of the content."""

    bytes: int
    mtime_ns: int
    inode: int
    blake2b: str

    @classmethod
    def of(cls, file: Path) -> "FileState":
        stat = file.stat()
        return cls(stat.st_size, stat.st_mtime_ns, stat.st_ino, file_checksum(file))

    def holds(self, file: Path) -> bool:
        """Whether the file is unchanged, by size, time and inode, or else by its content (for copies)."""
        stat = file.stat()
        if (stat.st_size, stat.st_mtime_ns, stat.st_ino) == (self.bytes, self.mtime_ns, self.inode):
            return True
        return stat.st_size == self.bytes and file_checksum(file) == self.blake2b


@contextlib.contextmanager
def refusing(
    where: str, *kinds: type[Exception], kind: type[Exception] = ValueError, more: str = ""
) -> Iterator[None]:
    """Raise exceptions of ``kinds``, by default all, again: as one line of ``kind`` that begins with ``where``."""
    caught = kinds or (Exception,)
    try:
        yield
    except caught as error:
        text = (isinstance(error, OSError) and error.strerror) or " ".join(str(error).split())
        text = printable(text or type(error).__name__, 1000)
        raise kind(f"{where}{': ' if where else ''}{text}{more}") from None


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the file's name to write errors that lack it, such as a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None


def local_path(path: str | Path) -> Path:
    """The path, unless it is the URL of a bucket or another server: locks and renames need a file system."""
    if url := re.match(r"([A-Za-z][A-Za-z0-9+.-]+):/+", str(path)):
        whole = f"{url[1]}://{str(path)[url.end() :]}"
        hint = "copy the files (gsutil, aws s3) or mount the bucket (gcsfuse)"
        raise ValueError(f"{whole}: got a URL, expected a path: {hint}")
    return Path(path)


def expect_file(path: Path, what: str) -> None:
    """Refuse a path at which there is no file; ``what`` describes the expected one."""
    if not os.path.isfile(path):
        found = "found a folder" if os.path.isdir(path) else "no such file"
        raise ValueError(f"{path}: {found}, expected {what}")


def some_files(folder: Path, ending: str, what: str) -> list[Path]:
    """The files in a folder whose names have an ending, sorted; refuses a folder without any, where ``what`` is
    expected.
    """
    if not (files := sorted(folder.glob(f"*{ending}"))):
        raise ValueError(f"{folder}: no {ending} file in it, expected {what}")
    return files


def import_extra(name: str, extra: str, before: str = "") -> Any:
    """Import a package that an extra of this one installs; ``before`` begins the message if it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError:
        how = f"pip install -e '.[{extra}]' in the repository"
        raise ValueError(f"{before}{name} is not installed: {how}") from None


def check_writable(path: Path) -> None:
    """Reject a path at which :func:`atomic_write` would fail, as far as this is known without writing."""
    _check_kind(path)
    folder = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
    if not (folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)):
        found = "a folder without write permission" if folder.is_dir() else "a file"
        raise PermissionError(f"{folder}: found {found}, expected a folder to write to")


def _check_kind(path: Path) -> None:
    """Reject URLs, and what a file must not replace: folders, devices, and links, whose targets would remain."""
    local_path(path)
    if path.is_symlink() or (path.exists() and not path.is_file()):
        found = "a folder" if path.is_dir() else "a device or a pipe"
        found = f"a link to {path.readlink()}" if path.is_symlink() else found
        raise FileExistsError(f"{path}: found {found}, expected a file to write")


@contextlib.contextmanager
def file_lock(path: str | Path, *, wait: bool = False) -> Iterator[bool]:
    """Lock a file against other processes of this machine and other locks of this process; yields whether it is
    held.

    The lock is released when the context or the process ends. The file remains. With ``wait``, the lock is always
    held.
    """
    path = local_path(path)
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
    """Replace a file line by line; yields a function that appends one line, given without its newline.

    The file contains only whole lines, even after an interruption or on a full disk.

    Raises:
        OSError: naming the file: another process writes to it, or a line cannot be written.
    """
    with file_lock(path) as held, path.open("ab", buffering=0) as file:
        if not held:
            raise BlockingIOError(f"{path}: in use: another process, expected no other process")
        file.truncate(0)
        size = 0  # Bytes of whole lines.

        def write(line: bytes) -> None:
            nonlocal size
            rest = memoryview(line + b"\n")
            try:
                with naming(path):
                    while rest:  # One call may write only a part.
                        rest = rest[file.write(rest) :]
            except BaseException:
                file.truncate(size)
                raise
            size += len(line) + 1

        yield write


def read_json(path: Path, kind: Any = Any, *, what: str = "a JSON file") -> Any:
    """Read a JSON file in UTF-8 and check its content against a type that msgspec can check.

    A byte order mark, as Windows editors write it, is skipped. NaN and infinities are accepted; callers reject
    them by name. ``what`` describes the file in the message that it is missing.

    Raises:
        ValueError: one line with the file and, on a type mismatch, the place, the found and the expected value.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "a.json"
    >>> _ = file.write_text('["a", 3]')
    >>> read_json(file, list[str])  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ValueError: ...a.json: $[1]: got 3, expected str
    """
    expect_file(local_path(path), what)
    with refusing(f"{path}: cannot be read", OSError), refusing(f"{path}: not JSON", ValueError, RecursionError):
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    try:
        return msgspec.convert(content, kind)
    except (msgspec.ValidationError, OverflowError, UnicodeError) as error:  # huge integers, lone surrogates
        raise ValueError(f"{path}: {_explain(str(error), content)}") from None


def _explain(message: str, content: Any) -> str:
    """Add the found value to msgspec's message; unchanged if its place contains no key (``$[...]``)."""
    problem, _, place = message.partition(" - at `")
    place = place.removesuffix("`")
    if not re.fullmatch(r"(\$(\.\w+|\[\d+\])*)?", place):
        return message
    for key, index in re.findall(r"\.(\w+)|\[(\d+)\]", place):
        content = content[key or int(index)]
    got = printable(repr(content), 57)
    expected = re.fullmatch(r"Expected (.+?)(, got .*)?", problem.replace("`", ""))
    return f"{place or '$'}: {f'got {got}, expected {expected[1]}' if expected else f'{problem}, got {got}'}"


def checksum(data: bytes) -> str:
    """16-byte BLAKE2b digest in hexadecimal."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def file_checksum(path: Path) -> str:
    """:func:`checksum` of a file, which is read in blocks."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


@contextlib.contextmanager
def folder_lock(folder: Path, doing: str) -> Iterator[None]:
    """Lock a folder against other processes with a file ``.lock`` that says what this process is ``doing``.

    The lock is released when the process ends.

    Raises:
        OSError: another process holds the lock; the message contains its id, machine and activity.
    """
    file = folder / ".lock"
    with file_lock(file) as held:
        if not held:
            owner = file.read_text(encoding="utf-8", errors="replace")[:200] or "another process"
            raise BlockingIOError(f"{folder}: in use: {owner}, expected no other process")
        try:
            file.write_text(f"process {os.getpid()} on {socket.gethostname()} is {doing}", encoding="utf-8")
            yield
        finally:
            with contextlib.suppress(OSError):  # the folder may have been removed
                os.truncate(file, 0)

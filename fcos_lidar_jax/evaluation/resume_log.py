"""Log of the detections of finished samples, from which an interrupted run resumes."""

import json
from pathlib import Path
from typing import Any

from fcos_lidar_jax.files import naming
from fcos_lidar_jax.progress import tell


class ResumeLog:
    """Append-only file of the entries of finished samples, one line per sample.

    A truncated or corrupt line and all lines after it are dropped. The first line is a fingerprint of detector and
    data. A file with a different fingerprint is overwritten when the first entry is added.
    """

    def __init__(self, path: Path, fingerprint: str) -> None:
        self.path, self.places = path, dict[str, tuple[int, int]]()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = path.open("a+b")
        self._stream.seek(0)
        self._first, end = json.dumps(fingerprint).encode() + b"\n", 0
        if self._stream.readline() == self._first:
            end = len(self._first)
            for line in self._stream:
                name, separator, entries = line.partition(b"\t")
                try:
                    token = json.loads(name)
                except (ValueError, RecursionError):  # corrupt
                    break
                if not isinstance(token, str) or not separator or not line.endswith(b"\n"):
                    break
                self.places[token] = end + len(name) + 1, len(entries) - 1
                end += len(line)
        self._begun = end > 0
        if self._begun:
            self._stream.truncate(end)

    def __contains__(self, token: str) -> bool:
        return token in self.places

    def __len__(self) -> int:
        return len(self.places)

    def add(self, token: str, entries: list[dict[str, Any]]) -> None:
        name, text = json.dumps(token).encode(), json.dumps(entries).encode()
        with naming(self.path):
            if not self._begun:
                self._stream.truncate(0)
                self._stream.write(self._first)
                self._begun = True
            start = self._stream.seek(0, 2) + len(name) + 1
            self._stream.write(b"%s\t%s\n" % (name, text))
            self._stream.flush()
        self.places[token] = start, len(text)

    def entry(self, token: str) -> bytes:
        """The entries of a sample as JSON."""
        start, length = self.places[token]
        self._stream.seek(start)
        return self._stream.read(length)

    def discard(self) -> None:
        """Delete the file; entries can still be read."""
        self.path.unlink(missing_ok=True)

    def __enter__(self) -> "ResumeLog":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and self.path.exists():
            if len(self):
                tell("the same command resumes")
            elif not self.path.stat().st_size:
                self.discard()
        with naming(self.path):
            self._stream.close()

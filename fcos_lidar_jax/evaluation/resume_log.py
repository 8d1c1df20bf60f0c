"""Detections of finished samples, kept so that an interrupted run resumes."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from fcos_lidar_jax.files import naming


class ResumeLog:
    """Entries of the samples that are done, one line each, in a file that is only appended to.

    A line that an interruption truncated, or that is damaged, is dropped with all behind it. The first line is the
    fingerprint of detector and data: a file with another one is begun anew, but not before the first entry.

    Args:
        path: of the file.
        fingerprint: of the detector and the data.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "resume_log"
    >>> with ResumeLog(file, "this detector") as resume_log:
    ...     resume_log.add("a", [])
    >>> with ResumeLog(file, "this detector") as resume_log:
    ...     "a" in resume_log, "b" in resume_log
    (True, False)
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
                except (ValueError, RecursionError):  # damaged, as is what follows
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
        """Append the entries of a sample."""
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

    def entries(self, tokens: Sequence[str]) -> Iterator[tuple[str, bytes]]:
        """Samples with their entries as JSON, in the order asked for."""
        for token in tokens:
            start, length = self.places[token]
            self._stream.seek(start)
            yield token, self._stream.read(length)

    def __enter__(self) -> "ResumeLog":
        return self

    def __exit__(self, *error: object) -> None:
        with naming(self.path):
            self._stream.close()

"""What was already detected, kept through interruptions."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any


class Journal:
    """Entries of the samples that are done, one line each, in a file that only ever grows.

    A line that an interruption cut is dropped. The first line tells what the entries follow from: a file of other
    things is begun anew.

    Args:
        path: of the file.
        fingerprint: of the detector and the data.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "journal"
    >>> with Journal(file, "this detector") as journal:
    ...     journal.add("a", [])
    >>> with Journal(file, "this detector") as journal:
    ...     "a" in journal, "b" in journal
    (True, False)
    """

    def __init__(self, path: Path, fingerprint: str) -> None:
        """Read what is there."""
        self.path, self.places = path, dict[str, tuple[int, int]]()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = path.open("a+b")
        end = self._read(json.dumps(fingerprint).encode())
        self._stream.truncate(end)
        self._stream.seek(end)
        if end == 0:
            self._stream.write(json.dumps(fingerprint).encode() + b"\n")

    def _read(self, first: bytes) -> int:
        """Where the whole lines end; 0 if they are of something else."""
        self._stream.seek(0)
        end = 0
        for number, line in enumerate(self._stream):
            token, separator, entries = line.partition(b"\t")
            if not line.endswith(b"\n") or (number == 0 and line != first + b"\n"):
                break
            if number:
                if not separator:
                    break
                self.places[json.loads(token)] = end + len(token) + 1, len(entries) - 1
            end += len(line)
        return end

    def __contains__(self, token: str) -> bool:
        """Whether a sample is done."""
        return token in self.places

    def __len__(self) -> int:
        """How many are done."""
        return len(self.places)

    def add(self, token: str, entries: list[dict[str, Any]]) -> None:
        """A sample is done."""
        name, text = json.dumps(token).encode(), json.dumps(entries).encode()
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

    def __enter__(self) -> "Journal":
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file, which stays."""
        self._stream.close()

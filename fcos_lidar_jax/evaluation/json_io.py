"""JSON files with a list of boxes per sample, read sample by sample, with precise error messages."""

import codecs
import json
import mmap
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fcos_lidar_jax.data.sweeps import FARTHEST_M
from fcos_lidar_jax.evaluation.boxes import heading_yaw
from fcos_lidar_jax.files import atomic_write, expect_file

_NOT_FINITE = re.compile(rb'"[^"\\]*(?:\\.[^"\\]*)*"|(NaN|-?Infinity)')
"""Also matches strings, so that their contents are not replaced."""

Text = bytes | mmap.mmap | msgspec.Raw
Vector = tuple[float, float, float]


class JsonBox(msgspec.Struct, gc=False):
    """A box in the global frame, with the fields common to results and ground truth."""

    translation: Vector
    size: Vector
    rotation: tuple[float, float, float, float]
    velocity: tuple[float | None, float | None] | None
    detection_name: str
    attribute_name: str


def read_source(source: str | Path | dict[str, Any], kind: Any, *, given: str = "") -> tuple[Any, str]:
    """Read a JSON file as an object of a type; also returns its name for messages.

    ``source`` may also be the result of ``json.load``, optionally with NumPy numbers and arrays; ``given`` names
    it then.
    """
    if isinstance(source, dict):
        text = json.dumps(source, default=lambda array: array.tolist()).encode()
        return decode_json(text, kind, given), given
    path = Path(source)
    expect_file(path, "a JSON file")
    with path.open("rb") as stream:
        is_empty = path.stat().st_size == 0  # which cannot be mapped
        text = b"" if is_empty else mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        return decode_json(text, kind, str(path)), str(path)


def decode_json(text: Text, kind: Any, source: str) -> Any:
    """Decode a JSON text as an object of a type. Parts that the type declares raw stay undecoded.

    Accepts NaN and infinities, which Python writes although JSON excludes them: NaN is read as ``null``, and
    infinities are rejected where the type expects a number.
    """
    try:
        try:
            return msgspec.json.decode(text, type=kind, dec_hook=_make)
        except msgspec.ValidationError:
            raise
        except msgspec.DecodeError:
            return msgspec.json.decode(_plain_json(text), type=kind, dec_hook=_make)
    except msgspec.ValidationError as error:
        problem = _explain(error)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        problem = f"not JSON: {error}"
    raise ValueError(f"{source}: {problem}")


def _make(kind: Any, value: Any) -> Any:
    return kind(value)


def _plain_json(text: Text) -> bytes:
    """Remove a byte order mark, and replace NaN by ``null`` and infinities by strings, which are not numbers."""

    def plain(match: re.Match[bytes]) -> bytes:
        return match[0] if not match[1] else b"null" if match[1] == b"NaN" else b'"%s"' % match[1]

    return _NOT_FINITE.sub(plain, bytes(text).removeprefix(codecs.BOM_UTF8))


class _Token:
    """A key that is equal only to itself, so that a dictionary keeps repeated keys."""

    def __init__(self, name: str) -> None:
        self.name = name


def decode_samples(samples: msgspec.Raw, kind: Any, source: str, *, field: str = "") -> Iterator[tuple[str, Any]]:
    """Iterate over sample tokens and their entries, decoded as objects of a type; a token must not occur twice.

    ``samples`` is the JSON object of all samples, which the file has in ``field``; ``""`` for the whole file.
    """
    whole = f"{source}: {field}" if field else source
    entries = decode_json(samples, dict[_Token, msgspec.Raw], whole)
    for token, count in Counter(token.name for token in entries).items():
        if count > 1:
            raise ValueError(f"{whole}: sample {token}: occurs twice")
    for token, entry in entries.items():
        yield token.name, decode_json(entry, kind, f"{source}: sample {token.name}")


def _explain(error: msgspec.ValidationError) -> str:
    """Put the place before the problem: ``box 3: size[1]: expected `float`, got `str```."""
    problem, _, place = str(error).rpartition(" - at `$")
    problem, place = (problem, place.rstrip("`")) if problem else (str(error), "")
    place = re.sub(r"^(\.boxes)?\[(\d+)\]\.?", r"box \2: ", place).lstrip(".").removesuffix(": ")
    problem = problem[0].lower() + problem[1:]
    problem = problem.replace("got `null`", "got null or NaN")
    return f"{place}: {problem}" if place else problem


def expect_samples(found: Collection[str], wanted: Sequence[str], source: str, *, of: str) -> None:
    """Check that ``found`` contains exactly the ``wanted`` samples, described by ``of`` as ``"split 'val'"``."""
    present, known = set(found), set(wanted)
    missing = [token for token in wanted if token not in present]
    extra = [token for token in found if token not in known]
    faults = [
        f"sample {tokens[0]}{f' and {len(tokens) - 1} more' if len(tokens) > 1 else ''}: {what}"
        for tokens, what in ((missing, "missing"), (extra, "not expected"))
        if tokens
    ]
    if faults:
        raise ValueError(f"{source}: {'; '.join(faults)}: expected the {len(wanted)} samples of {of}")


def geometry(boxes: Sequence[JsonBox], where: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Translation, size, yaw and velocity of boxes as columns, and rotations f64[n, 4].

    ``where`` names file and sample in messages.
    """
    unknown = (None, None)
    rows = [box.translation + box.size + box.rotation + (box.velocity or unknown) for box in boxes]
    # Converting one flat list is several times faster than converting tuples. None becomes NaN.
    table = np.array(list(chain.from_iterable(rows)), np.float64).reshape(-1, 12)
    translation, size, rotation, velocity = np.split(table, (3, 6, 10), axis=1)
    expect((size > 0).all(axis=1), boxes, "size", where, "three positive lengths")
    for name, values in (("translation", translation), ("size", size), ("velocity", velocity)):
        near = ~(np.abs(values) > FARTHEST_M).any(axis=1)
        expect(near, boxes, name, where, f"numbers of at most {FARTHEST_M:g}")
    largest = np.abs(rotation).max(axis=1, initial=0.0)  # so that squares neither vanish nor overflow
    expect((largest > 1e-8) & (largest < 1e8), boxes, "rotation", where, "a nonzero quaternion w, x, y, z")
    columns = {"translation": translation, "size": size, "yaw": heading_yaw(rotation), "velocity": velocity}
    return columns, rotation


def index_of(boxes: Sequence[msgspec.Struct], field: str, known: Mapping[str, int], where: str) -> np.ndarray:
    """Map the names in a field of the boxes to numbers of at least -1, i64[n]; ``""`` stands for no name."""
    index = np.array([known.get(getattr(box, field), -2) for box in boxes], np.int64)
    names = ", ".join(filter(None, known))
    expect(index > -2, boxes, field, where, f"one of {names}{' or nothing' if '' in known else ''}")
    return index


def expect(
    good: np.ndarray | np.bool, boxes: Sequence[msgspec.Struct], field: str, where: str, expected: str
) -> None:
    """Raise a ValueError that names the first box with a wrong value in a field."""
    if not good.all():
        box = int(np.argmin(good))
        got = list(value) if isinstance(value := getattr(boxes[box], field), tuple) else value
        raise ValueError(f"{where}: box {box}: {field}: got {got!r}, expected {expected}")


def write_lines(path: str | Path, before: bytes, lines: Iterable[bytes], after: bytes) -> None:
    """Write a JSON file with one line per item between two texts, and one item in memory at a time."""

    def write(file: Path) -> None:
        with file.open("wb") as stream:
            stream.write(before)
            for number, line in enumerate(lines):
                stream.write((b",\n" if number else b"\n") + line)
            stream.write(b"\n" + after)

    atomic_write(path, write)

"""JSON files with a list of boxes for every sample: read sample by sample, each fault named."""

import json
import mmap
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fcos_lidar_jax.data.sweeps import FARTHEST_M
from fcos_lidar_jax.evaluation.boxes import heading_yaw

_NOT_FINITE = re.compile(rb'"[^"\\]*(?:\\.[^"\\]*)*"|(NaN|-?Infinity)')
"""Texts are matched too, so that what is in them is left alone."""
_KEY = re.compile(rb'\s*[{,]\s*("(?:[^"\\]|\\.)*")\s*:\s*')

Text = bytes | mmap.mmap | msgspec.Raw
Vector = tuple[float, float, float]


class JsonBox(msgspec.Struct, gc=False):
    """A box in the global frame, as results and ground truth have it."""

    translation: Vector
    size: Vector
    rotation: tuple[float, float, float, float]
    velocity: tuple[float | None, float | None] | None
    detection_name: str
    attribute_name: str


def read_json(source: str | Path | dict[str, Any], kind: Any, *, given: str = "") -> tuple[Any, str]:
    """A JSON file as an object of a type, and its name for messages.

    Args:
        source: the file, or what ``json.load`` gives for it, with NumPy numbers and arrays if you like.
        given: name of a source that is no file.

    Raises:
        ValueError: no such file, nothing in it, not JSON, or not of this kind.
    """
    if isinstance(source, dict):
        text = json.dumps(source, default=lambda array: array.tolist()).encode()
        return decode_json(text, kind, given), given
    path = Path(source)
    if not path.is_file():
        raise ValueError(f"{path}: {'found a folder' if path.is_dir() else 'no such file'}, expected a JSON file")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: empty file, expected JSON")
    with path.open("rb") as stream:
        return decode_json(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ), kind, str(path)), str(path)


def decode_json(text: Text, kind: Any, source: str) -> Any:
    """A JSON text as an object of a type, with the parts that the type leaves raw.

    NaN and infinities, which Python writes and JSON does not have, are let in: NaN is what ``null`` is. No number
    of the object is either.

    Raises:
        ValueError: naming the source: not JSON, or not of this kind.

    >>> decode_json(b'{"a": NaN}', dict[str, float | None], "here")
    {'a': None}
    """
    try:
        try:
            return msgspec.json.decode(text, type=kind)
        except msgspec.ValidationError:
            raise
        except msgspec.DecodeError:
            return msgspec.json.decode(_plain_json(text), type=kind)
    except msgspec.ValidationError as error:
        raise ValueError(f"{source}: {_explain(error)}") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{source}: not JSON: {error}") from None


def _plain_json(text: Text) -> bytes:
    """NaN as ``null``, infinities as texts, which no number may be."""

    def plain(found: re.Match[bytes]) -> bytes:
        return found[0] if not found[1] else b"null" if found[1] == b"NaN" else b'"%s"' % found[1]

    return _NOT_FINITE.sub(plain, bytes(text))


def decode_samples(samples: msgspec.Raw, kind: Any, source: str, *, field: str = "") -> Iterator[tuple[str, Any]]:
    """Sample tokens with their entries as objects of a type, one after the other.

    Args:
        samples: the JSON object of all samples.
        kind: of one entry.
        field: of the file that holds the samples; ``""`` for the whole.

    Raises:
        ValueError: not an object, or a token that occurs twice; an entry of another kind, naming sample, box and
            field.
    """
    whole = f"{source}: {field}" if field else source
    entries = decode_json(samples, dict[str, msgspec.Raw], whole)
    # A key that occurs twice keeps its last value alone: the text between two values then holds another value.
    text, start, end = memoryview(samples), _address(samples), 0
    for entry in sorted(entries.values(), key=_address):
        first = _address(entry) - start
        between = bytes(text[end:first])
        key = _KEY.match(between)
        if key is not None and key.end() != len(between):
            raise ValueError(f"{whole}: sample {json.loads(key[1])}: occurs twice")
        end = first + len(memoryview(entry))
    for token, entry in entries.items():
        yield token, decode_json(entry, kind, f"{source}: sample {token}")


def _address(raw: msgspec.Raw) -> int:
    """Where the text lies in memory: entries are views of the whole."""
    return np.frombuffer(raw, np.uint8).ctypes.data


def _explain(error: msgspec.ValidationError) -> str:
    """Place first, then what is wrong: ``box 3: size[1]: expected `float`, got `str```."""
    problem, _, place = str(error).rpartition(" - at `$")
    problem, place = (problem, place.rstrip("`")) if problem else (str(error), "")
    place = re.sub(r"^(\.boxes)?\[(\d+)\]\.?", r"box \2: ", place).lstrip(".").removesuffix(": ")
    problem = problem[0].lower() + problem[1:]
    problem = problem.replace("got `null`", "got null or NaN")
    return f"{place}: {problem}" if place else problem


def expect_samples(found: Collection[str], wanted: Sequence[str], source: str, *, of: str) -> None:
    """Refuse other samples than the wanted ones, which are those of, say, ``of="split 'val'"``.

    Raises:
        ValueError: naming the source, missing and extra samples.
    """
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
    """Translation, size, yaw and velocity of boxes as columns, and their rotations f64[n, 4].

    Raises:
        ValueError: naming the box and the field; ``where`` are file and sample.
    """
    unknown = (None, None)
    rows = [box.translation + box.size + box.rotation + (box.velocity or unknown) for box in boxes]
    # One flat list: several times as fast as arrays of tuples. None becomes NaN.
    table = np.array(list(chain.from_iterable(rows)), np.float64).reshape(-1, 12)
    translation, size, rotation, velocity = np.split(table, (3, 6, 10), axis=1)
    expect((size > 0).all(axis=1), boxes, "size", where, "three positive lengths")
    for name, values in (("translation", translation), ("size", size), ("velocity", velocity)):
        near = ~(np.abs(values) > FARTHEST_M).any(axis=1)
        expect(near, boxes, name, where, f"numbers of at most {FARTHEST_M:g}")
    largest = np.abs(rotation).max(axis=1, initial=0.0)  # whose square neither vanishes nor overflows
    expect(
        (largest > 1e-8) & (largest < 1e8), boxes, "rotation", where, "a quaternion w, x, y, z that is not zero"
    )
    columns = {"translation": translation, "size": size, "yaw": heading_yaw(rotation), "velocity": velocity}
    return columns, rotation


def index_of(boxes: Sequence[msgspec.Struct], field: str, known: Mapping[str, int], where: str) -> np.ndarray:
    """What is known by the name in a field of each box, i64[n]: numbers of at least -1, ``""`` for no name.

    Raises:
        ValueError: a name that is not known; ``where`` are file and sample.
    """
    index = np.array([known.get(getattr(box, field), -2) for box in boxes], np.int64)
    names = ", ".join(filter(None, known))
    expect(index > -2, boxes, field, where, f"one of {names}{' or nothing' if '' in known else ''}")
    return index


def expect(
    good: np.ndarray | np.bool, boxes: Sequence[msgspec.Struct], field: str, where: str, expected: str
) -> None:
    """Refuse the first box whose field is not good."""
    if not good.all():
        box = int(np.argmin(good))
        got = list(value) if isinstance(value := getattr(boxes[box], field), tuple) else value
        raise ValueError(f"{where}: box {box}: {field}: got {got!r}, expected {expected}")

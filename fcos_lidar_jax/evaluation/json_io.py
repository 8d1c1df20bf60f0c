"""JSON files with a list of boxes for every sample: read sample by sample, each fault named."""

import json
import mmap
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

_NOT_FINITE = re.compile(rb'"[^"\\]*(?:\\.[^"\\]*)*"|(NaN|-?Infinity)')
"""Texts are matched too, so that what is in them is left alone."""
_UNREADABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
_KEY = re.compile(rb'\s*[{,]\s*("(?:[^"\\]|\\.)*")\s*:\s*')


Text = bytes | mmap.mmap | msgspec.Raw


def read_json(path: str | Path) -> Text:
    """The text of a JSON file, mapped into memory.

    Raises:
        ValueError: there is none, or nothing in it.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: {'found a folder' if path.is_dir() else 'no such file'}, expected a JSON file")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: empty file, expected JSON")
    with path.open("rb") as stream:
        return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)


def encode_json(value: Any) -> bytes:
    """JSON of Python objects, NumPy numbers and arrays among them: what a file of them would hold."""
    return json.dumps(value, default=lambda array: array.tolist()).encode()


def decode_json(text: Text, kind: Any, source: str) -> Any:
    """A JSON text as an object of a type, with the parts that the type leaves raw.

    NaN and infinities, which Python writes and JSON does not have, are let in: NaN is what ``null`` is.

    Args:
        text: the JSON.
        kind: a type that msgspec knows.
        source: name for the messages.

    Raises:
        ValueError: not JSON, or not of this kind.

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
    except _UNREADABLE as error:
        raise ValueError(f"{source}: not JSON: {error}") from None


def _plain_json(text: Text) -> bytes:
    """NaN as ``null``, infinities as texts, which no number may be."""
    whole, end, parts = bytes(text), 0, list[bytes]()
    for found in _NOT_FINITE.finditer(whole):
        if found[1]:
            parts += [whole[end : found.start()], b"null" if found[1] == b"NaN" else b'"%s"' % found[1]]
            end = found.end()
    return b"".join([*parts, whole[end:]])


def split_samples(samples: msgspec.Raw, source: str) -> dict[str, msgspec.Raw]:
    """The entry of every sample token, still as text.

    Raises:
        ValueError: not an object, or a token that occurs twice.
    """
    entries = decode_json(samples, dict[str, msgspec.Raw], source)
    # A key that occurs twice keeps its last value alone: the text between two values then holds another value.
    text, start, end = memoryview(samples), _address(samples), 0
    for entry in sorted(entries.values(), key=_address):
        first = _address(entry) - start
        between = bytes(text[end:first])
        key = _KEY.match(between)
        if key is not None and key.end() != len(between):
            raise ValueError(f"{source}: sample {json.loads(key[1])}: occurs twice")
        end = first + len(memoryview(entry))
    return entries


def _address(raw: msgspec.Raw) -> int:
    """Where the text lies in memory: entries are views of the whole."""
    return np.frombuffer(raw, np.uint8).ctypes.data


def decode_samples(entries: dict[str, msgspec.Raw], kind: Any, source: str) -> Iterator[tuple[str, Any]]:
    """The entry of every sample as an object of a type, one after the other.

    Raises:
        ValueError: naming sample, box and field.
    """
    decoder = msgspec.json.Decoder(kind)
    for token, entry in entries.items():
        try:
            yield token, decoder.decode(entry)
        except msgspec.ValidationError as error:
            raise ValueError(f"{source}: sample {token}: {_explain(error)}") from None
        except _UNREADABLE as error:
            raise ValueError(f"{source}: sample {token}: not JSON: {error}") from None


def _explain(error: msgspec.ValidationError) -> str:
    """Place first, then what is wrong: ``box 3: size[1]: expected `float`, got `str```."""
    problem, _, place = str(error).rpartition(" - at `$")
    problem, place = (problem, place.rstrip("`")) if problem else (str(error), "")
    place = re.sub(r"^(\.boxes)?\[(\d+)\]\.?", r"box \2: ", place).lstrip(".").removesuffix(": ")
    problem = problem[0].lower() + problem[1:]
    if "got `null`" in problem:
        problem = problem.replace("got `null`", "got null or NaN")
    return f"{place}: {problem}" if place else problem


def expect_samples(found: dict[str, Any], wanted: tuple[str, ...], source: str, *, of: str) -> None:
    """Check that the entries are of the wanted samples, no more and no less.

    Args:
        found: by sample.
        wanted: sample tokens.
        source: name of the file.
        of: what the wanted ones are, such as ``split 'val'``.

    Raises:
        ValueError: naming missing and extra samples.
    """
    missing = [token for token in wanted if token not in found]
    known = set(wanted)
    extra = [token for token in found if token not in known]
    faults = [
        f"sample {tokens[0]}{f' and {len(tokens) - 1} more' if len(tokens) > 1 else ''}: {what}"
        for tokens, what in ((missing, "missing"), (extra, "not expected"))
        if tokens
    ]
    if faults:
        raise ValueError(f"{source}: {'; '.join(faults)}: expected the {len(wanted)} samples of {of}")

"""Random changes of files: bytes, words, lines and JSON values."""

import copy
import json
import re
import struct
from collections.abc import Callable
from random import Random
from typing import Any

INTEGERS = (-1, 0, 1, 2, 3, 5, 127, 255, 65_536, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**62, 2**63, 2**64, 10**30)
WORDS = (
    *(str(number).encode() for number in INTEGERS),
    *(b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e999", b"1e-320", b"0.5", b"-0", b"0x10", b"1_0", b"+3"),
    *(b"", b"a", b"\0", b"\xff\xfe", b"\xd9\xa3", b"a" * 300, b"9" * 5000),
    *(b"%s", b"$a$", b"../..", b"/", b"#", b"\r"),
)
VALUES = (
    *(None, True, False, *INTEGERS, 10**400, 0.5, -1.5, -0.0, 1e308, -1e308, 1e-320),
    *(float("nan"), float("inf"), float("-inf")),
    *("", "a", "\0", "\ud800", "é" * 300, "a" * 5000, "../x", "/", "$a$", "0", "car", "nan"),
    *([], {}, [[]], [0], [None], {"": None}, {"a": 1}, [[[[[[[[]]]]]]]]),
)
DEEP = (b"[" * 100_000, b'{"a":' * 100_000, b"[" * 5000 + b"]" * 5000)
NUMBER = struct.Struct("<Q")
LARGEST = 1 << 16  # bytes; larger files are not extended


def mutate(name: str, content: bytes, rng: Random) -> bytes:
    """Change a file's content in at least one place."""
    ending = name.rpartition(".")[2]
    if rng.random() < 0.2:
        return mutate_bytes(content, rng)
    return _BY_ENDING.get(ending, mutate_bytes)(content, rng)


def mutate_bytes(content: bytes, rng: Random) -> bytes:
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        place, end = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
        end = min(end, place + rng.choice((1, 2, 4, 8, 64, 1 << 20)))
        match rng.randrange(8):
            case 0 | 1 if place < len(data):
                data[place] ^= 1 << rng.randrange(8)
            case 2 if place < len(data):
                data[place] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
            case 3:
                number = NUMBER.pack(rng.choice(INTEGERS) % 2**64)
                width = rng.choice((1, 2, 4, 8))
                data[place : place + width] = number[:width]
            case 4:
                del data[place:end]
            case 5 if len(data) < LARGEST:
                data[place:place] = rng.choice((bytes(data[place:end]), rng.randbytes(rng.choice((1, 4, 40)))))
            case 6:
                del data[place:]
            case 7 if len(data) < LARGEST:
                data += rng.choice((bytes(4), bytes(400), rng.randbytes(7)))
    return bytes(data)


_WORD = re.compile(rb"[\w.+-]+")


def mutate_words(content: bytes, rng: Random) -> bytes:
    """Replace, remove and repeat words and lines."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        if rng.random() < 0.7:
            words = [match.span() for match in _WORD.finditer(content)] or [(0, 0)]
            start, end = rng.choice(words)
            content = content[:start] + rng.choice((*WORDS, content[start:end] * 2)) + content[end:]
        else:
            lines = content.split(b"\n")
            i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
            match rng.randrange(4):
                case 0:
                    del lines[i]
                case 1:
                    lines[i], lines[j] = lines[j], lines[i]
                case 2 if len(content) < LARGEST:
                    lines.insert(i, lines[j])
                case 3:
                    lines[i] = b""
            content = b"\n".join(lines)
    return content


def mutate_json(content: bytes, rng: Random) -> bytes:
    kind = rng.random()
    if kind < 0.1:
        return mutate_words(content, rng)
    if kind < 0.105:
        return rng.choice(DEEP)
    root = {"": json.loads(content)}
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        mutate_value(root, rng)
    text = json.dumps(root.get(""))
    if kind < 0.15:  # a duplicate key, or deep nesting
        text = text.replace(",", rng.choice((',"a":0,"a":1,', "," + DEEP[2].decode() + ",")), 1)
    return text.encode()


def mutate_value(root: dict[str, Any], rng: Random) -> None:
    """Change a value somewhere below the only one of ``root``."""
    parent: Any = root
    key: Any = ""
    while parent and isinstance(value := parent[key], dict | list) and value and rng.random() < 0.9:
        parent, key = value, rng.choice(list(value)) if isinstance(value, dict) else rng.randrange(len(value))
    if not parent or (isinstance(parent, dict) and key not in parent):
        return
    value = parent[key]
    match rng.randrange(8):
        case 0 if parent is not root:
            del parent[key]
        case 1 if parent is not root and isinstance(parent, list) and len(parent) < 2000:
            parent.insert(key, value)
        case 1 if parent is not root and isinstance(parent, dict):
            parent[rng.choice(("", "a", "token", "x" * 300, key + " "))] = parent.pop(key)
        case 2 if isinstance(parent, list):
            other = rng.randrange(len(parent))
            parent[key], parent[other] = parent[other], value
        case 2 if isinstance(parent, dict):
            parent[key] = parent[rng.choice(list(parent))]
        case 3 if isinstance(value, int | float):
            half = value // 2 if isinstance(value, int) else value / 2
            parent[key] = rng.choice((-value, value * 1_000_003, value + 1, half, str(value)[:99]))
        case 4:
            parent[key] = [value]
        case _:
            parent[key] = copy.deepcopy(rng.choice(VALUES))


def mutate_lines(content: bytes, rng: Random) -> bytes:
    """Change one line of JSON, or words and the order of lines."""
    lines = content.splitlines()
    if rng.random() < 0.3:
        return mutate_words(content, rng)
    i = rng.randrange(len(lines))
    try:
        lines[i] = mutate_json(lines[i], rng)
    except ValueError:
        lines[i] = mutate_bytes(lines[i], rng)
    return b"\n".join(lines) + b"\n"


_BY_ENDING: dict[str, Callable[[bytes, Random], bytes]] = {
    "json": mutate_json,
    "jsonl": mutate_lines,
    "resume_log": mutate_lines,
    "txt": mutate_words,
    "npy": mutate_words,
    "pcd": mutate_words,
}

"""A reader of TensorBoard's event files, from the descriptions of TFRecord and protobuf."""

import struct
from collections.abc import Iterator
from pathlib import Path

FILE_VERSION, SUMMARY, SESSION_LOG, STEP = 3, 5, 7, 2  # fields of Event


def crc32c(data: bytes) -> int:
    """The CRC with Castagnoli's polynomial, bit by bit, masked as TFRecord does."""
    value = 0xFFFFFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)
    value ^= 0xFFFFFFFF
    return ((value >> 15 | value << 17) + 0xA282EAD8) & 0xFFFFFFFF


def fields(message: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Number and value of each field; fixed numbers stay bytes."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte, at = message[at], at + 1
            value, shift = value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value

    while at < len(message):
        key = varint()
        if key & 7 == 0:
            yield key >> 3, varint()
            continue
        size = {1: 8, 5: 4, 2: None}[key & 7] or varint()
        yield key >> 3, message[at : at + size]
        at += size


def read_events(folder: Path) -> list[dict[int, int | bytes]]:
    """All events of a folder, oldest file first, as their fields; checks lengths and small checksums."""
    events = []
    for file in sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime_ns):
        content, at = file.read_bytes(), 0
        while at < len(content):
            length, length_crc = struct.unpack_from("<QI", content, at)
            body = content[at + 12 : at + 12 + length]
            assert length_crc == crc32c(content[at : at + 8])
            assert len(body) > 4096 or struct.unpack_from("<I", content, at + 12 + length)[0] == crc32c(body)
            events.append(dict(fields(body)))
            at += 16 + length
    return events


def summaries(folder: Path) -> Iterator[tuple[str, int, float | dict[int, int | bytes]]]:
    """Tag, step and value of each summary: a number, or the fields of an image."""
    for event in read_events(folder):
        for _, value in fields(event.get(SUMMARY, b"")):
            parts = dict(fields(value))
            tag, step = parts[1].decode(), event.get(STEP, 0)
            yield tag, step, dict(fields(parts[4])) if 4 in parts else struct.unpack("<f", parts[2])[0]

"""A reader of TensorBoard's event files."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tensorboardX.proto.event_pb2 import Event


def read_events(folder: Path) -> list[Event]:
    """All events of a folder, oldest file first; each is behind its length and a checksum of that."""
    events = []
    for file in sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime_ns):
        content, at = file.read_bytes(), 0
        while at < len(content):
            (length,) = struct.unpack_from("<Q", content, at)
            events.append(Event.FromString(content[at + 12 : at + 12 + length]))
            at += 16 + length
    return events


def summaries(folder: Path) -> Iterator[tuple[str, int, Any]]:
    """Tag, step and value of each summary: a number, or an image."""
    for event in read_events(folder):
        for value in event.summary.value:
            yield value.tag, event.step, value.image if value.HasField("image") else value.simple_value

"""The metrics of a run: one line of JSON per step, and events for TensorBoard."""

import contextlib
import json
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.files import atomic_write, naming

METRICS = "metrics.jsonl"  # file of the metrics in the folder of a run
_START = 1  # SessionLog.START


class MetricsLog:
    """Appends to ``metrics.jsonl`` and writes TensorBoard events in the folder of a run.

    Records of steps after ``first_step``, from which the run resumes, are dropped.
    """

    def __init__(self, folder: Path, *, first_step: int) -> None:
        from tensorboardX import RecordWriter  # the thread of SummaryWriter would print its errors

        file = folder / METRICS
        if file.exists():
            kept = [json.dumps(line) + "\n" for line in read_metrics(folder) if line["step"] <= first_step]
            atomic_write(file, "".join(kept))
        self._lines = file.open("a", encoding="utf-8")
        self._folder = folder / "tensorboard"
        self._folder.mkdir(exist_ok=True)
        with naming(self._folder):
            self._events = RecordWriter(str(self._folder / f"events.out.tfevents.{time.time_ns()}"))
        self._write_event(first_step + 1, file_version="brain.Event:2")
        # TensorBoard then drops earlier events of these steps.
        self._write_event(first_step + 1, session_log={"status": _START})

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        with naming(Path(self._lines.name)):
            self._lines.write(json.dumps({"step": step, **values}) + "\n")
            self._lines.flush()
        scalars = dict[str, Any]()
        for name, value in values.items():
            many = isinstance(value, list)
            scalars |= {f"{name}/{i}": v for i, v in enumerate(value)} if many else {name: value}
        numbers = [
            {"tag": tag, "simple_value": float(value)}  # type: ignore[arg-type]
            for tag, value in scalars.items()
            if np.isscalar(value)
        ]
        self._write_event(step, summary={"value": numbers})

    def write_pictures(self, step: int, pictures: Iterable[Path]) -> None:
        """Show PNG files in TensorBoard, by the number of the frame with which their names end."""
        from PIL import Image

        images = list[dict[str, Any]]()
        for path in pictures:
            with Image.open(path) as picture:
                size = {"width": picture.width, "height": picture.height, "colorspace": len(picture.getbands())}
            tag = f"test/frame_{path.stem.rpartition('_')[2]}"
            images.append({"tag": tag, "image": {**size, "encoded_image_string": path.read_bytes()}})
        self._write_event(step, summary={"value": images})

    def flush(self) -> None:
        """Write buffered events, so that no checkpoint has more steps than the records."""
        with naming(self._folder):
            self._events.flush()

    def close(self) -> None:
        with naming(Path(self._lines.name)), self._lines, naming(self._folder):
            self._events.close()

    def _write_event(self, step: int, **content: Any) -> None:
        from tensorboardX.proto.event_pb2 import Event  # TensorBoard's message # type: ignore[attr-defined]

        event = Event(step=step, wall_time=time.time(), **content)
        with naming(self._folder):
            self._events.write(event.SerializeToString())


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """All records of a run, in order, without invalid lines, such as an incomplete line of a killed run."""
    lines = []
    for text in (folder / METRICS).read_bytes().splitlines():
        with contextlib.suppress(ValueError, RecursionError):  # invalid JSON or UTF-8
            line = json.loads(text)
            if isinstance(line, dict) and isinstance(line.get("step"), int):
                lines.append(line)
    return lines


def evaluated_steps(folder: Path) -> set[int]:
    """Steps after which a run was evaluated; empty without records."""
    return {line["step"] for line in _records(folder) if "test/mAP" in line}


def last_step(folder: Path) -> int:
    """The last step of which a run has metrics; 0 without records."""
    return max((line["step"] for line in _records(folder)), default=0)


def _records(folder: Path) -> list[dict[str, Any]]:
    return read_metrics(folder) if (folder / METRICS).exists() else []

"""The metrics of a run: one line of JSON a step, and the same for TensorBoard."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.files import atomic_write

_FILE = "metrics.jsonl"


class MetricsLog:
    """Appends to ``metrics.jsonl`` and to TensorBoard's events below a run's folder.

    What a killed run recorded of steps after ``first_step``, those done before, is dropped.
    """

    def __init__(self, folder: Path, *, first_step: int) -> None:
        from tensorboardX import SummaryWriter

        file = folder / _FILE
        if file.exists():
            kept = [json.dumps(line) + "\n" for line in read_metrics(folder) if line["step"] <= first_step]
            atomic_write(file, lambda path: path.write_text("".join(kept), encoding="utf-8"))
        self._lines = file.open("a", encoding="utf-8")
        self._events = SummaryWriter(str(folder / "tensorboard"), purge_step=first_step + 1)

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """Record numbers and lists of numbers by name."""
        self._lines.write(json.dumps({"step": step, **values}) + "\n")
        self._lines.flush()
        for name, value in values.items():
            numbers = {f"{name}/{i}": v for i, v in enumerate(value)} if isinstance(value, list) else {name: value}
            for tag, number in numbers.items():
                if np.isscalar(number):
                    self._events.add_scalar(tag, float(number), step)  # type: ignore[arg-type]

    def flush(self) -> None:
        """Write what is waiting, so that a checkpoint never knows of more steps than the records."""
        self._events.flush()

    def close(self) -> None:
        self._lines.close()
        self._events.close()


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """All lines of a run, in order; half a line, of a run that was killed as it wrote, is left out."""
    lines = []
    for text in (folder / _FILE).read_text(encoding="utf-8").splitlines():
        try:
            lines.append(json.loads(text))
        except json.JSONDecodeError:
            break
    return lines

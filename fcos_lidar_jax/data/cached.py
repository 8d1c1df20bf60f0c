"""Frames that are slow to make, kept on disk from the first time on."""

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax import __version__
from fcos_lidar_jax.data.frame import Frame, FrameSet, WrappedFrames, no_points, without_points
from fcos_lidar_jax.data.npy_files import parse_npz
from fcos_lidar_jax.files import atomic_write, read_json

_DESCRIPTION = "frames.json"
_TRUTH = ("boxes", "labels", "num_points")


@dataclasses.dataclass(frozen=True)
class CachedFrames(WrappedFrames):
    """A frame set that makes every frame once.

    The folder holds ``frames.json``, which says whose frames they are, and an archive of NumPy arrays for every
    frame that was asked for. Threads and processes may share it: files appear whole, and whoever makes a frame
    twice makes the same one. A damaged file is made anew, and a line on standard error says so.

    What the description cannot tell, such as changed code of the same version, goes unnoticed: the folder is then
    to be deleted.

    Raises:
        ValueError: at construction, where the folder holds the frames of another set.
        OSError: a file that cannot be written.

    >>> import tempfile
    >>> from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
    >>> from fcos_lidar_jax.sensors import TINY
    >>> folder = Path(tempfile.mkdtemp())
    >>> frames = CachedFrames(SimulatedFrames(TINY, number=2), folder)
    >>> len(frames), bool((frames.frame(1).points == frames.frame(1).points).all())
    (2, True)
    >>> sorted(file.name for file in folder.iterdir())
    ['000001.npz', 'frames.json']
    """

    frames: FrameSet  # what is kept: a dataclass whose fields JSON can hold
    folder: Path  # new, empty, or begun with the same frames

    def __post_init__(self) -> None:
        super().__post_init__()
        wanted, file = _description(self.frames), self.folder / _DESCRIPTION
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"{self.folder}: found a file, expected a folder")
        # In this order: another process may begin the same cache at this moment.
        stray = sorted(p.name for p in self.folder.glob("*.npz") if not p.name.startswith("."))
        if not file.is_file():
            if stray:
                raise ValueError(f"{self.folder}: found {stray[0]} without {_DESCRIPTION}, expected a new folder")
            atomic_write(file, lambda path: path.write_text(json.dumps(wanted, indent=1) + "\n", encoding="utf-8"))
        _compare(file, wanted)

    def frame(self, index: int) -> Frame:
        """One frame, read from its file; made and written where there is none."""
        arrays = self._read(index, (*_TRUTH, "points", "num_close"))
        if arrays is not None:
            num_close = int(arrays.pop("num_close"))
            return Frame(**arrays, num_close=num_close)
        frame = self.frames.frame(index)
        arrays = {name: getattr(frame, name) for name in (*_TRUTH, "points", "num_close")}
        atomic_write(self._file(index), lambda path: np.savez(path, **arrays))
        return frame

    def truth(self, index: int) -> Frame:
        """As of any frame set; where there is no file yet, the whole frame is made and written."""
        arrays = self._read(index, _TRUTH)
        if arrays is None:
            return without_points(self.frame(index))
        boxes, labels, num_points = (arrays[name] for name in _TRUTH)
        return Frame(no_points(self.sensor), boxes, labels, num_points)

    labels = FrameSet.labels

    def _file(self, index: int) -> Path:
        return self.folder / f"{index:06d}.npz"

    def _read(self, index: int, names: Sequence[str]) -> dict[str, np.ndarray] | None:
        """Arrays of a frame's file; None where there is no whole one."""
        file = self._file(index)
        try:
            return parse_npz(file.read_bytes(), names)
        except FileNotFoundError:
            return None
        except Exception as error:  # wrong bytes in an archive raise nearly anything
            reason = str(error).partition("\n")[0] or type(error).__name__
            print(f"warning: {file}: damaged ({reason}): made anew", file=sys.stderr, flush=True)
            return None


def _description(frames: FrameSet) -> dict[str, Any]:
    """What decides every byte of the frames, as JSON returns it."""
    kind = type(frames)
    if not dataclasses.is_dataclass(frames):
        raise ValueError(f"frames: got {kind.__name__}, expected a dataclass")
    try:
        fields = json.loads(json.dumps(dataclasses.asdict(frames)))
    except TypeError as error:
        raise ValueError(f"frames: {kind.__name__}: expected fields that JSON can hold: {error}") from None
    return {"version": __version__, "kind": kind.__qualname__, **fields}


def _compare(file: Path, wanted: dict[str, Any]) -> None:
    """Refuse the folder of another frame set."""
    found = read_json(file, dict[str, Any])
    for name in [*wanted, *(set(found) - set(wanted))]:
        if name not in found or name not in wanted or found[name] != wanted[name]:
            there, got = (_shown(record.get(name, "nothing")) for record in (found, wanted))
            raise ValueError(f"{file}: {name}: found {there}, expected {got}: this folder keeps other frames")


def _shown(value: Any) -> Any:
    """A sensor by its name."""
    return value["name"] if isinstance(value, dict) and "name" in value else value

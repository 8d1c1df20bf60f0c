"""A disk cache for frames that are slow to make."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax import __version__
from fcos_lidar_jax.data.frame import Frame, FrameSet, WrappedFrames, no_points, without_points
from fcos_lidar_jax.data.npy_files import parse_npz
from fcos_lidar_jax.files import atomic_write, read_json
from fcos_lidar_jax.progress import tell

_DESCRIPTION = "frames.json"
_TRUTH = ("boxes", "labels", "num_points")
_FRAME = (*_TRUTH, "points", "num_close")


@dataclasses.dataclass(frozen=True)
class CachedFrames(WrappedFrames):
    """A frame set that makes every frame once and keeps it on disk.

    The folder contains ``frames.json``, which describes the frame set, and one ``.npz`` archive per requested
    frame; one with another set's frames is refused at construction. Threads and processes may share the folder,
    since files appear whole. A damaged file is made again, with a warning on standard error. Changed code of the
    same version goes unnoticed: delete the folder then.

    Raises:
        ValueError: at construction, if the folder contains another set's frames.
        OSError: a file cannot be written.
    """

    frames: FrameSet  # a dataclass with fields that JSON can represent
    folder: Path  # new, empty, or begun with the same frames

    def __post_init__(self) -> None:
        super().__post_init__()
        own, file = _description(self.frames), self.folder / _DESCRIPTION
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"{self.folder}: found a file, expected a folder")
        # Listed before the description is looked for: another process may begin the same cache at this moment.
        archives = sorted(p.name for p in self.folder.glob("*.npz") if not p.name.startswith("."))
        if not file.is_file():
            if archives:
                problem = f"found {archives[0]} without {_DESCRIPTION}, expected a new folder"
                raise ValueError(f"{self.folder}: {problem}")
            atomic_write(file, lambda path: path.write_text(json.dumps(own, indent=1) + "\n", encoding="utf-8"))
        stored = read_json(file, dict[str, Any])
        for name in {**own, **stored}:
            if name not in own or name not in stored or own[name] != stored[name]:
                values = (record.get(name, "nothing") for record in (stored, own))
                there, got = (v["name"] if isinstance(v, dict) and "name" in v else v for v in values)  # sensors
                raise ValueError(f"{file}: {name}: found {there}, expected {got}: this folder keeps other frames")

    def frame(self, index: int) -> Frame:
        if (arrays := self._read(index, _FRAME)) is not None:
            num_close = int(arrays.pop("num_close"))
            return Frame(**arrays, num_close=num_close)
        frame = self.frames.frame(index)
        atomic_write(
            self._file(index), lambda path: np.savez(path, **{name: getattr(frame, name) for name in _FRAME})
        )
        return frame

    def truth(self, index: int) -> Frame:
        """:meth:`frame` without its points; makes and writes the whole frame if there is no file yet."""
        arrays = self._read(index, _TRUTH)
        if arrays is None:
            return without_points(self.frame(index))
        return Frame(no_points(self.sensor), **arrays)

    labels = FrameSet.labels

    def made(self) -> list[int]:
        """Indices of the frames in the folder, ascending."""
        return sorted(int(path.stem) for path in self.folder.glob("[0-9]*.npz"))

    def _file(self, index: int) -> Path:
        return self.folder / f"{index:06d}.npz"

    def _read(self, index: int, names: Sequence[str]) -> dict[str, Any] | None:
        """Arrays of a frame's file; None if the file is missing or damaged."""
        file = self._file(index)
        try:
            return parse_npz(file.read_bytes(), names)
        except FileNotFoundError:
            return None
        except Exception as error:  # damaged archives raise arbitrary exceptions
            reason = str(error).partition("\n")[0] or type(error).__name__
            tell(f"warning: {file}: damaged ({reason}): recreating it")
            return None


def _description(frames: FrameSet) -> dict[str, Any]:
    """Everything that determines the frames, as JSON returns it."""
    kind = type(frames)
    if not dataclasses.is_dataclass(frames):
        raise ValueError(f"frames: got {kind.__name__}, expected a dataclass")
    try:
        fields = json.loads(json.dumps(dataclasses.asdict(frames)))
    except TypeError as error:
        raise ValueError(f"frames: {kind.__name__}: expected fields that JSON can hold: {error}") from None
    if isinstance(sensor := fields.get("sensor"), dict):
        sensor.pop("forward_rad", None)  # changes no frame
    return {"version": __version__, "kind": kind.__qualname__, **fields}

"""A disk cache for frames that are slow to make."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax import __version__
from fcos_lidar_jax.data.frame import Frame, FrameSet, WrappedFrames
from fcos_lidar_jax.data.npy_files import parse_npz
from fcos_lidar_jax.files import atomic_write, read_json
from fcos_lidar_jax.progress import tell

_FRAME = ("boxes", "labels", "num_points", "points", "num_close")


@dataclasses.dataclass(frozen=True)
class CachedFrames(WrappedFrames):
    """A frame set that makes every frame once and keeps it on disk.

    The folder contains ``frames.json``, which describes the frame set, and one ``.npz`` archive per requested
    frame. Threads and processes may share the folder, since files appear whole. A damaged file is made again, with
    a warning on standard error. Changed code of the same version goes unnoticed: delete the folder then.

    Raises:
        ValueError: at construction, if the folder contains another set's frames.
    """

    frames: FrameSet  # a dataclass with fields that JSON can represent
    folder: Path  # new, empty, or begun with the same frames

    def __post_init__(self) -> None:
        super().__post_init__()
        own, file = _description(self.frames), self.folder / "frames.json"
        if not file.is_file():
            atomic_write(file, json.dumps(own, indent=1) + "\n")
        stored = read_json(file, dict[str, Any])
        for name in {**own, **stored}:
            if own.get(name) != stored.get(name):
                raise ValueError(f"{file}: found frames with another {name}: choose another folder")

    def frame(self, index: int) -> Frame:
        if (frame := self._read(index)) is None:
            frame = self.frames.frame(index)
            arrays = {name: getattr(frame, name) for name in _FRAME}
            atomic_write(self._file(index), lambda path: np.savez(path, **arrays))
        return frame

    truth, labels = FrameSet.truth, FrameSet.labels  # of the cached frame

    def made(self) -> list[int]:
        """Indices of the frames in the folder, ascending."""
        return sorted(int(path.stem) for path in self.folder.glob("[0-9]*.npz"))

    def _file(self, index: int) -> Path:
        return self.folder / f"{index:06d}.npz"

    def _read(self, index: int) -> Frame | None:
        """A frame of the folder; None if its file is missing or damaged."""
        file = self._file(index)
        try:
            arrays = parse_npz(file.read_bytes(), _FRAME)
            return Frame(**{**arrays, "num_close": int(arrays["num_close"])})
        except FileNotFoundError:
            return None
        except Exception as error:  # damaged archives raise arbitrary exceptions
            reason = str(error).partition("\n")[0] or type(error).__name__
            tell(f"warning: {file}: damaged ({reason}): recreating it")
            return None


def _description(frames: FrameSet) -> dict[str, Any]:
    """Everything that determines the frames, as JSON returns it."""
    fields = json.loads(json.dumps(dataclasses.asdict(frames)))  # type: ignore[call-overload]
    if isinstance(sensor := fields.get("sensor"), dict):
        sensor.pop("forward_rad", None)  # changes no frame
    return {"version": __version__, "kind": type(frames).__qualname__, **fields}

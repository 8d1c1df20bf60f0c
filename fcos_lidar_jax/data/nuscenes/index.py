"""An index of the tables: the columns that a LiDAR detector needs, as arrays that open quickly."""

import dataclasses
import hashlib
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from fcos_lidar_jax.data.npy_files import parse_npy
from fcos_lidar_jax.data.nuscenes.tables import TABLES
from fcos_lidar_jax.files import FileState, atomic_write, read_json, refusing

_FORMAT, _FORMAT_VERSION = "fcos_lidar_index", 3
_MANIFEST, _AGAIN = "index.json", ": run prepare again"


@dataclasses.dataclass(frozen=True)
class Index:
    """All keyframes, LiDAR sweeps, poses and annotations of one version.

    Rotations are unit quaternions w, x, y, z; translations are in metres, times in microseconds. Samples are
    sorted by scene and time, annotations by sample.
    """

    scene_name: np.ndarray  # str[scenes], in the order of the table
    category_name: np.ndarray  # str[categories]
    attribute_name: np.ndarray  # str[attributes]
    sample_token: np.ndarray  # bytes[samples]
    sample_time_us: np.ndarray  # i64[samples]
    sample_scene: np.ndarray  # i32[samples]: row of the scene
    sample_sweep: np.ndarray  # i32[samples]: row of the keyframe's own sweep
    sample_first: np.ndarray  # i64[samples + 1]: first annotation of each sample, and the end of the last
    sweep_file: np.ndarray  # bytes[sweeps]: path below the data root
    sweep_time_us: np.ndarray  # i64[sweeps]
    sweep_previous: np.ndarray  # i32[sweeps]: the sweep before, -1 at the start of a scene
    sweep_sensor: np.ndarray  # i32[sweeps]: row of the calibrated sensor
    ego_rotation: np.ndarray  # f64[sweeps, 4]: ego to global at the time of the sweep
    ego_translation: np.ndarray  # f64[sweeps, 3]
    sensor_rotation: np.ndarray  # f64[sensors, 4]: sensor to ego
    sensor_translation: np.ndarray  # f64[sensors, 3]
    box_token: np.ndarray  # bytes[annotations]
    box_instance: np.ndarray  # i32[annotations]: row of the instance, one object in a scene
    box_category: np.ndarray  # i16[annotations]: row of the category
    box_attribute: np.ndarray  # i16[annotations]: row of the attribute, -1 for none
    box_translation: np.ndarray  # f64[annotations, 3]: centre, global frame
    box_size: np.ndarray  # f64[annotations, 3]: width, length, height
    box_rotation: np.ndarray  # f64[annotations, 4]: box to global
    box_velocity: np.ndarray  # f64[annotations, 3]: m/s in the global frame, NaN where unknown
    box_lidar_points: np.ndarray  # i32[annotations]
    box_radar_points: np.ndarray  # i32[annotations]


def _tables(folder: str | Path) -> dict[str, Path]:
    files = (Path(folder) / kind.file for kind in TABLES)
    return {file.name: file for file in files if file.is_file()}


def save_index(index: Index, folder: str | Path, *, tables: str | Path) -> None:
    """Write an index of the tables in ``ROOT/VERSION``; the manifest is written last and marks it as complete."""
    folder = Path(folder)
    states = {name: FileState.of(file) for name, file in _tables(tables).items()}
    (folder / _MANIFEST).unlink(missing_ok=True)
    columns = {}
    for name, column in vars(index).items():
        atomic_write(folder / f"{name}.npy", lambda path, column=column: np.save(path, column))
        columns[name] = _summary(column)
    about = {"format": _FORMAT, "format_version": _FORMAT_VERSION, "tables": states}
    text = msgspec.json.encode({**about, "columns": columns})
    atomic_write(folder / _MANIFEST, msgspec.json.format(text, indent=1))


def default_index(root: str | Path, version: str) -> Path:
    """The default folder of ``prepare``'s output: the index of a version of nuScenes, and the cut objects."""
    return Path(root) / ".fcos_lidar" / version


def has_index(folder: str | Path) -> bool:
    """Whether a folder contains a finished index, of any format version."""
    return (Path(folder) / _MANIFEST).is_file()


def open_index(folder: str | Path, *, tables: str | Path) -> Index:
    """Read an index and verify its format, counts, checksums, and that it was made from the tables in
    ``ROOT/VERSION``.
    """
    folder = Path(folder)
    with refusing("", ValueError, more=_AGAIN):
        manifest = read_json(folder / _MANIFEST, _Manifest, what="a finished index")
    indexed, present = manifest.tables, _tables(tables)
    for name in {**present, **indexed}:
        if name not in indexed or name not in present or not indexed[name].holds(present[name]):
            problem = f"the index was made from another table than the one in {tables}{_AGAIN}"
            raise ValueError(f"{folder / _MANIFEST}: {name}: {problem}")
    columns = {}
    for field in dataclasses.fields(Index):
        file = folder / f"{field.name}.npy"
        with refusing(f"{file}: cannot be read", OSError, ValueError, more=_AGAIN):
            column = parse_npy(file.read_bytes())
        if manifest.columns.get(field.name) != _summary(column):
            raise ValueError(f"{file}: content differs from {_MANIFEST}{_AGAIN}")
        columns[field.name] = column
    return Index(**columns)


class _Manifest(msgspec.Struct):
    format: Annotated[str, msgspec.Meta(pattern=f"^{_FORMAT}$")]
    format_version: Annotated[int, msgspec.Meta(ge=_FORMAT_VERSION, le=_FORMAT_VERSION)]
    tables: dict[str, FileState]
    columns: dict[str, dict[str, Any]]


def column_checksums(index: Index) -> list[tuple[str, str]]:
    """Name and checksum of every column, as in the manifest of a saved index."""
    return [(name, _summary(column)["blake2b"]) for name, column in vars(index).items()]


def _summary(column: np.ndarray) -> dict[str, Any]:
    column = np.ascontiguousarray(column)
    described = f"{column.dtype.str}{column.shape}".encode()
    digest = hashlib.blake2b(column.data if column.size else b"", digest_size=16, key=described[:64]).hexdigest()
    return {"rows": len(column), "blake2b": digest}

"""Point clouds from files: raw nuScenes and KITTI, NumPy, PCD, and lists of sweeps."""

import zipfile
from pathlib import Path

import numpy as np

from fcos_lidar_jax.data.pcd import read_pcd
from fcos_lidar_jax.sensors import Sensor

_PLAUSIBLE_M = 300.0
"""No LiDAR here sees farther; the values of a misread file mostly do not look like metres."""
_RAW_COLUMNS = (3, 4, 5, 6)


class PointFileError(ValueError):
    """A point file that cannot be used: one line with the file, the finding and the expectation."""


def read_points(
    path: str | Path, sensor: Sensor, *, columns: int | None = None, dtype: str | None = None
) -> np.ndarray:
    """The points of a file.

    ``.pcd.bin``: float32 x 5, the fifth the ring (nuScenes). ``.bin``: float32 x 4 (KITTI). Other raw layouts by
    ``columns`` and ``dtype``; a fifth column is then the time lag, but in a ``.pcd.bin`` it stays the ring.
    ``.npy`` and ``.npz`` (one array, or one named ``points``): N x 3 to 6. ``.pcd``: by its header.

    Args:
        path: the file.
        sensor: scales the intensity and says whether a laser number is needed.
        columns: values a point in a raw file, 3 to 6.
        dtype: ``float16``, ``float32`` or ``float64``, of a raw file.

    Returns:
        f32[n, c]: x, y, z (metres, the file's frame), intensity (0-255), time lag (seconds), and the laser number
        for sensors whose rows come from it. Missing intensity and lag are 0. Rows keep the file's order;
        non-finite values stay, to be dropped and counted by the projection.

    Raises:
        PointFileError: naming the file, what was found and what was expected.
    """
    path = Path(path)
    if path.is_dir():
        raise PointFileError(f"{path}: found a folder, expected a point file")
    if not path.is_file():
        raise PointFileError(f"{path}: no such file")
    kind = _kind(path)
    if columns is not None and columns not in _RAW_COLUMNS:
        raise PointFileError(f"{path}: columns: got {columns}, expected 3, 4, 5 or 6")
    if kind in (".npy", ".npz", ".pcd") and (columns is not None or dtype is not None):
        raise PointFileError(f"{path}: columns and dtype are for raw .bin files, a {kind} file says its own")
    if path.stat().st_size == 0:
        raise PointFileError(f"{path}: empty file")
    if kind == ".pcd":
        table = read_pcd(path, PointFileError)
        return _assemble(path, sensor, table)
    if kind in (".npy", ".npz"):
        rows = _read_numpy(path, kind)
    else:
        default = 5 if kind == ".pcd.bin" else 4
        rows = _read_raw(path, columns or default, np.dtype(dtype or "float32"), guessed=columns is None)
    names = ["x", "y", "z", "intensity", "time_lag", "laser"]
    if kind == ".pcd.bin" and rows.shape[1] >= 5:
        names[4] = "laser"
        rows = rows[:, :5]
    return _assemble(path, sensor, {name: rows[:, i] for i, name in enumerate(names[: rows.shape[1]])})


def _kind(path: Path) -> str:
    for ending in (".pcd.bin", ".bin", ".npy", ".npz", ".pcd"):
        if path.name.lower().endswith(ending):
            return ending
    raise PointFileError(f"{path}: unknown extension {path.suffix!r}, expected .pcd.bin, .bin, .npy, .npz or .pcd")


def _read_raw(path: Path, columns: int, dtype: np.dtype, *, guessed: bool) -> np.ndarray:
    size, row = path.stat().st_size, columns * dtype.itemsize
    if size % row:
        raise PointFileError(
            f"{path}: {size} bytes are not a multiple of {row} ({columns} {dtype} values a point): truncated, or "
            "another layout, to be named by columns and dtype"
        )
    values = np.fromfile(path, dtype).astype(np.float32)
    rows = values.reshape(-1, columns)
    share = _plausible_share(rows)
    others = {c: _plausible_share(values.reshape(-1, c)) for c in (4, 5) if c != columns and len(values) % c == 0}
    better = max(others, key=others.__getitem__, default=None)
    if share < 0.5 or (better is not None and others[better] > share + 0.15):
        hint = f", {better} columns would fit" if better and others[better] > share else ""
        raise PointFileError(
            f"{path}: read with {columns} {dtype} columns most values are not plausible metres{hint}: "
            f"{'name' if guessed else 'check'} columns and dtype"
        )
    return rows


def _plausible_share(rows: np.ndarray) -> float:
    """Part of the rows that look like a LiDAR's points.

    Metres within reach, and heights that stay within tens of metres: intensities, rings or misplaced
    abscissas in the third column do not. Non-finite rows say nothing.
    """
    finite = np.isfinite(rows).all(axis=1)
    if not finite.any():
        return 1.0
    xyz = np.abs(rows[finite, :3])
    good = (xyz < _PLAUSIBLE_M).all(axis=1) & (rows[finite, 2] > -15) & (rows[finite, 2] < 40)
    # Denormal numbers are other types misread, not metres.
    good &= ~((xyz > 0) & (xyz < 1e-20)).any(axis=1)
    if rows.shape[1] > 3:
        good &= (rows[finite, 3] >= 0) & (rows[finite, 3] < 1e5)
    return float(good.mean())


def _read_numpy(path: Path, kind: str) -> np.ndarray:
    try:
        if kind == ".npy":
            array = np.load(path, allow_pickle=False)
        else:
            with np.load(path, allow_pickle=False) as archive:
                names = archive.files
                if len(names) != 1 and "points" not in names:
                    raise PointFileError(
                        f"{path}: got arrays {', '.join(names) or 'none'}, expected one, or one named points"
                    )
                array = archive["points" if "points" in names else names[0]]
    except PointFileError:
        raise
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError) as error:
        reason = " ".join(str(error).split())
        raise PointFileError(f"{path}: not a readable {kind} file without pickled objects: {reason}") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        found = getattr(array, "dtype", type(array).__name__)
        raise PointFileError(f"{path}: dtype: got {found}, expected real numbers")
    if array.ndim != 2 or array.shape[1] not in _RAW_COLUMNS:
        raise PointFileError(f"{path}: shape: got {array.shape}, expected N x 3, 4, 5 or 6")
    return array


def _assemble(path: Path, sensor: Sensor, table: dict[str, np.ndarray]) -> np.ndarray:
    """The contract's columns from named ones."""
    number = len(table["x"])
    if number == 0:
        raise PointFileError(f"{path}: no points in it")
    points = np.zeros((number, sensor.point_columns), np.float32)
    with np.errstate(over="ignore"):
        for i, name in enumerate(("x", "y", "z", "intensity", "time_lag")):
            if name in table:
                points[:, i] = table[name]
    points[:, 3] *= np.float32(sensor.intensity_scale)
    lag = points[:, 4]
    if (lag < 0).any():
        raise PointFileError(f"{path}: time_lag: got {lag[lag < 0][0]:g}, expected seconds of at least 0")
    if sensor.row_source == "laser":
        if "laser" not in table:
            raise PointFileError(f"{path}: no laser number (sixth column), which sensor {sensor.name} needs")
        laser = table["laser"]
        known = np.isfinite(laser.astype(np.float64))
        if ((laser < 0) | (laser >= sensor.num_rows) | (laser != np.floor(laser)))[known].any():
            raise PointFileError(f"{path}: laser number: expected whole numbers of 0 to {sensor.num_rows - 1}")
        points[:, 5] = laser
    return points

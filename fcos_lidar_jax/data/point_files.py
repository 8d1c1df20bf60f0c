"""Point clouds from files: raw nuScenes and KITTI, NumPy, PCD, Feather of Argoverse 2."""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fcos_lidar_jax.data.npy_files import parse_npy, parse_npz
from fcos_lidar_jax.data.pcd import parse_pcd
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.files import expect_file, import_extra, local_path, refusing
from fcos_lidar_jax.sensors import Sensor

ENDINGS = (".pcd.bin", ".bin", ".npy", ".npz", ".pcd", ".feather")  # supported names, the longest first
_RAW_COLUMNS = (3, 4, 5, 6)
MAX_SWEEPS = 100  # default limit of the sweeps in a cloud, far more than anybody fuses
MAX_TIME_LAG_S = 60.0  # far above any fusion; larger values, like negative ones, are timestamps or damage
MAX_POINTS = 10_000_000  # default limit of a cloud, far above any LiDAR's
BYTES_PER_POINT = 64  # limit of a cloud's size, as a file and unpacked
_HEADER_BYTES = 2**20
_UNIX_S = 1e9  # larger times, since 2001, are no ages

# Criteria for whether a raw file is read in the layout in which it was written.
_REACH_M = 300.0  # no supported LiDAR sees farther
_HEIGHT_M = (-15.0, 40.0)  # from ditches to bridges; other columns' values lie outside
_FINEST_M = 1e-6  # finer than any LiDAR resolves: text, or another number type
_MIN_PLAUSIBLE = 0.8  # share of rows; a right layout reaches 0.99, four in place of five columns 0.6
_INSPECTED_VALUES = 240_000  # a multiple of every number of columns


def read_points(
    path: str | Path,
    sensor: Sensor,
    *,
    columns: int | None = None,
    dtype: str | None = None,
    max_points: int = MAX_POINTS,
    num_sweeps: int = MAX_SWEEPS,
    viewpoint: bool = False,
) -> np.ndarray:
    """Read the points of a file.

    ``.pcd.bin`` (nuScenes): float32 x 5 with the intensity (0-255) and the ring. ``.bin`` (KITTI): float32 x 4.
    ``columns`` and ``dtype`` give another raw layout, for any file name; its fifth column is the time lag, except
    in a ``.pcd.bin``, where it stays the ring. ``.npy`` and ``.npz`` (one array, or one named ``points``): N x 3
    to 6. ``.pcd``: by its header. ``.feather`` (Argoverse 2): columns x, y, z, intensity, laser_number;
    see :func:`rank_lasers`.

    The size of a raw file cannot distinguish four from five columns, so the file is also refused if its values do
    not look like metres.

    Args:
        sensor: scales the intensity, except in ``.pcd.bin``, and determines whether laser numbers are needed.
        columns: values per point in a raw file, 3 to 6.
        dtype: ``float16``, ``float32`` or ``float64``, of a raw file.
        max_points: larger clouds are refused by their header or size, before they take memory.
        num_sweeps: largest number of different time lags; a column with more is probably something else.
        viewpoint: transform the points by the VIEWPOINT of a ``.pcd`` file.

    Returns:
        f32[n, c]: x, y, z (metres, the file's frame), intensity (0-255), time lag (seconds), and the laser number
        for sensors whose rows come from it. Missing intensity and lag are 0. The row order is the file's;
        non-finite values are kept, and dropped and counted by the projection. A file may say that it has no
        points, but files of 0 bytes are refused.

    Raises:
        ValueError: with the file, the field, the found and the expected value.

    >>> import tempfile
    >>> from fcos_lidar_jax.sensors import KITTI_HDL64E
    >>> file = Path(tempfile.mkdtemp()) / "000000.bin"
    >>> np.array([[20, 3, -1.5, 0.2], [8, -2, -1.7, 0.4]], np.float32).tofile(file)
    >>> read_points(file, KITTI_HDL64E).tolist()
    [[20.0, 3.0, -1.5, 51.0, 0.0], [8.0, -2.0, -1.7000000476837158, 102.0, 0.0]]
    """
    path = local_path(path)
    kind = _kind(path, raw=columns is not None or dtype is not None)
    if viewpoint and kind != ".pcd":
        raise ValueError(f"{path}: viewpoint: expected a .pcd file")
    if kind.endswith(".bin"):
        return _read_raw(path, sensor, kind, columns, dtype, max_points, num_sweeps)
    if columns is not None or dtype is not None:
        raise ValueError(f"{path}: columns and dtype are for raw .bin files, a {kind} file says its own")
    if kind == ".feather":
        names = ("x", "y", "z", "intensity", "laser_number")
        table = read_feather(path, dict.fromkeys(names, "fiu"), max_rows=max_points)
        points = assemble_points(path, sensor, {**table, "laser": table["laser_number"]})
        return rank_lasers(points, sensor) if sensor.row_source == "laser" else points
    content, max_bytes = _read_whole(path, max_points), max_points * BYTES_PER_POINT
    with refusing(f"{path}: not a readable {kind} file", ValueError):
        if kind == ".pcd":
            limits = {"max_points": max_points, "max_bytes": max_bytes}
            parsed = parse_pcd(content, str(path), **limits, viewpoint=viewpoint)
        elif kind == ".npy":
            parsed = parse_npy(content, max_rows=max_points)
        else:
            parsed = parse_npz(content, ["points"], max_rows=max_points, max_bytes=max_bytes)["points"]
    if isinstance(parsed, dict):
        return assemble_points(path, sensor, parsed, num_sweeps)
    return points_from_array(parsed, sensor, str(path), num_sweeps)


def points_from_array(
    array: ArrayLike, sensor: Sensor, where: str = "points", num_sweeps: int = MAX_SWEEPS
) -> np.ndarray:
    """Convert an array, which ``where`` names in messages, to the columns that :func:`read_points` returns.

    Args:
        array: [n, 3 to 6], of NumPy or JAX, or a list: x, y, z, intensity, time lag, laser number.
        sensor, num_sweeps: as in :func:`read_points`.

    Raises:
        ValueError: wrong shape or type, or a fifth column of something else, see :func:`check_time_lags`.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> points_from_array(np.array([[8, 1, -1]]), TINY).tolist()
    [[8.0, 1.0, -1.0, 0.0, 0.0]]
    """
    array = np.asarray(array)
    if array.dtype.kind not in "fiu" or array.ndim != 2 or array.shape[1] not in _RAW_COLUMNS:
        found = f"{array.dtype} of shape {array.shape}"
        raise ValueError(f"{where}: got {found}, expected real numbers of shape [n, 3 to 6]")
    names = ("x", "y", "z", "intensity", "time_lag", "laser")
    return assemble_points(where, sensor, dict(zip(names, array.T, strict=False)), num_sweeps)


def rank_lasers(points: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Number the lasers of f32[n, 6] anew, by the median inclination of their points.

    The lowest laser gets the last row. Lasers without points, which see only the sky, count as the highest.

    >>> from fcos_lidar_jax.sensors import ARGOVERSE2
    >>> points = np.array([[9, 0, 3, 0, 0, 5], [9, 0, -1, 0, 0, 0], [9, 0, 1, 0, 0, 31]], np.float32)
    >>> rank_lasers(points, ARGOVERSE2)[:, 5].tolist()
    [61.0, 63.0, 62.0]
    """
    usable = np.isfinite(points).all(axis=1)
    x, y, z = (points[usable, :3] - np.asarray(sensor.origin_m, np.float32)).T
    inclination = np.arctan2(z, np.hypot(x, y))
    lasers, of_point = np.unique(points[usable, 5], return_inverse=True)
    medians = [np.median(inclination[of_point == i]) for i in range(len(lasers))]
    rows = np.empty(len(lasers), np.float32)
    rows[np.argsort(medians, kind="stable")[::-1]] = np.arange(sensor.num_rows - len(lasers), sensor.num_rows)
    ranked = points.copy()
    ranked[usable, 5] = rows[of_point]
    return ranked


def check_time_lags(lag: np.ndarray, where: Path | str = "points", num_sweeps: int = MAX_SWEEPS) -> None:
    """Refuse a column that is no time lag in seconds: negative or Unix times, another unit, a ring, or more
    different values than sweeps.

    >>> check_time_lags(np.linspace(0, 1.5, 820), "a.bin")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ValueError: a.bin: fifth column: got 820 different values up to 1.5, expected the time lag in seconds, one ...
    """
    lag = lag[np.isfinite(lag)]  # rows of NaN stand for missing returns
    if not lag.size:
        return
    least, most = float(lag.min()), float(lag.max())
    is_unix = most >= _UNIX_S and np.median(lag) >= _UNIX_S  # a few may be damage
    if is_unix or (most > 1 and not (lag % 1).any()):
        kind = "values" if is_unix else "whole numbers"
        found = f"{kind} up to {most:g}, which look like {'Unix time' if is_unix else 'a ring'}"
        expected = "the time lag in seconds: leave the column out, or put 0 into it and a ring into a sixth"
        raise ValueError(f"{where}: fifth column: got {found}, expected {expected}")
    if np.count_nonzero((lag < 0) | (lag > MAX_TIME_LAG_S)) > lag.size / 10:
        expected = "the age of each sweep in seconds, 0 for the current one"
        raise ValueError(f"{where}: fifth column: got values from {least:g} to {most:g}, expected {expected}")
    check_num_lags(lag, where, num_sweeps)


def check_num_lags(lag: np.ndarray, where: Path | str = "points", num_sweeps: int = MAX_SWEEPS) -> None:
    """Refuse more different time lags than sweeps: times within a turn, or something else."""
    lag = lag[(lag >= 0) & (lag <= MAX_TIME_LAG_S)]  # other rows are dropped later
    number = len(np.unique(np.append(lag[:1], lag[1:][lag[1:] != lag[:-1]])))  # fast for sweeps in blocks
    if number > num_sweeps:
        raise ValueError(
            f"{where}: fifth column: got {number} different values up to {lag.max():g}, expected the time lag in "
            f"seconds, one per sweep, at most {num_sweeps} (num_sweeps): leave out older sweeps, or a column of "
            "something else, as in points[:, :4]; --columns cannot skip it"
        )


def read_feather(path: Path, kinds: Mapping[str, str], *, max_rows: int = MAX_POINTS) -> dict[str, np.ndarray]:
    """Read columns of an Apache Feather file (version 2), at most ``max_rows`` long; needs the extra
    ``argoverse2``.

    ``kinds`` maps columns to NumPy's letters of the allowed types: ``"fiu"`` numbers, ``"iu"`` whole numbers,
    ``"O"`` texts. Rows without a value are refused.
    """
    pyarrow = import_extra("pyarrow", "argoverse2", f"{path}: ")
    content = _read_whole(path, max_rows)
    with refusing(f"{path}: not a readable .feather file"):  # corrupt files raise arbitrary exceptions
        reader, batches, num_rows, columns = pyarrow.ipc.open_file(content), [], 0, {}
        for i in range(reader.num_record_batches):
            batches.append(reader.get_batch(i))
            num_rows += batches[-1].num_rows
            if num_rows > max_rows:
                raise ValueError(f"got more than {max_rows} rows, expected at most {max_rows}")
        table = pyarrow.Table.from_batches(batches, reader.schema)
        for name, kind in kinds.items():
            column = table.column(name)
            column.validate(full=True)  # crafted files may contain wrong offsets and lengths
            columns[name] = values = column.to_numpy()
            fits = values.dtype.kind in kind and (kind != "O" or all(isinstance(text, str) for text in values))
            if column.null_count or not fits:
                got = f"{column.null_count} rows without a value" if column.null_count else column.type
                expected = {"fiu": "numbers", "iu": "whole numbers", "O": "texts"}[kind]
                raise ValueError(f"{name}: got {got}, expected {expected}")
    return columns


def check_inside(file: Path, folder: Path | None, where: str) -> None:
    """Refuse a file that a link or ``..`` leads out of a folder, if any; ``where`` names it in the message."""
    if folder and not Path(real := os.path.realpath(file)).is_relative_to(os.path.realpath(folder)):
        found = f"resolves to {real}, expected a file inside {folder}"
        raise ValueError(f"{where}: {found}; --follow-links allows links that lead out")


def _read_whole(path: Path, max_points: int) -> bytes:
    """The bytes of a file, which may be at most as large as a cloud."""
    limit = max_points * BYTES_PER_POINT + _HEADER_BYTES
    with refusing(f"{path}: cannot be read", OSError):
        size = path.stat().st_size
        if not 0 < size <= limit:
            raise ValueError(f"{path}: got {size} bytes, expected 1 to {limit} for at most {max_points} points")
        return path.read_bytes()


def _kind(path: Path, *, raw: bool) -> str:
    """The file's extension among :data:`ENDINGS`; with ``raw`` any other name counts as ``.bin``."""
    expect_file(path, "a point file")
    for ending in ENDINGS:
        if path.name.lower().endswith(ending):
            return ending
    if raw:
        return ".bin"
    expected = f"{', '.join(ENDINGS)}, or the columns and dtype of a raw file"
    raise ValueError(f"{path}: unknown extension {path.suffix!r}, expected {expected}")


def _read_raw(
    path: Path, sensor: Sensor, kind: str, columns: int | None, dtype: str | None, max_points: int, num_sweeps: int
) -> np.ndarray:
    if columns is None:
        columns = 5 if kind == ".pcd.bin" else 4
    dtype = dtype or "float32"
    check(columns in _RAW_COLUMNS, f"{path}: columns", columns, "3, 4, 5 or 6")
    content, row = _read_whole(path, max_points), columns * np.dtype(dtype).itemsize
    layout = f"{columns} {dtype} values per point"
    other = "detect, stream and project read other layouts by --columns and --dtype"
    number, rest = divmod(len(content), row)
    if number > max_points or rest:
        expected = f"a multiple of {row}, at most {max_points * row} ({layout})"
        raise ValueError(f"{path}: got {len(content)} bytes, expected {expected}: truncated? {other}")
    rows = np.frombuffer(content, dtype).reshape(-1, columns)
    if _plausible_share(rows[: _INSPECTED_VALUES // columns]) < _MIN_PLAUSIBLE:
        raise ValueError(f"{path}: read with {layout}, most rows are not plausible metres; {other}")
    if kind != ".pcd.bin":
        return points_from_array(rows, sensor, str(path), num_sweeps)
    sensor = dataclasses.replace(sensor, intensity_scale=1.0)  # the format's intensities are already 0-255
    return assemble_points(path, sensor, dict(zip(("x", "y", "z", "intensity", "laser"), rows.T, strict=False)))


def _plausible_share(rows: np.ndarray) -> float:
    """Share of the finite rows with plausible metres and intensity."""
    with np.errstate(invalid="ignore"):  # misread numbers may be NaNs that signal
        rows = rows.astype(np.float64)
    rows = rows[np.isfinite(rows).all(axis=1)]
    xyz = np.abs(rows[:, :3])
    good = (xyz < _REACH_M).all(axis=1) & ((xyz == 0) | (xyz > _FINEST_M)).all(axis=1)
    good &= (rows[:, 2] > _HEIGHT_M[0]) & (rows[:, 2] < _HEIGHT_M[1])
    if rows.shape[1] > 3:
        good &= (rows[:, 3] >= 0) & (rows[:, 3] < 2**16)
    return float(good.mean()) if len(rows) else 1.0


def assemble_points(
    where: Path | str, sensor: Sensor, table: Mapping[str, np.ndarray], num_sweeps: int = MAX_SWEEPS
) -> np.ndarray:
    """Combine the columns x, y, z, intensity, time_lag and laser to the array that :func:`read_points` returns.

    Refuses what is no time lag of at most ``num_sweeps`` sweeps, and missing or invalid laser numbers.
    """
    if "time_lag" in table:
        check_time_lags(table["time_lag"], where, num_sweeps)
    points = np.zeros((len(table["x"]), sensor.point_columns), np.float32)
    # Values too large for float32 become infinite, and are dropped with other non-finite values.
    with np.errstate(over="ignore", invalid="ignore"):
        for i, name in enumerate(("x", "y", "z", "intensity", "time_lag")):
            if name in table:
                points[:, i] = table[name]
        points[:, 3] *= np.float32(sensor.intensity_scale)
        points *= np.float32(1)  # turns signalling NaNs, which would raise warnings later, into quiet ones
    negative = np.flatnonzero(points[:, 4] < 0)
    if len(negative):
        lag = f"{points[negative[0], 4]:g} in row {negative[0]}"
        raise ValueError(f"{where}: time_lag: got {lag}, expected seconds of at least 0")
    if sensor.row_source == "laser":
        if "laser" not in table:
            expected = f"one for every point, since sensor {sensor.name} needs it"
            raise ValueError(f"{where}: no laser number in it, expected {expected}")
        laser = table["laser"].astype(np.float64)
        bad = np.flatnonzero(np.isfinite(laser) & ((laser < 0) | (laser >= sensor.num_rows) | (laser % 1 != 0)))
        if len(bad):
            expected = f"whole numbers of 0 to {sensor.num_rows - 1}"
            raise ValueError(f"{where}: laser number: got {laser[bad[0]]:g} in row {bad[0]}, expected {expected}")
        points[:, 5] = laser
    return points

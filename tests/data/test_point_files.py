"""Point files: every supported layout is read exactly; damaged files are refused in one line that names them."""

import io
import itertools
import tracemalloc
import zipfile

import numpy as np
import pyarrow
import pyarrow.feather
import pytest
from refusal import refused

from fcos_lidar_jax.data import point_files
from fcos_lidar_jax.data.point_files import points_from_array, read_points
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, NUSCENES_HDL32E
from fcos_lidar_jax.simulation.frames import make_frame


@pytest.fixture(scope="module")
def points():
    return make_frame(0, NUSCENES_HDL32E).points[:2048]


def nuscenes_rows(points):
    rows = points.copy()
    rows[:, 4] = np.arange(len(rows)) % 32
    return rows


def pcd_header(form, number, fields="x y z intensity", kinds="", sizes="", counts=""):
    """By default, the fields are single numbers of type float32."""
    width = len(fields.split())
    kinds, sizes, counts = kinds or "F " * width, sizes or "4 " * width, counts or "1 " * width
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {kinds}\nCOUNT {counts}\n"
        f"WIDTH {number}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {number}\nDATA {form}\n"
    ).encode()


def packed_body(packed, plain_size):
    return np.array([len(packed), plain_size], "<u4").tobytes() + packed


def save(path, content):
    """Write bytes, an array or a dictionary of arrays in the format of the file name."""
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, dict):
        np.savez_compressed(path, **content)
    elif path.suffix == ".bin":
        content.tofile(path)
    else:
        np.savez(path, content) if path.suffix == ".npz" else np.save(path, content, allow_pickle=True)
    return path


def feather(points):
    columns = dict(zip(("x", "y", "z", "intensity"), points.T, strict=True))
    stream, table = io.BytesIO(), pyarrow.table(columns | {"laser_number": np.zeros(len(points), "u1")})
    pyarrow.feather.write_feather(table, stream, compression="zstd", chunksize=1000)
    return stream.getvalue()


def test_every_ending_is_read(tmp_path, points):
    """Of several arrays in an archive the one named points is read; a single array may have any name."""
    rows = points[:, :4]
    contents = {
        ".pcd.bin": [nuscenes_rows(points)],
        ".bin": [rows],
        ".npy": [rows, rows.astype(np.float64)],
        ".npz": [{"points": rows, "other": np.zeros(3)}, {"cloud": rows}],
        ".pcd": [pcd_header("binary", len(rows)) + rows.tobytes()],
        ".feather": [feather(rows)],
    }
    assert tuple(contents) == point_files.ENDINGS
    for ending in contents:
        for content in contents[ending]:
            read = read_points(save(tmp_path / f"a{ending}", content), NUSCENES_HDL32E)
            np.testing.assert_array_equal(read[:, :4], rows)
            assert not read[:, 4].any()


def test_the_laser_number_is_the_ring_or_the_sixth_column(tmp_path, points):
    path = save(tmp_path / "a.pcd.bin", nuscenes_rows(points))
    np.testing.assert_array_equal(read_points(path, ARGOVERSE2)[:, 5], np.arange(2048) % 32)
    rows = np.concatenate([points, (np.arange(2048) % 64)[:, None]], 1).astype(np.float32)
    np.testing.assert_array_equal(read_points(save(tmp_path / "a.npy", rows), ARGOVERSE2)[:, 5], rows[:, 5])


@pytest.mark.parametrize("value", [-1, 64, 1.5])
def test_invalid_and_missing_laser_numbers_are_refused(value):
    with refused(f"laser number: got {value:g} in row 0, expected whole"):
        points_from_array([[1, 2, 0, 3, 0, value]], ARGOVERSE2)
    with refused("no laser number"):
        points_from_array(np.zeros((1, 5)), ARGOVERSE2)


@pytest.mark.parametrize("name", ["a.bin", "a.npy", "a.pcd.bin"])
def test_intensities_are_scaled_except_in_nuscenes_files(tmp_path, points, name):
    rows = nuscenes_rows(points)
    if name != "a.pcd.bin":
        rows = points[:, :4] / np.array([1, 1, 1, 255], np.float32)
    read = read_points(save(tmp_path / name, rows), KITTI_HDL64E)
    np.testing.assert_allclose(read[:, 3], points[:, 3], rtol=1e-5)


@pytest.mark.parametrize(("columns", "dtype"), [(3, "float16"), (4, "float64"), (5, "float32"), (None, "float64")])
@pytest.mark.parametrize("name", ["a.bin", "000001.f64", "scan"])
def test_with_columns_or_dtype_a_file_of_any_name_is_raw(tmp_path, points, name, columns, dtype):
    width = columns or 4
    rows = points[:, :width].astype(dtype)
    if width == 5:
        rows[:, 4] = 0.05
    path = save(tmp_path / name, rows.tobytes())
    read = read_points(path, NUSCENES_HDL32E, columns=columns, dtype=dtype)
    np.testing.assert_array_equal(read[:, :width], rows.astype(np.float32))
    assert not read[:, width:].any()


def lzf(half: bytes) -> bytes:
    """LZF of the bytes twice: literals, then copies from as far before as the bytes are long."""
    literals = b"".join(bytes([31]) + half[i : i + 32] for i in range(0, len(half), 32))
    high, low = divmod(len(half) - 1, 256)
    return literals + bytes([(7 << 5) + high, 256 - 9, low]) * (len(half) // 256)


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_pcd_files_are_read_by_their_header(tmp_path, points, form):
    """Fields may have any type, size, count and order; unknown fields are skipped."""
    kinds = {"ring": "<u2", "X": "<f8", "y": "<f4", "normal": ("<f4", (2,)), "intensity": "u1"}
    kinds |= {"_": ("<i2", (3,)), "z": "<f2", "time_lag": "<f4", "t": "<i8"}
    record = np.dtype([(name, kind) for name, kind in kinds.items()])
    half = np.zeros(1024, record)
    half["ring"], half["X"], half["y"], half["z"] = np.arange(1024) % 64, *points[:1024, :3].T
    half["intensity"], half["time_lag"] = points[:1024, 3], 0.25
    half["normal"], half["t"] = np.nan, -(2**40)
    rows = np.tile(half, 2)
    base = [record[name].base for name in record.names]
    kinds, sizes = " ".join(b.kind.upper() for b in base), " ".join(str(b.itemsize) for b in base)
    counts = " ".join(str(record[i].itemsize // b.itemsize) for i, b in enumerate(base))
    body = rows.tobytes()
    if form == "ascii":
        lines = (" ".join(str(v) for field in row.item() for v in np.ravel(field)) for row in rows)
        body = "\r\n".join(lines).encode()
    elif form == "binary_compressed":
        body = packed_body(b"".join(lzf(half[name].tobytes()) for name in record.names), len(body))
    head = pcd_header(form, len(rows), " ".join(record.names), kinds, sizes, counts)
    path = save(tmp_path / "a.PCD", head + body)
    expected = np.column_stack([rows[name] for name in ("X", "y", "z", "intensity", "time_lag", "ring")])
    np.testing.assert_array_equal(read_points(path, ARGOVERSE2), expected)
    np.testing.assert_array_equal(read_points(path, NUSCENES_HDL32E), expected[:, :5])


def test_a_pcd_file_compressed_by_liblzf_is_read(tmp_path):
    """The points are x = 1, 2, 3, 4, 1, ..., y = 0, z = -1.5."""
    packed = bytes.fromhex("070000803f000000402002200300804003e0360fe0470001c0bfe0410301c0bf")
    head = pcd_header("binary_compressed", 20, "x y z")
    read = read_points(save(tmp_path / "a.pcd", head + packed_body(packed, 240)), NUSCENES_HDL32E)
    np.testing.assert_array_equal(read, [[1 + i % 4, 0, -1.5, 0, 0] for i in range(20)])


def test_old_pcd_headers_and_the_numbers_of_other_libraries_are_read(tmp_path):
    rows = b"5 2 -1 9\n-nan(ind) 1.#QNAN -1.#IND00 1.#INF\nnan(snan) nan 2 3\n"
    for header in (b"COLUMNS x y z intensity\nPOINTS 3\nDATA ascii\n", pcd_header("ascii", 3)):
        read = read_points(save(tmp_path / "a.pcd", header + rows), NUSCENES_HDL32E)
        assert read[0].tolist() == [5, 2, -1, 9, 0]
        assert np.isnan(read[1:, 0]).all()
        assert np.isnan(read[1]).sum() == 4
    old = b"# .PCD v.5\nVERSION .5\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nDATA ascii\n5 2 -1\n"
    assert read_points(save(tmp_path / "a.pcd", old), NUSCENES_HDL32E).tolist() == [[5, 2, -1, 0, 0]]


@pytest.mark.parametrize("turned", [False, True])
def test_the_viewpoint_of_a_pcd_file_is_told_or_applied(tmp_path, capsys, turned):
    """A quarter of a turn about z, then a metre along x."""
    words = "1 0 0 0.7071068 0 0 0.7071068" if turned else "0 0 0 -1 0 0 0"
    header = pcd_header("ascii", 1).replace(b"VIEWPOINT 0 0 0 1 0 0 0", f"VIEWPOINT {words}".encode())
    path = save(tmp_path / "a.pcd", header + b"5 2 -1 9\n")
    for _ in range(2):
        assert read_points(path, NUSCENES_HDL32E).tolist() == [[5, 2, -1, 9, 0]]
    told = f"note: {path}: its VIEWPOINT {words!r} is not applied; --viewpoint applies it\n"
    assert capsys.readouterr().err == (told if turned else "")
    moved = read_points(path, NUSCENES_HDL32E, viewpoint=True)
    np.testing.assert_allclose(moved, [[-1, 5, -1, 9, 0] if turned else [5, 2, -1, 9, 0]], atol=1e-6)
    assert capsys.readouterr().err == ""


def test_a_viewpoint_that_cannot_be_applied_is_refused(tmp_path):
    header = pcd_header("ascii", 1)
    for words in ("0 0 0 0 0 0 0", "0 0 0 1", "-nan(ind) 0 0 1 0 0 0"):
        path = save(tmp_path / "a.pcd", header.replace(b" 0 0 0 1 0 0 0", f" {words}".encode()) + b"5 2 -1 9\n")
        assert read_points(path, NUSCENES_HDL32E)[0, 0] == 5
        with refused(f"damaged header: VIEWPOINT: got {words!r}, expected", path):
            read_points(path, NUSCENES_HDL32E, viewpoint=True)
    with refused("viewpoint: expected a .pcd file"):
        read_points(save(tmp_path / "a.bin", np.zeros((4, 4), np.float32)), NUSCENES_HDL32E, viewpoint=True)


@pytest.mark.parametrize(
    ("field", "told"), [("i", False), ("Scalar_Intensity", False), ("signal", True), ("intensity_2", True)]
)
def test_fields_like_an_intensity_are_read_or_told(tmp_path, capsys, field, told):
    path = save(tmp_path / "a.pcd", pcd_header("ascii", 1, f"x y z {field}") + b"5 2 -1 9\n")
    assert read_points(path, NUSCENES_HDL32E)[0, 3] == (0 if told else 9)
    assert (f"note: {path}: field {field.lower()!r} is not read: rename" in capsys.readouterr().err) == told


def test_non_finite_points_are_kept(tmp_path, points):
    """Too large values become infinite without a warning."""
    rows = nuscenes_rows(points)
    rows[7, 0], rows[9, 2] = np.nan, np.inf
    read = read_points(save(tmp_path / "a.pcd.bin", rows), NUSCENES_HDL32E)
    assert np.flatnonzero(~np.isfinite(read).all(1)).tolist() == [7, 9]
    rows = points[:, :4].astype(np.float64)
    rows[3, 0], rows[5, 3] = 1e300, 3e38
    read = read_points(save(tmp_path / "a.bin", rows), KITTI_HDL64E, dtype="float64")
    assert np.flatnonzero(np.isinf(read).any(1)).tolist() == [3, 5]
    for name in ("a.bin", "a.npy"):
        path = save(tmp_path / name, np.full((20, 5), np.nan, np.float32))
        assert not np.isfinite(read_points(path, NUSCENES_HDL32E)[:, :4]).any()


@pytest.mark.parametrize("intensity_scale", [1, 1 / 255, 0], ids=["0-255", "0-1", "none"])
@pytest.mark.parametrize("number", [40, 2000])
def test_four_and_five_columns_are_distinguished_by_their_values(tmp_path, points, intensity_scale, number):
    rows = nuscenes_rows(points)[:number]
    rows[:, 3] *= intensity_scale
    four = save(tmp_path / "four.pcd.bin", rows[:, :4])
    assert read_points(four, NUSCENES_HDL32E, columns=4).shape == (number, 5)
    with refused("5 float32 values per point, most rows are not plausible metres", four):
        read_points(four, NUSCENES_HDL32E)
    for fifth in (rows[:, 4], 0):  # a ring, a time lag
        rows[:, 4] = fifth
        with refused("4 float32 values per point, most rows are not plausible metres"):
            read_points(save(tmp_path / "five.bin", rows), KITTI_HDL64E)


@pytest.mark.parametrize(("stored", "named"), [*itertools.permutations(("float16", "float32", "float64"), 2)])
def test_a_wrong_dtype_is_refused(tmp_path, points, stored, named):
    with refused(f"4 {named} values per point, most rows are not plausible metres"):
        read_points(save(tmp_path / "a.bin", points[:, :4].astype(stored)), NUSCENES_HDL32E, dtype=named)


@pytest.mark.parametrize(
    ("name", "number", "options", "message"),
    [
        ("a.bin", 1800, {"columns": 6}, "most rows are not plausible metres"),
        ("a.bin", 999, {}, "got 19980 bytes, expected a multiple of 16, at most 160000000 (4 float32 values per"),
        ("a.bin", 8, {"columns": 7}, "columns: got 7, expected 3, 4, 5 or 6"),
        ("a.npy", 8, {"columns": 4}, "columns and dtype are for raw .bin files"),
        ("a.pcd", 8, {"dtype": "float32"}, "columns and dtype are for raw .bin files"),
    ],
)
def test_wrong_layouts_are_refused(tmp_path, points, name, number, options, message):
    path = save(tmp_path / name, nuscenes_rows(points)[:number].tobytes())
    with refused(message, path):
        read_points(path, NUSCENES_HDL32E, **options)


@pytest.mark.real_data
def test_a_real_keyframe_is_read_and_other_layouts_are_refused(real_data, tmp_path):
    (path,) = (real_data / "nuscenes_scene0061").glob("*.pcd.bin")
    read = read_points(path, NUSCENES_HDL32E)
    assert read.shape == (34_688, 5)
    for options in ({"columns": 4}, {"dtype": "float16"}):
        with refused("not plausible metres"):
            read_points(path, NUSCENES_HDL32E, **options)
    for scale in (1, 1 / 255):
        four = save(tmp_path / "four.pcd.bin", read[:34_680, :4] * np.array([1, 1, 1, scale], np.float32))
        with refused("not plausible metres"):
            read_points(four, NUSCENES_HDL32E)


def one_of(values):
    return values, f"got {len(np.unique(values))} different values up to {values.max():g}, expected the time lag"


NO_LAGS = {
    "elongation": one_of(np.linspace(0, 1.5, 820, dtype=np.float32)),
    "times within a turn": one_of(np.arange(820, dtype=np.float32) / 8200),
    "scaled ring": one_of(np.arange(820) % 16 / np.float32(15)),
    "ring": (np.arange(820) % 16, "got whole numbers up to 15, which look like a ring"),
    "Unix seconds": (1.5e9 + np.arange(820) / 8192, "got values up to 1.5e+09, which look like Unix time"),
    "Unix nanoseconds": (1.5e18 + np.arange(820), "got values up to 1.5e+18, which look like Unix time"),
    "negative": (np.arange(820) % 4 * -0.05, "got values from -0.15 to -0, expected the age of each sweep"),
    "milliseconds": (np.arange(820) % 4 * 49.951, "got values from 0 to 149.853, expected the age of each sweep"),
}


@pytest.mark.parametrize("kind", NO_LAGS)
def test_a_fifth_column_of_something_else_is_refused(points, kind):
    values, message = NO_LAGS[kind]
    with refused(f"points: fifth column: {message}"):
        points_from_array(np.column_stack([points[:820, :4], values]), NUSCENES_HDL32E, num_sweeps=10)


@pytest.mark.parametrize(("name", "columns"), [("a.bin", 5), ("a.bin", 6), ("a.npy", None), ("a.pcd", None)])
def test_the_fifth_column_is_checked_in_every_kind_of_file(tmp_path, points, name, columns):
    values, message = NO_LAGS["elongation"]
    rows = np.column_stack([points[:820, :4], values, np.zeros(820)])[:, : columns or 5].astype(np.float32)
    pcd = pcd_header("binary", 820, "x y z intensity time_lag") + rows.tobytes()
    path = save(tmp_path / name, pcd if name == "a.pcd" else rows)
    with refused(f"fifth column: {message}", path):
        read_points(path, NUSCENES_HDL32E, columns=columns, num_sweeps=10)


def test_as_many_time_lags_as_sweeps_are_read(points):
    lags = np.float32(np.arange(8) * 0.05)
    for rows in (np.resize(lags, 2048), np.repeat(lags, 256)):
        rows = np.column_stack([points[:, :4], rows])
        np.testing.assert_array_equal(points_from_array(rows, NUSCENES_HDL32E, num_sweeps=8), rows)
        with refused("points: fifth column: got 8 different values up to 0.35, expected"):
            points_from_array(rows, NUSCENES_HDL32E, num_sweeps=7)


def npy_header(shape):
    text = f"{{'descr':'<f4','fortran_order':False,'shape':{shape}}}".ljust(53) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


GOOD = np.tile(np.array([[5, 6, -1, 30, 2]], np.float32), (8, 1)).tobytes()
NPY = npy_header((40, 4)) + np.ones((40, 4), np.float32).tobytes()


def packed_pcd(packed, plain_size=16, number=1):
    return pcd_header("binary_compressed", number) + packed_body(packed, plain_size)


def wrapping_pcd():
    """A point of 2**32 + 12 bytes, whose size is 12 where it wraps in 32 bits, and only a few of its bytes."""
    names = " ".join(f"f{i}" for i in range(2**13))
    sizes, kinds, counts = "8 " * 2**13, "F " * 2**13, f"{2**16} " * 2**13
    header = pcd_header("binary", 1, f"x y z {names}", f"F F F {kinds}", f"4 4 4 {sizes}", f"1 1 1 {counts}")
    return header + bytes(4096)


def zipped(method, size=1000):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr("points.npy", npy_header((9, 4)) + bytes(size))
    return stream.getvalue()


def with_size(archive, size):
    """The archive with another unpacked size in the header of its only member."""
    at = archive.index(b"PK\x01\x02") + 24
    return archive[:at] + np.array(size, "<u4").tobytes() + archive[at + 4 :]


BAD = {
    "missing.bin": (None, "no such file"),
    "empty.bin": (b"", "got 0 bytes, expected 1 to"),
    ".": (None, "found a folder"),
    "truncated.pcd.bin": (GOOD[:-3], "got 157 bytes, expected a multiple of 20"),
    "text.bin": (b"12.5 3.75 -1.25 0.5\n" * 80, "not plausible metres"),
    "noise.bin": (np.random.default_rng(0).bytes(16_000), "not plausible metres"),
    "millimetres.bin": (np.full((9, 4), 5000, np.float32), "not plausible metres"),
    "cloud.ply": (b"ply", "unknown extension '.ply', expected .pcd.bin"),
    "really_npy.npz": (NPY, "not a readable .npz file"),
    "pickled.npy": (np.array([{"a": 1}], object), "without pickled objects"),
    "truncated.npy": (NPY[:-7], "not a readable .npy file: got 633 bytes of values, expected 640"),
    "header.npy": (npy_header((9, 4)).replace(b"}", b","), "not a readable .npy file"),
    "huge.npy": (npy_header((2 * 10**13, 4)), "got 20000000000000 points, expected at most 10000000"),
    "wrapping.npy": (npy_header((4, 2**62)), "got 0 bytes of values, expected 73786976294838206464"),
    "negative.npy": (npy_header((-4, -4)) + bytes(64), "for (-4, -4) of float32"),
    "bomb.npz": (with_size(zipped(zipfile.ZIP_DEFLATED), 3 * 2**30), "got 3221225472 bytes, compressed by"),
    "bzip2.npz": (zipped(zipfile.ZIP_BZIP2), "compressed by method 12, expected"),
    "several.npz": ({"a": np.zeros((3, 4)), "b": np.zeros((3, 4))}, "got arrays a, b"),
    "one_axis.npy": (np.zeros(5, np.float32), "got float32 of shape (5,), expected"),
    "nine_columns.npy": (np.zeros((5, 9), np.float32), "got float32 of shape (5, 9), expected"),
    "complex.npy": (np.zeros((5, 4), complex), "got complex128 of shape (5, 4), expected real"),
    "ring.npy": (np.array([[8, 1, -1, 3, 31], [np.nan] * 5]), "fifth column: got whole numbers up to 31, which"),
    "future.npy": (np.column_stack([np.full((20, 4), 5), -0.1 * np.eye(20)[0]]), "time_lag: got -0.1 in row 0"),
    "no_header.pcd": (b"hello\nworld\n", "no DATA line"),
    "form.pcd": (pcd_header("zipped", 1) + b"1 2 3 4", "damaged header: 'zipped'"),
    "short.pcd": (pcd_header("binary", 9) + b"1234", "DATA: truncated: got 4 bytes, expected 144"),
    "short_ascii.pcd": (pcd_header("ascii", 2) + b"1 2 3 4\n", "DATA: got 4 values, expected 2 points of 4"),
    "long_ascii.pcd": (pcd_header("ascii", 1) + b"1 2 3 4 5\n", "DATA: got 5 values, expected 1 points of 4"),
    "words.pcd": (pcd_header("ascii", 1) + b"1 2 3 four\n", "could not convert string to float: b'four'"),
    "no_z.pcd": (pcd_header("ascii", 1, "x y q intensity") + b"1 2 3 4\n", "FIELDS: got x y q intensity"),
    "two_x.pcd": (pcd_header("ascii", 1, "x y z x") + b"1 2 3 4\n", "FIELDS: got x y z x, expected"),
    "kind.pcd": (pcd_header("ascii", 1, kinds="F F F Q") + b"1 2 3 4\n", "damaged header"),
    "lists.pcd": (pcd_header("ascii", 1, sizes="4 4") + b"1 2 3 4\n", "damaged header"),
    "count.pcd": (pcd_header("ascii", 1, counts="1 1 1 0") + b"1 2 3\n", "COUNT and POINTS: got 1 1 1 0 and 1"),
    "double_z.pcd": (pcd_header("ascii", 1, counts="1 1 2 1") + b"1 2 3 3 4\n", "expected one value per column"),
    "negative.pcd": (pcd_header("binary", -1) + bytes(64), "expected one value per column"),
    "wrapping.pcd": (wrapping_pcd(), "POINTS: got 1 points of 4294967308 bytes, expec"),
    "wrapping_64.pcd": (pcd_header("binary", 2**60) + bytes(4096), f"POINTS: got {2**60} points of 16 bytes"),
    "expanding.pcd": (packed_pcd(b"\x00aa", 2**26, 2**22), "DATA: got 3 compressed bytes of 67108864"),
    "no_number.pcd": (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nDATA ascii\n1 2 3\n", "damaged header: 'WIDTH'"),
    "ends_within.pcd": (packed_pcd(b"\xff\xff\xff"), "the compressed bytes are damaged"),
    "before.pcd": (packed_pcd(b"\x00a\x20\x05"), "the compressed bytes are damaged"),
    "unpacks_short.pcd": (packed_pcd(b"\x00a"), "damaged: they do not unpack to 16 bytes"),
    "other_size.pcd": (packed_pcd(b"\x00a", 99), "DATA: got 2 compressed bytes of 99"),
    "packed_short.pcd": (packed_pcd(b"\x00a")[:-1], "DATA: got 2 compressed bytes of 16, 1 of them in the file"),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_point_files_are_refused(tmp_path, name):
    content, message = BAD[name]
    if content is not None:
        save(tmp_path / name, content)
    with refused(message, tmp_path / name):
        read_points(tmp_path / name, NUSCENES_HDL32E)


def test_files_that_say_that_they_have_no_points_are_accepted(tmp_path):
    files = {"a.npy": np.zeros((0, 4), np.float32), "a.npz": {"points": np.zeros((0, 5))}}
    files |= {f"{form}.pcd": pcd_header(form, 0) for form in ("ascii", "binary", "binary_compressed")}
    for name, content in files.items():
        assert read_points(save(tmp_path / name, content), NUSCENES_HDL32E).shape == (0, 5)


def expect_little_memory(read, limit, *fragments):
    """The peak before the refusal is below a limit in bytes."""
    tracemalloc.start()
    with refused(*fragments):
        read()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < limit


def test_an_archive_is_unpacked_no_further_than_its_stated_size(tmp_path):
    path = save(tmp_path / "a.npz", with_size(zipped(zipfile.ZIP_DEFLATED, 2**25), 1000))
    expect_little_memory(lambda: read_points(path, NUSCENES_HDL32E), 2**22, "not a readable .npz file")


def test_a_file_larger_than_any_cloud_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "a.npy").open("wb") as file:
        file.truncate(2**40)  # a sparse file
    with refused("got 1099511627776 bytes, expected 1 to", "for at most 10000000 points"):
        read_points(tmp_path / "a.npy", NUSCENES_HDL32E)


@pytest.mark.parametrize("name", ["a.bin", "a.npy", "a.npz", "a.pcd", "packed.pcd", "ascii.pcd", "a.feather"])
def test_a_cloud_of_too_many_points_is_refused_before_it_takes_memory(tmp_path, name):
    """The limit is an option."""
    number = 300_000
    zeros = np.zeros((number, 4), np.float32)
    # One literal zero, then copies of the 264 bytes before: LZF's longest.
    packed = b"\x00\x00" + b"\xe0\xff\x00" * (16 * number // 264 + 1)
    contents = {
        "a.npz": {"points": zeros},
        "a.pcd": pcd_header("binary", number) + zeros.tobytes(),
        "packed.pcd": packed_pcd(packed, 16 * number, number),
        "ascii.pcd": pcd_header("ascii", number) + b"0 0 0 0\n" * number,
        "a.feather": feather(zeros),
    }
    path = save(tmp_path / name, contents.get(name, zeros))
    limit = 1.1 * path.stat().st_size + 2**21
    expect_little_memory(lambda: read_points(path, NUSCENES_HDL32E, max_points=number - 1), limit, path, "at most")

"""Readers: every layout comes back as it was, and every bad file gets one line that names it."""

import json

import numpy as np
import pytest

from fcos_lidar_jax.data.keyframe import read_keyframe
from fcos_lidar_jax.data.point_files import PointFileError, read_points
from fcos_lidar_jax.data.sweeps import read_sweeps
from fcos_lidar_jax.data.synthetic.frames import make_frame
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, NUSCENES_HDL32E, TINY


@pytest.fixture(scope="module")
def points():
    return make_frame(0, NUSCENES_HDL32E).points[:2000]


def nuscenes_rows(points):
    rows = points.copy()
    rows[:, 4] = np.arange(len(rows)) % 32
    return rows


def pcd_header(form, number, fields="x y z intensity", kinds="F F F F", sizes="4 4 4 4", counts="1 1 1 1"):
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {kinds}\nCOUNT {counts}\n"
        f"WIDTH {number}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {number}\nDATA {form}\n"
    ).encode()


def lzf(data: bytes) -> bytes:
    """A packer that writes literals, and one long run as a copy that overlaps itself."""
    run = len(data) - len(data.rstrip(data[-1:]))
    out = bytearray()
    head = data[: len(data) - run + 1] if run > 20 else data
    for i in range(0, len(head), 32):
        out += bytes([len(head[i : i + 32]) - 1]) + head[i : i + 32]
    left = len(data) - len(head)
    while left > 0:
        take = min(left, 264) if left >= 3 else left
        if take >= 9:
            out += bytes([7 << 5, take - 9, 0])
        elif take >= 3:
            out += bytes([(take - 2) << 5, 0])
        else:
            out += bytes([take - 1]) + data[-take:]
        left -= take
    return bytes(out)


def test_nuscenes_file_drops_the_ring_and_lag_is_zero(tmp_path, points):
    path = tmp_path / "a.pcd.bin"
    nuscenes_rows(points).tofile(path)
    read = read_points(path, NUSCENES_HDL32E)
    np.testing.assert_array_equal(read[:, :4], points[:, :4])
    assert not read[:, 4].any()


def test_kitti_file_scales_the_intensity(tmp_path, points):
    rows = points[:, :4].copy()
    rows[:, 3] /= 255
    path = tmp_path / "000.bin"
    rows.tofile(path)
    read = read_points(path, KITTI_HDL64E)
    np.testing.assert_allclose(read[:, 3], points[:, 3], rtol=1e-5)
    np.testing.assert_array_equal(read[:, :3], points[:, :3])


@pytest.mark.parametrize("columns", [3, 4, 5])
@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
def test_other_raw_layouts_by_columns_and_dtype(tmp_path, points, columns, dtype):
    rows = points[:, :columns].astype(dtype)
    if columns == 5:
        rows[:, 4] = 0.05
    path = tmp_path / "a.bin"
    rows.tofile(path)
    read = read_points(path, NUSCENES_HDL32E, columns=columns, dtype=dtype)
    np.testing.assert_array_equal(read[:, :columns], rows.astype(np.float32))
    assert not read[:, columns:].any()


@pytest.mark.parametrize("ending", [".npy", ".npz"])
@pytest.mark.parametrize("columns", [3, 4, 5])
def test_numpy_files(tmp_path, points, ending, columns):
    path = tmp_path / f"a{ending}"
    rows = points[:, :columns]
    np.save(path, rows) if ending == ".npy" else np.savez(path, points=rows, other=np.zeros(3))
    read = read_points(path, NUSCENES_HDL32E)
    np.testing.assert_array_equal(read[:, :columns], rows)


def test_laser_number_is_the_sixth_column_or_the_ring(tmp_path, points):
    rows = np.concatenate([points, (np.arange(len(points)) % 64)[:, None]], 1).astype(np.float32)
    np.save(tmp_path / "a.npy", rows)
    read = read_points(tmp_path / "a.npy", ARGOVERSE2)
    np.testing.assert_array_equal(read[:, 5], rows[:, 5])
    nuscenes_rows(points).tofile(tmp_path / "a.pcd.bin")
    np.testing.assert_array_equal(read_points(tmp_path / "a.pcd.bin", ARGOVERSE2)[:, 5], np.arange(2000) % 32)


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_pcd_files_by_their_header(tmp_path, points, form):
    names = "x y z normal intensity ring"
    kinds, sizes, counts = "F F F F F U", "4 4 4 4 4 2", "1 1 1 2 1 1"
    record = np.dtype([*[(n, "<f4") for n in "xyz"], ("normal", "<f4", (2,)), ("i", "<f4"), ("ring", "<u2")])
    rows = np.zeros(len(points), record)
    for i, name in enumerate("xyz"):
        rows[name] = points[:, i]
    rows["i"] = np.round(points[:, 3])
    head = pcd_header(form, len(rows), names, kinds, sizes, counts)
    if form == "ascii":
        lines = [
            f"{r['x']!r} {r['y']!r} {r['z']!r} 0 0 {r['i']} 0".replace("np.float32(", "").replace(")", "")
            for r in rows
        ]
        body = "\n".join(lines).encode()
    elif form == "binary":
        body = rows.tobytes()
    else:
        plain = b"".join(np.ascontiguousarray(rows[n]).tobytes() for n in record.names)
        packed = lzf(plain)
        assert len(packed) < len(plain)
        body = np.array([len(packed), len(plain)], "<u4").tobytes() + packed
    (tmp_path / "a.pcd").write_bytes(head + body)
    read = read_points(tmp_path / "a.pcd", NUSCENES_HDL32E)
    np.testing.assert_allclose(read[:, :3], points[:, :3], rtol=1e-6)
    np.testing.assert_array_equal(read[:, 3], np.round(points[:, 3]))
    assert not read[:, 4].any()


def test_non_finite_points_are_kept_for_the_projection_to_count(tmp_path, points):
    rows = nuscenes_rows(points)
    rows[7, 0], rows[9, 2] = np.nan, np.inf
    rows.tofile(tmp_path / "a.pcd.bin")
    read = read_points(tmp_path / "a.pcd.bin", NUSCENES_HDL32E)
    assert np.flatnonzero(~np.isfinite(read).all(1)).tolist() == [7, 9]


def test_four_and_five_columns_are_told_apart(tmp_path, points):
    nuscenes_rows(points).tofile(tmp_path / "five.bin")
    with pytest.raises(PointFileError, match=r"five\.bin: .*not plausible metres.*5 columns would fit"):
        read_points(tmp_path / "five.bin", KITTI_HDL64E)
    np.ascontiguousarray(points[:, :4]).tofile(tmp_path / "four.pcd.bin")
    with pytest.raises(PointFileError, match=r"four\.pcd\.bin: .*not plausible metres.*4 columns would fit"):
        read_points(tmp_path / "four.pcd.bin", NUSCENES_HDL32E)


@pytest.mark.real_data
def test_real_keyframe_reads_whole_and_refuses_four_columns(real_data):
    (path,) = (real_data / "nuscenes_scene0061").glob("*.pcd.bin")
    assert read_points(path, NUSCENES_HDL32E).shape == (34_688, 5)
    with pytest.raises(PointFileError, match="not plausible metres"):
        read_points(path, NUSCENES_HDL32E, columns=4)


def good_bytes():
    return np.tile(np.array([[5, 6, -1, 30, 2]], np.float32), (8, 1)).tobytes()


BAD = {
    "missing.bin": (None, "no such file"),
    "empty.bin": (b"", "empty file"),
    "empty.npy": (b"", "empty file"),
    "empty.pcd": (b"", "empty file"),
    "truncated.pcd.bin": (good_bytes()[:-3], "not a multiple of 20"),
    "odd.bin": (good_bytes()[:-4], "not a multiple of 16"),
    "cloud.ply": (b"ply", "unknown extension '.ply'"),
    "noextension": (b"1 2 3", "unknown extension"),
    "text.npy": (b"1 2 3\n4 5 6\n", "not a readable .npy"),
    "text.npz": (b"1 2 3\n4 5 6\n", "not a readable .npz"),
    "pickled.npy": (np.array([{"a": 1}], object), "without pickled objects"),
    "one_axis.npy": (np.zeros(5, np.float32), r"shape: got \(5,\)"),
    "two_columns.npy": (np.zeros((5, 2), np.float32), r"shape: got \(5, 2\)"),
    "nine_columns.npy": (np.zeros((5, 9), np.float32), r"shape: got \(5, 9\)"),
    "text_values.npy": (np.array([["a", "b", "c"]]), "dtype: got <U1"),
    "complex.npy": (np.zeros((5, 4), complex), "dtype: got complex128"),
    "no_rows.npy": (np.zeros((0, 4), np.float32), "no points"),
    "future.npy": (np.full((5, 5), -0.1, np.float32), "time_lag: got -0.1"),
    "several.npz": ({"a": np.zeros((3, 4)), "b": np.zeros((3, 4))}, "got arrays a, b"),
    "no_header.pcd": (b"hello\nworld\n", "no DATA line"),
    "form.pcd": (pcd_header("zipped", 1) + b"1 2 3 4", "DATA: got 'zipped'"),
    "short.pcd": (pcd_header("binary", 9) + b"1234", "truncated"),
    "short_ascii.pcd": (pcd_header("ascii", 2) + b"1 2 3 4\n", "truncated: got 4 values"),
    "words.pcd": (pcd_header("ascii", 1) + b"1 2 3 four\n", "not a number"),
    "no_z.pcd": (pcd_header("ascii", 1, "x y q intensity") + b"1 2 3 4\n", "FIELDS: no z"),
    "kind.pcd": (pcd_header("ascii", 1, kinds="F F F Q") + b"1 2 3 4\n", "field intensity: got TYPE Q"),
    "lists.pcd": (pcd_header("ascii", 1, sizes="4 4") + b"1 2 3 4\n", "must list as many"),
    "damaged.pcd": (
        pcd_header("binary_compressed", 1) + np.array([3, 16], "<u4").tobytes() + b"\xff\xff\xff",
        "damaged",
    ),
}


def write(path, content):
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, dict):
        np.savez(path, **content)
    elif content is not None:
        np.save(path, content, allow_pickle=True)


@pytest.mark.parametrize("name", BAD)
def test_bad_files_get_one_line(tmp_path, name):
    content, message = BAD[name]
    write(tmp_path / name, content)
    with pytest.raises(PointFileError, match=message) as caught:
        read_points(tmp_path / name, NUSCENES_HDL32E)
    assert str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_folder_is_refused(tmp_path):
    with pytest.raises(PointFileError, match="found a folder"):
        read_points(tmp_path, NUSCENES_HDL32E)


@pytest.mark.parametrize("value", [-1, 64, 1.5])
def test_bad_or_missing_laser_numbers_are_refused(tmp_path, value):
    np.save(tmp_path / "a.npy", np.array([[1, 2, 0, 3, 0, value]], np.float32))
    with pytest.raises(PointFileError, match="laser number: expected whole numbers of 0 to 63"):
        read_points(tmp_path / "a.npy", ARGOVERSE2)
    np.save(tmp_path / "b.npy", np.zeros((1, 5), np.float32))
    with pytest.raises(PointFileError, match=r"b\.npy: no laser number"):
        read_points(tmp_path / "b.npy", ARGOVERSE2)


def pose(rng):
    yaw = rng.uniform(-3, 3)
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    matrix[:3, 3] = rng.uniform(-1000, 1000, 3)
    return matrix


def test_sweeps_see_a_fixed_world(tmp_path):
    """Points fixed in the world land on the same place from every pose; lags are exact microseconds."""
    rng = np.random.default_rng(0)
    poses = [pose(rng) for _ in range(4)]
    world = np.concatenate([poses[0][:3, 3] + rng.uniform(-20, 20, (50, 3)), np.ones((50, 4 - 3))], 1)
    entries = []
    for i, matrix in enumerate(poses):
        local = (np.linalg.inv(matrix) @ world.T).T[:, :3]
        np.save(tmp_path / f"{i}.npy", local)
        stamp = 1_532_402_927_647_951 - 49_999 * i
        entries.append({"file": f"{i}.npy", "timestamp_us": stamp, "sensor_to_world": matrix.tolist()})
    (tmp_path / "sweeps.json").write_text(json.dumps(entries))
    fused = read_sweeps(tmp_path / "sweeps.json", NUSCENES_HDL32E, remove_close="none", close_m=1.0)
    expected = (np.linalg.inv(poses[0]) @ world.T).T[:, :3]
    for i in range(4):
        part = fused[50 * i : 50 * (i + 1)]
        np.testing.assert_allclose(part[:, :3], expected, atol=2e-4)
        np.testing.assert_array_equal(part[:, 4], np.float32(0.049999 * i))


@pytest.mark.parametrize(("mode", "counts"), [("all", [1, 1]), ("sweeps", [2, 1]), ("none", [2, 2])])
def test_close_points_are_judged_in_their_own_sweep(tmp_path, mode, counts):
    moved = np.eye(4)
    moved[0, 3] = 10
    np.save(tmp_path / "a.npy", np.array([[0.5, 0, 0], [10, 0, 0]]))
    entries = [
        {"file": "a.npy", "timestamp_us": 100, "sensor_to_world": moved.tolist()},
        {"file": "a.npy", "timestamp_us": 50, "sensor_to_world": np.eye(4).tolist()},
    ]
    (tmp_path / "s.json").write_text(json.dumps(entries))
    fused = read_sweeps(tmp_path / "s.json", TINY, remove_close=mode, close_m=1.0)
    assert [int((fused[:, 4] == 0).sum()), int((fused[:, 4] > 0).sum())] == counts
    if mode == "all":  # the old sweep's far point now lies at the sensor and stays
        assert [0, 0, 0] in fused[:, :3].tolist()


EYE = np.eye(4).tolist()
BAD_SWEEPS = {
    "not json": ("{", "not JSON"),
    "not a list": ({"a": 1}, "got dict, expected a list"),
    "empty": ([], "expected a list of at least one sweep"),
    "not an object": ([3], r"\[0\]: got int"),
    "no pose": ([{"file": "a.npy", "timestamp_us": 1}], r"\[0\].sensor_to_world: missing"),
    "time": ([{"file": "a.npy", "timestamp_us": 1.5, "sensor_to_world": EYE}], "timestamp_us: got 1.5"),
    "file": ([{"file": 3, "timestamp_us": 1, "sensor_to_world": EYE}], r"\[0\].file: got 3"),
    "shape": ([{"file": "a.npy", "timestamp_us": 1, "sensor_to_world": EYE[:3]}], "expected 4 rows"),
    "text": ([{"file": "a.npy", "timestamp_us": 1, "sensor_to_world": [["a"] * 4] * 4}], "expected 4 rows"),
    "last row": ([{"file": "a.npy", "timestamp_us": 1, "sensor_to_world": [*EYE[:3], [1, 1, 1, 1]]}], "last row"),
    "scaled": (
        [{"file": "a.npy", "timestamp_us": 1, "sensor_to_world": (np.diag([2, 2, 2, 1.0])).tolist()}],
        "not a rotation",
    ),
    "future": (
        [
            {"file": "a.npy", "timestamp_us": 1, "sensor_to_world": EYE},
            {"file": "a.npy", "timestamp_us": 2, "sensor_to_world": EYE},
        ],
        r"\[1\].timestamp_us: got 2",
    ),
}


@pytest.mark.parametrize("name", BAD_SWEEPS)
def test_bad_sweep_lists_get_one_line(tmp_path, name):
    content, message = BAD_SWEEPS[name]
    np.save(tmp_path / "a.npy", np.ones((3, 3)))
    path = tmp_path / "sweeps.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(PointFileError, match=message) as caught:
        read_sweeps(path, NUSCENES_HDL32E, remove_close="all", close_m=1.0)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_keyframe_folder_gives_points_boxes_and_unknown_velocities(tmp_path, points):
    nuscenes_rows(points).tofile(tmp_path / "a.pcd.bin")
    box = dict(zip("xyzlwh", range(1, 7), strict=True)) | {"yaw": 0.5, "vx": None, "vy": None, "num_lidar_pts": 9}
    boxes = [{**box, "class": "truck"}, {**box, "class": None}]
    (tmp_path / "boxes.json").write_text(json.dumps({"lidar_file": "a.pcd.bin", "boxes": boxes}))
    frame = read_keyframe(tmp_path, NUSCENES_HDL32E)
    np.testing.assert_array_equal(frame.boxes, np.array([[1, 2, 3, 4, 5, 6, 0.5, np.nan, np.nan]], np.float32))
    assert frame.labels.tolist() == [1]
    assert frame.num_points.tolist() == [9]
    assert len(frame.points) == len(points)
    for text, message in [("{", "not JSON"), ('{"boxes": []}', "'lidar_file'"), ('{"boxes": 3}', "missing or of")]:
        (tmp_path / "boxes.json").write_text(text)
        with pytest.raises(PointFileError, match=message):
            read_keyframe(tmp_path, NUSCENES_HDL32E)


@pytest.mark.real_data
def test_real_keyframe_has_its_boxes(real_data):
    frame = read_keyframe(real_data / "nuscenes_scene0061", NUSCENES_HDL32E)
    assert frame.boxes.shape == (68, 9)
    assert np.isnan(frame.boxes[:, 7]).sum() == 2
    assert (frame.num_points == 0).sum() == 3

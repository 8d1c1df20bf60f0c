"""ROS recordings: point layouts of drivers, poses against closed forms, one-line errors."""

import re
import sys

import numpy as np
import pytest
from made_bags import FORMS, Messages, structured, write_recording
from refusal import refused
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.data.ros_bags import is_ros_bag, ros_bag_drive
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, TINY

START_NS = 1_700_000_000_123_456_789
POINTS = structured(np.random.default_rng(0).uniform(1, 20, (12, 4)).astype(np.float32))
NO_TURN = (0, 0, 0, 1)
VELOCITY, YAW_RATE = np.array([8.0, -3.0, 0.5]), 0.7


def clouds(*stamps_ns, texts=0):
    """Clouds after messages of another topic."""

    def content(make):
        yield from [("/chatter", make.text("hello"))] * texts
        yield from (("/p", make.cloud(stamp, POINTS)) for stamp in stamps_ns)

    return content


one_cloud = clouds(1)


def one_sweep(folder, points, **changed):
    """Write a message of points, and read it."""
    bag = write_recording(folder / "a", "sqlite", lambda make: [("/p", make.cloud(1, points, **changed))])
    [sweep] = ros_bag_drive(bag, TINY).sweeps
    return sweep


def data_file(bag):
    return bag if bag.is_file() else next(file for file in bag.iterdir() if file.suffix != ".yaml")


def layout(itemsize, **fields):
    """name=(type, offset)"""
    kinds, places = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": kinds, "offsets": places, "itemsize": itemsize})


XYZ = {"x": ("f4", 0), "y": ("f4", 4), "z": ("f4", 8)}
DRIVERS = {
    "velodyne": layout(22, **XYZ, intensity=("f4", 12), ring=("u2", 16), time=("f4", 18)),
    "ouster": layout(
        48,
        **XYZ,
        **{"intensity": ("f4", 16), "t": ("u4", 20), "reflectivity": ("u2", 24), "ring": ("u1", 26)},
        **{"ambient": ("u2", 28), "range": ("u4", 32)},
    ),
    "hesai": layout(26, **XYZ, intensity=("f4", 12), timestamp=("f8", 16), ring=("u2", 24)),
    "livox": layout(26, **XYZ, intensity=("f4", 12), tag=("u1", 16), line=("u1", 17), timestamp=("f8", 18)),
    "big-endian": layout(18, z=(">f4", 0), y=(">f4", 4), x=(">f4", 8), intensity=(">f4", 12), ring=(">u2", 16)),
    "doubles": layout(29, ring=("i4", 25), x=("f8", 1), y=("f8", 9), z=("f8", 17), reflectivity=("u1", 0)),
}


@pytest.mark.parametrize("driver", DRIVERS)
def test_clouds_of_common_drivers_are_read(tmp_path, driver):
    rng, dtype = np.random.default_rng(1), DRIVERS[driver]
    points = np.frombuffer(rng.bytes(dtype.itemsize * 20), dtype).copy()  # noise in the gaps and in other fields
    values = rng.integers(1, 60, (20, 4))
    laser = next(name for name in ("ring", "line") if name in dtype.names)
    light = "reflectivity" if "reflectivity" in dtype.names else "intensity"  # of Ouster's both, not the signal
    for name, column in zip(("x", "y", "z", light), values.T, strict=True):
        points[name] = column
    points[laser] = np.arange(20)
    bag = write_recording(tmp_path / "a", "mcap", lambda make: [("/points", make.cloud(START_NS, points))])
    [sweep] = ros_bag_drive(bag, ARGOVERSE2).sweeps
    expected = np.column_stack([values, np.zeros(20), np.arange(20)])
    np.testing.assert_array_equal(sweep.points, expected.astype(np.float32))
    assert sweep.points.dtype == np.float32
    assert sweep.time_us == START_NS // 1000
    [sweep] = ros_bag_drive(bag, KITTI_HDL64E).sweeps
    np.testing.assert_array_equal(sweep.points[:, 3], values[:, 3] * 255)  # the sensor's scale
    assert sweep.points.shape == (20, 5)


def test_rows_of_organised_clouds_may_be_padded_and_contain_nan(tmp_path):
    rows = np.stack([POINTS[:6], POINTS[6:]])
    rows["z"][1, 2] = np.nan
    padded = np.zeros((2, 6 * 16 + 10), np.uint8)
    padded[:, : 6 * 16] = np.frombuffer(rows.tobytes(), np.uint8).reshape(2, -1)
    sweep = one_sweep(tmp_path, rows, row_step=6 * 16 + 10, data=padded.ravel()[:-10])
    np.testing.assert_array_equal(sweep.points[:, 2], rows["z"].ravel())
    np.testing.assert_array_equal(sweep.points[:, 0], rows["x"].ravel())


@pytest.mark.parametrize("row_step", [0, 6, 2**32 - 1])
def test_a_wrong_row_step_does_not_matter_where_the_length_decides(tmp_path, row_step):
    sweep = one_sweep(tmp_path, np.stack([POINTS[:6], POINTS[6:]]), row_step=row_step)
    np.testing.assert_array_equal(sweep.points[:, 2], POINTS["z"])


@pytest.mark.parametrize(
    ("form", "identifier"),
    [("sqlite", "  storage_identifier: ''\n"), ("mcap", '  storage_identifier: ""\n'), ("mcap", "")],
)
def test_reindexed_recordings_without_a_storage_identifier_are_read(tmp_path, form, identifier):
    bag = write_recording(tmp_path / "a", form, one_cloud)
    text = (bag / "metadata.yaml").read_text()
    changed = re.sub(r"  storage_identifier: .*\n", identifier, text)
    assert changed != text
    (bag / "metadata.yaml").write_text(changed)
    [sweep] = ros_bag_drive(bag, TINY).sweeps
    np.testing.assert_array_equal(sweep.points[:, 2], POINTS["z"])


@pytest.mark.parametrize("form", ["ros1", "sqlite", "mcap"])
def test_folders_of_files_are_read_in_the_order_of_recording(tmp_path, form):
    """The second file has the first name, as 10 comes before 9."""
    folder = tmp_path / "files"
    folder.mkdir()
    for name, before in (("a_9", 0), ("a_10", 3)):
        stamps_ns = [(before + i) * 1000 for i in range(3)]
        file = data_file(write_recording(tmp_path / name, form, clouds(*stamps_ns, texts=before)))
        file.rename(folder / f"{name}{file.suffix}")
    assert is_ros_bag(folder)
    sweeps = list(ros_bag_drive(folder, TINY).sweeps)
    assert [sweep.time_us for sweep in sweeps] == [*range(6)]
    assert [sweep.name for sweep in sweeps] == [f"{folder}: /p: message {i}" for i in range(6)]
    (folder / "000.PCD").touch()
    (folder / "metadata.yaml").write_text("of: another tool")
    assert not is_ros_bag(folder)


@pytest.mark.parametrize("form", FORMS)
def test_without_odometry_sweeps_have_times_but_no_poses(tmp_path, form):
    stamps_ns = [START_NS + i * 10**8 for i in range(3)]
    bag = write_recording(tmp_path / "a", form, clouds(*stamps_ns, texts=1))
    assert is_ros_bag(bag)
    drive = ros_bag_drive(bag, TINY)
    assert (drive.posed, drive.timed) == (False, True)
    sweeps = list(drive.sweeps)
    assert [sweep.name for sweep in sweeps] == [f"{bag}: /p: message {i}" for i in range(3)]
    assert [sweep.time_us for sweep in sweeps] == [stamp // 1000 for stamp in stamps_ns]


def test_clouds_of_several_sensors_on_one_topic_are_told_once(tmp_path, capsys):
    frames = ["lidar", "/lidar", "rear"] * 2
    bag = write_recording(
        tmp_path / "a", "mcap", lambda make: [("/points", make.cloud(START_NS, POINTS, frame)) for frame in frames]
    )
    assert len(list(ros_bag_drive(bag, TINY).sweeps)) == 6
    told = f"note: {bag}: /points: message 2: frame_id 'rear' after 'lidar': clouds of several sensors?\n"
    assert capsys.readouterr().err == told


def turn(yaw):
    return Rotation.from_euler("z", yaw).as_quat()


def matrix(place, quaternion):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), place
    return pose


def motion(seconds):
    """A constant velocity and a constant rate of rotation."""
    return VELOCITY * seconds, turn(0.3 + YAW_RATE * seconds)


MOUNT = (0.9, 0.1, 1.7), Rotation.from_euler("zyx", [0.2, -0.1, 0.05]).as_quat()
HEAD = (0.0, 0.02, 0.3), turn(1.5)
IMU = (-0.4, 0.3, 0.6), Rotation.from_euler("x", 3.0).as_quat()
POSES_S = np.arange(9) * 0.1
CLOUDS_S = np.array([0.05, 0.2, 0.333, 0.7999])


def drive_content(make, poses):
    """Clouds between poses; the LiDAR is on a mount on the vehicle."""
    yield "/tf_static", make.transform(0, "base_link", "mount", *MOUNT)
    yield "/tf_static", make.transform(0, "/mount", "lidar", *HEAD)
    yield "/tf_static", make.transform(0, "base_link", "imu", *IMU)
    yield from poses(make)
    for seconds in CLOUDS_S:
        yield "/points", make.cloud(START_NS + round(seconds * 1e9), POINTS, "/lidar")


def expect_poses(drive, expected):
    assert drive.posed
    for sweep, seconds in zip(drive.sweeps, CLOUDS_S, strict=True):
        # Whole microseconds: at 9 m/s up to a hundredth of a millimetre beside the stamp.
        np.testing.assert_allclose(sweep.sensor_to_world, expected(seconds), atol=1e-5)


def times_ns():
    return [(seconds, START_NS + round(seconds * 1e9)) for seconds in POSES_S]


TO_LIDAR = matrix(*MOUNT) @ matrix(*HEAD)
IMU_TO_LIDAR = np.linalg.inv(matrix(*IMU)) @ TO_LIDAR


def body(seconds):
    return matrix(*motion(seconds))


def odometry_of(child):
    return lambda make: (("/odom", make.odometry(t, *motion(seconds), child)) for seconds, t in times_ns())


def poses_of(kind):
    return lambda make: (("/pose", getattr(make, kind)(t, *motion(seconds))) for seconds, t in times_ns())


def transforms_below_map(make):
    for number, (seconds, t) in enumerate(times_ns()):
        yield "/tf", make.transform(t, "map", "odom", (number**2, 0, 0), NO_TURN)  # corrections that jump
        for _ in range(2):  # some transforms are sent twice
            yield "/tf", make.transform(t, "odom", "base_link", *motion(seconds))


def transforms_below_earth(make):
    yield "/tf", make.transform(0, "earth", "world", (5, 6, 7), turn(1))  # sent once: valid at all times
    for seconds, t in times_ns():
        yield "/tf", make.transform(t, "world", "lift", (0, 0, seconds), NO_TURN)
        yield "/tf", make.transform(t + 5 * 10**7, "lift", "base_link", *motion(seconds + 0.05))
    yield "/tf", make.transform(START_NS - 10**8, "lift", "base_link", *motion(-0.1))


def below_earth(seconds):
    return matrix((5, 6, 7), turn(1)) @ matrix((0, 0, seconds), NO_TURN) @ body(seconds) @ TO_LIDAR


def odometry_beside_two_parents(make):
    for name in ("odom", "map"):
        yield "/tf", make.transform(START_NS, name, "base_link", (0, 0, 0), NO_TURN)
    yield from odometry_of("base_link")(make)


SOURCES = {  # source of the poses, their messages, the pose of the LiDAR at a time
    "odometry of the LiDAR": ("/odom", odometry_of("lidar"), body),
    "odometry of the vehicle": ("/odom", odometry_of("/base_link"), lambda s: body(s) @ TO_LIDAR),
    "odometry of the IMU": ("/odom", odometry_of("imu"), lambda s: body(s) @ IMU_TO_LIDAR),
    "poses": ("/pose", poses_of("pose_stamped"), body),
    "poses with covariance": ("/pose", poses_of("pose_with_covariance"), body),
    "transforms up to odom, which does not jump": ("tf", transforms_below_map, lambda s: body(s) @ TO_LIDAR),
    "transforms up to the root": ("tf", transforms_below_earth, below_earth),
    "errors in unused branches": ("/odom", odometry_beside_two_parents, lambda s: body(s) @ TO_LIDAR),
}


@pytest.mark.parametrize(
    ("case", "form"),
    [*((case, "sqlite") for case in SOURCES), ("transforms up to odom, which does not jump", "ros1")],
)
def test_poses_are_interpolated_and_combined_with_transforms(tmp_path, form, case):
    source, poses, expected = SOURCES[case]
    bag = write_recording(tmp_path / "a", form, lambda make: drive_content(make, poses))
    drive = ros_bag_drive(bag, TINY, odometry=source)
    assumed = "/pose does not name the frame of its poses: assumed to be the clouds' frame"
    assert drive.notes == ([assumed] if source == "/pose" else [])
    expect_poses(drive, expected)


def test_poses_from_a_file_are_of_the_sensor(tmp_path):
    rows = [(f"{t // 10**9}.{t % 10**9:09d}", *np.concatenate(motion(seconds))) for seconds, t in times_ns()]
    (tmp_path / "poses.txt").write_text("\n".join(" ".join(map(str, row)) for row in rows))
    bag = write_recording(tmp_path / "a", "sqlite", lambda make: drive_content(make, lambda _: ()))
    expect_poses(ros_bag_drive(bag, TINY, poses=tmp_path / "poses.txt"), body)


def test_message_definitions_in_the_recording_are_ignored(tmp_path):
    bag = write_recording(tmp_path / "a", "ros1", one_cloud)
    content = bag.read_bytes()
    assert content.count(b"uint32 height") > 0
    bag.write_bytes(content.replace(b"uint32 height", b"string heigh!"))
    [sweep] = ros_bag_drive(bag, TINY).sweeps
    np.testing.assert_array_equal(sweep.points[:, 0], POINTS["x"])


def test_clouds_outside_the_poses_are_skipped_with_a_note(tmp_path):
    def poses(make):
        return list(odometry_of("lidar")(make))[1:6]

    bag = write_recording(tmp_path / "a", "mcap", lambda make: drive_content(make, poses))
    drive = ros_bag_drive(bag, TINY, odometry="/odom")
    assert [sweep.name[-1] for sweep in drive.sweeps] == ["1", "2"]
    assert drive.notes == ["2 clouds before the first or after the last pose were skipped"]
    drive = ros_bag_drive(bag, TINY, odometry="/odom", max_points=0)
    with refused("/points: message 1: got "):  # the first is outside
        list(drive.sweeps)
    assert drive.notes == ["1 clouds before the first or after the last pose were skipped"]
    bag = write_recording(tmp_path / "b", "mcap", lambda make: drive_content(make, lambda make: poses(make)[:1]))
    with refused("/points: message 0: /odom: at 1700000000.173456 s: a gap in the poses"):
        list(ros_bag_drive(bag, TINY, odometry="/odom").sweeps)


def moving(*names):
    return lambda make: (
        ("/tf", make.transform(t, parent, child, *motion(seconds)))
        for seconds, t in times_ns()
        for parent, child in names
    )


def standing(*stamps_ns, **last):
    """Odometry at the origin; ``last`` are changes of the last message."""

    def content(make):
        for stamp in stamps_ns:
            changes = last if stamp == stamps_ns[-1] else {}
            yield "/odom", make.odometry(START_NS + stamp, (0, 0, 0), **{"turn": NO_TURN, **changes})

    return content


TWO_PARENTS = moving(("odom", "base_link"), ("map", "base_link"))
WRONG_DRIVES = {  # source of the poses, their messages, the message
    "another topic of odometry": ("/odm", standing(0), "odometry: got '/odm', expected a topic of Odometry or Po"),
    "a gap": ("/odom", standing(0, 6 * 10**8), "/points: message 0: /odom: at 1700000000.173456 s: a gap in the"),
    "time going back": ("/odom", standing(5000, 4000), "/odom: message 1: time: got 1700000000.12346 s after 170"),
    "no rotation": ("/odom", standing(0, 4000, turn=(0, 0, 0, 0)), "/odom: message 1: rotation: got [0.0, 0.0, 0"),
    "other frames": ("/odom", standing(0, 4000, child="imu"), "/odom: message 1: child_frame_id: got 'imu', expe"),
    "no transform": (
        *("/odom", odometry_of("chassis")),
        "/points: message 0: no transform from 'lidar' to 'chassis', expected one in /tf_static or /tf, which "
        "have transforms of: imu, lidar, mount",
    ),
    "nothing that moves": ("tf", standing(), "got the frames lidar -> mount -> base_link, expected one that move"),
    "a gap in transforms": (
        *("tf", lambda make: np.delete(list(moving(("odom", "base_link"))(make)), range(2, 8), axis=0)),
        "/points: message 1: tf of base_link in odom: at 1700000000.323456 s: a gap in the poses",
    ),
    "two parents": ("tf", TWO_PARENTS, "a: tf: frame 'base_link' has 2 parents, expected a tree"),
    "a circle": ("tf", moving(("lidar", "base_link")), "a: tf: frame 'base_link' is its own ancestor, expected a"),
}


@pytest.mark.parametrize("case", WRONG_DRIVES)
def test_unusable_poses_are_refused(tmp_path, case):
    source, poses, message = WRONG_DRIVES[case]
    bag = write_recording(tmp_path / "a", "sqlite", lambda make: drive_content(make, poses))
    with refused(message, f"{bag}: "):
        list(ros_bag_drive(bag, TINY, odometry=source).sweeps)


def test_topics_must_be_named_if_there_are_several(tmp_path):
    bag = write_recording(
        tmp_path / "a",
        "mcap",
        lambda make: [("/front", make.cloud(1, POINTS)), ("/rear", make.cloud(1, POINTS)), ("/a", make.text(""))],
    )
    kind = "sensor_msgs/msg/PointCloud2, 1 messages"
    with refused("topic: got 2 topics and no name, expected", f"among: /front ({kind}), /rear ({kind})"):
        ros_bag_drive(bag, TINY)
    assert len(list(ros_bag_drive(bag, TINY, topic="/rear").sweeps)) == 1
    with refused("topic: got '/a', expected a topic of P"):
        ros_bag_drive(bag, TINY, topic="/a")
    bag = write_recording(tmp_path / "b", "sqlite", lambda make: [("/a", make.text(""))])
    with refused("topic: got 0 topics and no name", "among: /a (std_msgs/msg/String, 1 messages)"):
        ros_bag_drive(bag, TINY)
    with refused("odometry: got 'tf', expected a topic of TFMessage"):
        ros_bag_drive(tmp_path / "a", TINY, topic="/rear", odometry="tf")


def field(offset, datatype, count):
    """Fields of which x is changed."""
    fields = ("x", offset, datatype, count), ("y", 4, 7, 1), ("z", 8, 7, 1)
    return {"fields": [Messages(is_ros1=False).make("sensor_msgs/PointField", *each) for each in fields]}


WRONG_CLOUDS = {
    "too short": ({"data": np.zeros(191, np.uint8)}, "data: got 191 bytes, and row_step 192, expected 1 rows of"),
    "huge": ({"width": 2**32 - 1, "height": 2**32 - 1}, "x 4294967295 points, expected at most 10000000"),
    "wide rows": ({"row_step": 2**32 - 1, "height": 2}, "data: got 192 bytes, and row_step 4294967295"),
    "narrow rows": ({"row_step": 100, "width": 7, "height": 2}, "data: got 192 bytes, and row_step 100"),
    "narrow step": ({"point_step": 10}, "field z: got 1 of datatype 7 at offset 8, expected"),
    "no fields": ({"fields": []}, "fields: got none, expected one named x"),
    "no datatype": (field(0, 9, 1), "field x: got 1 of datatype 9 at offset 0, expected one number"),
    "several numbers": (field(0, 7, 3), "field x: got 3 of datatype 7"),
    "far field": (field(2**32 - 1, 7, 1), "field x: got 1 of datatype 7 at offset 4294967295"),
}


@pytest.mark.parametrize("case", WRONG_CLOUDS)
def test_damaged_clouds_are_refused(tmp_path, case):
    changed, message = WRONG_CLOUDS[case]
    with refused(f"{tmp_path / 'a'}: /p: message 0: ", message):
        one_sweep(tmp_path, POINTS, **changed)


@pytest.mark.parametrize(
    "changed", [{}, {"fields": [], "point_step": 0, "row_step": 0}, {"height": 0, "width": 9}]
)
def test_messages_without_points_are_empty_sweeps(tmp_path, changed):
    assert one_sweep(tmp_path, POINTS[:0], **changed).points.shape == (0, 5)


@pytest.mark.parametrize(
    ("form", "how"), [("ros1", "LZ4"), ("sqlite", "FILE"), ("sqlite", "MESSAGE"), ("mcap file", "STORAGE")]
)
def test_compressed_recordings_are_read(tmp_path, form, how):
    bag = write_recording(tmp_path / "a", form, one_cloud, compression=how)
    [sweep] = ros_bag_drive(bag, TINY).sweeps
    np.testing.assert_array_equal(sweep.points[:, 2], POINTS["z"])


@pytest.mark.parametrize(
    ("form", "share"), [("sqlite", 0), ("sqlite", 0.97), ("ros1", 0.97), ("mcap", 0.97), ("mcap file", 0.3)]
)
def test_truncated_recordings_are_refused(tmp_path, form, share):
    cloud = structured(np.random.default_rng(0).normal(0, 5, (5000, 4)).astype(np.float32))
    bag = write_recording(tmp_path / "a", form, lambda make: [("/p", make.cloud(i, cloud)) for i in range(3)])
    file = data_file(bag)
    content = file.read_bytes()
    file.write_bytes(content[: round(share * len(content))])
    with refused(f"{bag}: ", "cannot be read: "):
        list(ros_bag_drive(bag, TINY).sweeps)


@pytest.mark.parametrize("text", ["", "{", "a: &a [*a]"])
def test_damaged_metadata_are_refused(tmp_path, text):
    bag = write_recording(tmp_path / "a", "sqlite", one_cloud)
    (bag / "metadata.yaml").write_text(text)
    with refused(f"{bag}: cannot be read: "):
        ros_bag_drive(bag, TINY)


def test_without_rosbags_the_error_names_the_extra(tmp_path, monkeypatch):
    (tmp_path / "a.bag").touch()
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with refused("a.bag: rosbags is not installed", "pip install -e '.[ros]' in the repository"):
        ros_bag_drive(tmp_path / "a.bag", TINY)

"""Check recordings by reading them with rerun."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.visualization.rerun_recording import rerun_recording

POINTS = np.array([[1, 2, 3, 9], [4, 5, 6, 9], [np.nan, 0, 0, 0]], np.float32)
BOXES = np.array([[8, 5, 0, 6, 3, 2, 0.4, 0, 0], [-10, -6, -1, 8, 3, 3, 2, 1, 0]], np.float32)
FOUND = BOXES, np.array([1, 0]), np.array([0.5, 0.25], np.float32)


def read(chunk, path):
    """Values by entity and component."""
    columns = {}
    for each in chunk.RrdReader(path).stream():
        batch = each.to_record_batch()
        for name, values in zip(batch.schema.names, batch.columns, strict=True):
            if name != "log_time":
                columns.setdefault((each.entity_path, name.split(":")[-1]), []).extend(values.to_pylist())
    return columns


def shifted(place):
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose


def test_recordings_survive_a_round_trip(tmp_path):
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
    path, far = tmp_path / "drive.rrd", np.array([5e5, 5e6, 100])
    with rerun_recording(path, ("car", "bus")) as record:
        record(POINTS, FOUND, name="first", time_us=5, pose=shifted(far), ids=np.array([7, 9]))
        record(
            POINTS[:0],
            tuple(a[:0] for a in FOUND),
            name="second",
            time_us=10,
            pose=shifted(far + np.array([1.1, 2, 3])),
        )
        assert not path.exists()
    assert [file.name for file in tmp_path.iterdir()] == ["drive.rrd"]
    columns = read(chunk, path)

    def array(entity, name, row):
        return np.array(columns[entity, name][row])

    np.testing.assert_array_equal(array("/sensor/points", "positions", 0), POINTS[:2, :3])
    assert columns["/sensor/points", "positions"][1] == []
    np.testing.assert_array_equal(array("/sensor/boxes", "centers", 0), BOXES[:, :3])
    np.testing.assert_array_equal(array("/sensor/boxes", "half_sizes", 0), BOXES[:, 3:6] / 2)
    turned = Rotation.from_quat(array("/sensor/boxes", "quaternions", 0)).as_euler("zyx")
    np.testing.assert_allclose(turned, [[0.4, 0, 0], [2, 0, 0]], atol=1e-6)
    assert columns["/sensor/boxes", "labels"][0] == ["bus 0.50 #7", "car 0.25 #9"]
    places = [array("/sensor", "translation", row)[0] for row in (0, 1)]
    np.testing.assert_allclose(places, [[0, 0, 0], [1.1, 2, 3]], atol=1e-6)
    assert columns["/sensor/boxes", "frame"] == [0, 1]
    assert [time.microsecond for time in columns["/sensor/boxes", "time"]] == [5, 10]


def test_boxes_of_low_score_are_left_out_and_truth_is_recorded(tmp_path):
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
    with rerun_recording(tmp_path / "a.rrd", ("car", "bus"), min_score=0.3) as record:
        record(POINTS, FOUND, name="a", ids=np.array([7, 9]), truth=(BOXES[::-1], FOUND[1][::-1]))
    columns = read(chunk, tmp_path / "a.rrd")
    assert columns["/sensor/boxes", "labels"] == [["bus 0.50 #7"]]
    np.testing.assert_array_equal(columns["/sensor/boxes", "centers"][0], BOXES[:1, :3])
    assert columns["/sensor/truth", "labels"] == [["car, truth", "bus, truth"]]
    np.testing.assert_array_equal(columns["/sensor/truth", "centers"][0], BOXES[::-1, :3])

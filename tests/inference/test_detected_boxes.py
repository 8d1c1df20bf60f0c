"""What a detector answers: the boxes that there are, as arrays, a table, JSON and a picture."""

import base64
import io
import json
import re

import jax
import numpy as np
import pytest
from PIL import Image
from tiny_run import SENSOR

from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.inference import DetectedBox, DetectedBoxes
from fcos_lidar_jax.inference.detector import _scaled_once
from fcos_lidar_jax.sensors import KITTI_HDL64E
from fcos_lidar_jax.simulation.frames import make_frame

CLASSES = ("car", "traffic<cone>")


@pytest.fixture(scope="module")
def made():
    """Thirty boxes in a row, alternating classes, scores from 0.9 down."""
    boxes = np.zeros((30, 9), np.float32)
    boxes[:, 0], boxes[:, 3:6] = np.arange(30), 1
    scores, labels = np.linspace(0.9, 0.03, 30, dtype=np.float32), np.arange(30, dtype=np.int32) % 2
    return DetectedBoxes(boxes, scores, labels, CLASSES, np.zeros((0, 5), np.float32), {"num_points": 7}, 40.0)


def test_a_detector_answers_with_the_boxes_that_there_are(detector):
    points = make_frame(0, SENSOR).points
    padded = detector.detect(make_cloud(points, detector.config, sensor=SENSOR))
    found = detector(points)
    number = int(padded.valid.sum())
    assert 0 < len(found) == number
    for name in ("boxes", "scores", "labels"):
        np.testing.assert_array_equal(getattr(found, name), getattr(padded, name)[padded.valid])
    assert found.names.tolist() == [detector.classes[k] for k in padded.labels[:number]]
    first, *_, last = found
    assert isinstance(first, DetectedBox)
    assert (first.name, first.score) == (found.names[0], padded.scores[0])
    np.testing.assert_array_equal(last.box, padded.boxes[number - 1])
    record = json.loads(json.dumps(found.to_dict()))
    assert record["num_points"] == len(points)
    assert [box["box"] for box in record["boxes"]] == found.boxes.tolist()
    assert "file" not in record


def test_boxes_print_as_a_table_of_the_best(made):
    title, head, *rows, rest = str(made).splitlines()
    assert (title, rest) == ("30 boxes", "... and 10 more")
    assert head.split() == ["class", "score", *"xyzlwh", "yaw", "vx", "vy"]
    assert len(rows) == 20
    name, *numbers = rows[3].split()
    assert name == "traffic<cone>"
    np.testing.assert_allclose([float(v) for v in numbers], [0.81, 3, 0, 0, 1, 1, 1, 0, 0, 0], atol=0.005)
    assert len({len(row) for row in (head, *rows)}) == 1
    assert str(made.select(min_score=1)).startswith("0 boxes\n")


def test_selection_by_score_and_class(made):
    some = made.select(min_score=0.5, labels=["car"])
    assert [box.score for box in some] == [float(s) for s in made.scores[::2] if s >= 0.5]
    assert set(some.names) == {"car"}
    assert len(made.select(min_score=0.5, labels="car")) == len(some)
    assert [(box.name, box.score) for box in made[3:5]] == [(made[i].name, made[i].score) for i in (3, 4)]
    with pytest.raises(ValueError, match="labels: got 'Car', expected car"):
        made.select(labels=["Car"])
    assert some.to_dict() == {
        "num_points": 7,
        "boxes": [b for b in made.to_dict()["boxes"][::2] if b["score"] >= 0.5],
    }


def test_boxes_draw_themselves_in_a_notebook(made):
    shown = made._repr_html_()
    assert "traffic&lt;cone&gt;" in shown
    assert "<cone>" not in shown
    assert "of score 0.3 and more, of 30" in shown
    png = base64.b64decode(re.findall(r"base64,([^\"]+)", shown)[0])
    assert png == made.picture(min_score=0.3) != made.picture(min_score=0)
    assert made.picture() != made.picture(truth=(made.boxes, made.labels))
    assert Image.open(io.BytesIO(png)).width > 500


def test_a_detector_takes_files_arrays_of_jax_and_lists_and_prints_in_one_line(detector, tmp_path):
    points, file = make_frame(0, SENSOR).points, tmp_path / "cloud.npy"
    np.save(file, points)
    expected = detector(points)
    for same in (file, str(file), jax.numpy.asarray(points), points.tolist()):
        assert detector(same).to_dict()["boxes"] == expected.to_dict()["boxes"]
    assert repr(detector).startswith("TrainedDetector('quickstart', 'tiny', classes=('car', ")


def test_truncated_points_and_clouds_of_another_sensor_are_reported(detector):
    points = np.concatenate([make_frame(0, SENSOR).points] * 2)
    with (
        pytest.warns(UserWarning, match="^points do not fit sensor 'tiny' .*, expected about 1, .*; expect poor"),
        pytest.warns(
            UserWarning, match=r"^\d+ points left out in total: the detector takes at most 1024 per cloud"
        ),
    ):
        detector(points)


@pytest.mark.parametrize("factor", [1, 1 / 255])
def test_intensities_are_scaled_once_also_if_many_points_have_none(factor):
    points = np.full((1000, 5), 9, np.float32)
    points[:, 3:], points[:400, 3] = 0, np.linspace(50, 250, 400)
    found = _scaled_once(points * np.float32([1, 1, 1, factor, 1]), KITTI_HDL64E, 1)
    np.testing.assert_allclose(found, points, rtol=1e-5)

"""Boxes in camera images: their lines, by a loop over points of their edges, and an example of KITTI."""

import matplotlib.image
import numpy as np
import pytest
from made_kitti import P2, make_kitti
from PIL import Image
from refusal import refused

from fcos_lidar_jax.data.frame import SelectedFrames
from fcos_lidar_jax.data.kitti import CLASSES, KittiFrames
from fcos_lidar_jax.evaluation.frames import frame_columns
from fcos_lidar_jax.evaluation.metrics import evaluate, metric_of
from fcos_lidar_jax.types import Detections
from fcos_lidar_jax.visualization import camera, evaluation_report
from fcos_lidar_jax.visualization.camera import draw_camera
from fcos_lidar_jax.visualization.evaluation_report import make_examples
from fcos_lidar_jax.visualization.figure import class_color

LOOK = np.array([[50.0, -100, 0, 0], [30, 0, -100, 0], [1, 0, 0, 0]])  # along x, 100 pixels wide, 60 high
NOTHING = np.zeros((0, 9)), np.zeros(0, int)


@pytest.fixture
def image(tmp_path):
    Image.new("RGB", (100, 60), "white").save(tmp_path / "image.png")
    return tmp_path / "image.png"


@pytest.fixture
def drawn(monkeypatch):
    figures = []
    monkeypatch.setattr(camera, "save_png", lambda figure, path: figures.append(figure))
    return figures


def draw(image, found, truth=NOTHING):
    draw_camera(image, image.with_name("x.png"), LOOK, classes=CLASSES, detections=found, truth=truth)


def pixels_of_edges(box):
    """Positions in the image along all edges of a box, f64[n, 2], of points in front of the camera."""
    centre, size, yaw, found = np.array(box[:3]), np.array(box[3:6]), box[6], []
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    for axis in range(3):
        for a in (-1.0, 1.0):
            for b in (-1.0, 1.0):
                for along in np.linspace(-1, 1, 201):
                    place = centre + turn @ (np.insert([a, b], axis, along) * size / 2)
                    u, v, depth = LOOK @ [*place, 1]
                    if depth > 0.1:
                        found.append((u / depth, v / depth))
    return np.array(found)


@pytest.mark.parametrize(
    "box", [[12, 1, 0.2, 4, 2, 1.5, 0.4, 0, 0], [2, 0, -0.5, 6, 3, 0.4, 0.1, 0, 0]], ids=["in front", "beside"]
)
def test_lines_follow_the_edges(image, drawn, box):
    draw(image, (np.array([box]), np.array([2]), np.array([0.5])))
    [axis] = drawn[0].axes
    lines = [line.get_xydata() for line in axis.get_lines()]
    expected = pixels_of_edges(box)
    drawn_places = [s * (1 - share) + e * share for s, e in lines for share in np.linspace(0, 1, 99)]
    in_image = [place for place in drawn_places if (place > 0).all() and (place < (100, 60)).all()]
    assert len(in_image) > 99
    for place in in_image:
        assert np.abs(expected - place).max(axis=1).min() < 1
    for place in expected[:: len(expected) // 50]:
        gaps = [_distance(place, *line) for line in lines]
        assert min(gaps) < 1e-6 * (1 + np.abs(place).max())


def _distance(place, start, end):
    share = np.clip((place - start) @ (end - start) / max((end - start) @ (end - start), 1e-12), 0, 1)
    return np.linalg.norm(start + share * (end - start) - place)


def test_colours_labels_and_boxes_behind_the_camera(image, drawn):
    boxes = np.array([[12, 1, 0, 4, 2, 1.5, 0, 0, 0], [-12, 1, 0, 4, 2, 1.5, 0, 0, 0]])
    found = boxes, np.array([0, 1]), np.array([0.75, 0.9])
    draw(image, found, truth=(boxes, np.array([3, 3])))
    [axis] = drawn[0].axes
    lines = axis.get_lines()
    assert [line.get_color() for line in lines] == [class_color(3)] * 12 + [class_color(0)] * 12
    assert {line.get_linestyle() for line in lines[:12]} == {"--"} != {line.get_linestyle() for line in lines[12:]}
    assert [text.get_text() for text in axis.texts] in (["Car 0.75"], ["0.75"])


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n" + bytes(40)])
def test_a_damaged_image_is_named(image, content):
    image.write_bytes(content)
    with refused(str(image), "expected a PNG or JPEG image"):
        draw(image, (*NOTHING, np.zeros(0)))


@pytest.mark.slow
def test_an_example_of_kitti_has_boxes_in_the_camera_image(tmp_path):
    make_kitti(tmp_path / "kitti", train=1, val=1)
    frames = SelectedFrames(KittiFrames(tmp_path / "kitti"), (1, 0))
    assert frames.camera(0) is None
    folder = tmp_path / "kitti" / "training" / "image_2"
    folder.mkdir()
    Image.new("RGB", (1242, 375), "white").save(folder / "000001.png")
    truth = [frames.frame(i) for i in range(2)]
    found = []
    for frame in truth:
        ones = np.ones(len(frame.boxes))
        found.append(Detections(frame.boxes, ones.astype(np.float32), frame.labels, ones > 0, np.int32(0)))
    evaluation = evaluate(*frame_columns(found, truth, ["000001", "000000"]), metric_of(CLASSES))
    examples = make_examples(evaluation, frames, np.zeros((2, 3)), {"best": 0, "worst": 1}, min_score=0.3)
    ranges_m = dict.fromkeys(CLASSES, 50.0)
    views, images = evaluation_report._draw_examples(tmp_path, examples, ranges_m, frames.sensor)
    names = ["best_bev.png", "worst_bev.png", "best_camera.png", "best_range.png", "worst_range.png"]
    assert [file.name for _, file in (*views, *images)] == names
    assert all(("000001" if "best" in caption else "000000") in caption for caption, _ in views)
    picture = (matplotlib.image.imread(tmp_path / "best_camera.png")[..., :3] * 255).round()
    label = int(truth[0].labels[0])
    color = list(bytes.fromhex(class_color(label)[1:]))
    rows, columns = np.nonzero(np.abs(picture - color).max(axis=2) < 40)
    x, y, z = truth[0].boxes[truth[0].labels == label][0, :3]
    u, v, depth = P2 @ [-y, -z, x, 1]  # nearly, because the camera is mounted a degree off
    scale = np.array(picture.shape[:2]) / (375, 1242)
    assert np.hypot(rows / scale[0] - v / depth, columns / scale[1] - u / depth).min() < 150

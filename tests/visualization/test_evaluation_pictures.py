"""Check the contents of evaluation pictures by inspecting the figures."""

from types import SimpleNamespace

import numpy as np
import pytest

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.types import CHANNELS
from fcos_lidar_jax.visualization import bev, evaluation_report, range_image
from fcos_lidar_jax.visualization.figure import class_color, new_figure, set_title, write_labels

RECALL = np.linspace(0, 1, 101).tolist()


@pytest.fixture
def drawn(monkeypatch):
    """Collect figures instead of writing files."""
    figures = []
    for module in (evaluation_report, range_image, bev):
        monkeypatch.setattr(module, "save_png", lambda figure, path: figures.append(figure))
    return figures


def test_precision_ends_at_the_highest_recall(drawn):
    curve = [0.9] * 41 + [0.0] * 60
    curves = {"0.5": [0.0] * 101, "1.0": curve, "2.0": curve, "4.0": [1.0] * 101}
    evaluation_report._draw_precision("x.png", RECALL, curves)
    lines = {line.get_label(): line for line in drawn[0].axes[0].get_lines()}
    lengths = {name: len(line.get_xdata()) for name, line in lines.items()}
    assert lengths == {"0.5 m": 1, "1 m": 41, "2 m": 41, "4 m": 101}
    np.testing.assert_allclose(lines["2 m"].get_ydata(), 0.9)


def test_error_curves_span_the_evaluated_recalls(drawn):
    errors = {name: [float(k)] * 101 for k, name in enumerate(evaluation_report.ERROR_NAMES)}
    evaluation_report._draw_errors("x.png", RECALL, errors, first=11, last=60)
    lines = drawn[0].axes[0].get_lines()
    assert [line.get_label() for line in lines] == [name for _, name in evaluation_report.ERROR_NAMES.values()]
    for k, line in enumerate(lines):
        np.testing.assert_allclose(line.get_xdata()[[0, -1]], [0.11, 0.6])
        np.testing.assert_allclose(line.get_ydata(), k)
    evaluation_report._draw_errors("x.png", RECALL, errors, first=11, last=10)
    assert not drawn[1].axes[0].get_lines()
    assert drawn[1].axes[0].texts[0].get_text() == "recall never above 0.1"


def test_truth_and_detections_have_separate_panels(drawn):
    frame = make_frame(0, TINY)
    image = project_points(frame.points, np.ones(len(frame.points), bool), TINY, num_rounds=1)
    truth, scores = (frame.boxes, frame.labels), np.array([0.7, 0.4])
    detections = frame.boxes[:2], frame.labels[:2], scores
    range_image.draw_range_image(image, "x.png", classes=NUSCENES_CLASSES, truth=truth, detections=detections)
    titles = [axis.get_title(loc="left") for axis in drawn[0].axes if axis.get_title(loc="left")]
    assert len(titles) == 3
    assert f"of {len(frame.boxes)} boxes have a cell" in titles[0].partition("truth: ")[2]
    assert titles[1].endswith("detections: 2 of 2 boxes have a cell")
    assert "intensity" in titles[2]
    names = [NUSCENES_CLASSES[label].replace("_", " ") for label in frame.labels]
    above, below = ([text.get_text() for text in axis.texts] for axis in drawn[0].axes[:2])
    assert set(above) <= set(names)
    assert below == [f"{names[0]} 0.70", f"{names[1]} 0.40"]


def test_panels_show_all_rounds_and_nonzero_time_lags(drawn):
    features = np.zeros((8, 16, 9, 3), np.float32)
    features[2, 4, [CHANNELS.index("existence"), CHANNELS.index("time_lag")], 0] = 1, 0.1
    range_image.draw_range_image(SimpleNamespace(features=features), "x.png")
    titles = [title for axis in drawn[0].axes if (title := axis.get_title(loc="left"))]
    assert [title.split(",")[0] for title in titles] == [
        *("Round 1: range [m]", "Round 1: intensity (0-255)", "Round 1: time lag [s]"),
        *("Round 2: range [m]", "Round 3: range [m]"),
    ]


def boxes_at(*places):
    boxes = np.tile([0.0, 0, 0, 4, 2, 1.5, 0, 0, 0], (len(places), 1))
    boxes[:, :2] = places
    return boxes


def test_boxes_that_overlap_a_better_one_are_left_out(drawn):
    found = boxes_at((0, 0), (0.5, 0), (9, 9)), np.array([2, 3, 3]), np.array([0.4, 0.8, 0.5])
    bev.draw_bev(np.zeros((0, 3)), "x.png", limit_m=25, classes=NUSCENES_CLASSES, detections=found)
    assert [text.get_text() for text in drawn[0].axes[0].texts] == ["trailer 0.80", "trailer 0.50"]


def test_class_and_score_stand_beside_boxes_without_overlaps(drawn, monkeypatch):
    """Of six boxes in one place, the best have class and score; those without room have no text."""
    monkeypatch.setattr(bev, "one_per_object", lambda found: found)
    boxes = boxes_at(*[(0, 0)] * 6, (-20, 15))
    labels, scores = np.array([8] * 6 + [2]), np.array([0.31, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4])
    bev.draw_bev(
        np.zeros((0, 3)), "x.png", limit_m=25, classes=NUSCENES_CLASSES, detections=(boxes, labels, scores)
    )
    [figure] = drawn
    figure.canvas.draw()
    texts = figure.axes[0].texts
    written = [text.get_text() for text in texts]
    assert written[:2] == ["traffic cone 0.90", "traffic cone 0.80"]
    assert written[-1] == "bus 0.40"
    assert texts[-1].get_color() == class_color(2)
    assert 3 <= len(written) < 7
    spans = [text.get_window_extent() for text in texts]
    assert not any(a.overlaps(b) for i, a in enumerate(spans) for b in spans[:i])
    centre, half = figure.axes[0].transData.transform([(-20, 15), (-18, 16)])
    beside = np.abs(np.array(spans[-1].min + spans[-1].max) / 2 - centre)
    assert (beside > half - centre).any()
    assert beside.max() < 80  # pixels


def test_in_crowds_only_the_labels_of_the_best_ten_cover_other_boxes():
    """Of twenty boxes of 2 m side by side in two rows, with one apart that has the lowest score."""
    axis = new_figure(6, 6).add_subplot()
    axis.set(xlim=(-25, 25), ylim=(-25, 25))
    centres = np.array([(2.0 * i - 9, 2.0 * k) for i in range(10) for k in range(2)] + [(0, -20)])
    scores = np.linspace(0.9, 0.3, 21)
    boxes = [(centre, np.ones(2), 0, score) for centre, score in zip(centres, scores, strict=True)]
    write_labels(axis, boxes, ["car"], (0.15, 0.15))
    places = np.array([text.get_position() for text in axis.texts])
    covering = (np.abs(places[:, None] - centres) < 1).all(axis=2).any(axis=1)
    written = np.array([float(text.get_text().split()[-1]) for text in axis.texts])
    assert covering.any()
    assert written[covering].min() >= scores[9].round(2)
    assert axis.texts[-1].get_text() == "car 0.30"


def test_the_view_fits_points_to_one_side_and_their_boxes_but_no_full_turn(drawn):
    """Ahead: a square picture of the camera's view would be three quarters empty."""
    ahead = np.array([[4, -1, 0], [20, -6, 0], [30, 30, 0], [90, 0, 0], [9, np.nan, 0]])
    options = {"limit_m": 50, "classes": NUSCENES_CLASSES, "truth": (boxes_at((38, 3), (60, 0)), np.zeros(2, int))}
    around = np.concatenate([ahead, [[-9, -3, 0]]])
    for points in (ahead, ahead[:, [1, 0, 2]], around, np.zeros((0, 3))):
        bev.draw_bev(points, "x.png", **options)
    fitted, upright, *whole = (figure.axes[0] for figure in drawn)
    # The origin and the points with a margin of 2 m, and the box from 36 to 40 m.
    np.testing.assert_allclose([*fitted.get_xlim(), *fitted.get_ylim()], [-2, 42, -8, 32])
    np.testing.assert_allclose([*upright.get_xlim(), *upright.get_ylim()], [-8, 42, -2, 32])
    assert all((*axis.get_xlim(), *axis.get_ylim()) == (-50, 50) * 2 for axis in whole)
    assert {axis.get_aspect() for axis in (fitted, upright, *whole)} == {1.0}
    width, height = np.transpose([figure.get_size_inches() for figure in drawn])
    assert (width == 9).all()
    assert height[1] < height[0] < height[2] == height[3] == 9.5


@pytest.mark.parametrize("kind", ["axis", "figure"])
@pytest.mark.parametrize(
    "name", ["a word after another " * 4, "n015__LIDAR_TOP__" * 4, "W$^{MW}_$" * 9, "Ä\udcff" * 40]
)
def test_long_titles_are_whole(name, kind):
    figure = new_figure(4, 2)
    axis = figure.add_subplot()
    set_title(axis if kind == "axis" else figure, name, fontsize=11)
    figure.draw_without_rendering()  # with its layout
    title = axis.title if kind == "axis" else figure._suptitle
    low, high = title.get_window_extent().get_points()
    assert (low >= 0).all()
    assert (high <= figure.bbox.max).all()
    assert "".join(title.get_text().split()) == "".join(name.replace("\udcff", "?").split())

"""Check the contents of evaluation pictures by inspecting the figures."""

import numpy as np
import pytest

from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.visualization import bev, evaluation_report, range_image

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
    # Of two equal curves, the lower one is wider.
    assert lines["2 m"].get_linewidth() > lines["1 m"].get_linewidth()
    assert lines["2 m"].get_zorder() < lines["1 m"].get_zorder()


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
    evaluation_report._draw_errors("x.png", RECALL, {"scale_err": [0.5] * 101}, first=11, last=20)
    assert [line.get_label() for line in drawn[2].axes[0].get_lines()] == ["scale [1 - IoU]"]


def test_truth_and_detections_have_separate_panels(drawn):
    frame = make_frame(0, TINY)
    image = project_points(frame.points, np.ones(len(frame.points), bool), TINY, num_rounds=1)
    range_image.draw_range_image(image, "x.png", boxes=frame.boxes, detections=frame.boxes[:2])
    titles = [axis.get_title(loc="left") for axis in drawn[0].axes if axis.get_title(loc="left")]
    assert len(titles) == 3
    assert f"of {len(frame.boxes)} boxes have a cell" in titles[0]
    assert "2 of 2 detections have a cell" in titles[1]
    assert "intensity" in titles[2]


def test_axis_labels_do_not_name_a_forward_direction(drawn):
    bev.draw_bev(np.zeros((0, 3)), "x.png", limit_m=10, classes=())
    axis = drawn[0].axes[0]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("x [m]", "y [m]")
    assert [line.get_marker() for line in axis.lines] == ["+"]

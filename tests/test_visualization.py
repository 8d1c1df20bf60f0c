"""Pictures show what they should where they should; files are written whole or not at all."""

import matplotlib.image
import numpy as np
import pytest

from fcos_lidar_jax.data.synthetic.frames import make_frame
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.types import CLASSES
from fcos_lidar_jax.visualization.bev import draw_bev
from fcos_lidar_jax.visualization.curves import draw_curves
from fcos_lidar_jax.visualization.palette import CLASS_COLORS
from fcos_lidar_jax.visualization.range_image import draw_range_image
from fcos_lidar_jax.visualization.report import write_report


def pixels(path):
    return (matplotlib.image.imread(path)[..., :3] * 255).round().astype(int)


def places(image, color):
    rgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])
    return np.argwhere(np.abs(image - rgb).max(-1) <= 3)


def test_a_box_is_drawn_in_its_colour_at_its_place(tmp_path):
    label = CLASSES.index("bicycle")
    centres = []
    for i, (x, y) in enumerate([(-10, 10), (10, -10)]):
        box = np.array([[x, y, 0, 4, 2, 1, 0.3, 0, 0]])
        path = tmp_path / f"{i}.png"
        cloud = np.zeros((1, 3))
        draw_bev(cloud, path, limit_m=25, detections=(box, np.array([label]), np.array([0.5])))
        found = places(pixels(path), CLASS_COLORS[label])
        legend = found[:, 0] < 110
        centres.append(np.median(found[~legend], axis=0))
    (up, left), (down, right) = centres
    assert up < down
    assert left < right


def test_range_image_shows_every_round_and_grey_for_empty(tmp_path):
    frame = make_frame(0, TINY)
    valid = np.ones(len(frame.points), bool)
    heights = []
    for rounds in (1, 3):
        image = project_points(frame.points, valid, TINY, num_rounds=rounds)
        draw_range_image(image, tmp_path / f"{rounds}.png", title="t")
        picture = pixels(tmp_path / f"{rounds}.png")
        heights.append(picture.shape[0])
        assert len(places(picture, "#d9d9d9")) > 1000
    assert heights[1] > heights[0] + 200


def test_curves_are_written(tmp_path):
    draw_curves(tmp_path / "c.png", {"a": [(0, 1), (1, 2)]}, x_label="x", y_label="y", title="t", log_y=True)
    assert len(places(pixels(tmp_path / "c.png"), "#1f77b4")) > 100


def test_report_is_self_contained_and_escaped(tmp_path):
    draw_curves(tmp_path / "c.png", {"a": [(0, 1), (1, 2)]}, x_label="x", y_label="y", title="t")
    write_report(
        tmp_path / "r.html",
        title="<script>",
        lead="a & b",
        summary={"value": 0.12345, "none": float("nan")},
        tables=[("table", ("class", "AP"), [("car", 0.5)])],
        pictures=[("picture", tmp_path / "c.png")],
    )
    page = (tmp_path / "r.html").read_text()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page
    assert "0.123" in page
    assert "http" not in page
    assert 'src="data:image/png;base64,' in page


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_interrupted_writing_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def half(file):
        file.write_text("ha")
        raise error

    with pytest.raises(error):
        write_beside(path, half)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]

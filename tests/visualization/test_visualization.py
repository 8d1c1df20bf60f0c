"""Check the contents of pictures pixel by pixel, and reports."""

import base64
import re
from types import SimpleNamespace
from xml.etree import ElementTree

import matplotlib.image
import numpy as np
import pytest

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.types import CHANNELS
from fcos_lidar_jax.visualization.bev import draw_bev
from fcos_lidar_jax.visualization.figure import EMPTY, class_color, draw_curves
from fcos_lidar_jax.visualization.range_image import _row_inclinations, draw_range_image
from fcos_lidar_jax.visualization.report import write_report

CAR, BICYCLE = NUSCENES_CLASSES.index("car"), NUSCENES_CLASSES.index("bicycle")
LIMIT_M, GREEN = 25.0, class_color(BICYCLE)


def pixels(path):
    return (matplotlib.image.imread(path)[..., :3] * 255).round().astype(int)


def rgb(color):
    return np.array(list(bytes.fromhex(color[1:])))


def fill(label):
    return (0.7 * 255 + 0.3 * rgb(class_color(label))).round().astype(int)


def places(image, color):
    return np.argwhere(np.abs(image - rgb(color)).max(-1) <= 3)


def frames(image):
    """Frames of the panels from top to bottom, as (top, bottom, left, right) in pixels."""
    black = (image < 60).all(-1)
    lines = np.flatnonzero(black.sum(1) > 0.6 * image.shape[1])
    edges = lines[np.diff(lines, prepend=-9) > 2]  # lines are up to two pixels thick
    sides = np.flatnonzero(black[edges[0] : edges[1]].mean(0) > 0.95)
    sides = sides[sides < 0.95 * image.shape[1]] if len(sides) > 4 else sides  # without colour bars
    return [(top, bottom, sides[0], sides[-1]) for top, bottom in edges.reshape(-1, 2)]


class View:
    """A bird's-eye view and the position of its frame."""

    def __init__(self, folder, points=((np.nan,) * 3,), classes=NUSCENES_CLASSES, **options):
        draw_bev(np.array(points), folder / "a.png", limit_m=LIMIT_M, classes=classes, **options)
        self.image = pixels(folder / "a.png")
        self.frame = frames(self.image)[0]
        self.legend = self.image[self.frame[1] + 10 :]

    def at(self, x, y, reach=2):
        """Pixels around a position in metres."""
        top, bottom, left, right = self.frame
        row = round((LIMIT_M - y) / (2 * LIMIT_M) * (bottom - top) + top)
        column = round((x + LIMIT_M) / (2 * LIMIT_M) * (right - left) + left)
        return self.image[row - reach : row + reach + 1, column - reach : column + reach + 1]


def bicycle(*box):
    return np.array([[*box, 0, 0]], float), np.array([BICYCLE])


@pytest.mark.parametrize("yaw", [0.5, -2.0])
def test_a_box_is_drawn_with_its_colour_position_and_heading(tmp_path, yaw):
    view = View(tmp_path, detections=(*bicycle(-8, 12, 0, 10, 4, 1, yaw), np.array([0.5])))
    cos, sin = np.cos(yaw), np.sin(yaw)
    drawn = [(5, 0), (-5, 0), (0, 2), (0, -2), (5, 2), (2.5, 0)]  # front, back, sides, a corner, the heading
    for along, across in [*drawn, (-2.5, 0), (2.5, 1), (7, 0)]:
        place = view.at(-8 + cos * along - sin * across, 12 + sin * along + cos * across)
        assert bool(len(places(place, class_color(BICYCLE)))) == ((along, across) in drawn), (along, across)


def test_truth_has_dashed_black_outlines_and_coloured_area(tmp_path):
    view = View(tmp_path, truth=bicycle(8, -12, 0, 10, 4, 1, 0))
    assert np.abs(view.at(5, -12) - fill(BICYCLE)).max() <= 3
    dark = (view.at(8, -10, reach=60) < 90).all(-1).any(0)
    assert 0.4 < dark.mean() < 0.8
    assert np.count_nonzero(np.diff(dark.astype(int)) == 1) > 8  # dashes


def test_the_legend_contains_only_visible_classes(tmp_path):
    boxes = np.array([[90, 0, 0, 4, 2, 1, 0, 0, 0], [5, 5, 0, 4, 2, 1, 0, 0, 0]], float)
    view = View(tmp_path, detections=(boxes, np.array([CAR, BICYCLE]), np.ones(2)))
    assert len(places(view.legend, class_color(BICYCLE))) > 50
    assert not len(places(view.image, class_color(CAR)))


def test_any_number_of_classes_has_colours_and_a_legend(tmp_path):
    """Uses more classes than fit in the legend, with names that Matplotlib could parse as math."""
    colors = [class_color(label) for label in range(200)]
    assert len(set(colors)) == 200
    assert all(np.abs(rgb(a) - rgb(b)).sum() > 30 for i, a in enumerate(colors[:30]) for b in colors[:i])
    classes = [f"_{k}$x^$_" for k in range(140)]
    boxes = np.tile([0, 0, 0, 1.2, 1.2, 1, 0, 0, 0], (140, 1))
    boxes[:, 0], boxes[:, 1] = np.arange(140) % 20 * 2 - 20, np.arange(140) // 20 * 4 - 12
    view = View(tmp_path, truth=(boxes, np.arange(140)), classes=classes)
    assert np.abs(view.at(*boxes[139, :2] - 0.3, reach=1) - fill(139)).max() <= 3
    assert len(places(view.legend, class_color(29))) > 50
    assert not len(places(view.legend, class_color(30)))


def test_higher_points_are_darker(tmp_path):
    ground = np.stack([np.linspace(-20, 20, 400), np.full(400, -10), np.full(400, -1.8)], 1)
    view = View(tmp_path, np.concatenate([ground, ground + np.array([0, 20, 3])]))
    assert view.at(7, 10).mean() < view.at(7, -10).mean() - 20


def small_image(cells):
    """A range image with one point at x = 10 m in each given cell."""
    features = np.zeros((8, 16, 9, 1), np.float32)
    for row, column in cells:
        values = {"x": 10, "range": 10, "intensity": 99, "existence": 1, "inclination": -row / 10}
        features[row, column, :, 0] = [values.get(name, 0) for name in CHANNELS]
    return SimpleNamespace(features=features)


def draw(folder, image, **options):
    """Draw a range image; returns the picture and the frames of its panels."""
    draw_range_image(image, folder / "a.png", **options)
    picture = pixels(folder / "a.png")
    return picture, frames(picture)


def test_filled_cells_are_coloured_and_empty_cells_are_grey(tmp_path):
    image, panels = draw(tmp_path, small_image([(2, 4), (7, 15)]))
    assert len(panels) == 2  # range and intensity
    for top, bottom, left, right in panels:
        for row, column in np.ndindex(8, 16):
            at = round(top + (row + 0.5) / 8 * (bottom - top)), round(left + (column + 0.5) / 16 * (right - left))
            grey = np.abs(image[at] - rgb(EMPTY)).max() <= 3
            assert grey == ((row, column) not in [(2, 4), (7, 15)]), (row, column)


def test_boxes_are_outlined_around_their_cells(tmp_path):
    image = small_image([(2, 4), (3, 5)])
    around = np.array([[10, 0, 0, 1, 1, 1, 0, 0, 0], [-10, 0, 0, 1, 1, 1, 0, 0, 0]], np.float32)
    truth = around, [BICYCLE, CAR]
    picture, [(top, bottom, left, right), _] = draw(tmp_path, image, truth=truth, classes=[" "] * 10)
    green = places(picture, GREEN)
    cells = (green - (top, left)) / (bottom - top, right - left) * (8, 16)
    np.testing.assert_allclose([cells.min(0), cells.max(0)], [[2, 4], [4, 6]], atol=0.2)


def test_a_box_across_azimuth_pi_is_outlined_at_both_ends(tmp_path):
    box = np.array([[10, 0, 0, 1, 1, 1, 0]], np.float32)
    picture, [(_, _, left, right), _] = draw(
        tmp_path, small_image([(2, 0), (2, 15)]), truth=(box, [BICYCLE]), classes=[" "] * 10
    )
    columns = (places(picture, GREEN)[:, 1] - left) / (right - left) * 16
    assert columns.min() < 1.2
    assert columns.max() > 14.8
    assert not ((columns > 1.2) & (columns < 14.8)).any()


def test_boxes_in_a_sector_have_a_single_outline(tmp_path):
    """The outline spans the picture from the first to the last column."""
    box = np.array([[10, 0, 0, 1, 1, 1, 0]], np.float32)
    image = small_image([(2, 0), (2, 15)])
    picture, [(_, _, left, right), _] = draw(
        tmp_path, image, truth=(box, [CAR]), classes=[" "], azimuth_limits_rad=(3.0, 4.5)
    )
    outline = (np.abs(picture - rgb(class_color(CAR))).max(-1) < 40).any(axis=0)
    assert outline[left + 2 : right - 2].all()


def test_rows_are_labelled_with_the_inclination_of_their_points():
    table = _row_inclinations(small_image([(2, 0), (2, 9), (6, 1)]).features)
    np.testing.assert_allclose(table, -np.arange(8) / 10, atol=1e-6)  # includes interpolated and extrapolated rows
    np.testing.assert_allclose(_row_inclinations(small_image([(3, 0)]).features), -0.3)
    assert not _row_inclinations(small_image([]).features).any()


@pytest.mark.parametrize(
    "series", [{}, {"a": [], "b": [(1, float("nan")), (2, 0), (3, -1)], "c": [(1, 1)] * 99}], ids=["none", "gaps"]
)
def test_empty_and_incomplete_curves_are_drawn(tmp_path, series):
    draw_curves(tmp_path / "c.png", series, x_label="x", y_label="y", title="t", log_y=True)
    assert (tmp_path / "c.png").stat().st_size > 5000


def test_report_is_self_contained_and_escaped(tmp_path):
    nasty, picture, page = "<script>alert('&\"')</script>", tmp_path / "c.png", tmp_path / "r.html"
    draw_curves(picture, {"a": [(0, 1), (1, 2)]}, x_label="x", y_label="y", title="t")
    write_report(
        page,
        title=nasty,
        lead=nasty,
        summary={nasty: 0.12345, "none": float("nan"), "count": 7},
        tables=[(nasty, ("class", nasty), [(nasty, 0.5)])],
        galleries=[("Small & many", [("one", picture), ("two", picture)])],
        pictures=[(nasty, picture), ("by name", str(picture))],
        wide_pictures=[("wide one", picture)],
    )
    text = page.read_text(encoding="utf-8")
    # Parse as XML, which rejects elements that are not closed in order.
    root = ElementTree.fromstring(re.sub("(<(meta|img)[^>]*)>", r"\1/>", text.removeprefix("<!doctype html>")))
    texts = list(root.itertext())
    assert "script" not in {element.tag for element in root.iter()}
    assert texts.count(nasty) == 8
    assert {"0.123", "–", "7", "0.500"} <= set(texts)
    assert not re.search(r"https?://", text)
    data = base64.b64encode(picture.read_bytes()).decode()
    sources = [value for element in root.iter() for name, value in element.items() if name in ("src", "href")]
    assert sources == [f"data:image/png;base64,{data}"] * 5
    gallery, rest = text.split('<h2>Small &amp; many</h2><div class="gallery">')[1].split("</figure></div>")
    assert gallery.count("<figcaption>") == 2
    wide = rest.split('<div class="wide">')[1]
    assert "wide one" in wide
    assert "by name" not in wide

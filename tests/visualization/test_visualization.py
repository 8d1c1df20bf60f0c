"""Pictures show what they should where they should; files are written whole or not at all."""

import html.parser
import re
from types import SimpleNamespace

import matplotlib.image
import numpy as np
import pytest

from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.types import CHANNELS, CLASSES
from fcos_lidar_jax.visualization.bev import draw_bev
from fcos_lidar_jax.visualization.curves import draw_curves
from fcos_lidar_jax.visualization.figure import EMPTY, class_color
from fcos_lidar_jax.visualization.range_image import _row_inclinations, draw_range_image
from fcos_lidar_jax.visualization.report import write_report

CAR, BICYCLE = CLASSES.index("car"), CLASSES.index("bicycle")
LIMIT_M = 25.0


def pixels(path):
    return (matplotlib.image.imread(path)[..., :3] * 255).round().astype(int)


def rgb(color):
    return np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])


def places(image, color):
    return np.argwhere(np.abs(image - rgb(color)).max(-1) <= 3)


def frames(image):
    """The panels' frames from top to bottom, as (top, bottom, left, right) in pixels."""
    black = (image < 60).all(-1)
    lines = np.flatnonzero(black.sum(1) > 0.6 * image.shape[1])
    edges = lines[np.diff(lines, prepend=-9) > 2]  # a line is up to two pixels thick
    sides = np.flatnonzero(black[edges[0] : edges[1]].mean(0) > 0.95)
    sides = sides[sides < 0.95 * image.shape[1]] if len(sides) > 4 else sides  # colour bars have sides too
    return [(top, bottom, sides[0], sides[-1]) for top, bottom in edges.reshape(-1, 2)]


class View:
    """A bird's-eye view and where its frame is."""

    def __init__(self, path, points=None, **options):
        draw_bev(
            np.full((1, 3), np.nan) if points is None else points,
            path,
            limit_m=LIMIT_M,
            **{"classes": CLASSES, **options},
        )
        self.image = pixels(path)
        self.frame = frames(self.image)[0]

    def at(self, x, y, reach=2):
        """The pixels around a place in metres."""
        top, bottom, left, right = self.frame
        row = round((LIMIT_M - y) / (2 * LIMIT_M) * (bottom - top) + top)
        column = round((x + LIMIT_M) / (2 * LIMIT_M) * (right - left) + left)
        return self.image[row - reach : row + reach + 1, column - reach : column + reach + 1]


def detection(*box, label=BICYCLE):
    return np.array([[*box, 0, 0]], float), np.array([label]), np.array([0.5])


@pytest.mark.parametrize("yaw", [0.0, 0.5, np.pi / 2, np.pi, -2.0])
def test_a_box_is_drawn_in_its_colour_at_its_place_with_its_heading(tmp_path, yaw):
    view = View(tmp_path / "a.png", detections=detection(-8, 12, 0, 10, 4, 1, yaw))
    cos, sin = np.cos(yaw), np.sin(yaw)
    for along, across, drawn in [
        (5, 0, True),  # front
        (-5, 0, True),  # back
        (0, 2, True),  # sides
        (0, -2, True),
        (5, 2, True),  # a corner
        (2.5, 0, True),  # the heading, forward alone
        (-2.5, 0, False),
        (2.5, 1, False),
        (7, 0, False),
    ]:
        place = view.at(-8 + cos * along - sin * across, 12 + sin * along + cos * across)
        assert bool(len(places(place, class_color(BICYCLE)))) == drawn, (along, across)


def test_truth_is_dashed_black_and_filled_in_its_colour(tmp_path):
    boxes, labels, _ = detection(8, -12, 0, 10, 4, 1, 0)
    view = View(tmp_path / "a.png", truth=(boxes, labels))
    fill = (0.7 * 255 + 0.3 * rgb(class_color(BICYCLE))).round().astype(int)
    assert np.abs(view.at(5, -12) - fill).max() <= 3
    dark = (view.at(8, -10, reach=60) < 90).all(-1).any(0)
    assert 0.4 < dark.mean() < 0.8
    assert np.count_nonzero(np.diff(dark.astype(int)) == 1) > 8  # dashes


def test_the_legend_has_the_classes_in_view_only(tmp_path):
    far = detection(90, 0, 0, 4, 2, 1, 0, label=CAR)
    near = detection(5, 5, 0, 4, 2, 1, 0, label=BICYCLE)
    both = tuple(np.concatenate(pair) for pair in zip(far, near, strict=True))
    view = View(tmp_path / "a.png", detections=both)
    legend = view.image[view.frame[1] + 10 :]
    assert len(places(legend, class_color(BICYCLE))) > 50
    assert not len(places(view.image, class_color(CAR)))


def test_any_number_of_classes_has_colours_and_a_legend(tmp_path):
    """More classes than the legend has room for, with names that Matplotlib would take for formulas."""
    colors = [class_color(label) for label in range(200)]
    assert len(set(colors)) == 200
    assert all(np.abs(rgb(a) - rgb(b)).sum() > 30 for i, a in enumerate(colors[:30]) for b in colors[:i])
    classes = [f"_{k}$x^$_" for k in range(140)]
    shift = np.zeros((140, 9))
    shift[:, 0], shift[:, 1] = np.arange(140) % 20 * 2 - 20, np.arange(140) // 20 * 4 - 12
    boxes = np.array([[0, 0, 0, 1.2, 1.2, 1, 0, 0, 0]]) + shift
    view = View(tmp_path / "a.png", truth=(boxes, np.arange(140)), classes=classes)
    fill = (0.7 * 255 + 0.3 * rgb(class_color(139))).round().astype(int)
    assert np.abs(view.at(*boxes[139, :2] - 0.3, reach=1) - fill).max() <= 3
    legend = view.image[view.frame[1] + 10 :]
    assert len(places(legend, class_color(29))) > 50
    assert not len(places(legend, class_color(30)))


def test_scores_stay_apart_and_within_the_picture(tmp_path):
    boxes = np.tile([[24.0, 24, 0, 0.6, 0.6, 1, 0, 0, 0]], (30, 1))
    view = View(tmp_path / "a.png", detections=(boxes, np.full(30, BICYCLE), np.linspace(0.1, 0.9, 30)))
    top, _, _, right = view.frame
    assert (view.image[: top - 2] == 255).all()
    assert (view.image[:, right + 4 :] == 255).all()


def test_higher_points_are_darker(tmp_path):
    ground = np.stack([np.linspace(-20, 20, 400), np.full(400, -10), np.full(400, -1.8)], 1)
    wall = ground + np.array([0, 20, 3])
    view = View(tmp_path / "a.png", np.concatenate([ground, wall]))
    assert view.at(7, 10).mean() < view.at(7, -10).mean() - 20


def test_a_view_of_nothing_is_drawn(tmp_path):
    View(tmp_path / "a.png", np.zeros((0, 3)))


def small_image(cells, *, lag=0.0, shape=(8, 16), rounds=1):
    """A range image with one point in each of the cells, 10 m away along +x."""
    features = np.zeros((*shape, 9, rounds), np.float32)
    for row, column in cells:
        values = {"x": 10, "range": 10, "intensity": 99, "existence": 1, "time_lag": lag, "inclination": -row / 10}
        features[row, column, :, 0] = [values.get(name, 0) for name in CHANNELS]
    return SimpleNamespace(features=features)


def cell_pixel(image, frame, row, column, shape=(8, 16)):
    top, bottom, left, right = frame
    at_row = round(top + (row + 0.5) / shape[0] * (bottom - top))
    return image[at_row, round(left + (column + 0.5) / shape[1] * (right - left))]


def test_a_filled_cell_shows_at_its_place_and_empty_ones_are_grey(tmp_path):
    draw_range_image(small_image([(2, 4), (7, 15)]), tmp_path / "a.png")
    image = pixels(tmp_path / "a.png")
    panels = frames(image)
    assert len(panels) == 2  # range and intensity
    for frame in panels:
        for row, column in np.ndindex(8, 16):
            grey = np.abs(cell_pixel(image, frame, row, column) - rgb(EMPTY)).max() <= 3
            assert grey == ((row, column) not in [(2, 4), (7, 15)]), (row, column)


def test_every_round_has_a_panel_and_the_lag_where_there_is_one(tmp_path):
    counts = {}
    for rounds, lag in [(1, 0.0), (3, 0.0), (1, 0.1)]:
        draw_range_image(small_image([(2, 4)], lag=lag, rounds=rounds), tmp_path / "a.png", title="t")
        counts[rounds, lag] = len(frames(pixels(tmp_path / "a.png")))
    assert counts == {(1, 0.0): 2, (3, 0.0): 4, (1, 0.1): 3}


def test_boxes_are_outlined_around_their_cells(tmp_path):
    image = small_image([(2, 4), (3, 5)])
    around = np.array([[10, 0, 0, 1, 1, 1, 0, 0, 0], [-10, 0, 0, 1, 1, 1, 0, 0, 0]], np.float32)
    red = []
    for boxes in (None, around[:1], around[1:]):
        draw_range_image(image, tmp_path / "a.png", boxes=boxes)
        red.append(places(pixels(tmp_path / "a.png"), "#ff1f1f"))
    assert [bool(len(r)) for r in red] == [False, True, False]
    draw_range_image(image, tmp_path / "a.png", boxes=around)
    top, bottom, left, right = frames(pixels(tmp_path / "a.png"))[0]
    rows = (red[1][:, 0] - top) / (bottom - top) * 8
    columns = (red[1][:, 1] - left) / (right - left) * 16
    np.testing.assert_allclose([rows.min(), rows.max(), columns.min(), columns.max()], [2, 4, 4, 6], atol=0.15)


def test_a_box_across_the_seam_is_outlined_at_both_ends(tmp_path):
    draw_range_image(
        small_image([(2, 0), (2, 15)]), tmp_path / "a.png", boxes=np.array([[10, 0, 0, 1, 1, 1, 0]], np.float32)
    )
    image = pixels(tmp_path / "a.png")
    _, _, left, right = frames(image)[0]
    columns = (places(image, "#ff1f1f")[:, 1] - left) / (right - left) * 16
    assert (columns < 1.2).any()
    assert (columns > 14.8).any()
    assert not ((columns > 1.2) & (columns < 14.8)).any()


def test_rows_are_labelled_by_their_points_inclination():
    table = _row_inclinations(small_image([(2, 0), (2, 9), (6, 1)]).features)
    np.testing.assert_allclose(table, -np.arange(8) / 10, atol=1e-6)  # between and beyond rows with points, too
    np.testing.assert_allclose(_row_inclinations(small_image([(3, 0)]).features), -0.3)
    assert not _row_inclinations(small_image([]).features).any()


def test_an_empty_and_a_whole_range_image_are_drawn(tmp_path):
    draw_range_image(small_image([]), tmp_path / "empty.png")
    frame = make_frame(0, TINY)
    image = project_points(frame.points, np.ones(len(frame.points), bool), TINY, num_rounds=2)
    draw_range_image(image, tmp_path / "whole.png", title="t", boxes=frame.boxes)
    assert len(places(pixels(tmp_path / "empty.png"), EMPTY)) > len(places(pixels(tmp_path / "whole.png"), EMPTY))


def test_curves_rise_with_their_values(tmp_path):
    series = {"a": [(x, 10**x) for x in np.linspace(0, 2, 100)]}
    draw_curves(tmp_path / "c.png", series, x_label="x", y_label="y", title="t", log_y=True)
    found = places(pixels(tmp_path / "c.png"), "#0072b2")
    found = found[np.bincount(found[:, 0])[found[:, 0]] < 15]  # without the level line in the legend
    (bottom, left), (top, right) = found[found[:, 1].argmin()], found[found[:, 1].argmax()]
    middle = found[np.abs(found[:, 1] - (left + right) / 2) < 3, 0]
    assert top < bottom - 200
    assert np.abs(middle - (top + bottom) / 2).min() < 5  # 10 halfway between 1 and 100


@pytest.mark.parametrize("log_y", [False, True])
@pytest.mark.parametrize(
    "series",
    [{}, {"a": []}, {"a": [(1, 2)]}, {"a": [(1, float("nan")), (2, 0), (3, -1)], "b": [(1, 1)] * 99}],
    ids=["none", "empty", "one", "gaps"],
)
def test_odd_curves_are_drawn_too(tmp_path, series, log_y):
    draw_curves(tmp_path / "c.png", series, x_label="x", y_label="y", title="t", log_y=log_y)
    assert (tmp_path / "c.png").stat().st_size > 5000


class Tags(html.parser.HTMLParser):
    """Text, attributes, and whether every element is closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.text, self.sources = [], [], []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img"):
            self.open.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def test_report_is_self_contained_and_escaped(tmp_path):
    nasty = "<script>alert('&\"')</script>"
    draw_curves(tmp_path / "c.png", {"a": [(0, 1), (1, 2)]}, x_label="x", y_label="y", title="t")
    write_report(
        tmp_path / "r.html",
        title=nasty,
        lead=nasty,
        summary={nasty: 0.12345, "none": float("nan"), "count": 7},
        tables=[(nasty, ("class", nasty), [(nasty, 0.5)])],
        pictures=[(nasty, tmp_path / "c.png"), ("by name", str(tmp_path / "c.png"))],
    )
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(page)
    assert not tags.open
    assert "script" not in {t for t in re.findall(r"<(\w+)", page)}
    assert tags.text.count(nasty) == 8
    assert {"0.123", "–", "7", "0.500"} <= set(tags.text)
    assert not re.search(r"https?://", page)
    assert len(tags.sources) == 2
    assert all(s.startswith("data:image/png;base64,") for s in tags.sources)

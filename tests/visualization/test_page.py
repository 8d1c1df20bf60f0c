"""Check the data in the HTML page, and that it is self-contained. See test_page_browser.py for its behaviour."""

import base64
import gzip
import re

import numpy as np
import pytest
from commands import page_content

from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.visualization.page import STEP_M, encode_points, page_frame, write_page


def decoded(num_points, max_lag_s, text):
    """Decode points f64[n, 5] byte by byte, as the script of the page does."""
    data, step = gzip.decompress(base64.b64decode(text)), num_points
    assert len(data) == 8 * num_points
    points, x = [], 0
    for i in range(num_points):
        low = [data[2 * axis * step + i] + 256 * data[(2 * axis + 1) * step + i] for axis in range(3)]
        x = (x + low[0]) % 2**16
        signed = [value - 2**16 * (value >= 2**15) for value in (x, *low[1:])]
        lag = data[7 * step + i] / 255 * max_lag_s
        points.append([*(value * STEP_M for value in signed), data[6 * step + i], lag])
    return np.array(points).reshape(-1, 5)


def found(seed, number=7):
    rng = np.random.default_rng(seed)
    boxes = rng.normal(0, 20, (number, 9)).astype(np.float32)
    boxes[:, 3:6] = 4, 2, 1.5
    return boxes, rng.integers(0, 2, number), rng.random(number).astype(np.float32)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A page of two frames, with a class name that tries to end the script."""
    path = tmp_path_factory.mktemp("page") / "page.html"
    frames = []
    for index in range(2):
        pose = np.eye(4)
        pose[0, 3] = 5 * index
        points, truth = make_frame(index, NUSCENES_HDL32E).points[:, :4], found(index + 9)[:2]
        truth[0][0, 7:] = np.nan
        look = {"name": f"sweep {index}.bin", "ids": np.arange(7) + index, "truth": truth}
        frames.append(page_frame(points, found(index), time_us=10**5 * index, pose=pose, **look))
    write_page(path, frames, classes=("car", "</script><b>"), title="<Drive> {{drive}}")
    return path


def test_boxes_survive_a_round_trip(page):
    drive = page_content(page)
    assert drive["title"] == "<Drive> {{drive}}"
    assert drive["classes"] == ["car", "</script><b>"]
    for index, frame in enumerate(drive["frames"]):
        boxes, labels, scores = found(index)
        np.testing.assert_array_equal(np.array(frame["boxes"], np.float32), boxes)
        np.testing.assert_array_equal(np.array(frame["scores"], np.float32), scores)
        assert frame["labels"] == labels.tolist()
        assert frame["ids"] == list(range(index, index + 7))
        assert frame["name"] == f"sweep {index}.bin"
        truth, truth_labels, _ = found(index + 9)
        assert frame["truth"][0][7:] == [None, None]
        np.testing.assert_array_equal(np.array(frame["truth"][1:], np.float32), truth[1:])
        assert frame["truth_labels"] == truth_labels.tolist()
        assert np.array(frame["pose"]).reshape(4, 4)[0, 3] == 5 * index


def test_points_survive_a_round_trip_within_half_a_step():
    rng = np.random.default_rng(0)
    points = rng.uniform(-600, 600, (500, 4)).astype(np.float32)
    points[:, 3] = rng.integers(0, 256, 500)
    points[0, :3] = -655.3
    back = decoded(*encode_points(points))
    order = np.argsort(np.round(points[:, 0] / STEP_M), kind="stable")
    assert len(back) == 500
    np.testing.assert_allclose(back[:, 0], points[order, 0], atol=STEP_M / 2 + 1e-4)
    for x, y, z, value, _ in back:
        nearest = np.argmin(np.abs(points[:, :3] - (x, y, z)).sum(axis=1))
        assert points[nearest, 3] == value


def test_each_sweep_keeps_its_points_and_its_lag():
    """Sweeps are sorted from the newest; a position in two sweeps is kept for both."""
    points = np.zeros((6, 5), np.float32)
    points[:, 0], points[:, 4] = (3, 3, -600, 600, 1, 1), (0.45, 0, 0.2, 0.2, np.nan, -5)
    back = decoded(*encode_points(points))
    np.testing.assert_allclose(back[:, [0, 4]], [[1, 0], [3, 0], [-600, 0.2], [600, 0.2], [3, 0.45]], atol=1e-3)
    assert encode_points(points[:, :4])[1] == 0


def test_non_finite_and_distant_points_are_omitted():
    points = np.array([[np.nan, 0, 0, 1], [700, 0, 0, 1], [1, 2, 3, np.nan], [4, 5, 6, 1e9]], np.float32)
    np.testing.assert_allclose(decoded(*encode_points(points)), [[1, 2, 3, 0, 0], [4, 5, 6, 255, 0]], atol=1e-9)
    assert decoded(*encode_points(points[:0])).shape == (0, 5)


def test_the_template_contains_no_external_links(page):
    text = re.sub(r'id="drive">.*?</script>', "", page.read_text(), flags=re.DOTALL)
    text = text.replace("<meta http-equiv=", "")  # the page's content security policy
    for word in ("http", "src=", "fetch", "import", "@font-face", "url(", "XMLHttp", "WebSocket", "sendBeacon"):
        assert word not in text, word
    assert re.findall(r'href="([^"]*)"', text) == ["data:,"]


def test_forty_sweeps_take_less_than_eight_megabytes():
    *_, text = encode_points(make_frame(3, NUSCENES_HDL32E).points)
    assert 40 * len(text) < 8e6

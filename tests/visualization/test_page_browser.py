"""Check the HTML page in a real browser: drawing, keys, touch, no requests. test_page_script.py asks the rest."""

import numpy as np
import pytest
from browser import find_browser, open_tab, start_browser

from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.visualization.page import page_frame, write_page

pytestmark = pytest.mark.slow

CLASSES = ("car", "truck")
BLUE, RED = (31, 119, 180), (214, 39, 40)  # colours of the first two classes
LIGHT, DARK = (251, 251, 250), (16, 18, 20)  # backgrounds
BOXES = np.array([[8, 5, 0, 6, 3, 2, 0.4, 0, 0], [-10, -6, -0.5, 8, 3, 3, 2, 0, 0]], np.float32)
SCORES = np.array([0.9, 0.4], np.float32)
TRUTH = np.array([[-9, 7, 0, 5, 2, 0.01, -0.7, 0, 0]], np.float32)
WIDTH, HEIGHT = 1280, 800


@pytest.fixture(scope="module")
def browser():
    path = find_browser()
    if path is None:
        pytest.skip("neither chromium nor chrome is installed")
    with start_browser(path) as started:
        yield started


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A page of three frames of a drive, 4 m apart along x, each with two boxes and one true box."""
    path, frames = tmp_path_factory.mktemp("page") / "page.html", []
    for index in range(3):
        pose = np.eye(4)
        pose[0, 3] = 4 * index
        look = {"pose": pose, "time_us": index * 500_000, "truth": (TRUTH, [0]), "name": f"frame {'abc'[index]}"}
        points = make_frame(index, NUSCENES_HDL32E).points[:, :4]
        frames.append(page_frame(points, (BOXES, np.array([0, 1]), SCORES), **look))
    write_page(path, frames, classes=CLASSES, title="A drive")
    return path


@pytest.fixture
def empty_page(tmp_path):
    """A page of one frame with boxes and a single point far below, so that nothing hides the boxes."""
    path, point = tmp_path / "page.html", np.array([[0, 0, -30, 0]], np.float32)
    write_page(
        path, [page_frame(point, (BOXES, [0, 1], SCORES), name="a", truth=(TRUTH, [0]))], classes=CLASSES, title=""
    )
    return path


def state(tab):
    """Wait until the page has drawn and return its status text."""
    tab.run("(async () => { while (!$('state').textContent) await new Promise(r => setTimeout(r, 20)); })()")
    tab.settle()
    return tab.run("$('state').textContent")


def from_above(points, distance=60.0, centre=(WIDTH / 2, HEIGHT / 2), shortest=HEIGHT):
    """Screen positions of points, f64[n, 2], for a camera ``distance`` above the origin that looks down.

    The field of view is 0.9 rad, with +y up, because there is no drive to define another direction.
    """
    points = np.asarray(points, float)
    scale = shortest / 2 / np.tan(0.45) / (distance - points[:, 2])
    return np.stack([centre[0] + scale * points[:, 0], centre[1] - scale * points[:, 1]], axis=1)


def corners(box):
    x, y, z, l, w, h, yaw = box[:7].astype(float)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    flat = np.array([[l, w], [l, -w], [-l, -w], [-l, w]]) / 2 @ turn.T + (x, y)
    return np.concatenate([np.c_[flat, np.full(4, z - h / 2)], np.c_[flat, np.full(4, z + h / 2)]])


def near(picture, color, tolerance=40):
    return np.abs(picture.astype(int) - color).max(axis=2) <= tolerance


def canvas(tab):
    """Take a screenshot of the canvas only, with text and controls hidden."""
    tab.run("document.querySelectorAll('header, footer, #text').forEach(e => e.style.visibility = 'hidden')")
    return tab.picture()


@pytest.mark.parametrize(
    ("width", "dark"), [(1280, False), (390, True)], ids=["wide and light", "narrow and dark"]
)
def test_the_page_draws_fits_and_makes_no_requests(browser, page, width, dark):
    with open_tab(browser, page.as_uri(), width=width, dark=dark) as tab:
        assert state(tab) == "frame 1 of 3, 0.00 s, 2 boxes, 1 in truth"
        parts = "[...document.querySelectorAll('header, footer, header *, footer *')].filter(e => e.offsetParent)"
        rectangles = tab.run(
            f"{parts}.map(e => e.getBoundingClientRect()).map(r => [r.left, r.right, r.top, r.bottom])"
        )
        assert len(rectangles) > 12
        left, right, top, bottom = np.array(rectangles).T
        assert left.min() >= 0 <= top.min()
        assert right.max() <= width
        assert bottom.max() <= 800
        # The controls leave most of the screen to the picture.
        assert (
            tab.run("$('score').closest('footer').offsetHeight + document.querySelector('header').offsetHeight")
            < 260
        )
        drawn = ~near(canvas(tab), DARK if dark else LIGHT, 6)
        assert drawn.mean() > 0.02
        asked = {event["request"]["url"] for event in tab.events("Network.requestWillBeSent")}
        assert {url for url in asked if not url.startswith("data:")} == {page.as_uri()}
        assert tab.events("Runtime.exceptionThrown") == tab.events("Log.entryAdded") == []
        # The content security policy forbids requests.
        for place in ("'data:,x'", "location.href", "'http://127.0.0.1:9/'"):
            assert tab.run(f"fetch({place}).then(() => 'fetched', () => 'refused')") == "refused"


def test_boxes_are_drawn_at_their_coordinates(browser, empty_page):
    with open_tab(browser, empty_page.as_uri()) as tab:
        state(tab)
        tab.press("b")
        picture = canvas(tab)
    for box, color in zip(BOXES, (BLUE, RED), strict=True):
        place, found = from_above(corners(box)), np.argwhere(near(picture, color))[:, ::-1]
        nose = from_above(
            [[*(box[:2] + (box[3] / 2 + 0.7) * np.array([np.cos(box[6]), np.sin(box[6])])), box[2] + box[5] / 2]]
        )
        expected = np.concatenate([place, nose])
        assert np.abs(found.min(axis=0) - expected.min(axis=0)).max() < 2.5
        assert np.abs(found.max(axis=0) - expected.max(axis=0)).max() < 2.5
        for a, b in [(i, (i + 1) % 4) for i in range(4)] + [(i + 4, (i + 1) % 4 + 4) for i in range(4)]:
            for share in np.linspace(0, 1, 9):
                point = place[a] * (1 - share) + place[b] * share
                assert np.linalg.norm(found - point, axis=1).min() < 2, (box, a, b, share)


def test_truth_is_dashed_and_can_be_hidden(browser, empty_page):
    place = from_above(corners(TRUTH[0])[:4])
    with open_tab(browser, empty_page.as_uri()) as tab:
        state(tab)
        tab.press("b")
        ink = np.argwhere(near(canvas(tab), (0, 0, 0)))[:, ::-1]
        edge = [place[0] * (1 - share) + place[3] * share for share in np.linspace(0, 1, 200)]
        covered = np.mean([np.abs(ink - point).max(axis=1).min() < 1.5 for point in edge])
        assert 0.4 < covered < 0.95
        tab.press("t")
        assert not near(tab.picture(), (0, 0, 0)).any()
        assert near(tab.picture(), BLUE).any()


def test_keys_and_sliders_change_frame_and_threshold(browser, page):
    with open_tab(browser, page.as_uri()) as tab:
        state(tab)
        first = canvas(tab)
        tab.press("ArrowRight")
        tab.settle()
        assert state(tab) == "frame 2 of 3, 0.50 s, 2 boxes, 1 in truth"
        assert tab.run("$('name').textContent") == "frame b"
        assert (tab.picture() != first).any(axis=2).mean() > 0.01
        for _ in range(3):  # starts at 0.3
            tab.press("ArrowUp")
        assert "1 boxes" in state(tab)
        assert not near(tab.picture(), RED, 20).any()
        tab.run("$('score').value = 0.95, $('score').dispatchEvent(new Event('input'))")
        assert "0 boxes" in state(tab)
        tab.run("$('frame').value = 2, $('frame').dispatchEvent(new Event('input'))")
        tab.run(
            "(async () => { while (now !== 2 || !frames[2].places) await new Promise(r => setTimeout(r, 20)); })()"
        )
        assert state(tab).startswith("frame 3 of 3, 1.00 s")
        tab.press(" ")
        tab.run("(async () => { while (now === 2) await new Promise(r => setTimeout(r, 20)); })()")
        assert tab.run("$('play').textContent") == "Stop"
        tab.press(" ")
        assert tab.run("$('play').textContent") == "Play"


def test_points_are_drawn_at_their_coordinates_with_earlier_sweeps(browser, tmp_path):
    """Uses two frames of a drive with one point each, and one cloud of two points of different age."""
    nothing, points = (np.zeros((0, 9)), np.zeros(0, int), np.zeros(0)), [[10, 4, 0, 200], [-8, 9, 1, 200]]
    frames = []
    for index, point in enumerate(points):
        turn, pose = 0.5 * index, np.eye(4)
        pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        pose[:3, 3] = 3 * index, 0, 0
        frames.append(page_frame(np.array([point], np.float32), nothing, name="", pose=pose, time_us=index))
    fused = np.array([[10, -4, 0, 0, 0], [-12, -5, 0, 0, 0.45]], np.float32)
    frames.append(page_frame(fused, nothing, name=""))
    path = tmp_path / "page.html"
    write_page(path, frames, classes=CLASSES, title="")
    world = np.linalg.inv(pose) @ [10, 4, 0, 1]  # the first frame's pose is the identity
    with open_tab(browser, path.as_uri()) as tab:
        state(tab)
        tab.run("view.yaw = behind = -Math.PI / 2")
        for key in ("b", "ArrowRight"):
            tab.press(key)
        tab.run("show(1)")

        def drawn(point):
            x, y = np.round(from_above([point])[0]).astype(int)
            around = canvas(tab)[y - 3 : y + 4, x - 3 : x + 4]
            return around[~near(around, LIGHT, 12)]

        assert len(drawn(points[1][:3])) > 0 == len(drawn(world[:3]))
        for _ in range(2):
            tab.press("c")
        assert "sweeps of 0.00 s" in state(tab)
        assert len(drawn(points[1][:3])) > 0 < len(drawn(world[:3]))
        tab.press("ArrowRight")
        assert "sweeps of 0.45 s" in state(tab)
        new, old = (drawn(point[:3]) for point in fused)
        assert np.abs(new.min(axis=0).astype(int) - old.min(axis=0)).max() > 40


def test_touch_rotates_zooms_and_pans(browser, page):
    with open_tab(browser, page.as_uri(), width=390) as tab:
        state(tab)

        def drag(start, end):
            for kind, places in (("touchStart", start), ("touchMove", end), ("touchEnd", [])):
                fingers = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
                tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)
            return tab.run("({...view})")

        before = tab.run("({...view})")
        turned = drag([(200, 400)], [(250, 430)])
        assert turned["yaw"] != before["yaw"]
        assert turned["pitch"] > before["pitch"]
        assert turned["distance"] == before["distance"]
        near = drag([(180, 400), (220, 400)], [(100, 400), (300, 400)])
        assert near["distance"] < 0.5 * before["distance"]
        assert near["yaw"] == turned["yaw"]
        tab.run("bird()")
        moved = drag([(200, 400)], [(250, 430)])
        assert (moved["x"], moved["y"]) != (near["x"], near["y"])


def test_the_page_redraws_after_a_lost_context(browser, page):
    with open_tab(browser, page.as_uri()) as tab:
        state(tab)
        before = canvas(tab)
        tab.run("var lost = gl.getExtension('WEBGL_lose_context'); lost.loseContext()")
        tab.settle()
        tab.run("""new Promise(done => {
            $('view').addEventListener('webglcontextrestored', () => done(0), {once: true});
            lost.restoreContext(); })""")
        assert (tab.picture() != before).any(axis=2).mean() < 0.01

"""Check what the script of the HTML page picks and hides, in Node.js without a screen."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest

from fcos_lidar_jax.visualization.page import page_frame, write_page

CLASSES = ("car", "traffic cone", "bus")
BOXES = np.array([[8, 5, 0, 6, 3, 2, 0.4, 0, 0], [7, 5, 0, 0.5, 0.4, 1, 0, 0, 0], [-10, -6, 0, 8, 3, 3, 2, 0, 0]])
SCORES = np.array([0.9, 0.4, 0.2])
TRUTH = np.array([[-9, 7, 0, 5, 2, 1, -0.7, np.nan, np.nan]])
WIDTH, HEIGHT = 1280, 800

# Enough of a browser to run the script, but no WebGL.
BROWSER = f"""
const made = {{}}, element = () => ({{
  children: [], style: {{setProperty: () => 0}}, append(...parts) {{ this.children.push(...parts); }},
  addEventListener: (name, act) => {{ (handlers[name] ??= []).push(act); }}, setPointerCapture: () => 0,
  getContext: () => null, checked: true, value: "0",
}}), handlers = {{}};
globalThis.document = {{getElementById: id => made[id] ??= element(), createElement: element}};
Object.assign(globalThis, {{innerWidth: {WIDTH}, innerHeight: {HEIGHT}, addEventListener: () => 0,
  matchMedia: () => element(), requestAnimationFrame: () => 0}});
"""
CLICK = """
function click(x, y, moved = 0) {
  for (const [name, shift] of [["pointerdown", 0], ["pointermove", moved], ["pointerup", moved]])
    for (const act of handlers[name] ?? []) act({pointerId: 1, clientX: x + shift, clientY: y, buttons: 1});
  return describe(frames[now]);
}
"""


@pytest.fixture(scope="module")
def evaluate(tmp_path_factory):
    """A function that runs an expression in the script of a page of two frames, seen from above."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("Node.js is not installed")
    folder = tmp_path_factory.mktemp("page")
    point = np.array([[0, 0, -30, 0]], np.float32)
    frame = page_frame(point, (BOXES, np.array([0, 1, 2]), SCORES), name="a", truth=(TRUTH, np.array([0])))
    write_page(folder / "page.html", [frame, frame], classes=CLASSES, title="")
    content, script = re.findall(r"<script.*?>(.*?)</script>", (folder / "page.html").read_text(), re.DOTALL)

    def run(expression, **changes):
        drive = f"made.drive = {{textContent: {json.dumps(json.dumps(json.loads(content) | changes))}}};"
        text = f"{BROWSER}{drive}{script}{CLICK}bird(); console.log(JSON.stringify({expression}));"
        (folder / "page.js").write_text(text)
        done = subprocess.run([node, folder / "page.js"], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


def at(x, y, z=0.0):
    """Screen position for a camera 60 m above the origin with a field of view of 0.9 rad, +y up."""
    scale = HEIGHT / 2 / np.tan(0.45) / (60 - z)
    return f"{WIDTH / 2 + scale * x:.1f}, {HEIGHT / 2 - scale * y:.1f}"


CAR = "car, score 0.90, 6.0 m long, 3.0 m wide, 2.0 m high, 9.4 m away"
CONE = "traffic cone, score 0.40, 0.5 m long, 0.4 m wide, 1.0 m high, 8.6 m away"
TRUE = "car, truth, 5.0 m long, 2.0 m wide, 1.0 m high, 11.4 m away"


def test_a_click_picks_the_smallest_visible_box_around_it(evaluate):
    places = [at(9.5, 5.5), at(7, 5), at(-9, 7), at(0, 0), at(-10, -6)]
    found = evaluate(f"[{', '.join(f'click({place})' for place in places)}]")
    assert found == [CAR, CONE, TRUE, "", ""]  # the bus is below the threshold
    assert evaluate(f"[$('score').value = '0.1', click({at(-10, -6)})]")[1].startswith(
        "bus, score 0.20, 8.0 m long"
    )


def test_a_drag_does_not_pick(evaluate):
    assert evaluate(f"click({at(7, 5)}, 30)") == ""


def test_a_picked_box_is_forgotten_when_it_is_no_longer_shown(evaluate):
    cone = f"click({at(7, 5)})"
    assert evaluate(f"[{cone}, $('score').value = '0.5', describe(frames[0])]") == [CONE, "0.5", ""]
    assert evaluate(f"[{cone}, now = 1, describe(frames[1])]") == [CONE, 1, ""]


def test_without_poses_the_view_is_from_behind_the_heading_of_the_sensor(evaluate):
    for forward_rad, behind in ((None, -np.pi / 2), (np.pi / 2, -np.pi / 2), (0, -np.pi)):
        assert evaluate("[behind, view.yaw]", forward_rad=forward_rad) == pytest.approx([behind, behind])


def test_classes_can_be_hidden(evaluate):
    hide = (
        "made.classes.children.map(e => e.children[0]).slice(0, 2).map(b => { b.checked = false; b.onchange(); })"
    )
    names = "made.classes.children.map(e => e.children[1])"
    show = "(b => { b.checked = true; b.onchange(); })(made.classes.children[1].children[0])"
    state = "[shown(frames[0]), truth(frames[0])]"
    found = evaluate(f"[{names}, {state}, {hide}, {state}, click({at(7, 5)}), {show}, {state}]")
    assert found[0] == list(CLASSES)
    assert (found[1], found[3], found[4], found[6]) == ([[0, 1], [0]], [[], []], "", [[1], []])

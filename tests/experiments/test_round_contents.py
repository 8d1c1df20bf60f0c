"""Contents of the extra rounds: shares of a cloud made by hand, and of simulated frames by loops."""

import dataclasses
import json
import math
import sys

import numpy as np
import pytest

from experiments.script import run_measurement
from experiments.studies import round_contents as study
from experiments.studies.round_contents import GROUPS, KINDS, READING, SENSOR, Args, contents, summarize
from fcos_lidar_jax.data.box_geometry import inside_box
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.simulation.frame_set import city_frames
from fcos_lidar_jax.simulation.lidar import SWEEP_S

STILL, MOVING = (0, 20, 0, 2, 2, 2, 0, 0, 0), (20, 0, 0, 2, 2, 2, 0, 8, 0)
"""Boxes x, y, z, l, w, h, yaw, vx, vy. The sensor sees the second half a turn before the end of a sweep: at 19.8 m
in the current sweep, at 19 m a tenth of a second before."""
BACKGROUND = [(-20, -20, 0, 0), (-20.03, -20.03, 0, 0.05), (-20.3, -20.3, 0, 0.1), (-25, -25, 0, 0.15)]
ON_STILL = [(0, 19.5, 0, 0), (0, 19.55, 0, 0.2), (0, 22, 0, 0.3)]  # the last is behind it
ON_MOVING = [
    (18.9, 0, 0, 0),
    (18.25, 0, 0, 0.1),
    (24, 0, 0, 0.2),
    (18.5, 0, -0.5, 0.1),
]  # the last in a cell below


def cloud(*rows) -> np.ndarray:
    """Points f32[n, 5] of rows (x, y, z, time lag)."""
    x, y, z, lag = np.array(rows, np.float32).T
    return np.stack([x, y, z, np.full_like(x, 9), lag], axis=1)


POINTS, BOXES = cloud(*BACKGROUND, *ON_STILL, *ON_MOVING), np.array([STILL, MOVING], np.float32)


def test_the_cells_of_a_small_cloud_hold_what_was_put_there():
    found = contents(POINTS, BOXES)
    near, between, far, nothing = [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]
    assert found["cells"].tolist() == [1, 1, 2]
    assert found["kinds"].tolist() == [
        [near, between, far, nothing],
        [near, far, nothing, nothing],
        [between, far, nothing, nothing],
    ]
    np.testing.assert_allclose(found["age_s"], [[0.05, 0.1, 0.15, 0], [0.2, 0.3, 0, 0], [0.1, 0.2, 0, 0]])
    assert found["history"].tolist() == [0, 1, 1]
    assert found["objects"].tolist() == [1, 1, 1]


def test_an_object_of_which_one_sweep_is_left_has_no_history():
    current = POINTS[POINTS[:, 4] == 0]
    assert contents(current, BOXES)["objects"].tolist() == [1, 0, 0]
    older_alone = contents(cloud(*ON_MOVING[1:]), BOXES)
    assert (older_alone["objects"].tolist(), older_alone["history"].tolist()) == ([1, 0, 0], [0, 0, 0])


def test_a_simulated_frame_is_counted_as_by_a_loop():
    frame = dataclasses.replace(
        city_frames(SENSOR, 1, 7), reading=dataclasses.replace(READING, num_sweeps=3)
    ).frame(0)
    found, boxes, points = contents(frame.points, frame.boxes), [], frame.points
    for box in frame.boxes.astype(float):
        delay = SWEEP_S * (1 - (math.pi - math.atan2(box[1], box[0])) / (2 * math.pi))
        boxes.append([box - [*(box[7:9] * (k * SWEEP_S + delay)), *[0] * 7] for k in range(3)])
    owner = np.full(len(points), -1)
    for number, moments in enumerate(boxes):
        for k, box in enumerate(moments):
            owner[inside_box(points, box) & (np.round(points[:, 4] / SWEEP_S) == k)] = number
    image = project_points(points, np.ones(len(points), bool), SENSOR, num_rounds=5)
    cells, kinds, history = [0] * 3, np.zeros((3, 4, 3), int), [0] * 3
    for first, *later in np.asarray(image.point_index).reshape(-1, 5).tolist():
        if first < 0:
            continue
        own = owner[first]
        group = 0 if own < 0 else 1 + int(math.hypot(*frame.boxes[own, 7:9]) > 0.5)
        cells[group] += 1
        older = False
        for r, other in enumerate(later):
            if other >= 0:
                distance = math.dist(points[first, :3].tolist(), points[other, :3].tolist())
                kinds[group, r, 0 if distance < 0.1 else 1 if distance < 1 else 2] += 1
                older |= own >= 0 and owner[other] == own and points[other, 4] > points[first, 4]
        history[group] += older
    assert min(cells) > 50
    assert history[2] > 20
    np.testing.assert_array_equal(found["cells"], cells)
    np.testing.assert_array_equal(found["history"], history)
    np.testing.assert_allclose(found["kinds"], kinds, atol=1)  # float32 distances beside 0.1 m and 1 m


def test_shares_are_of_all_cells_and_their_intervals_over_frames(monkeypatch):
    monkeypatch.setattr(study, "_MIN_POINTS", 1)
    more = contents(cloud(*BACKGROUND[:2]), BOXES)  # near in round 2, and nothing else
    same = summarize([contents(POINTS, BOXES)] * 3)
    assert same["moving objects"]["older in a later round"] == [50.0, 50.0, 50.0]
    assert same["each moving object"] == {
        "objects": 3,
        "older in a later round": [100.0] * 3,
        "two sweeps in the first round": [100.0] * 3,
    }
    record = summarize([contents(POINTS, BOXES), more])
    assert list(record) == ["frames", "all", *GROUPS, "each moving object"]
    assert record["all"]["cells"] == 5
    assert record["all"]["round 2"]["filled"][0] == 80.0
    assert [record["all"]["round 2"][kind][0] for kind in KINDS] == [75.0, 25.0, 0.0]
    assert record["all"]["round 2"]["within 0.1 m"][1:] == [66.7, 100.0]  # only the first frame, only the second
    assert record["all"]["round 2"]["mean age, s"] == pytest.approx((0.05 + 0.2 + 0.1 + 0.05) / 4)
    assert record["background"]["round 4"] == {
        "filled": [50.0, 0.0, 100.0],
        **dict(zip(KINDS, ([0.0] * 3, [0.0] * 3, [100.0, 0.0, 100.0]), strict=True)),
        "mean age, s": 0.15,
    }
    assert "older in a later round" not in record["background"]
    assert summarize([more], ())["all"]["round 2"]["within 0.1 m"] == [100.0], "one cloud has no interval"


def test_the_file_holds_simulated_frames_and_the_real_cloud(tmp_path, monkeypatch):
    (tmp_path / "ten_sweep_cloud").mkdir()
    POINTS.astype(np.float16).tofile(tmp_path / "ten_sweep_cloud" / "cloud.f16.bin")
    out = tmp_path / "record.json"
    monkeypatch.setattr(sys, "argv", ["contents", "--frames", "1", "--data", str(tmp_path), "--out", str(out)])
    with pytest.raises(SystemExit) as ended:
        run_measurement(study.measure, Args, study.__doc__)
    assert ended.value.code == 0
    record = json.loads(out.read_text())
    assert record["real, ten sweeps"]["all"]["cells"] == 4
    assert record["real, one sweep"]["all"]["cells"] == 3
    ten, one = record["simulated, ten sweeps"], record["simulated, one sweep"]
    assert ten["all"]["round 5"]["filled"][0] > 50 > 5 > one["all"]["round 2"]["filled"][0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--frames", "0"], "--frames: got 0, expected at least 1"),
        (["--data", "nowhere"], "--data: nowhere: no ten_sweep_cloud/cloud.f16.bin there"),
    ],
)
def test_a_mistake_is_one_line_before_anything_is_simulated(tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["contents", *options])
    with pytest.raises(SystemExit, match="1"):
        run_measurement(study.measure, Args, None)
    assert capsys.readouterr().err == f"contents: error: {message}\n"
    assert list(tmp_path.iterdir()) == []

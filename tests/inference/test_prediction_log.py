"""Counts of removed points; tests/cli/test_evaluate.py tests the results file."""

import numpy as np
import pytest
from refusal import refused
from tiny_run import CONFIG, SENSOR
from toy_frames import ToyFrames

from fcos_lidar_jax.data.cloud_policy import Cloud
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.inference import prediction_log as results
from fcos_lidar_jax.inference.loop import Prediction
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.types import Detections


def test_counts_of_all_processes_are_summed_exactly(monkeypatch):
    counts = [2**31, 2**63, 5]
    assert results._sum_over_processes(counts) == counts

    def of_two(words, tiled):
        return np.concatenate([words, words])

    monkeypatch.setattr(results.multihost_utils, "process_allgather", of_two)
    assert results._sum_over_processes(counts) == [2**32, 2**64, 10]


def test_points_of_a_cloud_that_another_process_has_read_are_not_counted():
    cloud = Cloud(np.zeros((0, 5)), np.zeros(0, bool), num_points=9, num_close=1, num_invalid=2, num_truncated=3)
    nothing = Detections(*np.zeros((3, 0)), valid=np.zeros(0, bool), num_dropped=np.int32(0))
    assert results._removed(Prediction(0, nothing, None, cloud)) == [1, 2, 3]
    assert results._removed(Prediction(0, nothing, None, None)) == [0, 0, 0]


def boxes_cloud_and_note(num_dropped):
    cloud = Cloud(np.zeros((9, 5)), np.ones(9, bool), num_points=9, num_close=0, num_invalid=0, num_truncated=0)
    nothing = np.zeros((0, 9)), *np.zeros((2, 0)), np.zeros(0, bool)
    note = None if num_dropped < 9 else "none of its 9 points is usable"
    return Detections(*nothing, num_dropped=np.int32(num_dropped)), cloud, note


def run_with(monkeypatch, predict, out, **how):
    """Write the predictions of a stand-in for the detection."""
    monkeypatch.setattr(results, "predict", predict)
    how = {"entries": lambda found: ([], ""), "write": lambda path, entries: path.write_text("")} | how
    detector = TrainedDetector(build_detector(CONFIG, SENSOR), {})
    results.write_predictions(detector, ToyFrames(size=3), out, **how)


def test_a_run_without_any_usable_points_is_refused(monkeypatch, tmp_path):
    def predict(detector, frames, *, indices, **how):
        for index in indices:
            boxes, cloud, note = boxes_cloud_and_note(9)
            yield Prediction(index, boxes, None, cloud, note)

    for _ in range(2):
        with refused("none of its 9 points is usable"):
            run_with(monkeypatch, predict, tmp_path / "detections.json")
    assert list(tmp_path.iterdir()) == []


def test_frames_without_usable_points_of_other_processes_are_counted(monkeypatch, tmp_path, capsys):
    def predict(detector, frames, *, indices, **how):
        boxes, cloud, note = boxes_cloud_and_note(9)
        own = [(cloud, note) if index == 2 else (None, None) for index in range(3)]
        yield from (Prediction(index, boxes, None, *each) for index, each in enumerate(own))

    others = iter([True, False, False])

    def of_two(own, tiled):
        return np.concatenate([own, [next(others)]]) if own.dtype == bool else own

    assert [results._in_any_process(flag) for flag in (True, False)] == [True, False]
    monkeypatch.setattr(results.multihost_utils, "process_allgather", of_two)
    run_with(monkeypatch, predict, tmp_path / "x.json")
    told = capsys.readouterr().err
    assert "note: 2 of 3 clouds without usable points" in told
    assert "the first is toy 0: no usable points\n" in told


@pytest.mark.parametrize(
    ("options", "clouds", "again"), [(None, "a", [0, 2]), ([0.5], "a", [0, 1, 2]), (None, "changed", [0, 1, 2])]
)
def test_a_resumed_run_also_counts_the_frames_without_usable_points_of_the_part_before(
    monkeypatch, tmp_path, capsys, options, clouds, again
):
    detected, written = [], []

    def predict(detector, frames, *, indices, **how):
        for index in indices:
            if len(detected) == 2:
                detected.append("interrupted")
                raise KeyboardInterrupt
            boxes, cloud, note = boxes_cloud_and_note(9 if index in (0, 2) else 4)
            detected.append(index)
            yield Prediction(index, boxes, None, cloud, note)

    def run(**how):
        entries, write = lambda found: ([{"index": found.index}], ""), lambda _, found: written.extend(found)
        run_with(monkeypatch, predict, tmp_path / "x.json", entries=entries, write=write, **how)

    monkeypatch.setattr(ToyFrames, "clouds_fingerprint", lambda *_: "a")
    with pytest.raises(KeyboardInterrupt):
        run()
    monkeypatch.setattr(ToyFrames, "clouds_fingerprint", lambda *_: clouds)
    run(options=options)
    assert detected == [0, 1, "interrupted", *again]
    assert written == [(f"toy {i}", b'[{"index": %d}]' % i) for i in range(3)]
    told = capsys.readouterr().err
    assert "note: 2 of 3 clouds without usable points, and so without boxes: the first is none of its 9" in told
    assert "frames 3/3" in told

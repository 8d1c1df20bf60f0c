"""Counts of removed points; tests/cli/test_evaluate.py tests the results file."""

import numpy as np
import pytest
from refusal import refused
from toy_frames import ToyFrames

from fcos_lidar_jax.data.cloud_policy import Cloud
from fcos_lidar_jax.inference import load_detector
from fcos_lidar_jax.inference import prediction_log as results
from fcos_lidar_jax.inference.prediction import Prediction
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


def cloud_and_boxes(num_dropped):
    cloud = Cloud(np.zeros((9, 5)), np.ones(9, bool), num_points=9, num_close=0, num_invalid=0, num_truncated=0)
    nothing = np.zeros((0, 9)), *np.zeros((2, 0)), np.zeros(0, bool)
    return cloud, Detections(*nothing, num_dropped=np.int32(num_dropped))


@pytest.mark.parametrize("unusable", [1, 3])
def test_frames_without_usable_points_are_reported_and_only_such_frames_refused(
    unusable, monkeypatch, tmp_path, capsys
):
    def predict_groups(detector, frames, *, indices, **how):
        for index in indices:
            cloud, boxes = cloud_and_boxes(9 if index < unusable else 4)
            yield [Prediction(index, boxes, None, cloud)]

    monkeypatch.setattr(results, "predict_groups", predict_groups)
    detector = load_detector("quickstart")
    frames, out = ToyFrames(size=3), tmp_path / "detections.json"

    def run():
        how = {"entries": lambda index, boxes: [], "write": lambda path, entries: path.write_text("")}
        results.write_predictions(detector, frames, out, **how)

    first = f"{frames.name(0)}: none of its 9 points is usable"
    if unusable == 3:
        for _ in range(2):
            with refused(first):
                run()
        assert not out.exists()
        return
    run()
    assert f"note: 1 of 3 clouds without usable points, and so without boxes: {first}" in capsys.readouterr().err


def test_frames_without_usable_points_of_other_processes_are_counted(monkeypatch, tmp_path, capsys):
    def predict_groups(detector, frames, *, indices, **how):
        cloud, boxes = cloud_and_boxes(9)
        yield [Prediction(index, boxes, None, cloud if index == 2 else None) for index in range(3)]

    def of_two(own, tiled):
        return np.concatenate([own, [[True, False, False]]]) if own.dtype == bool else own

    assert results._in_any_process([True, False]) == [True, False]
    monkeypatch.setattr(results, "predict_groups", predict_groups)
    monkeypatch.setattr(results.multihost_utils, "process_allgather", of_two)
    how = {"entries": lambda index, boxes: [], "write": lambda path, entries: [*entries]}
    results.write_predictions(load_detector("quickstart"), ToyFrames(size=3), tmp_path / "x.json", **how)
    told = capsys.readouterr().err
    assert "note: 2 of 3 clouds without usable points" in told
    assert "the first is toy 0: no usable points\n" in told


def test_a_resumed_run_also_counts_the_frames_without_usable_points_of_the_part_before(
    monkeypatch, tmp_path, capsys
):
    detected, written = [], []

    def predict_groups(detector, frames, *, indices, **how):
        for index in indices:
            if len(detected) == 2:
                detected.append("interrupted")
                raise KeyboardInterrupt
            cloud, boxes = cloud_and_boxes(9 if index in (0, 3) else 4)
            detected.append(index)
            yield [Prediction(index, boxes, None, cloud)]

    def run():
        how = {"entries": lambda index, _: [{"index": index}], "write": lambda _, found: written.extend(found)}
        results.write_predictions(load_detector("quickstart"), ToyFrames(size=4), tmp_path / "x.json", **how)

    monkeypatch.setattr(results, "predict_groups", predict_groups)
    with pytest.raises(KeyboardInterrupt):
        run()
    run()
    assert detected == [0, 1, "interrupted", 0, 2, 3]
    assert written == [(f"toy {i}", b'[{"index": %d}]' % i) for i in range(4)]
    told = capsys.readouterr().err
    assert "note: 2 of 4 clouds without usable points" in told
    assert "frames 4/4" in told

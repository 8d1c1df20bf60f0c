"""Predictions and evaluations of frames."""

from tiny_run import CONFIG, FRAMES, TESTS, weights

from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.trainer import evaluate, prediction


def test_an_evaluation_keeps_no_cloud(monkeypatch):
    kept = []

    def evaluate_frames(found, truths, metric):
        kept.extend(truths)

    monkeypatch.setattr(prediction, "evaluate_frames", evaluate_frames)
    detector = TrainedDetector(build_detector(CONFIG, FRAMES.sensor), weights())
    evaluate(detector, TESTS)
    assert [frame.points.shape for frame in kept] == 2 * [(0, 5)]
    assert all(frame.points.base is None for frame in kept), "a view of the whole cloud"

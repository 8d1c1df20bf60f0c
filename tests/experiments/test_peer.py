"""The table of CenterPoint beside the range view, and what cells of long trainings hold beside their scores."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
import tiny_run
from linear_network import linear_network

from experiments.benchmarks.latency import stage_calls
from experiments.changes import change
from experiments.paper_tables.scales import quarter
from experiments.studies import centerpoint
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import CENTERPOINT_COMPACT


def test_each_row_is_compared_with_centerpoint_on_its_sweeps():
    for table in (centerpoint.TABLE, centerpoint.WITH_SECOND_LOOK):
        for row in [row for row in table.rows if row.label.startswith("FCOS-LiDAR")]:
            assert table.reference_of(row).label == f"CenterPoint, {row.label.rpartition(', ')[2]}"
    looks = [row.change(quarter(Path("unused")).base).refinement for row in centerpoint.ROWS_WITH_SECOND_LOOK]
    assert None not in looks
    assert len({*looks}) == 1


def test_both_detectors_share_all_but_themselves(tmp_path):
    scale = quarter(tmp_path)
    for rows, sweeps in ((centerpoint.ROWS[:3], 10), (centerpoint.ROWS[3:], 1)):
        base = dataclasses.replace(scale.base, num_sweeps=sweeps)
        peer, ours, plain = (row.change(scale.base) for row in rows)
        assert plain == base
        assert ours == change(model__local_geometry=True)(base)
        assert peer.pillars == CENTERPOINT_COMPACT.pillars
        inference = dataclasses.replace(base.inference, iou_exponent=1.0, candidates_per_level=4450)
        assert peer.inference == inference
        shared = {"model": base.model, "loss": base.loss, "inference": base.inference}
        assert Config.of(peer, **shared) == base
    sizes = image_layout(scale.sensor, base.model).level_sizes  # (location, class) pairs of the range view
    assert sum(min(base.inference.candidates_per_level, len(base.classes) * size) for size in sizes) == 4450


@pytest.mark.slow
def test_the_stages_that_are_timed_are_the_detector():
    config = change(inference__min_probability=0.0)(tiny_run.CONFIG)  # random weights are sure of nothing
    with linear_network():
        detector = build_detector(config, tiny_run.SENSOR)
        variables = detector.init(jax.random.key(0))
    cloud = make_cloud(tiny_run.FRAMES.frame(0).points, config, sensor=tiny_run.SENSOR, num_close=0)
    calls = stage_calls(detector, variables, cloud)
    whole = calls["points to boxes, one program"]()
    assert whole.valid.any()
    expected = whole.boxes, whole.scores, whole.labels, whole.valid
    for stage, of_whole in zip(calls["post-processing"](), expected, strict=True):
        np.testing.assert_allclose(stage, of_whole, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("own_ms", "peer_ms", "seen", "theirs"), [(10, 12, 250, "40.0, 50.0"), (12, 10, 300, "60.0, 70.0")]
)
def test_after_equal_time_the_slower_detector_has_seen_fewer_samples(own_ms, peer_ms, seen, theirs):
    curves = [[[100, 0.1], [200, 0.2], [300, 0.6]], [[100, 0.2], [200, 0.3], [300, 0.7]]]
    peer = [{"curve": curve} for curve in curves]
    ours = [{"curve": [[100, 0.1], [300, 0.35]]}, None]  # The second seed diverged.
    times = {"ours": {"training step, ms": own_ms}, "CenterPoint": {"training step, ms": peer_ms}}
    record = {
        "rows": [
            {"label": "CenterPoint", "reference": "CenterPoint", "scores": peer},
            {"label": "ours", "reference": "CenterPoint", "scores": ours},
        ],
        "figures": {"columns": times},
    }
    (line,) = centerpoint.equal_time(record)
    assert "mAP on the frames of the curves: 35.0 at the end; " in line
    assert f"CenterPoint after as much time, {seen} samples: {theirs}." in line
    for row in record["rows"]:
        del row["scores"]
    assert list(centerpoint.equal_time(record)) == []

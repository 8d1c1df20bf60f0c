"""MetricsLog: one line of JSON per step, events for TensorBoard, and the records of killed runs."""

import json
import resource
from pathlib import Path

import pytest
from event_files import read_events, summaries
from tensorboardX.proto.event_pb2 import SessionLog

from fcos_lidar_jax.training.metrics_log import MetricsLog, read_metrics


def write(folder: Path, steps, *, first_step: int = 0) -> None:
    records = MetricsLog(folder, first_step=first_step)
    for step in steps:
        records.write(step, {"loss/total": 10.0 / step, "positives": step, "per_level": [step, 0]})
    records.close()


def steps(folder: Path) -> list[int]:
    return [line["step"] for line in read_metrics(folder)]


def test_records_survive_a_round_trip_and_are_on_disk_before_the_next_step(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"metrics\.jsonl"):
        read_metrics(tmp_path)
    records = MetricsLog(tmp_path, first_step=0)
    records.write(1, {"loss/total": 10.0, "positives": 1, "per_level": [1, 0]})
    assert read_metrics(tmp_path) == [{"step": 1, "loss/total": 10.0, "positives": 1, "per_level": [1, 0]}]
    records.close()


@pytest.mark.parametrize(
    ("appended", "kept"),
    [
        (b'{"step": 3}\n{"step": 4}\n', [1, 2, 3, 4]),
        (b'{"step": 3, "a": "\xff"}\n[]\n{"step": "x"}\n' + b"[" * 10**5 + b'\n{"step": 3}\n', [1, 2, 3]),
        (b'{"step": 3, "a"', [1, 2]),
    ],
    ids=["later steps", "invalid lines", "an incomplete line"],
)
def test_a_resumed_run_drops_later_steps_and_invalid_lines(tmp_path, appended, kept):
    write(tmp_path, [1, 2])
    file = tmp_path / "metrics.jsonl"
    with file.open("ab") as stream:
        stream.write(appended)
    assert steps(tmp_path) == kept
    write(tmp_path, [3, 4], first_step=2)
    assert [json.loads(line)["step"] for line in file.read_text().splitlines()] == [1, 2, 3, 4]
    assert list(tmp_path.glob(".*")) == []


def test_tensorboard_gets_every_number_and_the_step_of_a_resumption(tmp_path):
    write(tmp_path, [1, 2])
    values = {(tag, step): value for tag, step, value in summaries(tmp_path / "tensorboard")}
    tags = ("loss/total", "positives", "per_level/0", "per_level/1")
    expected = {1: (10.0, 1.0, 1.0, 0.0), 2: (5.0, 2.0, 2.0, 0.0)}
    assert values == {(tag, step): v for step, row in expected.items() for tag, v in zip(tags, row, strict=True)}
    write(tmp_path, [2, 3], first_step=1)
    starts = [event for event in read_events(tmp_path / "tensorboard") if event.HasField("session_log")]
    # TensorBoard then drops earlier events from step 2 on.
    assert (starts[-1].step, starts[-1].session_log.status) == (2, SessionLog.START)


def test_a_full_disk_raises_at_once_and_nothing_is_printed(tmp_path, capfd):
    records = MetricsLog(tmp_path, first_step=0)
    records.write(1, {"loss": 1.0})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (9, limits[1]))
    try:
        for fail in (records.flush, records.close):
            with pytest.raises(OSError, match=r"/tensorboard: cannot be written: File too large$"):
                fail()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert capfd.readouterr() == ("", "")

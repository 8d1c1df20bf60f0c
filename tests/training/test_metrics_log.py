"""MetricsLog: one line of JSON a step, TensorBoard's events beside it, and what a killed run leaves."""

import json
import resource
import struct
from pathlib import Path

import pytest
from tensorboardX.proto.event_pb2 import Event

from fcos_lidar_jax.training.metrics_log import MetricsLog, read_metrics


def write(folder: Path, steps, *, first_step: int = 0) -> None:
    records = MetricsLog(folder, first_step=first_step)
    for step in steps:
        records.write(step, {"loss/total": 10.0 / step, "positives": step, "per_level": [step, 0]})
    records.close()


def events(folder: Path) -> list[Event]:
    """All events of a folder's files, oldest file first: u64 length, u32 check, the message, u32 check."""
    found = []
    for file in sorted((folder / "tensorboard").iterdir(), key=lambda file: file.stat().st_mtime_ns):
        content, at = file.read_bytes(), 0
        while at < len(content):
            (length,) = struct.unpack_from("<Q", content, at)
            found.append(Event.FromString(content[at + 12 : at + 12 + length]))
            at += 16 + length
    return found


def test_lines_are_read_as_they_were_written(tmp_path):
    write(tmp_path, [1, 2])
    assert (tmp_path / "metrics.jsonl").read_text().count("\n") == 2
    assert read_metrics(tmp_path) == [
        {"step": 1, "loss/total": 10.0, "positives": 1, "per_level": [1, 0]},
        {"step": 2, "loss/total": 5.0, "positives": 2, "per_level": [2, 0]},
    ]


def steps(folder: Path) -> list[int]:
    return [line["step"] for line in read_metrics(folder)]


def test_a_line_is_on_disk_before_the_next_step(tmp_path):
    records = MetricsLog(tmp_path, first_step=0)
    records.write(1, {"a": 1.0})
    assert steps(tmp_path) == [1]
    records.close()


def test_a_resumed_run_forgets_what_came_after_its_checkpoint(tmp_path):
    write(tmp_path, [1, 2, 3, 4])
    write(tmp_path, [3, 4, 5], first_step=2)
    assert steps(tmp_path) == [1, 2, 3, 4, 5]


def test_what_is_no_line_is_left_out(tmp_path):
    write(tmp_path, [1, 2])
    with (tmp_path / "metrics.jsonl").open("ab") as file:
        file.write(b'{"step": 3, "a": "\xff"}\n[]\n{"step": "x"}\n' + b"[" * 10**5 + b'\n{"step": 3}\n')
    assert steps(tmp_path) == [1, 2, 3]
    write(tmp_path, [3, 4], first_step=2)
    assert steps(tmp_path) == [1, 2, 3, 4]


def test_half_a_line_of_a_killed_run_is_dropped(tmp_path):
    write(tmp_path, [1, 2])
    file = tmp_path / "metrics.jsonl"
    file.write_text(file.read_text()[:-9])
    assert steps(tmp_path) == [1]
    write(tmp_path, [2], first_step=1)
    assert [json.loads(line)["step"] for line in file.read_text().splitlines()] == [1, 2]
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_tensorboard_gets_every_number_and_where_a_run_went_on(tmp_path):
    write(tmp_path, [1, 2])
    values = {(v.tag, e.step): v.simple_value for e in events(tmp_path) for v in e.summary.value}
    tags = ("loss/total", "positives", "per_level/0", "per_level/1")
    expected = {1: (10.0, 1.0, 1.0, 0.0), 2: (5.0, 2.0, 2.0, 0.0)}
    assert values == {(tag, step): v for step, row in expected.items() for tag, v in zip(tags, row, strict=True)}
    write(tmp_path, [2, 3], first_step=1)
    starts = [e.step for e in events(tmp_path) if e.HasField("session_log")]
    assert starts[-1] == 2  # TensorBoard then drops steps from 2 on that were written before


def test_where_there_is_no_room_it_is_told_at_once_and_nothing_is_printed(tmp_path, capfd):
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


def test_without_a_file_there_is_a_clear_error(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"metrics\.jsonl"):
        read_metrics(tmp_path)

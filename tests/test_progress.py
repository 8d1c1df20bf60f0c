"""Check progress lines and notes."""

import re
import time

import jax
import pytest

from fcos_lidar_jax.progress import Progress, tell


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass when a test says so."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def lines_of(progress, clock, capsys, steps, seconds, text=""):
    """What is printed for items that take some seconds each."""
    for done in steps:
        clock[0] += seconds
        progress.show(done, text)
    return capsys.readouterr().err.splitlines()


def test_the_first_and_last_item_print_a_line(clock, capsys):
    lines = lines_of(Progress("scenes", 4, every_s=60), clock, capsys, (1, 2, 3, 4), 2, "32 objects")
    assert lines == ["scenes 1/4  32 objects", "scenes 4/4  32 objects  0.50 scenes/s, 0 s left"]


def test_without_a_total_lines_have_a_rate_and_no_time_left(clock, capsys):
    assert lines_of(Progress("sweeps", None, every_s=4), clock, capsys, (1, 2, 3), 2) == [
        "sweeps 1",
        "sweeps 3  0.50 sweeps/s",
    ]


def test_the_rate_of_resumed_work_counts_only_new_items(clock, capsys):
    lines = lines_of(Progress("steps", 100, every_s=0), clock, capsys, (90, 91), 2)
    assert lines[1] == "steps 91/100  0.50 steps/s, 18 s left"


def test_a_pause_is_forgotten(clock, capsys):
    progress = Progress("steps", 1000)
    before = lines_of(progress, clock, capsys, range(0, 400, 10), 10)
    clock[0] += 3600
    after = lines_of(progress, clock, capsys, range(400, 800, 10), 10)
    assert (len(before), len(after)) == (40, 40)
    assert before[-1].endswith("1.00 steps/s, 610 s left")
    assert float(re.search(r"([\d.]+) steps/s", after[0])[1]) < 0.1
    assert after[-1] == "steps 790/1000  1.00 steps/s, 210 s left"


def test_a_line_is_told_once_and_only_by_the_first_process(capsys, monkeypatch):
    for _ in range(2):
        tell("often")
        tell("told once", once=True)
    assert capsys.readouterr().err == "often\ntold once\noften\n"
    for number in (1, 2):
        tell(f"number {number}", once="numbers")
    assert capsys.readouterr().err == "number 1\n"
    monkeypatch.setattr(jax.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    tell("by another process")
    assert capsys.readouterr().err == ""

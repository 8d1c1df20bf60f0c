"""Check progress lines and notes."""

import re
import time

import jax

from fcos_lidar_jax.progress import Progress, tell


def test_the_first_and_last_item_print_a_line(capsys):
    progress = Progress("scenes", 4, every_s=60)
    for done in (1, 2, 3, 4):
        progress.show(done, "32 objects")
        time.sleep(0.02)
    first, last = capsys.readouterr().err.splitlines()
    assert first == "scenes 1/4  32 objects"
    rate = re.fullmatch(r"scenes 4/4  32 objects  (\d+\.\d\d) scenes/s, 0 s left", last)
    assert rate is not None
    assert 10 < float(rate[1]) <= 50


def test_without_a_total_lines_have_a_rate_and_no_time_left(capsys):
    progress = Progress("sweeps", None, every_s=0.05)
    for done in (1, 2, 3):
        progress.show(done)
        time.sleep(0.03)
    first, last = capsys.readouterr().err.splitlines()
    assert first == "sweeps 1"
    assert re.fullmatch(r"sweeps 3  \d+\.\d\d sweeps/s", last)


def test_the_rate_of_resumed_work_counts_only_new_items(capsys):
    progress = Progress("steps", 100, every_s=0)
    progress.show(90)
    time.sleep(0.05)
    progress.show(91)
    lines = capsys.readouterr().err.splitlines()
    left = re.search(r"(\d+\.\d\d) steps/s, (\d+) s left", lines[1])
    assert left is not None
    assert float(left[1]) <= 20


def test_a_pause_is_forgotten(capsys, monkeypatch):
    clock = iter([*range(0, 400, 10), *range(4000, 4400, 10)])  # an hour of pause after the 40th line
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    progress = Progress("steps", 1000)
    for line in range(80):
        progress.show(10 * line)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 80
    assert lines[39].endswith("1.00 steps/s, 610 s left")
    assert float(re.search(r"([\d.]+) steps/s", lines[40])[1]) < 0.1
    assert lines[-1] == "steps 790/1000  1.00 steps/s, 210 s left"


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

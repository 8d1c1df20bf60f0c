"""The studies of equivalence and of faults, in their short forms."""

import json

import numpy as np
import pytest
from commands import run_python

from experiments.studies.track_switches import count_switches


def run_study(name: str, tmp_path, *options: object) -> dict:
    out = tmp_path / "record.json"
    done = run_python("-m", f"experiments.studies.{name}", *options, "--out", out)
    assert done.returncode == 0, done.stderr
    return json.loads(out.read_text())


def test_five_steps_are_the_same_on_one_device_and_on_eight_in_two_processes(tmp_path):
    (mesh,) = run_study("device_equivalence", tmp_path, "--quick")["meshes"]
    assert (mesh["devices"], mesh["processes"], mesh["dtype"]) == (8, 2, "float64")
    assert mesh["after_five_steps"] < 1e-9


@pytest.mark.parametrize(
    ("commands", "faults"),
    [
        (("synthesize", "prepare"), ("kill", "pair", "fill_disk", "forbid")),
        (("evaluate",), ("kill",)),  # those of train are in tests/trainer
    ],
)
def test_no_work_is_lost(commands, faults, tmp_path):
    names = {"kill": "--kills", "pair": "--pairs", "fill_disk": "--full-disks", "damage": "--damages"}
    times = [word for fault, name in names.items() for word in (name, int(fault in faults))]
    done = run_study("faults", tmp_path, "--only", *commands, *times, "--train-kills", 1)["faults"]
    found = {what: (fault["same"], fault["times"]) for what, fault in done.items() if fault["times"]}
    assert found == {f"{command}: {fault}": (1, 1) for command in commands for fault in faults}


def test_hostile_clouds_do_no_harm(tmp_path):
    record = run_study("adversarial_clouds", tmp_path, "--projected", 300, "--detected", 10)
    assert (record["projected"]["clouds"], record["detected"]["clouds"]) == (300, 10)
    assert 0 < record["projected"]["in_image"] < record["projected"]["points"]
    assert record["projected"]["dropped"] > 0
    assert record["detected"]["boxes"] > 0


def test_switches_of_tracks_are_counted():
    """The first of two objects moves 3 m a frame, more than a track may be off; the second is once not seen."""
    first, second = np.zeros((6, 9)), np.full((6, 9), 40.0)
    first[:, 0], first[:, 7:9], second[:, 7:9] = 3.0 * np.arange(6), (6, 0), 0
    both = [(np.stack([a, b]), np.zeros(2, int), np.arange(2)) for a, b in zip(first, second, strict=True)]
    both[2] = tuple(column[:1] for column in both[2])
    assert count_switches(both, 0.5, velocities=True) == (0, 9)
    assert count_switches(both, 0.5, velocities=False) == (5, 9)

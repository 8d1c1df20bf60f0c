"""The study of equivalence, in its short form. ``tests/equivalence`` and ``tests/cli`` ask for more devices."""

import json
import sys

import pytest
import small_study
from commands import child_environment

from experiments.script import run_measurement
from experiments.studies import device_equivalence as study


@pytest.mark.slow
def test_five_steps_are_the_same_on_one_device_and_on_two(tmp_path, monkeypatch):
    out = tmp_path / "record.json"
    for name, value in child_environment().items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(study, "work", small_study.work)
    monkeypatch.setattr(sys, "argv", ["device_equivalence", "--quick", "--out", str(out)])
    with pytest.raises(SystemExit) as ended:
        run_measurement(study.measure_all, study.Args, study.__doc__)
    assert ended.value.code == 0
    (mesh,) = json.loads(out.read_text())["meshes"]
    assert (mesh["devices"], mesh["processes"], mesh["dtype"]) == (2, 1, "float64")
    # Half of a batch left out would change the third digit; tests/equivalence asks for the ninth.
    assert mesh["after_five_steps"] < 1e-8

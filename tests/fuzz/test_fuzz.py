"""The short form of the fuzzing, and a test that it notices every kind of failure."""

import json
import re
from typing import get_args

from commands import run_python

from fcos_lidar_jax.input_pipeline.open import Format

from .targets import plain_name


def test_every_reader_refuses_in_one_line_or_returns_valid_data(tmp_path):
    out = tmp_path / "fuzz.json"
    done = run_python("-m", "tests.fuzz", "--inputs", 10_000, "--workers", 1, "--memory-mib", 512, "--out", out)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    record = json.loads(out.read_text())
    assert (record["failures"], record["python_malloc"]) == (0, "debug")
    assert record["inputs"] >= 9_900
    accepted, refused = ({n for n, c in record["targets"].items() if c[what]} for what in ("accepted", "refused"))
    # Logs skip damaged lines; a run spec that differs in anything is of another run.
    assert record["targets"].keys() - refused == {"metrics.jsonl", "resume log"}
    assert record["targets"].keys() - accepted <= {"run.json"}
    fuzzed = set(map(plain_name, record["targets"]))
    assert set(get_args(Format)) - fuzzed == {"simulated"}


def test_targets_are_named_as_formats_are(tmp_path):
    out = tmp_path / "fuzz.json"
    run = ("-m", "tests.fuzz", "--inputs", 20, "--workers", 1, "--out", out, "--only")
    done = run_python(*run, "argoverse2", "KITTI")
    assert done.returncode == 0, done.stderr
    assert set(json.loads(out.read_text())["targets"]) == {"Argoverse 2", "KITTI"}
    done = run_python(*run, "kitti", "kiti")
    assert done.returncode == 1
    assert re.search("--only: got 'kiti', expected some of .*KITTI", done.stderr)


MISTREATED = """
import ctypes, json, sys, time, warnings
from pathlib import Path
from tests.fuzz.engine import Limits, fuzz
from tests.fuzz.targets import InvalidError, Target

def refuse(message):
    raise ValueError(message)

def invalid():
    raise InvalidError("half a result")

wrong = {
    "nothing": lambda file: None,
    "refusal": lambda file: refuse(f"{file}: wrong"),
    "other exception": lambda file: {}["key"],
    "warning": lambda file: warnings.warn("hm"),
    "no name": lambda file: refuse("wrong"),
    "two lines": lambda file: refuse(f"{file}: wrong\\nindeed"),
    "long": lambda file: refuse(f"{file}: {'wrong' * 5000}"),
    "invalid": lambda file: invalid(),
    "memory": lambda file: bytearray(1 << 30),
    "hang": lambda file: time.sleep(60),
    "crash": lambda file: ctypes.string_at(0),
}
def target(name, treat):
    return Target(name, {"a.txt": b"1 2 3"}, lambda folder, file: treat(folder / file), alone=True)

limits = Limits(memory_mib=256, seconds=1)
counts, failures = fuzz([target(*each) for each in wrong.items()], 22, seed=0, workers=3, limits=limits)
print(json.dumps([{n: vars(c) for n, c in counts.items()}, {f.target: f.problem for f in failures}]))
"""


def test_every_kind_of_failure_is_noticed():
    done = run_python("-c", MISTREATED)
    assert done.returncode == 0, done.stderr
    counts, problems = json.loads(done.stdout)
    assert {count["inputs"] for count in counts.values()} == {2}
    assert counts["nothing"]["accepted"] == counts["refusal"]["refused"] == 2
    assert {name for name, count in counts.items() if count["failed"] == 2} == set(problems)
    found = {name: problem.partition(" at ")[0].removesuffix(",") for name, problem in problems.items()}
    assert found == {
        "other exception": "KeyError",
        "warning": "UserWarning",
        "no name": "a message that does not name the file",
        "two lines": "a message of several lines",
        "long": "a message that is too long",
        "invalid": "accepted: half a result",
        "memory": "MemoryError",
        "hang": "takes too long",
        "crash": "ends the process with -11",
    }

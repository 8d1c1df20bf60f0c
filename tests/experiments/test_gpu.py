"""The measurements on a GPU: what is resumed, what a failure or a limit costs, and a row at toy size."""

import json
import os

import pytest

from experiments.benchmarks import gpu
from experiments.benchmarks.gpu import Args, Row, measure


def crashes(args):
    print("Check failed", flush=True)
    os._exit(3)


def test_the_same_command_continues_with_what_is_left(tmp_path, monkeypatch, capsys):
    rows = {name: Row(limit_s, crashes) for name, limit_s in (("bad", 10), ("long", 500), ("good", 10))}
    monkeypatch.setattr(gpu, "PARTS", {"detection": rows, "torch": {"other": Row(10, crashes)}})
    reached = []

    def run_row(args, part, name, row):
        first = {"bad": {"failed": "cannot"}, "other": {"missing": "torch in python"}}
        record = {"ms": 1} if name in reached else first.get(name, {"ms": 1})
        reached.append(name)
        gpu.keep(args, part, name, record)
        return record

    monkeypatch.setattr(gpu, "run_row", run_row)
    args = Args(out=tmp_path, parts=("detection",))
    file = tmp_path / "detection.json"
    with pytest.raises(ValueError, match=r"^failed: detection, bad: see "):
        measure(args)
    assert reached == ["bad", "good"]
    assert capsys.readouterr().out.splitlines()[2:] == ["left, for the same command: detection, long"]
    measure(Args(out=tmp_path, limit_s=700))
    assert reached[2:] == ["long", "other", "bad"], "failed rows come last"
    assert f"detection, good: already in {file}\n" in capsys.readouterr().out
    measure(args)
    assert len(reached) == 5
    measure(Args(out=tmp_path, limit_s=700))
    assert reached[5:] == ["other"], "which lacked torch"
    rows = {name: {"ms": 1} for name in ("bad", "good", "long")}
    assert json.loads(file.read_text()) == {"toy": False, "rows": rows}
    with pytest.raises(ValueError, match=r"detection\.json: toy: found False, expected True"):
        measure(Args(out=tmp_path, toy=True))
    with pytest.raises(ValueError, match=r"^--limit-s: got 539, expected at least 540, for the longest row"):
        measure(Args(out=tmp_path, limit_s=539))


@pytest.mark.slow
def test_a_row_that_crashes_or_takes_too_long_costs_only_itself(tmp_path, monkeypatch):
    rows = {"late": Row(0, crashes), "crashed": Row(600, crashes), "toy": gpu.PARTS["projection"]["rounds"]}
    monkeypatch.setattr(gpu, "PARTS", {"torch": rows})
    with pytest.raises(ValueError, match=r"^failed: torch, late; torch, crashed: see "):
        measure(Args(out=tmp_path, parts=("torch",), toy=True, limit_s=1200))
    late, crashed, toy = json.loads((tmp_path / "torch.json").read_text())["rows"].values()
    assert late["failed"] == "not finished after 0 s"
    assert crashed["failed"] == "exit code 3: Check failed"
    for times in (toy["single"], toy["multi"]):
        assert times["1"]["ratio"] == 1
        assert 0 < times["2"]["median_ms"] <= times["2"]["p99_ms"]
    assert toy["peak_memory_gib"] > 0
    assert {"device", "jax", "git"} <= toy.keys()

"""Programs compiled for a GPU that is not there: what is counted in them, and how failures are told."""

import dataclasses
import json
import subprocess

import pytest

from experiments.benchmarks import gpu_programs
from experiments.benchmarks.gpu_programs import PROGRAMS, Args, Program, check, count_kernels
from experiments.hardware import hardware
from fcos_lidar_jax.presets import QUICKSTART

pytestmark = pytest.mark.slow

MODULE = """HloModule jit_step

%inner (t: (s32[], f32[4])) -> (s32[], f32[4]) {
  %f1 = f32[4]{0} fusion(%x), kind=kLoop, calls=%fused
  ROOT %t1 = (s32[], f32[4]{0}) tuple(%i, %f1)
}

%outer (t: (s32[], f32[4])) -> (s32[], f32[4]) {
  %f2 = f32[4]{0} fusion(%x), kind=kLoop, calls=%fused
  %s = f32[4]{0} sort(%f2), dimensions={0}
  %w2 = (s32[], f32[4]{0}) while(%t), condition=%c, body=%inner
}

%few (p: f32[4]) -> f32[4] {
  ROOT %f3 = f32[4]{0} fusion(%p), kind=kLoop, calls=%fused
}

%many (p: f32[4]) -> f32[4] {
  %f4 = f32[4]{0} fusion(%p), kind=kLoop, calls=%fused
  ROOT %f5 = f32[4]{0} fusion(%f4), kind=kLoop, calls=%fused
}

ENTRY %main (p: f32[4]) -> f32[4] {
  %p = f32[4]{0} parameter(0)
  %w = (s32[], f32[4]{0}) while(%t), condition=%c, body=%outer, backend_config={"known_trip_count":{"n":"5"}}
  %conv = (f32[4]{0}, u8[0]{0}) custom-call(%p, %p), custom_call_target="__cudnn$convForward"
  %b = f32[4]{0} conditional(%i, %p, %p), branch_computations={%few, %many}
  ROOT %copy = f32[4]{0} copy(%b)
}
"""


def test_kernels_are_counted_by_loop_and_of_branches_the_larger():
    kernels, loops = count_kernels(MODULE)
    assert kernels == 2 + 2  # The convolution, the copy, and the branch of two.
    assert loops == [(5, 2), (None, 1)]


def test_programs_match_the_package():
    points = QUICKSTART.max_points
    _, (_, batch) = gpu_programs._function(Program("train", "quickstart", batch=2, devices=2))
    assert batch.points.shape[:2] == (2, points)
    _, (_, cloud, valid) = gpu_programs._function(Program("detect", "quickstart"))
    assert (cloud.shape[0], valid.shape) == (points, (points,))


def test_a_program_that_kills_the_compiler_is_reported_in_its_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "nvidia/cuda_nvcc").mkdir(parents=True)
    good = {**dataclasses.asdict(PROGRAMS["detect-compact"]), "seconds": 3, "gflop_per_frame": 2.0, "slow": 0}
    good |= {"temporary_mib": 5, "kernels": 7, "loops": [[5, 2], [None, 4]]}
    runs = iter([(0, json.dumps(good), ""), (-6, "", "one\nF 1 x.cc:627] Check failed: a == b (1 vs. 2)\nstack")])

    def compiled(command, *, env, **options):
        assert env["PYTHONPATH"].startswith(str(tmp_path))
        return subprocess.CompletedProcess(command, *next(runs))

    hardware()  # Before its own processes are replaced.
    monkeypatch.setattr(gpu_programs.subprocess, "run", compiled)
    args = Args(plugin=tmp_path, programs=("detect-compact", "train-compact"), out=tmp_path / "record.json")
    with pytest.raises(ValueError, match=r"not as they should be: train-compact$"):
        check(args)
    first, second, last = capsys.readouterr().out.splitlines()
    assert "2 GFLOP per frame" in first
    assert "loops 5x2 ?x4" in first
    assert second.endswith("FAILED: exit code -6: F 1 x.cc:627] Check failed: a == b (1 vs. 2)")
    assert last == "1 of 2 programs compile as they should"
    assert list(json.loads(args.out.read_text())["programs"]) == list(args.programs)

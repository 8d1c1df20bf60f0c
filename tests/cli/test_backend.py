"""``--backend openvino``, and the export as ONNX graphs."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from commands import command, run_python
from tiny_run import save_untrained

from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame

pytestmark = pytest.mark.slow

onnx = pytest.importorskip("onnx", reason="onnx, of the extra cpu, is not installed")
pytest.importorskip("openvino", reason="openvino, of the extra cpu, is not installed")


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("backend")
    save_untrained(folder / "checkpoint")
    (folder / "clouds").mkdir()
    for seed in range(2):
        np.save(folder / "clouds" / f"{seed}.npy", make_frame(seed, TINY).points)
    return folder


def test_detect_and_stream_agree_with_xla(home, tmp_path):
    files = {}
    for backend in ("xla", "openvino"):
        out = tmp_path / f"{backend}.json"
        command("detect", home / "clouds", "--checkpoint", home / "checkpoint", "--backend", backend, "--out", out)
        files[backend] = json.loads(out.read_text())["files"]
    for a, b in zip(*files.values(), strict=True):
        assert a["num_dropped"] == b["num_dropped"]
        scores = [[box["score"] for box in file["boxes"]] for file in (a, b)]
        assert len(scores[0]) > 0
        np.testing.assert_allclose(*scores, atol=0.02)  # bfloat16
    options = "--backend openvino --checkpoint", home / "checkpoint"
    command("stream", home / "clouds", *options, "--out", tmp_path / "a.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    assert [line["boxes"] for line in lines] == [file["boxes"] for file in files["openvino"]]


def test_benchmark_times_the_same_stages(home, tmp_path):
    options = "--backend openvino --repeats 1 --batch 1 2 --checkpoint", home / "checkpoint"
    command("benchmark", *options, "--out", tmp_path / "a")
    record = json.loads((tmp_path / "a").read_text())
    assert list(record["stages"]) == ["clean", "prepare", "network", "postprocess", "detect", "whole"]
    assert record["backend"] in ("openvino float32", "openvino bfloat16")


@pytest.mark.parametrize("part", ["--network-only", ""])
def test_export_writes_the_graph(home, tmp_path, capsys, part):
    command(f"export {part} --format onnx --checkpoint", home / "checkpoint", "--out", tmp_path / "a.onnx")
    onnx.checker.check_model(tmp_path / "a.onnx", full_check=True)
    assert json.loads(capsys.readouterr().out)["bytes"] == (tmp_path / "a.onnx").stat().st_size


def test_the_python_of_the_export_page_runs(home):
    text = (Path(__file__).parents[2] / "docs" / "export.md").read_text()
    code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[-1].replace("quickstart", "checkpoint")
    export = "export --network-only --format onnx --checkpoint"
    command(export, home / "checkpoint", "--out", home / "network.onnx")
    (home / "run.py").write_text(f"import os\nos.chdir({str(home)!r})\n{code}\nprint(boxes.shape)")
    ran = run_python(home / "run.py")
    assert ran.stdout == "(20, 9)\n", ran.stderr

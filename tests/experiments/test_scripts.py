"""Every script of the experiments: its help, which imports all that it uses, and mistakes before the work."""

import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(
    ".".join(file.relative_to(ROOT).with_suffix("").parts)
    for file in (ROOT / "experiments").rglob("*.py")
    if "run_script(" in (text := file.read_text()) or "run_measurement(" in text
)
SCRIPTS.remove("experiments.script")
TABLES = "paper_tables.__main__"


def run(script: str, options: list[str], monkeypatch, folder: Path) -> object:
    """Run a script as its command does, in an empty folder; returns the exit code."""
    monkeypatch.chdir(folder)
    monkeypatch.delenv("FCOS_LIDAR_REAL_DATA", raising=False)
    monkeypatch.delitem(sys.modules, script, raising=False)
    monkeypatch.setattr(sys, "argv", [script, *options])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(script, run_name="__main__")
    return ended.value.code


@pytest.mark.parametrize("script", SCRIPTS)
def test_the_help_of_a_script_names_its_command(script, monkeypatch, tmp_path, capsys):
    assert run(script, ["--help"], monkeypatch, tmp_path) == 0
    assert script.removesuffix(".__main__") in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (f"{TABLES} --seeds 0 0", "--seeds: got (0, 0), expected different seeds"),
        (f"{TABLES} --data nowhere", "--data: nowhere: no ten_sweep_cloud/cloud.f16.bin there"),
        (f"{TABLES} --scale sector --steps 5", "--steps: only for --scale nuscenes, got --scale sector"),
        (f"{TABLES} --tables table9", "--tables: got 'table9', expected some of table1,"),
        (f"{TABLES} --rows base", "--rows: got ['base'], expected none unless --tables names one table"),
        (f"{TABLES} --scale nuscenes", "data root: missing, expected the folder of a data set"),
        ("studies.centerpoint --scale nuscenes", "--scale: got nuscenes, expected smoke or sector"),
        ("studies.ladder --trials base magic", "--trials: got 'magic', expected some of base,"),
        ("studies.overfit_keyframe", "--data: missing, expected the folder that holds nuscenes_scene0061/"),
        ("studies.shipped_weights --name hdl32e --export", "--work: missing, expected the folder"),
        ("benchmarks.gpu_programs --plugin .", "--plugin: .: no nvidia/cuda_nvcc there: run bash .ci/gpu"),
    ],
)
def test_a_mistake_is_one_line_before_the_work(command, message, monkeypatch, tmp_path, capsys):
    script, *options = command.split()
    assert run(f"experiments.{script}", options, monkeypatch, tmp_path) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert list(tmp_path.iterdir()) == []

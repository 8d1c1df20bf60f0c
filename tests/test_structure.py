"""The structure of the project: layers, light imports, one test file a module."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_arrows_point_inward_only():
    run = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports; raise SystemExit(lint_imports())"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr


def test_the_core_loads_without_pictures_command_line_or_checkpoints():
    modules = "models, training, inference, projection, nms, losses, augment"
    code = (
        f"import sys; from fcos_lidar_jax import {modules}; "
        "print([m for m in ('matplotlib', 'tyro', 'orbax', 'tensorflow', 'torch') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_every_core_module_has_its_test_file():
    core = (
        {p.stem for p in (ROOT / "fcos_lidar_jax").glob("*.py")}
        - {"__init__", "__main__", "types"}
        - {"classes", "presets"}
    )  # of tests/test_config.py
    tested = {p.stem.removeprefix("test_") for p in (ROOT / "tests").glob("test_*.py")}
    assert core - tested == set()


def test_only_the_second_detector_and_the_presets_know_pillars():
    package = ROOT / "fcos_lidar_jax"
    knowing = [
        f for f in package.rglob("*.py") if re.search(r"\b[Pp]illar(s|Config)?\b", f.read_text(encoding="utf-8"))
    ]
    assert {f.relative_to(package).parts[0] for f in knowing} == {"centerpoint", "presets.py"}

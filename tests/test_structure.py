"""The structure of the project: what is named in one place. The layers are a matter of lint-imports."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

from fcos_lidar_jax.cli.commands import _COMMANDS
from fcos_lidar_jax.input_pipeline.open import READERS, Format

ROOT = Path(__file__).parents[1]


def nodes(*folders: str) -> Iterator[tuple[str, ast.AST]]:
    """The syntax of all files below some folders, with the files' names."""
    for folder in folders:
        for file in sorted((ROOT / folder).rglob("*.py")):
            name = file.relative_to(ROOT).as_posix()
            yield from ((name, node) for node in ast.walk(ast.parse(file.read_text())))


def test_only_the_rows_of_the_readers_know_formats_by_name():
    names = {reader.name for reader in READERS}
    assert names == set(get_args(Format))
    compared = {
        file
        for file, node in nodes("fcos_lidar_jax")
        if isinstance(node, ast.Compare) and "output_format" not in ast.unparse(node)  # formats of results
        for part in ast.walk(node)
        if isinstance(part, ast.Constant) and part.value in names
    }
    assert compared == set()


def test_no_command_imports_another():
    commands = {kind.__module__ for kind, *_ in _COMMANDS.values()}
    for file, node in nodes("fcos_lidar_jax/cli"):
        own = file.removesuffix(".py").replace("/", ".")
        if own in commands and isinstance(node, ast.ImportFrom):
            found = {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)} & commands
            assert found <= {own}, own


def test_only_the_second_detector_and_the_presets_know_pillars():
    package = ROOT / "fcos_lidar_jax"
    knowing = [
        f for f in package.rglob("*.py") if re.search(r"\b[Pp]illar(s|Config)?\b", f.read_text(encoding="utf-8"))
    ]
    assert {f.relative_to(package).parts[0] for f in knowing} == {"centerpoint", "presets.py"}

"""Print the lowest versions that pyproject.toml allows, as constraints for pip, but for tools that read code."""

import re
import tomllib
from pathlib import Path

TOOLS = ("ruff", "pyright", "import-linter", "check-jsonschema")

project = tomllib.loads(Path(__file__).parent.with_name("pyproject.toml").read_text(encoding="utf-8"))["project"]
for requirement in sorted({*project["dependencies"], *project["optional-dependencies"]["test"]}):
    name, lowest = re.fullmatch(r"([\w.-]+)>=([\d.]+)(?:,.*)?", requirement).groups()
    if name not in TOOLS:
        print(f"{name}=={lowest}")

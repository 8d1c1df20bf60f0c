"""Figures of the paper, with their places in it."""

import json
from pathlib import Path

PAPER = json.loads((Path(__file__).parent / "paper_tables" / "paper.json").read_text(encoding="utf-8"))
"""``{"tables": {name: {"place", "columns", "rows"}}, "text": {name: {"value", ...}}, "times": hardware}``."""
TIMES_NOTE = f"The paper's times: {PAPER['times']}. On other hardware, only ratios can be compared."

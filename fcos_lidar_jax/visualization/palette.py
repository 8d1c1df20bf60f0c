"""Colours that ten classes can be told apart by."""

CLASS_COLORS = (
    "#1f77b4",
    "#d62728",
    "#9467bd",
    "#8c564b",
    "#e6a000",
    "#e377c2",
    "#17becf",
    "#2ca02c",
    "#ff6f00",
    "#5b5b5b",
)
"""In the order of ``types.CLASSES``."""

EMPTY = "#d9d9d9"
"""Cells without a point."""

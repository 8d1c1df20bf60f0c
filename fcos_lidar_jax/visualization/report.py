"""A report as one HTML file that needs nothing else."""

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path

from fcos_lidar_jax.files import write_beside

Cell = str | float | int
Table = tuple[str, Sequence[str], Sequence[Sequence[Cell]]]
"""Caption, header, rows."""

_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 0 auto; padding: 1rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .5rem 0 1.5rem; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
th, td { padding: .2rem .7rem; border-bottom: 1px solid #8886; text-align: right; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1.5rem 0; }
img { max-width: 100%; height: auto; background: white; }
figcaption { color: #777; font-size: .9rem; }
"""


def write_report(
    path: str | Path,
    *,
    title: str,
    lead: str,
    summary: Mapping[str, Cell],
    tables: Sequence[Table] = (),
    pictures: Sequence[tuple[str, Path]] = (),
) -> None:
    """Write a self-contained report.

    Args:
        path: HTML file to write.
        title: heading.
        lead: one paragraph below it.
        summary: named values.
        tables: caption, header and rows each.
        pictures: caption and PNG each; the files are embedded.
    """
    parts = [f"<h1>{_text(title)}</h1>", f"<p>{_text(lead)}</p>"]
    parts.append(_table("Summary", ("", "value"), list(summary.items())))
    parts += [_table(*table) for table in tables]
    for caption, file in pictures:
        data = base64.b64encode(file.read_bytes()).decode("ascii")
        parts.append(
            f'<figure><img alt="{_text(caption)}" src="data:image/png;base64,{data}">'
            f"<figcaption>{_text(caption)}</figcaption></figure>"
        )
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(title)}</title><style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )
    write_beside(path, lambda out: out.write_text(page, encoding="utf-8"))


def _text(value: Cell) -> str:
    if isinstance(value, float):
        return "–" if value != value else f"{value:.3f}"
    return html.escape(str(value))


def _table(caption: str, header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    head = "".join(f"<th>{_text(h)}</th>" for h in header)
    body = "".join("<tr>" + "".join(f"<td>{_text(c)}</td>" for c in row) + "</tr>" for row in rows)
    return (
        f'<div class="scroll"><table><caption>{_text(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )

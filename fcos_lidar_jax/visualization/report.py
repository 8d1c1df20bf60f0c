"""Self-contained HTML reports."""

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path

from fcos_lidar_jax.files import atomic_write

Cell = str | float | int
Table = tuple[str, Sequence[str], Sequence[Sequence[Cell]]]  # caption, header, rows
Picture = tuple[str, str | Path]  # caption and PNG or GIF file

_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; line-height: 1.2; overflow-wrap: anywhere; }
p { max-width: 42rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .5rem 0 1.5rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid #8886; text-align: right; font-weight: 400; }
thead th { border-bottom-width: 2px; font-weight: 600; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1.5rem 0; }
img { display: block; max-width: 100%; height: auto; background: white; border-radius: .3rem; }
.gallery { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(20rem, 100%), 1fr)); gap: 1rem; }
.gallery figure { margin: 0; display: flex; flex-direction: column-reverse; justify-content: flex-end; }
.wide { overflow-x: auto; }
.wide img { max-width: none; width: max(100%, 50rem); }
h2 { font-size: 1.2rem; margin: 2rem 0 .5rem; }
figcaption { margin-top: .3rem; opacity: .8; font-size: .9rem; }
"""


def write_report(
    path: str | Path,
    *,
    title: str,
    summary: Mapping[str, Cell],
    lead: str = "",
    links: Sequence[tuple[str, str]] = (),
    tables: Sequence[Table] = (),
    galleries: Sequence[tuple[str, Sequence[Picture]]] = (),
    pictures: Sequence[Picture] = (),
    wide_pictures: Sequence[Picture] = (),
) -> None:
    """Write a self-contained report in one file, without external links, in the system's light or dark theme.

    Floats in the summary and in tables have three decimals; NaN is a dash.

    Args:
        links: text and file name of links to files beside the report.
        galleries: (heading, small pictures) of each gallery, arranged side by side.
        pictures: (caption, PNG or GIF file) of each picture; the files are embedded.
        wide_pictures: pictures that scroll horizontally on narrow screens instead of shrinking.
    """
    parts = [f"<h1>{_text(title)}</h1>"]
    if lead:
        parts.append(f"<p>{_text(lead)}</p>")
    parts += [f'<p><a href="{_text(file)}">{_text(text)}</a></p>' for text, file in links]
    parts.append(_table("Summary", ("", "value"), list(summary.items())))
    parts += [_table(*table) for table in tables]
    for heading, gallery in galleries:
        figures = "".join(_figure(*picture) for picture in gallery)
        parts.append(f'<h2>{_text(heading)}</h2><div class="gallery">{figures}</div>')
    parts += [_figure(*picture) for picture in pictures]
    parts += [_figure(*picture, wide=True) for picture in wide_pictures]
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(title)}</title><style>{_STYLE}</style></head><body><main>{''.join(parts)}</main></body></html>\n"
    )
    atomic_write(path, page)


def _text(value: Cell) -> str:
    if isinstance(value, float):
        return "–" if value != value else f"{value:.3f}"
    return html.escape(str(value).encode("utf-8", "replace").decode())  # paths may contain invalid UTF-8


def _figure(caption: str, file: str | Path, *, wide: bool = False) -> str:
    data = base64.b64encode(Path(file).read_bytes()).decode("ascii")
    kind = Path(file).suffix.removeprefix(".")
    image = f'<img alt="{_text(caption)}" src="data:image/{kind};base64,{data}">'
    if wide:
        image = f'<div class="wide">{image}</div>'
    return f"<figure>{image}<figcaption>{_text(caption)}</figcaption></figure>"


def _table(caption: str, header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    head = "".join(f'<th scope="col">{_text(h)}</th>' for h in header)
    body = "".join(
        f'<tr><th scope="row">{_text(name)}</th>' + "".join(f"<td>{_text(c)}</td>" for c in cells) + "</tr>"
        for name, *cells in rows
    )
    return (
        f'<div class="scroll"><table><caption>{_text(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )

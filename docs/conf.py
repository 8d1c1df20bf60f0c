"""The documentation site: ``sphinx-build -W --keep-going docs docs/_build``."""

import dataclasses
import json
import re
import typing
from importlib.metadata import version as installed
from os.path import relpath
from pathlib import Path

import sphinx.pycode.parser
from sphinx.application import Sphinx

typing.GENERATING_DOCUMENTATION = True  # jaxtyping then names arrays without the modules that define them

_ROOT = Path(__file__).resolve().parents[1]
_PAGES = {  # Documents of the repository that are pages of the site, by ``part`` below.
    "CONTRIBUTING.md": "contributing.md",
    "experiments/LOG.md": "log.md",
    "experiments/README.md": "evidence.md",
    "fcos_lidar_jax/weights/hdl32e/README.md": "model_card.md",
}

project = "fcos_lidar_jax"
author = copyright = "the fcos_lidar_jax developers"
version = release = installed("fcos-lidar-jax")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
source_suffix = {".md": "markdown", ".ipynb": "markdown"}
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = "FCOS-LiDAR in JAX"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
pygments_style = "friendly"
copybutton_exclude = ".linenos, .gp, .go"

myst_heading_anchors = 3

# The source of what a module takes from elsewhere, built-in types too, is that of the module.
viewcode_follow_imported_members = False
add_module_names = False
napoleon_use_ivar = True
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True}
# Fields and constants are described by plain comments behind them.
sphinx.pycode.parser.comment_re = re.compile(r"^\s*#:? ?(.*)\r?\n?$")

# Names of the package must be links; names of other packages are text.
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(?!fcos_lidar_jax).*"),
    # What is no part of the reference, and is read in its source.
    (
        r"py:.*",
        r"fcos_lidar_jax\.(inference\.(export|openvino|stream)|evaluation\.metrics|input_pipeline\.database"
        r"|data\.(sweeps|nuscenes\.index)|devices\.mesh|collectives\._Tree).*",
    ),
]


def setup(app: Sphinx) -> None:
    """What the extensions do not do by themselves."""
    app.connect("source-read", _with_parts)
    app.connect("autodoc-process-signature", _short_signature)
    app.connect("autodoc-process-docstring", _whole_comment, priority=400)  # before napoleon's


def _short_signature(app, what, name, obj, options, signature, returned):
    """Arrays without the module that defines them; no signature of dataclasses, whose fields are listed."""
    if what not in ("function", "method"):
        return ("", None) if what == "class" and dataclasses.is_dataclass(obj) else None
    return _short_arrays(signature or ""), _short_arrays(returned or "") or None


def _short_arrays(text: str) -> str:
    return re.sub(r"(\w+)\[Array, ('[^']*')\] \| \1\[ndarray, \2\]", r"\1[Array | ndarray, \2]", text)


def _whole_comment(app, what, name, obj, options, lines):
    """A colon in the comment of a field is no end of a type, which napoleon takes it for in the first line."""
    if lines and lines[0].startswith("Alias for field number"):  # Python's text for fields of named tuples
        lines.clear()
    elif what in ("attribute", "data", "property"):
        lines.insert(0, "\\")


def _with_parts(app, docname, source):
    """Notebooks as Markdown; the repository's other documents in place of ``<!-- part: FILE: HEADING -->``."""
    if Path(app.env.doc2path(docname)).suffix == ".ipynb":
        source[0] = "\n\n".join(map(_cell, json.loads(source[0])["cells"]))
    for name, page in _PAGES.items():
        source[0] = source[0].replace(f"](../{name}", f"]({page}")
    source[0] = re.sub(r"<!-- part: (\S+): (.+) -->", lambda found: _part(found[1], found[2]), source[0])


def _cell(cell: dict) -> str:
    """A cell of a notebook; outputs are not stored."""
    text = "".join(cell["source"])
    return text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```"


def _part(name: str, heading: str) -> str:
    """What follows a heading of a document, up to the next of its kind, with links as they are from here."""
    file = _ROOT / name
    mark, text = heading.split()[0], file.read_text(encoding="utf-8")
    if f"\n{heading}\n" not in f"\n{text}":
        raise ValueError(f"{name}: no heading {heading!r}, which a page of the site includes")
    after = f"\n{text}".split(f"\n{heading}\n")[1].split(f"\n{mark} ")[0]
    return re.sub(r"(!?)\[([^\]]+)\]\(([^):]+)\)", lambda link: _link(file, *link.groups()), after)


def _link(file: Path, image: str, text: str, target: str) -> str:
    """Pages and data are linked, other documents and folders are named, for the site does not have them."""
    name, mark, place = target.partition("#")
    path = (file.parent / name).resolve() if name else file
    if page := _PAGES.get(path.relative_to(_ROOT).as_posix()):
        return f"{image}[{text}]({page}{mark}{place})"
    if path.is_dir() or (path.suffix == ".md" and not path.is_relative_to(_ROOT / "docs")):
        return f"{text} (`{path.relative_to(_ROOT)}`)"
    return f"{image}[{text}]({relpath(path, _ROOT / 'docs')}{mark}{place})"

"""The documents do what they say: code runs, commands exist."""

import builtins
import dataclasses
import doctest
import importlib
import importlib.util
import inspect
import json
import pkgutil
import re
import shlex
import symtable
import sys
from pathlib import Path

import numpy as np
import pytest

import fcos_lidar_jax
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli import demo
from fcos_lidar_jax.cli.commands import parse
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.evaluation.kitti_results import kitti_types
from fcos_lidar_jax.input_pipeline.open import READERS
from fcos_lidar_jax.models import Detector
from fcos_lidar_jax.presets import PRESETS
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, SHORT_RANGE, Sensor
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.simulation.nuscenes_tables import CHANNEL
from fcos_lidar_jax.training import Schedule
from fcos_lidar_jax.types import Batch

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "experiments" / "README.md",
    ROOT / "experiments" / "LOG.md",
    *sorted(DOCS.glob("*.md")),
]
RUN_ELSEWHERE = {  # pages that have a test of their own, which goes on from what they make
    "own_data.md": "cli/test_own_data.py",
    "export.md": "inference/test_export.py",
    "own_loop.md": "training/test_own_loop.py",
}
CORE = (
    *("sensors", "types", "config", "presets", "geometry", "projection", "locations"),
    *("coding", "iou", "assignment", "losses", "nms", "augment"),
)


def page_name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page that are no fragments, in their order."""
    found = re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    return [block for block in found if block.strip()]


def referred() -> dict[str, object]:
    """Functions and classes of the reference, by their full names."""
    listed: dict[str, object] = {}
    for page in (DOCS / "api").glob("*.md"):
        for kind, name in re.findall(
            r"^\.\. auto(module|class|function):: (\S+)$", page.read_text(), re.MULTILINE
        ):
            if kind == "module":
                listed |= public(importlib.import_module(name))
            else:
                module, _, attribute = name.rpartition(".")
                listed[name] = getattr(importlib.import_module(module), attribute)
    return listed


def public(module) -> dict[str, object]:
    """What a module offers: what it says, or the functions and classes that it defines."""
    own = [
        n
        for n, v in vars(module).items()
        if not n.startswith("_") and getattr(v, "__module__", "") == module.__name__
    ]
    members = {name: getattr(module, name) for name in getattr(module, "__all__", own)}
    return {
        f"{module.__name__}.{n}": v
        for n, v in members.items()
        if inspect.isclass(v) or inspect.isfunction(inspect.unwrap(v))
    }


@pytest.mark.parametrize("kind", [Frame, Batch, Detector, Schedule])
def test_help_describes_the_fields(kind):
    _, _, section = (inspect.getdoc(kind) or "").partition("Attributes:\n")
    described = re.findall(r"^    (\w+): ", section, re.MULTILINE)
    assert described == list(inspect.signature(kind).parameters)


def belongs_to(module, value) -> bool:
    return not inspect.ismodule(value) and getattr(value, "__module__", module.__name__) == module.__name__


def test_examples_use_the_imports_of_the_reference():
    exec(blocks(DOCS / "api" / "index.md", "python")[0], given := {})
    missing = {}
    for name, value in referred().items():
        module = sys.modules[value.__module__]
        own = {other.rpartition(".")[2] for other in referred() if other.startswith(f"{name.rpartition('.')[0]}.")}
        own |= {n for n, v in vars(module).items() if belongs_to(module, v)}
        for example in doctest.DocTestFinder(recurse=False).find(value, name, module=module):
            scopes = [symtable.symtable("".join(step.source for step in example.examples), name, "exec")]
            for scope in scopes:
                scopes += scope.get_children()
            symbols = [symbol for scope in scopes for symbol in scope.get_symbols()]
            made = {s.get_name() for s in symbols if s.is_assigned() or s.is_imported() or s.is_parameter()}
            used = {s.get_name() for s in symbols if s.is_referenced()}
            if rest := used - made - own - given.keys() - set(dir(builtins)):
                missing[name] = rest
    assert missing == {}


def test_the_reference_holds_the_core_and_whatever_a_package_exports():
    packages = [m.name for m in pkgutil.walk_packages(fcos_lidar_jax.__path__, "fcos_lidar_jax.") if m.ispkg]
    modules = [m for m in map(importlib.import_module, packages) if hasattr(m, "__all__")]
    modules += [importlib.import_module(f"fcos_lidar_jax.{name}") for name in CORE]
    offered = {value for module in (fcos_lidar_jax, *modules) for value in public(module).values()}
    assert {value.__qualname__ for value in offered - set(referred().values())} == set()


def make_drive(folder: Path) -> None:
    """A folder of clouds of the quickstart's sensor, and their poses."""
    (folder / "drive").mkdir()
    frames, poses = SimulatedFrames(SHORT_RANGE, 2), []
    for index in range(len(frames)):
        np.save(folder / "drive" / f"{index}.npy", frames.frame(index).points)
        pose = {"timestamp_us": index * 100_000, "sensor_to_world": np.eye(4).tolist()}
        poses.append({"file": f"drive/{index}.npy", **pose})
    (folder / "poses.json").write_text(json.dumps(poses))


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python")], ids=page_name)
def test_the_python_of_a_page_runs(page, tmp_path, monkeypatch):
    if page.name in RUN_ELSEWHERE:
        assert page.name in (Path(__file__).parent / RUN_ELSEWHERE[page.name]).read_text()
        return
    monkeypatch.chdir(tmp_path)
    if page.name == "stream.md":
        make_drive(tmp_path)
    if page.name == "README.md":
        (folder := demo.Demo().out / "drive" / "samples" / CHANNEL).mkdir(parents=True)
        make_frame(0, NUSCENES_HDL32E).points.tofile(folder / "a.pcd.bin")
    namespace: dict = {}
    for block in blocks(page, "python"):
        exec(compile(block, page.name, "exec"), namespace)


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "bash")], ids=page_name)
def test_the_commands_of_a_page_exist(page):
    for line in "\n".join(blocks(page, "bash")).replace("\\\n", " ").splitlines():
        for words in re.findall(r"\bfcos-lidar (.*?)(?:&&|$)", line):
            parse(shlex.split(words))
        for module in re.findall(r"python -m ([\w.]+)", line):
            assert importlib.util.find_spec(module), line


def test_the_profile_of_the_paper_s_training_starts_and_stops_once(monkeypatch):
    calls: list[str] = []
    for name in ("start_trace", "stop_trace"):
        monkeypatch.setattr(f"jax.profiler.{name}", lambda *_, name=name: calls.append(name))
    exec(blocks(DOCS / "paper_training.md", "python")[0], given := {})
    for step in range(1, 201):
        given["profile"](step, {"loss/total": 1.0})
        if step % 10 == 0:  # hooks are called after an evaluation again
            given["profile"](step, {"test/mAP": 0.1})
    assert calls == ["start_trace", "stop_trace"]


def test_the_notebook_imports_what_exists():
    """``.ci/notebook`` runs it."""
    cells = json.loads((DOCS / "tutorial.ipynb").read_text())["cells"]
    lines = "".join("".join(cell["source"]) + "\n" for cell in cells if cell["cell_type"] == "code").splitlines()
    imports = [line for line in lines if line.startswith("from fcos_lidar_jax")]
    assert len(imports) > 5
    exec("\n".join(imports), {})


def test_json_of_the_pages_parses():
    for page in PAGES:
        for block in blocks(page, "json"):
            json.loads(block)


def test_the_page_names_every_field_of_a_sensor_file():
    text = (DOCS / "own_data.md").read_text()
    assert [f.name for f in dataclasses.fields(Sensor) if not re.search(rf"[`\"]{f.name}[`\"]", text)] == []


def test_the_page_has_every_preset():
    rows = re.findall(
        r"^\| (`.*?) \|", (DOCS / "commands.md").read_text().partition("## Presets")[2], re.MULTILINE
    )
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == set(PRESETS)


def test_the_page_has_the_class_maps_and_the_types_of_result_files():
    maps = {(reader.name, name): names for reader in READERS for name, names in reader.class_maps.items()}
    types = kitti_types(maps["kitti", "nuscenes"]) | kitti_types()
    assert maps.keys() == {
        ("kitti", "nuscenes"),
        ("argoverse2", "nuscenes"),
        ("nuscenes", "kitti"),
        ("simulated", "kitti"),
    }

    def cell(names):
        return ", ".join(f"`{name}`" for name in names if name) or "-"

    def row(name):
        sources = [
            [old for old, new in maps[data, "nuscenes"].items() if new == name] for data in ("kitti", "argoverse2")
        ]
        return [cell(names) for names in (*sources, [maps["nuscenes", "kitti"].get(name)], [types.get(name)])]

    rows = [[f"`{name}`", *row(name)] for name in NUSCENES_CLASSES] + [["left out", *row(None)[:2], "", ""]]
    text = (DOCS / "commands.md").read_text().partition("### Class maps")[2]
    table = [line for line in text.splitlines() if line.startswith("|") and line.count("|") == 6]
    assert [[each.strip() for each in line.split("|")[1:-1]] for line in table[2:]] == rows


def test_blocks_of_code_are_run_or_marked():
    known = {"python", "bash", "json", "{code-block} python", "{toctree}"}
    for page in PAGES:
        openings = re.findall(r"^```(.*)$", page.read_text(), re.MULTILINE)[::2]
        assert set(openings) <= known, page.name
        directives = re.findall(r"^```\{code-block\} python\n(.*)$", page.read_text(), re.MULTILINE)
        assert all(":class: fragment" in line for line in directives), page.name


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_and_files_that_a_page_names_exist(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        file, _, place = link.partition("#")
        if not re.match(r"\w+:", link):
            target = page.parent / file if file else page
            assert target.exists(), link
            assert not place or page.parent == DOCS or place in places(target), link
    files = [
        file.as_posix()
        for folder in ("fcos_lidar_jax", "experiments", "tests")
        for file in (ROOT / folder).rglob("*.py")
    ]
    for name in re.findall(r"`((?:\w+/)*\w+\.py)`", text):
        assert "NAME" in name or any(file.endswith(f"/{name}") for file in files), name
    tests = "".join(Path(file).read_text() for file in files if "/tests/" in file)
    for name in re.findall(r"`(test_\w+)`", text):
        assert f"def {name}(" in tests, name


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=page_name)
def test_a_page_of_the_site_links_to_documents_that_the_site_has(page):
    included = re.findall(r'^    "(\S+\.md)": "', (DOCS / "conf.py").read_text(), re.MULTILINE)
    assert "CONTRIBUTING.md" in included
    for link in re.findall(r"\]\(\.\./([^)#\s]+)", page.read_text()):
        assert link in included or ((ROOT / link).is_file() and not link.endswith(".md")), link


def places(page: Path) -> set[str]:
    """What links to a document can name, as on GitHub: its headings in small letters, with hyphens for spaces."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_check_runs_the_readme_s_test_command():
    (tests,) = [line for line in "\n".join(blocks(ROOT / "README.md", "bash")).splitlines() if "pytest" in line]
    assert tests.split(" && ")[-1] in (ROOT / ".ci" / "run").read_text().splitlines()

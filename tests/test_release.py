"""What is no code of the package: version, scripts of the checks, workflows."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.version import Version

from fcos_lidar_jax import __version__

ROOT = Path(__file__).parents[1]
SCRIPTS = ROOT / ".ci"


def test_changelog_and_citation_have_the_released_version_and_its_date():
    """The package has a newer version as soon as there are unreleased changes."""
    sections = re.findall(r"^## (\S+)(?: - (\S+))?$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    version, date = next((version, date) for version, date in sections if version != "Unreleased")
    citation = (ROOT / "CITATION.cff").read_text()
    is_newer = Version(__version__) > Version(version)
    assert is_newer if sections[0][0] == "Unreleased" else version == __version__
    assert f"\nversion: {version}\n" in citation
    assert f"\ndate-released: {date}\n" in citation


def test_workflows_only_call_the_scripts_and_all_of_them():
    text = "".join(file.read_text() for file in (ROOT / ".github" / "workflows").glob("*.yml"))
    commands = re.findall(r"\brun: *(.*)", text)
    assert commands
    assert all(re.fullmatch(r"bash \.ci/(\w+|\$\{\{ matrix\.check \}\})", command) for command in commands)
    called = {name for names in re.findall(r"check: \[(.*)\]", text) for name in names.split(", ")}
    called |= {command.rpartition("/")[2] for command in commands if "matrix" not in command}
    assert called == {"run", "lowest", "newest", "wheel", "gpu", "site", "notebook"}
    assert all((SCRIPTS / name).is_file() for name in called)


@pytest.mark.parametrize(
    ("place", "found"),
    [
        *(("data", True), ("shared/data", True)),
        *(("holdout", False), ("shared/holdout", False), ("far/shared/data", False)),
    ],
)
def test_real_data_are_found_beside_the_repository_but_not_held_out_or_far_away(place, found, tmp_path):
    data, scripts = tmp_path / "work" / place, tmp_path / "work" / "main" / ".ci"
    (data / "nuscenes_scene0523").mkdir(parents=True)
    scripts.mkdir(parents=True)
    script = shutil.copy(SCRIPTS / "real_data", scripts)
    printed = subprocess.run(["bash", script], capture_output=True, text=True, check=True).stdout
    assert printed.strip() == (str(data) if found else "")


def followed(site: Path) -> subprocess.CompletedProcess:
    command = [sys.executable, SCRIPTS / "follow_links.py", site]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_links_inside_the_site_are_followed(tmp_path):
    assert followed(tmp_path).returncode == 1  # no pages
    (tmp_path / "api").mkdir()
    (tmp_path / "index.html").write_text(
        '<h1 id="one"></h1><a href="#one"></a><a href="api/core.html#iou%20of"></a><img src="a.png">'
        '<a href="https://example.org/nothing"></a><a href="mailto:a@example.org"></a>'
    )
    (tmp_path / "api" / "core.html").write_text('<p id="iou of"></p><a href="../index.html?q=1#one"></a>')
    (tmp_path / "a.png").touch()
    run = followed(tmp_path)
    assert (run.returncode, run.stdout) == (0, f"{tmp_path.name}: 2 pages, 4 links inside, 0 broken\n")


def test_links_that_lead_nowhere_are_named(tmp_path):
    links = ["gone.html", "index.html#two", "#two", "../outside.html", "gone.png"]
    (tmp_path / "site").mkdir()
    (tmp_path / "outside.html").touch()
    (tmp_path / "site" / "index.html").write_text("".join(f'<a href="{link}"></a>' for link in links))
    run = followed(tmp_path / "site")
    assert run.returncode == 1
    assert run.stdout.splitlines()[:5] == sorted(f"index.html: {link}: leads nowhere" for link in links)

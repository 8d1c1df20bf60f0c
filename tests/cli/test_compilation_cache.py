"""The cache of compiled programs: made for commands only, refused where others can write, damage is repaired."""

import json
import os
import types
from pathlib import Path

import numpy as np
import pytest
from commands import run_python

from fcos_lidar_jax.cli import compilation_cache
from fcos_lidar_jax.cli.compilation_cache import use_compilation_cache

PROJECT = """
import collections, json, os, sys
from pathlib import Path
del os.environ["JAX_COMPILATION_CACHE_DIR"]
import jax
from fcos_lidar_jax.cli import main
assert jax.config.jax_compilation_cache_dir is None
events = collections.Counter()
jax.monitoring.register_event_listener(lambda name, **_: events.update([name.rpartition("/")[2]]))
home, cloud = map(Path, sys.argv[1:])
results = []
def project():
    jax.clear_caches()
    before = events.copy()
    assert main(["project", str(cloud), "--out", str(cloud.with_suffix(".npz")), "--sensor", "tiny"]) == 0
    results.append(cloud.with_suffix(".npz").read_bytes())
    return dict(events - before)
counts = [project(), project()]
for file in home.glob("*/*/*-cache"):
    file.write_bytes(file.read_bytes()[:-9])
counts += [project(), project()]
assert len(set(results)) == 1
print(json.dumps(counts))
"""


def test_commands_keep_their_programs_and_replace_damaged_ones(tmp_path):
    np.save(tmp_path / "a.npy", np.full((9, 4), [9.0, 0, -0.5, 1]))
    home = tmp_path / "cache"
    every = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", "XDG_CACHE_HOME": str(home)}
    done = run_python("-c", PROJECT, home, tmp_path / "a.npy", **every)
    assert done.returncode == 0, done.stderr
    counts = [
        (each.get("cache_hits", 0), each.get("cache_misses", 0))
        for each in json.loads(done.stdout.split("\n")[-2])
    ]
    number = counts[0][1]
    assert number > 0
    assert counts[0::2] == [(0, number)] * 2
    assert counts[1::2] == [(number, 0)] * 2
    told = [line for line in done.stderr.splitlines() if "cache" in line.lower()]
    assert told == [
        f"compiled programs are kept in {home}/fcos_lidar_jax, so that later commands start faster; "
        "JAX_ENABLE_COMPILATION_CACHE=false turns this off"
    ]
    for folder in (home / "fcos_lidar_jax", *(home / "fcos_lidar_jax").iterdir()):
        assert folder.stat().st_mode & 0o777 == 0o700


@pytest.fixture
def settings(tmp_path, monkeypatch):
    """JAX's settings, as a dictionary; other tests of this process keep their cache."""
    values = {"jax_compilation_cache_dir": None, "jax_enable_compilation_cache": True}

    class Config:
        update = values.__setitem__
        __getattr__ = values.__getitem__

    monkeypatch.setattr(compilation_cache, "jax", types.SimpleNamespace(config=Config(), __version__="0.0"))
    monkeypatch.setattr(compilation_cache, "_remove_damaged", lambda _: None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return values


def writable_by_others(home, monkeypatch):
    (home / "fcos_lidar_jax").mkdir()
    (home / "fcos_lidar_jax").chmod(0o770)


def of_another_user(home, monkeypatch):
    (home / "fcos_lidar_jax").mkdir(mode=0o700)
    monkeypatch.setattr("os.geteuid", lambda: os.getuid() + 1)


def not_a_folder(home, monkeypatch):
    (home / "fcos_lidar_jax").touch()


def without_home(home, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # to be ignored
    monkeypatch.setattr(Path, "home", lambda: Path("~nobody-of-this-name").expanduser())


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (writable_by_others, "/fcos_lidar_jax: belongs to another user, or others can write to it;"),
        (of_another_user, "/fcos_lidar_jax: belongs to another user, or others can write to it;"),
        (not_a_folder, "File exists: "),
        (without_home, "Could not determine home directory.;"),
    ],
)
def test_a_folder_that_cannot_be_used_is_one_line(tmp_path, settings, monkeypatch, capsys, prepare, message):
    prepare(tmp_path, monkeypatch)
    before = dict(settings)
    use_compilation_cache()
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("note: no compilation cache: ")
    assert message in line
    assert settings == before


@pytest.mark.parametrize(
    "given",
    [{"jax_compilation_cache_dir": "/own"}, {"jax_enable_compilation_cache": False}],
    ids=["folder", "off"],
)
def test_the_settings_of_jax_come_first(tmp_path, settings, given):
    settings |= given
    before = dict(settings)
    use_compilation_cache()
    assert settings == before
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("_processor", lambda: "other"),
        ("_cores", lambda: 77),
        ("jaxlib", types.SimpleNamespace(__version__="0.1")),
    ],
)
def test_another_version_processor_or_number_of_cores_has_its_own_folder(settings, monkeypatch, name, value):
    use_compilation_cache()
    usual = settings["jax_compilation_cache_dir"]
    settings["jax_compilation_cache_dir"] = None
    monkeypatch.setattr(compilation_cache, name, value)
    use_compilation_cache()
    assert settings["jax_compilation_cache_dir"] not in (None, usual)


def test_the_programs_that_were_used_last_are_kept(tmp_path, settings, monkeypatch):
    monkeypatch.setattr(compilation_cache, "_MAX_BYTES", 25)
    old = tmp_path / "fcos_lidar_jax" / "jax-0.1"
    old.mkdir(parents=True)
    for name, used_s in (("a", 30), ("b", 10), ("c", 20)):
        (old / f"{name}-cache").write_bytes(bytes(10))
        os.utime(old / f"{name}-cache", (used_s, used_s))
    use_compilation_cache()
    assert sorted(file.name for file in old.iterdir()) == ["a-cache", "c-cache"]

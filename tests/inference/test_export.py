"""Exported detectors are bit-identical to their checkpoint, deterministic, and free of paths of this machine."""

import hashlib
import json
import re
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import assert_one_line_error, command, run_python
from tiny_run import TINY_REFINED as TINY_CONFIG
from tiny_run import bits, untrained

import fcos_lidar_jax as fcos
from fcos_lidar_jax.checkpoints import Checkpoint, save_checkpoint
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.inference.export import PLATFORMS, export_detector, load_exported
from fcos_lidar_jax.sensors import TINY, sensor_from_json
from fcos_lidar_jax.simulation.frames import make_frame

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
VARIABLES = untrained(TINY_CONFIG, TINY)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Folder of a checkpoint, an exported detector, and a cloud with points that must be ignored."""
    folder = tmp_path_factory.mktemp("export")
    save_checkpoint(folder / "checkpoint", Checkpoint(TINY_CONFIG, TINY, VARIABLES, 7))
    command("export --checkpoint", folder / "checkpoint", "--out", folder / "detector.fcos")
    points = make_frame(3, TINY).points
    points[5:8, :2] = TINY.origin_m[:2]  # on the ego vehicle
    points[11, 1], points[12, 3] = np.nan, 1e30
    np.save(folder / "cloud.npy", points)
    return folder


@pytest.mark.optimised
def test_boxes_are_bit_identical_to_the_checkpoint(home):
    trained, exported = (fcos.load_detector(home / name) for name in ("checkpoint", "detector.fcos"))
    clouds = [*(make_frame(seed, TINY).points for seed in range(3)), np.load(home / "cloud.npy")]
    for points in clouds:
        cloud = make_cloud(points, TINY_CONFIG, sensor=TINY)
        found = exported.detect(cloud)
        assert found.valid.any()
        assert bits(found) == bits(trained.detect(cloud))
        assert exported(points).to_dict() == trained(points).to_dict()
    assert exported.classes == trained.classes
    assert exported.sensor == trained.sensor


@pytest.mark.optimised
def test_detect_accepts_an_exported_detector_with_its_batch_size(home, tmp_path, capsys):
    for name in ("checkpoint", "detector.fcos"):
        command("detect", home / "cloud.npy", "--checkpoint", home / name, "--out", tmp_path / f"{name}.json")
    assert (tmp_path / "checkpoint.json").read_bytes() == (tmp_path / "detector.fcos.json").read_bytes()
    words = ["detect", str(home / "cloud.npy"), "--checkpoint", str(home / "detector.fcos"), "--batch-size", "2"]
    assert_one_line_error(capsys, [*words, "--out", str(tmp_path / "a")], r"batch size: got 2, expected 1")


@pytest.mark.optimised
def test_the_program_cleans_raw_clouds(home):
    trained, points = fcos.load_detector(home / "checkpoint"), np.load(home / "cloud.npy")
    exported = load_exported(home / "detector.fcos").exported
    padded = np.full((1, TINY_CONFIG.max_points, 5), np.nan, np.float32)
    padded[0, : len(points)] = points
    valid = np.arange(TINY_CONFIG.max_points)[None] < len(points)
    program = jax.jit(exported.call)
    found = program(padded, valid, True)
    expected = trained.detect(make_cloud(points, TINY_CONFIG, sensor=TINY))
    assert {name: bits(leaf[0]) for name, leaf in found.items()} == {
        name: bits(getattr(expected, name)) for name in found
    }
    kept = program(padded, valid, False)
    assert bits(kept) != bits(found)
    close = (np.abs(points[:, :2] - TINY.origin_m[:2]) < TINY_CONFIG.projection.close_m).all(axis=1)
    points[close] += np.float32(1000)  # beyond the limits, and therefore dropped
    padded[0, : len(points)] = points
    assert bits(program(padded, valid, False)["boxes"]) == bits(found["boxes"])


def test_an_export_for_any_number_of_points_and_clouds(home, tmp_path, capsys):
    out = tmp_path / "any.fcos"
    command("export --points any --batch any --checkpoint", home / "checkpoint", "--out", out)
    printed = json.loads(capsys.readouterr().out)
    assert (printed["num_points"], printed["batch"], printed["bytes"]) == ("any", "any", out.stat().st_size)
    trained, exported = fcos.load_detector(home / "checkpoint"), load_exported(out)
    clouds = [make_frame(seed, TINY).points for seed in range(2)]
    length = max(map(len, clouds)) + 3
    points = np.stack([np.pad(cloud, ((0, length - len(cloud)), (0, 0))) for cloud in clouds])
    valid = np.stack([np.arange(length) < len(cloud) for cloud in clouds])
    found = jax.jit(exported.exported.call)(points, valid, True)
    for scores, cloud in zip(found["scores"], clouds, strict=True):
        expected = trained(cloud).scores
        np.testing.assert_allclose(scores[: len(expected)], expected, atol=1e-4)
        assert not scores[len(expected) :].any()


def test_exports_are_deterministic_and_contain_no_path_of_this_machine(home):
    content = (home / "detector.fcos").read_bytes()
    jax.clear_caches()
    assert export_detector(fcos.load_detector(home / "checkpoint")) == content  # type: ignore[arg-type]
    for trace in (str(ROOT), str(home), sys.prefix, str(Path.home()), ".py", "site-packages"):
        assert trace.encode() not in content, trace


def test_the_record_describes_the_detector(home):
    first, line, program = (home / "detector.fcos").read_bytes().split(b"\n", 2)
    record = json.loads(line)
    assert record == load_exported(home / "detector.fcos").record
    assert record["classes"] == list(TINY_CONFIG.classes)
    assert sensor_from_json(record["sensor"], "") == TINY
    assert record["platforms"] == list(PLATFORMS) == ["cpu", "cuda", "rocm", "tpu"]
    assert f"jax {jax.__version__}" in record["written_by"]
    weights = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(VARIABLES))
    assert record["weights"]["blake2b"] == hashlib.blake2b(weights, digest_size=16).hexdigest()
    assert record["program"] == {
        "bytes": len(program),
        "blake2b": hashlib.blake2b(program, digest_size=16).hexdigest(),
    }
    content = hashlib.blake2b(line + b"\n" + program, digest_size=16).hexdigest()
    assert first.decode() == f"fcos-lidar-detector 1 {content}"


def test_a_file_of_an_older_version_is_read(home, tmp_path):
    _, line, program = (home / "detector.fcos").read_bytes().split(b"\n", 2)
    record = json.loads(line)
    later = ("model", "regression_axes"), ("model", "remat"), ("loss", "quality"), ("inference", "flips")
    for section, name in later:
        del record["config"][section][name]
    content = json.dumps(record).encode() + b"\n" + program
    first = f"fcos-lidar-detector 1 {hashlib.blake2b(content, digest_size=16).hexdigest()}\n".encode()
    (tmp_path / "older.fcos").write_bytes(first + content)
    assert load_exported(tmp_path / "older.fcos").config == load_exported(home / "detector.fcos").config


@pytest.mark.optimised
def test_the_documented_code_runs_without_this_package(home):
    code, _ = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "export.md").read_text(), re.DOTALL)
    hide = "import os, sys; sys.modules['fcos_lidar_jax'] = sys.modules['flax'] = None"
    (home / "run.py").write_text(f"{hide}\nos.chdir({str(home)!r})\n{code}")
    ran = run_python(home / "run.py")
    assert ran.returncode == 0, ran.stderr
    found = fcos.load_detector(home / "checkpoint")(home / "cloud.npy")
    lines = [line for line in ran.stdout.splitlines() if line[:1].isalpha()]
    assert [line.split()[0] for line in lines] == found.names.tolist()
    assert [np.float32(line.split()[1]) for line in lines] == list(found.scores)


DAMAGE = {
    "foreign": (lambda content: b"PK\x03\x04" + content, "found a file, expected a checkpoint folder or a file"),
    "other format": (
        lambda content: content.replace(b"r 1", b"r 2", 1),
        "format: got '2', expected 1",
    ),
    "other checksum": (lambda content: content[:30] + b"f" * 4 + content[34:], "checksum .*: damaged"),
    "record": (lambda content: content.replace(b'"car"', b'"cat"', 1), "checksum .*: damaged"),
    "program": (lambda content: content[:-9] + bytes([content[-9] ^ 1]) + content[-8:], "checksum .*: damaged"),
    "cut": (lambda content: content[:-100], "checksum .*: damaged"),
    "empty": (lambda content: b"", "found a file, expected a checkpoint folder or a file"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_corrupt_files_are_reported_in_one_line(home, tmp_path, capsys, name):
    damage, message = DAMAGE[name]
    (tmp_path / "bad.fcos").write_bytes(damage((home / "detector.fcos").read_bytes()))
    words = ["detect", str(home / "cloud.npy"), "--checkpoint", str(tmp_path / "bad.fcos")]
    assert_one_line_error(capsys, [*words, "--out", str(tmp_path / "a.json")], f"bad.fcos: {message}")


@pytest.mark.parametrize(
    "command_line", ["detect HOME/cloud.npy", "stream HOME/cloud.npy", "benchmark HOME/cloud.npy"]
)
def test_no_command_overwrites_its_detector(home, capsys, command_line):
    content = (home / "detector.fcos").read_bytes()
    words = command_line.replace("HOME", str(home)).split()
    detector = str(home / "detector.fcos")
    message = "--out: .* inside of the checkpoint, expected a path elsewhere"
    assert_one_line_error(capsys, [*words, "--checkpoint", detector, "--out", detector], message)
    assert (home / "detector.fcos").read_bytes() == content


WRONG = {
    "--points 0": "points: got 0, expected at least 1, or any",
    "--batch 0": "batch: got 0, expected at least 1, or any",
    "--out HOME/checkpoint/a": "--out: .* inside of the checkpoint, expected a path elsewhere",
    "--out HOME": "found a folder",
    "--checkpoint HOME/detector.fcos": "found a file, expected a checkpoint folder",
}


@pytest.mark.parametrize("options", WRONG)
def test_invalid_options_are_reported_in_one_line(home, tmp_path, capsys, options):
    line = f"export {options}"
    line += "" if "--checkpoint " in line else " --checkpoint HOME/checkpoint"
    line += "" if "--out" in line else f" --out {tmp_path / 'a.fcos'}"
    assert_one_line_error(capsys, line.replace("HOME", str(home)).split(), WRONG[options])
    assert list(tmp_path.iterdir()) == []

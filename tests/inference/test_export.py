"""Exported detectors are bit-identical to their checkpoint, deterministic, and free of paths of this machine."""

import json
import re
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import command, run_python
from linear_network import linear_network
from refusal import refused
from tiny_run import REFINED as CONFIG
from tiny_run import SENSOR, bits, untrained

import fcos_lidar_jax as fcos
from fcos_lidar_jax.checkpoints import Checkpoint, save_checkpoint
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.inference.export import PLATFORMS, export_detector, load_exported
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.sensors import sensor_from_json
from fcos_lidar_jax.simulation.frames import make_frame

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
VARIABLES = untrained(CONFIG, SENSOR)
BAD_ROWS = [5, 6, 7, 11, 12]


def raw_cloud():
    """A cloud with points on the ego vehicle and unusable points, in ``BAD_ROWS``."""
    points = make_frame(3, SENSOR).points
    points[5:8, :2] = SENSOR.origin_m[:2]
    points[11, 1], points[12, 3] = np.nan, 1e30
    return points


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Folder of a checkpoint, an exported detector, and a raw cloud."""
    folder = tmp_path_factory.mktemp("export")
    save_checkpoint(folder / "checkpoint", Checkpoint(CONFIG, SENSOR, VARIABLES, 7))
    command("export --checkpoint", folder / "checkpoint", "--out", folder / "detector.fcos")
    np.save(folder / "cloud.npy", raw_cloud())
    return folder


@pytest.mark.optimised
def test_boxes_are_bit_identical_to_the_checkpoint(home):
    trained, exported = (fcos.load_detector(home / name) for name in ("checkpoint", "detector.fcos"))
    for points in (make_frame(0, SENSOR).points, raw_cloud()):
        cloud = make_cloud(points, CONFIG, sensor=SENSOR)
        found = exported.detect(cloud)
        assert found.valid.any()
        assert bits(found) == bits(trained.detect(cloud))
        assert exported(points).to_dict() == trained(points).to_dict()
    assert exported.classes == trained.classes
    assert exported.sensor == trained.sensor


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


def test_the_record_describes_the_detector(home):
    first, line, program = (home / "detector.fcos").read_bytes().split(b"\n", 2)
    record = json.loads(line)
    assert record == load_exported(home / "detector.fcos").record
    assert record["classes"] == list(CONFIG.classes)
    assert sensor_from_json(record["sensor"], "") == SENSOR
    assert record["platforms"] == list(PLATFORMS) == ["cpu", "cuda", "rocm", "tpu"]
    assert f"jax {jax.__version__}" in record["written_by"]
    weights = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(VARIABLES))
    assert record["weights"]["blake2b"] == checksum(weights)
    assert record["program"] == {"bytes": len(program), "blake2b": checksum(program)}
    assert first.decode() == "fcos-lidar-detector 1 " + checksum(line + b"\n" + program)


def test_a_file_of_an_older_version_is_read(home, tmp_path):
    _, line, program = (home / "detector.fcos").read_bytes().split(b"\n", 2)
    record = json.loads(line)
    for section, name in (("model", "regression_axes"), ("loss", "quality"), ("inference", "flips")):
        del record["config"][section][name]
    content = json.dumps(record).encode() + b"\n" + program
    (tmp_path / "older.fcos").write_bytes(f"fcos-lidar-detector 1 {checksum(content)}\n".encode() + content)
    assert load_exported(tmp_path / "older.fcos").config == load_exported(home / "detector.fcos").config


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: b"PK" + content, "found a file with b'PKfcos-lidar-detector ', expected a check"),
        (lambda content: content.replace(b"r 1", b"r 2", 1), "found a file with b'fcos-lidar-detector 2 '"),
        (lambda content: content.replace(b'"car"', b'"cat"', 1), ": damaged"),
        (lambda content: content[:-9] + bytes([content[-9] ^ 1]) + content[-8:], ": damaged"),
        (lambda content: content[:-100], ": damaged"),
        (lambda content: b"", "found a file with b'', expected a checkpoint folder or a file"),
    ],
    ids=["foreign", "other format", "record", "program", "cut", "empty"],
)
def test_damaged_files_are_refused(home, tmp_path, damage, message):
    (tmp_path / "bad.fcos").write_bytes(damage((home / "detector.fcos").read_bytes()))
    with refused("bad.fcos: ", message):
        load_exported(tmp_path / "bad.fcos")


@pytest.fixture(scope="module")
def linear(tmp_path_factory):
    """A detector with a network of one layer and a second look, and its export for any points and clouds."""
    folder = tmp_path_factory.mktemp("linear")
    with linear_network():
        detector = TrainedDetector(build_detector(CONFIG, SENSOR), untrained(CONFIG, SENSOR))
        save_checkpoint(folder / "checkpoint", Checkpoint(CONFIG, SENSOR, detector.variables, 7))
        line = "export --points any --batch any --checkpoint", folder / "checkpoint", "--out", folder / "any.fcos"
        command(*line)
    return detector, folder / "any.fcos"


@pytest.fixture(scope="module")
def program(linear):
    return jax.jit(load_exported(linear[1]).exported.call)


def padded(clouds):
    """Clouds f32[2, 1024, 5], and where they have points."""
    points, valid = np.zeros((2, 1024, 5), np.float32), np.zeros((2, 1024), bool)
    for row, cloud in enumerate(clouds):
        points[row, : len(cloud)], valid[row, : len(cloud)] = cloud, True
    return points, valid


def test_an_export_for_any_number_of_points_and_clouds(linear, program):
    record = load_exported(linear[1]).record
    assert (record["num_points"], record["batch"]) == ("any", "any")
    clouds = [make_frame(seed, SENSOR).points for seed in range(2)]
    for scores, cloud in zip(program(*padded(clouds), True)["scores"], clouds, strict=True):
        expected = linear[0](cloud).scores
        assert len(expected) > 0
        np.testing.assert_allclose(scores[: len(expected)], expected, atol=1e-4)
        assert not scores[len(expected) :].any()


def test_the_program_cleans_raw_clouds(program):
    points, valid = padded([raw_cloud(), make_frame(1, SENSOR).points])
    clean = valid.copy()
    clean[0, BAD_ROWS] = False
    found = program(points, valid, True)
    assert bits(found) == bits(program(points, clean, False))
    assert bits(found) != bits(program(points, valid, False))


def test_exports_are_deterministic_and_contain_no_path_of_this_machine(home, linear):
    detector, file = linear
    jax.clear_caches()
    assert export_detector(detector, num_points="any", batch="any") == file.read_bytes()
    for trace in (str(ROOT), str(home), sys.prefix, str(Path.home()), ".py", "site-packages"):
        assert trace.encode() not in (home / "detector.fcos").read_bytes(), trace


def test_sizes_must_be_positive(linear):
    for options, name in (({"num_points": 0}, "points"), ({"batch": 0}, "batch")):
        with refused(f"{name}: got 0, expected at least 1, or any"):
            export_detector(linear[0], **options)

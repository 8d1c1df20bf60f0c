"""Checkpoints survive a round trip bit-identical, and every kind of damage is reported in one line."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import cut
from tiny_run import CONFIG, SENSOR, bits

from fcos_lidar_jax.checkpoints import Checkpoint, CheckpointError, load_checkpoint, load_state, save_checkpoint
from fcos_lidar_jax.checkpoints.storage import NonFiniteStateError
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.training import make_optimizer, make_state


def random_like(tree, seed: int):
    """Random values of the dtype of each leaf."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jax.numpy.asarray(rng.normal(0, 9, leaf.shape), leaf.dtype), tree)


@pytest.fixture(scope="module")
def state():
    detector, optimizer = build_detector(CONFIG, SENSOR), make_optimizer(CONFIG.optimizer, 10)
    state = jax.eval_shape(lambda key: make_state(detector, optimizer, key), jax.random.key(0))
    key = jax.random.key(2**40 + 7)
    return dataclasses.replace(random_like(dataclasses.replace(state, key=None), 1), key=key)


@pytest.fixture(scope="module")
def checkpoint(state):
    variables = {"params": state.ema, "batch_stats": state.batch_stats}
    return Checkpoint(CONFIG, SENSOR, variables, 7, "some data", 0.25)


@pytest.fixture(scope="module")
def written(tmp_path_factory, checkpoint, state) -> Path:
    folder = tmp_path_factory.mktemp("written") / "c"
    save_checkpoint(folder, checkpoint, state=state)
    return folder


@pytest.fixture
def copy(written, tmp_path) -> Path:
    return shutil.copytree(written, tmp_path / "c")


def contents(folder: Path) -> dict[Path, bytes]:
    return {p: p.read_bytes() if p.is_file() else b"folder" for p in folder.rglob("*")}


def rewrite(file: Path, change) -> None:
    """Change a description and give it a matching hash."""
    description = json.loads(file.read_text())
    del description["hash"]
    change(description)
    hash_ = checksum(json.dumps(description, sort_keys=True).encode())
    file.write_text(json.dumps({**description, "hash": hash_}))


def test_a_round_trip_is_bit_identical(written, checkpoint, state):
    loaded = load_checkpoint(written)
    assert dataclasses.replace(loaded, variables={}) == dataclasses.replace(checkpoint, variables={})
    assert jax.tree.structure(loaded.variables) == jax.tree.structure(checkpoint.variables)
    assert bits(loaded.variables) == bits(checkpoint.variables)
    like = dataclasses.replace(random_like(dataclasses.replace(state, key=None), 2), key=jax.random.key(0))
    again = load_state(written, like)
    assert jax.tree.structure(again) == jax.tree.structure(state)
    assert [leaf.dtype for leaf in jax.tree.leaves(again)] == [leaf.dtype for leaf in jax.tree.leaves(state)]
    assert bits(again) == bits(state)
    assert bits(like) != bits(state)
    assert [p.name for p in written.parent.iterdir()] == ["c"]
    assert {p.name for p in written.iterdir()} == {"checkpoint.json", "variables", "state"}
    assert written.stat().st_mode & 0o777 == 0o755


def test_values_that_are_not_finite_are_never_saved(copy, checkpoint):
    before = contents(copy.parent)
    variables = jax.tree.map(np.array, checkpoint.variables)
    for leaf in jax.tree.leaves(variables["batch_stats"]):
        leaf.flat[0] = np.inf
    with pytest.raises(NonFiniteStateError, match=r"c: not saved: variables/batch_stats/.*: not finite"):
        save_checkpoint(copy, dataclasses.replace(checkpoint, variables=variables))
    assert contents(copy.parent) == before


def test_a_checkpoint_of_an_older_version_is_converted(copy, written):
    later = {
        "model": {"remat": False, "regression_axes": "lidar", "local_geometry": False, "round_offsets": False},
        "loss": {"quality": "iou", "centreness_m": 0.75},
        "inference": {"iou_exponent": 1.0, "merge_iou": None, "flips": "none", "nms_across_classes": False},
    }

    def make_older(description):
        config = description["config"]
        for section, fields in later.items():
            for name, value in fields.items():
                assert config[section].pop(name) == value
        config["model"]["meta_kernel"] = False

    rewrite(copy / "checkpoint.json", make_older)
    loaded, expected = load_checkpoint(copy), load_checkpoint(written)
    assert (loaded.config, loaded.sensor, loaded.step) == (expected.config, expected.sensor, expected.step)
    assert bits(loaded.variables) == bits(expected.variables)


def test_a_checkpoint_that_uses_a_removed_feature_is_refused(copy):
    rewrite(copy / "checkpoint.json", lambda description: description["config"]["model"].update(meta_kernel=True))
    with pytest.raises(ValueError, match=r"^.*checkpoint\.json: config\.model\.meta_kernel: unknown field.*$"):
        load_checkpoint(copy)


DAMAGES = {  # what happens to a file, and the message
    "cut": (lambda file: cut(file, -9), "got hash .*, expected hash"),
    "missing": (Path.unlink, "got no file, expected hash"),
    "additional": (
        lambda file: file.with_name(f"{file.name}.new").write_text("x"),
        "got hash .*, expected no file",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_named(copy, state, damage):
    change, message = DAMAGES[damage]
    largest = max((p for p in (copy / "state").rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    change(largest)
    for load in (load_checkpoint, lambda folder: load_state(folder, state)):
        with pytest.raises(CheckpointError, match=rf"^{re.escape(str(largest))}(\.new)?: damaged: {message}"):
            load(copy)


def test_corruption_of_any_file_is_detected(copy):
    for file in [file for file in copy.rglob("*") if file.is_file()]:
        content = file.read_bytes()
        file.write_bytes(content[1:] if content else b"x")
        with pytest.raises(CheckpointError, match=file.name):
            load_checkpoint(copy)
        file.write_bytes(content)
    assert load_checkpoint(copy).step == 7


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", r"checkpoint\.json: \$: got \[\], expected object"),
        ('{"format": 2}', r"checkpoint\.json: format: got 2, expected 3$"),
        ("", "not JSON"),
        (None, r"found a folder without checkpoint\.json, expected a checkpoint folder"),
    ],
)
def test_an_invalid_description_is_named(tmp_path, text, message):
    if text is not None:
        (tmp_path / "checkpoint.json").write_text(text)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(tmp_path)


def test_a_checkpoint_without_a_state_cannot_be_resumed(tmp_path, checkpoint, state):
    save_checkpoint(tmp_path / "c", checkpoint)
    assert load_checkpoint(tmp_path / "c").step == 7
    with pytest.raises(CheckpointError, match="found a detector without a training state"):
        load_state(tmp_path / "c", state)


def test_arrays_of_another_configuration_are_refused(tmp_path, written, checkpoint, state):
    wider = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, head_channels=16))
    message = (
        r"c: params/head.*: got \(.*8.*\), expected \(.*16.*\): the arrays do not belong to the configuration"
    )
    save_checkpoint(tmp_path / "c", dataclasses.replace(checkpoint, config=wider))
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(tmp_path / "c")
    with pytest.raises(CheckpointError, match=r"ema\..*: got \(.*\), expected nothing"):
        load_state(written, dataclasses.replace(state, ema=None))


def test_only_a_checkpoint_is_replaced(copy, checkpoint):
    """A run stands for its last checkpoint when it is read, but writing there would delete the run."""
    run = copy.parent / "run"
    (run / "checkpoints").mkdir(parents=True)
    (run / "notes.txt").write_text("mine")
    before = contents(copy.parent)
    for target, found in ((run, "a folder without checkpoint.json"), (run / "notes.txt", "a file")):
        with pytest.raises(
            CheckpointError, match=f"{target}: found {found}, expected a checkpoint to replace, or"
        ):
            save_checkpoint(target, checkpoint)
    assert contents(copy.parent) == before
    (copy.parent / "empty").mkdir()
    for free in (copy, copy.parent / "empty"):
        save_checkpoint(free, dataclasses.replace(checkpoint, step=9))
        assert load_checkpoint(free).step == 9


@pytest.fixture
def disk(tmp_path):
    """A file system of 8 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "t", str(folder)]
    if os.geteuid() or subprocess.run(mount, check=False, stderr=subprocess.DEVNULL).returncode:
        pytest.skip("no right to mount a small tmpfs")
    yield folder
    subprocess.run(["umount", folder], check=True)


@pytest.mark.slow
def test_a_full_disk_is_reported_in_one_line_and_keeps_the_old_checkpoint(disk, written, checkpoint, state):
    shutil.copytree(written, disk / "c")
    newer, filler, before = dataclasses.replace(checkpoint, step=8), disk / "filler", contents(disk)

    def leave(free_kib: int) -> None:
        filler.unlink(missing_ok=True)
        filler.write_bytes(b"\0" * (shutil.disk_usage(disk).free - free_kib * 1024))

    for free_kib in (0, 8, 200, 1000):
        leave(free_kib)
        with pytest.raises(OSError, match="no space left on device") as error:
            save_checkpoint(disk / "c", newer, state=state)
        text = str(error.value)
        assert text.startswith(f"{disk / 'c'}: cannot be written: ")
        assert "\n" not in text
        filler.unlink()
        assert contents(disk) == before
    # The space that the message asks for suffices, even though random numbers hardly compress.
    leave(int(re.search(r"expected (\d+) KiB", text)[1]) + 4)  # type: ignore[index]
    save_checkpoint(disk / "c", newer, state=state)
    assert load_checkpoint(disk / "c").step == 8

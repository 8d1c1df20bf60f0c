"""Checkpoints: bit for bit there and back, and one line for every kind of damage."""

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
from tiny_run import CONFIG, SENSOR, bits

from fcos_lidar_jax.checkpoints import Checkpoint, CheckpointError, load_checkpoint, save_checkpoint
from fcos_lidar_jax.checkpoints.storage import NonFiniteStateError, load_state
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.training import make_optimizer, make_state


def numbers(tree, seed: int):
    """Random values of every leaf's kind, so that no two leaves are alike."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jax.numpy.asarray(rng.normal(0, 9, leaf.shape), leaf.dtype), tree)


@pytest.fixture(scope="module")
def state():
    detector, optimizer = build_detector(CONFIG, SENSOR), make_optimizer(CONFIG.optimizer, 10)
    state = jax.eval_shape(lambda key: make_state(detector, optimizer, key), jax.random.key(0))
    key = jax.random.key(2**40 + 7)
    return dataclasses.replace(numbers(dataclasses.replace(state, key=None), 1), key=key)


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


def test_everything_comes_back_bit_for_bit(written, checkpoint, state):
    loaded = load_checkpoint(written)
    assert dataclasses.replace(loaded, variables={}) == dataclasses.replace(checkpoint, variables={})
    assert jax.tree.structure(loaded.variables) == jax.tree.structure(checkpoint.variables)
    assert bits(loaded.variables) == bits(checkpoint.variables)
    like = dataclasses.replace(numbers(dataclasses.replace(state, key=None), 2), key=jax.random.key(0))
    again = load_state(written, like)
    assert jax.tree.structure(again) == jax.tree.structure(state)
    assert [leaf.dtype for leaf in jax.tree.leaves(again)] == [leaf.dtype for leaf in jax.tree.leaves(state)]
    assert bits(again) == bits(state)
    assert bits(like) != bits(state)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_never_saved(copy, checkpoint, value):
    before = contents(copy.parent)
    odd = jax.tree.map(np.array, checkpoint.variables)
    for leaf in jax.tree.leaves(odd["batch_stats"]):
        leaf.flat[0] = value
    with pytest.raises(NonFiniteStateError, match=r"c: not saved: variables/batch_stats/.*: not finite"):
        save_checkpoint(copy, dataclasses.replace(checkpoint, variables=odd))
    assert contents(copy.parent) == before


@pytest.mark.parametrize("version", [2, 3])
def test_a_checkpoint_of_older_fields_is_converted(copy, written, version):
    file = copy / "checkpoint.json"
    old = json.loads(file.read_text())
    config = old["config"]
    later = {
        "model": {"remat": False, "regression_axes": "lidar", "local_geometry": False},
        "loss": {"quality": "iou", "centreness_m": 0.75},
        "inference": {"iou_exponent": 1.0, "merge_iou": None, "flips": "none"},
    }
    for section, fields in later.items():
        for name, value in fields.items():
            assert config[section].pop(name) == value
    del old["hash"]
    config["model"]["meta_kernel"] = False
    if version == 2:
        del config["classes"], config["class_ranges_m"]
        config["model"]["num_classes"] = 10
        config["model"]["stem"]["form"], config["inference"]["nms_form"] = "split", "rows"
    old["format"] = version
    file.write_text(json.dumps({**old, "hash": checksum(json.dumps(old, sort_keys=True).encode())}))
    found, expected = load_checkpoint(copy), load_checkpoint(written)
    assert (found.config, found.sensor, found.step) == (expected.config, expected.sensor, expected.step)
    assert bits(found.variables) == bits(expected.variables)


def test_a_checkpoint_with_a_part_that_is_gone_is_refused_in_one_line(copy):
    file = copy / "checkpoint.json"
    old = json.loads(file.read_text())
    old["config"]["model"]["meta_kernel"] = True
    del old["hash"]
    file.write_text(json.dumps({**old, "hash": checksum(json.dumps(old, sort_keys=True).encode())}))
    with pytest.raises(ValueError, match=r"^.*checkpoint\.json: config\.model\.meta_kernel: unknown field.*$"):
        load_checkpoint(copy)


def test_nothing_else_is_written_and_others_may_read_it(written):
    assert [p.name for p in written.parent.iterdir()] == ["c"]
    assert {p.name for p in written.iterdir()} == {"checkpoint.json", "variables", "state"}
    assert written.stat().st_mode & 0o777 == 0o755


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


@pytest.mark.parametrize("part", ["variables", "state"])
@pytest.mark.parametrize("damage", [truncate, flip, Path.unlink])
def test_a_damaged_array_file_is_found_and_named(copy, state, part, damage):
    largest = max((p for p in (copy / part).rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    damage(largest)
    told = "found nothing, expected a file" if damage is Path.unlink else "hash .*: damaged"
    for load in (load_checkpoint, lambda folder: load_state(folder, state)):
        with pytest.raises(CheckpointError, match=told) as error:
            load(copy)
        assert str(error.value).startswith(f"{largest}: ")


def test_damage_of_any_file_is_found(written, tmp_path):
    names = [p.relative_to(written) for p in sorted(written.rglob("*")) if p.is_file()]
    for number, name in enumerate(names):
        folder = shutil.copytree(written, tmp_path / str(number))
        truncate(folder / name) if (folder / name).stat().st_size else (folder / name).write_text("x")
        with pytest.raises(CheckpointError, match=name.name):
            load_checkpoint(folder)


def says_the_same(a, b):
    try:
        return json.loads(a) == json.loads(b)
    except ValueError:
        return False


def test_every_byte_of_the_description_counts(copy, written):
    """Any flipped bit leaves something that is no JSON, no description, not what was written, or that says the
    same: between tokens, or in the last digit of a number that reads as the same number."""
    content = (written / "checkpoint.json").read_bytes()
    for at in np.random.default_rng(0).choice(len(content), 200, replace=False):
        changed = bytearray(content)
        changed[at] ^= 1
        if says_the_same(changed, content):
            continue
        (copy / "checkpoint.json").write_bytes(changed)
        with pytest.raises(CheckpointError, match=r"checkpoint\.json"):
            load_checkpoint(copy)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[]", "format: got 'list', expected 3"),
        ("{}", "format: got None, expected 3"),
        ("", "not JSON"),
        (None, r"no checkpoint\.json in it"),
    ],
)
def test_what_is_not_a_description_is_named(tmp_path, text, told):
    if text is not None:
        (tmp_path / "checkpoint.json").write_text(text)
    with pytest.raises(CheckpointError, match=told):
        load_checkpoint(tmp_path)


def test_a_file_too_many_is_named(copy):
    (copy / "variables" / "stranger").write_text("x")
    with pytest.raises(CheckpointError, match=r"variables/stranger: found a file that is not of the checkpoint"):
        load_checkpoint(copy)


def test_a_checkpoint_without_a_state_is_not_gone_on_from(tmp_path, checkpoint, state):
    save_checkpoint(tmp_path / "c", checkpoint)
    assert load_checkpoint(tmp_path / "c").step == 7
    with pytest.raises(CheckpointError, match="found a detector, expected a training state"):
        load_state(tmp_path / "c", state)


def test_arrays_of_another_configuration_are_refused_and_the_first_one_is_named(tmp_path, checkpoint, state):
    wider = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, head_channels=16))
    save_checkpoint(tmp_path / "c", dataclasses.replace(checkpoint, config=wider), state=state)
    told = r"c: params/head.*: got \(.*8.*\), expected \(.*16.*\): the arrays are not of the configuration"
    with pytest.raises(CheckpointError, match=told):
        load_checkpoint(tmp_path / "c")


def test_a_state_without_a_running_mean_is_not_taken_for_one_with(written, state):
    with pytest.raises(CheckpointError, match=r"ema\..*: got \(.*\), expected nothing"):
        load_state(written, dataclasses.replace(state, ema=None))


def test_a_missing_parent_is_named(tmp_path, checkpoint):
    with pytest.raises(OSError, match="gone"):
        save_checkpoint(tmp_path / "gone" / "c", checkpoint)


def test_a_failure_between_leaves_the_old_one_whole(copy, checkpoint, monkeypatch):
    """The last file, the description, cannot be written: what was there is there, and nothing else."""
    before = contents(copy.parent)
    monkeypatch.setattr(json, "dumps", lambda *_, **__: (_ for _ in ()).throw(OSError("no")))
    with pytest.raises(OSError, match="no"):
        save_checkpoint(copy, checkpoint)
    assert contents(copy.parent) == before


@pytest.fixture
def disk(tmp_path):
    """A small one of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "t", str(folder)]
    if os.geteuid() or subprocess.run(mount, check=False, stderr=subprocess.DEVNULL).returncode:
        pytest.skip("no right to mount a small tmpfs")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_full_disk_gets_one_line_and_leaves_the_old_one_whole(disk, written, checkpoint, state):
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
    # What the line asks for is enough, though random numbers hardly compress.
    leave(int(re.search(r"expected (\d+) KiB", text)[1]) + 4)  # type: ignore[index]
    save_checkpoint(disk / "c", newer, state=state)
    assert load_checkpoint(disk / "c").step == 8

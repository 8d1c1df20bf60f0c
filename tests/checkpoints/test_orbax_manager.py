"""Why checkpoints are not managed by Orbax's ``CheckpointManager``: damage that ours finds, it does not."""

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest

ARRAYS = {"weights": np.random.default_rng(0).normal(size=(200, 50)).astype(np.float32)}


def manager(folder) -> ocp.CheckpointManager:
    return ocp.CheckpointManager(folder, options=ocp.CheckpointManagerOptions(enable_async_checkpointing=False))


def save(checkpoints, step) -> None:
    checkpoints.save(step, args=ocp.args.StandardSave(ARRAYS))


def restore_latest(folder):
    like = jax.tree.map(lambda array: jax.ShapeDtypeStruct(array.shape, array.dtype), ARRAYS)
    with manager(folder) as checkpoints:
        return checkpoints.restore(checkpoints.latest_step(), args=ocp.args.StandardRestore(like))


@pytest.fixture
def run(tmp_path):
    """Folder of two checkpoints, and the array file of the newest."""
    with manager(tmp_path) as checkpoints:
        save(checkpoints, 1)
        save(checkpoints, 2)
    files = (path for path in (tmp_path / "2").rglob("*") if path.is_file())
    return tmp_path, max(files, key=lambda file: file.stat().st_size)


def test_a_flipped_bit_is_restored_without_an_error(run):
    folder, file = run
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    assert not np.array_equal(restore_latest(folder)["weights"], ARRAYS["weights"])


def test_a_truncated_newest_checkpoint_is_not_skipped(run):
    folder, file = run
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(ValueError, match="OUT_OF_RANGE"):
        restore_latest(folder)


def test_two_managers_write_into_one_folder(run):
    folder, _ = run
    with manager(folder) as one, manager(folder) as other:
        save(one, 3)
        save(other, 3)
        assert 3 in one.all_steps()
        assert 3 in other.all_steps()

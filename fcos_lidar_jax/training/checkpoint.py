"""Checkpoints that explain themselves: orbax arrays beside the configuration and the sensor as JSON."""

import dataclasses
import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import jax

from fcos_lidar_jax import __version__
from fcos_lidar_jax.config import Config, config_from_json, config_to_json
from fcos_lidar_jax.models import Variables, build_detector
from fcos_lidar_jax.sensors import Sensor, sensor_from_json, sensor_to_json

_FORMAT = 1
_DESCRIPTION = "checkpoint.json"
_ARRAYS = "variables"


class CheckpointError(ValueError):
    """A checkpoint that cannot be used: the message names the folder, the finding and the expectation."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A trained detector."""

    config: Config
    """What was trained."""
    sensor: Sensor
    """For which sensor."""
    variables: Variables
    """``params`` and ``batch_stats``."""
    step: int
    """Updates done."""


def save_checkpoint(folder: str | Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint, whole or not at all.

    It is written beside the folder and renamed; a checkpoint that was there before is kept until then.

    Args:
        folder: where; its parent must exist.
        checkpoint: what.
    """
    import orbax.checkpoint as ocp

    folder = Path(folder).absolute()
    beside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        description = {
            "format": _FORMAT,
            "written_by": f"fcos_lidar_jax {__version__}, jax {jax.__version__}",
            "step": checkpoint.step,
            "config": config_to_json(checkpoint.config),
            "sensor": sensor_to_json(checkpoint.sensor),
        }
        (beside / _DESCRIPTION).write_text(json.dumps(description, indent=1), encoding="utf-8")
        with ocp.StandardCheckpointer() as checkpointer:
            checkpointer.save(beside / _ARRAYS, checkpoint.variables)
        os.chmod(beside, 0o755)
        old = beside.with_name(beside.name + ".old")
        if folder.exists():
            os.replace(folder, old)
        os.replace(beside, folder)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def load_checkpoint(folder: str | Path) -> Checkpoint:
    """Read a checkpoint and check that its arrays are those of its configuration.

    Raises:
        CheckpointError: naming the folder, what was found and what was expected.
    """
    import orbax.checkpoint as ocp

    folder = Path(folder).absolute()
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise CheckpointError(f"{folder}: found {found}, expected a checkpoint folder")
    description = _read_description(folder)
    config = config_from_json(description["config"], f"{folder / _DESCRIPTION}: config")
    sensor = sensor_from_json(description["sensor"], f"{folder / _DESCRIPTION}: sensor")
    expected = jax.eval_shape(build_detector(config, sensor).init, jax.random.key(0))
    where = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    target = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where), expected)
    try:
        with ocp.StandardCheckpointer() as checkpointer:
            metadata: Any = checkpointer.metadata(folder / _ARRAYS).item_metadata
            _compare(folder, config, expected, metadata.tree)
            variables = checkpointer.restore(folder / _ARRAYS, target)
    except CheckpointError:
        raise
    except Exception as error:  # orbax and its storage raise what they like on damaged files
        reason = " ".join(str(error).split())[:200]
        raise CheckpointError(f"{folder / _ARRAYS}: cannot be read: {reason}") from error
    return Checkpoint(config, sensor, variables, description["step"])


def _read_description(folder: Path) -> dict[str, Any]:
    file = folder / _DESCRIPTION
    if not file.is_file():
        raise CheckpointError(f"{folder}: no {_DESCRIPTION} in it, expected a checkpoint folder")
    try:
        description = json.loads(file.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{file}: not JSON: {error}") from None
    if not isinstance(description, dict) or description.get("format") != _FORMAT:
        found = description.get("format") if isinstance(description, dict) else type(description).__name__
        raise CheckpointError(f"{file}: format: got {found!r}, expected {_FORMAT}")
    for name, kind in (("step", int), ("config", dict), ("sensor", dict)):
        if not isinstance(description.get(name), kind):
            raise CheckpointError(f"{file}: {name}: got {description.get(name)!r}, expected {kind.__name__}")
    return description


def _compare(folder: Path, config: Config, expected: Any, found: Any) -> None:
    """Same names and shapes, or a line that names the first difference."""

    def shapes(tree: Any) -> dict[str, tuple[int, ...]]:
        leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
        return {jax.tree_util.keystr(path, simple=True, separator="/"): tuple(leaf.shape) for path, leaf in leaves}

    wanted, there = shapes(expected), shapes(found)
    for name in sorted(wanted.keys() | there.keys()):
        if wanted.get(name) != there.get(name):
            raise CheckpointError(
                f"{folder}: {name}: got {there.get(name, 'nothing')}, "
                f"expected {wanted.get(name, 'nothing')}: "
                f"the arrays are not of the configuration {config.name!r} beside them"
            )

"""Self-describing checkpoints: Orbax arrays, with configuration and sensor as JSON.

A checkpoint is a folder. ``checkpoint.json`` describes it and lists the hash of every file, ``variables`` holds
the arrays for detection, and ``state``, if present, the arrays to resume training from. An optional ``README.md``
is not hashed.
"""

import dataclasses
import json
import os
import shutil
import tempfile
from importlib.resources import files
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import fcos_lidar_jax.presets  # noqa: F401  (a checkpoint may hold the configuration of any of them)
from fcos_lidar_jax import __version__
from fcos_lidar_jax.checkpoints.preemption import after_the_block
from fcos_lidar_jax.config import Config, config_from_json, config_to_json
from fcos_lidar_jax.files import checksum, local_path, naming, read_json, refusing
from fcos_lidar_jax.models import Variables, build_detector
from fcos_lidar_jax.sensors import Sensor, sensor_from_json, sensor_to_json
from fcos_lidar_jax.types import TrainState

_FORMAT = 3
LATER_FIELDS = {
    "model": {"remat": False, "regression_axes": "lidar", "local_geometry": False, "round_offsets": False},
    "loss": {"quality": "iou", "centreness_m": 0.75, "refined_class_weight": 4.0, "refined_box_weight": 0.5},
    "inference": {"iou_exponent": 1.0, "merge_iou": None, "flips": "none", "nms_across_classes": False},
    "refinement": {"num_neighbours": 0, "pair_channels": (64, 64)},
}
"""Configuration fields added to format 3 later, and their values in checkpoints without them."""
LATER_SECTIONS = {"refinement": None}
"""Sections of the configuration added later, and their values in checkpoints without them."""
GONE_FIELDS = {"model": {"meta_kernel": False}}
"""Removed configuration fields, and the only values with which a configuration is still accepted."""
_DESCRIPTION, _VARIABLES, _STATE = "checkpoint.json", "variables", "state"
_CARD = "README.md"
_METADATA_BYTES = 2**20  # disk space for the metadata of the arrays


class NonFiniteStateError(ArithmeticError):
    """A value to be saved is not finite; the message names the first such array."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message names the folder, what was found and what was expected."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A trained detector. Weights of another precision, such as float16, are loaded as float32."""

    config: Config
    sensor: Sensor
    variables: Variables = dataclasses.field(repr=False)  # ``params`` and ``batch_stats``
    step: int  # number of updates
    data: str = ""  # description of the training data; a run resumes only with the same data
    score: float | None = None  # mean average precision; None if it was not evaluated


def save_checkpoint(folder: str | Path, checkpoint: Checkpoint, *, state: TrainState | None = None) -> None:
    """Write a checkpoint atomically, with ``state`` to resume from if given.

    It is written next to ``folder``, whose parent must exist, and then replaces ``folder``. Only one of several
    processes may call this function.

    Raises:
        NonFiniteStateError: a value is not finite; nothing is written.
        CheckpointError: the folder holds something other than a checkpoint; nothing is written.
        OSError: writing failed; the message is one line.

    >>> import tempfile
    >>> from fcos_lidar_jax.checkpoints import load_checkpoint
    >>> shipped = load_checkpoint("quickstart")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_checkpoint(f"{folder}/mine", dataclasses.replace(shipped, step=7))
    ...     load_checkpoint(f"{folder}/mine").step
    7
    """
    folder = local_path(folder).absolute()
    _check_replaceable(folder)
    parts = {_VARIABLES: checkpoint.variables} | ({} if state is None else {_STATE: _as_arrays(state)})
    # Replicated arrays are complete on every device.
    parts = jax.tree.map(lambda x: np.asarray(x.addressable_data(0) if isinstance(x, jax.Array) else x), parts)
    for name, leaf in by_name(parts).items():
        if jnp.issubdtype(leaf.dtype, jnp.floating) and not np.isfinite(leaf).all():
            raise NonFiniteStateError(f"{folder}: not saved: {name}: not finite")
    _check_space(folder, parts)
    beside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        for name, tree in parts.items():
            _save_arrays(beside / name, tree)
        description = {
            "format": _FORMAT,
            "written_by": f"fcos_lidar_jax {__version__}, jax {jax.__version__}",
            "step": checkpoint.step,
            "data": checkpoint.data,
            "score": checkpoint.score,
            "config": config_to_json(checkpoint.config),
            "sensor": sensor_to_json(checkpoint.sensor),
            "files": _hashes(beside),
        }
        with naming(folder):
            (beside / _DESCRIPTION).write_text(_with_hash(description), encoding="utf-8")
        os.chmod(beside, 0o755)
        _replace_folder(beside, folder)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _check_replaceable(folder: Path) -> None:
    """Refuse to replace anything but a checkpoint. The folder of a run can be read as one, but not replaced."""
    if is_checkpoint(folder) or not os.path.lexists(folder) or (folder.is_dir() and not any(folder.iterdir())):
        return
    raise CheckpointError(f"{folder}: found {_found(folder)}, expected a checkpoint to replace, or nothing")


def _found(folder: Path) -> str:
    """What is in the place of a checkpoint."""
    if folder.is_dir():
        return f"a folder without {_DESCRIPTION}"
    return "a file" if os.path.lexists(folder) else "nothing"


def _replace_folder(beside: Path, folder: Path) -> None:
    """Rename ``beside`` to ``folder``; if this fails, an existing folder stays."""
    old = beside.with_name(beside.name + ".old")
    try:
        if folder.exists():
            os.replace(folder, old)
        os.replace(beside, folder)
    except BaseException:
        if old.exists() and not folder.exists():
            os.replace(old, folder)
        raise
    shutil.rmtree(old, ignore_errors=True)


def is_checkpoint(folder: Path) -> bool:
    """Whether a folder has the description of a checkpoint; its other files may be damaged."""
    return (folder / _DESCRIPTION).is_file()


def save_score(folder: str | Path, score: float) -> None:
    """Record the score of a checkpoint without touching its arrays."""
    file = Path(folder).absolute() / _DESCRIPTION
    text = _with_hash(read_description(file.parent) | {"score": score})
    # Written beside the checkpoint: a file that a kill leaves in it would count as damage.
    with naming(file), tempfile.TemporaryDirectory(prefix=f".{file.parent.name}.", dir=file.parents[1]) as beside:
        new = Path(beside) / _DESCRIPTION
        new.write_text(text, encoding="utf-8")
        os.replace(new, file)


def _with_hash(description: dict[str, Any]) -> str:
    return json.dumps({**description, "hash": checksum(_canonical(description))}, indent=1)


def read_checkpoint(folder: Path) -> Checkpoint:
    """Read the checkpoint in a folder, see :func:`~fcos_lidar_jax.checkpoints.load_checkpoint`."""
    folder = local_path(folder).absolute()
    description = verify(folder)
    config = config_from_json(description["config"], f"{folder / _DESCRIPTION}: config")
    sensor = sensor_from_json(description["sensor"], f"{folder / _DESCRIPTION}: sensor")
    expected = jax.eval_shape(build_detector(config, sensor).init, jax.random.key(0))
    variables = _load_arrays(folder / _VARIABLES, expected, config.name)
    return Checkpoint(
        config, sensor, variables, description["step"], description.get("data", ""), description.get("score")
    )


def read_state(folder: Path, like: TrainState) -> TrainState:
    """Read the state in the folder of a checkpoint, see :func:`~fcos_lidar_jax.checkpoints.load_state`."""
    folder = local_path(folder).absolute()
    description = verify(folder)
    if not (folder / _STATE).is_dir():
        raise CheckpointError(f"{folder}: found a detector without a training state, expected both")
    loaded = _load_arrays(folder / _STATE, jax.eval_shape(_as_arrays, like), description["config"]["name"])
    state = jax.tree.unflatten(jax.tree.structure(like), [loaded[name] for name in by_name(like, ".")])
    return dataclasses.replace(state, key=jax.random.wrap_key_data(state.key))


def _as_arrays(state: TrainState) -> dict[str, Any]:
    """Leaves of the state by name, with the random key as raw data."""
    return by_name(dataclasses.replace(state, key=jax.random.key_data(state.key)), ".")


def by_name(tree: Any, separator: str = "/") -> dict[str, Any]:
    """The leaves of a tree by their path."""
    leaves = jax.tree.leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator=separator): leaf for path, leaf in leaves}


def _checkpointer() -> Any:
    """An Orbax checkpointer that does not synchronise with other processes."""
    import orbax.checkpoint as ocp

    own = jax.process_index()
    options = ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
    )
    return ocp.StandardCheckpointer(multiprocessing_options=options)


def _check_space(folder: Path, tree: Any) -> None:
    """Raise an OSError without free space; Orbax's threads would print tracebacks."""
    needed = sum(leaf.nbytes for leaf in jax.tree.leaves(tree)) * 9 // 8 + _METADATA_BYTES
    free = shutil.disk_usage(folder.parent).free
    if free < needed:
        raise OSError(
            f"{folder}: cannot be written: no space left on device: "
            f"{free >> 10} KiB are free, expected {needed >> 10} KiB"
        )
    if hasattr(os, "posix_fallocate"):  # not on macOS
        with naming(folder), tempfile.TemporaryFile(dir=folder.parent) as file:
            os.posix_fallocate(file.fileno(), 0, needed)


def _save_arrays(folder: Path, tree: Any) -> None:
    with refusing(f"{folder}: cannot be written", kind=OSError):  # on a full disk, Orbax raises any exceptions
        with after_the_block(), _checkpointer() as checkpointer:
            checkpointer.save(folder, tree)
        # It contains a path of this machine, and is not needed: the hashes show that the checkpoint is complete.
        (folder / "commit_success.txt").unlink(missing_ok=True)


def _load_arrays(folder: Path, expected: Any, configuration: str) -> Any:
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    target = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=device), expected)
    try:
        with after_the_block(), _checkpointer() as checkpointer:
            metadata: Any = checkpointer.metadata(folder).item_metadata
            check_arrays(folder.parent, expected, metadata.tree, whose=f"the configuration {configuration!r}")
            return checkpointer.restore(folder, target)
    except CheckpointError:
        raise
    except Exception as error:  # Orbax raises arbitrary exceptions for corrupt files
        raise CheckpointError(f"{folder}: cannot be read: {' '.join(str(error).split())[:200]}") from error


def _canonical(description: dict[str, Any]) -> bytes:
    """Canonical JSON of a description without its own hash."""
    return json.dumps({k: v for k, v in description.items() if k != "hash"}, sort_keys=True).encode()


def _hashes(folder: Path) -> dict[str, str]:
    """Checksums of all files in a folder except the description and the card."""
    return {
        file.relative_to(folder).as_posix(): checksum(file.read_bytes())
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file not in (folder / _DESCRIPTION, folder / _CARD)
    }


def verify(folder: Path) -> dict[str, Any]:
    """Check the hashes of all files of a checkpoint, and return its description."""
    description = read_description(folder)
    expected, found = description["files"], _hashes(folder)
    for name in sorted(expected.keys() | found.keys()):
        was, now = (f"hash {files[name]}" if name in files else "no file" for files in (expected, found))
        if was != now:
            raise CheckpointError(f"{folder / name}: damaged: got {now}, expected {was}")
    return description


def read_description(folder: Path) -> dict[str, Any]:
    """Read and check the description of a checkpoint, but not its arrays."""
    file = folder / _DESCRIPTION
    if not is_checkpoint(folder):
        places = "a checkpoint folder, the folder of a run that has saved one, or the name of shipped weights"
        names = ", ".join(shipped_checkpoints())
        raise CheckpointError(f"{folder}: found {_found(folder)}, expected {places}: {names}")
    with refusing("", ValueError, kind=CheckpointError):
        description = read_json(file, dict[str, Any])
    if (version := description.get("format")) != _FORMAT:
        raise CheckpointError(f"{file}: format: got {version!r}, expected {_FORMAT}")
    if description.get("hash") != checksum(_canonical(description)):
        raise CheckpointError(f"{file}: damaged: its hash does not match its content")
    return {**description, "config": with_later_fields(description["config"])}


def with_later_fields(config: dict[str, Any]) -> dict[str, Any]:
    """Add the fields that a configuration of an earlier version lacks, and drop removed fields."""
    later: dict[str, Any] = {name: config.get(name, value) for name, value in LATER_SECTIONS.items()}
    for section, fields in LATER_FIELDS.items():
        if isinstance(values := later.get(section, config.get(section, {})), dict):
            gone = GONE_FIELDS.get(section, {})
            kept = {name: value for name, value in values.items() if name not in gone or value != gone[name]}
            later[section] = {**fields, **kept}
    return {**config, **later}


def check_arrays(where: Path | str, expected: Any, found: Any, *, whose: str) -> None:
    """Compare names and shapes of the arrays found at ``where`` with the expected arrays, which belong to
    ``whose``.

    Raises:
        CheckpointError: names the first difference.
    """
    shapes, got = ({name: tuple(leaf.shape) for name, leaf in by_name(t).items()} for t in (expected, found))
    for name in sorted(shapes.keys() | got.keys()):
        if shapes.get(name) != got.get(name):
            difference = f"got {got.get(name, 'nothing')}, expected {shapes.get(name, 'nothing')}"
            raise CheckpointError(f"{where}: {name}: {difference}: the arrays do not belong to {whose}")


def shipped_checkpoints() -> dict[str, Path]:
    """Names and folders of the checkpoints that come with the package."""
    folder = Path(str(files("fcos_lidar_jax") / "weights"))
    return {path.name: path for path in sorted(folder.iterdir()) if path.is_dir()} if folder.is_dir() else {}

"""Detectors in one file: a program of ``jax.export`` from points to boxes that includes the weights.

The file consists of a line with its format and the checksum of the rest, a line of JSON that describes the
detector, and the serialised program. docs/export.md shows how to run it without this package.
"""

import contextlib
import dataclasses
import functools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import export, lax
from jax.sharding import Mesh

from fcos_lidar_jax import __version__
from fcos_lidar_jax.checkpoints.storage import CheckpointError, with_later_fields
from fcos_lidar_jax.config import config_from_json, config_to_json
from fcos_lidar_jax.data.cloud_policy import usable_rows
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.files import checksum, refusing
from fcos_lidar_jax.inference.detect import make_detect, over_clouds
from fcos_lidar_jax.inference.detector import CloudDetector, TrainedDetector, jit_split
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.projection import remove_close
from fcos_lidar_jax.sensors import sensor_from_json, sensor_to_json
from fcos_lidar_jax.types import Detections

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
Size = int | Literal["any"]

_FORMAT = b"fcos-lidar-detector 1 "
_MAX_FIRST_LINE, _MAX_BYTES = 100, 2**31
_WITHOUT_SOURCE_PATHS = {"jax_hlo_source_file_canonicalization_regex": ".*", "jax_traceback_in_locations_limit": 0}


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ExportedDetector(CloudDetector):
    """A detector from a file of ``fcos-lidar export``, see :func:`load_exported`."""

    record: dict[str, Any]  # description of the detector in the file
    exported: export.Exported

    @property
    def fingerprint(self) -> str:
        return f"{self.record['weights']['blake2b']} in {self.record['program']['blake2b']}"

    def program(self, mesh: Mesh, batch_size: int = 1) -> Callable[..., Any]:
        takes = self.record["batch"]
        expected = f"{takes}: the detector was exported for it"
        check(takes in (batch_size, "any"), "batch size", batch_size, expected)
        return _split_program(self, mesh)


@functools.lru_cache(maxsize=8)
def _split_program(detector: ExportedDetector, mesh: Mesh) -> Callable[..., Any]:
    def on_one_device(points: jax.Array, valid: jax.Array) -> Detections:
        # This package has already removed close points, in the frame of each sweep.
        arrays: Any = detector.exported.call(points, valid, np.False_)
        return Detections(**arrays)

    return jit_split(on_one_device, mesh)


def export_detector(detector: TrainedDetector, *, num_points: Size | None = None, batch: Size = 1) -> bytes:
    """Export a detector to the bytes of a file that runs without this package; deterministic for fixed versions.

    The program takes points f32[b, n, c], valid bool[b, n] and remove_close bool[], and returns a dictionary of
    the arrays of :class:`~fcos_lidar_jax.types.Detections`. It drops rows that are not finite or beyond physical
    limits and, with ``remove_close``, points on the ego vehicle as configured.

    Args:
        num_points: n, number of rows of a padded cloud, by default ``config.max_points``; ``"any"`` compiles for
            each number.
        batch: b, number of clouds, or ``"any"``. With several clouds, boxes and scores differ by rounding.
    """
    config, sensor = detector.config, detector.sensor
    rows = config.max_points if num_points is None else num_points
    for name, size in (("points", rows), ("batch", batch)):
        check(not isinstance(size, int) or size >= 1, name, size, "at least 1, or any")
    if rows != "any":
        config = dataclasses.replace(config, max_points=rows)
    scope = export.SymbolicScope()
    b, n = (
        export.symbolic_shape(name, scope=scope)[0] if size == "any" else size
        for name, size in (("b", batch), ("n", rows))
    )
    arguments = (
        jax.ShapeDtypeStruct((b, n, sensor.point_columns), jnp.float32),
        jax.ShapeDtypeStruct((b, n), jnp.bool_),
        jax.ShapeDtypeStruct((), jnp.bool_),
    )
    with _settings(_WITHOUT_SOURCE_PATHS):
        exported = export.export(jax.jit(_whole_path(detector, batch)), platforms=PLATFORMS)(*arguments)
        program = bytes(exported.serialize())
    weights = [np.asarray(leaf) for leaf in jax.tree.leaves(detector.variables)]
    record = {
        "written_by": f"fcos_lidar_jax {__version__}, jax {jax.__version__}",
        "name": config.name,
        "classes": list(detector.classes),
        "batch": batch,
        "num_points": rows,
        "num_columns": sensor.point_columns,
        "columns": ["x", "y", "z", "intensity", "time_lag", "laser"][: sensor.point_columns],
        "box": ["x", "y", "z", "l", "w", "h", "yaw", "vx", "vy"],
        "platforms": PLATFORMS,
        "calling_convention": exported.calling_convention_version,
        "weights": {
            "parameters": sum(leaf.size for leaf in jax.tree.leaves(detector.variables["params"])),
            "blake2b": checksum(b"".join(leaf.tobytes() for leaf in weights)),
        },
        "program": {"bytes": len(program), "blake2b": checksum(program)},
        "sensor": sensor_to_json(sensor),
        "config": config_to_json(config),
    }
    content = json.dumps(record).encode() + b"\n" + program
    return _FORMAT + checksum(content).encode() + b"\n" + content


def _whole_path(detector: TrainedDetector, batch: Size) -> Callable[..., dict[str, jax.Array]]:
    detect, reading, sensor = make_detect(detector.model), detector.config.reading, detector.sensor
    weights = jax.tree.map(np.asarray, detector.variables)

    def one(variables: Any, points: jax.Array, valid: jax.Array, removes_close: jax.Array) -> Detections:
        usable = valid & usable_rows(points)
        far = remove_close(points, usable, sensor, reading)
        return detect(variables, points, jnp.where(removes_close, far, usable))

    def whole(points: jax.Array, valid: jax.Array, removes_close: jax.Array) -> dict[str, jax.Array]:
        # The barrier prevents constant folding, so that the program computes as with weights as arguments.
        variables = lax.optimization_barrier(jax.tree.map(jnp.asarray, weights))
        return vars(over_clouds(one, batch)(variables, points, valid, removes_close))

    return whole


@contextlib.contextmanager
def _settings(values: dict[str, Any]) -> Iterator[None]:
    before = {name: getattr(jax.config, name) for name in values}
    try:
        for name, value in values.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def load_exported(file: Path) -> ExportedDetector:
    """Load a file of :func:`export_detector`; the program is compiled for the first cloud."""
    record, program = _read(file)
    config = config_from_json(with_later_fields(record["config"]), f"{file}: config")
    sensor = sensor_from_json(record["sensor"], f"{file}: sensor")
    where = f"{file}: not readable by jax {jax.__version__}: found the program of {record['written_by']}"
    with refusing(where, kind=CheckpointError):
        exported = export.deserialize(bytearray(program))
    return ExportedDetector(build_detector(config, sensor), record, exported)


def _read(file: Path) -> tuple[dict[str, Any], bytes]:
    with refusing(f"{file}: cannot be read", OSError, kind=CheckpointError), file.open("rb") as stream:
        first = stream.readline(_MAX_FIRST_LINE)
        if not first.startswith(_FORMAT):
            wanted = f"a checkpoint folder or a file that `fcos-lidar export` has written, with {_FORMAT!r}"
            raise CheckpointError(f"{file}: found a file with {first[: len(_FORMAT)]!r}, expected {wanted}")
        content = stream.read(min(file.stat().st_size, _MAX_BYTES))  # read() allocates its whole argument
    expected = first.removeprefix(_FORMAT).decode("ascii", "replace").strip()
    if (actual := checksum(content)) != expected:
        raise CheckpointError(f"{file}: checksum {actual!r}, expected {expected!r}: damaged")
    line, _, program = content.partition(b"\n")
    return json.loads(line), program

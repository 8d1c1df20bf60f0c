"""Generated tables in the official nuScenes layout, of any size, without point files."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.nuscenes.names import CATEGORY_TO_CLASS
from fcos_lidar_jax.evaluation.boxes import CLASS_ATTRIBUTES
from fcos_lidar_jax.simulation.nuscenes_tables import CHANNEL, fixed_tables
from fcos_lidar_jax.simulation.nuscenes_tables import token as name_token

Row = dict[str, Any]
SHARES = (0.43, 0.08, 0.02, 0.02, 0.02, 0.2, 0.02, 0.02, 0.09, 0.1)  # Class frequencies, similar to nuScenes.
EGO = {"translation": [411.3039349319818, 1180.8903791765097, 0.0], "rotation": [0.9831, 0.0, 0.0, -0.18307]}
MOUNT = {"translation": [0.9, 0.0, 1.8], "rotation": [1.0, 0.0, 0.0, 0.0]}
_CATEGORIES = {name: category for category, name in reversed(CATEGORY_TO_CLASS.items())}


def write_tables(folder: Path, scenes: Mapping[str, int], *, objects: int) -> None:
    """Write all tables into a new version folder.

    ``scenes`` maps names to numbers of keyframes. All of a scene's ``objects`` occur in all of its keyframes.
    """
    folder.mkdir(parents=True)
    numbers = list(scenes.values())
    keyframes = [(s, k, number) for s, number in enumerate(numbers) for k in range(number)]
    mount = {"token": "mount", "sensor_token": name_token("sensor", CHANNEL), "camera_intrinsic": [], **MOUNT}
    tables: dict[str, Any] = {
        **fixed_tables([]),
        "log": [],
        "map": [{"token": "map", "log_tokens": [], "category": "semantic_prior", "filename": "map.png"}],
        "calibrated_sensor": [mount],
        "scene": (
            {"token": _token("n", s), "name": name, "log_token": "", "first_sample_token": _token("s", s, 0)}
            for s, name in enumerate(scenes)
        ),
        "sample": (
            {**_link("s", s, k, of=number), "timestamp": _time_us(s, k), "scene_token": _token("n", s)}
            for s, k, number in keyframes
        ),
        "sample_data": (
            {
                **_link("d", s, k, of=number),
                "sample_token": _token("s", s, k),
                "ego_pose_token": _token("d", s, k),
                "calibrated_sensor_token": "mount",
                "timestamp": _time_us(s, k),
                "fileformat": "pcd",
                "is_key_frame": True,
                "height": 0,
                "width": 0,
                "filename": f"samples/{CHANNEL}/n000-2018-01-01-00-00-00-0400__{CHANNEL}__{s:08}{k:08}.bin",
            }
            for s, k, number in keyframes
        ),
        "ego_pose": ({"token": _token("d", s, k), "timestamp": _time_us(s, k), **EGO} for s, k, _ in keyframes),
        "instance": (
            {"token": _token("i", s, o), "category_token": name_token("category", _CATEGORIES[class_of(s, o)])}
            for s in range(len(scenes))
            for o in range(objects)
        ),
        "sample_annotation": (
            row for s, number in enumerate(numbers) for o in range(objects) for row in annotations(s, o, number)
        ),
    }
    for name, rows in tables.items():
        with (folder / f"{name}.json").open("w") as stream:
            stream.write("[")
            for i, row in enumerate(rows):  # One field per line, like the official tables.
                stream.write(("," if i else "") + "\n" + json.dumps(row, indent=0))
            stream.write("\n]")
    (folder.parent / "map.png").touch()


def class_of(scene: int, number: int) -> str:
    """Choose the class of an object of a scene."""
    return str(np.random.default_rng([scene, number]).choice(NUSCENES_CLASSES, p=SHARES))


def annotations(scene: int, number: int, keyframes: int) -> Iterator[Row]:
    """Yield the rows of an object in its keyframes; it stands still or moves in a straight line."""
    rng, known = np.random.default_rng([1, scene, number]), CLASS_ATTRIBUTES[class_of(scene, number)]
    start = EGO["translation"] + np.append(rng.normal(0, 22, 2), 0)
    step = rng.choice([0, 2]) * np.append(rng.normal(0, 1, 2), 0)
    size, yaw = rng.uniform(0.5, 4.5, 3).tolist(), rng.uniform(-np.pi, np.pi)
    rotation = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    for i, points in enumerate(rng.integers(0, 40, keyframes).tolist()):
        yield {
            **_link("a", scene, number, i, of=keyframes),
            "sample_token": _token("s", scene, i),
            "instance_token": _token("i", scene, number),
            "visibility_token": "4",
            "attribute_tokens": [name_token("attribute", known[number % len(known)])] if known else [],
            "translation": (start + i * step).tolist(),
            "size": size,
            "rotation": rotation,
            "num_lidar_pts": points,
            "num_radar_pts": 0,
        }


def _token(kind: str, *numbers: int) -> str:
    """Token of 32 characters, like real tokens."""
    return (kind.encode().hex() + "".join(f"{n:06x}" for n in numbers)).ljust(32, "0")


def _link(kind: str, *numbers: int, of: int) -> Row:
    """Tokens of a row and its neighbours; the last number is the row's index in a chain of length ``of``."""
    *chain, i = numbers
    return {
        "token": _token(kind, *numbers),
        "prev": _token(kind, *chain, i - 1) if i else "",
        "next": _token(kind, *chain, i + 1) if i + 1 < of else "",
    }


def _time_us(scene: int, keyframe: int) -> int:
    return 1_500_000_000_000_000 + scene * 10**8 + keyframe * 500_000

"""A small data set in the nuScenes layout: random poses, and points that are static in the world."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

VERSION = "v1.0-made"
KEYFRAMES, BETWEEN = 4, 3
STEP_US = 50_000
FAR = np.array([1000.0, 2000, 0])
"""Position of the scenes in the global frame."""
SENSORS = (("lidar", "LIDAR_TOP", "mount"), ("camera", "CAM_FRONT", "eye"))


def token(*parts: object) -> str:
    return "-".join(map(str, parts)).ljust(32, ".")


def pose(rotation: Rotation, translation: np.ndarray) -> dict[str, Any]:
    return {"rotation": rotation.as_quat(scalar_first=True).tolist(), "translation": translation.tolist()}


def make_tables(scenes: int = 2, seed: int = 0) -> tuple[dict[str, list[dict[str, Any]]], dict[str, np.ndarray]]:
    """Make all tables, and the points of every file."""
    rng = np.random.default_rng(seed)
    mount = Rotation.random(random_state=seed), rng.normal(0, 1, 3)
    names = ["vehicle.car", "human.pedestrian.adult", "animal", "static_object.bicycle_rack"]
    tables: dict[str, list[dict[str, Any]]] = {
        "category": [{"token": token("category", i), "name": n, "description": ""} for i, n in enumerate(names)],
        "attribute": [{"token": token("attribute"), "name": "vehicle.moving", "description": ""}],
        "sensor": [{"token": token(n), "channel": channel} for n, channel, _ in SENSORS],
        "calibrated_sensor": [
            {"token": token(m), "sensor_token": token(n), **pose(*mount)} for n, _, m in SENSORS
        ],
        **{n: [] for n in ("scene", "sample", "sample_data", "ego_pose", "instance", "sample_annotation")},
    }
    clouds: dict[str, np.ndarray] = {}
    for s in range(scenes):
        world = rng.uniform(-30, 30, (50, 3)) + FAR
        first = {"first_sample_token": token("sample", s, 0)}
        tables["scene"].append({"token": token("scene", s), "name": f"scene-{s}", **first})
        for k in range(KEYFRAMES):
            after = token("sample", s, k + 1) if k + 1 < KEYFRAMES else ""
            time = 1_600_000_000_000_000 + s * 10**8 + k * BETWEEN * STEP_US
            row = {"token": token("sample", s, k), "timestamp": time, "scene_token": token("scene", s)}
            tables["sample"].append({**row, "prev": "", "next": after})
        for i in range(KEYFRAMES * BETWEEN):
            ego = Rotation.random(random_state=100 * s + i), rng.normal(0, 20, 3) + FAR
            file = f"samples/LIDAR_TOP/{s}-{i}.pcd.bin"
            to_global = ego[0] * mount[0], ego[0].apply(mount[1]) + ego[1]
            local = to_global[0].inv().apply(world - to_global[1])
            clouds[file] = np.column_stack([local, np.full(50, 7), np.arange(50) % 32]).astype("f4")
            tables["ego_pose"].append({"token": token("pose", s, i), "timestamp": 0, **pose(*ego)})
            tables["sample_data"].append(
                {
                    "token": token("data", s, i),
                    "sample_token": token("sample", s, min(-(-i // BETWEEN), KEYFRAMES - 1)),
                    "ego_pose_token": token("pose", s, i),
                    "calibrated_sensor_token": token("mount"),
                    "timestamp": 1_600_000_000_000_000 + s * 10**8 + i * STEP_US,
                    "is_key_frame": i % BETWEEN == 0,
                    "filename": file,
                    "prev": token("data", s, i - 1) if i else "",
                }
            )
        camera = {**tables["sample_data"][-1], "token": token("photo", s), "prev": ""}
        tables["sample_data"].append({**camera, "calibrated_sensor_token": token("eye"), "filename": "p.jpg"})
        for o in range(len(names)):
            tables["instance"].append({"token": token("instance", s, o), "category_token": token("category", o)})
            speed, start = rng.uniform(-5, 5, 3), world[o]
            for k in range(KEYFRAMES):
                row = token("box", s, o, k)
                tables["sample_annotation"].append(
                    {
                        "token": row,
                        "sample_token": token("sample", s, k),
                        "instance_token": token("instance", s, o),
                        "attribute_tokens": [token("attribute")] if o == 0 else [],
                        "size": [1.5, 4.0, 2.0],
                        **pose(Rotation.from_euler("z", 0.3 * o + k), start + speed * k * BETWEEN * STEP_US / 1e6),
                        "prev": token("box", s, o, k - 1) if k else "",
                        "next": token("box", s, o, k + 1) if k + 1 < KEYFRAMES else "",
                        "num_lidar_pts": o + k,
                        "num_radar_pts": 0,
                    }
                )
    return tables, clouds


def write(
    root: Path, tables: dict[str, Any], clouds: dict[str, np.ndarray], version: str = VERSION, **own: list[str]
) -> Path:
    """Write the data root with its own splits, or with a split per scene and a split of all scenes."""
    folder = root / version
    folder.mkdir(parents=True)
    for name, rows in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(rows, indent=0))
    scenes = [row["name"] for row in tables["scene"]]
    splits = {"all": scenes, **{scene: [scene] for scene in scenes}, "none": [], "lost": ["scene-99"]}
    (folder / "splits.json").write_text(json.dumps(own or splits))
    for file, points in clouds.items():
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        points.tofile(root / file)
    return root

"""Random evaluation tasks: official tables, a results file and the truth, with every case that matters."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.evaluation.boxes import CLASS_ATTRIBUTES
from fcos_lidar_jax.types import CLASSES

VERSION, SPLIT = "v1.0-mini", "mini_val"
SCENES = ("scene-0103", "scene-0916")
RACK = "static_object.bicycle_rack"
CATEGORIES = {
    "car": "vehicle.car",
    "truck": "vehicle.truck",
    "bus": "vehicle.bus.rigid",
    "trailer": "vehicle.trailer",
    "construction_vehicle": "vehicle.construction",
    "pedestrian": "human.pedestrian.adult",
    "motorcycle": "vehicle.motorcycle",
    "bicycle": "vehicle.bicycle",
    "traffic_cone": "movable_object.trafficcone",
    "barrier": "movable_object.barrier",
    RACK: RACK,
    "animal": "animal",
}
ATTRIBUTES = sorted({a for names in CLASS_ATTRIBUTES.values() for a in names})

Tables = dict[str, list[dict[str, Any]]]


def make_task(
    seed: int,
    *,
    samples: int = 5,
    objects: int = 30,
    absent: tuple[str, ...] = (),
    ties: bool = True,
    noise: float = 0.8,
    empty: float = 0.15,
) -> tuple[Tables, dict[str, Any]]:
    """Tables and a results file.

    Args:
        seed: of everything.
        samples: keyframes of each of the two scenes.
        objects: tracks of each scene.
        absent: classes without truth; they are predicted all the same.
        ties: round the scores, so that many are equal.
        noise: of the predictions, metres.
        empty: share of samples without predictions.
    """
    rng = np.random.default_rng(seed)
    tables = _empty_tables()
    results: dict[str, list[dict[str, Any]]] = {}
    kinds = [name for name in CATEGORIES if name not in absent]
    for s, scene in enumerate(SCENES):
        tables["scene"].append(
            {
                "token": f"scene{s}",
                "log_token": "log",
                "nbr_samples": samples,
                "first_sample_token": f"s{s}k0",
                "last_sample_token": f"s{s}k{samples - 1}",
                "name": scene,
                "description": "",
            }
        )
        where = np.array([600.0, 1600, 1]) + rng.normal(0, 100, 3)
        times = 1_530_000_000_123_456 + s * 10**9 + np.cumsum(rng.integers(400_000, 700_000, samples))
        egos = where + np.cumsum(rng.normal(0, 3, (samples, 3)), axis=0)
        for k in range(samples):
            _add_sample(tables, rng, s, k, samples, int(times[k]), egos[k])
        for o in range(objects):
            # Racks are few and large.
            kind = str(rng.choice(kinds)) if o else RACK
            _add_track(tables, rng, f"s{s}o{o}", kind, s, egos, times)
    for sample in rng.permutation([row["token"] for row in tables["sample"]]):
        truths = [row for row in tables["sample_annotation"] if row["sample_token"] == sample]
        boxes = [] if rng.random() < empty else _predictions(rng, str(sample), truths, tables, noise, ties)
        results[str(sample)] = boxes
    flags = {f"use_{name}": name == "lidar" for name in ("camera", "lidar", "radar", "map", "external")}
    return tables, {"meta": flags, "results": results}


def _empty_tables() -> Tables:
    unit = {"translation": [0.9, 0.0, 1.8], "rotation": [0.7, 0.0, 0.0, 0.714]}
    norm = float(np.linalg.norm(unit["rotation"]))
    unit["rotation"] = [v / norm for v in unit["rotation"]]
    return {
        "category": [{"token": f"c-{n}", "name": c, "description": ""} for n, c in CATEGORIES.items()],
        "attribute": [{"token": f"a-{a}", "name": a, "description": ""} for a in ATTRIBUTES],
        "visibility": [],
        "sensor": [{"token": "lidar", "channel": "LIDAR_TOP", "modality": "lidar"}],
        "calibrated_sensor": [{"token": "mount", "sensor_token": "lidar", **unit, "camera_intrinsic": []}],
        "log": [{"token": "log", "logfile": "", "vehicle": "", "date_captured": "", "location": ""}],
        "map": [
            {"token": "map", "log_tokens": ["log"], "category": "semantic_prior", "filename": "maps/empty.png"}
        ],
        **{n: [] for n in ("scene", "sample", "sample_data", "ego_pose", "instance", "sample_annotation")},
    }


def _add_sample(
    tables: Tables, rng: np.random.Generator, s: int, k: int, samples: int, time_us: int, ego: np.ndarray
) -> None:
    token = f"s{s}k{k}"
    after = f"s{s}k{k + 1}" if k + 1 < samples else ""
    before = f"s{s}k{k - 1}" if k else ""
    links = {"prev": before, "next": after}
    tables["sample"].append({"token": token, "timestamp": time_us, "scene_token": f"scene{s}", **links})
    turn = Rotation.from_euler("zyx", [rng.uniform(-np.pi, np.pi), *rng.normal(0, 0.02, 2)])
    tables["ego_pose"].append(
        {
            "token": f"pose-{token}",
            "timestamp": time_us,
            "rotation": turn.as_quat(scalar_first=True).tolist(),
            "translation": ego.tolist(),
        }
    )
    tables["sample_data"].append(
        {
            "token": f"data-{token}",
            "sample_token": token,
            "ego_pose_token": f"pose-{token}",
            "calibrated_sensor_token": "mount",
            "timestamp": time_us,
            "fileformat": "pcd",
            "is_key_frame": True,
            "height": 0,
            "width": 0,
            "filename": f"samples/LIDAR_TOP/{token}.pcd.bin",
            "prev": f"data-{before}" if before else "",
            "next": f"data-{after}" if after else "",
        }
    )


def _add_track(
    tables: Tables, rng: np.random.Generator, name: str, kind: str, s: int, egos: np.ndarray, times: np.ndarray
) -> None:
    """One object through some of the keyframes; there only once, or after a gap, its velocity is unknown."""
    tables["instance"].append(
        {
            "token": name,
            "category_token": f"c-{kind}",
            "nbr_annotations": 0,
            "first_annotation_token": "",
            "last_annotation_token": "",
        }
    )
    # From near to beyond the range of the class.
    start = egos[0] + [*(rng.uniform(5, 60) * _direction(rng)), rng.normal()]
    speed = np.append(rng.choice([0.0, 3.0]) * rng.normal(0, 1, 2), 0)
    size = np.array([8.0, 8.0, 4.0]) if kind == RACK else rng.uniform(0.4, 5, 3)
    present = np.flatnonzero(rng.random(len(times)) < rng.choice([0.3, 1.0]))
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
    known = CLASS_ATTRIBUTES.get(kind, ())
    for i, k in enumerate(present):
        drawn = [f"a-{rng.choice(known)}"] if known and rng.random() < 0.8 else []
        tables["sample_annotation"].append(
            {
                "token": f"{name}-{k}",
                "sample_token": f"s{s}k{k}",
                "instance_token": name,
                "visibility_token": "",
                "attribute_tokens": drawn,
                "translation": (start + speed * (times[k] - times[0]) / 1e6 + rng.normal(0, 0.05, 3)).tolist(),
                "size": size.tolist(),
                "rotation": turn.as_quat(scalar_first=True).tolist(),
                "prev": f"{name}-{present[i - 1]}" if i else "",
                "next": f"{name}-{present[i + 1]}" if i + 1 < len(present) else "",
                "num_lidar_pts": int(rng.integers(0, 4)) * int(rng.integers(0, 9)),
                "num_radar_pts": int(rng.integers(0, 2)),
            }
        )


def _direction(rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _predictions(
    rng: np.random.Generator, token: str, truths: list[dict[str, Any]], tables: Tables, noise: float, ties: bool
) -> list[dict[str, Any]]:
    kind_of = {row["token"]: row["category_token"].removeprefix("c-") for row in tables["instance"]}
    boxes = []
    for truth in truths:
        for _ in range(rng.integers(0, 4)):
            kind = kind_of[truth["instance_token"]]
            if kind not in CLASSES or rng.random() < 0.1:
                kind = str(rng.choice(["bicycle", "motorcycle", *CLASSES]))
            known = (*CLASS_ATTRIBUTES[kind], "")
            sway = Rotation.from_euler("zyx", rng.normal(0, [0.8, 0.05, 0.05]))
            rotation = (sway * Rotation.from_quat(truth["rotation"], scalar_first=True)).as_quat(scalar_first=True)
            score = float(rng.beta(2, 3))
            boxes.append(
                {
                    "sample_token": token,
                    "translation": (np.array(truth["translation"]) + rng.normal(0, noise, 3)).tolist(),
                    "size": (np.array(truth["size"]) * rng.uniform(0.7, 1.4, 3)).tolist(),
                    "rotation": (rotation * rng.choice([1.0, 1.0, -1.0, 2.5])).tolist(),
                    "velocity": rng.normal(0, 3, 2).tolist() if rng.random() > 0.05 else [float("nan")] * 2,
                    "detection_name": kind,
                    "detection_score": round(score, 1) if ties else score,
                    "attribute_name": str(rng.choice(known)),
                }
            )
    return [boxes[i] for i in rng.permutation(len(boxes))]


def write_task(root: Path, tables: Tables, results: dict[str, Any]) -> Path:
    """The data root on disk, and ``results.json`` beside it."""
    folder = root / VERSION
    folder.mkdir(parents=True)
    for name, rows in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(rows))
    (folder / "splits.json").write_text(json.dumps({SPLIT: list(SCENES)}))
    (root / "maps").mkdir()
    (root / "maps" / "empty.png").touch()
    (root / "results.json").write_text(json.dumps(results))
    return root


def truth_of(tables: Tables) -> dict[str, Any]:
    """The truth of the tables in the form that ``evaluate_detections`` takes, by plain loops."""
    rows = {name: {row["token"]: row for row in table} for name, table in tables.items()}
    name_of = {row["token"]: row["category_token"].removeprefix("c-") for row in tables["instance"]}
    poses = {row["sample_token"]: rows["ego_pose"][row["ego_pose_token"]] for row in tables["sample_data"]}
    truth: dict[str, Any] = {
        row["token"]: {"ego_translation": poses[row["token"]]["translation"], "boxes": []}
        for row in tables["sample"]
    }
    for row in tables["sample_annotation"]:
        name = name_of[row["instance_token"]]
        if name == "animal":
            continue
        truth[row["sample_token"]]["boxes"].append(
            {
                "translation": row["translation"],
                "size": row["size"],
                "rotation": row["rotation"],
                "velocity": _velocity(row, rows),
                "detection_name": name,
                "attribute_name": row["attribute_tokens"][0].removeprefix("a-") if row["attribute_tokens"] else "",
                "num_pts": row["num_lidar_pts"] + row["num_radar_pts"],
            }
        )
    return truth


def _velocity(row: dict[str, Any], rows: dict[str, dict[str, Any]]) -> list[float] | None:
    first = rows["sample_annotation"][row["prev"] or row["token"]]
    last = rows["sample_annotation"][row["next"] or row["token"]]
    # In the official rounding.
    seconds = 1e-6 * rows["sample"][last["sample_token"]]["timestamp"]
    seconds -= 1e-6 * rows["sample"][first["sample_token"]]["timestamp"]
    if first is last or seconds > (3.0 if row["prev"] and row["next"] else 1.5):
        return None
    return [(last["translation"][i] - first["translation"][i]) / seconds for i in range(2)]

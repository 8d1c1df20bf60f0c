"""Random evaluation tasks: official tables, a results file and the truth, with all special cases."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from made_nuscenes import pose, write
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.nuscenes.names import BICYCLE_RACK as RACK
from fcos_lidar_jax.data.nuscenes.names import CATEGORY_TO_CLASS
from fcos_lidar_jax.evaluation.boxes import ATTRIBUTE_INDEX, CLASS_ATTRIBUTES
from fcos_lidar_jax.evaluation.results import LIDAR_META

VERSION, SPLIT = "v1.0-mini", "mini_val"
SCENES = ("scene-0103", "scene-0916")
CATEGORIES = {name: category for category, name in CATEGORY_TO_CLASS.items()} | {RACK: RACK, "animal": "animal"}
GROWING = ("scene", "sample", "sample_data", "ego_pose", "instance", "sample_annotation")
DATA = {"calibrated_sensor_token": "mount", "fileformat": "pcd", "is_key_frame": True, "height": 0, "width": 0}
"""Fields shared by all rows of ``sample_data``."""

Rows = list[dict[str, Any]]
Tables = dict[str, Rows]


def random_boxes(rng: np.random.Generator, number: int) -> np.ndarray:
    """f32[number, 9], up to 60 m away."""
    boxes = rng.normal(0, [1, 1, 1, 0, 0, 0, 0, 3, 3], (number, 9))
    boxes[:, :2] = rng.uniform(-60, 60, (number, 2))
    boxes[:, 3:6] = rng.uniform(0.5, 5, (number, 3))
    boxes[:, 6] = rng.uniform(-np.pi, np.pi, number)
    return boxes.astype(np.float32)


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
    """Make tables and a results file.

    Args:
        samples: keyframes of each of the two scenes.
        objects: tracks of each scene.
        absent: classes without truth, which are still predicted.
        ties: round the scores, so that many are equal.
        noise: standard deviation of predicted centres, metres.
        empty: share of samples without predictions.
    """
    rng = np.random.default_rng(seed)
    mount = {"rotation": (np.array([0.7, 0, 0, 0.714]) / np.hypot(0.7, 0.714)).tolist()}
    mount |= {"translation": [0.9, 0.0, 1.8], "camera_intrinsic": []}
    log = dict.fromkeys(("logfile", "vehicle", "date_captured", "location"), "")
    tables: Tables = {
        "category": [{"token": f"c-{n}", "name": c, "description": ""} for n, c in CATEGORIES.items()],
        "attribute": [{"token": f"a-{a}", "name": a, "description": ""} for a in filter(None, ATTRIBUTE_INDEX)],
        "visibility": [],
        "sensor": [{"token": "lidar", "channel": "LIDAR_TOP", "modality": "lidar"}],
        "calibrated_sensor": [{"token": "mount", "sensor_token": "lidar", **mount}],
        "log": [{"token": "log", **log}],
        "map": [{"token": "map", "log_tokens": ["log"], "category": "semantic_prior", "filename": "maps/e.png"}],
        **{name: [] for name in GROWING},
    }
    kinds = [name for name in CATEGORIES if name not in absent]
    for s, scene in enumerate(SCENES):
        row = {"token": f"scene{s}", "log_token": "log", "name": scene, "description": "", "nbr_samples": samples}
        ends = {"first_sample_token": f"s{s}k0", "last_sample_token": f"s{s}k{samples - 1}"}
        tables["scene"].append(row | ends)
        where = np.array([600.0, 1600, 1]) + rng.normal(0, 100, 3)
        times = 1_530_000_000_123_456 + s * 10**9 + np.cumsum(rng.integers(400_000, 700_000, samples))
        egos = where + np.cumsum(rng.normal(0, 3, (samples, 3)), axis=0)
        tokens = ["", *(f"s{s}k{k}" for k in range(samples)), ""]
        for k in range(samples):
            before, token, after = tokens[k : k + 3]
            row = {"timestamp": int(times[k]), "prev": before, "next": after}
            tables["sample"].append({"token": token, "scene_token": f"scene{s}", **row})
            turn = Rotation.from_euler("zyx", [rng.uniform(-np.pi, np.pi), *rng.normal(0, 0.02, 2)])
            tables["ego_pose"].append(
                {"token": f"pose-{token}", "timestamp": int(times[k]), **pose(turn, egos[k])}
            )
            row |= {"prev": before and f"data-{before}", "next": after and f"data-{after}"}
            row |= {"token": f"data-{token}", "sample_token": token, "ego_pose_token": f"pose-{token}"}
            tables["sample_data"].append({**DATA, **row, "filename": f"samples/LIDAR_TOP/{token}.pcd.bin"})
        for o in range(objects):
            kind = str(rng.choice(kinds)) if o else RACK  # racks are few and large
            _add_track(tables, rng, f"s{s}o{o}", kind, s, egos, times)
    results, kind_of = {}, _kinds(tables)
    for sample in rng.permutation([row["token"] for row in tables["sample"]]).tolist():
        truths = [row for row in tables["sample_annotation"] if row["sample_token"] == sample]
        results[sample] = [] if rng.random() < empty else _predictions(rng, sample, truths, kind_of, noise, ties)
    return tables, {"meta": LIDAR_META, "results": results}


def _add_track(
    tables: Tables, rng: np.random.Generator, name: str, kind: str, s: int, egos: np.ndarray, times: np.ndarray
) -> None:
    """Add an object to some keyframes. If it is in only one, or after a gap, its velocity is unknown."""
    ends = {"nbr_annotations": 0, "first_annotation_token": "", "last_annotation_token": ""}
    tables["instance"].append({"token": name, "category_token": f"c-{kind}", **ends})
    # At distances within and beyond the range of the class.
    distance, angle = rng.uniform(5, 60), rng.uniform(-np.pi, np.pi)
    start = egos[0] + [distance * np.cos(angle), distance * np.sin(angle), rng.normal()]
    speed = np.append(rng.choice([0.0, 3.0]) * rng.normal(0, 1, 2), 0)
    size = np.array([8.0, 8.0, 4.0]) if kind == RACK else rng.uniform(0.4, 5, 3)
    present = np.flatnonzero(rng.random(len(times)) < rng.choice([0.3, 1.0]))
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
    known = CLASS_ATTRIBUTES.get(kind, ())
    tokens = ["", *(f"{name}-{k}" for k in present), ""]
    for i, k in enumerate(present):
        attributes = [f"a-{rng.choice(known)}"] if known and rng.random() < 0.8 else []
        where = start + speed * (times[k] - times[0]) / 1e6 + rng.normal(0, 0.05, 3)
        tables["sample_annotation"].append(
            {
                "token": tokens[i + 1],
                "sample_token": f"s{s}k{k}",
                "instance_token": name,
                "visibility_token": "",
                "attribute_tokens": attributes,
                "size": size.tolist(),
                **pose(turn, where),
                "prev": tokens[i],
                "next": tokens[i + 2],
                "num_lidar_pts": int(rng.integers(0, 4)) * int(rng.integers(0, 9)),
                "num_radar_pts": int(rng.integers(0, 2)),
            }
        )


def _kinds(tables: Tables) -> dict[str, str]:
    """Class of every instance."""
    return {row["token"]: row["category_token"].removeprefix("c-") for row in tables["instance"]}


def _predictions(
    rng: np.random.Generator, token: str, truths: Rows, kinds: dict[str, str], noise: float, ties: bool
) -> Rows:
    boxes = []
    for truth in (truth for truth in truths for _ in range(rng.integers(0, 4))):
        kind = kinds[truth["instance_token"]]
        if kind not in NUSCENES_CLASSES or rng.random() < 0.1:
            kind = str(rng.choice(["bicycle", "motorcycle", *NUSCENES_CLASSES]))
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
                "attribute_name": str(rng.choice((*CLASS_ATTRIBUTES[kind], ""))),
            }
        )
    return [boxes[i] for i in rng.permutation(len(boxes))]


def write_task(root: Path, tables: Tables, results: dict[str, Any]) -> Path:
    """Write the tables and ``results.json``; returns the data root."""
    write(root, tables, {}, VERSION, **{SPLIT: list(SCENES)})
    (root / "results.json").write_text(json.dumps(results))
    (root / "maps").mkdir()
    (root / "maps" / "e.png").touch()
    return root


def devkit_summary(data: Any, results: Path, split: str, out: Path) -> dict[str, Any]:
    """The official summary of a results file, written and read again; ``data`` is the devkit's ``NuScenes``."""
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.detection.evaluate import DetectionEval

    config = config_factory("detection_cvpr_2019")
    DetectionEval(data, config, str(results), split, str(out), verbose=False).main(0, False)
    return json.loads((out / "metrics_summary.json").read_text())


def truth_of(tables: Tables) -> dict[str, Any]:
    """Convert the tables to ground truth for ``evaluate_detections``, with plain loops."""
    rows = {name: {row["token"]: row for row in table} for name, table in tables.items()}
    kinds = _kinds(tables)
    truth: dict[str, Any] = {}
    for row in tables["sample_data"]:
        ego = rows["ego_pose"][row["ego_pose_token"]]
        truth[row["sample_token"]] = {"ego_translation": ego["translation"], "boxes": []}
    for row in tables["sample_annotation"]:
        if kinds[row["instance_token"]] == "animal":
            continue
        truth[row["sample_token"]]["boxes"].append(
            {
                **{name: row[name] for name in ("translation", "size", "rotation")},
                "velocity": _velocity(row, rows),
                "detection_name": kinds[row["instance_token"]],
                "attribute_name": "".join(row["attribute_tokens"]).removeprefix("a-"),
                "num_pts": row["num_lidar_pts"] + row["num_radar_pts"],
            }
        )
    return truth


def _velocity(row: dict[str, Any], rows: dict[str, dict[str, Any]]) -> list[float] | None:
    first = rows["sample_annotation"][row["prev"] or row["token"]]
    last = rows["sample_annotation"][row["next"] or row["token"]]
    # Rounded like the devkit does.
    seconds = 1e-6 * rows["sample"][last["sample_token"]]["timestamp"]
    seconds -= 1e-6 * rows["sample"][first["sample_token"]]["timestamp"]
    if first is last or seconds > (3.0 if row["prev"] and row["next"] else 1.5):
        return None
    return [(last["translation"][i] - first["translation"][i]) / seconds for i in range(2)]

"""KITTI's result files: detections in the frame of the rectified camera, with their boxes in the image."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.data.box_geometry import LIMITS
from fcos_lidar_jax.data.class_mapping import ClassMap, MappedFrames
from fcos_lidar_jax.data.frame import FrameSet, WrappedFrames
from fcos_lidar_jax.data.kitti import CLASSES, IMAGE_SIZE, KittiFrames, read_calibration
from fcos_lidar_jax.evaluation.json_io import expect_samples
from fcos_lidar_jax.evaluation.kitti import MIN_OVERLAP, evaluate_kitti, results_folder
from fcos_lidar_jax.evaluation.records import confident
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.geometry import wrap_angle
from fcos_lidar_jax.types import Detections

KITTI_SUMMARY = "metrics_kitti.json"

_NEAR_M = 0.1  # What is nearer to the camera is cut off before it is projected.
_SMALLEST_M = 1e-3


def write_kitti(out: Path, detections: Iterable[Detections], frames: FrameSet | None) -> dict[str, Any] | None:
    """Write detections as ``results_kitti/NAME.txt``, and KITTI's metric of them as ``metrics_kitti.json``.

    Classes match KITTI's types by name, in lower or upper case, after the class map that the frames were opened
    with. Boxes of other classes are not written, and only classes of the metric are evaluated. Other .txt files in
    ``results_kitti`` are removed.

    Returns:
        what :func:`~fcos_lidar_jax.evaluation.kitti.evaluate_kitti` returns, and ``left_out``: classes of the
        frames and of the metric without a counterpart. None for frames of other data: nothing is written, and an
        older ``metrics_kitti.json`` is removed.
    """
    summary, folder = out / KITTI_SUMMARY, out / "results_kitti"
    opened = _kitti_frames(frames)
    if frames is None or opened is None:
        summary.unlink(missing_ok=True)
        return None
    source, types = opened
    names = [frames.name(index) for index in range(len(frames))]
    for file in folder.glob("*.txt"):
        if file.stem not in names:
            file.unlink()
    kinds = np.array([types.get(name.lower(), "") for name in frames.classes])
    for name, found in zip(names, detections, strict=True):
        boxes, labels, scores = confident(found, 0.0)
        known = kinds[labels] != ""
        calibration = read_calibration(source.root / "training" / "calib" / f"{name}.txt")
        rows = boxes[known], kinds[labels[known]].tolist(), scores[known]
        write_result(folder / f"{name}.txt", *rows, calibration)
    classes = [name for name in MIN_OVERLAP if name in kinds]
    metrics = evaluate_kitti(folder, source.root / "training" / "label_2", classes=classes)
    others = [name for name, kind in zip(frames.classes, kinds, strict=True) if kind not in MIN_OVERLAP]
    metrics["left_out"] = others + [name for name in MIN_OVERLAP if name not in classes]
    atomic_write(out / KITTI_SUMMARY, json.dumps(metrics, indent=2))
    return metrics


def score_kitti(results: Path, frames: KittiFrames, *, of: str) -> dict[str, Any]:
    """KITTI's metric of a folder of result files, one for each of the frames, which ``of`` describes."""
    names = [frames.name(index) for index in range(len(frames))]
    expect_samples(sorted(file.stem for file in results_folder(results).glob("*.txt")), names, str(results), of=of)
    return evaluate_kitti(results, frames.root / "training" / "label_2")


def _kitti_frames(frames: FrameSet | None) -> tuple[KittiFrames, dict[str, str]] | None:
    """The frames of the data set, and name of a class in lower case -> KITTI's type; None for other data."""
    maps = []
    while isinstance(frames, WrappedFrames):
        maps += [frames.class_map] if isinstance(frames, MappedFrames) and frames.class_map else []
        frames = frames.frames
    return (frames, kitti_types(*reversed(maps))) if isinstance(frames, KittiFrames) else None


def kitti_types(*class_maps: ClassMap) -> dict[str, str]:
    """KITTI's types by class in lower case, after class maps from the types to the classes.

    >>> from fcos_lidar_jax.data.kitti import TO_NUSCENES
    >>> [kitti_types(TO_NUSCENES)[name] for name in ("car", "bicycle", "bus")]
    ['Car', 'Cyclist', 'Tram']
    """
    types: dict[str, str] = {}
    for kind in (*MIN_OVERLAP, *CLASSES):  # A class of several types stands for the one that is evaluated.
        name: str | None = kind
        for class_map in class_maps:
            name = None if name is None else class_map.get(name, name)
        if name is not None:
            types.setdefault(name.lower(), kind)
    return types


def write_result(
    path: Path,
    boxes: np.ndarray,
    types: Sequence[str],
    scores: np.ndarray,
    calibration: dict[str, np.ndarray],
) -> int:
    """Write the detections of a frame; boxes that are outside of the image, or
    larger than any object, are left out. Returns their number.

    Args:
        path: the benchmark's files are called ``000123.txt``.
        boxes: [m, >= 7], ``x, y, z, l, w, h, yaw`` in the Velodyne's frame.
        calibration: as ``fcos_lidar_jax.data.kitti.read_calibration`` returns it.

    >>> import tempfile
    >>> axes = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    >>> calibration = {"velo_to_rect": axes, "P2": np.array([[700, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1.0, 0]])}
    >>> file, car = Path(tempfile.mkdtemp()) / "000000.txt", np.array([[20, -2, -0.95, 4, 1.6, 1.5, 0]])
    >>> write_result(file, car, ["Car"], np.array([0.9]), calibration)
    0
    >>> file.read_text()  # type, truncation, occlusion, alpha, 4 pixels, h, w, l, x, y, z, rotation_y, score
    'Car -1 -1 -1.6705 638.18 186.36 708.89 246.11 1.5 1.6 4 2 1.7 20 -1.5708 0.9\\n'
    """
    boxes = np.asarray(boxes, np.float64)[:, :7]
    camera = to_camera(boxes, calibration["velo_to_rect"])
    image, visible = image_boxes(camera, calibration["P2"], IMAGE_SIZE)
    visible &= (np.abs(boxes) <= list(LIMITS.values())[:7]).all(axis=1)
    visible &= (boxes[:, 3:6] >= _SMALLEST_M).all(axis=1)
    alpha = wrap_angle(camera[:, 6] - np.arctan2(camera[:, 3], camera[:, 5]))
    lines = []
    for i in np.flatnonzero(visible).tolist():
        pixels = " ".join(f"{v:.2f}" for v in image[i])
        place = " ".join(f"{v:.6g}" for v in camera[i])
        lines.append(f"{types[i]} -1 -1 {alpha[i]:.4f} {pixels} {place} {scores[i]:.9g}\n")
    atomic_write(path, "".join(lines))
    return len(boxes) - len(lines)


def to_camera(boxes: np.ndarray, velo_to_rect: np.ndarray) -> np.ndarray:
    """Boxes ``x, y, z, l, w, h, yaw`` as labels f64[m, 7]: the inverse of
    :func:`~fcos_lidar_jax.data.kitti.to_lidar`."""
    turn, (length, width, height, yaw) = velo_to_rect[:3, :3], boxes[:, 3:7].T
    x, y, z = turn @ boxes[:, :3].T + velo_to_rect[:3, 3:]
    # The heading in the camera's ground plane that has this yaw for the Velodyne.
    across = turn[:, :2] @ np.stack([-np.sin(yaw), np.cos(yaw)])
    return np.stack([height, width, length, x, y + height / 2, z, np.arctan2(across[0], across[2])], -1)


def image_boxes(
    camera_boxes: np.ndarray, to_image: np.ndarray, image_size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Left, top, right, bottom in the image, clipped to it, of boxes of :func:`to_camera`; which have an area."""
    height, width, length, x, y, z, turn = camera_boxes.T[..., None]
    a = np.array([1, 1, -1, -1, 1, 1, -1, -1]) * length / 2
    b = np.array([1, -1, -1, 1, 1, -1, -1, 1]) * width / 2
    cos, sin = np.cos(turn), np.sin(turn)
    xyz = x + cos * a + sin * b, y - height * (np.arange(8) > 3), z + cos * b - sin * a
    points = np.stack([*xyz, np.ones_like(a)], -1) @ to_image.T  # [m, 8, 3]: pixels times depth, depth
    # A box that crosses the plane near the camera is cut there, and so are the lines between its corners.
    i, j = np.triu_indices(8, 1)
    depth = points[..., 2]
    crosses = (depth[:, i] < _NEAR_M) != (depth[:, j] < _NEAR_M)
    share = (_NEAR_M - depth[:, i]) / np.where(crosses, depth[:, j] - depth[:, i], 1.0)
    between = points[:, i] + share[..., None] * (points[:, j] - points[:, i])
    points = np.concatenate([points, between], axis=1)
    seen = np.concatenate([depth >= _NEAR_M, crosses], axis=1)[..., None]
    pixels = points[..., :2] / np.where(seen, points[..., 2:], 1.0)
    last = np.array(image_size) - 1.0
    low = np.clip(np.where(seen, pixels, np.inf).min(axis=1), 0.0, last)
    high = np.clip(np.where(seen, pixels, -np.inf).max(axis=1), 0.0, last)
    return np.concatenate([low, high], -1), (high > low).all(axis=1)

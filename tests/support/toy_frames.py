"""Small frame sets that worker processes can import."""

import dataclasses

import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.box_geometry import count_inside
from fcos_lidar_jax.data.frame import Frame, FrameSet, InMemoryFrames, WrappedFrames
from fcos_lidar_jax.sensors import NUSCENES_HDL32E


def toy_frame(seed: int, *, num_boxes: int = 12, num_points: int = 1500, columns: int = 5) -> Frame:
    """Boxes of all sizes among random points, a quarter of them near a box; three sweeps, the newest first."""
    rng = np.random.default_rng([seed, 99])
    boxes = np.zeros((num_boxes, 9), np.float32)
    boxes[:, :2] = rng.uniform(-40, 40, (num_boxes, 2))
    boxes[:, 3:6] = rng.uniform(0.5, 6, (num_boxes, 3))
    boxes[:, 6] = rng.uniform(-np.pi, np.pi, num_boxes)
    boxes[:, 7:] = rng.normal(0, 3, (num_boxes, 2))
    boxes[::5, 7:] = np.nan
    points = np.zeros((num_points, columns), np.float32)
    points[:, :3] = rng.uniform((-45, -45, -2), (45, 45, 2), (num_points, 3))
    inside = num_points // 4
    where = rng.integers(0, num_boxes, inside)
    points[:inside, :3] = boxes[where, :3] + rng.normal(0, 0.6, (inside, 3))
    points[:, 3] = rng.uniform(0, 255, num_points)
    points[:, 4] = rng.choice(np.array([0, 0.05, 0.1], np.float32), num_points)
    points = points[np.argsort(points[:, 4], kind="stable")]
    labels = rng.integers(0, 10, num_boxes).astype(np.int32)
    return Frame(points, boxes, labels, count_inside(points[points[:, 4] == 0], boxes))


@dataclasses.dataclass(frozen=True)
class ToyFrames(FrameSet):
    """Frames of :func:`toy_frame`."""

    size: int = 7
    classes, sensor = NUSCENES_CLASSES, NUSCENES_HDL32E

    def __len__(self) -> int:
        return self.size

    def frame(self, index: int) -> Frame:
        return toy_frame(index)

    def labels(self, index: int) -> np.ndarray:
        return toy_frame(index).labels

    def name(self, index: int) -> str:
        return f"toy {index}"

    def fingerprint(self) -> str:
        return f"{self.size} toys"


@dataclasses.dataclass(frozen=True)
class SceneFrames(WrappedFrames):
    """Frames grouped into scenes."""

    scenes: tuple[tuple[str, tuple[int, ...]], ...]
    source: str = "f"

    def __len__(self) -> int:
        return sum(len(indices) for _, indices in self.scenes)

    def _source(self, index: int) -> int:
        return [frame for _, indices in self.scenes for frame in indices][index]

    def scene(self, index: int) -> str:
        return [name for name, indices in self.scenes for _ in indices][index]

    def fingerprint(self) -> str:
        return self.source


class ListedFrames(InMemoryFrames):
    """Given frames with the ten nuScenes classes."""

    def __init__(self, frames: tuple[Frame, ...]) -> None:
        super().__init__(frames, NUSCENES_HDL32E, NUSCENES_CLASSES)

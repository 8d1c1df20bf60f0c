"""FCOS-LiDAR in JAX: 3D object detection on LiDAR range images with pure functions.

>>> import fcos_lidar_jax as fcos
>>> detector = fcos.load_detector("quickstart")
>>> frames = fcos.open_frames(format="simulated", sensor=detector.sensor)
>>> found = detector(frames.frame(0).points)
>>> found.boxes.shape == (len(found), 9)
True

``open_frames`` opens a data set; ``train``, ``predict`` and ``evaluate`` work on its frames. The modules of pure
functions, such as ``fcos.projection`` and ``fcos.nms``, are imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fcos_lidar_jax.inference import evaluate, load_detector, predict
    from fcos_lidar_jax.input_pipeline import open_frames
    from fcos_lidar_jax.presets import PRESETS
    from fcos_lidar_jax.sensors import load_sensor
    from fcos_lidar_jax.training import train

__version__ = "0.3.0.dev0"
__all__ = ["PRESETS", "evaluate", "load_detector", "load_sensor", "open_frames", "predict", "train"]

_HOME = {
    "PRESETS": "presets",
    "evaluate": "inference",
    "load_detector": "inference",
    "load_sensor": "sensors",
    "open_frames": "input_pipeline",
    "predict": "inference",
    "train": "training",
}
_MODULES = (
    *("assignment", "augment", "coding", "collectives", "config", "geometry", "iou", "locations", "losses", "nms"),
    *("presets", "projection", "sensors", "types"),
    *("centerpoint", "checkpoints", "data", "devices", "evaluation", "inference", "input_pipeline", "models"),
    *("refinement", "simulation", "training", "visualization"),
)


def __dir__() -> list[str]:
    return [*__all__, *_MODULES, "__version__"]


def __getattr__(name: str) -> Any:
    # Imported on first use, because importing the package must not load JAX.
    if name in _MODULES:
        return import_module(f"{__name__}.{name}")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)

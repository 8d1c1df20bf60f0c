"""A small folder of simulated clouds, annotated with its own three classes."""

import json
from pathlib import Path

import numpy as np

from fcos_lidar_jax.sensors import TINY, Sensor, sensor_to_json
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames

CLASSES = ("person", "post", "vehicle")
_OWN = {"pedestrian": "person", "traffic_cone": "post", "barrier": "post", "bicycle": None, "motorcycle": None}
"""New names of simulated classes, None for none; all other classes are vehicles."""


def make_folder(root: Path, *, train: int = 4, val: int = 2, sensor: Sensor = TINY, first_seed: int = 0) -> Path:
    """Write frames ``000``, ``001`` ... with splits ``train`` and ``val``. Persons have no velocity."""
    frames = SimulatedFrames(sensor, train + val, first_seed)
    for name in ("clouds", "boxes"):
        (root / name).mkdir(parents=True)
    (root / "sensor.json").write_text(json.dumps(sensor_to_json(sensor)))
    names = [f"{i:03d}" for i in range(len(frames))]
    (root / "splits.json").write_text(json.dumps({"train": names[:train], "val": names[train:]}))
    for i, name in enumerate(names):
        frame = frames.frame(i)
        points = frame.points[:, :4] / (1, 1, 1, sensor.intensity_scale)
        np.save(root / "clouds" / f"{name}.npy", points.astype(np.float32))
        boxes = []
        for box, label in zip(frame.boxes.tolist(), frame.labels, strict=True):
            own = _OWN.get(frames.classes[label], "vehicle")
            if own is not None:
                boxes.append({"label": own, "box": [*box[:7], None, None] if own == "person" else box})
        (root / "boxes" / f"{name}.json").write_text(json.dumps({"boxes": boxes}))
    return root

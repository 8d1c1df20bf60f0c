"""Two scenes, prepared, for tests of commands."""

import json
from pathlib import Path

from commands import command
from linear_network import linear_network
from tiny_run import CONFIG, SENSOR, untrained, weights

from fcos_lidar_jax.checkpoints import Checkpoint, save_checkpoint
from fcos_lidar_jax.sensors import sensor_to_json


def make_two_scenes(home: Path) -> Path:
    """Two scenes of six keyframes, one to train on and one to test on, with an index and objects.

    Their sensor and two checkpoints are beside them.
    """
    (home / "sensor.json").write_text(json.dumps(sensor_to_json(SENSOR)))
    command("synthesize --scenes 2 --keyframes 6 --out", home / "data", "--sensor", home / "sensor.json")
    command("prepare --num-sweeps 1 --data-root", home / "data")
    save_checkpoint(home / "start", Checkpoint(CONFIG, SENSOR, weights(), 1))
    with linear_network():
        save_checkpoint(home / "linear", Checkpoint(CONFIG, SENSOR, untrained(CONFIG, SENSOR), 1))
    return home / "data"

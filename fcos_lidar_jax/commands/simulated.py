"""Training on simulated streets that are made as they are asked for: every frame another one."""

import dataclasses
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import jax

from fcos_lidar_jax.commands.runs import Feed, Plan, Rhythm, Run
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.pipeline import make_batches
from fcos_lidar_jax.data.synthetic.frame_set import SimulatedFrames
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.types import TrainState

_UNSEEN = 1_000_000
"""Seeds of the test frames start here; training frames never get that far."""


def on_fresh_streets(config: Config) -> Config:
    """The configuration without what makes more of few frames: resampling, pasted objects, augmentation.

    >>> from fcos_lidar_jax.config import QUICKSTART
    >>> on_fresh_streets(QUICKSTART).augment is None
    True
    """
    return dataclasses.replace(config, copy_paste=None, class_balanced=False, augment=None)


def unseen_frames(sensor: Sensor, number: int) -> SimulatedFrames:
    """Streets that no training gets to see.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> unseen_frames(TINY, 3).first_seed
    1000000
    """
    return SimulatedFrames(sensor, number, _UNSEEN)


class SimulatedTraining:
    """A run on fresh simulated streets; the same arguments go on where it was stopped.

    Args:
        folder: of the run.
        config: from :func:`on_fresh_streets`.
        steps: of the run.
        seed: of the weights and the streets.
        rhythm: when to save and evaluate.
        tests: to evaluate on along the way.
    """

    def __init__(
        self, folder: Path, config: Config, *, steps: int, seed: int, rhythm: Rhythm, tests: SimulatedFrames | None
    ) -> None:
        """Nothing is written yet."""
        sensor = load_sensor(config.sensor)
        number = min(steps * config.optimizer.batch_size, _UNSEEN // 2)
        self.frames = SimulatedFrames(sensor, number, seed * number % (_UNSEEN - number))
        self.run = Run(folder, Plan(config, sensor, steps, seed, {"simulated": number}), rhythm, tests)

    def train(self) -> TrainState:
        """Train to the end on one device, or until Ctrl-C or SIGTERM; see :meth:`Run.train`."""
        resume = (self.run.folder / "run.json").exists()
        return self.run.train(self._feed(), resume=resume, devices=jax.devices()[:1])

    def _feed(self) -> Feed:
        plan = self.run.plan

        def feed(first_step: int) -> AbstractContextManager[Any]:
            return make_batches(
                self.frames,
                plan.config,
                seed=plan.seed,
                num_steps=plan.num_steps,
                first_step=first_step,
                threads=1,
            )

        return feed

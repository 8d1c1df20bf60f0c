"""Frames that other processes simulate while a detector learns from them.

A GPU takes less time for a training step than a core for the simulation of its frames. Several processes therefore
simulate, and the training repeats the frames that there are.
"""

import contextlib
import dataclasses
import functools
import multiprocessing
import os
import time
from collections.abc import Iterator

import jax

from experiments.cached import CachedFrames
from fcos_lidar_jax.data.frame import WrappedFrames
from fcos_lidar_jax.workers import end_with_parent

_FRESH_S = 2.0  # The folder is listed anew after this time.
_NICE = 5  # Simulation yields to the preparation of batches.


@dataclasses.dataclass(frozen=True)
class PooledFrames(WrappedFrames):
    """The frames that a cache contains so far: any index stands for one of them, so frames repeat.

    The frame of an index changes while the cache grows, so a training from a pool cannot be repeated bit for bit.
    """

    frames: CachedFrames
    least: int = 64  # Number of frames to wait for.

    def _source(self, index: int) -> int:
        while len(made := _made(self.frames, time.monotonic() // _FRESH_S)) < min(self.least, len(self.frames)):
            time.sleep(_FRESH_S / 10)
        return made[index % len(made)]


@functools.lru_cache(maxsize=1)
def _made(frames: CachedFrames, moment: float) -> list[int]:
    """Indices of the frames in the cache, listed once for each ``moment``."""
    return frames.made()


@contextlib.contextmanager
def simulating(frames: CachedFrames, processes: int) -> Iterator[None]:
    """Context manager in which a number of processes fill a cache in the order of its frames.

    A full cache starts no process.
    """
    processes = processes if len(frames.made()) < len(frames) else 0
    spawn = multiprocessing.get_context("spawn")
    started = [spawn.Process(target=_fill, args=(frames, first, processes)) for first in range(processes)]
    for process in started:
        process.start()
    try:
        yield
    finally:
        for process in started:
            process.terminate()
        for process in started:
            process.join()


def _fill(frames: CachedFrames, first: int, step: int) -> None:
    end_with_parent()
    os.nice(_NICE)
    jax.config.update("jax_platforms", "cpu")
    for index in range(first, len(frames), step):
        frames.truth(index)

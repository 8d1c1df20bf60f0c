"""The pool of frames: only frames that exist are drawn, and processes fill it."""

import multiprocessing

import pytest

from experiments.cached import CachedFrames
from experiments.pool import PooledFrames, simulating
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames

FRAMES = SimulatedFrames(TINY, 6)


@pytest.fixture
def cache(tmp_path):
    return CachedFrames(FRAMES, tmp_path / "streets")


def test_frames_that_exist_are_repeated_and_new_ones_are_found(cache, monkeypatch):
    monkeypatch.setattr("experiments.pool._FRESH_S", 1e-4)
    for index in (1, 4):
        cache.frame(index)
    pool = PooledFrames(cache, least=2)
    assert len(pool) == len(FRAMES)
    assert [pool.name(index) for index in range(5)] == [FRAMES.name(i) for i in (1, 4, 1, 4, 1)]
    assert (pool.frame(3).points == FRAMES.frame(4).points).all()
    assert cache.made() == [1, 4]
    cache.frame(5)
    assert pool.name(5) == FRAMES.name(5)


@pytest.mark.slow
def test_processes_fill_the_pool_and_end(cache):
    with simulating(cache, 1):
        pool = PooledFrames(cache, least=3)
        assert (pool.frame(0).points == FRAMES.frame(0).points).all()
        assert len(cache.made()) >= 3
    assert not multiprocessing.active_children()

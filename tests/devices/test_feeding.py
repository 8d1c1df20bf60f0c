"""Transfer of batches: the same batches in order, ahead of time, and no thread left behind."""

import dataclasses
import os
import signal
import threading
import time

import jax
import numpy as np
import pytest
from commands import wait_until
from toy_frames import ToyFrames

from fcos_lidar_jax.devices.feeding import feed
from fcos_lidar_jax.devices.mesh import make_mesh
from fcos_lidar_jax.input_pipeline.loader import make_batches
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.types import HostBatch

PLAIN = dataclasses.replace(QUICKSTART, copy_paste=None, class_balanced=False, max_points=3000)


@pytest.fixture
def mesh():
    return make_mesh(jax.devices()[:1])


def host(step: int) -> HostBatch:
    return HostBatch({"x": np.full((2, 3), step, np.int32)}, {"step": step}, (f"{step} a", f"{step} b"))


def feed_threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == "feed"]


def test_batches_arrive_on_the_devices_in_order(mesh):
    with feed((host(step) for step in range(7)), mesh) as stream:
        batches = list(stream)
        assert next(stream, None) is None
    for step, each in enumerate(batches):
        assert each.batch["x"].devices() == {jax.devices()[0]}
        np.testing.assert_array_equal(each.batch["x"], host(step).batch["x"])
        assert (each.counts, each.names) == (host(step).counts, host(step).names)
    assert feed_threads() == []


def test_at_most_the_given_number_of_batches_waits(mesh):
    requested = []
    source = (requested.append(step) or host(step) for step in range(20))
    with feed(source, mesh, ahead=2) as stream:
        for taken in range(3):
            wait_until(lambda: len(requested) == taken + 2)  # noqa: B023
            time.sleep(0.05)
            assert len(requested) == taken + 2
            next(stream)
    assert feed_threads() == []


@pytest.mark.parametrize("taken", [0, 1])
def test_leaving_early_leaves_no_thread(mesh, taken):
    with feed((host(step) for step in range(100)), mesh) as stream:
        for _ in range(taken):
            next(stream)
    assert feed_threads() == []
    with pytest.raises(ArithmeticError, match="step 3"), feed(map(host, range(100)), mesh) as stream:
        raise ArithmeticError("step 3: not finite")
    assert feed_threads() == []


def test_an_error_of_the_loader_reaches_the_caller_after_the_batches_before_it(mesh):
    def source():
        yield host(0)
        raise ValueError("sweeps/1.bin: got 3 bytes, expected 20")

    with feed(source(), mesh) as stream:
        assert next(stream).names == ("0 a", "0 b")
        with pytest.raises(ValueError, match=r"^sweeps/1.bin: got 3 bytes, expected 20$"):
            next(stream)
        assert next(stream, None) is None
    assert feed_threads() == []


class HangingFrames(ToyFrames):
    """Frames of the second batch wait for an event."""

    def frame(self, index):
        reading.append(index)
        if len(reading) > PLAIN.optimizer.batch_size:
            go_on.wait(20)
        return super().frame(index)


go_on, reading = threading.Event(), list[int]()


@pytest.mark.parametrize("threads", [0, 1])
def test_ctrl_c_interrupts_the_wait_for_a_hanging_thread(mesh, threads):
    """Leaving the loader must not replace the interruption by another error."""
    go_on.clear()
    reading.clear()
    interrupt = threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT))
    prepared = make_batches(HangingFrames(), PLAIN, seed=0, num_steps=6, threads=threads)

    def leave_early():
        with prepared as batches, feed(batches, mesh, ahead=1) as stream:
            next(stream)
            wait_until(lambda: len(reading) > PLAIN.optimizer.batch_size)
            interrupt.start()

    try:
        with pytest.raises(KeyboardInterrupt):
            leave_early()
    finally:
        go_on.set()
    wait_until(lambda: not feed_threads())


def test_host_memory_may_be_reused_while_a_batch_is_alive(mesh):
    """At an address where JAX would use the memory itself for an array on a CPU."""
    memory = np.empty(4096 + 64, np.uint8)
    start = -memory.ctypes.data % 64
    x = memory[start : start + 4096].view(np.float32).reshape(4, 256)

    def source():
        for step in range(6):
            x[:] = step
            yield HostBatch({"x": x}, {}, ())

    with feed(source(), mesh) as stream:
        batches = list(stream)
    assert [np.unique(each.batch["x"]).tolist() for each in batches] == [[step] for step in range(6)]


@pytest.mark.slow
def test_batches_in_shared_memory_of_workers_outlive_it(mesh):
    options = {"seed": 0, "num_steps": 6, "threads": 0}
    with make_batches(ToyFrames(), PLAIN, **options) as batches:
        expected = [each.batch for each in batches]
    kinds = set()

    def noted(batches):
        for each in batches:
            kinds.add(type(each.batch.points).__name__)
            yield each
            del each

    with (
        make_batches(ToyFrames(), PLAIN, workers=1, **options) as batches,
        feed(noted(batches), mesh) as stream,
    ):
        fed = [each.batch for each in stream]
    assert kinds == {"SharedMemoryArray"}
    for a, b in zip(jax.tree.leaves(fed), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)

"""The feed of the devices: the same batches in the same order, ahead of time, and no thread left behind."""

import dataclasses
import os
import signal
import threading
import time

import jax
import numpy as np
import pytest
from toy_frames import ToyFrames

from fcos_lidar_jax.devices import feeding
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


def left() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == "feed"]


def wait_until(holds) -> None:
    deadline = time.monotonic() + 20
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_batches_arrive_on_the_devices_in_their_order(mesh):
    with feed((host(step) for step in range(7)), mesh) as stream:
        found = list(stream)
        assert next(stream, None) is None
    for step, each in enumerate(found):
        assert each.batch["x"].devices() == {jax.devices()[0]}
        np.testing.assert_array_equal(each.batch["x"], host(step).batch["x"])
        assert (each.counts, each.names) == (host(step).counts, host(step).names)
    assert left() == []


@pytest.mark.parametrize("ahead", [1, 2])
def test_so_many_wait_and_no_more(mesh, ahead):
    asked = []
    source = (asked.append(step) or host(step) for step in range(20))
    with feed(source, mesh, ahead=ahead) as stream:
        for taken in range(3):
            wait_until(lambda: len(asked) == taken + ahead)  # noqa: B023
            time.sleep(0.05)
            assert len(asked) == taken + ahead
            next(stream)
    assert left() == []


@pytest.mark.parametrize("taken", [0, 1])
def test_a_consumer_that_stops_early_leaves_no_thread(mesh, taken):
    with feed((host(step) for step in range(100)), mesh) as stream:
        for _ in range(taken):
            next(stream)
    assert left() == []
    with pytest.raises(ArithmeticError, match="step 3"), feed(map(host, range(100)), mesh) as stream:
        raise ArithmeticError("step 3: not finite")
    assert left() == []


def test_the_loader_s_error_reaches_the_caller_after_the_batches_before_it(mesh):
    def source():
        yield host(0)
        raise ValueError("sweeps/1.bin: got 3 bytes, expected 20")

    with feed(source(), mesh) as stream:
        assert next(stream).names == ("0 a", "0 b")
        with pytest.raises(ValueError, match=r"^sweeps/1.bin: got 3 bytes, expected 20$"):
            next(stream)
        assert next(stream, None) is None
    assert left() == []


def test_ctrl_c_interrupts_the_wait_for_a_batch(mesh):
    go_on = threading.Event()

    def source():
        yield host(0)
        os.kill(os.getpid(), signal.SIGINT)
        go_on.wait(20)
        yield host(1)

    with feed(source(), mesh, ahead=1) as stream:
        with pytest.raises(KeyboardInterrupt):
            list(stream)
        go_on.set()
    assert left() == []


class HangingFrames(ToyFrames):
    """The frames of the second batch come when they are told to."""

    def frame(self, index):
        reading.append(index)
        if len(reading) > PLAIN.optimizer.batch_size:
            go_on.wait(20)
        return super().frame(index)


go_on, reading = threading.Event(), list[int]()


@pytest.mark.parametrize("threads", [0, 1])
def test_ctrl_c_interrupts_the_wait_for_a_thread_that_hangs(mesh, threads):
    """Leaving the loader as well does not replace it by a failure of its own."""
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
    wait_until(lambda: not left())


def test_memory_on_loan_may_be_used_again_while_a_batch_is_alive(mesh):
    """At an address where JAX would take the memory itself for the array, on a CPU."""
    memory = np.empty(4096 + 64, np.uint8)
    start = -memory.ctypes.data % 64
    x = memory[start : start + 4096].view(np.float32).reshape(4, 256)

    def source():
        for step in range(6):
            x[:] = step
            yield HostBatch({"x": x}, {}, ())

    with feed(source(), mesh) as stream:
        found = list(stream)
    assert [np.unique(each.batch["x"]).tolist() for each in found] == [[step] for step in range(6)]


def test_on_a_cpu_the_one_copy_is_the_array(mesh, monkeypatch):
    copies, copy = [], feeding._aligned_copy
    monkeypatch.setattr(feeding, "_aligned_copy", lambda array: copies.append(copy(array)) or copies[-1])
    given = [np.arange(24, dtype=dtype).reshape(4, -1) for dtype in (np.uint8, np.uint16, np.float32, np.int32)]
    with feed([HostBatch({"x": given}, {}, ())], mesh) as stream:
        [found] = stream
    for array, made, source in zip(found.batch["x"], copies, given, strict=True):
        assert array.addressable_data(0).unsafe_buffer_pointer() == made.ctypes.data
        assert not np.shares_memory(made, source)
        np.testing.assert_array_equal(array, source)


def test_batches_that_workers_lend_stay_as_they_are(mesh):
    """All alive at once, when the workers' memory is long freed; and that is the memory they came in."""
    options = {"seed": 0, "num_steps": 6, "threads": 0}
    with make_batches(ToyFrames(), PLAIN, **options) as batches:
        expected = [each.batch for each in batches]
    kinds = set()

    def seen(batches):
        for each in batches:
            kinds.add(type(each.batch.points).__name__)
            yield each
            del each

    with (
        make_batches(ToyFrames(), PLAIN, workers=1, lend=True, **options) as batches,
        feed(seen(batches), mesh) as stream,
    ):
        found = [each.batch for each in stream]
    assert kinds == {"SharedMemoryArray"}
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)

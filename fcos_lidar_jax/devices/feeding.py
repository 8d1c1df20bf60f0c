"""The feed of the devices: batches are transferred in a background thread while the step before them runs."""

import contextlib
import dataclasses
import queue
import threading
from collections.abc import Iterable, Iterator

import jax
import numpy as np
from jax.sharding import Mesh

from fcos_lidar_jax.devices.mesh import shard_batch
from fcos_lidar_jax.types import HostBatch

_ALIGNMENT = 64  # Bytes; an array at another address is copied again by JAX.


@contextlib.contextmanager
def feed(batches: Iterable[HostBatch], mesh: Mesh, *, ahead: int = 2) -> Iterator[Iterator[HostBatch]]:
    """Batches split over the devices of a mesh, in their order, transferred in a background thread.

    The memory of a batch is not read any more when the next one is asked for, so it may be on loan. On
    accelerators the transfer is the only copy; on a CPU, where JAX would go on using the memory, one copy is made.

    Args:
        batches: NumPy arrays of this process's rows; only the thread takes from them.
        mesh: of the devices.
        ahead: batches that wait on the devices at most, beside the one that was taken last.

    Yields:
        an iterator over the batches as device arrays. What ``batches`` raises is raised there. Leaving the context
        stops the thread, which finishes the batch it is at; batches that wait are dropped.

    >>> from fcos_lidar_jax.devices.mesh import make_mesh
    >>> mesh = make_mesh(jax.devices()[:1])
    >>> given = (HostBatch({"x": np.full((2, 3), step)}, {}, ("a", "b")) for step in range(3))
    >>> with feed(given, mesh) as stream:
    ...     [int(host.batch["x"].sum()) for host in stream]
    [0, 6, 12]
    """
    ready: queue.SimpleQueue[HostBatch | BaseException | None] = queue.SimpleQueue()
    room, stop = threading.Semaphore(ahead), threading.Event()

    def transfer() -> None:
        try:
            source = iter(batches)
            while room.acquire() and not stop.is_set():
                host = next(source, None)
                ready.put(None if host is None else _transferred(host, mesh))
                if host is None:
                    return
                del host  # which may be on loan, before the wait for room
        except BaseException as error:
            ready.put(error)

    def taken() -> Iterator[HostBatch]:
        while (host := ready.get()) is not None:
            if isinstance(host, BaseException):
                raise host
            room.release()
            held = [host]
            del host  # The caller alone keeps it: it fills memory of the devices.
            yield held.pop()

    thread = threading.Thread(target=transfer, name="feed", daemon=True)
    thread.start()
    try:
        yield taken()
    finally:
        stop.set()
        room.release()
        thread.join()


def _transferred(host: HostBatch, mesh: Mesh) -> HostBatch:
    batch = host.batch
    if mesh.devices.flat[0].platform == "cpu":
        batch = jax.tree.map(_aligned_copy, batch)
    return dataclasses.replace(host, batch=jax.block_until_ready(shard_batch(batch, mesh)))


def _aligned_copy(array: np.ndarray) -> np.ndarray:
    """A copy that JAX takes for a CPU device as it is, instead of making another."""
    memory = np.empty(array.nbytes + _ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    copy = memory[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    np.copyto(copy, array)
    return copy

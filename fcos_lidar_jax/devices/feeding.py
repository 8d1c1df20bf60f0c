"""Transfer of batches to the devices in a background thread, while the previous step runs."""

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


@contextlib.contextmanager
def feed(batches: Iterable[HostBatch], mesh: Mesh, *, ahead: int = 2) -> Iterator[Iterator[HostBatch]]:
    """Split batches over the devices of a mesh, in order, in a background thread.

    A batch is not read after the next one has been requested, so its memory may be reused.

    Args:
        batches: NumPy arrays with the rows of this process; only the thread may iterate over them.
        ahead: maximum number of batches waiting on the devices, besides the last one that was taken.

    Yields:
        iterator over the batches as device arrays, which raises the errors of ``batches``. Leaving the context
        stops the thread after its current batch and drops waiting batches.

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
                del host  # its memory may be reused while this thread waits
        except BaseException as error:
            ready.put(error)

    def taken() -> Iterator[HostBatch]:
        while (host := ready.get()) is not None:
            if isinstance(host, BaseException):
                raise host
            room.release()
            held = [host]
            del host  # Only the caller keeps a reference: the batch occupies memory of the devices.
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
        batch = jax.tree.map(np.array, batch)  # JAX would keep using the memory
    return dataclasses.replace(host, batch=jax.block_until_ready(shard_batch(batch, mesh)))

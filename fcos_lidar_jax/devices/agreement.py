"""Agreement between processes: all continue, or none does."""

import contextlib
from collections.abc import Iterator

import jax
import numpy as np
from jax.experimental import multihost_utils


@contextlib.contextmanager
def agreed(failed: str) -> Iterator[None]:
    """Continue after the block only if no process failed in it.

    All processes enter the same blocks in the same order, and must not wait for each other inside a block.

    Args:
        failed: what a failing process could not do, for the messages of the other processes.

    Raises:
        OSError: another process failed. The failing process raises its own error.
    """
    error: BaseException | None = None
    try:
        yield
    except BaseException as failure:  # including interruptions
        error = failure
    if jax.process_count() > 1:
        try:
            succeeded = multihost_utils.process_allgather(np.array(error is None))
            if error is None and not succeeded.all():
                error = OSError(f"process {int(np.argmin(succeeded))}: {failed}, see its output")
        except Exception:  # Another process ended. The failure of this process, if any, says more.
            if error is None:
                raise
    if error is not None:
        raise error


def check_same(checksum: str, what: str) -> None:
    """Refuse processes with different inputs, described by ``what``, from a hexadecimal checksum of the inputs.

    Raises:
        ValueError: on all processes; names the first process that differs from process 0.
    """
    if jax.process_count() == 1:
        return
    checksums = multihost_utils.process_allgather(np.frombuffer(bytes.fromhex(checksum), np.uint8))
    differs = (checksums != checksums[0]).any(axis=1)
    if differs.any():
        raise ValueError(f"process {int(np.argmax(differs))}: {what}: different from process 0, expected the same")

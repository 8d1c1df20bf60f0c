"""Agreement between processes: they continue together, or none does."""

import contextlib
from collections.abc import Iterator

import jax
import numpy as np
from jax.experimental import multihost_utils


@contextlib.contextmanager
def agreed(failed: str) -> Iterator[None]:
    """Let all processes go on after the block, or none: where one fails in it, the others stop behind it.

    Every process enters the same blocks in the same order, and within them does nothing that waits for another.

    Args:
        failed: what a process could not do if it fails, for the others to say.

    Raises:
        OSError: another process failed; the one that did raises its own error.

    >>> with agreed("cannot read"):
    ...     value = 1
    """
    error: BaseException | None = None
    try:
        yield
    except BaseException as failure:  # an interruption, too
        error = failure
    if jax.process_count() > 1:
        try:
            fine = multihost_utils.process_allgather(np.array(error is None))
            if error is None and not fine.all():
                error = OSError(f"process {int(np.argmin(fine))}: {failed}, see what it says")
        except Exception:  # Another process ended: what is known of this one's own failure says more.
            if error is None:
                raise
    if error is not None:
        raise error


def check_same(checksum: str, what: str) -> None:
    """Refuse to work with processes that do not start from the same.

    Args:
        checksum: of what shall be the same, hexadecimal.
        what: that is.

    Raises:
        ValueError: on all processes, naming the first that differs from the first one.

    >>> check_same("cae66941", "frames")
    """
    if jax.process_count() == 1:
        return
    found = multihost_utils.process_allgather(np.frombuffer(bytes.fromhex(checksum), np.uint8))
    differs = (found != found[0]).any(axis=1)
    if differs.any():
        raise ValueError(
            f"process {int(np.argmax(differs))}: {what}: got another than process 0, expected the same"
        )

"""Work that several processes of one machine could begin, and only one should."""

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def claim(path: Path, *, wait: bool = False) -> Iterator[bool]:
    """Hold a file against other processes, as long as this one lives at most.

    Args:
        path: of the file; made if missing.
        wait: until nobody else holds it.

    Returns:
        within the context, whether it is held; always with ``wait``.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "cell.lock"
    >>> with claim(file) as mine, claim(file) as again:
    ...     (mine, again)
    (True, False)
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
        else:
            yield True

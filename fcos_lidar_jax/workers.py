"""Worker processes that must not outlive their parent process."""

import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """Make this worker process exit when its parent exits or is killed. Call once, in the worker."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()

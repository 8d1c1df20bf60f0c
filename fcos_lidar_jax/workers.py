"""Worker processes, which must not outlive their parent process."""

import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """Have this worker process exit as soon as its parent has, even where the parent was killed.

    Called in the worker, once.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()

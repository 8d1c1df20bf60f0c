"""Worker processes, which must not outlive the process that they work for."""

import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """End this worker process, which calls it, when its parent has ended, which may have been killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()

"""Jobs in worker processes, which never outlive their parent process."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any


def run_jobs(work: Callable[[Any, Any], Any], shared: Any, jobs: Sequence[Any], workers: int) -> Iterator[Any]:
    """Yield ``work(shared, job)`` of each job as it finishes, in worker processes or, for one, in this process.

    An error or an interruption kills the workers at once, so jobs must write atomically.

    Args:
        work: a function of a module.
        shared: sent once to each worker.

    Raises:
        OSError: a worker died.
    """
    if min(workers, len(jobs)) <= 1:
        yield from (work(shared, job) for job in jobs)
        return
    context, others = multiprocessing.get_context("spawn"), set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(min(workers, len(jobs)), context, initializer=_begin, initargs=(work, shared))
    # The workers inherit the mask, so that only this process answers signals.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        futures = [pool.submit(_work, job) for job in jobs]
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    try:
        yield from (future.result() for future in as_completed(futures))
    except BaseException as error:
        for process in set(multiprocessing.active_children()) - others:
            process.kill()
        if isinstance(error, BrokenProcessPool):
            raise OSError("a worker process died, possibly out of memory: try fewer workers") from None
        raise
    finally:
        pool.shutdown(cancel_futures=True)


_given: tuple[Callable[[Any, Any], Any], Any] | None = None  # in worker processes: work and shared


def _begin(work: Callable[[Any, Any], Any], shared: Any) -> None:
    import jax

    global _given
    _given = work, shared
    jax.config.update("jax_platforms", "cpu")  # accelerators are not needed, and may be in use
    end_with_parent()


def _work(job: Any) -> Any:
    assert _given is not None
    work, shared = _given
    return work(shared, job)


def end_with_parent() -> None:
    """Make this worker process exit when its parent exits or is killed. Call once, in the worker."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()

"""The Python loop around the training step: progress, finite checks, pauses, and a clean stop."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Sequence

import jax
import numpy as np

from fcos_lidar_jax.progress import Progress, tell
from fcos_lidar_jax.training.step import TrainStep
from fcos_lidar_jax.types import HostBatch, TrainState

Record = dict[str, float | list[float]]


class NonFiniteLossError(ArithmeticError):
    """A loss or gradient is not finite; the message names the step, the losses and the samples."""


def fit(
    step: TrainStep,
    state: TrainState,
    batches: Iterable[HostBatch],
    *,
    num_steps: int,
    report: Callable[[int, Record], None] | None = None,
    pause_at: Callable[[int], bool] = lambda _: False,
    pause: Callable[[int, TrainState], None] | None = None,
    stopping: Callable[[int], bool] = lambda _: False,
    log_every_s: float = 10.0,
) -> TrainState:
    """Run the training step over batches and return the last state.

    Metrics are read one step late, so that the host never waits for the device. Before a pause and at the end, all
    metrics have been read, so a state that is saved there has finite losses.

    Args:
        step: compiled ``(state, batch) -> (state, metrics)``; may donate the buffers of the state.
        state: initial state; the run ends when ``state.step`` reaches ``num_steps``.
        batches: at least one batch per remaining step; the time to get one is recorded as ``waiting_seconds``.
        report: called after every step with the number of steps and the metrics of the last one.
        pause_at: called with the number of steps; returns whether to pause.
        pause: called at a pause with the number of steps and the state; do not keep a reference to the state: its
            buffers are donated.
        stopping: called after every step with the number of steps; returns whether to stop.
        log_every_s: seconds between progress lines on standard error.

    Raises:
        NonFiniteLossError: a loss or gradient is not finite.

    >>> def count(state, batch):
    ...     return dataclasses.replace(state, step=state.step + 1), {"loss/total": 1.0, "positive_iou": 0.5}
    >>> state = TrainState(np.int32(0), {}, {}, (), None, jax.random.key(0))
    >>> batches = [HostBatch(None, {}, (f"frame {i}",)) for i in range(3)]
    >>> int(fit(count, state, batches, num_steps=3).step)
    3
    """
    done = int(state.step)
    reader = _Reader(Progress("steps", num_steps, every_s=log_every_s), report)
    iterator = iter(batches)
    while done < num_steps:
        began = time.monotonic()
        host = next(iterator)
        waited = time.monotonic() - began
        state, metrics = step(state, host.batch)
        host = dataclasses.replace(host, batch=None)  # frees the memory for the next batch
        done += 1
        reader.read()
        reader.unread = done, host, metrics, waited
        stop, pausing = stopping(done), pause_at(done)
        if stop or pausing or done == num_steps:
            reader.read()
        if pause is not None and pausing:
            pause(done, state)
            reader.before = time.monotonic()
        if stop:
            break
    return state


class _Reader:
    """Reads the metrics of the last step, once they are asked for, and reports them."""

    def __init__(self, progress: Progress, report: Callable[[int, Record], None] | None) -> None:
        self.progress, self.report, self.before = progress, report, time.monotonic()
        self.unread: tuple[int, HostBatch, dict[str, jax.Array], float] | None = None

    def read(self) -> None:
        if self.unread is None:
            return
        number, host, metrics, waited = self.unread
        self.unread = None
        record: Record = {name: np.asarray(value).tolist() for name, value in metrics.items()}
        now = time.monotonic()
        record |= {"seconds": now - self.before, "waiting_seconds": waited, **host.counts}
        for what in ("points", "boxes"):
            if lost := host.counts.get(count := f"truncated_{what}"):
                told = f"step {number}: {lost} {what} left out, since samples have more than max_{what}"
                tell(f"note: {told}; the metrics of each step count them as {count}", once=count)
        self.before = now
        _check_finite(number, record, host.names)
        iou = f"  IoU {record['positive_iou']:.2f}" if "positive_iou" in record else ""
        self.progress.show(number, f"loss {record['loss/total']:.3f}{iou}")
        if self.report is not None:
            self.report(number, record)


def _check_finite(number: int, record: Record, names: Sequence[str]) -> None:
    checked = {k: v for k, v in record.items() if k.startswith("loss/") or k == "gradient_norm"}
    bad = {k: v for k, v in checked.items() if not isinstance(v, float) or not math.isfinite(v)}
    if bad:
        parts = ", ".join(f"{name.removeprefix('loss/')} {value}" for name, value in bad.items())
        raise NonFiniteLossError(f"step {number}: not finite: {parts}; samples: {', '.join(names)}")

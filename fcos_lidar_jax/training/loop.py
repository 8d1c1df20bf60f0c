"""The Python loop around the step: progress, finite checks, a clean stop."""

import math
from collections.abc import Callable, Iterable

import jax
import numpy as np

from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.training.step import TrainStep
from fcos_lidar_jax.types import Batch, TrainState

Record = dict[str, float | list[float]]


class NonFiniteLossError(ArithmeticError):
    """The loss stopped being a number; the message names the step and the parts."""


def fit(
    step: TrainStep,
    state: TrainState,
    batches: Iterable[Batch],
    *,
    num_steps: int,
    report: Callable[[int, TrainState, Record], None] | None = None,
    log_every_s: float = 10.0,
) -> tuple[TrainState, list[Record]]:
    """Run the step over batches.

    Metrics are read one step late, so that the host never waits for the device.

    Args:
        step: jitted ``(state, batch) -> (state, metrics)``.
        state: where to begin; the run ends when ``state.step`` is ``num_steps``.
        batches: at least as many as there are steps left.
        num_steps: of the whole run.
        report: called with (steps done, state, metrics of the last of them) after every step.
        log_every_s: seconds between two progress lines on standard error.

    Returns:
        the last state and the metrics of every step.

    Raises:
        NonFiniteLossError: with the step's number and the parts of the loss.
    """
    done = int(state.step)
    progress = Progress("steps", num_steps, every_s=log_every_s)
    records: list[Record] = []
    waiting: tuple[int, TrainState, dict[str, jax.Array]] | None = None

    def read() -> None:
        assert waiting is not None
        number, at, metrics = waiting
        record: Record = {name: np.asarray(value).tolist() for name, value in metrics.items()}
        total = record["loss/total"]
        if not isinstance(total, float) or not math.isfinite(total):
            parts = ", ".join(f"{k[5:]} {v}" for k, v in record.items() if k.startswith("loss/"))
            raise NonFiniteLossError(f"step {number}: the loss is not finite ({parts})")
        records.append(record)
        progress.show(number, f"loss {total:.3f}  IoU {record['positive_iou']:.2f}")
        if report is not None:
            report(number, at, record)

    for batch in batches:
        if done >= num_steps:
            break
        state, metrics = step(state, batch)
        done += 1
        if waiting is not None:
            read()
        waiting = (done, state, metrics)
    if waiting is not None:
        read()
    return state, records

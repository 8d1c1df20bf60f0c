"""The options of commands that several processes run together."""

import dataclasses
import os
from collections.abc import Mapping
from typing import Annotated

import jax

from fcos_lidar_jax.cli.checks import Needs
from fcos_lidar_jax.cli.options import option
from fcos_lidar_jax.devices.launcher import local_device_ids
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.files import refusing


@dataclasses.dataclass(frozen=True)
class ProcessOptions:
    """Options that connect several processes."""

    distributed: bool = False  # Connect to the other processes that Slurm, Open MPI or a TPU pod has started.
    coordinator: Annotated[str | None, Needs("num_processes"), option("HOST:PORT")] = None
    """Address of process 0, without a launcher. Needs --num-processes and --process-index."""
    num_processes: Annotated[int | None, Needs("process_index"), option("N")] = None  # Number of processes.
    process_index: Annotated[int | None, Needs("coordinator"), option("I")] = None
    """Index of this process, from 0."""


def join_processes(options: ProcessOptions, environment: Mapping[str, str] = os.environ) -> None:
    """Connect to the other processes, if any. Call this before JAX lists its devices."""
    by_hand = options.coordinator
    if by_hand is None and not options.distributed:
        return
    if by_hand is not None:
        host, _, port = by_hand.rpartition(":")
        check(bool(host) and port.isdecimal() and 0 < int(port) < 2**16, "--coordinator", by_hand, "HOST:PORT")
    cluster = by_hand or "--distributed"
    more = (
        "" if by_hand else "; expected Slurm, Open MPI, a TPU pod, or --coordinator and the options that it needs"
    )
    place, ids = dataclasses.astuple(options)[1:], local_device_ids(environment)
    with (
        refusing(f"{cluster}: this process cannot join", ValueError, more=more),
        refusing(f"{cluster}: the processes did not connect", RuntimeError, kind=OSError),
    ):
        jax.distributed.initialize(*place, local_device_ids=ids)

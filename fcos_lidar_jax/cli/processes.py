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

    @property
    def several(self) -> bool:
        """Whether there may be other processes."""
        return self.distributed or self.coordinator is not None


def check_processes(options: ProcessOptions) -> None:
    """Raise ValueError for options that do not describe a process of a cluster."""
    index, number = options.process_index, options.num_processes or 0
    check(index is None or 0 <= index < number, "--process-index", index, f"0 to {number} excluded")
    if options.coordinator is not None:
        host, _, port = options.coordinator.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
            raise ValueError(f"--coordinator: got {options.coordinator!r}, expected HOST:PORT")


def join_processes(options: ProcessOptions, environment: Mapping[str, str] = os.environ) -> None:
    """Connect to the other processes, if any. Call this before JAX lists its devices."""
    if not options.several:
        return
    cluster = options.coordinator or "the cluster of the environment"
    place, ids = dataclasses.astuple(options)[1:], local_device_ids(environment)
    try:
        with refusing(f"{cluster}: the processes did not connect", RuntimeError, kind=OSError):
            jax.distributed.initialize(*place, local_device_ids=ids)
    except ValueError as error:
        if options.coordinator is not None or "defined" not in str(error):
            raise ValueError(f"{cluster}: this process cannot join: {error}") from None
        raise ValueError(  # the error of JAX names the missing argument
            f"--distributed: found no launcher ({error}), expected Slurm, Open MPI or a TPU pod; otherwise give "
            "--coordinator, --num-processes and --process-index"
        ) from None

"""The options of commands that several processes run as one."""

import dataclasses
import os
import sys
from collections.abc import Mapping

import jax

from fcos_lidar_jax.cli.checks import check_at_least
from fcos_lidar_jax.devices.launcher import local_device_ids


@dataclasses.dataclass(frozen=True)
class ProcessOptions:
    """Which of several processes this is."""

    distributed: bool = False
    """Join the other processes that Slurm, Open MPI or a TPU pod has started; JAX finds them by itself."""
    coordinator: str | None = None
    """HOST:PORT of process 0, without such a launcher; needs --num-processes and --process-index."""
    num_processes: int | None = None  # Number of processes in all.
    process_index: int | None = None  # Index of this process, counted from 0.

    @property
    def several(self) -> bool:
        """Whether there may be others."""
        return self.distributed or self.coordinator is not None


def check_processes(options: ProcessOptions) -> None:
    """Refuse options that describe no process of a cluster.

    Raises:
        ValueError: naming the option, what was found and what was expected.
    """
    check_at_least(options, 1, "num_processes")
    given = [value is not None for value in (options.coordinator, options.num_processes, options.process_index)]
    if any(given) and not all(given):
        raise ValueError("--coordinator, --num-processes and --process-index: got some, expected all or none")
    if options.process_index is not None and not 0 <= options.process_index < (options.num_processes or 0):
        found = f"got {options.process_index}, expected 0 to {options.num_processes} excluded"
        raise ValueError(f"--process-index: {found}")
    if options.coordinator is not None:
        host, _, port = options.coordinator.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
            raise ValueError(f"--coordinator: got {options.coordinator!r}, expected HOST:PORT")


def join_processes(options: ProcessOptions, environment: Mapping[str, str] = os.environ) -> None:
    """Meet the other processes, if there are any; before JAX's devices are asked for.

    Raises:
        ValueError: nothing describes a cluster, or a variable of the environment cannot be read.
        OSError: the others were not reached.
    """
    if not options.several:
        return
    where = options.coordinator or "the cluster of the environment"
    place, ids = dataclasses.astuple(options)[1:], local_device_ids(environment)
    try:
        jax.distributed.initialize(*place, local_device_ids=ids)
    except ValueError as error:
        if options.coordinator is not None or "defined" not in str(error):
            raise ValueError(f"{where}: this process cannot join: {error}") from None
        raise ValueError(  # JAX says which of coordinator, number and index is not defined
            f"--distributed: found no launcher ({error}), expected Slurm, Open MPI or a TPU pod; elsewhere give "
            "--coordinator, --num-processes and --process-index"
        ) from None
    except RuntimeError as error:
        raise OSError(f"{where}: the processes did not meet: {error}") from None


def tell(line: str) -> None:
    """Print a line on standard error; of several processes the first alone does."""
    if not jax.distributed.is_initialized() or jax.process_index() == 0:
        print(line, file=sys.stderr, flush=True)

"""GPUs of a process, from the variables of its launcher: Slurm or Open MPI."""

from collections.abc import Mapping

from fcos_lidar_jax.files import refusing

_SLURM = ("SLURM_JOB_ID", "SLURM_STEP_NODELIST", "SLURM_NTASKS", "SLURM_PROCID", "SLURM_LOCALID")
"""Variables of processes started by srun, as in JAX; inside a job, other processes lack some of them."""
_TASKS = ("SLURM_STEP_TASKS_PER_NODE", "SLURM_NTASKS_PER_NODE", "SLURM_TASKS_PER_NODE")
"""Tasks per node, of which the first one set counts: of the step, as requested, of the job."""
_VISIBLE = ("CUDA_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES")


def local_device_ids(environment: Mapping[str, str]) -> tuple[int, ...] | None:
    """Choose the GPUs for ``jax.distributed.initialize`` from the environment of a process.

    The only process of a machine uses all visible GPUs. One of several processes uses the GPU with its local rank,
    or all visible GPUs if the launcher only shows each process its own.

    Returns:
        indices into the visible GPUs; ``()`` for all of them; None to let JAX decide, if the process was started
        by neither Slurm nor Open MPI, or if ``JAX_LOCAL_DEVICE_IDS`` is set.

    Raises:
        ValueError: the launcher's variables cannot be read.
    """
    if environment.get("JAX_LOCAL_DEVICE_IDS"):
        return None
    where = "variables of Slurm or Open MPI: cannot be read"
    with refusing(where, LookupError, ValueError, more=": set JAX_LOCAL_DEVICE_IDS to the GPUs of this process"):
        local = _local_rank(environment)
    if local is None:
        return None
    rank, size = local
    # By default, JAX gives each process of these launchers the GPU of its rank. On a machine with one process, the
    # other GPUs would stay idle, and if each process only sees its own GPU, rank 1 would have none. An empty
    # sequence leaves all GPUs visible in jax 0.10. Listing all ids would be the documented way, but their number
    # is unknown until JAX's backend starts.
    return () if size == 1 or _sees_only_its_own(environment) else (rank,)


def _local_rank(environment: Mapping[str, str]) -> tuple[int, int] | None:
    """Rank on the machine, and number of processes there (0 if unknown); Open MPI has priority, as in JAX."""
    if "OMPI_COMM_WORLD_LOCAL_SIZE" in environment:
        names = "OMPI_COMM_WORLD_LOCAL_RANK", "OMPI_COMM_WORLD_LOCAL_SIZE"
        rank, size = (int(environment[name]) for name in names)
        return rank, size
    if not all(name in environment for name in _SLURM):
        return None
    name = next((name for name in _TASKS if name in environment), None)
    return int(environment["SLURM_LOCALID"]), 0 if name is None else _tasks_of_node(environment, name)


def _sees_only_its_own(environment: Mapping[str, str]) -> bool:
    """Whether exactly one GPU is visible, or as many as requested per task."""
    visible = next((environment[name] for name in _VISIBLE if name in environment), "")
    number = len([entry for entry in visible.split(",") if entry.strip()])
    per_task = environment.get("SLURM_GPUS_PER_TASK", "").rpartition(":")[2]  # 2 or a100:2
    return number == 1 or str(number) == per_task


def _tasks_of_node(environment: Mapping[str, str], name: str) -> int:
    """Number of Slurm's tasks on this node, from ``8`` for all nodes, or ``2(x3),1`` node by node."""
    counts: list[int] = []
    for part in environment[name].split(","):
        tasks, _, nodes = part.removesuffix(")").partition("(x")
        counts += [int(tasks)] * int(nodes or 1)
    return counts[0] if len(set(counts)) == 1 else counts[int(environment["SLURM_NODEID"])]

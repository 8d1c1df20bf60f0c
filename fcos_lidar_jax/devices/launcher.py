"""What the program that started a process, Slurm or Open MPI, says of its GPUs."""

import re
from collections.abc import Mapping

# As JAX: only with all of them was a process started by srun, and not within a job in another way.
_SLURM = ("SLURM_JOB_ID", "SLURM_STEP_NODELIST", "SLURM_NTASKS", "SLURM_PROCID", "SLURM_LOCALID")
# Of the step, what was asked for, of the whole job: the first that is there.
_TASKS = ("SLURM_STEP_TASKS_PER_NODE", "SLURM_NTASKS_PER_NODE", "SLURM_TASKS_PER_NODE")
_VISIBLE = ("CUDA_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES")


def local_device_ids(environment: Mapping[str, str]) -> tuple[int, ...] | None:
    """Which GPUs a process takes, for ``jax.distributed.initialize``.

    The only process on its machine takes all GPUs that it may see. Of several, each takes the one of its own
    number; where the launcher shows each its own GPUs alone, it takes those.

    Args:
        environment: variables of the process.

    Returns:
        places among the GPUs that the process may see; ``()`` for all of them; None where neither Slurm nor Open
        MPI started it, or ``JAX_LOCAL_DEVICE_IDS`` says it, so that JAX decides.

    Raises:
        ValueError: a variable of the launcher, or JAX's, that cannot be read, with its name.

    >>> local_device_ids({"OMPI_COMM_WORLD_LOCAL_SIZE": "8", "OMPI_COMM_WORLD_LOCAL_RANK": "3"})
    (3,)
    >>> local_device_ids({"OMPI_COMM_WORLD_LOCAL_SIZE": "1", "OMPI_COMM_WORLD_LOCAL_RANK": "0"})
    ()
    """
    place = None if _said_to_jax(environment) else _place(environment)
    if place is None:
        return None
    rank, size = place
    # Left to itself JAX gives every process of these launchers the one GPU of its rank: the others of a machine
    # with one process would stay idle, and where each process sees a single GPU, rank 1 would have none. Only
    # None makes JAX do so, and only ids hide the GPUs that are not among them, so an empty sequence leaves all
    # visible: jax 0.10 asks `local_device_ids is None`, then `if local_device_ids`. To spell out the ids would be
    # the documented way, but how many there are is not known before JAX's backend starts, which must be later:
    # CUDA_VISIBLE_DEVICES may be missing, or name them by UUID. A JAX that took "none" at its word would find no
    # GPU and stop: nothing would stay idle unseen.
    return () if size == 1 or _sees_its_own(environment) else (rank,)


def _said_to_jax(environment: Mapping[str, str]) -> bool:
    """Whether JAX's own variable says which GPUs; as in JAX, an empty one says nothing."""
    text = environment.get("JAX_LOCAL_DEVICE_IDS", "")
    if text and not all(part.strip().isdecimal() for part in text.split(",")):
        raise ValueError(f"JAX_LOCAL_DEVICE_IDS: got {text!r}, expected numbers of GPUs, as 0 or 0,1")
    return text != ""


def _place(environment: Mapping[str, str]) -> tuple[int, int] | None:
    """The process's rank on its machine and how many there are; Open MPI comes first, as in JAX."""
    if "OMPI_COMM_WORLD_LOCAL_SIZE" in environment:
        names = "OMPI_COMM_WORLD_LOCAL_RANK", "OMPI_COMM_WORLD_LOCAL_SIZE"
        rank, size = (_number(environment, name) for name in names)
        return rank, size
    if not all(name in environment for name in _SLURM):
        return None
    name = next((name for name in _TASKS if name in environment), None)
    rank = _number(environment, "SLURM_LOCALID")
    return rank, 0 if name is None else _tasks_of_node(environment, name)


def _sees_its_own(environment: Mapping[str, str]) -> bool:
    """Whether the GPUs that the process may see are no other process's: one, or as many as a task was promised."""
    seen = next((environment[name] for name in _VISIBLE if name in environment), "")
    number = len([entry for entry in seen.split(",") if entry.strip()])
    promised = environment.get("SLURM_GPUS_PER_TASK", "").rpartition(":")[2]  # 2 or a100:2
    return number == 1 or str(number) == promised


def _tasks_of_node(environment: Mapping[str, str], name: str) -> int:
    """How many tasks Slurm started on this node: of ``8``, or node by node of ``2(x3),1``."""
    parts = [re.fullmatch(r"(\d+)(?:\(x(\d+)\))?", part) for part in environment[name].split(",")]
    counts = [int(part[1]) for part in parts if part for _ in range(int(part[2] or 1))]
    if not all(parts) or not counts:
        raise ValueError(f"{name}: got {environment[name]!r}, expected tasks per node, as 8 or 2(x3),1")
    if len(set(counts)) == 1:
        return counts[0]
    node = _number(environment, "SLURM_NODEID")
    if node >= len(counts):
        raise ValueError(f"SLURM_NODEID: got {node}, expected less than the {len(counts)} nodes of {name}")
    return counts[node]


def _number(environment: Mapping[str, str], name: str) -> int:
    if not (text := environment.get(name, "")).isdecimal():
        raise ValueError(f"{name}: got {text!r}, expected a whole number")
    return int(text)

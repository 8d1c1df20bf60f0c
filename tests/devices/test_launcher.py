"""Choice of the GPUs of a process from the variables of its launcher."""

import pytest
from commands import free_port, run_python

from fcos_lidar_jax.devices.launcher import local_device_ids

SRUN = {"SLURM_JOB_ID": "7", "SLURM_STEP_NODELIST": "n[1-2]", "SLURM_NTASKS": "16", "SLURM_PROCID": "11"}
FIRST, FOURTH = SRUN | {"SLURM_LOCALID": "0"}, SRUN | {"SLURM_LOCALID": "3"}
STEP, JOB = "SLURM_STEP_TASKS_PER_NODE", "SLURM_TASKS_PER_NODE"
MPI = {"OMPI_MCA_orte_hnp_uri": "1.0;tcp://10.0.0.1:5", "OMPI_COMM_WORLD_SIZE": "16", "OMPI_COMM_WORLD_RANK": "11"}
MPI_SIZE, MPI_RANK = "OMPI_COMM_WORLD_LOCAL_SIZE", "OMPI_COMM_WORLD_LOCAL_RANK"
CUDA, PER_TASK, JAX_IDS = "CUDA_VISIBLE_DEVICES", "SLURM_GPUS_PER_TASK", "JAX_LOCAL_DEVICE_IDS"
ALL = "0,1,2,3,4,5,6,7"
CASES = {
    "no launcher": ({}, None),
    "TPU pod": ({"TPU_WORKER_ID": "3", "TPU_WORKER_HOSTNAMES": "a,b,c,d"}, None),
    "in a job, but not started by srun": ({"SLURM_JOB_ID": "7", "SLURM_LOCALID": "0", JOB: "1"}, None),
    "srun, one task per node": (FIRST | {STEP: "1(x2)", CUDA: ALL}, ()),
    "srun, one task per node, the job has more": (FIRST | {STEP: "1(x2)", JOB: "8(x2)"}, ()),
    "srun, one task per node, as requested": (FIRST | {"SLURM_NTASKS_PER_NODE": "1", JOB: "8(x2)"}, ()),
    "srun, eight tasks per node": (FOURTH | {STEP: "8(x2)", CUDA: ALL}, (3,)),
    "srun, tasks per node unknown": (FOURTH, (3,)),
    "srun, this node has one task": (FIRST | {STEP: "2(x2),1", "SLURM_NODEID": "2"}, ()),
    "srun, this node has two tasks": (FIRST | {STEP: "2(x2),1", "SLURM_NODEID": "1"}, (0,)),
    "srun, one GPU per task": (FOURTH | {STEP: "8(x2)", PER_TASK: "1", CUDA: "0"}, ()),
    "srun, one GPU per task, by index": (FOURTH | {STEP: "8(x2)", CUDA: "3"}, ()),
    "srun, two GPUs per task": (FOURTH | {STEP: "4", PER_TASK: "a100:2", CUDA: "0,1"}, ()),
    "srun, one GPU per task, all visible": (FOURTH | {STEP: "8(x2)", PER_TASK: "1", CUDA: ALL}, (3,)),
    "srun, one AMD GPU per task": (FOURTH | {STEP: "8(x2)", "ROCR_VISIBLE_DEVICES": "3"}, ()),
    "mpirun, eight processes per host": (MPI | {MPI_SIZE: "8", MPI_RANK: "3"}, (3,)),
    "mpirun within srun": (FIRST | {STEP: "1"} | MPI | {MPI_SIZE: "8", MPI_RANK: "3"}, (3,)),
    "JAX's variable is set": (FIRST | {STEP: "1", JAX_IDS: "0,2"}, None),
}
INVALID = {
    "tasks": FIRST | {STEP: "1(2)"},
    "no node": FIRST | {STEP: "2,1"},
    "rank": SRUN | {"SLURM_LOCALID": "x"},
    "no rank": {MPI_SIZE: "8"},
}


@pytest.mark.parametrize("case", CASES)
def test_a_process_uses_its_own_gpus(case):
    environment, expected = CASES[case]
    assert local_device_ids(environment) == expected


@pytest.mark.parametrize("case", INVALID)
def test_unreadable_variables_are_refused(case):
    with pytest.raises(ValueError, match="variables of Slurm or Open MPI: cannot be read"):
        local_device_ids(INVALID[case])


@pytest.mark.slow
@pytest.mark.parametrize(("tasks", "visible"), [("1", "all"), ("2", "0")])
def test_jax_hides_no_gpu_from_the_only_process_of_a_machine(tasks, visible):
    """Checks the setting that the CUDA backend of the installed JAX starts with."""
    code = (
        "import os, jax; from fcos_lidar_jax.devices.launcher import local_device_ids as ids; "
        "jax.distributed.initialize(local_device_ids=ids(os.environ)); "
        "print(jax.config.read('jax_cuda_visible_devices'))"
    )
    step = {"SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": "1", "SLURM_PROCID": "0", STEP: tasks}
    done = run_python("-c", code, **FIRST | step, JAX_COORDINATOR_PORT=free_port())
    assert done.stdout == f"{visible}\n", done.stderr

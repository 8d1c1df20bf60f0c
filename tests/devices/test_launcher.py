"""Which GPUs a process takes, by the variables of the program that started it."""

import re
import socket

import pytest
from commands import run_python

from fcos_lidar_jax.devices.launcher import local_device_ids

SRUN = {"SLURM_JOB_ID": "7", "SLURM_STEP_NODELIST": "n[1-2]", "SLURM_NTASKS": "16", "SLURM_PROCID": "11"}
FIRST, FOURTH = SRUN | {"SLURM_LOCALID": "0"}, SRUN | {"SLURM_LOCALID": "3"}
STEP, JOB = "SLURM_STEP_TASKS_PER_NODE", "SLURM_TASKS_PER_NODE"
MPI = {"OMPI_MCA_orte_hnp_uri": "1.0;tcp://10.0.0.1:5", "OMPI_COMM_WORLD_SIZE": "16", "OMPI_COMM_WORLD_RANK": "11"}
ALL = "0,1,2,3,4,5,6,7"
CASES = {
    "by hand": ({}, None),
    "TPU pod": ({"TPU_WORKER_ID": "3", "TPU_WORKER_HOSTNAMES": "a,b,c,d"}, None),
    "within a job, but not by srun": ({"SLURM_JOB_ID": "7", "SLURM_LOCALID": "0", JOB: "1"}, None),
    "srun, one task a node": (FIRST | {STEP: "1(x2)", "CUDA_VISIBLE_DEVICES": ALL}, ()),
    "srun, one task a node, GPUs by UUID": (FIRST | {STEP: "1", "CUDA_VISIBLE_DEVICES": "GPU-1a,GPU-2b"}, ()),
    "srun, one task a node, of a job with more": (FIRST | {STEP: "1(x2)", JOB: "8(x2)"}, ()),
    "srun, one task a node, as asked": (FIRST | {"SLURM_NTASKS_PER_NODE": "1", JOB: "8(x2)"}, ()),
    "srun, one task a node, of the job": (FIRST | {JOB: "1(x2)"}, ()),
    "srun, eight tasks a node": (FOURTH | {STEP: "8(x2)", "CUDA_VISIBLE_DEVICES": ALL}, (3,)),
    "srun, eight tasks a node, without a list": (FOURTH | {STEP: "8(x2)"}, (3,)),
    "srun, nothing about nodes": (FOURTH, (3,)),
    "srun, this node has one": (FIRST | {STEP: "2(x2),1", "SLURM_NODEID": "2"}, ()),
    "srun, this node has two": (FIRST | {STEP: "2(x2),1", "SLURM_NODEID": "1"}, (0,)),
    "srun, a GPU for each task": (
        FOURTH | {STEP: "8(x2)", "SLURM_GPUS_PER_TASK": "1", "CUDA_VISIBLE_DEVICES": "0"},
        (),
    ),
    "srun, a GPU for each task, by its number": (FOURTH | {STEP: "8(x2)", "CUDA_VISIBLE_DEVICES": "3"}, ()),
    "srun, two GPUs for each task": (
        FOURTH | {STEP: "4", "SLURM_GPUS_PER_TASK": "a100:2", "CUDA_VISIBLE_DEVICES": "0,1"},
        (),
    ),
    "srun, a GPU for each task, and all seen": (
        FOURTH | {STEP: "8(x2)", "SLURM_GPUS_PER_TASK": "1", "CUDA_VISIBLE_DEVICES": ALL},
        (3,),
    ),
    "srun, an AMD GPU for each task": (FOURTH | {STEP: "8(x2)", "ROCR_VISIBLE_DEVICES": "3"}, ()),
    "mpirun, one process a host": (
        MPI | {"OMPI_COMM_WORLD_LOCAL_SIZE": "1", "OMPI_COMM_WORLD_LOCAL_RANK": "0", "CUDA_VISIBLE_DEVICES": ALL},
        (),
    ),
    "mpirun, eight processes a host": (
        MPI | {"OMPI_COMM_WORLD_LOCAL_SIZE": "8", "OMPI_COMM_WORLD_LOCAL_RANK": "3"},
        (3,),
    ),
    "mpirun within srun": (
        FIRST | {STEP: "1"} | MPI | {"OMPI_COMM_WORLD_LOCAL_SIZE": "8", "OMPI_COMM_WORLD_LOCAL_RANK": "3"},
        (3,),
    ),
    "said by JAX's own variable": (FIRST | {STEP: "1", "JAX_LOCAL_DEVICE_IDS": "0,2"}, None),
    "JAX's own variable is empty": (FOURTH | {STEP: "8", "JAX_LOCAL_DEVICE_IDS": ""}, (3,)),
}
BAD = {
    "JAX's own variable": ({"JAX_LOCAL_DEVICE_IDS": "0,x"}, "JAX_LOCAL_DEVICE_IDS: got '0,x', expected numbers"),
    "tasks": (FIRST | {STEP: "1(2)"}, f"{STEP}: got '1(2)', expected tasks per node, as 8 or 2(x3),1"),
    "no tasks": (FIRST | {STEP: ""}, f"{STEP}: got '', expected tasks per node"),
    "node": (FIRST | {STEP: "2,1"}, "SLURM_NODEID: got '', expected a whole number"),
    "far node": (
        FIRST | {STEP: "2,1", "SLURM_NODEID": "2"},
        f"SLURM_NODEID: got 2, expected less than the 2 nodes of {STEP}",
    ),
    "rank": (SRUN | {"SLURM_LOCALID": "x"}, "SLURM_LOCALID: got 'x', expected a whole number"),
    "size": ({"OMPI_COMM_WORLD_LOCAL_SIZE": "8"}, "OMPI_COMM_WORLD_LOCAL_RANK: got '', expected a whole number"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_process_takes_the_gpus_that_are_its_own(case):
    environment, expected = CASES[case]
    assert local_device_ids(environment) == expected


@pytest.mark.parametrize("case", BAD)
def test_a_launcher_that_cannot_be_read_is_named(case):
    environment, message = BAD[case]
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        local_device_ids(environment)


@pytest.mark.parametrize(("tasks", "seen"), [("1", "all"), ("2", "0")])
def test_jax_hides_no_gpu_from_the_only_process_of_a_machine(tasks, seen):
    """What the installed JAX makes of the ids: the setting that its CUDA backend starts with."""
    code = (
        "import os, jax; from fcos_lidar_jax.devices.launcher import local_device_ids as ids; "
        "jax.distributed.initialize(local_device_ids=ids(os.environ)); "
        "print(jax.config.read('jax_cuda_visible_devices'))"
    )
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    step = {"SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": "1", "SLURM_PROCID": "0", STEP: tasks}
    done = run_python("-c", code, **FIRST | step, JAX_COORDINATOR_PORT=port)
    assert done.stdout == f"{seen}\n", done.stderr

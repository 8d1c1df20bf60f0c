"""The study of equivalence with a network and images that take seconds; its processes import this module.

Most of the time of a step in float64 is that of convolutions, which XLA computes slowly on CPUs.
"""

import dataclasses

import tiny_run

from experiments.studies import device_equivalence as study

CONFIG = dataclasses.replace(study.CONFIG, model=tiny_run.CONFIG.model, projection=tiny_run.CONFIG.projection)
SENSOR = dataclasses.replace(study.SENSOR, num_columns=32)
_work = study.work


def work(*args) -> None:
    study.CONFIG, study.SENSOR = CONFIG, SENSOR
    _work(*args)

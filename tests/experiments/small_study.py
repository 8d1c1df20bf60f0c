"""The study of equivalence with the linear network; its processes import this module."""

import dataclasses

import linear_network
import optax
import tiny_run

from experiments.studies import device_equivalence as study

CONFIG = dataclasses.replace(study.CONFIG, model=tiny_run.CONFIG.model, projection=tiny_run.CONFIG.projection)
SENSOR = dataclasses.replace(study.SENSOR, num_columns=32)
_work = study.work


def make_optimizer(*_):
    """Not AdamW, which turns rounding of a gradient near zero into a full-size step."""
    sgd = optax.inject_hyperparams(lambda learning_rate, b1: optax.sgd(learning_rate, b1))(0.01, 0.9)
    return optax.chain(optax.identity(), sgd)


def work(*args) -> None:
    linear_network.use()
    study.CONFIG, study.SENSOR, study.make_optimizer = CONFIG, SENSOR, make_optimizer
    _work(*args)

"""A detector whose network is one layer, for tests of what surrounds the network."""

from collections.abc import Iterator

import pytest
from linear_network import linear_network
from tiny_run import CONFIG, SENSOR, untrained

from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.models import build_detector


@pytest.fixture(scope="module")
def detector() -> Iterator[TrainedDetector]:
    """Meanwhile, other detectors that are built have the linear network, too."""
    with linear_network():
        yield TrainedDetector(build_detector(CONFIG, SENSOR), untrained(CONFIG, SENSOR))

"""Set-up that several tests of commands share."""

import pytest
from linear_network import linear_network


@pytest.fixture
def linear():
    """The network of one layer; tests/training trains FCOS-LiDAR's."""
    with linear_network():
        yield

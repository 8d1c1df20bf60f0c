"""Processes that agree; two of them, in processes of their own, are in tests/cli/test_processes.py."""

import numpy as np
import pytest

from fcos_lidar_jax.devices import agreement
from fcos_lidar_jax.devices.agreement import agreed, check_same


@pytest.fixture
def of_three(monkeypatch):
    """This process is the first of three; what the others send."""
    sent = []

    def gather(own):
        return np.stack([own, *(np.asarray(other) for other in others)])

    others = [True, True]
    monkeypatch.setattr(agreement.jax, "process_count", lambda: 3)
    monkeypatch.setattr(
        agreement.multihost_utils, "process_allgather", lambda own: (sent.append(own.copy()), gather(own))[1]
    )
    return others, sent


@pytest.mark.parametrize("failure", [ValueError("x"), KeyboardInterrupt(), SystemExit(143)])
def test_a_failure_is_told_and_raised(of_three, failure):
    _, sent = of_three
    with pytest.raises(type(failure)) as raised, agreed("cannot read"):
        raise failure
    assert raised.value is failure
    assert [bool(own) for own in sent] == [False]


def test_the_failure_of_another_stops_all(of_three):
    others, sent = of_three
    with agreed("cannot read"):
        pass
    others[1] = False
    with pytest.raises(OSError, match=r"^process 2: cannot read, see what it says$"), agreed("cannot read"):
        pass
    assert [bool(own) for own in sent] == [True, True]


def test_where_the_others_cannot_be_told_the_own_failure_is_raised(of_three, monkeypatch):
    def gather(_):
        raise RuntimeError("Gloo AllGather failed: Connection closed by peer")

    monkeypatch.setattr(agreement.multihost_utils, "process_allgather", gather)
    with pytest.raises(ValueError, match=r"^my own reason$"), agreed("cannot read"):
        raise ValueError("my own reason")
    with pytest.raises(RuntimeError, match="Connection closed"), agreed("cannot read"):
        pass


def test_alone_a_block_is_a_block():
    with pytest.raises(ValueError, match="own"), agreed("cannot read"):
        raise ValueError("own")


def test_another_start_is_refused_by_all(of_three):
    others, _ = of_three
    others[:] = [np.array([0, 255], np.uint8), np.array([0, 255], np.uint8)]
    check_same("00ff", "frames")
    others[1] = np.array([0, 254], np.uint8)
    with pytest.raises(ValueError, match=r"^process 2: frames: got another than process 0, expected the same$"):
        check_same("00ff", "frames")

"""Agreement of processes, mocked here; tests/cli/test_processes.py runs two real processes."""

import numpy as np
import pytest

from fcos_lidar_jax.devices import agreement
from fcos_lidar_jax.devices.agreement import agreed, check_same


@pytest.fixture
def of_three(monkeypatch):
    """Mock three processes, of which this is the first: values sent by the others, and by this one."""
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
def test_a_failure_is_reported_to_the_others_and_raised(of_three, failure):
    _, sent = of_three
    with pytest.raises(type(failure)) as raised, agreed("cannot read"):
        raise failure
    assert raised.value is failure
    assert [bool(own) for own in sent] == [False]


def test_the_failure_of_another_process_stops_this_one(of_three):
    others, sent = of_three
    with agreed("cannot read"):
        pass
    others[1] = False
    with pytest.raises(OSError, match=r"^process 2: cannot read, see its output$"), agreed("cannot read"):
        pass
    assert [bool(own) for own in sent] == [True, True]


def test_the_own_failure_is_raised_if_the_others_cannot_be_reached(of_three, monkeypatch):
    def gather(_):
        raise RuntimeError("Gloo AllGather failed: Connection closed by peer")

    monkeypatch.setattr(agreement.multihost_utils, "process_allgather", gather)
    with pytest.raises(ValueError, match=r"^my own reason$"), agreed("cannot read"):
        raise ValueError("my own reason")
    with pytest.raises(RuntimeError, match="Connection closed"), agreed("cannot read"):
        pass


def test_different_inputs_are_refused(of_three):
    others, _ = of_three
    others[:] = [np.array([0, 255], np.uint8), np.array([0, 255], np.uint8)]
    check_same("00ff", "frames")
    others[1] = np.array([0, 254], np.uint8)
    with pytest.raises(ValueError, match=r"^process 2: frames: different from process 0, expected the same$"):
        check_same("00ff", "frames")

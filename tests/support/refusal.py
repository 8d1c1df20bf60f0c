"""What all refusals of bad input have in common."""

import contextlib
import re
from collections.abc import Iterator

import pytest


@contextlib.contextmanager
def refused(*fragments: object) -> Iterator[None]:
    """Within it a ``ValueError`` is raised, whose message is one line that holds all the fragments."""
    with pytest.raises(ValueError, match=re.escape(str(fragments[0]))) as caught:
        yield
    message = str(caught.value)
    assert "\n" not in message
    for fragment in fragments:
        assert str(fragment) in message, message

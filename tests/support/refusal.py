"""Assertions on error messages."""

import contextlib
import re
from collections.abc import Iterator

import pytest


@contextlib.contextmanager
def refused(*fragments: object) -> Iterator[None]:
    """Expect a ``ValueError`` whose message is one line that contains all fragments."""
    with pytest.raises(ValueError, match=re.escape(str(fragments[0]))) as caught:
        yield
    message = str(caught.value)
    assert "\n" not in message
    for fragment in fragments:
        assert str(fragment) in message, message

"""Conversion of parsed JSON to dataclasses, beside ``msgspec.convert``."""

import json

import msgspec
import pytest

from fcos_lidar_jax.config import Config, config_to_json
from fcos_lidar_jax.fields import from_json


@pytest.mark.parametrize(
    ("change", "message", "by_msgspec"),
    [
        ({"colour": 1}, r"run: colour: unknown field, expected one of name, sensor, .*", None),
        ({"loss": ...}, r"run: loss: missing, expected a JSON object", None),
        ({"num_sweeps": "ten"}, r"run: num_sweeps: got 'ten', expected int", "Expected `int`, got `str`"),
        ({"model": {"precision": "half"}}, r"run: model\.\w+: missing, expected .*", "Invalid enum value 'half'"),
    ],
    ids=["unknown field", "missing field", "wrong type", "unknown choice"],
)
def test_msgspec_would_accept_or_explain_less(change, message, by_msgspec):
    """An unknown or missing field would change a checkpoint's configuration without an error."""
    record = json.loads(json.dumps(config_to_json(Config())))
    record = {name: value for name, value in (record | change).items() if value is not ...}
    with pytest.raises(ValueError, match=f"^{message}$"):
        from_json(Config, record, "run")
    if by_msgspec is None:
        assert msgspec.convert(record, Config) == Config()
    else:
        with pytest.raises(msgspec.ValidationError, match=by_msgspec):
            msgspec.convert(record, Config)

"""The run-time checker of the signatures: an int is a float, as everywhere in Python's type system."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))

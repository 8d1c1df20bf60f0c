"""Functions in several forms, each fast on a different platform."""

import functools
from collections.abc import Callable, Mapping
from typing import Literal, TypeVar

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

T = TypeVar("T")


def in_form(form: str | None, forms: Mapping[str, Callable[..., T]], *args: Array, **platforms: str) -> T:
    """Call one form of a function, with the arguments ``args``.

    ``forms`` have the same arguments and, up to rounding, the same result. Without a name, the form of the
    platform is selected when the program runs: ``platforms`` are such as ``cpu="loop", default="reduction"``.

    >>> forms = {"product": lambda x: x * 2, "sum": lambda x: x + x}
    >>> in_form(None, forms, jnp.ones(2), cpu="sum", default="product").tolist()
    [2.0, 2.0]
    """
    if form is None:
        return lax.platform_dependent(*args, **{platform: forms[name] for platform, name in platforms.items()})
    return forms[form](*args)


def search(ascending: Array, values: Array, *, side: Literal["left", "right"] = "left") -> Array:
    """``jnp.searchsorted`` by binary search on CPUs, and by comparison of all pairs, without a loop, elsewhere."""
    scan, compare = (
        functools.partial(jnp.searchsorted, side=side, method=method) for method in ("scan", "compare_all")
    )
    return lax.platform_dependent(ascending, values, cpu=scan, default=compare)

"""One function in several forms, each fast on another platform."""

import functools
from collections.abc import Callable, Mapping
from typing import Literal, TypeVar

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

T = TypeVar("T")


def in_form(form: str | None, forms: Mapping[str, Callable[..., T]], *given: Array, **platforms: str) -> T:
    """The result of one form of a function.

    Args:
        form: name of the form; None for the one that suits the platform, decided where the program runs.
        forms: functions of the same arguments and, up to rounding, the same result.
        given: the arguments.
        platforms: which form suits which platform, such as ``cpu="loop", default="reduction"``.

    Raises:
        ValueError: no such form.

    >>> import jax.numpy as jnp
    >>> forms = {"product": lambda x: x * 2, "sum": lambda x: x + x}
    >>> in_form(None, forms, jnp.ones(2), cpu="sum", default="product").tolist()
    [2.0, 2.0]
    """
    if form is None:
        return lax.platform_dependent(*given, **{name: forms[chosen] for name, chosen in platforms.items()})
    if form not in forms:
        raise ValueError(f"form: got {form!r}, expected {', '.join(map(repr, forms))} or None")
    return forms[form](*given)


def search(ascending: Array, values: Array, *, side: Literal["left", "right"] = "left") -> Array:
    """``jnp.searchsorted``: a search on a CPU; elsewhere a comparison of all pairs, which needs no loop.

    >>> import jax.numpy as jnp
    >>> search(jnp.array([1.0, 2.0, 2.0]), jnp.array([2.0]), side="right").tolist()
    [3]
    """
    scan, compare = (
        functools.partial(jnp.searchsorted, side=side, method=method) for method in ("scan", "compare_all")
    )
    return lax.platform_dependent(ascending, values, cpu=scan, default=compare)

"""What a module offers to ``dir()`` and tab completion."""

import sys
from collections.abc import Callable
from types import ModuleType


def own_names(module: str) -> Callable[[], list[str]]:
    """A ``__dir__`` for a module: its public functions, classes and constants, without what it imports.

    >>> import fcos_lidar_jax.nms
    >>> [name for name in ("jnp", "lax", "Array", "rotated_nms") if name in dir(fcos_lidar_jax.nms)]
    ['rotated_nms']
    """

    def names() -> list[str]:
        return sorted(
            name
            for name, value in vars(sys.modules[module]).items()
            if not (name.startswith("_") or isinstance(value, ModuleType))
            # Only functions and classes say where they come from.
            and not (callable(value) and value.__module__ != module)
        )

    return names

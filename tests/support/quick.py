"""Compile programs in a third of the time, for tests that do not depend on rounding."""

import functools
import gc
import os
import threading
from pathlib import Path
from typing import Any

import jax
from jax._src import compiler, lru_cache

_LEVEL = "xla_backend_optimization_level"
_OPTIONS = {_LEVEL: 0, "xla_cpu_use_fusion_emitters": False}
_compile_options = compiler.get_compile_options

# Tracing makes so many objects that Python would look for garbage in a quarter of its time.
gc.set_threshold(200_000, 50, 100)


def compile_quickly(quick: bool) -> None:
    """Turn quick compilation on or off for all later programs of this process."""
    if is_quick() == quick:
        return
    jax.config.update("jax_disable_most_optimizations", quick)
    # JAX reads compiler options for all programs only from the environment, once per process.
    compiler.get_compile_options = _quick_compile_options if quick else _compile_options
    jax.clear_caches()


def is_quick() -> bool:
    return jax.config.read("jax_disable_most_optimizations")


def environment(quick: bool, level: int = 0) -> dict[str, str]:
    """Environment variables that turn quick compilation on or off in another process.

    A higher level of optimisation takes longer and rounds as XLA does by default.
    """
    options = {name: level if name == _LEVEL else value for name, value in _known_options().items()}
    flags = [f"--{name}={str(value).lower()}" for name, value in options.items()] if quick else []
    return {
        "JAX_DISABLE_MOST_OPTIMIZATIONS": str(int(quick and not level)),
        "XLA_FLAGS": " ".join([os.environ.get("XLA_FLAGS", ""), *flags]),
    }


def _put_whole(cache: lru_cache.LRUCache, key: str, value: bytes) -> None:
    """Store a compiled program under its name when it is whole.

    JAX writes it in place, where another process can read the first half, also after this one is killed.
    """
    file = Path(str(cache.path), f"{key}{lru_cache._CACHE_SUFFIX}")
    if not file.exists():
        part = file.with_name(f".{os.getpid()}-{threading.get_ident()}-{file.name}")
        part.write_bytes(value)
        part.replace(file)


lru_cache.LRUCache.put = _put_whole


def _quick_compile_options(*args, env_options_overrides=None, **kwargs):
    options = _known_options() | (env_options_overrides or {})
    return _compile_options(*args, env_options_overrides=options, **kwargs)


@functools.cache
def _known_options() -> dict[str, Any]:
    """The options that this XLA has; unknown options in the environment would end the process."""

    def known(option: dict[str, Any]) -> bool:
        lowered = jax.jit(lambda x: x + 1).lower(0.0)
        try:
            lowered.compile(compiler_options=option)
        except jax.errors.JaxRuntimeError:
            return False
        return True

    compiler.get_compile_options, current = _compile_options, compiler.get_compile_options
    options = {name: value for name, value in _OPTIONS.items() if known({name: value})}
    compiler.get_compile_options = current
    return options

"""Lines on stderr: progress of long operations, with rate and time left, and notes."""

import collections
import sys
import time

import jax

_LINES = 30  # Number of lines whose work determines the rate.


class Progress:
    """Prints progress lines to stderr, identical on a terminal and in a pipe.

    The rate covers the last 30 lines, five minutes with the default interval and quick items, so that older pauses
    and slow beginnings do not count. It excludes the work before the first call, which often includes compilation.
    ``unit`` names the counted items, in the plural. Lines are at least ``every_s`` seconds apart; the last item
    always prints one. Lines without ``total`` have no time left.
    """

    def __init__(self, unit: str, total: int | None, *, every_s: float = 10.0) -> None:
        self.unit, self.total, self.every_s = unit, total, every_s
        self._shown = collections.deque[tuple[float, int]](maxlen=_LINES)
        self._next = 0.0

    def show(self, done: int, text: str = "") -> None:
        """Report ``done`` finished items, with ``text`` between the count and the rate."""
        now = time.monotonic()
        if now < self._next and done != self.total:
            return
        self._next = now + self.every_s
        began, first = self._shown[0] if self._shown else (now, done)
        self._shown.append((now, done))
        line = f"{self.unit} {done}" + ("" if self.total is None else f"/{self.total}")
        line += f"  {text}" if text else ""
        if done > first and now > began:
            rate = (done - first) / (now - began)
            line += f"  {rate:.2f} {self.unit}/s"
            line += "" if self.total is None else f", {(self.total - done) / rate:.0f} s left"
        _print(line)


_told: set[str] = set()


def tell(line: str, *, once: bool | str = False) -> None:
    """Print a line to stderr, in the first process only; with ``once``, the same line is not printed again.

    A name as ``once`` stands for all lines with that name.
    """
    name = once if isinstance(once, str) else line
    if (once and name in _told) or (jax.distributed.is_initialized() and jax.process_index() > 0):
        return
    if once:
        _told.add(name)
    _print(line)


def _print(line: str) -> None:
    # In one call: threads would print between the line and its end.
    print(line + "\n", end="", file=sys.stderr, flush=True)

"""Lines on stderr: progress of long operations, with rate and time left, and notes."""

import sys
import time

import jax


class Progress:
    """Prints progress lines to stderr, identical on a terminal and in a pipe.

    The rate excludes the work before the first call, which often includes compilation. ``unit`` names the counted
    items, in the plural. Lines are at least ``every_s`` seconds apart; the last item always prints one. Without
    ``total``, lines have no time left.
    """

    def __init__(self, unit: str, total: int | None, *, every_s: float = 10.0) -> None:
        self.unit, self.total, self.every_s = unit, total, every_s
        self._began: tuple[float, int] | None = None
        self._next = 0.0

    def show(self, done: int, text: str = "") -> None:
        """Report ``done`` finished items, with ``text`` between the count and the rate."""
        now = time.monotonic()
        if self._began is None:
            self._began = now, done
        if now < self._next and done != self.total:
            return
        self._next = now + self.every_s
        began, first = self._began
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

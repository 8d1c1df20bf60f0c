"""Progress of long work: a line now and then, with rate and time left."""

import sys
import time


class Progress:
    """Prints how far the work is, the same on a terminal and in a pipe.

    The rate counts from the first call on, since the first piece of work often compiles or warms up something.

    Args:
        unit: what is counted, in the plural.
        total: how many there are.
        every_s: seconds between two lines; the last piece of work always has one.
    """

    def __init__(self, unit: str, total: int, *, every_s: float = 10.0) -> None:
        self.unit, self.total, self.every_s = unit, total, every_s
        self._began: tuple[float, int] | None = None
        self._next = 0.0

    def show(self, done: int, text: str = "") -> None:
        """So many are done; ``text`` stands between the count and the rate."""
        now = time.monotonic()
        if self._began is None:
            self._began = now, done
        if now < self._next and done < self.total:
            return
        self._next = now + self.every_s
        began, first = self._began
        line = f"{self.unit} {done}/{self.total}" + (f"  {text}" if text else "")
        if done > first and now > began:
            rate = (done - first) / (now - began)
            line += f"  {rate:.2f} {self.unit}/s, {(self.total - done) / rate:.0f} s left"
        print(line, file=sys.stderr, flush=True)

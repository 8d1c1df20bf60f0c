"""A headless Chromium or Chrome, driven over a pipe by the DevTools protocol, without a driver or a port."""

import base64
import contextlib
import dataclasses
import fcntl
import io
import json
import os
import select
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_OPTIONS = """
    --headless=new --no-sandbox --no-first-run --disable-background-networking --disable-dev-shm-usage
    --use-angle=swiftshader --enable-unsafe-swiftshader --remote-debugging-pipe
""".split()  # noqa: SIM905


def find_browser() -> str | None:
    """Path of an installed browser, or None."""
    return next(filter(None, map(shutil.which, _NAMES)), None)


@dataclasses.dataclass
class Browser:
    """The pipe to a browser, and the events it has sent."""

    to_browser: int
    from_browser: int
    timeout_s: float
    events: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    _rest: bytes = b""
    _number: int = 0

    def call(self, method: str, session: str | None = None, **params: Any) -> dict[str, Any]:
        """Call a method and wait for its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        message |= {"sessionId": session} if session else {}
        os.write(self.to_browser, json.dumps(message).encode() + b"\0")
        while (answer := self._read()).get("id") != self._number:
            self.events.append(answer)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return answer["result"]

    def wait_for(self, event: str, session: str) -> None:
        """Wait until an event has arrived, now or earlier."""
        while not any(e.get("method") == event and e.get("sessionId") == session for e in self.events):
            self.events.append(self._read())

    def _read(self) -> dict[str, Any]:
        end = time.monotonic() + self.timeout_s
        while b"\0" not in self._rest:
            if not select.select([self.from_browser], [], [], max(end - time.monotonic(), 0))[0]:
                raise TimeoutError(f"browser: no answer within {self.timeout_s:g} s")
            if not (data := os.read(self.from_browser, 1 << 20)):
                raise RuntimeError("browser: ended")
            self._rest += data
        message, self._rest = self._rest.split(b"\0", 1)
        return json.loads(message)


@contextlib.contextmanager
def start_browser(path: str, *, timeout_s: float = 120) -> Iterator[Browser]:
    """Start a browser with software rendering, which ends with the context."""
    ends = [*os.pipe(), *os.pipe()]
    # The child gets two ends as 3 and 4. All are moved upwards first, so that none is overwritten.
    high = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends]
    for end in ends:
        os.close(end)
    read, to_browser, from_browser, write = high
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        actions = [(os.POSIX_SPAWN_DUP2, read, 3), (os.POSIX_SPAWN_DUP2, write, 4)]
        actions += [(os.POSIX_SPAWN_OPEN, n, os.devnull, os.O_WRONLY, 0) for n in (1, 2)]
        arguments = [path, *_OPTIONS, f"--user-data-dir={profile}", "about:blank"]
        process = os.posix_spawn(path, arguments, os.environ, file_actions=actions)
        os.close(read)
        os.close(write)
        browser = Browser(to_browser, from_browser, timeout_s)
        try:
            yield browser
            browser.call("Browser.close")
        except BaseException:
            os.kill(process, signal.SIGKILL)
            raise
        finally:
            os.waitpid(process, 0)
            os.close(to_browser)
            os.close(from_browser)


@dataclasses.dataclass(frozen=True)
class Tab:
    """An open page."""

    browser: Browser
    session: str

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        return self.browser.call(method, self.session, **params)

    def events(self, method: str) -> list[dict[str, Any]]:
        """Parameters of this page's events so far."""
        own = (e for e in self.browser.events if e.get("sessionId") == self.session)
        return [e["params"] for e in own if e["method"] == method]

    def run(self, script: str) -> Any:
        """Evaluate an expression and await its value; raises RuntimeError if the script throws."""
        options = {"awaitPromise": True, "returnByValue": True}
        answer = self.call("Runtime.evaluate", expression=script, **options)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{script}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def settle(self) -> None:
        """Wait until pending changes are drawn."""
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def picture(self) -> np.ndarray:
        """A screenshot, u8[height, width, 3]."""
        from PIL import Image

        self.settle()
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def press(self, key: str) -> None:
        """Press and release a key by its name, such as ``ArrowRight`` or ``b``."""
        text = {"text": key} if len(key) == 1 else {}
        code = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}.get(key, 0)
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, windowsVirtualKeyCode=code, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key, windowsVirtualKeyCode=code)
        self.settle()


@contextlib.contextmanager
def open_tab(
    browser: Browser, url: str, *, width: int = 1280, height: int = 800, dark: bool = False
) -> Iterator[Tab]:
    """Load a page at a size in pixels. Narrow pages have a touch screen."""
    target = browser.call("Target.createTarget", url="about:blank")["targetId"]
    session = browser.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
    tab = Tab(browser, session)
    for domain in ("Network", "Page", "Runtime", "Log"):
        tab.call(f"{domain}.enable")
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    tab.call("Emulation.setDeviceMetricsOverride", **size)
    tab.call("Emulation.setTouchEmulationEnabled", enabled=width < 600)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    tab.call("Emulation.setEmulatedMedia", features=[scheme])
    tab.call("Page.navigate", url=url)
    browser.wait_for("Page.loadEventFired", session)
    yield tab
    browser.call("Target.closeTarget", targetId=target)

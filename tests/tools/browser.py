"""Headless Chromium for tests, driven over pipes by the DevTools protocol; tests skip where there is no browser.

Reference: https://chromedevtools.github.io/devtools-protocol/; messages are JSON that ends with a zero byte.
"""

import base64
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest

BROWSERS = ("chromium", "google-chrome", "chrome")
SOFTWARE_WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
QUIET = ("--no-first-run", "--no-default-browser-check", "--disable-background-networking", "--hide-scrollbars")
LOCAL = ("file:", "data:", "blob:", "about:")
REPLY_LIMIT_S = 90.0


def find_chromium() -> str:
    """Return the browser: `CHROMIUM` in the environment, or one on the PATH; skips the test without one."""
    found = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip("no Chromium: install one or set CHROMIUM to its path")
    return found


class BrowserPage:
    """One tab. `problems` collects console errors and warnings, uncaught exceptions and requests to a network."""

    def __init__(self, to_browser: int, from_browser: int) -> None:
        self.problems: list[str] = []
        self._write, self._read = to_browser, from_browser
        self._buffer, self._last_id = b"", 0
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command to the tab and return its result."""
        return self._call(method, session=self._session, **parameters)

    def resize(self, width_px: int, height_px: int, touch: bool = False) -> None:
        """Set the size of the window; touch: as of a telephone."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width_px, height=height_px, deviceScaleFactor=1, mobile=touch
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=touch)

    def open(self, file: Path) -> None:
        """Open a file and wait until `data-ready` is set on an element."""
        self.call("Page.navigate", url="about:blank")
        self.problems.clear()
        self.call("Page.navigate", url=file.resolve().as_uri())
        self.wait("document.querySelector('[data-ready]') !== null")

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; a promise is awaited."""
        reply = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in reply, reply["exceptionDetails"]
        return reply["result"].get("value")

    def wait(self, condition: str, limit_s: float = REPLY_LIMIT_S) -> None:
        """Wait until a JavaScript expression is true."""
        end_s = time.monotonic() + limit_s
        while not self.evaluate(f"Boolean({condition})"):
            assert time.monotonic() < end_s, f"not true after {limit_s} s: {condition}; {self.problems}"
            time.sleep(0.05)

    def press(self, key: str) -> None:
        """Press and release a key in the element with the focus."""
        text = {"text": key} if len(key) == 1 else {}
        code = {" ": "Space"}.get(key, key)
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code, **(text if kind == "keyDown" else {}))

    def screenshot(self) -> np.ndarray:
        """Return the window as RGB, (h, w, 3)."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)

    def _call(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        self._last_id += 1
        message: dict[str, Any] = {"id": self._last_id, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._write, data) :]
        while True:
            reply = self._receive()
            if reply.get("id") == self._last_id:
                assert "error" not in reply, (method, reply["error"])
                result: dict[str, Any] = reply["result"]
                return result
            self._note(reply.get("method", ""), reply.get("params", {}))

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], REPLY_LIMIT_S)
            assert ready, f"the browser does not answer after {REPLY_LIMIT_S} s"
            data = os.read(self._read, 1 << 20)
            assert data, "the browser ended"
            self._buffer += data
        text, self._buffer = self._buffer.split(b"\0", 1)
        message: dict[str, Any] = json.loads(text)
        return message

    def _note(self, method: str, event: dict[str, Any]) -> None:
        if method == "Runtime.consoleAPICalled" and event["type"] in ("error", "warning", "assert"):
            self.problems.append(" ".join(str(part.get("value", part.get("description"))) for part in event["args"]))
        elif method == "Runtime.exceptionThrown":
            self.problems.append(str(event["exceptionDetails"].get("exception", event["exceptionDetails"])))
        elif method == "Log.entryAdded" and event["entry"]["level"] in ("error", "warning"):
            self.problems.append(event["entry"]["text"])
        elif method == "Network.requestWillBeSent" and not event["request"]["url"].startswith(
            ("file:", "data:", "blob:")
        ):
            self.problems.append(f"requests {event['request']['url'][:80]}")


@contextmanager
def open_browser(width_px: int = 1000, height_px: int = 800) -> Iterator[BrowserPage]:
    """Start a browser with software WebGL and an empty tab; skips the test where there is none."""
    program = find_chromium()
    (read_3, write_3), (read_4, write_4) = os.pipe(), os.pipe()

    def connect_pipes() -> None:
        first, second = os.dup(read_3), os.dup(write_4)
        os.dup2(first, 3)
        os.dup2(second, 4)

    with TemporaryDirectory() as profile:
        options = ["--headless", "--no-sandbox", "--no-zygote", "--remote-debugging-pipe", f"--user-data-dir={profile}"]
        process = subprocess.Popen(
            [program, *options, *SOFTWARE_WEBGL, *QUIET],
            close_fds=False,
            preexec_fn=connect_pipes,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            page = BrowserPage(write_3, read_4)
            page.resize(width_px, height_px)
            yield page
        finally:
            process.kill()
            process.wait()
            for end in (read_3, write_3, read_4, write_4):
                os.close(end)

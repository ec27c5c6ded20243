"""A headless Chromium that opens a page and evaluates expressions in it, over the DevTools protocol's pipe."""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..core.errors import UserError

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--disable-background-networking", "--disable-sync"),
    *("--disable-component-update", "--disable-dev-shm-usage", "--hide-scrollbars", "--window-size=800,900"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
"""Software GL: checks must not depend on the machine's graphics."""

LOADING = 60
"""Seconds."""


class PageError(UserError):
    """The page threw, or Chromium did not answer."""


def find_chromium() -> str | None:
    """Path of an installed Chromium, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


def require_chromium() -> str:
    """Its path. Raises UserError where none is installed."""
    chromium = find_chromium()
    if chromium is None:
        raise UserError(f"no Chromium here (looked for {', '.join(NAMES)}); install one to check the page")
    return chromium


class Tab:
    """One page. ``evaluate`` waits for promises; ``picture`` is a PNG of what is seen."""

    def __init__(self, write: int, read: int) -> None:
        self._write, self._read = write, read
        self._rest, self._number, self._session = b"", 0, ""
        self.messages: list[str] = []

    def open(self, address: str) -> None:
        target = self._call("Target.createTarget", {"url": "about:blank"})["targetId"]
        self._session = self._call("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self._call(f"{domain}.enable", {})
        self._call("Page.navigate", {"url": address})
        until = time.monotonic() + LOADING
        while self.evaluate("document.readyState + location.protocol") != "complete" + address.split("//")[0]:
            if time.monotonic() > until:
                raise PageError(f"Chromium did not load {address} in {LOADING} s")
            time.sleep(0.05)

    def evaluate(self, expression: str, timeout: float = 120) -> Any:
        """The value of a JavaScript expression. Raises PageError where it throws or takes too long."""
        options = {"expression": expression, "awaitPromise": True, "returnByValue": True}
        answer = self._call("Runtime.evaluate", options, timeout)
        if "exceptionDetails" in answer:
            found = answer["exceptionDetails"].get("exception", {}).get("description", "unknown")
            raise PageError(f"the page says: {found}; {' | '.join(self.messages[-3:])}")
        return answer["result"].get("value")

    def picture(self) -> bytes:
        import base64

        return base64.b64decode(self._call("Page.captureScreenshot", {"format": "png"})["data"])

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """The left button down at ``start``, moved to ``end`` in ten steps, and up. CSS pixels."""
        moves = [[a + (b - a) * i / 10 for a, b in zip(start, end, strict=True)] for i in range(11)]
        for kind, (x, y) in [
            ("mousePressed", moves[0]),
            *(("mouseMoved", m) for m in moves),
            ("mouseReleased", moves[-1]),
        ]:
            event = {"type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1}
            self._call("Input.dispatchMouseEvent", event)

    def _call(self, method: str, parameters: dict[str, Any], timeout: float = 60) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._write, data) :]
        until = time.monotonic() + timeout
        while True:
            answer = self._next(until, method)
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise PageError(f"Chromium refuses {method}: {answer['error']['message']}")
                return answer["result"]
            if answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled"):
                self.messages.append(json.dumps(answer["params"])[:400])

    def _next(self, until: float, what: str) -> dict[str, Any]:
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._read], [], [], max(0.0, until - time.monotonic()))
            if not ready:
                raise PageError(f"Chromium did not answer {what} in time")
            part = os.read(self._read, 1 << 20)
            if not part:
                raise PageError(f"Chromium ended during {what}")
            self._rest += part
        line, self._rest = self._rest.split(b"\0", 1)
        return json.loads(line)


@contextmanager
def browser() -> Iterator[Tab]:
    """A Chromium of its own, with a profile of its own, ended afterwards. Raises UserError where none is installed."""
    chromium = require_chromium()
    to_child, write = os.pipe()
    read, from_child = os.pipe()
    with tempfile.TemporaryDirectory(prefix="dnrpipe-", ignore_cleanup_errors=True) as profile:
        # Chromium reads commands from descriptor 3 and answers on 4.
        line = f'exec "$0" "$@" 3<&{to_child} 4>&{from_child}'
        arguments = [chromium, *FLAGS, "--remote-debugging-pipe", f"--user-data-dir={Path(profile)}"]
        process = subprocess.Popen(
            ["bash", "-c", line, *arguments],
            pass_fds=(to_child, from_child),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_child)
        os.close(from_child)
        try:
            yield Tab(write, read)
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            os.close(write)
            os.close(read)

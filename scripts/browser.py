"""A page in headless Chromium, driven over its DevTools protocol (https://chromedevtools.github.io/devtools-protocol/)."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from websockets.sync.client import connect

_START_S = 30.0


def find() -> str | None:
    """Return the path of Chromium, None if it is not installed."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    return next((path for name in names if (path := shutil.which(name))), None)


class Page:
    """One open page. A context manager: leaving it removes the browser and its profile."""

    def __init__(self, program: str, address: str, *, width: int, height: int) -> None:
        self._profile = tempfile.TemporaryDirectory(prefix="skyloop-browser-", ignore_cleanup_errors=True)
        arguments = [program, "--headless=new", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-port=0"]
        arguments += [f"--user-data-dir={self._profile.name}", f"--window-size={width},{height}"]
        if os.geteuid() == 0:
            arguments.append("--no-sandbox")  # Chromium has no sandbox for the superuser
        self._process = subprocess.Popen(
            [*arguments, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            self._socket = connect(self._debugger(), max_size=None)
        except BaseException:
            self._end()
            raise
        self._number = 0
        self._call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        dark = {"name": "prefers-color-scheme", "value": "dark"}
        self._call("Emulation.setEmulatedMedia", features=[dark])
        self._call("Page.navigate", url=address)

    def screenshot(self) -> bytes:
        """Return the page's present picture, as PNG."""
        answer = self._call("Page.captureScreenshot", format="png")
        return base64.b64decode(answer["data"])

    def _debugger(self) -> str:
        """Return the WebSocket address of its first tab; the browser writes its port into its profile."""
        told = Path(self._profile.name) / "DevToolsActivePort"
        deadline = time.monotonic() + _START_S
        while not (told.exists() and "\n" in told.read_text()):
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError("Chromium did not start")
            time.sleep(0.05)
        port = told.read_text().splitlines()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=5.0) as answer:
            tabs = json.load(answer)
        address: str = next(tab["webSocketDebuggerUrl"] for tab in tabs if tab["type"] == "page")
        return address

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=_START_S))
            if message.get("id") == self._number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                result: dict[str, Any] = message["result"]
                return result

    def _end(self) -> None:
        self._process.terminate()
        self._process.wait(10)
        self._profile.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._socket.close()
        self._end()

"""Firefox for the tests of the page: driven by Playwright, like Chromium.

Playwright speaks WebDriver BiDi to an unpatched Firefox (channel ``moz-firefox``), but sends commands that Firefox
lacks, different ones in each release, and gives up at the first. ``launch`` therefore makes Playwright start this
module instead of Firefox: it starts Firefox, relays every message, and confirms the unknown ones. Tests set preferences
of the browser instead. A test opens it by ``browser.browser_and_cockpit("firefox")`` and then runs as in Chromium;
``fingers.on`` moves fingers in both. Start a browser once per file, as it takes seconds.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection, serve, unix_serve
from websockets.sync.client import unix_connect

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Playwright

FIREFOX = next((path for name in ("firefox-esr", "firefox") if (path := shutil.which(name))), None)
PREFERENCES: Mapping[str, str | float | bool] = {
    "dom.w3c_touch_events.enabled": 1,
    "webgl.force-enabled": True,
}
_SECOND = "SKYLOOP_TEST_BIDI"  #: in the environment: the path of the socket of a second client, beside Playwright
_SECOND_IDS = 1 << 40  #: the numbers of its commands begin here
_sockets: dict[Browser, str] = {}  #: where the second client of each reaches it
_OPTIONS: dict[str, Any] = {"max_size": None, "compression": None, "ping_interval": None}


@contextmanager
def launch(playwright: Playwright, preferences: Mapping[str, str | float | bool] = {}) -> Iterator[Browser]:
    """Run Firefox with these preferences in addition to ``PREFERENCES``, and remove its profile at the end.

    ``ui.primaryPointerCapabilities=1`` is a screen that is touched,
    ``layout.css.prefers-color-scheme.content-override=0`` a dark system, 1 a light one.
    """
    with tempfile.TemporaryDirectory(prefix="skyloop-firefox-") as folder:
        program = Path(folder) / "firefox"
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{__file__}" "$@"\n')
        program.chmod(0o700)
        browser = playwright.firefox.launch(
            channel="moz-firefox",
            executable_path=program,
            firefox_user_prefs={**PREFERENCES, **preferences},
            env={**os.environ, _SECOND: f"{folder}/bidi", "HOME": folder},
        )
        try:
            _skip_if_it_can_not_be_asked(browser)
            _sockets[browser] = f"{folder}/bidi"
            yield browser
        finally:
            _sockets.pop(browser, None)
            browser.close()


def _skip_if_it_can_not_be_asked(browser: Browser) -> None:
    """Work around Firefox 140.12, which applies a page's policy to Playwright's own scripts, so that nothing works."""
    page = browser.new_page()
    try:
        page.goto("data:text/html,<meta http-equiv='Content-Security-Policy' content=\"default-src 'self'\">")
        page.evaluate("1 + 1")
    except Exception as error:
        if "EvalError" not in str(error):
            raise
        pytest.skip("this Firefox keeps Playwright from pages with a Content-Security-Policy")
    finally:
        page.close()


@contextmanager
def bidi(browser: Browser) -> Iterator[Callable[..., dict[str, Any]]]:
    """Send a command without a Playwright call, and return its result (https://w3c.github.io/webdriver-bidi)."""
    with unix_connect(_sockets[browser], uri="ws://localhost", compression=None, max_size=None) as socket:
        numbers = count(_SECOND_IDS)

        def call(method: str, **parameters: Any) -> dict[str, Any]:
            socket.send(json.dumps({"id": next(numbers), "method": method, "params": parameters}))
            answer = json.loads(socket.recv(timeout=10.0))
            if answer["type"] != "success":
                raise RuntimeError(f"{method}: {answer['error']}: {answer['message']}")
            result: dict[str, Any] = answer["result"]
            return result

        yield call


class _Relay:
    """Relay messages between Playwright, a second client, and Firefox."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._firefox: ClientConnection | None = None
        self._second: ServerConnection | None = None

    async def playwright(self, client: ServerConnection) -> None:
        async with connect(self._address, **_OPTIONS) as self._firefox:
            down = asyncio.create_task(self._answers(self._firefox, client))
            async for text in client:
                await self._firefox.send(text)
            down.cancel()

    async def second(self, client: ServerConnection) -> None:
        self._second = client
        async for text in client:
            assert self._firefox is not None, "Playwright opens the session"
            await self._firefox.send(text)

    async def _answers(self, firefox: ClientConnection, client: ServerConnection) -> None:
        async for text in firefox:
            answer = json.loads(text)
            number = answer.get("id")
            if isinstance(number, int) and number >= _SECOND_IDS:
                if self._second is not None:
                    await self._second.send(text)
            elif answer.get("error") == "unknown command":
                await client.send(json.dumps({"type": "success", "id": number, "result": {}}))
            else:
                await client.send(text)


async def main() -> None:
    """Return Firefox, and where Playwright looks for it."""
    assert FIREFOX is not None, "no Firefox here"
    process = await asyncio.create_subprocess_exec(FIREFOX, *sys.argv[1:], stderr=asyncio.subprocess.PIPE)
    assert process.stderr is not None
    async for line in process.stderr:
        if found := re.search(rb"WebDriver BiDi listening on (ws://\S+)", line):
            relay = _Relay(f"{found[1].decode()}/session")
            break
        sys.stderr.buffer.write(line)
    else:
        sys.exit("Firefox did not start")
    async with (
        serve(relay.playwright, "127.0.0.1", 0, **_OPTIONS) as server,
        unix_serve(relay.second, os.environ[_SECOND], **_OPTIONS),
    ):
        port = next(iter(server.sockets)).getsockname()[1]
        print(f"WebDriver BiDi listening on ws://127.0.0.1:{port}", file=sys.stderr, flush=True)
        async for line in process.stderr:
            sys.stderr.buffer.write(line)
        await process.wait()


if __name__ == "__main__":
    asyncio.run(main())

"""The cockpit's page in a real browser, against real proxies: fixtures for the tests of the page."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pytest

from skyloop.cockpit.child import CockpitProcess
from tests.cockpit import firefox
from tests.support.processes import Process
from tests.support.systems import PLATFORM

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ConsoleMessage, Page, Playwright

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
PATIENCE_S = 30.0
IN_FIREFOX = pytest.mark.parametrize("open_cockpit", ["firefox"], indirect=True, scope="module")
IN_BOTH = pytest.mark.parametrize("open_cockpit", ["chromium", "firefox"], indirect=True, scope="module")
#: Firefox runs it in the empty page before this one, too, which has no storage.
PANELS = """
try { localStorage.getItem("skyloop-panels") ?? localStorage.setItem("skyloop-panels", "true"); } catch {}"""
WATCHED = "sim://?world=empty&cameras=front&width=320&fps=15"


class Deck:
    """A cockpit, its browser, and proxies started for one test."""

    def __init__(self, browser: Browser, address: str) -> None:
        self.address = address
        self._browser = browser
        self._processes: list[Process] = []
        self._contexts: list[Any] = []

    def proxy(self, name: str, uri: str = WATCHED) -> Process:
        """A proxy that serves; ended with the test."""
        process = Process("-m", "skyloop", "proxy", uri, "--name", name)
        self._processes.append(process)
        process.until("ready")
        return process

    def cockpit(self, *options: str) -> str:
        """Start another cockpit with options of ``skyloop cockpit``; return its address."""
        usual = self.address
        self.own_cockpit(*options)
        other, self.address = self.address, usual
        return other

    def own_cockpit(self, *options: str) -> Process:
        """Start another cockpit for later pages; it can be stopped."""
        process = Process("-m", "skyloop", "cockpit", "--port", "0", *options)
        self._processes.append(process)
        process.until("/\n")
        self.address = process.text.split("cockpit: ")[1].strip()
        return process

    def page(self, *names: str, prepare: str = "", panels: bool = True, **options: Any) -> DronePage:
        """Open the page with these drones, once it shows the last of them. ``prepare``: a script that runs first.

        The panels are shown beside the picture, as for a person who chose them, unless ``panels`` is false.
        """
        if panels:
            prepare += PANELS
        page = self._new_page(prepare, options)
        shown = DronePage(page, names[-1])
        page.goto(f"{self.address}#{','.join(names)}")
        page.locator(f'.pane[data-drone="{names[-1]}"][data-lost="false"]').wait_for(timeout=PATIENCE_S * 1000)
        return shown

    def overview(self, prepare: str = "", **options: Any) -> DronePage:
        """Open the page with all drones; a drone opened from it has its panels beside the picture."""
        page = self._new_page(prepare + PANELS, options)
        shown = DronePage(page, "")
        page.goto(f"{self.address}#/")
        return shown

    def _new_page(self, prepare: str, options: dict[str, Any]) -> Page:
        context = self._browser.new_context(**{"viewport": {"width": 1280, "height": 860}, **options})
        self._contexts.append(context)
        if prepare:
            context.add_init_script(prepare)
        return context.new_page()

    def end(self) -> None:
        for context in self._contexts:
            context.close()
        for process in self._processes:
            process.end()


class DronePage:
    """One open page, and its view of one drone."""

    def __init__(self, page: Page, drone: str) -> None:
        self.page = page
        self.problems: list[str] = []  #: errors in it, as reported by the browser
        self.pane = page.locator(f'.pane[data-drone="{drone}"]')
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("console", self._hear)

    def _hear(self, said: ConsoleMessage) -> None:
        if said.type == "error":
            self.problems.append(f"{said.text} {said.location['url']}")

    def press(self, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.press(key)

    def until(
        self, condition: Callable[[], bool], what: str | Callable[[], str], timeout_s: float = PATIENCE_S
    ) -> None:
        """Wait while the browser continues, never longer than this. ``what`` may be asked for when the time is over."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, (
                f"not within {timeout_s} s: {what() if callable(what) else what}; the page's problems: {self.problems}"
            )
            self.page.wait_for_timeout(20)

    def says(self, selector: str) -> str:
        """The text of a part of the drone's pane."""
        return self.pane.locator(selector).first.text_content() or ""

    def wait_for_text(self, selector: str, text: str) -> None:
        self.until(lambda: text in self.says(selector), lambda: f"{selector} says {text!r}: {self.says(selector)!r}")

    def begin_to_mark(self, press: Callable[[], object]) -> None:
        """Press until a box can be drawn: the cockpit is not asked while it answers late, and the picture is back."""
        layer, pressed_s = self.pane.locator(".follow-layer").first, 0.0

        def ready() -> bool:
            nonlocal pressed_s
            if not layer.is_visible():
                if time.monotonic() - pressed_s > 3.0:
                    pressed_s = time.monotonic()
                    press()
                return False
            return "Drag a box" in self.says(".follow-hint")

        self.until(ready, lambda: f"a box can be drawn; the hint is {self.says('.follow-hint')!r}")

    @contextmanager
    def holding(self, *keys: str) -> Iterator[None]:
        """Hold keys during the block."""
        for key in keys:
            self.page.keyboard.down(key)
        try:
            yield
        finally:
            for key in reversed(keys):
                self.page.keyboard.up(key)

    def attribute(self, selector: str, name: str) -> str:
        return self.pane.locator(selector).first.get_attribute(name) or ""

    def wait_for_new_picture(self) -> None:
        first = self.attribute(".camera", "data-seq")
        self.until(lambda: self.attribute(".camera", "data-seq") not in ("", first), "another picture")

    def ask_for_control(self) -> None:
        """Press the key, once the page is connected to the cockpit."""
        self.until(lambda: not self.pane.locator(".taking .primary").is_disabled(), "the line is open")
        self.press("c")

    def press_until(
        self,
        key: str,
        condition: Callable[[], bool],
        what: str,
        timeout_s: float = PATIENCE_S,
        *,
        again: Callable[[], bool] = lambda: True,
    ) -> None:
        """Act like a person: press again without effect, for example when late on a busy machine."""
        pressed_s = 0.0

        def done() -> bool:
            nonlocal pressed_s
            if condition():
                return True
            if time.monotonic() - pressed_s > 3.0 and again():
                pressed_s = time.monotonic()
                self.press(key)
            return False

        self.until(done, what, timeout_s)

    def take_control(self) -> None:
        """Press until this page has control."""
        self.press_until("c", lambda: self.pane.get_attribute("data-mine") == "true", "this page has control")

    def take_off(self) -> None:
        """Take control, and wait until it hovers."""
        self.take_control()
        hovers, stands = (lambda: "hovering" in self.says(".pill")), (lambda: "anded" in self.says(".pill"))
        self.press_until("t", hovers, "it hovers", 2 * PATIENCE_S, again=stands)


@contextmanager
def runtime() -> Iterator[None]:
    """A separate directory of sockets for these tests, with a short path, as sockets require."""
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        yield


@contextmanager
def _chromium(playwright: Playwright) -> Iterator[Browser]:
    arguments = ["--enable-unsafe-swiftshader"]  # 3-D without a graphics card
    if os.geteuid() == 0:
        arguments.append("--no-sandbox")  # Chromium has no sandbox for the superuser
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
    yield browser
    browser.close()


@contextmanager
def browser_and_cockpit(name: Literal["chromium", "firefox"] = "chromium") -> Iterator[tuple[Browser, str]]:
    """A browser, and the address of a cockpit that shows every proxy as it appears. Skips without a browser."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="the tests of the page need: pip install playwright")
    if PLATFORM != "linux":
        pytest.skip(f"not on {PLATFORM}: the cockpit pairs one browser there, and these tests open many")
    if {"chromium": CHROMIUM, "firefox": firefox.FIREFOX}[name] is None:
        pytest.skip(f"no {name} here (Debian: apt install chromium firefox-esr)")
    with (
        runtime(),
        tempfile.TemporaryDirectory(prefix="skyloop-recordings-") as folder,
        CockpitProcess(recordings=Path(folder)) as cockpit,
        sync_api.sync_playwright() as playwright,
        _chromium(playwright) if name == "chromium" else firefox.launch(playwright) as browser,
    ):
        yield browser, cockpit.address()

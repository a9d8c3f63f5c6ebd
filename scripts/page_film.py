"""A film of a page in a browser, at true speed, with the mouse: for ``cockpit_pictures.py``."""

from __future__ import annotations

import base64
import io
import itertools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from PIL import Image
from playwright.sync_api import Locator, Page

EVERY_S: Final = 0.12
_WIDTH: Final = 560
_LAST_MS: Final = 1500
_QUALITIES: Final = (60, 45, 35, 30, 25, 20, 15)
_MOVE_S: Final = 0.5
_DRAWN_MS: Final = 15  # after its arrival
#: Headless browsers draw no mouse: an arrow that follows the mouse, and a ring while it is pressed.
_MOUSE: Final = """() => {
  const make = (name, attributes) => {
    const one = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) one.setAttribute(key, value);
    return one;
  };
  const arrow = make("svg", { width: 44, height: 44, viewBox: "-16 -16 44 44" });
  const ring = make("circle", { r: 11, fill: "none", stroke: "#fff", "stroke-width": 3, visibility: "hidden" });
  const shape = "M0 0V19L4.6 14.6 7.6 21.6 10.8 20.2 7.9 13.4H14Z";
  arrow.append(ring, make("path", { d: shape, fill: "#fff", stroke: "#000", "stroke-width": 1.4 }));
  const style = { position: "fixed", left: 0, top: 0, "z-index": 2147483647, "pointer-events": "none" };
  for (const [key, value] of Object.entries(style)) arrow.style.setProperty(key, value);
  const follow = (event) => {
    const top = document.fullscreenElement ?? document.body;
    if (arrow.parentNode !== top) top.append(arrow);
    arrow.style.setProperty("translate", `${event.clientX - 16}px ${event.clientY - 16}px`);
    ring.setAttribute("visibility", event.buttons ? "visible" : "hidden");
  };
  for (const kind of ["pointermove", "pointerdown", "pointerup"]) addEventListener(kind, follow, { capture: true });
}"""


class Shown:
    """The frame of a drone's only camera on a page, from the page's messages after its next load."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._newest_ns: int | None = None
        page.on("websocket", lambda socket: socket.on("framereceived", self._received))

    @property
    def captured_ns(self) -> int:
        """Capture time of the newest frame."""
        while self._newest_ns is None:
            self._page.wait_for_timeout(10)
        return self._newest_ns

    def wait_for_next(self) -> None:
        """Wait until another frame has arrived and is on the screen."""
        before = self.captured_ns
        while self.captured_ns == before:
            self._page.wait_for_timeout(2)
        self._page.wait_for_timeout(_DRAWN_MS)

    def _received(self, message: str | bytes) -> None:
        if isinstance(message, bytes):  # the length of its head, the head, a JPEG
            head = json.loads(message[4 : 4 + int.from_bytes(message[:4], "big")])
            self._newest_ns = int(head["captured_ns"])


@dataclass
class PageFilm:
    """Takes pictures of a page during actions on it.

    Attributes:
        watch: Called with each picture.
        times_s: The time of each.
    """

    page: Page
    watch: Callable[[], None] = lambda: None
    times_s: list[float] = field(default_factory=list)
    _shots: list[bytes] = field(default_factory=list)
    _at: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        self._session = self.page.context.new_cdp_session(self.page)

    def begin(self, x: float, y: float) -> None:
        """Show the mouse at this place [CSS pixels]."""
        self.page.evaluate(_MOUSE)
        self._at = x, y
        self.page.mouse.move(x, y)

    def shoot(self, seconds: float = 0.0) -> None:
        """Take pictures for this time; at least one."""
        end_s = time.monotonic() + seconds
        while True:
            begun_s = time.monotonic()
            self._shots.append(self._picture())
            self.times_s.append((begun_s + time.monotonic()) / 2)
            self.watch()
            left_s = begun_s + EVERY_S - time.monotonic()
            self.page.wait_for_timeout(max(1.0, 1000 * left_s))
            if time.monotonic() >= end_s:
                return

    def shoot_until(self, seen: Locator) -> None:
        """Take pictures until something is on the page."""
        while not seen.is_visible():
            self.shoot()

    def move(self, x: float, y: float, seconds: float = _MOVE_S) -> None:
        """Move the mouse like a hand: slowly at both ends."""
        (from_x, from_y), begun_s = self._at, time.monotonic()
        share = 0.0
        while share < 1.0:
            share = min(1.0, (time.monotonic() - begun_s + EVERY_S) / seconds)
            eased = share * share * (3.0 - 2.0 * share)
            self.page.mouse.move(from_x + eased * (x - from_x), from_y + eased * (y - from_y))
            self.shoot()
        self._at = x, y

    def click(self, button: Locator) -> None:
        """Move to the centre of a button, and press it."""
        self.move(*_middle(button))
        self._at = _middle(button)  # its text may have changed its width meanwhile
        self.page.mouse.move(*self._at)
        self.page.mouse.down()
        self.page.mouse.up()
        self.shoot()

    def _picture(self) -> bytes:
        """Take a picture like Playwright, but without waiting for fonts, and compressed for speed."""
        taken = self._session.send(
            "Page.captureScreenshot", {"format": "jpeg", "quality": 95, "optimizeForSpeed": True}
        )
        return base64.b64decode(taken["data"])

    def save(self, path: Path, most_bytes: int) -> None:
        """Write an animated WebP that plays in real time, in the best quality that fits.

        Raises:
            SystemExit: It does not fit.
        """
        pictures = [Image.open(io.BytesIO(shot)).convert("RGB") for shot in self._shots]
        height = round(pictures[0].height * _WIDTH / pictures[0].width)
        pictures = [one.resize((_WIDTH, height), Image.Resampling.HAMMING) for one in pictures]
        begins = [round(1000 * (at - self.times_s[0])) for at in self.times_s]
        lasts = [after - before for before, after in itertools.pairwise(begins)] + [_LAST_MS]
        for quality in _QUALITIES:
            pictures[0].save(
                path, save_all=True, append_images=pictures[1:], duration=lasts, loop=0, quality=quality, method=4
            )
            size = path.stat().st_size
            if size <= most_bytes:
                took_s = self.times_s[-1] - self.times_s[0]
                print(
                    f"{path.name}: {_WIDTH}×{height}, {len(pictures)} pictures of {took_s:.1f} s, "
                    f"{(len(pictures) - 1) / took_s:.1f} a second, at most {max(lasts[:-1])} ms apart, "
                    f"quality {quality}, {size:,} bytes"
                )
                return
        raise SystemExit(f"{path.name} has {size:,} bytes, more than {most_bytes:,}")


def _middle(button: Locator) -> tuple[float, float]:
    box = button.bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

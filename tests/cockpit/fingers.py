"""Fingers on the page, in Chromium (DevTools protocol) and Firefox (WebDriver BiDi) alike."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

from tests.cockpit.browser import Deck, DronePage
from tests.cockpit.firefox import bidi

if TYPE_CHECKING:
    from playwright.sync_api import Page

Places = dict[str, tuple[float, float]]
Send = Callable[[Literal["touchStart", "touchMove", "touchEnd"], str, Places], None]


class Fingers:
    """Any number of named fingers, at places on the screen in CSS pixels from the upper left corner."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self.places: Places = {}

    def put(self, finger: str, x: float, y: float) -> None:
        """Put a finger there, or move it if it is on the screen."""
        moves = finger in self.places
        self.places[finger] = (x, y)
        self._send("touchMove" if moves else "touchStart", finger, self.places)

    def lift(self, finger: str) -> None:
        """Take a finger away."""
        self._send("touchEnd", finger, {name: place for name, place in self.places.items() if name != finger})
        del self.places[finger]


@contextmanager
def on(page: Page) -> Iterator[Fingers]:
    """Fingers on this page; those that are still there at the end are lifted::

    with fingers.on(page.page) as hand:
        hand.put("left", 100, 700)
        hand.put("left", 100, 640)  # the same finger: moves there
        hand.lift("left")
    """
    browser = page.context.browser
    assert browser is not None
    with _firefox(page) if browser.browser_type.name == "firefox" else _chromium(page) as send:
        hand = Fingers(send)
        yield hand
        for finger in list(hand.places):
            hand.lift(finger)


@contextmanager
def _chromium(page: Page) -> Iterator[Send]:
    session = page.context.new_cdp_session(page)
    numbers: dict[str, int] = {}

    def send(what: str, finger: str, places: Places) -> None:
        numbers.setdefault(finger, len(numbers))
        points = [{"x": x, "y": y, "id": numbers[name]} for name, (x, y) in places.items()]
        session.send("Input.dispatchTouchEvent", {"type": what, "touchPoints": points})

    yield send
    session.detach()


@contextmanager
def _firefox(page: Page) -> Iterator[Send]:
    browser = page.context.browser
    assert browser is not None
    with bidi(browser) as call:
        name = uuid4().hex  # identifies this page, as Playwright does not reveal Firefox's name for it
        page.evaluate("name => { window.name = name; }", name)

        def named(context: str) -> bool:
            target = {"context": context}
            said = call("script.evaluate", expression="window.name", target=target, awaitPromise=False)
            return bool(said["result"].get("value") == name)

        tabs = [str(tab["context"]) for tab in call("browsingContext.getTree")["contexts"]]
        tab = next(tab for tab in tabs if named(tab))

        def send(what: str, finger: str, places: Places) -> None:
            actions: list[dict[str, Any]] = []
            if what != "touchEnd":
                x, y = places[finger]
                actions.append({"type": "pointerMove", "x": round(x), "y": round(y)})
            if what != "touchMove":
                actions.append({"type": "pointerDown" if what == "touchStart" else "pointerUp", "button": 0})
            source = {"type": "pointer", "id": finger, "parameters": {"pointerType": "touch"}, "actions": actions}
            call("input.performActions", context=tab, actions=[source])

        yield send


PORTRAIT, LANDSCAPE, TABLET = (390, 844), (844, 390), (1024, 768)
FINGER_PX = 44.0
FELT = "window.felt = []; navigator.vibrate = (pattern) => felt.push(pattern);"
#: What can be pressed and seen, and is smaller than a finger: name, width, height.
SMALL = """(least) => [...document.querySelectorAll("button, .button, select, input")]
  .filter((one) => one.checkVisibility({visibilityProperty: true, opacityProperty: true}))
  .map((one) => [one.getAttribute("aria-label") ?? one.textContent, one.getBoundingClientRect()])
  .map(([name, box]) => [name, box.width, box.height])
  .filter(([, width, height]) => width > 0 && (width < least - 0.5 || height < least - 0.5))"""


def touched(deck: Deck, drone: str, size: tuple[int, int]) -> DronePage:
    """The page on a touch screen of this size."""
    viewport = {"width": size[0], "height": size[1]}
    return deck.page(drone, prepare=FELT, viewport=viewport, has_touch=True, is_mobile=True)


def take_control(page: DronePage) -> None:
    take = page.pane.get_by_role("button", name="Take control")
    page.until(lambda: not take.is_disabled(), "the line to the cockpit is open")
    take.tap()
    page.until(lambda: page.pane.get_attribute("data-mine") == "true", "this page has control")


def tap_until(page: DronePage, name: str, state: str) -> None:
    """Tap again if the first tap came too late to count, as on a busy machine."""
    tapped_s = -math.inf

    def reached() -> bool:
        nonlocal tapped_s
        if time.monotonic() - tapped_s > 4.0 and "ing" not in page.says(".pill").replace("hovering", ""):
            tapped_s = time.monotonic()
            page.pane.get_by_role("button", name=name).tap()
        return state in page.says(".pill")

    page.until(reached, f"it is {state} after {name}", timeout_s=30.0)

"""Fingers on the page, in Chromium (DevTools protocol) and Firefox (WebDriver BiDi) alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

from tests.cockpit.firefox import bidi

if TYPE_CHECKING:
    from playwright.sync_api import Page

Places = dict[str, tuple[float, float]]
Send = Callable[[Literal["touchStart", "touchMove", "touchEnd"], str, Places], None]


class Fingers:
    """Any number of fingers, each by its name, at places on the screen in CSS pixels from the upper left corner."""

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
        name = uuid4().hex  # what tells this page from the others, as Playwright does not say what Firefox calls it
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

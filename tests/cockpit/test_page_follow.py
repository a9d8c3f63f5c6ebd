"""Following a target marked on the picture, by mouse and by finger: a simulated person, the real tracker and law."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import pytest

import skyloop
from skyloop.client import Drone, Frame
from skyloop.messages import Feedback, FlightState, Polyline, Text
from tests.cockpit import fingers
from tests.cockpit.browser import Deck, DronePage
from tests.cockpit.fingers import FINGER_PX, PORTRAIT, SMALL, tap_until, touched
from tests.cockpit.fingers import take_control as tap_control
from tests.cockpit.walker import Box, Walker

pytestmark = pytest.mark.process
Edges = tuple[float, float, float, float]  #: left, top, right, bottom [CSS pixels]


class Sight:
    """The person's place in the page's pictures, which are old on a busy machine."""

    def __init__(self, page: DronePage, walker: Walker, drone: Drone) -> None:
        self._page, self._walker = page, walker
        self._states: deque[Feedback] = deque(maxlen=2000)
        drone.on_feedback(self._states.append, inline=True)
        page.until(lambda: bool(self._states), "it is known where the drone is")

    def on_screen(self, captured: str = "") -> Edges:
        """Return the person's place in the picture of a capture; by default, in the one on the screen."""
        captured_ns = int(captured or self._page.attribute(".camera", "data-drawn"))
        state = min(list(self._states), key=lambda state: abs(state.captured_ns - captured_ns))
        return on_screen(self._page, self._walker.box(state))

    def draw(
        self, press: Callable[[float, float], None], drag: Callable[[float, float], None], lift: Callable[[], None]
    ) -> None:
        """Drag a box around the person in the frozen picture; again if another one is shown by then."""
        page = self._page
        still = page.pane.locator(".still")

        def pressed() -> bool:
            left, top, right, _ = self.on_screen()
            press(left, top)
            page.until(
                lambda: still.is_visible() or "One moment" in page.says(".follow-hint"), "the picture stands still"
            )
            if not still.is_visible():  # the cockpit did not keep that frame
                lift()
                return False
            stands = self.on_screen(page.attribute(".still", "data-captured"))
            if abs(stands[0] - left) < 0.15 * (right - left):
                return True
            lift()  # too small for a box
            page.until(lambda: not still.is_visible(), "it goes on")
            return False

        page.until(pressed, "the picture is the one that was looked at")
        left, _, right, bottom = self.on_screen(page.attribute(".still", "data-captured"))
        drag((left + right) / 2, bottom)
        drag(right, bottom)


def on_screen(page: DronePage, box: Box) -> Edges:
    """Return left, top, right and bottom of a box of the picture on the screen, a little loosely [CSS pixels]."""
    x, y, width, height = box
    picture = page.pane.locator(".video").first.bounding_box()
    assert picture is not None
    columns, rows = (int(page.attribute(".video", side)) for side in ("width", "height"))
    scale = min(picture["width"] / columns, picture["height"] / rows)
    left = picture["x"] + (picture["width"] - columns * scale) / 2
    top = picture["y"] + (picture["height"] - rows * scale) / 2
    edges = (left + (x - 1) * scale, top + (y - 1) * scale, left + (x + width + 1) * scale)
    return (*edges, top + (y + height + 1) * scale)


def distance_m(walker: Walker, drone: Drone) -> float:
    native = dict(drone.feedback().native or {})
    return math.dist(*([float(native[f"truth.{one}{axis}"]) for axis in "xy"] for one in ("", "walker.")))  # type: ignore[arg-type]


def place_x(drone: Drone) -> float:
    position = drone.feedback().position_m
    assert position is not None
    return position[0]


def detected(walker: Walker, drone: Drone, frame: Frame) -> None:
    """Draw like ``skyloop detect``."""
    if frame.feedback is not None:
        x, y, width, height = walker.box(frame.feedback)
        corners = ((x, y), (x + width, y), (x + width, y + height), (x, y + height))
        drone.annotate(frame, [Polyline(corners, closed=True), Text("person 0.91", (x, y))], source="detections")


def picture(page: DronePage, name: str) -> None:
    if folder := os.environ.get("SKYLOOP_PICTURES"):
        page.page.screenshot(path=f"{folder}/{name}.png")


def test_a_person_is_marked_with_the_mouse_and_followed(deck: Deck, tmp_path: Path) -> None:
    walker = Walker(tmp_path)
    deck.proxy("chaser", walker.uri)
    page = deck.page("chaser")
    with skyloop.connect("chaser", access="observe", name="test") as drone:
        page.take_off()
        page.wait_for_new_picture()
        sight, mouse = Sight(page, walker, drone), page.page.mouse
        began_m = place_x(drone)
        page.begin_to_mark(lambda: page.press("f"))

        def press(x: float, y: float) -> None:
            mouse.move(x, y)
            mouse.down()

        sight.draw(press, lambda x, y: mouse.move(x, y, steps=3), mouse.up)
        picture(page, "follow-drag")
        mouse.up()
        panel = page.pane.get_by_role("region", name="Target")

        def chosen_by_enter() -> bool:
            focused = "(button) => button === document.activeElement"
            return bool(panel.get_by_role("button", name="Follow").evaluate(focused))

        page.wait_for_text(".follow-phase", "Tracking, not flying")
        picture(page, "follow-marked")
        assert drone.feedback().state is FlightState.HOVERING, "nothing flies yet"
        page.until(chosen_by_enter, "the panel can be read by now")
        page.press("Enter")
        page.wait_for_text(".follow-phase", "following")
        assert panel.get_by_role("button", name="Follow").get_attribute("aria-pressed") == "true"
        page.until(lambda: place_x(drone) > began_m + 1.0, "it flies after the person", 15.0)
        page.wait_for_text(".follow-figures", "%")
        assert distance_m(walker, drone) > 2.0
        picture(page, "follow-flying")
        width = page.page.evaluate("document.querySelector('.follow-panel').offsetWidth")
        assert width <= 420, "the panel leaves the picture and the map beside it free"
        panel.get_by_role("button", name="Stop").click()
        page.until(lambda: drone.feedback().state is FlightState.HOVERING, "it hovers")
        page.until(lambda: not panel.is_visible(), "the panel is closed")

        # A processor's detection is chosen by a click, without dragging.
        drone.on_frame(lambda frame: detected(walker, drone, frame))
        page.begin_to_mark(lambda: page.press("f"))

        def hover_over_it() -> bool:
            left, top, right, bottom = sight.on_screen()
            mouse.move((left + right) / 2, (top + bottom) / 2)
            return bool(page.pane.locator(".follow-box", has_text="person").is_visible())

        def chosen() -> bool:
            hover_over_it()
            mouse.down()
            mouse.up()
            return bool(panel.is_visible())

        page.until(hover_over_it, "what is under the mouse is shown")
        picture(page, "follow-detection")
        page.until(chosen, "it is chosen, although the drone still swings")
        page.wait_for_text(".follow-phase", "Tracking, not flying")
        page.until(chosen_by_enter, "the panel can be read by now")
        page.press("Enter")
        page.until(lambda: drone.feedback().state is FlightState.FLYING, "it flies")
        page.press("h")
        page.until(lambda: drone.feedback().state is FlightState.HOVERING, "the key that hovers stops it")
        page.until(lambda: not panel.is_visible(), "for good")
    assert page.problems == []


def test_a_person_is_marked_with_a_finger_and_followed(deck: Deck, tmp_path: Path) -> None:
    walker = Walker(tmp_path)
    deck.proxy("pocket", walker.uri)
    page = touched(deck, "pocket", PORTRAIT)
    with skyloop.connect("pocket", access="observe", name="test") as drone:
        sight = Sight(page, walker, drone)
        page.wait_for_new_picture()
        tap_control(page)
        tap_until(page, "Take off", "hovering")
        began_m = place_x(drone)
        page.begin_to_mark(page.pane.get_by_role("button", name="Follow something in camera front").tap)
        picture(page, "follow-phone-hint")
        with fingers.on(page.page) as hand:

            def put(x: float, y: float) -> None:
                hand.put("finger", x, y)

            sight.draw(put, put, lambda: hand.lift("finger"))
            hand.lift("finger")
        page.wait_for_text(".follow-phase", "Tracking, not flying")
        picture(page, "follow-phone-marked")
        panel = page.pane.get_by_role("region", name="Target")
        tapped_s = -math.inf

        def follows() -> bool:  # tap again if the panel had moved with the person before the finger came down
            nonlocal tapped_s
            if "Tracking" in page.says(".follow-phase") and time.monotonic() - tapped_s > 4.0:
                tapped_s = time.monotonic()
                panel.get_by_role("button", name="Follow").tap()
            return "following" in page.says(".follow-phase")

        page.until(follows, "it follows", 30.0)
        page.until(lambda: place_x(drone) > began_m + 1.0, "it flies after the person", 15.0)
        picture(page, "follow-phone-flying")
        assert page.page.evaluate(SMALL, FINGER_PX) == [], "all is as large as a finger"
        panel.get_by_role("button", name="Stop").tap()
        page.until(lambda: drone.feedback().state is FlightState.HOVERING, "it hovers")
        page.until(lambda: not panel.is_visible(), "the panel is closed")
    assert page.problems == []

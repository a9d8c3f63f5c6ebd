"""Following what is marked on the picture, by mouse and by finger: a simulated person, the real tracker and law."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path

import pytest

import skyloop
from skyloop.client import Drone, Frame
from skyloop.messages import FlightState, Polyline, Text
from tests.cockpit import fingers
from tests.cockpit.browser import Deck, DronePage
from tests.cockpit.test_page_touch import FINGER_PX, PORTRAIT, SMALL, tap_until, touched
from tests.cockpit.test_page_touch import take_control as tap_control
from tests.cockpit.walker import Walker

pytestmark = pytest.mark.process


def on_screen(page: DronePage, walker: Walker, drone: Drone) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of the person in the picture on the screen, a little loosely [CSS pixels]."""
    x, y, width, height = walker.box(drone.feedback())
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
    """What ``skyloop detect`` would draw."""
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
        began_m = place_x(drone)
        page.press("f")
        page.wait_for_text(".follow-hint", "Drag a box")
        left, top, right, bottom = on_screen(page, walker, drone)
        mouse = page.page.mouse
        mouse.move(left, top)
        mouse.down()
        mouse.move((left + right) / 2, bottom, steps=3)
        mouse.move(right, bottom)
        page.until(lambda: page.pane.locator(".still").is_visible(), "the picture stands still")
        picture(page, "follow-drag")
        mouse.up()
        panel = page.pane.get_by_role("region", name="Target")

        def chosen_by_enter() -> bool:
            focused = "(button) => button === document.activeElement"
            return bool(panel.get_by_role("button", name="Follow").evaluate(focused))

        page.wait_for_text(".follow-phase", "Tracked: nothing flies")
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

        # What a processor draws is chosen by a click; nothing is dragged.
        drone.on_frame(lambda frame: detected(walker, drone, frame))
        page.press("f")
        page.wait_for_text(".follow-hint", "Drag a box")

        def hover_over_it() -> bool:
            left, top, right, bottom = on_screen(page, walker, drone)
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
        page.wait_for_text(".follow-phase", "Tracked: nothing flies")
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
        page.wait_for_new_picture()
        tap_control(page)
        tap_until(page, "Take off", "hovering")
        began_m = place_x(drone)
        page.pane.get_by_role("button", name="Follow something in camera front").tap()
        page.wait_for_text(".follow-hint", "Drag a box")
        picture(page, "follow-phone-hint")
        left, top, right, bottom = on_screen(page, walker, drone)
        with fingers.on(page.page) as hand:
            hand.put("finger", left, top)
            hand.put("finger", (left + right) / 2, bottom)
            hand.put("finger", right, bottom)
            hand.lift("finger")
        page.wait_for_text(".follow-phase", "Tracked: nothing flies")
        picture(page, "follow-phone-marked")
        panel = page.pane.get_by_role("region", name="Target")
        tapped_s = -math.inf

        def follows() -> bool:  # tapped again where the panel had moved on with the person before the finger came down
            nonlocal tapped_s
            if "Tracked" in page.says(".follow-phase") and time.monotonic() - tapped_s > 4.0:
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

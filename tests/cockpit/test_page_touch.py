"""The page under fingers: the flight mode on a phone and a tablet, the size of touch targets, and alarms."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import pytest

import skyloop
from skyloop.messages import FlightState
from tests.cockpit import fingers
from tests.cockpit.browser import Deck, DronePage
from tests.cockpit.fingers import FINGER_PX, LANDSCAPE, PORTRAIT, SMALL, TABLET, take_control, tap_until, touched

if TYPE_CHECKING:
    pass

pytestmark = pytest.mark.process

NARROW = (360, 740)
STILL = "[scrollX, scrollY, document.scrollingElement.scrollTop, visualViewport.scale, visualViewport.pageTop].join()"


def in_flight_mode(page: DronePage) -> bool:
    return bool(page.pane.get_attribute("data-flight") == "true")


def box(page: DronePage, selector: str, place: int = 0) -> dict[str, float]:
    found = page.pane.locator(selector).nth(place).bounding_box()
    assert found is not None, f"{selector} is seen"
    return {
        "left": found["x"],
        "top": found["y"],
        "right": found["x"] + found["width"],
        "bottom": found["y"] + found["height"],
    }


def within(inner: dict[str, float], outer: dict[str, float]) -> bool:
    less = all(outer[side] <= inner[side] + 0.5 for side in ("left", "top"))
    return less and all(inner[side] <= outer[side] + 0.5 for side in ("right", "bottom"))


def apart(one: dict[str, float], other: dict[str, float]) -> bool:
    beside = one["right"] <= other["left"] or other["right"] <= one["left"]
    return beside or one["bottom"] <= other["top"] or other["bottom"] <= one["top"]


def check_arrangement(page: DronePage, size: tuple[int, int]) -> None:
    """Check that both sticks are on the picture, all on one screen, and nothing is covered."""
    screen = {"left": 0.0, "top": 0.0, "right": float(size[0]), "bottom": float(size[1])}
    video, stop, holder = box(page, ".video"), box(page, ".strip .stop"), box(page, ".holder")
    sticks = [box(page, ".thumb", place) for place in (0, 1)]
    assert within(screen, video), "the picture has the whole screen"
    assert within(stop, screen)
    for stick in sticks:
        assert within(stick, screen)
        assert within(stick, video)
        assert stick["right"] - stick["left"] >= 2 * FINGER_PX
        assert apart(stick, stop)
        for button in page.pane.locator("button:visible").all():
            found = button.bounding_box()
            assert found is not None
            edges = {"left": found["x"], "top": found["y"]}
            edges |= {"right": found["x"] + found["width"], "bottom": found["y"] + found["height"]}
            assert apart(stick, edges), button.text_content()
            assert within(edges, screen), button.text_content()
            assert apart(holder, edges), f"the holder of control is written below {button.text_content()}"
    assert sticks[0]["left"] < 0.05 * size[0] + 12
    assert sticks[1]["right"] > 0.95 * size[0] - 12
    for shown in (".pill", ".battery", ".hud", ".holder", ".chip.age"):
        assert within(box(page, shown), screen), shown
    assert page.page.evaluate(SMALL, FINGER_PX) == []


def check_head(page: DronePage) -> None:
    """Check that on a narrow phone, too, everything in the head has its own place, even with a full battery."""
    page.page.set_viewport_size({"width": NARROW[0], "height": NARROW[1]})
    page.until(lambda: "100 %" in page.says(".battery"), "the battery is full")
    parts = {name: box(page, name) for name in (".fly", "h2", ".pill", ".battery", ".full", ".hud", ".chip.age")}
    for one, other in itertools.combinations(parts, 2):
        assert apart(parts[one], parts[other]), f"{one} and {other}: {parts}"
    assert parts[".full"]["top"] == parts[".fly"]["top"], "in the corner"
    page.page.set_viewport_size({"width": PORTRAIT[0], "height": PORTRAIT[1]})


def test_a_flight_on_a_telephone(deck: Deck) -> None:
    deck.proxy("phone")
    page = touched(deck, "phone", PORTRAIT)
    page.until(lambda: in_flight_mode(page), "a telephone has the flight mode by itself")
    with skyloop.connect("phone", access="observe", name="test") as drone:
        page.wait_for_new_picture()
        still = page.page.evaluate(STILL)
        take_control(page)
        check_arrangement(page, PORTRAIT)
        check_head(page)
        tap_until(page, "Take off", "hovering")
        left, right = (page.pane.locator(".thumb").nth(place).bounding_box() for place in (0, 1))
        assert left is not None
        assert right is not None

        def flies() -> bool:
            forward, _, up = drone.feedback().velocity_m_s or (0.0, 0.0, 0.0)
            return forward > 0.2 and up > 0.1

        with fingers.on(page.page) as hand:
            for name, pad in (("left", left), ("right", right)):
                hand.put(name, pad["x"] + pad["width"] / 2, pad["y"] + pad["height"] / 2)
            for name, pad in (("left", left), ("right", right)):
                hand.put(name, pad["x"] + pad["width"] / 2, pad["y"] + 6)
            page.until(flies, "two thumbs fly it forward and up")
        page.until(lambda: drone.feedback().state is FlightState.HOVERING, "it hovers when they are lifted")
        assert page.page.evaluate(STILL) == still, "nothing scrolls, nothing is enlarged"
        # Swipes beside the sticks would scroll or reload the page.
        with fingers.on(page.page) as hand:
            for y in (200, 300, 420, 560):
                hand.put("swipe", 195, y)
        assert page.page.evaluate(STILL) == still
        tap_until(page, "Return", "landed")
        start, there = drone.start_position, drone.feedback().position_m
        assert start is not None
        assert there is not None
        assert math.dist(start[:2], there[:2]) < 0.6
    page.page.go_back()
    page.until(lambda: not in_flight_mode(page), "Back leaves it")
    assert page.pane.get_attribute("data-mine") == "true", "and nothing else"
    assert page.page.evaluate(SMALL, FINGER_PX) == []
    assert page.page.evaluate("document.documentElement.scrollWidth") <= PORTRAIT[0], "nothing beside the screen"
    assert page.problems == []


@pytest.mark.parametrize("size", [LANDSCAPE, TABLET])
def test_the_flight_mode_on_its_side_and_on_a_tablet(deck: Deck, size: tuple[int, int]) -> None:
    deck.proxy("wide")
    page = touched(deck, "wide", size)
    if size == TABLET:
        assert not in_flight_mode(page), "there is room for all: it is offered"
        page.pane.get_by_role("button", name="Flight mode").tap()
    page.until(lambda: in_flight_mode(page), "the flight mode")
    page.wait_for_new_picture()
    take_control(page)
    check_arrangement(page, size)
    page.press("Escape")
    page.until(lambda: not in_flight_mode(page), "Escape leaves it")
    page.pane.get_by_role("button", name="Flight mode").tap()
    page.pane.get_by_role("button", name="Leave flight mode").tap()
    page.until(lambda: not in_flight_mode(page), "its button leaves it")
    assert page.problems == []


def test_an_alarm_moves_nothing_is_felt_and_acknowledged(deck: Deck) -> None:
    deck.proxy("low")
    page = touched(deck, "low", TABLET)
    page.pane.get_by_role("heading", name="low").tap()  # browsers allow sound and vibration after the first touch
    with skyloop.connect("low", name="test") as drone:
        page.wait_for_text(".holder", "test")
        before: list[Any] = [box(page, part) for part in (".stage", ".deck.space", ".strip .taking")]
        felt = page.page.evaluate("felt.length")  # a busy machine may have raised an alarm of old feedback
        drone.config["battery.warn"] = 1.0
        page.wait_for_text(".alarms", "battery low")
        assert [box(page, part) for part in (".stage", ".deck.space", ".strip .taking")] == before
        page.until(lambda: page.page.evaluate("felt.length") > felt, "a vibration")
        acknowledge = page.pane.get_by_role("button", name="OK: acknowledge battery low")
        page.page.wait_for_timeout(700)  # until there was time to read it
        acknowledge.tap()
        page.until(lambda: not page.pane.locator(".alarms").is_visible(), "it is folded")
        page.wait_for_text(".alarm-chip", "1 alarm")
        drone.config["alarms.battery_critical"] = 1.0
        drone.takeoff()
        page.wait_for_text(".alarms", "battery critical")
        page.until(lambda: page.page.evaluate("felt.length") >= felt + 3, "felt again and again")
        drone.land()
    page.page.get_by_role("button", name="Alarm sound").tap()
    assert page.page.evaluate("localStorage.getItem('skyloop-sound')") == "off"
    assert page.problems == []

"""The page in Firefox: a person's first steps, by keys, and the arrival of fingers. Chromium tests the rest."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import skyloop
from skyloop.messages import FlightState
from tests.cockpit import fingers
from tests.cockpit.browser import IN_FIREFOX, Deck, DronePage
from tests.support.recorded_flights import Plan, write_flight

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.process, IN_FIREFOX]


def test_a_person_logs_in_and_flies_by_keys(open_cockpit: tuple[Browser, str], deck: Deck, tmp_path: Path) -> None:
    tokens = tmp_path / "tokens"
    tokens.write_text("pilot 0123456789abcdefP ann\n")
    tokens.chmod(0o600)
    deck.proxy("fox")
    address = deck.cockpit("--token-file", str(tokens), "--recordings", str(tmp_path))
    browser, _ = open_cockpit
    with browser.new_context() as context, skyloop.connect("fox", access="observe", name="test") as drone:
        page = DronePage(context.new_page(), "fox")
        page.page.goto(f"{address}#fox")
        page.page.get_by_label("Token").fill("0123456789abcdefP")
        page.page.get_by_role("button", name="Enter").click()
        page.pane.wait_for()
        page.problems.clear()  # that no one was logged in yet
        page.wait_for_new_picture()
        page.take_off()
        with page.holding("w"):
            page.until(lambda: (drone.feedback().velocity_m_s or (0,))[0] > 0.3, "it flies forward")
        page.until(lambda: drone.feedback().state is FlightState.HOVERING, "it hovers when the key is released")
        page.press("l")
        page.wait_for_text(".pill", "landed")
    assert page.problems == []


def test_two_thumbs_fly_in_the_flight_mode(deck: Deck) -> None:
    deck.proxy("thumbs")
    page = deck.page("thumbs", viewport={"width": 390, "height": 844}, has_touch=True)
    page.pane.get_by_role("button", name="Flight mode").click()
    with skyloop.connect("thumbs", access="observe", name="test") as drone:
        page.take_off()
        places = [page.pane.locator(".thumb").nth(place).bounding_box() for place in (0, 1)]
        assert all(place is not None and place["y"] + place["height"] <= 844 for place in places), "on one screen"

        def flies() -> bool:
            forward, _, up = drone.feedback().velocity_m_s or (0.0, 0.0, 0.0)
            return forward > 0.2 and up > 0.1

        with fingers.on(page.page) as hand:
            for number, place in enumerate(places):
                assert place is not None
                hand.put(str(number), place["x"] + place["width"] / 2, place["y"] + place["height"] / 2)
                hand.put(str(number), place["x"] + place["width"] / 2, place["y"] + 6)
            page.until(flies, "it flies forward and up")
        page.until(lambda: drone.feedback().state is FlightState.HOVERING, "it hovers when they are lifted")
        page.press("l")
        page.wait_for_text(".pill", "landed")
    page.press("Escape")
    page.until(lambda: page.pane.get_attribute("data-flight") == "false", "Escape leaves it")
    assert page.problems == []


HEARD = """
window.heard = [];
for (const type of ["pointerdown", "pointermove", "pointerup"])
  addEventListener(type, (event) => heard.push([type, event.pointerType, event.clientX, event.clientY]), true);
"""


def test_fingers_arrive(deck: Deck) -> None:
    deck.proxy("touched")
    page = deck.page("touched", has_touch=True)
    page.page.evaluate(HEARD)
    with fingers.on(page.page) as hand:
        hand.put("left", 100, 700)
        hand.put("right", 300, 700)
        hand.put("left", 100, 690)
        hand.lift("left")
    page.until(lambda: page.page.evaluate("heard.length") >= 5, "both fingers came and went")
    expected = [
        ["pointerdown", "touch", 100, 700],
        ["pointerdown", "touch", 300, 700],
        ["pointermove", "touch", 100, 690],
        ["pointerup", "touch", 100, 690],
        ["pointerup", "touch", 300, 700],
    ]
    assert page.page.evaluate("heard") == expected
    assert page.problems == []


COUNTS_BLINKS = """
(part) => {
  window.blinks = 0;
  new MutationObserver(() => { window.blinks += part.hidden ? 1 : 0; }).observe(part, { attributes: true });
}
"""


def test_a_finger_scrubs_a_replay_whose_end_is_announced(deck: Deck, tmp_path: Path) -> None:
    write_flight(tmp_path / "flight.mcap", Plan(seconds=4.0))
    deck.address = deck.cockpit("--recordings", str(tmp_path))
    page = deck.overview(has_touch=True)
    page.page.get_by_role("button", name="Replay flight.mcap").click()
    page.page.locator(".replay-slider:visible").wait_for(timeout=30_000)
    page.pane = page.page.locator(".pane")
    page.pane.locator(".replay-slider").focus()
    page.press("Space")
    page.until(lambda: page.attribute(".replay", "data-paused") == "true", "it is paused", 30.0)
    rail = page.pane.locator(".replay-rail").bounding_box()
    assert rail is not None
    duration_s = float(page.attribute(".replay-slider", "aria-valuemax"))
    for share in (0.7, 0.3):
        with fingers.on(page.page) as hand:
            for at in (0.1, 0.9, share):
                hand.put("one", rail["x"] + at * rail["width"], rail["y"] + rail["height"] / 2)
        page.until(
            lambda at_s=share * duration_s: abs(float(page.attribute(".replay", "data-position")) - at_s) < 0.35,  # type: ignore[misc]
            f"it is at {share}",
        )
        page.until(lambda: page.says(".chip.age") == "paused", "its picture is there")
    assert page.problems == []
    name = page.pane.get_attribute("data-drone")
    stopped = page.page.request.post(
        f"{deck.address}api/replays/{name}/stop", data={}, headers={"Origin": deck.address.rstrip("/")}
    )
    assert stopped.ok, stopped.text()
    ended = page.pane.locator(".ended-replay", has_text="This replay has ended.")
    ended.wait_for()
    ended.evaluate(COUNTS_BLINKS)
    page.page.wait_for_timeout(1500)  # meanwhile the page asks for the drone again and again
    assert page.page.evaluate("window.blinks") == 0
    ended.get_by_role("button", name="Close").click()
    page.until(lambda: page.pane.count() == 0, "the overview is left")

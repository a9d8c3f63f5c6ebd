"""The page is truthful on a bad link, and no accident stops a drone: Chromium, with suspended processes.

Suspension is real: of the cockpit's process, or of the browser's renderer (SIGSTOP).
"""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import skyloop
from skyloop.messages import FlightState
from tests.cockpit.browser import Deck, DronePage
from tests.support.processes import Process, stopped

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.process
SMALL = "sim://?world=empty&cameras="


def own_cockpit(deck: Deck, folder: Path) -> Process:
    """A cockpit that may be stopped without those of other tests."""
    return deck.own_cockpit("--recordings", str(folder))


def observe(name: str) -> skyloop.Drone:
    return skyloop.connect(name, access="observe", name="test")


def fate(page: DronePage, name: str) -> str:
    button = page.pane.locator(".strip").get_by_role("button", name=name)
    return button.get_attribute("data-fate") or ""


def test_a_take_off_pressed_in_a_stall_does_not_happen_when_the_link_returns(deck: Deck, tmp_path: Path) -> None:
    cockpit = own_cockpit(deck, tmp_path)
    deck.proxy("late", SMALL)
    page = deck.page("late")
    page.take_control()
    with observe("late") as drone:
        with stopped(cockpit.pid):
            page.press("t")
            page.until(lambda: fate(page, "Take off") == "pending", "it is shown as pending")
            page.until(lambda: fate(page, "Take off") == "no_answer", "and then as not answered")
            page.press("t")
            page.until(lambda: fate(page, "Take off") == "not_sent", "it is not even sent any more")
            page.wait_for_text(".notice", "no answer from the cockpit for")
        page.until(lambda: page.pane.get_attribute("data-old") == "false", "the cockpit is heard again")
        page.until(lambda: fate(page, "Take off") in ("refused", "not_sent"), "what came late was refused")
        for _ in range(20):
            assert drone.next_feedback().state is FlightState.LANDED


def test_an_emergency_stop_held_in_a_stall_is_pending_for_two_seconds_and_never_happens_after(
    deck: Deck, tmp_path: Path
) -> None:
    cockpit = own_cockpit(deck, tmp_path)
    deck.proxy("cut", SMALL)
    page = deck.page("cut")
    stop = page.page.locator(".safety .own")
    with skyloop.connect("cut", name="flies.py") as flies:
        flies.takeoff()
        page.until(lambda: not page.pane.locator(".taking .primary").is_disabled(), "the line is open")
        with stopped(cockpit.pid):
            with page.holding("Control", "Enter"):
                page.until(lambda: stop.get_attribute("data-fate") == "pending", "it is shown as pending")
            pressed_s = time.monotonic()
            page.until(lambda: stop.get_attribute("data-fate") in ("no_answer", "not_sent"), "it is given up")
            assert 1.0 < time.monotonic() - pressed_s < 8.0
        page.until(lambda: page.pane.get_attribute("data-old") == "false", "the cockpit is heard again")
        page.until(lambda: stop.get_attribute("data-fate") == "refused", "it was refused")
        for _ in range(20):
            assert flies.next_feedback().state is FlightState.HOVERING
        # A short stall is different: the press was a moment ago, and the page still shows it as pending.
        with stopped(cockpit.pid), page.holding("Control", "Enter"):
            page.until(lambda: stop.get_attribute("data-fate") == "pending", "it is shown as pending")
        page.until(lambda: flies.feedback().state is FlightState.EMERGENCY, "late, and in time")
        page.until(lambda: stop.get_attribute("data-fate") == "sent", "and shown as sent")


def test_a_page_whose_cockpit_is_stopped_is_grey_and_tells_the_age_in_seconds(deck: Deck, tmp_path: Path) -> None:
    cockpit = own_cockpit(deck, tmp_path)
    deck.proxy("grey", SMALL)
    page = deck.page("grey")
    page.take_off()
    with stopped(cockpit.pid):
        stopped_s = time.monotonic()
        page.until(lambda: page.pane.get_attribute("data-old") == "true", "it is grey")
        assert time.monotonic() - stopped_s < 6.0
        page.until(lambda: float(page.says(".old b").split()[0]) > 2.0, "the age counts")
        assert "was hovering" in page.says(".pill")
        assert "Unknown" in page.says(".holder")
        assert "you had control" in page.says(".holder")
        assert page.pane.get_attribute("data-mine") == "false"
        for part in (".pane-body", ".holder", ".deeds", ".pill", ".battery"):
            style = page.pane.locator(part).first.evaluate("part => getComputedStyle(part).filter")
            assert "grayscale(1)" in style, part
        page.page.locator('.fleet[data-old="true"]').wait_for()
        assert "the cockpit does not answer" in page.says(".banner.old")
        assert page.page.locator(".banner:visible").count() == 1, "one cause is told once, and hides nothing"
        assert page.pane.locator("h2").is_visible()
        with observe("grey") as drone:
            page.until(lambda: drone.feedback().owner_id == 0 or not drone.feedback().lease, "control expired")
    page.until(lambda: page.pane.get_attribute("data-old") == "false", "it is heard again")
    page.until(lambda: page.pane.locator(".ended").is_visible(), "it tells that control was lost")
    assert "nobody has control" in page.says(".ended")
    assert page.pane.get_attribute("data-mine") == "false"


def test_a_stopped_browser_is_a_silent_pilot(open_cockpit: tuple[Browser, str], deck: Deck) -> None:
    browser, _ = open_cockpit
    deck.proxy("frozen", SMALL)
    page = deck.page("frozen")
    with skyloop.connect("frozen", name="lab", on_exit="hover") as lab:
        lab.config["failsafe.land_after_s"] = 1.0
    page.take_off()
    page.page.keyboard.down("w")
    processes = browser.new_browser_cdp_session().send("SystemInfo.getProcessInfo")["processInfo"]
    renderers = [one["id"] for one in processes if one["type"] == "renderer"]
    with observe("frozen") as drone:
        page.until(lambda: drone.feedback().state is FlightState.FLYING, "it flies")
        with stopped(*renderers):
            drone.wait("hovering", 2.0)
            drone.wait(lambda feedback: feedback.state in (FlightState.LANDING, FlightState.LANDED), 8.0)
            drone.wait(lambda feedback: not feedback.lease, 5.0)
        page.page.keyboard.up("w")
        page.until(lambda: page.pane.locator(".ended").is_visible(), "it tells that control was lost")
        assert "control expired" in page.says(".ended")
        page.until(lambda: "Nobody" in page.says(".holder"), "it is told who has control now")
        assert not drone.feedback().lease, "it is not taken back by itself"
        page.pane.get_by_role("button", name="Understood").click()
        page.until(lambda: not page.pane.locator(".ended").is_visible(), "it was read")
        page.take_control()


def test_after_a_proxys_death_and_return_control_is_the_persons_to_take(deck: Deck) -> None:
    proxy = deck.proxy("returns", SMALL)
    page = deck.page("returns")
    page.take_control()
    proxy.signal(signal.SIGKILL)
    page.wait_for_text(".ended", "nobody has control, and the state of returns is unknown")
    page.wait_for_text(".holder", "Nobody")
    page.wait_for_text(".pill", "unknown")
    assert page.pane.get_attribute("data-old") == "true"
    proxy.end()
    deck.proxy("returns", SMALL)
    page.until(lambda: page.pane.get_attribute("data-old") == "false", "it is back")
    page.wait_for_text(".ended", "what returns did meanwhile is unknown")
    with observe("returns") as drone:
        for _ in range(30):
            assert drone.next_feedback().owner is None
    page.take_control()
    page.until(lambda: not page.pane.locator(".ended").is_visible(), "it is over")


def test_escape_closes_a_dialog_and_nothing_else(deck: Deck) -> None:
    deck.proxy("escape", SMALL)
    page = deck.page("escape")
    page.take_off()
    with observe("escape") as drone:
        page.press("?")
        page.page.locator(".help[open]").wait_for()
        page.press("Escape")
        page.until(lambda: page.page.locator(".help[open]").count() == 0, "the list is closed")
        page.page.keyboard.down("w")
        page.until(lambda: drone.feedback().state is FlightState.FLYING, "it flies")
        for _ in range(6):
            page.press("Escape")
        for _ in range(20):
            assert drone.next_feedback().state is FlightState.FLYING
        page.page.keyboard.up("w")


def test_the_emergency_stop_is_held_shown_as_it_counts_and_names_the_drone(deck: Deck) -> None:
    deck.proxy("left", SMALL)
    deck.proxy("right", SMALL)
    page = deck.page("left", "right")
    own = page.page.locator(".safety .own")
    counting = page.page.locator(".counting")
    with skyloop.connect("left", name="a", on_exit="hover") as left, skyloop.connect("right", name="b") as right:
        left.takeoff()
        right.takeoff()
        page.page.locator('.pane[data-drone="left"] .pane-head h2').click()
        page.until(lambda: "left" in own.inner_text(), "it names the one that is chosen")
        for _ in range(4):
            own.click()  # as if by accident
            page.press("Enter")
        with page.holding("Control", "Enter"):
            counting.wait_for()
            assert "Motors of left off" in counting.inner_text()
        page.until(lambda: "released too early" in counting.inner_text(), "it says that nothing was done")
        assert {left.feedback().state, right.feedback().state} == {FlightState.HOVERING}
        # While a person types; test_page_dialogs.py covers an open dialog.
        field = page.page.locator('.pane[data-drone="left"] input[aria-label="Filter events by words"]')
        field.fill("wind")
        with page.holding("Control", "Enter"):
            page.until(lambda: left.feedback().state is FlightState.EMERGENCY, "its motors are off")
        assert field.input_value() == "wind", "and nothing was written"
        assert right.next_feedback().state is FlightState.HOVERING
        stop = page.page.locator('.pane[data-drone="right"] .strip .stop')
        stop.hover()
        page.page.mouse.down()
        page.until(lambda: right.feedback().state is FlightState.EMERGENCY, "by its own button")
        page.page.mouse.up()


def test_keys_stop_the_visible_drone_not_the_one_opened_last(deck: Deck) -> None:
    deck.proxy("upper", SMALL)
    deck.proxy("lower", SMALL)
    page = deck.page("upper", "lower")
    own = page.page.locator(".safety .own")
    page.page.set_viewport_size({"width": 390, "height": 700})
    page.page.evaluate("document.querySelector('.pane[data-drone=lower]').scrollIntoView({block: 'end'})")
    page.until(lambda: "lower" in own.inner_text(), "the one that is seen")
    page.page.evaluate("scrollTo(0, 0)")
    page.until(lambda: "upper" in own.inner_text(), "the other one, when it is")


def test_land_all_and_stop_all_are_available_with_no_drone_open(deck: Deck) -> None:
    deck.proxy("one", SMALL)
    deck.proxy("two", SMALL)
    page = deck.page("one", "two")
    for name in ("one", "two"):
        page.page.get_by_role("button", name=f"Close {name}", exact=True).last.click()
    page.page.locator(".overview .tile").first.wait_for()
    assert not page.page.locator(".safety .own").is_visible(), "nothing is seen that it could name"
    with (
        skyloop.connect("one", name="a", on_exit="hover") as one,
        skyloop.connect("two", name="b", on_exit="hover") as two,
    ):
        one.takeoff()
        two.takeoff()
        page.page.get_by_role("button", name="Land all").focus()
        with page.holding(" "):
            page.until(lambda: "Land all" in page.page.locator(".safety-message").inner_text(), "it is told")
        for drone in (one, two):
            drone.wait("landed", 15)
        page.until(
            lambda: "landed: one, two" in page.page.locator(".safety-message").inner_text(), "with what came of it"
        )
        one.wait(lambda feedback: feedback.owner == "a", 5)
        two.wait(lambda feedback: feedback.owner == "b", 5)
        one.takeoff()
        with page.holding("Control", "Shift", "Enter"):
            page.until(lambda: one.feedback().state is FlightState.EMERGENCY, "all motors are off")


def test_a_stop_that_is_held_is_ended_by_no_other_key_or_finger(deck: Deck) -> None:
    """Releasing the key that flew, or touching another drone with the other hand, kept all motors running."""
    for name in ("left", "right"):
        deck.proxy(name, SMALL)
    page = deck.page("left", "right")
    stop = page.page.get_by_role("button", name="Stop all")
    with skyloop.connect("left", name="a", on_exit="hover") as drone:
        drone.takeoff()
        page.until(lambda: not stop.is_disabled(), "there are drones")
        stop.focus()
        page.page.keyboard.down("w")
        with page.holding(" "):
            page.page.keyboard.up("w")
            page.until(lambda: drone.feedback().state is FlightState.EMERGENCY, "all motors are off")

        def stands() -> bool:
            state = drone.feedback().state
            if state is FlightState.EMERGENCY:
                drone.reset_emergency()  # which has no effect while it falls
            return state is FlightState.LANDED

        page.until(stands, "it has fallen, and is reset")
        drone.takeoff()
        stop.hover()
        page.page.mouse.down()
        other = page.page.locator('.pane[data-selected="false"]')
        other.dispatch_event("pointerdown", {"pointerId": 7, "button": 0})
        stop.dispatch_event("pointerup", {"pointerId": 7, "button": 0})
        page.until(lambda: drone.feedback().state is FlightState.EMERGENCY, "all motors are off again")
        page.page.mouse.up()


def test_a_recording_has_no_flight_controls_and_ends_neutrally(deck: Deck) -> None:
    deck.proxy("taped", SMALL)
    page = deck.page("taped")
    page.page.get_by_role("button", name="Record", exact=True).click()
    page.page.locator(".running li").wait_for()
    page.page.wait_for_timeout(600)
    page.page.get_by_role("button", name="Stop recording taped").click()
    page.page.locator(".past li").get_by_role("button", name="Replay").first.click()
    replay = page.page.locator('.pane[data-recording="true"]')
    replay.wait_for()
    # Elements to hide disappear with the page's next drawing. Neither a recording nor the drone behind it is stopped.
    for hidden in (replay.locator(".strip"), replay.locator("form.waypoint"), page.page.locator(".safety .own")):
        hidden.wait_for(state="hidden")
    replay.locator(".pill", has_text="recording over").wait_for(timeout=10_000)
    assert replay.locator(".pill").get_attribute("data-tone") == "quiet"
    assert not replay.locator(".alarms").is_visible()
    assert not replay.locator(".old").is_visible()
    with page.holding("Control", "Enter"), observe("taped") as drone:
        page.until(lambda: "No drone" in page.page.locator(".safety-message").inner_text(), "it is told")
        assert drone.next_feedback().state is FlightState.LANDED
    assert page.problems == []

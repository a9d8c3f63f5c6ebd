"""Sticks belong to the drone that a person touches: fingers, gamepads and keys, in a real browser."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import fmean
from typing import Any

import pytest

import skyloop
from skyloop.client import Drone
from skyloop.messages import FlightState
from tests.cockpit import fingers
from tests.cockpit.browser import Deck, DronePage

pytestmark = pytest.mark.process

#: Two gamepads as browsers show them.
PADS = """
const buttons = (...pressed) => Array.from({length: 17}, (_, one) => ({pressed: pressed.includes(one)}));
const pad = (id, index, axes, ...pressed) => (
  {id, index, mapping: "standard", connected: true, axes, buttons: buttons(...pressed)});
window.usual = (axes, ...pressed) => pad("usual", 0, axes, ...pressed);
window.other = (axes) => pad("other", 1, axes);
window.pads = [];
navigator.getGamepads = () => window.pads;
"""
BLIND = "sim://?world=empty&cameras=none"  # pictures are irrelevant here, and costly on a busy machine
MOVES_M_S = 0.15


def speed(drone: Drone) -> float:
    """Return the horizontal speed [m/s]."""
    return max(abs(one) for one in (drone.feedback().velocity_m_s or (0.0, 0.0, 0.0))[:2])


@contextmanager
def flown(deck: Deck, *names: str, **options: Any) -> Iterator[tuple[DronePage, dict[str, DronePage], list[Drone]]]:
    """Open a page with these drones in the air, all flown by it; yield each drone's page and observer."""
    for name in names:
        deck.proxy(name, BLIND)
    page = deck.page(*names, **options)
    pages = {name: DronePage(page.page, name) for name in names}
    drones = [skyloop.connect(name, access="observe", name="test") for name in names]
    try:
        for one in pages.values():
            one.pane.locator("h2").click()  # selected
            one.take_off()
        yield page, pages, drones
    finally:
        for drone in drones:
            drone.close()


def stays(page: DronePage, drone: Drone, seconds: float = 1.5) -> bool:
    """Return whether it comes to rest, and then stays at rest.

    Uses the mean of six consecutive samples: a single one deviates by 0.044 m/s (standard deviation), and so exceeds
    the limit in one of some tens of such tests.
    """
    seen: dict[int, tuple[float, float]] = {}  # by time of capture: a stalled machine shows one several times

    def moves() -> float:
        page.page.wait_for_timeout(50)
        feedback = drone.feedback()
        seen[feedback.captured_ns] = (feedback.velocity_m_s or (0.0, 0.0, 0.0))[:2]
        return max(abs(fmean(axis)) for axis in zip(*list(seen.values())[-6:], strict=True))

    rest_s = time.monotonic() + 3.0
    while (moves() > 0.5 * MOVES_M_S or len(seen) < 6) and time.monotonic() < rest_s:
        pass
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        if moves() > MOVES_M_S:
            return False
    return True


def until_it_flies(page: DronePage, drone: Drone, push: Callable[[], object], let_go: Callable[[], object]) -> None:
    """Push, again if a busy machine stalled the page: a stick held then must be released first."""
    pushed_s = 0.0

    def flies() -> bool:
        nonlocal pushed_s
        if time.monotonic() - pushed_s > 3.0:
            if pushed_s:
                let_go()
                page.take_off()  # if control expired meanwhile
                page.page.wait_for_timeout(300)
            push()
            pushed_s = time.monotonic()
        return speed(drone) > 2 * MOVES_M_S

    page.until(flies, "it flies", 30.0)


class Thumb:
    """Hold a finger on the right stick of a drone's pane."""

    def __init__(self, page: DronePage, hand: fingers.Fingers) -> None:
        self._hand = hand
        stick = page.pane.locator(".thumb").nth(1)
        stick.scroll_into_view_if_needed()
        box = stick.bounding_box()
        assert box is not None
        self._x, self._y, self._half = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, box["height"] / 2

    def push(self) -> None:
        self._hand.put("thumb", self._x, self._y)
        self._hand.put("thumb", self._x, self._y - 0.9 * self._half)

    def lift(self) -> None:
        self._hand.lift("thumb")


def test_a_finger_on_another_drone_flies_that_one_with_nothing_and_lifted_fingers_fly_nothing(deck: Deck) -> None:
    """It flew with the first one's stick, and continued after all fingers were lifted."""
    size = {"width": 1200, "height": 1900}
    with flown(deck, "left", "right", viewport=size, has_touch=True) as (page, pages, (left, right)):
        pages["left"].pane.locator("h2").click()
        other = pages["right"].pane.bounding_box()
        assert other is not None
        with fingers.on(page.page) as hand:
            thumb = Thumb(pages["left"], hand)
            until_it_flies(pages["left"], left, thumb.push, thumb.lift)
            hand.put("other", other["x"] + 4, max(other["y"] + 5, 700.0))  # its margin, where visible
            hand.lift("other")
            page.until(lambda: pages["right"].pane.get_attribute("data-selected") == "true", "it is selected")
            page.until(lambda: left.feedback().state is FlightState.HOVERING, "the one that was flown hovers")
            assert stays(page, right)
            thumb.lift()
        assert stays(page, right)
        assert stays(page, left)


def test_a_stick_released_while_hidden_is_released(deck: Deck) -> None:
    """Held, All drones pressed, lifted there: opened again, the drone flew untouched."""
    size = {"width": 1200, "height": 1900}
    with flown(deck, "alone", viewport=size, has_touch=True) as (page, _, (drone,)):
        with fingers.on(page.page) as hand:
            thumb = Thumb(page, hand)
            until_it_flies(page, drone, thumb.push, thumb.lift)
            page.page.evaluate("document.querySelector('button.all-drones').click()")
            page.until(lambda: drone.feedback().state is FlightState.HOVERING, "it hovers out of sight")
            thumb.lift()
        page.page.locator('.tile[data-drone="alone"] .tile-main').click()
        page.until(lambda: page.pane.is_visible(), "it is opened again")
        assert stays(page, drone)
        with fingers.on(page.page) as hand:
            thumb = Thumb(page, hand)
            until_it_flies(page, drone, thumb.push, thumb.lift)


def test_a_key_that_is_held_for_one_drone_does_not_fly_another(deck: Deck) -> None:
    with flown(deck, "one", "two") as (page, pages, (one, two)):
        pages["one"].pane.locator("h2").click()
        keyboard = page.page.keyboard
        until_it_flies(pages["one"], one, lambda: keyboard.down("w"), lambda: keyboard.up("w"))
        pages["two"].pane.locator("h2").click()
        page.until(lambda: one.feedback().state is FlightState.HOVERING, "it hovers")
        assert stays(page, two)
        keyboard.up("w")
        until_it_flies(pages["two"], two, lambda: keyboard.down("w"), lambda: keyboard.up("w"))
        keyboard.up("w")


def test_a_gamepad_that_is_unplugged_beside_another_one_hovers_and_a_waking_press_is_no_command(deck: Deck) -> None:
    """The other one flew at once, by its present sticks; and the press that wakes a gamepad took off."""
    deck.proxy("pads", BLIND)
    page = deck.page("pads", prepare=PADS)
    with skyloop.connect("pads", access="observe", name="test") as drone:
        page.take_control()
        page.page.evaluate("pads = [usual([0, 0, 0, 0], 9)]")
        page.page.wait_for_timeout(300)
        page.page.evaluate("pads = [usual([0, 0, 0, 0])]")
        page.page.wait_for_timeout(700)
        assert drone.feedback().state is FlightState.LANDED, "the press that wakes it"
        page.take_off()
        usual, other = "pads = [usual([0, 0, 0, %s]), other([0, 1, 0, 1])]", "pads = [null, other([0, 0, 0, %s])]"

        def axis(pads: str, value: float) -> Callable[[], object]:
            return lambda: page.page.evaluate(pads % value)

        until_it_flies(page, drone, axis(usual, -0.8), axis(usual, 0))
        page.page.evaluate("pads = [null, other([0, 1, 0, 1])]")
        page.until(lambda: drone.feedback().state is FlightState.HOVERING, "it is unplugged: it hovers")
        assert stays(page, drone), "the other one lies there"
        axis(other, 0)()
        page.page.wait_for_timeout(200)
        until_it_flies(page, drone, axis(other, -0.8), axis(other, 0))


def test_a_stop_by_gamepad_with_its_stick_held_is_shown_and_nothing_flies_on_after_its_reset(deck: Deck) -> None:
    deck.proxy("stopped", BLIND)
    page = deck.page("stopped", prepare=PADS)
    with skyloop.connect("stopped", access="observe", name="test") as drone:
        page.take_off()
        usual = "pads = [usual([0, 0, 0, %s]%s)]"
        until_it_flies(
            page, drone, lambda: page.page.evaluate(usual % (-0.8, "")), lambda: page.page.evaluate(usual % (0, ""))
        )
        page.page.evaluate(usual % (-0.8, ", 4, 5"))
        page.until(lambda: drone.feedback().state is FlightState.EMERGENCY, "the motors stand")
        page.wait_for_text(".notice", "motors are stopped")
        page.page.evaluate(usual % (-0.8, ""))
        page.pane.get_by_role("button", name="Reset").click()
        page.until(lambda: drone.feedback().state is FlightState.LANDED, "it is reset")
        page.take_off()
        assert stays(page, drone), "the stick is still held from before"


def test_control_that_comes_back_while_a_stick_is_held_flies_nothing(deck: Deck) -> None:
    """A thumb never left the stick while a program took the drone and gave it back."""
    size = {"width": 1200, "height": 1900}
    with flown(deck, "taken", viewport=size, has_touch=True) as (page, _, (drone,)), fingers.on(page.page) as hand:
        thumb = Thumb(page, hand)
        until_it_flies(page, drone, thumb.push, thumb.lift)
        with skyloop.connect("taken", name="program", authority=skyloop.Authority(priority=0), on_exit="hover"):
            page.until(lambda: page.pane.get_attribute("data-mine") == "false", "the program has it")
        page.until(lambda: page.pane.get_attribute("data-mine") == "true", "it is back")
        assert stays(page, drone)


def test_sticks_held_while_the_page_was_hidden_fly_nothing_on_return(deck: Deck) -> None:
    """By Back and Forward, as a browser may keep a page unchanged."""
    with flown(deck, "back") as (page, _, (drone,)):
        keyboard = page.page.keyboard
        until_it_flies(page, drone, lambda: keyboard.down("w"), lambda: keyboard.up("w"))
        page.page.goto("about:blank")
        page.until(lambda: drone.feedback().state is not FlightState.FLYING, "the page is gone: it hovers")
        page.page.go_back()
        page.pane.wait_for()
        assert stays(page, drone)


def test_two_tabs_fly_one_drone_each_in_its_turn(deck: Deck) -> None:
    """The tab that lost control to the person's other tab flies no more, with a key held throughout."""
    with flown(deck, "tabs") as (first, _, (drone,)):
        second = DronePage(first.page.context.new_page(), "tabs")
        second.page.goto(f"{deck.address}#tabs")
        second.pane.wait_for()
        first.page.bring_to_front()
        keyboard = first.page.keyboard
        until_it_flies(first, drone, lambda: keyboard.down("w"), lambda: keyboard.up("w"))
        second.pane.locator(".taking input[type=number]").fill("2")
        second.pane.locator("h2").click()
        second.take_control()
        first.until(lambda: first.pane.get_attribute("data-mine") == "false", "the first one has not")
        assert stays(second, drone)
        second.pane.get_by_role("button", name="Release").click()
        first.until(lambda: first.pane.get_attribute("data-mine") == "true", "it is back")
        assert stays(first, drone), "the key was held all the while: it is pressed anew first"
        keyboard.up("w")


def test_text_composed_by_an_input_method_flies_nothing_and_does_not_block_the_stop(deck: Deck) -> None:
    with flown(deck, "typed") as (page, _, (drone,)):
        session = page.page.context.new_cdp_session(page.page)
        page.page.evaluate("document.body.append(Object.assign(document.createElement('input'), {id: 'typed-here'}))")
        page.page.locator("#typed-here").focus()
        session.send("Input.imeSetComposition", {"text": "とwt", "selectionStart": 3, "selectionEnd": 3})
        for key in ("KeyW", "KeyT", "KeyL"):
            event = {"type": "keyDown", "code": key, "key": "Process", "windowsVirtualKeyCode": 229}
            session.send("Input.dispatchKeyEvent", event)
        assert stays(page, drone, 1.0)
        page.page.keyboard.down("Control")
        page.page.keyboard.down("Enter")
        page.until(lambda: drone.feedback().state is FlightState.EMERGENCY, "the emergency stop")
        page.page.keyboard.up("Enter")
        page.page.keyboard.up("Control")
        page.wait_for_text(".notice", "motors are stopped")

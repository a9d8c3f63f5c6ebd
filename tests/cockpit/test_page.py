"""A person's view and actions on the cockpit's page: Chromium, a real cockpit, real proxies of simulated drones."""

from __future__ import annotations

import re
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import skyloop
from skyloop.messages import EventKind, FlightState
from tests.cockpit.browser import Deck, DronePage

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.process

MAX_AGE_MS = 200.0


def observe(name: str) -> skyloop.Drone:
    """Return the drone's own report, besides the page's."""
    return skyloop.connect(name, access="observe", name="test")


def rotation(page: DronePage) -> float:
    """Return the horizon's rotation on the page [degrees]."""
    found = re.search(r"rotate\((-?[\d.]+)\)", page.attribute(".horizon .roll", "transform"))
    assert found is not None
    return float(found[1])


def test_video_moves_and_is_young(deck: Deck) -> None:
    deck.proxy("video")
    page = deck.page("video")
    page.until(lambda: bool(page.attribute(".camera", "data-seq")), "a first picture")
    first = int(page.attribute(".camera", "data-seq"))
    ages: list[float] = []

    def moved() -> bool:
        ages.append(float(page.attribute(".camera", "data-age-ms")))
        return int(page.attribute(".camera", "data-seq")) >= first + 20

    # The page's own figure: age when sent, plus the time since. A busy machine gets more tries.
    for _ in range(5):
        ages.clear()
        first = int(page.attribute(".camera", "data-seq"))
        page.until(moved, "twenty more pictures")
        if sorted(ages)[len(ages) // 2] < MAX_AGE_MS:
            break
    else:
        pytest.fail(f"pictures are {sorted(ages)[len(ages) // 2]:.0f} ms old, and were five times")
    pixels = "canvas => [...canvas.getContext('2d').getImageData(0, 0, 320, 240).data].reduce((a, b) => a + b, 0)"
    assert page.pane.locator(".video").evaluate(pixels) > 0
    assert page.problems == []


def test_video_out_of_sight_is_not_requested(deck: Deck) -> None:
    deck.proxy("away")
    page = deck.page("away", viewport={"width": 390, "height": 500})
    page.wait_for_new_picture()
    page.page.evaluate("scrollTo(0, document.body.scrollHeight)")
    page.until(lambda: page.attribute(".camera", "data-asks") == "false", "nobody sees it")
    page.page.evaluate("scrollTo(0, 0)")
    page.wait_for_new_picture()
    assert page.problems == []


def test_horizon_follows_the_attitude(deck: Deck) -> None:
    deck.proxy("roll")
    page = deck.page("roll")
    with skyloop.connect("roll", name="sideways.py") as drone:
        drone.takeoff()
        for left in (-1.5, 1.5):
            drone.velocity(left=left)

            def tilts_as_the_drone(sign: float = left) -> bool:
                # Right side down is positive roll; seen from inside, the horizon then turns to the left.
                return rotation(page) * sign > 1.5 * abs(sign)

            page.until(tilts_as_the_drone, f"the horizon turns for {left} m/s to the left")
        drone.hover()

        def agree() -> bool:
            roll = drone.feedback().roll_rad
            return roll is not None and abs(rotation(page) + roll * 57.29578) < 1.0

        page.until(agree, "horizon and feedback agree")
        drone.land(wait=False)


def test_keyboard_flight(deck: Deck) -> None:
    deck.proxy("keys")
    page = deck.page("keys")
    with observe("keys") as drone:
        page.take_off()
        before = drone.feedback().position_m
        page.page.keyboard.down("w")
        page.until(lambda: (drone.feedback().velocity_m_s or (0,))[0] > 0.4, "it flies forward")
        page.until(
            lambda: float(page.says('[data-figure="speed"]').replace("−", "-")) > 0.4, "the page shows its speed"
        )
        page.wait_for_text(".command", "forward 0.80")
        page.page.keyboard.up("w")
        page.until(lambda: drone.feedback().state is FlightState.HOVERING, "it hovers when the key is released")
        after = drone.feedback().position_m
        assert before is not None
        assert after is not None
        assert after[0] > before[0], "it flew forward; how far depends on how soon the page saw its speed"
        # Nothing flies while a person types, and no text is lost when the page loses the focus.
        page.pane.locator('input[aria-label="Filter events by words"]').click()
        page.page.keyboard.type("www")
        assert drone.feedback().state is FlightState.HOVERING
        page.pane.locator(".pane-head").click()
        page.page.keyboard.down("w")
        page.until(lambda: drone.feedback().state is FlightState.FLYING, "it flies again")
        page.page.evaluate("window.dispatchEvent(new Event('blur'))")
        page.until(lambda: drone.feedback().state is FlightState.HOVERING, "it hovers when the focus is lost")
        page.press("l")
        page.wait_for_text(".pill", "landed")
        assert page.problems == []


def test_authority_passes_from_a_controller_to_a_person_and_back(deck: Deck) -> None:
    deck.proxy("passes")
    page = deck.page("passes")
    with skyloop.connect("passes", name="follow.py", authority=skyloop.Authority(priority=16)) as drone:
        page.wait_for_text(".holder", "follow.py")
        page.take_control()
        assert "You" in page.says(".holder")
        page.until(lambda: drone.authority.state == "preempted", "the controller is told")
        assert (drone.authority.holder or "").startswith("cockpit")
        with pytest.raises(skyloop.AuthorityError, match="cockpit"):
            drone.velocity(forward=0.1)
        page.press("r")
        page.until(lambda: drone.authority.state == "held", "the controller has it back")
        page.wait_for_text(".holder", "follow.py")
        assert page.pane.get_attribute("data-mine") == "false"


def test_a_page_of_no_higher_priority_asks_with_one_press_and_is_notified_of_control(deck: Deck) -> None:
    deck.proxy("busy")
    page = deck.page("busy")
    first = page.pane.get_by_role("button", name="Ask first")
    with skyloop.connect("busy", name="first.py", authority=skyloop.Authority(priority=2)) as drone:
        page.wait_for_text(".now", "ask for it, since your priority 8 is no higher")
        assert not first.is_visible(), "there is no choice"
        page.press_until("c", lambda: "first.py was asked" in page.says(".waiting"), "it asks")
        page.pane.locator(".priority").fill("1")
        page.until(first.is_visible, "it could be taken now")
        page.wait_for_text(".taking .primary", "Take control")
        drone.release_authority()
        page.wait_for_text(".notice", "You have control now")
    assert page.problems == []


def test_a_person_has_a_name_which_others_see(deck: Deck) -> None:
    deck.proxy("named")
    ann, ben = deck.page("named"), deck.page("named")
    ann.take_control()
    ben.wait_for_text(".holder", "cockpit ")
    ann.page.get_by_role("button", name="Settings").click()
    ann.page.get_by_label("Your name").fill("Ann")
    ann.page.get_by_label("Your name").press("Enter")
    ann.press("Escape")
    assert ann.pane.get_attribute("data-mine") == "true", "a name is no reason to lose control"
    ann.press("r")
    ben.wait_for_text(".holder", "Nobody")
    ann.take_control()
    ben.wait_for_text(".holder", "Ann (cockpit ")
    ann.wait_for_text(".holder", "You (Ann, cockpit ")
    ann.page.reload()
    ann.take_control()
    ben.wait_for_text(".holder", "Ann (cockpit ")
    assert ann.problems == ben.problems == []


def allow_time(name: str) -> None:
    """Allow more than the usual 10 s for an answer: a busy machine's browser is slow."""
    with skyloop.connect(name, name="patience") as drone:
        drone.config["authority.ask_s"] = 120.0


def test_a_person_who_is_asked_for_control_keeps_it_and_then_hands_it_over(deck: Deck) -> None:
    deck.proxy("asks")
    allow_time("asks")
    page = deck.page("asks")
    page.take_off()
    panel = page.pane.get_by_role("alertdialog")
    assert not panel.is_visible()
    with skyloop.connect(
        "asks", name="survey.py", authority=skyloop.Authority(priority=4, takeover="ask", stay=True, for_s=120)
    ) as drone:
        page.wait_for_text(".asks", "survey.py asks for control")
        for words in ("Priority 4, yours 8", "Wanted for 2 min", "it gets control when the time is up"):
            assert words in page.says(".asks")
        assert 60 < int(page.says(".asks-left b").split()[0]) <= 120
        assert "survey.py asks for control" in (page.pane.locator("[aria-live=assertive]").text_content() or "")
        assert page.page.evaluate("document.activeElement === document.body"), "the focus is not taken from who flies"
        page.until(lambda: not panel.get_by_role("button", name="Keep it").is_disabled(), "there was time to read it")
        # By keyboard alone; typing the reason flies nothing.
        page.press("q", "Tab")
        page.page.keyboard.type("what is this")
        page.press("Enter")
        page.wait_for_text(".asks", "survey.py still asks for control")
        told = [event for event in drone.recent_events() if event.kind is EventKind.AUTHORITY_DECLINED]
        assert told[-1].data["reason"] == "what is this"
        assert drone.feedback().state is FlightState.HOVERING
        assert drone.authority.state == "queued"
        page.page.set_viewport_size({"width": 390, "height": 844})
        assert page.page.evaluate("document.documentElement.scrollWidth") <= 390, "nothing beside the screen"
        panel.get_by_role("button", name="Hand over").click()
        page.until(lambda: drone.authority.state == "held", "the program has it")
        page.wait_for_text(".holder", "survey.py")
        page.until(lambda: not panel.is_visible(), "nobody asks any more")
        page.wait_for_text(".waiting", "You are number 1 in line")
        assert page.pane.get_attribute("data-mine") == "false"
        assert drone.feedback().state is FlightState.HOVERING
        drone.release_authority()
        page.until(lambda: page.pane.get_attribute("data-mine") == "true", "the person has it back")
        page.press("l")
        page.wait_for_text(".pill", "landed")
    assert page.problems == []


def test_a_question_that_is_withdrawn_vanishes(deck: Deck) -> None:
    deck.proxy("withdrawn")
    allow_time("withdrawn")
    page = deck.page("withdrawn")
    page.take_control()
    with skyloop.connect("withdrawn", name="survey.py", authority=skyloop.Authority(takeover="ask", stay=True)):
        page.wait_for_text(".asks", "That is no higher than yours")
        page.press("q")
        assert page.page.evaluate("document.activeElement.className") == "asks"
    page.until(lambda: not page.pane.locator(".asks").is_visible(), "nobody asks any more")
    assert page.pane.get_attribute("data-mine") == "true"


def test_a_person_asks_first_waits_and_cancels(deck: Deck) -> None:
    deck.proxy("first")
    allow_time("first")
    page = deck.page("first")
    with skyloop.connect("first", name="follow.py", authority=skyloop.Authority(priority=16)) as drone:
        page.wait_for_text(".holder", "follow.py")
        drone.on_takeover(lambda request: "measuring until noon" if request.priority == 8 else True)
        page.pane.get_by_role("button", name="Ask first").click()
        assert page.pane.get_by_role("button", name="Ask for control").is_visible()
        page.ask_for_control()
        page.wait_for_text(".waiting", "follow.py keeps it for now: “measuring until noon” · you are number 1 in line")
        page.wait_for_text(".waiting", "min to wait")  # then the higher priority gets it
        assert drone.authority.state == "held"
        page.pane.get_by_role("button", name="Stop waiting").click()
        page.until(lambda: not page.pane.locator(".waiting").is_visible(), "it waits no more")
        page.until(
            lambda: EventKind.AUTHORITY_WITHDRAWN in [event.kind for event in drone.recent_events()], "its holder knows"
        )
        page.pane.locator(".priority").fill("4")
        page.pane.locator(".pane-head").click()
        page.press("c")
        page.until(lambda: page.pane.get_attribute("data-mine") == "true", "follow.py hands it over")
        page.until(lambda: drone.authority.state == "preempted", "follow.py waits to have it back")
    assert page.problems == []


def test_emergency_stops_the_motors(deck: Deck) -> None:
    deck.proxy("stop")
    page = deck.page("stop")
    with skyloop.connect("stop", name="flies.py") as drone:
        drone.takeoff()
        page.until(lambda: not page.pane.locator(".taking .primary").is_disabled(), "the line is open")
        page.wait_for_text(".holder", "flies.py")
        with page.holding("Control", "Enter"):  # without control, and without a question
            page.until(lambda: drone.feedback().state is FlightState.EMERGENCY, "the motors are off")
        page.wait_for_text(".pill", "emergency")
        page.wait_for_text(".alarms", "motors are off")


def test_parameters(deck: Deck) -> None:
    deck.proxy("config")
    page = deck.page("config")
    page.pane.get_by_role("button", name="Parameters").click()
    row = page.pane.locator('[data-parameter="limits.speed"]')
    row.wait_for()
    assert "float" in (row.text_content() or "")
    assert row.locator("input").is_disabled(), "without control it can't be changed"
    page.take_control()

    def write(value: str) -> None:
        row.locator("input").fill(value)
        row.get_by_role("button", name="Set").click()

    with observe("config") as drone:
        write("1.5")
        page.wait_for_text('[data-parameter="limits.speed"] .answer', "written")
        assert drone.config["limits.speed"] == 1.5
        write("-4")
        page.until(lambda: row.locator(".answer").get_attribute("data-tone") == "bad", "it is refused")
        assert "must be at least 0.1" in page.says('[data-parameter="limits.speed"] .answer'), "the drone's own words"
        assert drone.config["limits.speed"] == 1.5
        write("fast")
        page.wait_for_text('[data-parameter="limits.speed"] .answer', "enter a number")


def test_two_watch_while_one_flies(deck: Deck) -> None:
    deck.proxy("watched")
    flies, *watch = [deck.page("watched") for _ in range(3)]
    flies.take_off()
    for page in watch:
        page.wait_for_text(".pill", "hovering")
        page.wait_for_text(".holder", "cockpit")
        page.wait_for_new_picture()
        page.press("l")  # lands nothing without control
    with observe("watched") as drone:
        assert drone.feedback().state.airborne
        assert (drone.feedback().owner or "").startswith("cockpit")
        flies.press("l")
        watch[0].wait_for_text(".pill", "landed")


#: It hovers within 2 s, by a timer of the same browser: on a busy machine that takes longer, too.
LOOKS = 100
LOOK_MS = 20
FREEZE = "setTimeout(() => { const end = Date.now() + 4000; while (Date.now() < end); }, 0)"


@pytest.mark.parametrize("crashes", [True, False], ids=["crashes", "hangs"])
def test_a_page_that_dies_in_flight_leaves_a_hovering_drone(deck: Deck, crashes: bool) -> None:
    deck.proxy("dies")
    page = deck.page("dies")
    witness = deck.page("dies")
    with observe("dies") as drone:
        page.page.bring_to_front()
        page.take_off()
        page.page.keyboard.down("w")
        page.until(lambda: drone.feedback().state is FlightState.FLYING, "it flies")
        if crashes:
            with suppress(Exception):  # the browser says that its page has crashed
                page.page.goto("chrome://crash", timeout=200)
        else:
            page.page.evaluate(FREEZE)
        for _ in range(LOOKS):
            if drone.feedback().state is FlightState.HOVERING:
                break
            witness.page.wait_for_timeout(LOOK_MS)
        assert drone.feedback().state is FlightState.HOVERING, "it hovers"
        witness.wait_for_text(".pill", "hovering")
        if crashes:
            witness.until(lambda: drone.feedback().owner is None, "the authority was given back")


def test_a_killed_proxy_is_shown_as_lost_and_comes_back(deck: Deck) -> None:
    proxy = deck.proxy("killed")
    page = deck.page("killed")
    proxy.signal(signal.SIGKILL)
    page.until(lambda: page.pane.get_attribute("data-lost") == "true", "it is lost")
    page.wait_for_text(".alarms", "lost")
    page.until(lambda: "lost" in (page.page.locator('.card[data-drone="killed"]').text_content() or ""), "in the list")
    proxy.end()
    deck.proxy("killed")
    page.until(lambda: page.pane.get_attribute("data-lost") == "false", "it is back")
    page.wait_for_text(".pill", "landed")
    page.wait_for_new_picture()


PAD = """
window.pad = {id: "Test pad", mapping: "standard", connected: true, axes: [0, 0, 0, 0],
              buttons: Array.from({length: 17}, () => ({pressed: false}))};
navigator.getGamepads = () => [window.pad];
"""


def test_gamepad(deck: Deck) -> None:
    deck.proxy("pad")
    page = deck.page("pad", prepare=PAD)
    with observe("pad") as drone:
        page.take_control()
        page.page.evaluate("window.pad.buttons[9].pressed = true")
        page.wait_for_text(".pill", "hovering")
        pushed_s = 0.0

        def flies_forward() -> bool:
            nonlocal pushed_s
            if time.monotonic() - pushed_s > 3.0:  # after a stall of a busy machine, sticks must be centred first
                page.page.evaluate("window.pad.axes = [0, 0, 0, 0]")
                page.page.wait_for_timeout(200)
                page.page.evaluate("window.pad.axes = [0, 0, 0, -1]")
                pushed_s = time.monotonic()
            return (drone.feedback().velocity_m_s or (0,))[0] > 0.3

        page.until(flies_forward, "the right stick flies forward")
        page.page.evaluate("window.pad = null")
        page.until(lambda: drone.feedback().state is FlightState.HOVERING, "it hovers when the gamepad goes away")


def test_a_waypoint_is_previewed_and_flown_to(deck: Deck) -> None:
    deck.proxy("place")
    page = deck.page("place")
    with observe("place") as drone:
        page.take_off()
        canvas = page.pane.locator(".map.clickable")
        canvas.wait_for()
        page.until(lambda: canvas.get_attribute("data-still") == "true", "it shows the room")
        box = canvas.bounding_box()
        assert box is not None
        start = drone.feedback().position_m
        # The room, 30 m wide, has 10/13 of the map's height: some 2 m to the right.
        place = {"x": box["width"] / 2 + box["height"] * 0.05, "y": box["height"] / 2}
        canvas.click(position=place)
        page.wait_for_text(".preview", "m straight")
        assert drone.feedback().state is FlightState.HOVERING, "choosing moves nothing"
        page.press("Enter")
        page.until(lambda: drone.feedback().state is FlightState.FLYING, "it flies")
        pressed_s = time.monotonic()

        def arrived() -> bool:
            """It hovers on its way if a busy machine made the page silent: send it again, as a person would."""
            nonlocal pressed_s
            if "waypoint is reached" in page.says(".notice"):
                return True
            if drone.feedback().state is FlightState.HOVERING and time.monotonic() - pressed_s > 3.0:
                pressed_s = time.monotonic()
                canvas.click(position=place)
                page.press("Enter")
            return False

        page.until(arrived, "it flies there, some metres", 40.0)
        there = drone.feedback().position_m
        assert start is not None
        assert there is not None
        assert there[0] > start[0] + 0.3, "to the right is east"
        assert abs(there[1] - start[1]) < 0.3


def test_plots_space_and_recordings_work_under_the_pages_policy(deck: Deck) -> None:
    deck.proxy("all")
    page = deck.page("all")
    page.pane.get_by_role("button", name="3-D").click()
    page.pane.locator(".scene canvas").wait_for()
    page.pane.locator(".plots select").first.select_option("battery")
    page.until(lambda: "battery" in page.says(".legend"), "the number that was picked")
    page.pane.locator(".uplot canvas").wait_for()
    page.page.get_by_role("button", name="Record", exact=True).click()
    page.page.locator(".running li").wait_for()
    page.until(lambda: "none dropped" in (page.page.locator(".running li").text_content() or ""), "length and size")
    page.page.get_by_role("button", name="Stop recording all").click()
    page.page.locator(".past li").wait_for()
    assert "all" in (page.page.locator(".past li").text_content() or "")
    assert page.page.locator(".past a").get_attribute("href"), "its report"
    page.page.locator(".past li").get_by_role("button", name="Replay").click()
    replay = page.page.locator('.pane:not([data-drone="all"])')
    replay.get_by_role("button", name="End replay").click()
    page.until(lambda: replay.count() == 0, "the replay is closed")
    assert page.problems == []


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_a_phone(deck: Deck, scheme: str) -> None:
    deck.proxy("phone")
    page = deck.page("phone", color_scheme=scheme, has_touch=True)
    page.page.set_viewport_size({"width": 390, "height": 844})
    assert page.page.locator("html").get_attribute("data-theme") == scheme
    assert page.page.evaluate("document.documentElement.scrollWidth") <= 390, "nothing beside the screen"
    for name in ("Take control", "Take off", "Hover", "Land", "Motors off"):
        assert page.pane.locator(".strip").get_by_role("button", name=name).is_visible()
    box = page.pane.locator(".strip .stop").bounding_box()
    assert box is not None
    assert box["y"] + box["height"] <= 844, "in reach without scrolling"


def test_a_token_admits_an_observer_or_a_pilot(open_cockpit: tuple[Browser, str], deck: Deck, tmp_path: Path) -> None:
    tokens = tmp_path / "tokens"
    tokens.write_text("pilot 0123456789abcdefP ann\nobserver 0123456789abcdefO bob\n")
    tokens.chmod(0o600)
    deck.proxy("asked")
    address = deck.cockpit("--token-file", str(tokens), "--recordings", str(tmp_path))
    browser, _ = open_cockpit
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(f"{address}#asked")
        page.get_by_label("Token").fill("not a token of this cockpit")
        page.get_by_role("button", name="Enter").click()
        page.get_by_text("this token is unknown here").wait_for()
        page.get_by_label("Token").fill("0123456789abcdefO")
        page.get_by_role("button", name="Enter").click()
        page.get_by_text("You may watch, not fly.").wait_for()
        assert page.get_by_role("button", name="Motors off").count() == 0
        page.get_by_role("button", name="Log out").click()
        page.get_by_label("Token").fill("0123456789abcdefP")
        page.get_by_role("button", name="Enter").click()
        page.get_by_role("button", name="Take control").wait_for()
        assert "ann" in (page.locator(".person").text_content() or "")

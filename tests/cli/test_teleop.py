"""Flying with the terminal's keys."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import skyloop
from skyloop.cli.keyboard import (
    HOLD_S,
    KEY_MAP,
    ORDERS,
    STICKS,
    TWICE_S,
    Deflection,
    Hands,
    Keyboard,
    Order,
    Tokenizer,
)
from skyloop.cli.teleop import Teleop
from skyloop.messages import EmergencyStop, Fate, FlightState, Hover, Land, Outcome, Refusal, Takeoff, Velocity
from tests.support.commands import Run
from tests.support.processes import Process
from tests.support.scripted_proxy import WAIT_S, ScriptedProxy, flown, scripted
from tests.support.systems import only_on

FLYING, LANDED, LANDING = FlightState.FLYING, FlightState.LANDED, FlightState.LANDING
FORWARD = Deflection(forward=1)


class Fingers:
    """Hands, and the time: each call is a step."""

    def __init__(self) -> None:
        self.hands = Hands()
        self.now_s = 100.0

    def press(self, *keys: str, after_s: float = 0.05, state: FlightState = FLYING) -> list[Order | Deflection]:
        self.now_s += after_s
        return self.hands.step(keys, self.now_s, state)

    def wait(self, seconds: float, state: FlightState = FLYING) -> list[Order | Deflection]:
        """Step at the rate of the loop, without a key."""
        wanted: list[Order | Deflection] = []
        for _ in range(round(seconds / 0.05)):
            wanted += self.press(state=state)
        return wanted

    def hold(self, key: str, seconds: float, every_s: float = 0.03) -> list[Order | Deflection]:
        """Hold a key: a press, half a second of nothing, then repeats."""
        wanted = self.press(key) + self.wait(0.5)
        for _ in range(round(seconds / every_s)):
            wanted += self.press(key, after_s=every_s)
        return wanted


def test_a_press_moves_its_stick_for_a_while_and_repeats_hold_it() -> None:
    fingers = Fingers()
    assert fingers.press("w") == [FORWARD]
    assert fingers.press("left", after_s=0.2) == [Deflection(forward=1, yaw_rate=1)]
    assert fingers.press(after_s=HOLD_S - 0.21) == [Deflection(forward=1, yaw_rate=1)]
    assert fingers.press(after_s=0.02) == [Deflection(yaw_rate=1)]
    assert fingers.press(after_s=HOLD_S) == ["centre"]
    assert fingers.press() == []
    fingers.press("s")
    assert fingers.press("w") == [FORWARD], "the newest press of an axis counts"
    assert fingers.press("W", "x", "[") == [FORWARD]


def test_sticks_do_nothing_on_the_ground_and_unmoved_sticks_are_not_released() -> None:
    fingers = Fingers()
    assert fingers.press("w", state=LANDED) == ["grounded"]
    assert fingers.press(after_s=1.0, state=LANDED) == []


@pytest.mark.parametrize("key", ["h", "H", " ", "t", "l", "esc", "alt"])
def test_a_stop_releases_all_sticks(key: str) -> None:
    fingers = Fingers()
    fingers.press("w")
    (order,) = fingers.press(key)
    assert order == {"t": "takeoff", "l": "land"}.get(key, "hover")
    assert fingers.wait(1.0) == [], "nor is a hover sent after it, which would end a landing"


def test_a_landing_is_not_ended_by_a_stick_that_was_held_or_is_still() -> None:
    """L during, or soon after, a stick key: the vehicle shows its landing only after some time."""
    fingers = Fingers()
    fingers.hold("w", 0.3)
    assert fingers.press("l") == ["land"]
    for _ in range(40):
        assert fingers.press("w") == [], "held, while the vehicle still seems to fly"
    for _ in range(100):
        assert fingers.press("w", state=LANDING) == []
    assert fingers.press("w") == [], "still held, as somebody has ended the landing"
    assert fingers.wait(1.0) == []
    assert fingers.press("w") == [FORWARD], "pressed anew"


def test_h_ends_a_landing_and_gives_the_sticks_back() -> None:
    fingers = Fingers()
    fingers.press("l")
    assert fingers.press("h", state=LANDING) == ["hover"]
    assert fingers.press("w") == [FORWARD]


@pytest.mark.parametrize("gap_s", [0.0, 0.03, 0.1, 0.15, 0.19, 0.3, 0.6, TWICE_S - 0.01])
def test_esc_hovers_and_twice_stops_the_motors(gap_s: float) -> None:
    fingers = Fingers()
    assert fingers.press("esc") == ["hover"]
    stopped = fingers.press("esc", after_s=gap_s)
    assert stopped + fingers.wait(0.2) == ["stop"]
    assert fingers.wait(2.0) == []


def test_two_presses_of_esc_in_one_read_stop_the_motors() -> None:
    fingers = Fingers()
    assert fingers.press("esc", "esc") + fingers.wait(0.2) == ["hover", "stop"]
    assert Fingers().press("esc", "esc", "l") == ["hover", "stop"], "another key shows that none is held"


def test_a_late_second_press_is_a_first_one() -> None:
    fingers = Fingers()
    fingers.press("esc")
    assert fingers.press("esc", after_s=TWICE_S + 0.01) == ["hover"]


@pytest.mark.parametrize("every_s", [0.015, 0.03, 0.05, 0.092])
def test_esc_that_is_held_stops_no_motors(every_s: float) -> None:
    fingers = Fingers()
    assert fingers.hold("esc", 3.0, every_s) == ["hover", "held"]
    assert fingers.wait(0.5) == []
    assert fingers.press("esc") == ["hover"], "which was one press, however long"
    assert fingers.press("esc", after_s=0.15) == ["stop"], "pressed on purpose after it"


def test_repeats_that_were_held_up_stop_no_motors() -> None:
    """The program, or its network connection, stalled for a moment while Esc was held."""
    fingers = Fingers()
    fingers.press("esc")
    fingers.press("esc", after_s=0.5)
    assert fingers.press(*["esc"] * 9, after_s=0.4) + fingers.wait(0.5) == ["held"]
    assert Fingers().press(*["esc"] * 9) == ["hover", "held"]
    known = Fingers()
    known.hold("w", 0.3)
    known.wait(3.0)
    known.press("esc")
    known.wait(0.5)
    assert known.press("esc", after_s=0.02) == ["held"]
    assert "stop" not in known.press(*["esc"] * 9, after_s=0.4) + known.wait(0.5)


@pytest.mark.parametrize("key", ["w", "esc"])
def test_esc_held_just_past_its_first_repeat_is_one_press_once_the_keyboard_is_known(key: str) -> None:
    """Released after one repeat, which comes as late as a slow second press, it cut the motors."""
    fingers = Fingers()
    fingers.hold(key, 0.3)
    fingers.wait(3.0)
    assert fingers.press("esc") == ["hover"]
    fingers.wait(0.5)
    assert fingers.press("esc", after_s=0.02) + fingers.wait(1.0) == ["held"]
    assert fingers.press("esc") == ["hover"]
    assert fingers.press("esc", after_s=0.3) + fingers.wait(0.2) == ["stop"], "a second press at another time"


@pytest.mark.parametrize("delay_s", [0.25, 0.5])
def test_esc_pressed_repeatedly_at_the_keyboards_own_pace_stops_the_motors(delay_s: float) -> None:
    """Each second press was taken for a repeat of the first, however often Esc was pressed."""
    fingers = Fingers()
    fingers.press("w")
    fingers.wait(delay_s - 0.05)
    for _ in range(5):
        fingers.press("w")
    fingers.wait(3.0)
    wanted: list[Order | Deflection] = []
    for _ in range(3):
        wanted += fingers.press("esc") + fingers.wait(delay_s - 0.05)
    assert wanted == ["hover", "held", "stop"]


def test_repeats_that_were_held_up_behind_the_first_one_stop_no_motors() -> None:
    fingers = Fingers()
    fingers.hold("w", 0.3)
    fingers.wait(3.0)
    assert fingers.press("esc") + fingers.wait(0.5) + fingers.press("esc", after_s=0.02) == ["hover", "held"]
    assert "stop" not in fingers.press(*["esc"] * 9, after_s=0.4) + fingers.wait(0.5)


@pytest.mark.parametrize("gap_s", [0.5, 0.9])
def test_repeated_presses_of_esc_stop_the_motors_whatever_the_keyboards_delay(gap_s: float) -> None:
    """Presses in the rhythm of the keyboard's delay were each taken for its first repeat, and nothing stopped."""
    fingers = Fingers()
    fingers.hold("w", 0.3)
    fingers.wait(3.0)
    assert fingers.press("esc") == ["hover"]
    fingers.wait(0.5)
    assert fingers.press("esc", after_s=0.02) + fingers.wait(gap_s - 0.02) == ["held"]
    assert fingers.press("esc") == ["stop"]


@pytest.mark.parametrize("between", ["w", "alt", "h", "up", "x"])
def test_esc_with_another_key_between_is_not_a_second_press(between: str) -> None:
    fingers = Fingers()
    fingers.press("esc")
    fingers.press(between, after_s=0.3)
    wanted = fingers.press("esc", after_s=0.3) + fingers.wait(0.5)
    assert "stop" not in wanted
    assert "hover" in wanted


def test_nothing_replaces_a_stop_that_is_not_shown_yet() -> None:
    fingers = Fingers()
    fingers.press("esc", "esc")
    assert fingers.press("l", "w", "h", "t") == ["stop"]
    assert fingers.press("l", "w", "h", "t") == []
    assert fingers.press("esc") == ["stop"], "once more"
    assert fingers.press("c", "q") == ["quit"]
    assert fingers.press("t", state=FlightState.EMERGENCY) == ["takeoff"]


@given(st.lists(st.tuples(st.sampled_from(["esc", "alt", *STICKS, *ORDERS]), st.floats(0.0, 2.0)), max_size=40))
def test_motors_are_cut_only_by_two_presses_of_esc(presses: list[tuple[str, float]]) -> None:
    fingers = Fingers()
    stopped = False
    for number, (key, after_s) in enumerate(presses):
        wanted = fingers.press(key, after_s=after_s)
        before = [name for name, _ in presses[max(0, number - 2) : number + 1]]
        assert "stop" not in wanted or before.count("esc") >= 2 or stopped
        stopped = stopped or "stop" in wanted
        assert sum(isinstance(one, Deflection) for one in wanted) <= 1
    assert "centre" in fingers.wait(1.0) or not any(fingers.wait(1.0))


def test_each_listed_key_does_something() -> None:
    told = {"↑": "up", "↓": "down", "←": "left", "→": "right", "−": "-", "Space": " ", "Esc": "esc"}
    keys = {told.get(word, word.lower()) for keys, _ in KEY_MAP for word in keys.replace(",", " ").split()}
    assert keys == {*STICKS, *ORDERS, "esc"}


@pytest.mark.parametrize(
    ("data", "keys", "flushed"),
    [
        (b"w\x1b[A\x1bOB\x1b[C\x1b[Dt", ["w", "up", "down", "right", "left", "t"], None),
        (b"\x1b", [], ["esc"]),
        (b"\x1b\x1b", [], ["esc", "esc"]),
        (b"\x1b[", [], ["alt"]),
        (b"\x1bO", [], ["alt"]),
        (b"\x1bw", ["alt"], None),
        (b"\x1bw\x1bw\x1bw", ["alt", "alt", "alt"], None),
        (b"\x1b\x1bx", ["esc", "alt"], None),
        (b"\x1b\x1b[A", ["alt"], None),
        (b"\x1b[1;5A\x1b[1;2D", [], None),
        (b"\x1b[3~l\x1b[15~\x1bOP", ["l"], None),
        (b"\x1b[1;5", [], ["alt"]),
        (b"\x1b[\x1b", ["alt"], ["esc"]),
        (b"\x13\x1a", ["\x13", "\x1a"], None),
        (b"\x1b[" + b"1" * 60, None, None),
    ],
)
def test_escape_sequences_are_distinguished_from_esc_and_letters(
    data: bytes, keys: list[str] | None, flushed: list[str] | None
) -> None:
    """Ctrl with an arrow ends in a letter, and Alt with a letter begins with Esc: neither counts as either key."""
    tokens = Tokenizer()
    found = tokens.feed(data)
    if keys is not None:
        assert found == keys
    assert tokens.waits is (flushed is not None)
    if flushed is not None:
        assert tokens.flush() == flushed
    assert not tokens.waits
    assert "esc" not in found or b"\x1b\x1b" in data


def test_a_slowly_arriving_arrow_sequence_is_an_arrow() -> None:
    tokens = Tokenizer()
    assert tokens.feed(b"\x1b") == []
    assert tokens.feed(b"[") == []
    assert tokens.feed(b"D") == ["left"]
    tokens.feed(b"\x1b")
    assert tokens.flush() == ["esc"]
    assert tokens.feed(b"[Aw") == ["w"], "an arrow, and no letters"


@pytest.mark.parametrize(("focus", "told"), [(b"\x1b[O", "another window"), (b"\x1b[I", "again")])
def test_a_window_without_keys_is_reported_and_swallows_no_esc(focus: bytes, told: str) -> None:
    """A terminal behind another window received no keys, without a message."""
    tokens = Tokenizer()
    assert tokens.feed(focus) == []
    assert told in tokens.other
    assert tokens.feed(b"w") == ["w"]
    assert tokens.other == ""
    assert tokens.feed(b"\x1b\x1b" + focus + b"l") == ["esc", "esc", "l"]
    assert told in tokens.other
    assert tokens.feed(b"\x1b[15~") == []
    assert tokens.other == "this key has no function here"
    tokens.feed(b"\x1b")
    tokens.flush()
    assert tokens.other == ""


def test_a_key_that_does_nothing_says_so() -> None:
    fingers = Fingers()
    for key, told in (
        ("x", "X has no function here"),
        ("\n", "Enter has no function here"),
        ("\x01", "'\\x01' has no function here"),
    ):
        assert fingers.press(key) == []
        assert fingers.hands.no_effect == told
    assert fingers.press("w") == [FORWARD]
    assert fingers.hands.no_effect == ""
    assert fingers.press("l") == ["land"]
    assert fingers.press("up", state=LANDING) == []
    assert fingers.hands.no_effect.startswith("↑ has no effect during a landing")
    assert fingers.press("esc", after_s=5.0) == ["hover"]
    assert fingers.press("esc", after_s=0.15) == ["stop"]
    assert fingers.press("t") == []
    assert fingers.hands.no_effect == "T has no effect while the motors are being stopped"


@given(st.lists(st.binary(max_size=60), max_size=5))
def test_any_terminal_input_is_parsed_as_keys(parts: list[bytes]) -> None:
    tokens, hands = Tokenizer(), Hands()
    for at, data in enumerate(parts):
        keys = tokens.feed(data) + (tokens.flush() if tokens.waits else [])
        assert all(keys)
        hands.step(keys, float(at), FLYING)


@pytest.fixture
def line(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int]]:
    """A terminal: the person's end, and the end used as standard input."""
    person, program = os.openpty()
    with os.fdopen(program, "rb", buffering=0) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield person, program
    os.close(person)


@only_on("linux", "darwin", reason="consoles have no terminal settings")
def test_ctrl_z_and_ctrl_s_are_keys_and_the_shells_terminal_settings_are_undone(line: tuple[int, int]) -> None:
    import termios

    person, program = line
    before = termios.tcgetattr(program)
    with Keyboard() as keyboard:
        ours = termios.tcgetattr(program)
        os.write(person, b"\x13\x1aw\x1b[A")
        assert keyboard.keys(WAIT_S) == ["\x13", "\x1a", "w", "up"]
        termios.tcsetattr(program, termios.TCSANOW, before)  # like a shell before it continues a job
        signal.raise_signal(signal.SIGCONT)
        assert termios.tcgetattr(program) == ours
        os.write(person, b"\x1b")
        assert keyboard.keys(WAIT_S) == []
        assert keyboard.keys(WAIT_S) == ["esc"]
        assert keyboard.keys(0.0) == []
    assert termios.tcgetattr(program) == before
    assert signal.getsignal(signal.SIGCONT) is signal.SIG_DFL


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        proxy.state = FLYING
        yield proxy


def test_a_hover_ends_a_take_off_that_does_not_show_yet(proxy: ScriptedProxy) -> None:
    """T, then Esc or H while it was still on the ground: nothing was sent, and it took off."""
    proxy.state = FlightState.LANDED
    with flown(proxy) as drone:
        drone.wait("landed", WAIT_S)
        pilot = Teleop(drone, 0.5, 0.8)
        pilot.obey("hover")
        pilot.obey("takeoff")
        proxy.until_commanded(Takeoff())
        assert Hover() not in proxy.actions(), "nothing was to be ended"
        pilot.obey("hover")
        assert not proxy.until_commanded(Hover()).automatic


def test_an_emergency_stop_is_handled_while_control_is_requested_or_released(
    proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """C waited for the proxy's answer for up to 7 s, R for 2 s, and no key was read meanwhile."""
    with flown(proxy) as drone:
        pilot, answered = Teleop(drone, 0.5, 0.8), threading.Event()
        monkeypatch.setattr(drone, "request_authority", lambda: answered.wait(WAIT_S))
        monkeypatch.setattr(drone._connection, "call", lambda *_: pytest.fail("R waits for an answer"))
        for order in ("take", "take", "stop"):
            pilot.obey(order)
        proxy.until_commanded(EmergencyStop())
        assert not answered.is_set()
        answered.set()
        pilot._taking.join(WAIT_S)
        pilot.obey("release")
        assert pilot._message == "release"


def test_the_pressed_keys_are_flown(proxy: ScriptedProxy) -> None:
    with flown(proxy) as drone:
        drone.wait("flying", WAIT_S)
        pilot = Teleop(drone, 0.5, 0.8)
        pilot.obey("slower")
        pilot.obey(Deflection(forward=1, yaw_rate=-1))
        assert not proxy.until_commanded(Velocity(0.25, 0.0, 0.0, -0.4)).automatic
        pilot.obey("centre")
        assert proxy.until_commanded(Hover()).automatic, "nobody pressed a key for it"
        count = len(proxy.commands)
        pilot.obey("hover")
        assert not proxy.until_commanded(Hover(), count + 1).automatic
        pilot.obey(FORWARD)
        pilot.obey("land")
        pilot.obey("centre")
        assert drone._commands.newest == Land()
        pilot.obey("takeoff")
        pilot.obey("stop")
        proxy.until_commanded(EmergencyStop())
        proxy.take_over("boss")
        drone.wait(lambda _: drone.authority.state == "preempted", WAIT_S)
        for order, told in (
            (FORWARD, "boss took over the authority; it returns when they release it (C takes control)"),
            ("grounded", "T takes off"),
            ("held", "press it twice"),
            ("release", "release"),
        ):
            pilot.obey(order)  # type: ignore[arg-type]
            assert told in pilot._message
        assert pilot.picture()


def test_keys_that_have_no_effect_say_why(proxy: ScriptedProxy) -> None:
    """With the link lost, or sticks refused, nothing moved, without a message."""
    with flown(proxy) as drone:
        drone.wait("flying", WAIT_S)
        pilot = Teleop(drone, 0.5, 0.8)
        pilot.obey(FORWARD)
        command = proxy.until_commanded(Velocity(0.5))
        assert pilot._message == ""
        assert proxy.owner is not None
        text = "skyloop teleop: velocity refused: the vehicle is in RTL, which was not chosen here"
        proxy.more["outcome"] = Outcome(proxy.owner[0], command.intent, Fate.OTHERS, Refusal.WRONG_STATE, text)
        drone.wait(lambda feedback: feedback.outcome is not None, WAIT_S)
        pilot.obey(FORWARD)
        assert pilot._message == f"the keys have no effect: {text}"
        proxy.more.clear()
        proxy.stop()
        drone._state.notifier.wait_for(lambda: drone.link.application.value == "lost", WAIT_S)
        pilot.obey(FORWARD)
        assert pilot._message.startswith("the keys have no effect: the link is ")
        proxy.start()
    proxy.state = LANDED
    with flown(proxy) as drone:
        drone.wait("landed", WAIT_S)
        pilot = Teleop(drone, 0.5, 0.8)
        pilot.obey("hover")
        assert pilot._message == "on the ground: T takes off"


def test_without_a_terminal_it_says_so(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    with Path(os.devnull).open() as nothing:
        monkeypatch.setattr("sys.stdin", nothing)
        ended = run("teleop", "alpha")
    assert ended.code == 2
    assert "not a terminal" in ended.err


class Terminal:
    """``skyloop teleop`` in a separate terminal."""

    def __init__(self, *arguments: str) -> None:
        self._master, slave = os.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "skyloop", "teleop", *arguments], stdin=slave, stdout=slave, stderr=slave
        )
        os.close(slave)
        self.text = ""

    def press(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def until(self, words: str, timeout_s: float = 20.0) -> None:
        deadline = time.monotonic() + timeout_s
        while words not in self.text:
            assert select.select([self._master], [], [], max(0.0, deadline - time.monotonic()))[0], self.text[-2000:]
            self.text += os.read(self._master, 65536).decode("utf-8", "replace")

    def wait(self, timeout_s: float = 20.0) -> int:
        """Read until it has ended."""
        deadline = time.monotonic() + timeout_s
        while self.process.poll() is None:
            assert time.monotonic() < deadline, self.text[-2000:]
            if select.select([self._master], [], [], 0.05)[0]:
                try:
                    self.text += os.read(self._master, 65536).decode("utf-8", "replace")
                except OSError:  # the other end is closed
                    break
        return self.process.wait(5)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(5)
        os.close(self._master)


@pytest.fixture
def terminal(alpha: Process) -> Iterator[Terminal]:
    terminal = Terminal("alpha")
    yield terminal
    terminal.close()


@pytest.mark.process
def test_a_flight_by_keys(terminal: Terminal) -> None:
    terminal.until("take off")
    with skyloop.connect("alpha", access="observe") as drone:
        terminal.press(b"w")
        terminal.until("T takes off")
        terminal.press(b"t")
        drone.wait("hovering", timeout_s=30.0)
        terminal.press(b"w\x1b[D")
        drone.wait(lambda feedback: (feedback.velocity_m_s or (0.0,))[0] > 0.05, 20.0)
        drone.wait("hovering", timeout_s=30.0)  # no key is held
        terminal.press(b"+")
        terminal.until("1 m/s, 1.6 rad/s")
        terminal.press(b"r")
        drone.wait(lambda feedback: feedback.owner is None, 20.0)
        terminal.press(b"w")
        terminal.until("C takes control")
        terminal.press(b"c")
        drone.wait(lambda feedback: feedback.owner == "skyloop teleop", 20.0)
        terminal.press(b"q")
        assert terminal.wait() == 0
        assert drone.wait("landed", timeout_s=30.0)


@pytest.mark.process
def test_esc_twice_cuts_the_motors_and_ctrl_c_ends(terminal: Terminal) -> None:
    terminal.until("take off")
    with skyloop.connect("alpha", access="observe") as drone:
        terminal.press(b"t")
        drone.wait("hovering", timeout_s=30.0)
        terminal.press(b"\x1b\x1b")
        drone.wait("emergency", timeout_s=30.0)
        terminal.process.send_signal(signal.SIGINT)
        assert terminal.wait() == 0
    with skyloop.connect("alpha") as pilot:
        pilot.reset_emergency()
        pilot.wait("landed", timeout_s=30.0)


@pytest.mark.process
def test_l_lands_while_a_stick_key_is_held_and_esc_that_is_held_cuts_nothing(terminal: Terminal) -> None:
    """The stick's hover followed the landing, and autopilots break off a landing for it."""
    terminal.until("take off")
    with skyloop.connect("alpha", access="observe") as drone:
        terminal.press(b"t")
        drone.wait("hovering", timeout_s=30.0)
        for _ in range(6):
            terminal.press(b"w")
            time.sleep(0.05)
        terminal.press(b"\x1b")
        for _ in range(8):
            terminal.press(b"\x1b")
            time.sleep(0.03)
        terminal.until("holding Esc")
        for _ in range(4):
            terminal.press(b"\x1bw")
            time.sleep(0.03)
        assert drone.feedback().state.airborne
        terminal.press(b"w")
        drone.wait("flying", timeout_s=10.0)
        terminal.press(b"l")
        drone.wait("landed", timeout_s=30.0)
        terminal.press(b"q")
        assert terminal.wait() == 0

"""Flying by the keys of a terminal."""

from __future__ import annotations

import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import skyloop
from skyloop.cli.keyboard import HOLD_S, KEY_MAP, ORDERS, STICKS, TWICE_S, Deflection, Sticks, split_keys
from tests.cli.conftest import Run
from tests.processes.conftest import Process


def test_a_press_moves_its_stick_for_a_while_and_repeats_keep_it() -> None:
    sticks = Sticks()
    assert sticks.press("w", 1.0) is None
    assert sticks.press("left", 1.2) is None
    assert sticks.deflection(1.0 + HOLD_S - 0.01) == Deflection(forward=1, yaw_rate=1)
    assert sticks.deflection(1.0 + HOLD_S) == Deflection(yaw_rate=1)
    sticks.press("s", 2.0)
    sticks.press("w", 2.1)
    assert sticks.deflection(2.2) == Deflection(forward=1), "the newest press of an axis counts"
    assert sticks.deflection(9.0) == Deflection()


@pytest.mark.parametrize("key", ["h", "H", " ", "t", "l", "esc"])
def test_an_order_to_stop_lets_all_sticks_go(key: str) -> None:
    sticks = Sticks()
    sticks.press("w", 1.0)
    sticks.press(key, 1.1)
    assert sticks.deflection(1.1) == Deflection()


def test_esc_hovers_and_twice_stops_the_motors() -> None:
    sticks = Sticks()
    assert sticks.press("esc", 5.0) == "hover"
    assert sticks.press("esc", 5.0 + TWICE_S) == "stop"
    assert Sticks().press("esc", 0.0) == "hover"
    late = Sticks()
    late.press("esc", 5.0)
    assert late.press("esc", 5.1 + TWICE_S) == "hover"


def test_each_key_that_is_told_does_something() -> None:
    told = {"↑": "up", "↓": "down", "←": "left", "→": "right", "−": "-", "Space": " ", "Esc": "esc"}
    keys = {told.get(word, word.lower()) for keys, _ in KEY_MAP for word in keys.replace(",", " ").split()}
    assert keys == {*STICKS, *ORDERS, "esc"}


def test_arrows_are_told_from_esc() -> None:
    assert split_keys(b"w\x1b[A\x1bOB\x1b[C\x1b[Dt") == (["w", "up", "down", "right", "left", "t"], b"")
    assert split_keys(b"\x1b") == ([], b"\x1b")
    assert split_keys(b"\x1b[") == ([], b"\x1b[")
    assert split_keys(b"\x1b\x1b") == (["esc"], b"\x1b")
    assert split_keys(b"\x1bx") == (["esc", "x"], b"")


@given(st.binary(max_size=60))
def test_whatever_a_terminal_sends_is_keys(data: bytes) -> None:
    keys, rest = split_keys(data)
    assert len(rest) <= 2
    assert all(keys)
    for at, key in enumerate(keys):
        Sticks().press(key, float(at))


def test_without_a_terminal_it_says_so(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    with Path(os.devnull).open() as nothing:
        monkeypatch.setattr("sys.stdin", nothing)
        ended = run("teleop", "alpha")
    assert ended.code == 2
    assert "no terminal" in ended.err


class Terminal:
    """``skyloop teleop`` in a terminal of its own."""

    def __init__(self, *arguments: str) -> None:
        self._master, slave = pty.openpty()
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
        """Read on until it has ended."""
        deadline = time.monotonic() + timeout_s
        while self.process.poll() is None:
            assert time.monotonic() < deadline, self.text[-2000:]
            if select.select([self._master], [], [], 0.05)[0]:
                try:
                    self.text += os.read(self._master, 65536).decode("utf-8", "replace")
                except OSError:  # its other end is closed
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
        drone.wait("hovering", timeout_s=30.0)  # no key is held any more
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

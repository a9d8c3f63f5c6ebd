"""What all sessions share: restarts and late packets, the emergency stop, reasons with remedies, slow names."""

from __future__ import annotations

import errno
import os
import socket
import stat
import threading
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import nanoseconds
from skyloop.drivers.vehicle_link import NameLookup
from skyloop.drivers.vehicle_session import (
    GIVE_UP_NS,
    PACE_NS,
    RESTART_RUN,
    SETTLE_NS,
    MotorStop,
    PacketOrder,
    RestartWatch,
    VehicleEvent,
    serial_trouble,
    trouble_of,
)
from skyloop.errors import DriverError
from tests.support.systems import only_on

STEP_NS = 20_000_000


def judged(watch: RestartWatch, numbers: list[int]) -> list[PacketOrder]:
    """Return the verdicts on consecutive packets."""
    return [watch.update(number, place * STEP_NS) for place, number in enumerate(numbers)]


def test_a_new_count_needs_a_run_of_packets() -> None:
    watch = RestartWatch(tolerance=100)
    assert judged(watch, [5000, 5020, 4950, 3000, 5040]) == [
        *([PacketOrder.NEW] * 3),
        PacketOrder.LATE,
        PacketOrder.NEW,
    ]
    assert judged(watch, [20, 40, 60, 80, 100, 120]) == [
        *([PacketOrder.LATE] * (RESTART_RUN - 1)),
        PacketOrder.RESTARTED,
        PacketOrder.NEW,
    ]


def test_a_burst_of_late_packets_does_not_start_a_new_count() -> None:
    """However many: they arrive together, and the next one continues the old count."""
    watch = RestartWatch()
    assert watch.update(5000, 0) is PacketOrder.NEW
    assert {watch.update(number, STEP_NS) for number in range(1000, 1020)} == {PacketOrder.LATE}
    assert watch.update(5001, 2 * STEP_NS) is PacketOrder.NEW


@pytest.mark.parametrize("tolerance", [0, 1000])
def test_a_count_may_restart_where_it_wraps(tolerance: int) -> None:
    watch = RestartWatch(tolerance, 1 << 32)
    numbers = [(1 << 32) - 30, (1 << 32) - 10, 10, (1 << 32) - 5000, 30]
    assert judged(watch, numbers) == [
        PacketOrder.NEW,
        PacketOrder.NEW,
        PacketOrder.NEW,
        PacketOrder.LATE,
        PacketOrder.NEW,
    ]


@given(st.lists(st.integers(1, 400), min_size=1, max_size=40), st.integers(1, 5000))
def test_single_late_packets_never_start_a_new_count(steps: list[int], behind: int) -> None:
    watch, number = RestartWatch(), 10_000
    for place, step in enumerate(steps):
        number += step
        assert watch.update(number, 2 * place * STEP_NS) is PacketOrder.NEW
        assert watch.update(number - behind, (2 * place + 1) * STEP_NS) is PacketOrder.LATE


TICK_NS = nanoseconds(0.02)
BEGUN_NS = nanoseconds(100.0)


class Press:
    """A stop that was just pressed, with a clock. ``sent``: times when it was sent [ns since the press]."""

    def __init__(self) -> None:
        self.events: list[VehicleEvent] = []
        self.stop = MotorStop(self.events.append)
        self.now_ns = BEGUN_NS
        self.sent: list[int] = []
        self.stop.press(self.now_ns)

    def run(self, span_ns: int, shown: bool | None = None) -> None:
        until_ns = self.now_ns + span_ns
        while self.now_ns < until_ns:
            if self.stop.step(shown, self.now_ns):
                self.sent.append(self.now_ns - BEGUN_NS)
            self.now_ns += TICK_NS


@pytest.mark.parametrize("shown", [None, False])
def test_a_stop_is_sent_at_once_and_steadily_until_it_is_abandoned(shown: bool | None) -> None:
    press = Press()
    press.run(2 * GIVE_UP_NS, shown)
    assert press.sent[0] == 0
    assert {after - before for before, after in pairwise(press.sent)} == {PACE_NS}
    assert GIVE_UP_NS - PACE_NS <= press.sent[-1] < GIVE_UP_NS
    assert not press.stop.active
    (event,) = press.events
    assert event.data["reason"] == "stop_given_up"
    assert "has not confirmed it for 10 s" in event.text


def test_a_shown_stop_ends_the_sending_and_lasts_until_the_reset() -> None:
    press = Press()
    press.run(SETTLE_NS)
    sent = len(press.sent)
    press.run(3 * GIVE_UP_NS, shown=True)
    press.run(3 * GIVE_UP_NS, shown=None)  # the link is lost: the vehicle's last state stays
    assert (len(press.sent), press.stop.active, press.events) == (sent, True, [])
    press.stop.reset()
    assert not press.stop.active
    press.run(GIVE_UP_NS)
    assert len(press.sent) == sent


def test_no_reset_before_it_is_shown() -> None:
    press = Press()
    for shown in (None, False):
        press.run(TICK_NS, shown)
        assert not press.stop.shown
        with pytest.raises(DriverError, match="is not confirmed"):
            press.stop.reset()
        assert press.stop.active
    press.run(TICK_NS, shown=True)
    assert press.stop.shown
    press.stop.reset()
    assert not press.stop.shown
    press.stop.reset()  # a reset without a stop is not an error


def test_motors_that_restart_soon_are_stopped_again_but_not_later() -> None:
    press = Press()
    press.run(nanoseconds(1.0), shown=True)
    assert not press.sent
    press.run(nanoseconds(1.0), shown=False)
    assert len(press.sent) == 10
    press.run(GIVE_UP_NS, shown=True)
    press.run(TICK_NS, shown=False)
    assert len(press.sent) == 10
    assert not press.stop.active
    assert "motors again" in press.events[0].text


def test_another_press_restarts_the_time_limit_and_keeps_the_pace() -> None:
    press = Press()
    for _ in range(30):
        press.run(nanoseconds(0.5))
        press.stop.press(press.now_ns)
    assert press.stop.active
    assert {after - before for before, after in pairwise(press.sent)} == {PACE_NS}
    press.run(GIVE_UP_NS + TICK_NS)
    assert not press.stop.active


def test_repeats_of_a_press_neither_extend_it_nor_delay_its_confirmation() -> None:
    """The library repeats the stop 32 times a second until it shows."""
    press = Press()
    while press.now_ns < BEGUN_NS + nanoseconds(8.0):
        press.run(nanoseconds(0.04))
        press.stop.press(press.now_ns)
    assert press.stop.settled(BEGUN_NS + SETTLE_NS)
    press.run(nanoseconds(2.1))
    assert not press.stop.active
    press.stop.press(press.now_ns)
    assert press.stop.step(None, press.now_ns), "an abandoned stop can be pressed again at once"


def test_reports_around_the_press_may_be_from_before_it() -> None:
    stop = Press().stop
    assert [stop.settled(BEGUN_NS + span_ns) for span_ns in (-1, 0, SETTLE_NS - 1, SETTLE_NS)] == [False] * 3 + [True]
    stop = MotorStop(lambda _: None)
    assert not stop.settled(BEGUN_NS)


@given(st.lists(st.sampled_from([None, False, True]), max_size=80))
def test_a_stop_is_never_sent_late_or_after_it_is_shown(states: list[bool | None]) -> None:
    press = Press()
    known = False
    for shown in states:
        before, known = len(press.sent), known if shown is None else shown
        press.run(nanoseconds(0.2), shown)
        assert len(press.sent) == before or not known
        assert press.stop.active is (not press.events)
    assert all(sent < GIVE_UP_NS for sent in press.sent)


DENIED = OSError(errno.EACCES, "Permission denied")


@pytest.mark.parametrize(
    ("error", "reason", "remedy"),
    [
        (OSError(errno.ENETUNREACH, "Network is unreachable"), "Network is unreachable", "join it"),
        (ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused"), "Connection refused", "join it"),
        (TimeoutError("timed out"), "timed out", "join it"),
        (OSError(), "OSError", "join it"),
        (OSError(errno.EADDRINUSE, "in use"), "in use", "end the other program"),
        (socket.gaierror(-2, "Name or service not known"), "its name is unknown", "correct the name"),
    ],
)
def test_errors_have_a_reason_and_a_remedy(error: OSError, reason: str, remedy: str) -> None:
    trouble = trouble_of(error, "join it")
    assert reason in trouble.reason
    assert remedy in trouble.remedy


def test_a_missing_port_lists_the_available_ones(tmp_path: Path) -> None:
    for name in ("ttyACM0", "ttyUSB1", "null"):
        (tmp_path / name).touch()
    trouble = serial_trouble(OSError(errno.ENOENT, "gone"), str(tmp_path / "none"), "", tmp_path)
    assert trouble.reason == f"there is no {tmp_path}/none"
    assert trouble.remedy.startswith("plug the vehicle in")
    assert trouble.remedy.endswith(f"{tmp_path}/ttyACM0, {tmp_path}/ttyUSB1")
    assert "available ports" not in serial_trouble(OSError(), str(tmp_path / "none"), "", tmp_path / "no").remedy


def test_troubles_with_a_port_of_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    ports = pytest.importorskip("serial.tools.list_ports")
    monkeypatch.setattr(
        ports, "comports", lambda: [SimpleNamespace(device=name) for name in ("COM7", "COM4", "COM5", "COM6", "COM8")]
    )
    monkeypatch.setattr("skyloop.drivers.vehicle_session.sys.platform", "win32")
    missing = serial_trouble(OSError("could not open port 'COM3': FileNotFoundError(2, …)"), "COM3", "look")
    assert missing.reason == "there is no COM3"
    assert missing.remedy.endswith("available ports: COM4, COM5, COM6, COM7")
    denied = OSError("could not open port 'COM4': PermissionError(13, 'Access is denied.', None, 5)")
    assert serial_trouble(denied, "COM4", "look").reason == "another program uses COM4"
    other = serial_trouble(OSError("Cannot configure port"), "COM8", "look")
    assert (other.reason, other.remedy) == ("Cannot configure port", "look")


def test_a_file_is_not_a_port(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "is not a serial port" in serial_trouble(OSError(), str(tmp_path / "file"), "").reason


@only_on("linux", "darwin", reason="ports have no modes and groups")
@pytest.mark.parametrize(
    ("mode", "group", "remedy"),
    [
        (0o660, 20, "join the group dialout: sudo usermod -a -G dialout $USER, then log in again"),
        (0o660, 4711, "join the group 4711"),
        (0o600, 20, "add a udev rule"),
        (0o660, 0, "add a udev rule"),
    ],
)
def test_a_port_that_this_user_may_not_open(
    monkeypatch: pytest.MonkeyPatch, mode: int, group: int, remedy: str
) -> None:
    def look_up(number: int) -> SimpleNamespace:
        if number != 20:
            raise KeyError(number)
        return SimpleNamespace(gr_name="dialout")

    status = SimpleNamespace(st_mode=stat.S_IFCHR | mode, st_gid=group)
    monkeypatch.setattr(Path, "stat", lambda _: status)
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr("grp.getgrgid", look_up)
    trouble = serial_trouble(DENIED, "/dev/ttyACM0", "")
    assert trouble.reason == f"this user may not open /dev/ttyACM0 (mode {mode:04o})"
    assert trouble.remedy.startswith(remedy)


def test_a_folder_that_this_user_may_not_enter(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "stat", refuse)
    assert serial_trouble(DENIED, "/dev/x/tty", "").remedy == "let this user enter /dev/x"


def test_a_port_that_another_program_has_or_that_fails() -> None:
    assert "another program uses" in serial_trouble(OSError(errno.EAGAIN, "locked"), "/dev/null", "").reason
    trouble = serial_trouble(OSError(errno.EIO, "Input/output error"), "/dev/null", "check the cable")
    assert (trouble.reason, trouble.remedy) == ("Input/output error", "check the cable")


# Names --------------------------------------------------------------------------------------------------------------


def test_a_number_is_not_looked_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(socket, "getaddrinfo")
    assert NameLookup().address("192.168.10.1") == "192.168.10.1"


def test_a_slow_name_look_up_blocks_no_one(monkeypatch: pytest.MonkeyPatch) -> None:
    known = threading.Event()

    def look_up(*_: object) -> list[tuple[object, ...]]:
        known.wait(10)
        return [(0, 0, 0, "", ("10.0.0.7", 0))]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    monkeypatch.setattr("skyloop.drivers.vehicle_link.NAME_WAIT_S", 0.001)
    lookup = NameLookup()
    for _ in range(2):
        with pytest.raises(OSError, match="the name drone is still being looked up"):
            lookup.address("drone")
    monkeypatch.setattr("skyloop.drivers.vehicle_link.NAME_WAIT_S", 10.0)
    known.set()
    assert lookup.address("drone") == "10.0.0.7"


@pytest.mark.parametrize("error", [socket.gaierror(-2, "Name or service not known"), UnicodeError("label too long")])
def test_an_unknown_host_name(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def look_up(*_: object) -> None:
        raise error

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    monkeypatch.setattr("skyloop.drivers.vehicle_link.NAME_WAIT_S", 10.0)
    lookup = NameLookup()
    for _ in range(2):  # each attempt looks it up again
        with pytest.raises(OSError, match=r"not known|not a valid host name"):
            lookup.address("drone")

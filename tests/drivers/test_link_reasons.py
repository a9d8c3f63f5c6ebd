"""Reasons for unreachable vehicles, with remedies, and slow name look-ups."""

from __future__ import annotations

import errno
import os
import socket
import stat
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from skyloop.drivers.vehicle_link import NameLookup
from skyloop.drivers.vehicle_session import serial_trouble, trouble_of

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


def test_a_file_is_not_a_port(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "is not a serial port" in serial_trouble(OSError(), str(tmp_path / "file"), "").reason


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

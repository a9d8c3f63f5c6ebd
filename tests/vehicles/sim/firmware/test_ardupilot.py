"""ArduCopter's coupling, with a stand-in for its program."""

from __future__ import annotations

import itertools
import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from skyloop.errors import UsageError
from skyloop.vehicles.sim.firmware.ardupilot import VARIABLE, ArduCopter
from skyloop.vehicles.sim.firmware.program import STOPPED, WAIT_S, FirmwareEventKind
from tests.vehicles.sim.firmware.rig import COMMANDS, Rig, flying, program

pytestmark = pytest.mark.process


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    monkeypatch.setenv(VARIABLE, str(program(tmp_path, "arducopter")))
    with flying(lambda on_event: ArduCopter(on_event, folder=tmp_path / "kept")) as rig:
        yield rig


def states(tmp_path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (tmp_path / "kept" / "states.jsonl").read_text().splitlines()]


@pytest.fixture
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skyloop.vehicles.sim.firmware.program.WAIT_S", 20.0)  # a busy machine is not silence


def test_it_flies_in_step(rig: Rig, patience: None, tmp_path: Path) -> None:
    rig.answered()
    for _ in range(100):
        assert rig.step() == pytest.approx(COMMANDS)  # every time, as the step waits for them
    told = states(tmp_path)
    times = [state["timestamp"] for state in told]
    assert times == pytest.approx([0.001 * n for n in range(1, len(times) + 1)])
    last = told[-1]
    assert last["position"] == [2, 1, -3]  # north, east, down
    assert last["velocity"] == [0.2, 0.1, -0.3]
    assert last["imu"] == {"gyro": [0.1, -0.2, -0.3], "accel_body": [0.5, -0.25, -9.80665]}
    assert last["quaternion"] == pytest.approx([0.5**0.5, 0, 0, 0.5**0.5])  # its nose points east
    assert last["rng_1"] == 1.5
    assert last["battery"] == {"voltage": 11.5, "current": 3}
    assert "FRAME_CLASS 1" in (tmp_path / "kept" / "firmware.log").read_text()
    assert rig.firmware.address.startswith("mavlink://udpin:127.0.0.1:")


def test_silence_is_an_event_and_blocks_only_one_step(rig: Rig, tmp_path: Path) -> None:
    rig.answered()
    os.kill(rig.firmware.program.pid, signal.SIGSTOP)
    begun_s = time.monotonic()
    rig.until(lambda commands: commands is None, "silence")
    assert time.monotonic() - begun_s >= WAIT_S
    rig.until(lambda commands: commands == STOPPED, "the rotors' stop")
    assert "does not answer" in rig.event(FirmwareEventKind.SILENT)
    os.kill(rig.firmware.program.pid, signal.SIGCONT)
    assert "again" in rig.event(FirmwareEventKind.ANSWERS)
    rig.answered()
    assert rig.step() == pytest.approx(COMMANDS)
    times = [float(str(state["timestamp"])) for state in states(tmp_path)]
    assert max(b - a for a, b in itertools.pairwise(times)) == pytest.approx(0.001)  # its clock paused


def test_its_death_stops_the_rotors_and_it_is_restarted(rig: Rig) -> None:
    rig.answered()
    os.kill(rig.firmware.program.pid, signal.SIGKILL)
    rig.until(lambda commands: commands == STOPPED, "the rotors' stop")
    assert "was killed by SIGKILL" in rig.event(FirmwareEventKind.DIED)
    rig.event(FirmwareEventKind.ANSWERS)
    assert rig.firmware.program.starts == 2


def test_other_packets_are_ignored(rig: Rig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("STANDIN", "garbage")
    with flying(lambda on_event: ArduCopter(on_event)) as second:
        second.answered()
        for _ in range(20):
            assert second.step() == pytest.approx(COMMANDS)
        rig.answered()  # two at once, each with its own ports
        assert second.firmware.address != rig.firmware.address


def test_the_event_of_its_death_has_its_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(program(tmp_path, "arducopter")))
    monkeypatch.setenv("STANDIN", "dies")
    with flying(lambda on_event: ArduCopter(on_event)) as rig:
        assert "something went wrong in it" in rig.event(FirmwareEventKind.DIED)


def test_without_a_program_the_error_names_its_source(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UsageError, match=r"set SKYLOOP_ARDUCOPTER to its path\. How to get it: https://ardupilot\.org"):
        ArduCopter(print).start()

"""A stand-in for firmware, flown with readings from the tests."""

from __future__ import annotations

import queue
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import msgspec

import skyloop
from skyloop.sim.instruments import GpsFix, Readings
from skyloop.vehicles.sim.firmware.program import CoupledFirmware, FirmwareEvent, FirmwareEventKind

SOURCE = Path(skyloop.__file__).parents[1]
STANDINS = Path(__file__).parent / "standins"
STEP_S = 0.001
LONG_S = 60.0
#: Commands of all stand-ins, in the simulation's order.
COMMANDS = (0.3, 0.1, 0.2, 0.4)
AT_REST = Readings(
    time_s=0.0,
    gyro_rad_s=(0.1, 0.2, 0.3),
    acceleration_m_s2=(0.5, 0.25, 9.80665),
    pressure_pa=95000.0,
    temperature_c=20.0,
    magnetic_gauss=(0.1, 0.2, -0.4),
    gps=None,
    range_m=1.5,
    flow=None,
    battery_v=11.5,
    battery_a=3.0,
    position_m=(1.0, 2.0, 3.0),
    velocity_m_s=(0.1, 0.2, 0.3),
    quaternion=(1.0, 0.0, 0.0, 0.0),
    rates_rad_s=(0.1, 0.2, 0.3),
)
FIX = GpsFix(0.0, 47.4, 8.5, 490.0, (1.0, 2.0, 3.0), 0.5, 0.8, 14)


def program(folder: Path, standin: str) -> Path:
    """Return a stand-in as an executable program."""
    path = folder / "bin" / standin
    path.parent.mkdir(parents=True, exist_ok=True)
    text = (STANDINS / f"{standin}.py").read_text(encoding="utf-8")
    where = f"import sys; sys.path.insert(0, {str(SOURCE)!r})"  # for any working folder
    path.write_text(f"#!{sys.executable}\n{where}\n{text}", encoding="utf-8")
    path.chmod(0o755)
    return path


class Rig:
    """Steps a firmware and collects its events."""

    def __init__(self) -> None:
        self.firmware: CoupledFirmware  # set by the test
        self.events: queue.Queue[FirmwareEvent] = queue.Queue()
        self._steps = count()

    def step(self, **changes: Any) -> Sequence[float] | None:
        """Do one step; return the commands."""
        readings = msgspec.structs.replace(AT_REST, time_s=next(self._steps) * STEP_S, **changes)
        return self.firmware.exchange(readings)

    def until(self, good: Callable[[Sequence[float] | None], bool], what: str) -> Sequence[float] | None:
        """Step until a step's commands are good."""
        end_s = time.monotonic() + LONG_S
        while time.monotonic() < end_s:
            commands = self.step()
            if good(commands):
                return commands
            time.sleep(STEP_S)
        raise AssertionError(f"{what} did not happen; events: {list(self.events.queue)}")

    def answered(self) -> None:
        """Step until the firmware sends commands."""
        self.until(lambda commands: commands is not None and any(commands), "an answer")

    def event(self, kind: FirmwareEventKind) -> str:
        """Wait for an event, stepping meanwhile; return its text."""
        end_s = time.monotonic() + LONG_S
        seen = []
        while time.monotonic() < end_s:
            try:
                event = self.events.get(timeout=STEP_S)
            except queue.Empty:
                self.step()
                continue
            seen.append(event)
            if event.kind is kind:
                return event.text
        raise AssertionError(f"no {kind} in {seen}")


@contextmanager
def flying(make: Callable[[Callable[[FirmwareEvent], None]], CoupledFirmware]) -> Iterator[Rig]:
    """Start a firmware, and end it afterwards."""
    rig = Rig()
    rig.firmware = make(rig.events.put)
    rig.firmware.program._restart_s = 0.05  # no waiting in tests
    rig.firmware.start()
    try:
        yield rig
    finally:
        rig.firmware.close()

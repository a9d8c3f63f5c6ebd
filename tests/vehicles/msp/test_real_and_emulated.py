"""The driver's assumptions, checked against real and emulated Betaflight by the same tests."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import pytest

from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.errors import DriverError
from skyloop.messages import Attitude, FlightState, LinkState, Takeoff
from skyloop.vehicles.msp.driver import MspDriver
from skyloop.vehicles.msp.emulator import BetaflightFirmware, bit
from skyloop.vehicles.msp.wire.firmwares import flag_names
from skyloop.vehicles.msp.wire.frames import MspFrame, Parser, encode
from skyloop.vehicles.msp.wire.messages import Function, MspStatus, channels, pack_channels
from tests.support.betaflight import world
from tests.vehicles.msp.sitl import MSP_PORT, Sitl
from tests.vehicles.sim.firmware.real_betaflight import real_betaflight

PATIENCE_S: Final = 20.0


@dataclass
class Vehicle:
    """Real or emulated Betaflight. ``tilt`` puts it on its side, or upright again."""

    host: str
    port: int
    tilt: Callable[[bool], None]

    @property
    def address(self) -> str:
        return f"msp://tcp:{self.host}:{self.port}"


@pytest.fixture(params=["emulated", pytest.param("real", marks=[pytest.mark.slow, pytest.mark.process])])
def vehicle(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Vehicle]:
    if request.param == "emulated":
        with BetaflightFirmware(world(), port=0) as firmware:
            board = firmware.board

            def set_flag(on: bool) -> None:
                board.settings = replace(board.settings, flags=bit("ANGLE") if on else 0)

            yield Vehicle("127.0.0.1", firmware.port, set_flag)
        return
    with real_betaflight(), Sitl(tmp_path) as sitl:

        def roll(on: bool) -> None:
            sitl.roll_rad = math.radians(60.0) if on else 0.0

        yield Vehicle("127.0.0.1", MSP_PORT, roll)


class Line:
    """A separate client, silent on request."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._socket = socket.create_connection((vehicle.host, vehicle.port), 5)
        self._socket.settimeout(5)
        self._parser = Parser()
        self._came: list[MspFrame] = []

    def ask(self, function: int, payload: bytes = b"") -> bytes:
        self._socket.sendall(encode(MspFrame(function, payload)))
        while True:
            while not self._came:
                self._came += self._parser.feed(self._socket.recv(4096))
            frame = self._came.pop(0)
            if frame.function == function:
                return frame.payload

    def sticks(self, throttle: int, arm: int) -> None:
        self.ask(Function.SET_RAW_RC, pack_channels([1500, 1500, throttle, 1500, arm, 1000, 1000, 1000]))

    def state(self) -> tuple[bool, set[str], int]:
        """Return whether it is armed, what prevents arming, and the throttle in force [µs]."""
        status = MspStatus.of_betaflight(self.ask(Function.STATUS_EX))
        names = flag_names("BTFL", status.flags or 0, status.count)
        return bool(status.modes & 1), set(names), channels(self.ask(Function.RC))[3]

    def send_until(self, arm: int, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end, self.state()
            self.sticks(1000, arm)
            time.sleep(0.01)

    def close(self) -> None:
        self._socket.close()


#: Betaflight 4.6.0 SITL's answers to the requests that take no arguments and only read.
ANSWERED: Final = (
    *(1, 2, 3, 4, 5, 32, 34, 36, 38, 40, 42, 44, 50, 52, 54, 56, 58, 64, 70, 75, 79, 80, 82, 90, 92, 94, 96),
    *(101, 102, 104, 105, 108, 109, 110, 111, 112, 116, 117, 119, 124, 125, 126, 128, 129, 130, 131, 133, 139, 140),
    *(142, 143, 144, 145, 150, 160, 187, 238, 240),
)


def test_a_configurators_requests_are_answered(vehicle: Vehicle) -> None:
    """The emulator refused 40 of these requests."""
    line = Line(vehicle)
    try:
        lengths = {function: len(line.ask(function)) for function in ANSWERED}
    finally:
        line.close()
    assert [function for function, length in lengths.items() if not length] == []
    assert (lengths[70], lengths[112], lengths[92]) == (13, 15, 49)


def test_the_drivers_assumptions(vehicle: Vehicle) -> None:
    driver, sink = MspDriver(parse_uri(vehicle.address)), RecordingSink()
    driver.open(sink)
    try:
        _arms_and_disarms(driver, sink, vehicle)
    finally:
        driver.close()
    line = Line(vehicle)
    try:
        _silence(line)
    finally:
        line.close()


def _arms_and_disarms(driver: MspDriver, sink: RecordingSink, vehicle: Vehicle) -> None:
    assert sink.wait(lambda: sink.link_state is LinkState.UP, PATIENCE_S), sink.links
    assert any(event.text.startswith("Betaflight 4.6.0 on ") for event in sink.events)

    def flags() -> str:
        return str(sink.newest and sink.newest.native and sink.newest.native["arming.flags"])

    def phase() -> str:
        return str(sink.newest and sink.newest.native and sink.newest.native["phase"])

    assert sink.wait(lambda: flags() == "", PATIENCE_S), flags()
    assert not [each for each in driver.checkup() if each.severe and not each.good]

    vehicle.tilt(True)
    assert sink.wait(lambda: "ANGLE" in flags(), PATIENCE_S), flags()
    with pytest.raises(DriverError, match="refuses to arm: ANGLE"):
        driver.apply(Attitude(climb=0.3))
    vehicle.tilt(False)
    assert sink.wait(lambda: flags() == "", PATIENCE_S), flags()

    driver.check(Takeoff())
    driver.apply(Attitude(climb=0.3))
    assert sink.wait(lambda: phase() == "spooling", PATIENCE_S), sink.events
    driver.apply(Attitude())
    assert sink.wait(lambda: phase() == "standing" and "armed" in native(sink) and not native(sink)["armed"], 10.0)
    assert sink.newest is not None
    assert sink.newest.state is FlightState.LANDED
    assert abs(sink.newest.roll_rad or 0.0) < 0.05


def native(sink: RecordingSink) -> dict[str, object]:
    return dict((sink.newest and sink.newest.native) or {})


def _silence(line: Line) -> None:
    """Check ``docs/msp.md`` on the time after the last stick: hold, throttle off, disarm."""
    line.send_until(1000, lambda: not line.state()[1])
    line.send_until(2000, lambda: line.state()[0])
    line.sticks(1090, 2000)
    begun = time.monotonic()
    seen: list[tuple[float, bool, set[str], int]] = []
    while not seen or seen[-1][1]:
        seen.append((time.monotonic() - begun, *line.state()))
        assert seen[-1][0] < PATIENCE_S, "it never disarms"
        time.sleep(0.01)
    # The order of events: on a busy machine all are later, in the same order.
    lost_s = next(at_s for at_s, _, flags, _ in seen if "RXLOSS" in flags)
    low_s = next(at_s for at_s, _, _, throttle in seen if throttle < 1000)
    assert 0.1 < lost_s <= low_s < seen[-1][0]
    assert low_s > 0.2, "the last sticks are held at first"
    assert all(throttle == 1090 for at_s, _, _, throttle in seen if 0.05 < at_s < low_s)
    assert seen[-1][0] > 1.2, "armed until the failsafe starts"
    assert "FAILSAFE" in line.state()[1]
    line.send_until(1000, lambda: not line.state()[1])

"""An emulated ArduCopter that journals what it does: ``python -m tests.promises.chaos.autopilot NAME FOLDER PROXY``.

It outlives its proxy. ``PROXY`` is the proxy's UDP port, or a path at which a serial port is created for it. Lines on
standard input cause faults of the vehicle and its link (:meth:`JournalledAutopilot.order`).
"""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from skyloop.messages import FlightState
from skyloop.sim.host import Report, SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors
from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m
from tests.promises.chaos.journal import Journal
from tests.promises.chaos.radio import FORCE, Radio
from tests.promises.chaos.vehicle import NUMBER_RAD_S

STATION: Final = 250  #: system id of another ground station
LAND: Final = 9
RATE_HZ: Final = 50.0
CHARGE: Final = 0.9
BATTERY_S: Final = 0.5
BATTERIES: Final = ((12.2, 80), (9.9, 5))  #: volts and percent
_MODES: Final = {LAND: "land", 4: "guided"}


class JournalledAutopilot:
    """The autopilot, and the other ground station that commands it."""

    def __init__(self, name: str, folder: Path, proxy: int | Path) -> None:
        self._second_battery = False
        self._journal = Journal(folder / f"{name}.vehicle")
        options = SimOptions(world="empty", seed=4, wind=0.0)
        self._world = SimHost(with_multirotors(options, rate_hz=RATE_HZ))
        ports = Ports.free(Kind.ARDUCOPTER)
        self._firmware = MavlinkFirmware(self._world, kind=Kind.ARDUCOPTER, ports=ports, boot_s=0.5)
        self._radio = Radio(ports.udp, ports.remote, proxy, self._journal.write)
        self._firmware.start()
        self._autopilot = self._firmware.autopilot
        for port in self._autopilot.ports:
            port.send = partial(self._on_send, port.send)  # type: ignore[method-assign]
        self._hear, self._tick = self._autopilot.on_message, self._autopilot.tick
        self._autopilot.on_message = self._on_message  # type: ignore[method-assign]
        self._autopilot.tick = self._on_tick  # type: ignore[method-assign]
        self._codec = MavlinkCodec(STATION, 190)
        self._orders: deque[list[str]] = deque()
        self._state, self._armed = "", False
        self._lands_at_m = math.inf
        self._tips_after_s: float | None = None
        self._tips_s = math.inf
        self._battery_s = 0.0

    def order(self, line: str) -> None:
        """``land``, ``land_at METRES`` (at the next climb), ``tip SECONDS`` (after it is armed next), ``battery 1/0``,
        ``late SECONDS``, ``port``, ``lose_stops NUMBER``, ``full SECONDS``. Any thread.
        """
        what, _, argument = line.strip().partition(" ")
        if what == "late":
            self._radio.delay(float(argument))
        elif what == "port":
            self._radio.moving = True
        elif what == "lose_stops":
            self._radio.lost_stops = int(argument)
        elif what == "full":
            self._radio.full_until_s = time.monotonic() + float(argument)
        else:
            self._orders.append([what, argument])

    # On the emulator's thread ----------------------------------------------------------------------------------------

    def _on_message(self, port: object, message: Message, now_ns: int) -> None:
        autopilot = self._autopilot
        taken, mode = autopilot.set_points, autopilot.mode
        self._hear(port, message, now_ns)  # type: ignore[arg-type]
        kind = message.get_type()
        if kind == "SET_POSITION_TARGET_LOCAL_NED":
            if autopilot.set_points > taken and autopilot.flight.airborne:
                self._journal_set_point(message)
        elif kind == "COMMAND_LONG" and message.command == m.MAV_CMD_DO_SET_MODE and autopilot.mode != mode:
            what = _MODES.get(round(message.param2))
            if what is not None and not autopilot.flight.standing:
                self._journal.write(what)

    def _on_send(self, send: Callable[[Message], None], message: Message) -> None:
        if self._second_battery and message.get_type() == "SYS_STATUS":
            message.battery_remaining = -1  # the receiver has to find out which of the two it is
        send(message)

    def _journal_set_point(self, message: Message) -> None:
        left_ns = self._radio.left_ns.get(message.get_seq())
        number = round(-message.yaw_rate / NUMBER_RAD_S)
        fastest = max(abs(message.vx), abs(message.vy), abs(message.vz))
        if number:
            self._journal.write("velocity", number, left_ns)
        if fastest > 1e-3:
            self._journal.write("moved", round(fastest * 1000))

    def _on_tick(self, report: Report) -> None:
        autopilot = self._autopilot
        self._world.simulation.set_charge(0, CHARGE)  # it flies for hours
        self._tick(report)
        if autopilot.armed != self._armed:
            self._armed = autopilot.armed
            self._journal.write("armed" if self._armed else "disarmed")
            if self._armed and self._tips_after_s is not None:
                self._tips_s, self._tips_after_s = autopilot.time_s + self._tips_after_s, None
        state = self._named_state()
        if state != self._state:
            self._state = state
            self._journal.write(f"state:{state}")
        while self._orders:
            self._obey(*self._orders.popleft())
        self._befall()

    def _named_state(self) -> str:
        autopilot = self._autopilot
        if autopilot.flight.state is FlightState.EMERGENCY:
            return "emergency"
        if autopilot.flight.standing:
            return "landed"
        if autopilot.mode in ("LAND", "RTL"):
            return "landing"
        return "flying" if autopilot.flight.airborne else "taking_off"

    def _obey(self, what: str, argument: str) -> None:
        if what == "land":
            self._station_lands()
        elif what == "land_at":
            self._lands_at_m = float(argument)
        elif what == "tip":
            self._tips_after_s = float(argument)
        elif what == "battery":
            self._second_battery = argument == "1"

    def _befall(self) -> None:
        autopilot = self._autopilot
        if self._state in ("taking_off", "flying") and autopilot.flight.place[2] > self._lands_at_m:
            self._lands_at_m = math.inf
            self._station_lands()
        if autopilot.time_s >= self._tips_s:
            self._tips_s = math.inf
            self._journal.write("other:tip")
            self._station(m.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, FORCE)
        if self._second_battery and autopilot.time_s - self._battery_s > BATTERY_S:
            self._battery_s = autopilot.time_s
            for number, (volts, percent) in enumerate(BATTERIES):
                cells = [round(volts * 1000), *[0xFFFF] * 9]
                status = m.MAVLink_battery_status_message(number, 0, 1, 32767, cells, 500, -1, -1, percent)
                for port in autopilot.ports:
                    port.send(status)

    def _station_lands(self) -> None:
        self._journal.write("other:land")
        self._station(m.MAV_CMD_DO_SET_MODE, 1.0, LAND)

    def _station(self, command: int, *arguments: float) -> None:
        padded = (*arguments, *[0.0] * (7 - len(arguments)))
        frame = self._codec.encode(m.MAVLink_command_long_message(1, 1, command, 0, *padded))
        (message,) = MavlinkCodec(1, 1).decode(frame, whole=True)
        self._hear(self._autopilot.ports[0], message, 0)


def main() -> None:
    """Fly until killed."""
    name, folder, proxy = sys.argv[1], Path(sys.argv[2]), sys.argv[3]
    autopilot = JournalledAutopilot(name, folder, int(proxy) if proxy.isdecimal() else Path(proxy))
    print("ready", flush=True)
    for line in sys.stdin:
        autopilot.order(line)


if __name__ == "__main__":
    main()

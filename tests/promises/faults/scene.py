"""An autopilot, another ground station, and a proxy that may be started and killed."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from skyloop.client import Drone
from skyloop.client.drone import open_drone
from skyloop.drivers.registry import make_driver
from skyloop.proxy.core.failsafe import FailsafeSettings
from skyloop.proxy.proxy import Proxy
from skyloop.proxy.records import FlightRecord
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.transport.memory import MemoryServer
from skyloop.transport.testing import wait_until
from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors
from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m

WAIT_S = 20.0
STATION = 250  #: the other station's system id
STEERING = (m.MAV_CMD_DO_SET_MODE, m.MAV_CMD_COMPONENT_ARM_DISARM, m.MAV_CMD_NAV_TAKEOFF)
MODES: dict[Kind, dict[str, tuple[int, ...]]] = {
    Kind.ARDUCOPTER: {"GUIDED": (4,), "LAND": (9,), "RTL": (6,), "LOITER": (5,)},
    Kind.PX4: {"GUIDED": (4, 3), "LAND": (4, 6), "RTL": (4, 5), "LOITER": (4, 3)},
}
KINDS = pytest.mark.parametrize("kind", list(Kind))


class Scene:
    """An autopilot, another ground station, and a proxy that may be started and killed."""

    def __init__(self, kind: Kind, note: Path, boot_s: float = 0.5) -> None:
        world = SimHost(with_multirotors(SimOptions(world="empty", seed=4, wind=0.0, speed=3.0)))
        self.kind = kind
        self.firmware = MavlinkFirmware(world, kind=kind, ports=Ports.free(kind), boot_s=boot_s)
        self.note = note
        self.ours: list[int] = []  #: numbers of the commands with which the proxy steered
        self.set_points = 0
        self._codec = MavlinkCodec(STATION, 190)
        self._proxies: list[Proxy] = []

    def __enter__(self) -> Scene:
        self.firmware.start()
        autopilot = self.firmware.autopilot
        hear = autopilot.on_message

        def on_message(port: object, message: Message, now_ns: int) -> None:
            if message.get_srcSystem() != STATION:
                if message.get_type() == "COMMAND_LONG" and message.command in STEERING:
                    self.ours.append(message.command)
                self.set_points += message.get_type().startswith("SET_")
            hear(port, message, now_ns)  # type: ignore[arg-type]

        autopilot.on_message = on_message  # type: ignore[method-assign]
        return self

    def __exit__(self, *_: object) -> None:
        for proxy in self._proxies:
            proxy.end()
        self.firmware.stop()

    @property
    def address(self) -> str:
        return f"{self.firmware.address}?parameters=no&takeoff_altitude=8&altitude=20&climb=3"

    @property
    def mode(self) -> str:
        return self.firmware.autopilot.mode

    @property
    def armed(self) -> bool:
        return self.firmware.autopilot.armed

    @property
    def height(self) -> float:
        return self.firmware.autopilot.flight.place[2]

    def station(self, command: int, *arguments: float) -> None:
        """Send a command as the other ground station."""
        padded = (*arguments, *[0.0] * (7 - len(arguments)))
        self.station_says(m.MAVLink_command_long_message(1, 1, command, 0, *padded))

    def station_says(self, said: Message) -> None:
        frame = self._codec.encode(said)
        (message,) = MavlinkCodec(1, 1).decode(frame, whole=True)
        running = self.firmware._started
        running._loop.post(partial(running._on_message, running.autopilot.ports[0], message))

    def station_mode(self, mode: str) -> None:
        self.station(m.MAV_CMD_DO_SET_MODE, 1.0, *MODES[self.kind][mode])

    def station_flies(self, height_m: float = 6.0) -> None:
        """The other station arms and takes off."""
        wait_until(lambda: self.firmware.autopilot.ready, "it may be armed")
        self.station_mode("GUIDED")
        self.station(m.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
        altitude = height_m if self.kind is Kind.ARDUCOPTER else 488.0 + height_m
        nan = float("nan") if self.kind is Kind.PX4 else 0.0
        self.station(m.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, nan, nan, nan, altitude)
        wait_until(lambda: self.height > 0.8 * height_m, "it is up")

    def proxy(self) -> Proxy:
        """A proxy with short failsafe times, so that a test need not wait long for its ladder."""
        address = self.address
        self.server = MemoryServer("alpha")
        proxy = Proxy(make_driver(address), self.server, name="alpha")
        proxy.keep_record(FlightRecord(self.note, address))
        self._proxies.append(proxy)
        proxy.start()
        proxy.handler.ladder.settings = FailsafeSettings(hover_after_s=0.2, land_after_s=0.6)
        return proxy

    def die(self, proxy: Proxy) -> None:
        """Die without sending anything more to the vehicle."""
        proxy.handler.leave_hovering = lambda now_ns: None  # type: ignore[method-assign]
        proxy.end()

    def drone(self) -> Drone:
        return open_drone(self.server.dial, app="me", on_exit="hover")

    def watched(self, proxy: Proxy, samples: int = 60) -> None:
        """Wait until the proxy has this many more samples: its ladder had time for several steps."""
        after = proxy._counts["feedback.published"] + samples
        wait_until(lambda: proxy._counts["feedback.published"] >= after, "time passed")


def taken_off(scene: Scene) -> Drone:
    drone = scene.drone()
    drone.wait(lambda f: bool((f.native or {}).get("mavlink.ready")), timeout_s=WAIT_S)
    drone.takeoff(timeout_s=WAIT_S)
    return drone

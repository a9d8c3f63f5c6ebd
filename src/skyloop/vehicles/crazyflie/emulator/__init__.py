"""An emulated Crazyflie 2.1 on the network that flies a simulated vehicle and accepts any program with CRTP over UDP.

To use it in a test::

    from skyloop.vehicles.crazyflie.emulator import CrazyflieFirmware, with_crazyflies
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions

    host = SimHost(with_crazyflies(SimOptions(world="room", seed=1)))
    with CrazyflieFirmware(host, port=0) as firmware:
        firmware.address  # for a driver: crazyflie://udp:127.0.0.1:…; for cflib: udp://127.0.0.1:…
        host.simulation.truth(0).position_m  # the vehicle's true position

It has a Flow deck and a Multi-ranger deck, and with ``deck=DeckSettings()`` an AI-deck that sends images. Its estimate
begins at (0, 0, 0) with yaw 0 where it stands when it is switched on. ``checksum=True`` speaks ESP-Drone's dialect, in
which each packet ends with a checksum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

from skyloop.clock import monotonic_ns
from skyloop.errors import DecodeError, UsageError
from skyloop.faults import Faults
from skyloop.messages.geometry import turned
from skyloop.sim.host import Report, SimHost
from skyloop.sim.options import SimOptions
from skyloop.sim.parameters import GRAVITY_M_S2
from skyloop.sim.vehicles import CRAZYFLIE
from skyloop.vehicles.crazyflie.emulator.deck import DeckSettings, EmulatedDeck
from skyloop.vehicles.crazyflie.emulator.logic import PROTOCOL, CrazyflieLogic
from skyloop.vehicles.crazyflie.wire.crtp import (
    NEWEST_PROTOCOL,
    OLDEST_PROTOCOL,
    UDP_PORT,
    CrtpPacket,
    with_checksum,
    without_checksum,
)
from skyloop.vehicles.emulation.emulator import (
    NO_FAULTS,
    Address,
    DatagramPort,
    Emulator,
    Loop,
    RunningEmulator,
    checked_delay,
)
from skyloop.vehicles.emulation.flight import SimulatedVehicle

__all__ = ["CrazyflieFirmware", "DeckSettings", "Faults", "with_crazyflies"]

REPORTS_HZ: Final = 100.0  #: rate at which the simulation reports to the firmware
_RANGE_M: Final = 4.0  # range of the Multi-ranger's sensors
#: Directions of the range finders: forward, left, up.
_BEAMS: Final = {
    "front": (1.0, 0.0, 0.0),
    "back": (-1.0, 0.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "zrange": (0.0, 0.0, -1.0),
}


def with_crazyflies(options: SimOptions | None = None) -> SimOptions:
    """Return the options for a world of Crazyflies. The firmware ignores the cameras in the options."""
    return replace(options or SimOptions(), parameters=CRAZYFLIE, rate_hz=REPORTS_HZ, cameras=())


@dataclass(frozen=True, slots=True)
class CrazyflieSettings:
    """The arguments passed to :class:`CrazyflieFirmware`."""

    bind: str
    port: int
    protocol: int
    auto_arm: bool
    checksum: bool
    faults: Faults
    delay_s: float
    deck: DeckSettings | None


class RunningFirmware(RunningEmulator):
    """A Crazyflie that is switched on. Use it only on the loop's thread."""

    def __init__(
        self, host: SimHost, drone: int, settings: CrazyflieSettings, stored: dict[int, float], loop: Loop | None
    ) -> None:
        super().__init__(host, drone, loop or "skyloop-crazyflie")
        self._settings = settings
        self._client: Address | None = None
        vehicle = host.simulation.parameters[drone]
        full_n = (
            vehicle.rotors.full_thrust_n if vehicle.rotors else vehicle.most_thrust * vehicle.mass_kg * GRAVITY_M_S2
        )
        self.logic = CrazyflieLogic(
            SimulatedVehicle(host.simulation, drone),
            vehicle.mass_kg * GRAVITY_M_S2 / full_n,
            self._ranges,
            stored,
            protocol=settings.protocol,
            auto_arm=settings.auto_arm,
        )
        self.deck: EmulatedDeck | None = None
        try:
            self._udp = DatagramPort(
                self._loop,
                (settings.bind, settings.port),
                self._on_datagram,
                name="CRTP",
                faults=settings.faults,
                delay_s=settings.delay_s,
            )
            self._open.append(self._udp)
            if settings.deck is not None:
                self.deck = EmulatedDeck(self._loop, settings.deck)
                self._open.append(self.deck)
                self._video = self.deck.video
                self._video.start()
            simulation = host.simulation
            self._tick(Report(simulation.feedback(drone), simulation.truth(drone), (), monotonic_ns()))
            if self._own_loop:
                self._loop.start()
            host.attach(drone, self, self, [] if self.deck is None else [self.deck.camera])
        except BaseException:
            self.stop()
            raise

    @property
    def port(self) -> int:
        return self._udp.port

    def _ranges(self) -> dict[str, float]:
        truth = self._host.simulation.truth(self._drone)
        found = {}
        for name, (forward, left, up) in _BEAMS.items():
            east, north = turned(forward, left, truth.yaw_rad)
            distance = self._host.simulation.distance_along(truth.position_m, (east, north, up))
            found[name] = distance if distance <= _RANGE_M else math.inf
        return found

    def _on_datagram(self, datagram: bytes, sender: Address) -> None:
        try:
            if self._settings.checksum:
                datagram = without_checksum(datagram)
            packet = CrtpPacket.decode(datagram)
        except DecodeError:
            return
        if packet.is_null:  # a greeting, or a search for vehicles: the client stays
            self._send(datagram, sender)
            return
        self._client = sender
        for answer in self.logic.receive(packet):
            self._send(answer.encode(), sender)

    def _send(self, data: bytes, to: Address) -> None:
        self._udp.send(with_checksum(data) if self._settings.checksum else data, to)

    def _tick(self, report: Report) -> None:
        for packet in self.logic.update(report, talks=self._client is not None):
            if self._client is not None:
                self._send(packet.encode(), self._client)
        if self.deck is not None:
            self.deck.hear(self.logic.deck_state, report.captured_ns)

    def _crashed(self, text: str) -> None:
        if not text.startswith("stopped"):  # by our own command
            self.logic.flight.crash()


class CrazyflieFirmware(Emulator[RunningFirmware]):
    """The firmware of one Crazyflie in a host's world. Several may share a host, each with its own drone and port.

    Create the host with options from :func:`with_crazyflies`. Persistent parameters survive a restart of the firmware.

    Args:
        host: The simulated world.
        drone: Number of the drone in that world.
        bind: The local address to listen on.
        port: The UDP port; 0 for any free one.
        protocol: Version of CRTP, 7 to 12.
        auto_arm: Whether it arms itself, as vehicles with brushed motors do.
        checksum: Whether each packet ends with a checksum, as in ESP-Drone and LiteWing.
        faults: Faults injected into all datagrams in both directions.
        delay_s: Delay added to all datagrams in each direction.
        deck: What its AI-deck sends, and where; None for no deck.
        loop: Thread shared by a fleet; None for a separate thread.

    Raises:
        UsageError: An argument is invalid.
    """

    def __init__(
        self,
        host: SimHost,
        drone: int = 0,
        *,
        bind: str = "127.0.0.1",
        port: int = UDP_PORT,
        protocol: int = PROTOCOL,
        auto_arm: bool = True,
        checksum: bool = False,
        faults: Faults = NO_FAULTS,
        delay_s: float = 0.0,
        deck: DeckSettings | None = None,
        loop: Loop | None = None,
    ) -> None:
        if not OLDEST_PROTOCOL <= protocol <= NEWEST_PROTOCOL:
            raise UsageError(f"protocol must be from {OLDEST_PROTOCOL} to {NEWEST_PROTOCOL}, got {protocol!r}")
        super().__init__(host, drone)
        self.settings = CrazyflieSettings(
            bind, port, protocol, auto_arm, checksum, faults, checked_delay(delay_s), deck
        )
        self._stored: dict[int, float] = {}
        self._loop = loop

    def _switched_on(self) -> RunningFirmware:
        running = RunningFirmware(self.host, self.drone, self.settings, self._stored, self._loop)
        self.settings = replace(self.settings, port=running.port)  # keeps the port the same after a restart
        if running.deck is not None and self.settings.deck is not None:
            self.settings = replace(self.settings, deck=replace(self.settings.deck, port=running.deck.port))
        return running

    @property
    def port(self) -> int:
        """The actual port; if 0 was given, the system chose it."""
        return self._started.port

    @property
    def deck(self) -> EmulatedDeck | None:
        """The running AI-deck, if any."""
        return self._started.deck

    @property
    def logic(self) -> CrazyflieLogic:
        """The logic of the running firmware, for tests. Use it only on the loop's thread."""
        return self._started.logic

    @property
    def address(self) -> str:
        """Address for a driver on this machine."""
        deck = self.settings.deck
        kind = "esp" if self.settings.checksum else "udp"
        more = "" if deck is None else f"?deck={deck.bind}:{deck.port}"
        return f"crazyflie://{kind}:{self.settings.bind}:{self.port}{more}"

    @property
    def description(self) -> str:
        """A readable one-line summary: kind, number and address."""
        kind = "esp-drone" if self.settings.checksum else "crazyflie"
        images = "" if self.deck is None else f", images tcp {self.deck.port}"
        return f"{kind} drone {self.drone} on {self.settings.bind}: CRTP udp {self.port}{images}"

"""An emulated racing drone with Betaflight, flying a simulated vehicle, for any program that uses MSP over TCP.

To use it in a test::

    from skyloop.vehicles.msp.emulator import BetaflightFirmware, with_racers
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions

    host = SimHost(with_racers(SimOptions(world="room", seed=1)))
    with BetaflightFirmware(host, port=0) as firmware:
        firmware.address  # for a driver: msp://tcp:127.0.0.1:…
        host.simulation.truth(0).position_m  # the vehicle's true position

Its barometer and GPS are the simulated vehicle's. It answers the driver's requests, and is set up as described in
``docs/msp.md``.
"""

from __future__ import annotations

from typing import Final

from skyloop.clock import monotonic_ns
from skyloop.sim.host import Report, SimHost
from skyloop.sim.reports import Occurrence, OccurrenceKind
from skyloop.vehicles.emulation.datagrams import ByteServer, Loop
from skyloop.vehicles.emulation.emulator import Emulator, RunningEmulator
from skyloop.vehicles.emulation.flight import SimulatedVehicle
from skyloop.vehicles.msp.emulator.board import PORT, Board, BoardSettings, with_racers
from skyloop.vehicles.msp.wire.frames import Parser, encode

__all__ = ["BetaflightFirmware", "BoardSettings", "with_racers"]


USUAL: Final = BoardSettings()


class RunningFirmware(RunningEmulator):
    """A flight controller that is switched on. Belongs to the loop's thread."""

    def __init__(
        self, host: SimHost, drone: int, bind: str, port: int, settings: BoardSettings, loop: Loop | None
    ) -> None:
        super().__init__(host, drone, loop or "skyloop-betaflight")
        self.board = Board(SimulatedVehicle(host.simulation, drone), settings, monotonic_ns())
        self._parser = Parser()
        simulation = host.simulation
        first = Report(simulation.feedback(drone), simulation.truth(drone), (), monotonic_ns())
        self.board.tick(first, monotonic_ns())
        try:
            self._server = ByteServer(self._loop, (bind, port), self._receive, self._parser.reset, name="MSP")
            self._open.append(self._server)
            if self._own_loop:
                self._loop.start()
            host.attach(drone, self, self, [])
        except BaseException:
            self.stop()
            raise

    @property
    def port(self) -> int:
        """The actual port, which was chosen if 0 was requested."""
        return self._server.port

    def _receive(self, data: bytes) -> None:
        now_ns = monotonic_ns()
        for frame in self._parser.feed(data):
            reply = self.board.answer(frame, now_ns)
            if reply is not None:
                self._server.send(encode(reply))

    def _tick(self, report: Report) -> None:
        self.board.tick(report, monotonic_ns())

    # Called by the host, on its threads --------------------------------------------------------------------------

    def happened(self, occurrence: Occurrence) -> None:
        """Disarm after a crash."""
        super().happened(occurrence)
        if occurrence.kind is OccurrenceKind.EMERGENCY:
            self._loop.post(self.board.crashed)


class BetaflightFirmware(Emulator[RunningFirmware]):
    """The flight controller of one drone in a host's world. Several may share a host, each with its own drone and port.

    Create the host with options from :func:`with_racers`.

    Args:
        host: The simulated world.
        drone: Number of the drone in that world.
        bind: The local address to listen on.
        port: The TCP port; 0 for any free one.
        settings: The flight controller's settings.
        loop: Thread shared by a fleet; None for a separate thread.
    """

    def __init__(
        self,
        host: SimHost,
        drone: int = 0,
        *,
        bind: str = "127.0.0.1",
        port: int = PORT,
        settings: BoardSettings = USUAL,
        loop: Loop | None = None,
    ) -> None:
        super().__init__(host, drone)
        self.settings = settings
        self._bind, self._port = bind, port
        self._loop = loop

    def _switched_on(self) -> RunningFirmware:
        running = RunningFirmware(self.host, self.drone, self._bind, self._port, self.settings, self._loop)
        self._port = running.port  # keeps the port for a restart
        return running

    @property
    def port(self) -> int:
        """The actual port, which was chosen if 0 was requested."""
        return self._started.port

    @property
    def board(self) -> Board:
        """The running flight controller, for tests. Belongs to the loop's thread."""
        return self._started.board

    @property
    def address(self) -> str:
        """Address for a driver on this machine."""
        return f"msp://tcp:{self._bind}:{self.port}"

    @property
    def description(self) -> str:
        """A readable one-line summary: kind, number and address."""
        return f"betaflight drone {self.drone}: {self.address}"

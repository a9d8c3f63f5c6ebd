"""An emulated AR.Drone 1 or 2 on the network that flies a simulated vehicle and accepts any program for the real drone.

To use it on free local ports, as in a test::

    from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Ports, with_ardrones
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions

    host = SimHost(with_ardrones(SimOptions(world="room", seed=1)))
    with ArdroneFirmware(host, version=2, ports=Ports.free()) as firmware:
        ports = firmware.ports  # .navdata and .at (UDP), .video (TCP; UDP for version 1), .control (TCP)
        host.simulation.truth(0).position_m  # the vehicle's true position

``firmware.stop()`` and ``firmware.start()`` restart the firmware on the same ports. ``faults=Faults(seed=1, drop=0.1)``
drops datagrams in both directions (see :mod:`skyloop.faults`).
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.errors import UsageError
from skyloop.faults import Faults
from skyloop.sim.host import Report, SimHost
from skyloop.sim.options import SimOptions
from skyloop.sim.vehicles import AR_DRONE
from skyloop.vehicles.ardrone.emulator.logic import ArdroneLogic, VideoSettings
from skyloop.vehicles.ardrone.emulator.telemetry import ArdroneSnapshot, options_of, tags_of
from skyloop.vehicles.ardrone.emulator.video import CAMERAS, DroneClock, PavePacker, UvlcPacker
from skyloop.vehicles.ardrone.wire import navdata
from skyloop.vehicles.ardrone.wire.navdata import FIRST_SEQUENCE, STANDARD, Ports
from skyloop.vehicles.emulation.emulator import (
    NO_FAULTS,
    Address,
    DatagramPort,
    Emulator,
    Loop,
    RunningEmulator,
    bound,
    checked_delay,
)
from skyloop.vehicles.emulation.flight import SimulatedVehicle
from skyloop.vehicles.emulation.video import Packer, Piece, VideoEncoding, require_encoder

if TYPE_CHECKING:
    from skyloop.sim.camera_pipeline import PipelineCamera

__all__ = ["ArdroneFirmware", "Faults", "Ports", "with_ardrones"]


REPORTS_HZ: Final = 125.0  #: report rate that a world can sustain in real time


def with_ardrones(options: SimOptions | None = None) -> SimOptions:
    """Return the options for a world of AR.Drones, with their identified response and the highest navdata rate.

    The firmware has its own cameras and ignores those in the options.
    """
    return replace(options or SimOptions(), parameters=AR_DRONE, rate_hz=REPORTS_HZ, cameras=())


@dataclass(frozen=True, slots=True)
class ArdroneSettings:
    """The arguments passed to :class:`skyloop.vehicles.ardrone.emulator.ArdroneFirmware`."""

    version: int
    bind: str
    ports: Ports
    faults: Faults
    delay_s: float
    header_size: int
    torn_start: bool


# Clients -------------------------------------------------------------------------------------------------------------

MOST: Final = 8  #: maximum number of recipients of datagrams


class Listeners:
    """Recipients' addresses, each with its own sequence.

    There are at most :data:`MOST` recipients; a new one replaces the one whose last request is the oldest. As with the
    real drone, requests need not be repeated.
    """

    def __init__(self) -> None:
        self._sequences: dict[Address, int] = {}  # ordered by the time of each recipient's last request

    def refresh(self, address: Address) -> bool:
        """Record a request from an address; return whether the address is new."""
        sequence = self._sequences.pop(address, None)
        self._sequences[address] = FIRST_SEQUENCE if sequence is None else sequence
        if len(self._sequences) > MOST:
            del self._sequences[next(iter(self._sequences))]
        return sequence is None

    def next_sequences(self) -> list[tuple[Address, int]]:
        """Return each address with its next sequence number."""
        now = list(self._sequences.items())
        for address, sequence in now:
            self._sequences[address] = (sequence + 1) & 0xFFFFFFFF
        return now

    def __len__(self) -> int:
        return len(self._sequences)


MOST_CLIENTS: Final = 8  #: maximum number of clients of a TCP port
MOST_BACKLOG: Final = 256 * 1024  #: maximum number of bytes queued for one client in addition to the system's buffer
_SYSTEM_BUFFER: Final = 64 * 1024  #: size of the system's send buffer for one client [bytes]
_READ: Final = 4096  #: maximum number of bytes per read


class Outlet:
    """The connection to one client.

    A client that reads too slowly loses whole pieces of the stream, from the first piece that does not fit up to the
    next piece that can be decoded on its own.
    """

    def __init__(self, loop: Loop, connection: socket.socket, gone: Callable[[Outlet], None]) -> None:
        self._loop = loop
        self._socket = connection
        self._gone = gone
        self._waiting: deque[memoryview] = deque()
        self._backlog = 0
        self._writing = False
        self._skipping = False
        self.dropped = 0  #: number of pieces dropped
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SYSTEM_BUFFER)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        loop.watch(connection, self._read)

    def offer(self, piece: bytes, *, starts: bool) -> None:
        """Send a piece unless the client is too slow. ``starts``: whether a stream can begin with this piece."""
        if starts:
            self._skipping = False
        if self._skipping or self._backlog > MOST_BACKLOG:
            self._skipping = True
            self.dropped += 1
            return
        self._waiting.append(memoryview(piece))
        self._backlog += len(piece)
        if not self._writing:
            self._write()

    def skip_to_start(self) -> None:
        """Drop pieces until the next piece that can begin a stream."""
        self._skipping = True

    def close(self) -> None:
        self._loop.forget(self._socket)
        self._socket.close()

    def _write(self) -> None:
        try:
            while self._waiting:
                piece = self._waiting[0]
                sent = self._socket.send(piece)
                self._backlog -= sent
                if sent == len(piece):
                    self._waiting.popleft()
                else:
                    self._waiting[0] = piece[sent:]
        except BlockingIOError:
            pass
        except OSError:
            self._gone(self)
            return
        if self._writing != bool(self._waiting):
            self._writing = bool(self._waiting)
            self._loop.watch(self._socket, self._read, self._write if self._writing else None)

    def _read(self) -> None:
        try:
            data = self._socket.recv(_READ)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._gone(self)


class StreamPort:
    """A TCP port that sends to its clients and discards their data. Use only on the loop's thread."""

    def __init__(self, loop: Loop, bind: Address, *, name: str, joined: Callable[[Outlet], None] | None = None) -> None:
        self._loop = loop
        self._joined = joined
        self._socket = bound(socket.SOCK_STREAM, bind, name)
        self._socket.listen(MOST_CLIENTS)
        self.outlets: list[Outlet] = []  #: replaced as a whole, because other threads may read it
        loop.watch(self._socket, self.accept)

    @property
    def port(self) -> int:
        return int(self._socket.getsockname()[1])

    def accept(self) -> None:
        """Accept all pending connections."""
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:  # no connection is pending, or the socket is already closed
                return
            if len(self.outlets) >= MOST_CLIENTS:
                connection.close()
                continue
            outlet = Outlet(self._loop, connection, self._drop)
            self.outlets = [*self.outlets, outlet]
            if self._joined is not None:
                self._joined(outlet)

    def broadcast(self, piece: bytes, *, starts: bool = True) -> None:
        for outlet in self.outlets:
            outlet.offer(piece, starts=starts)

    def close(self) -> None:
        self._loop.forget(self._socket)
        self._socket.close()
        for outlet in self.outlets:
            outlet.close()
        self.outlets = []

    def _drop(self, outlet: Outlet) -> None:
        outlet.close()
        self.outlets = [other for other in self.outlets if other is not outlet]


# The firmware --------------------------------------------------------------------------------------------------------

DEMO_HZ: Final = 15.0  #: rate of navdata in demo mode


class RunningFirmware(RunningEmulator):
    """An AR.Drone that is switched on. Use its logic, ports and lists of clients only on the loop's thread."""

    def __init__(self, host: SimHost, drone: int, settings: ArdroneSettings) -> None:
        super().__init__(host, drone, "skyloop-ardrone")
        self._settings = settings
        self._clock = DroneClock(monotonic_ns())
        self._demo_due_ns = 0
        self._stale = b""  # the last frame that depends on earlier ones
        self._navdata_clients, self._video_clients = Listeners(), Listeners()
        self._most_thrust = host.simulation.parameters[drone].most_thrust
        vehicle = SimulatedVehicle(host.simulation, drone)
        self.logic = ArdroneLogic(vehicle, self._send_text, monotonic_ns, version=settings.version)
        self._shown = self.logic.video
        self._video = self._encoding = VideoEncoding(self._packer(), lambda: self._shown, self._encoded)
        self._cameras: tuple[PipelineCamera, ...] = ()
        try:
            self._open_ports(settings.ports)
            self._encoding.start()
            self._loop.start()
            self._cameras = host.attach(drone, self, self, list(CAMERAS[settings.version]))
        except BaseException:
            self.stop()
            raise

    # Ports -----------------------------------------------------------------------------------------------------

    def _open_ports(self, wanted: Ports) -> None:
        self._navdata_port = self._datagrams("navdata", wanted.navdata, self._asked_for_navdata)
        self._at_port = self._datagrams("AT", wanted.at, self._on_commands)
        self._control_port = self._stream("control", wanted.control)
        self._video_stream: StreamPort | None = None
        self._video_datagrams: DatagramPort | None = None
        if self._settings.version == 1:
            self._video_datagrams = self._datagrams("video", wanted.video, self._asked_for_video)
            video = self._video_datagrams.port
        else:
            self._video_stream = self._stream("video", wanted.video, self._joined_video)
            video = self._video_stream.port
        self.ports = Ports(self._navdata_port.port, video, self._at_port.port, self._control_port.port)

    def _datagrams(self, name: str, port: int, on_datagram: Callable[[bytes, Address], None]) -> DatagramPort:
        settings = self._settings
        opened = DatagramPort(
            self._loop, (settings.bind, port), on_datagram, name=name, faults=settings.faults, delay_s=settings.delay_s
        )
        self._open.append(opened)
        return opened

    def _stream(self, name: str, port: int, joined: Callable[[Outlet], None] | None = None) -> StreamPort:
        opened = StreamPort(self._loop, (self._settings.bind, port), name=name, joined=joined)
        self._open.append(opened)
        return opened

    # Commands and navdata, on the loop's thread ----------------------------------------------------------------

    def _on_commands(self, datagram: bytes, _sender: Address) -> None:
        self.logic.receive(datagram)
        self._update_video()

    def _send_text(self, text: bytes) -> None:
        self._control_port.accept()  # so that a client that connected just before its command gets the reply too
        self._control_port.broadcast(text)

    def _asked_for_navdata(self, _datagram: bytes, sender: Address) -> None:
        if self._navdata_clients.refresh(sender):
            self._demo_due_ns = 0

    def _tick(self, report: Report) -> None:
        self.logic.supervise(report.believed)
        if self.logic.lost:
            self._video_clients = Listeners()  # otherwise an AR.Drone 1 would keep sending to clients that have left
        self._update_video()
        now_ns = monotonic_ns()
        if self.logic.demo or self.logic.bootstrap:
            if now_ns < self._demo_due_ns:
                return
            period_ns = nanoseconds(1 / DEMO_HZ)
            self._demo_due_ns = max(self._demo_due_ns + period_ns, now_ns)
        self._send_navdata(report)

    def _send_navdata(self, report: Report) -> None:
        if not self._navdata_clients:
            return
        options = []
        logic = self.logic
        if not logic.bootstrap:
            mask = int(logic.configuration.number("general:navdata_options"))
            tags = tags_of(mask, demo=logic.demo, version=self._settings.version)
            options = options_of(self._snapshot(report), tags)
        state = logic.state(video=self._seen)
        vision = bool(state & navdata.State.VISION)
        for client, sequence in self._navdata_clients.next_sequences():
            self._navdata_port.send(navdata.encode(state, sequence, options, vision), client)

    def _snapshot(self, report: Report) -> ArdroneSnapshot:
        flight = self.logic.flight
        return ArdroneSnapshot(
            believed=report.believed,
            state=report.believed.state,
            time=self._clock.navdata_time(report.captured_ns),
            thrust=report.truth.thrust,
            most_thrust=self._most_thrust,
            trim_rad=flight.trim_rad,
            progress=flight.progress,
            flipping=flight.flipping(monotonic_ns()),
            video=self._encoding.status,
            channel=self._shown.channel,
            link_quality=round(100 * (1 - self._settings.faults.drop)),
        )

    # Video -----------------------------------------------------------------------------------------------------

    @property
    def _seen(self) -> bool:
        if self._video_stream is not None:
            return bool(self._video_stream.outlets)
        return bool(self._video_clients)

    def _packer(self) -> Packer[VideoSettings]:
        if self._settings.version == 1:
            return UvlcPacker()
        return PavePacker(self._clock, self._settings.header_size, self._attitude)

    def _attitude(self) -> tuple[float, float, float]:
        """Return theta, phi and psi [rad]."""
        if self._report is None:
            return 0.0, 0.0, 0.0
        believed = self._report.believed
        return -believed.pitch_rad, believed.roll_rad, -believed.yaw_rad

    def _update_video(self) -> None:
        """Apply the configured video settings. Runs on the loop's thread."""
        wanted = self.logic.video
        if wanted == self._shown:
            return
        self._shown = wanted
        for camera in self._cameras:
            camera.model = replace(camera.model, fps=wanted.fps)

    def _joined_video(self, outlet: Outlet) -> None:
        if not self._settings.torn_start:
            outlet.skip_to_start()
        elif self._stale:
            outlet.offer(self._stale, starts=True)

    def _asked_for_video(self, _datagram: bytes, sender: Address) -> None:
        self._video_clients.refresh(sender)

    def _encoded(self, piece: Piece) -> None:
        """Send an encoded image. Runs on the encoder's thread."""
        self._loop.post(lambda: self._send_video(piece))

    def _send_video(self, piece: Piece) -> None:
        if self._video_stream is not None:
            self._video_stream.broadcast(piece.data, starts=piece.starts)
            if not piece.starts:
                self._stale = piece.data
        elif self._video_datagrams is not None:
            for client, _ in self._video_clients.next_sequences():
                self._video_datagrams.send(piece.data, client)

    # Called by the host on its threads -------------------------------------------------------------------------

    def wanted_fps(self, camera: str) -> float:
        """Return the frame rate at which to render this camera: its full rate, or 0 if there is no client."""
        return super().wanted_fps(camera) if self._seen else 0.0


VERSIONS: Final = (1, 2)


class ArdroneFirmware(Emulator[RunningFirmware]):
    """The firmware of one drone in a host's world. Several drones can share a host, each with its own ports.

    Create the host with options from :func:`with_ardrones`. Full navdata is sent at the host's report rate, which they
    set to 125 Hz; real drones send it at 200 Hz.

    Args:
        host: The simulated world.
        drone: Number of the drone in that world.
        version: 1 or 2.
        bind: The local address to listen on.
        ports: The ports to listen on; 0 for any free one.
        faults: Injected into the datagrams of AT commands, navdata and an AR.Drone 1's video, in both directions.
        delay_s: Delay added to those datagrams in each direction.
        header_size: Size of the PaVE headers: 68 bytes, or 64 as in early firmware.
        torn_start: Whether, as with a real AR.Drone 2, a new video client first gets the last frame that is not a key
            frame, however old, and then the frames that follow. If False, its stream begins with the next key frame.

    Raises:
        UsageError: The version or header size is unknown, or the delay is out of range.
        MissingExtraError: A library that renders or encodes images is not installed.
    """

    def __init__(
        self,
        host: SimHost,
        drone: int = 0,
        *,
        version: int = 2,
        bind: str = "127.0.0.1",
        ports: Ports = STANDARD,
        faults: Faults = NO_FAULTS,
        delay_s: float = 0.0,
        header_size: int = 68,
        torn_start: bool = True,
    ) -> None:
        if version not in VERSIONS:
            raise UsageError(f"the AR.Drone's version must be 1 or 2, got {version!r}")
        if header_size not in (64, 68):
            raise UsageError(f"header_size must be 64 or 68, got {header_size!r}")
        if version > 1:
            require_encoder()
        super().__init__(host, drone)
        self.settings = ArdroneSettings(version, bind, ports, faults, checked_delay(delay_s), header_size, torn_start)

    def _switched_on(self) -> RunningFirmware:
        running = RunningFirmware(self.host, self.drone, self.settings)
        self.settings = replace(self.settings, ports=running.ports)  # keeps the ports the same after a restart
        return running

    @property
    def ports(self) -> Ports:
        """The actual ports, including those that the system chose where 0 was given."""
        return self._started.ports

    @property
    def logic(self) -> ArdroneLogic:
        """The logic of the running firmware, for tests. Use it only on the loop's thread."""
        return self._started.logic

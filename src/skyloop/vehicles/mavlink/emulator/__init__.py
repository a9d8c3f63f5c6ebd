"""An emulated ArduCopter or PX4 that flies a simulated vehicle and is open to any MAVLink program.

To use it on free local ports, as in a test::

    from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions

    host = SimHost(with_multirotors(SimOptions(world="empty", seed=1)))
    with MavlinkFirmware(host, kind=Kind.PX4, ports=Ports.free(Kind.PX4)) as firmware:
        firmware.address  # mavlink://udpin:127.0.0.1:…, the driver's address

The differences between the two were observed on real autopilots and are listed in ``docs/mavlink.md``.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns
from skyloop.errors import MissingExtraError, UsageError
from skyloop.faults import Faults
from skyloop.sim.camera import FRONT_CAMERA, CameraModel
from skyloop.sim.host import Report, SimHost
from skyloop.vehicles.emulation.emulator import NO_FAULTS, Emulator, Loop, RunningEmulator, checked_delay
from skyloop.vehicles.emulation.flight import SimulatedVehicle
from skyloop.vehicles.emulation.video import GROUP, OneCamera, VideoEncoding
from skyloop.vehicles.mavlink.emulator.arducopter import EmulatedArduCopter
from skyloop.vehicles.mavlink.emulator.autopilot import EmulatedAutopilot
from skyloop.vehicles.mavlink.emulator.links import (
    Kind,
    LinkIntervals,
    MavlinkSettings,
    Port,
    Ports,
    TcpPort,
    UdpPort,
    with_multirotors,
)
from skyloop.vehicles.mavlink.emulator.px4 import EmulatedPx4

if TYPE_CHECKING:
    from av.container import OutputContainer
    from av.video.stream import VideoStream

__all__ = ["Faults", "Kind", "MavlinkFirmware", "Ports", "with_multirotors"]


_KINDS: dict[Kind, type[EmulatedAutopilot]] = {Kind.ARDUCOPTER: EmulatedArduCopter, Kind.PX4: EmulatedPx4}


class RunningFirmware(RunningEmulator):
    """An autopilot that is switched on. Use it only on the loop's thread."""

    def __init__(self, host: SimHost, drone: int, settings: MavlinkSettings, loop: Loop | None) -> None:
        super().__init__(host, drone, loop or f"skyloop-{settings.kind.value}")
        kind = _KINDS[settings.kind]
        self.autopilot = kind(SimulatedVehicle(host.simulation, drone), settings.system, settings.boot_s, settings.gps)
        try:
            udp = UdpPort(self._loop, settings, LinkIntervals(kind.RATES), self._on_message)
            self._open.append(udp)
            tcp = None
            if settings.ports.tcp is not None:
                tcp = TcpPort(self._loop, settings, LinkIntervals(kind.RATES), self._on_message)
                self._open.append(tcp)
            self.ports = Ports(udp.port, settings.ports.remote, tcp.port if tcp is not None else None)
            self.autopilot.ports = (udp,) if tcp is None else (udp, tcp)
            if self._own_loop:
                self._loop.start()
            if settings.video is not None:
                stream = TransportStream(*settings.video)
                self._open.append(stream)
                self._video = VideoEncoding(stream, lambda: _SETTINGS, lambda _: None)
                self._video.start()
            host.attach(drone, self, self, [CAMERA] if self._video is not None else [])
        except BaseException:
            self.stop()
            raise

    def _on_message(self, port: Port, message: object) -> None:
        self.autopilot.on_message(port, message, monotonic_ns())

    def _tick(self, report: Report) -> None:
        self.autopilot.tick(report)

    def _crashed(self, text: str) -> None:
        self.autopilot.crashed(text)


BOOT_S: Final = 2.0  #: chosen; real vehicles take 5 to 40 s


class MavlinkFirmware(Emulator[RunningFirmware]):
    """The autopilot of one drone in a host's world. Autopilots may share a host, each with its own drone and ports.

    Create the host with options from :func:`with_multirotors`.

    Args:
        host: The simulated world.
        drone: Number of the drone in that world.
        kind: ArduCopter or PX4.
        bind: The local address to listen on.
        ports: The ports to use; None for those of the autopilot's own simulation.
        system: MAVLink system id, 1 to 255; None for the drone's number plus one.
        faults: Faults injected into UDP datagrams in both directions.
        delay_s: Delay added to UDP datagrams in each direction.
        boot_s: Simulated time from the start until the vehicle can be armed, in seconds.
        gps: Whether the vehicle has GPS; without it, the autopilot is not ready until external poses arrive.
        version: 1 if the autopilot supports only MAVLink 1.
        key: 32-byte key for signing all messages; None to sign nothing.
        video: Host and port for the front camera's video over UDP; None for no camera.
        loop: Thread shared by a fleet, to be started after all its members and stopped before any of them; None for
            a separate thread.

    Raises:
        UsageError: An argument is out of range.
        MissingExtraError: pymavlink is not installed.
    """

    def __init__(
        self,
        host: SimHost,
        drone: int = 0,
        *,
        kind: Kind,
        bind: str = "127.0.0.1",
        ports: Ports | None = None,
        system: int | None = None,
        faults: Faults = NO_FAULTS,
        delay_s: float = 0.0,
        boot_s: float = BOOT_S,
        gps: bool = True,
        version: int = 2,
        key: bytes | None = None,
        video: tuple[str, int] | None = None,
        loop: Loop | None = None,
    ) -> None:
        number = drone + 1 if system is None else system
        if not 1 <= number <= 255:
            raise UsageError(f"a system id must be from 1 to 255, not {number!r}")
        if version not in (1, 2):
            raise UsageError(f"the MAVLink version must be 1 or 2, not {version!r}")
        super().__init__(host, drone)
        self._loop = loop
        delay_s = checked_delay(delay_s)
        ports = ports or Ports.standard(kind, drone)
        self.settings = MavlinkSettings(kind, bind, ports, number, faults, delay_s, boot_s, gps, version, key, video)

    def _switched_on(self) -> RunningFirmware:
        running = RunningFirmware(self.host, self.drone, self.settings, self._loop)
        self.settings = replace(self.settings, ports=running.ports)  # keeps the ports the same after a restart
        return running

    @property
    def autopilot(self) -> EmulatedAutopilot:
        """The running autopilot, for tests. Use it only on the loop's thread."""
        return self._started.autopilot

    @property
    def address(self) -> str:
        """Address for a driver on this machine, over UDP."""
        return f"mavlink://udpin:{self.settings.bind}:{self.settings.ports.remote}"

    @property
    def tcp_address(self) -> str:
        """Address for a driver on this machine, over TCP; raises an error for a kind without a TCP port."""
        if self.settings.ports.tcp is None:
            raise UsageError(f"an emulated {self.settings.kind.value} has no TCP port")
        return f"mavlink://tcp:{self.settings.bind}:{self.settings.ports.tcp}"

    @property
    def description(self) -> str:
        """A readable one-line summary: kind, system and address."""
        settings = self.settings
        tcp = f", {self.tcp_address}" if settings.ports.tcp is not None else ""
        return (
            f"{settings.kind.value} drone {self.drone}, system {settings.system}, "
            f"from udp {settings.ports.udp}: {self.address}{tcp}"
        )


CAMERA: Final[CameraModel] = replace(FRONT_CAMERA, fps=20.0)
_CLOCK: Final = Fraction(1, 90_000)  #: time unit of a transport stream [s]
_X264: Final = {"preset": "ultrafast", "tune": "zerolatency", "x264-params": "scenecut=0:repeat-headers=1:threads=1"}
_SETTINGS: Final = OneCamera("front", CAMERA.fps, 1500)


class TransportStream:
    """Encodes and sends each image as it arrives. Not thread-safe. Raises MissingExtraError without PyAV."""

    def __init__(self, host: str, port: int) -> None:
        try:
            import av
        except ImportError as error:
            raise MissingExtraError("the video of an emulated vehicle", "video", cause=str(error)) from error
        self._av = av
        options = {"mpegts_flags": "resend_headers", "flush_packets": "1"}
        url = f"udp://{host}:{port}?pkt_size=1316"
        self._container: OutputContainer = av.open(url, "w", format="mpegts", options=options)
        self._stream: VideoStream = self._container.add_stream("libx264", rate=round(CAMERA.fps), options=dict(_X264))
        self._stream.width, self._stream.height = CAMERA.width, CAMERA.height
        self._stream.pix_fmt = "yuv420p"
        self._stream.bit_rate = _SETTINGS.bitrate_kbps * 1000
        self._stream.gop_size = GROUP
        self._stream.time_base = self._stream.codec_context.time_base = _CLOCK  # finer than the frame interval
        self._begun_ns: int | None = None
        self._stamp = -1

    def pack(self, picture: NDArray[np.uint8], _settings: OneCamera, captured_ns: int) -> None:
        """Encode and send an image: BGR, uint8, shape (height, width, 3)."""
        self._begun_ns = captured_ns if self._begun_ns is None else self._begun_ns
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="bgr24")
        # A drone's exposures may arrive out of order, but a stream's stamps must increase.
        self._stamp = max(self._stamp + 1, round((captured_ns - self._begun_ns) / 1e9 / _CLOCK))
        frame.pts = self._stamp
        frame.time_base = _CLOCK
        for packet in self._stream.encode(frame):
            self._container.mux(packet)

    def close(self) -> None:
        self._container.close()

"""An emulated Ryze Tello on the network that flies a simulated vehicle and accepts any program for the real drone.

To use it at a local address, as in a test::

    from skyloop.vehicles.tello.emulator import TelloFirmware, with_tellos
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions

    host = SimHost(with_tellos(SimOptions(world="room", seed=1)))
    with TelloFirmware(host, bind="127.0.0.1", port=0) as firmware:
        firmware.port  # UDP, where it takes commands
        host.simulation.truth(0).position_m  # the vehicle's true position

State and video go to ports 8890 and 11111 of the host that sent ``command``, or to those set by ``port`` (SDK 3.0).
``faults=Faults(seed=1, drop=0.1)`` drops datagrams in both directions (see :mod:`skyloop.faults`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.errors import UsageError
from skyloop.faults import Faults
from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA
from skyloop.sim.host import Report, SimHost
from skyloop.sim.options import SimOptions
from skyloop.sim.parameters import Limits, VehicleParameters
from skyloop.vehicles.emulation.emulator import (
    NO_FAULTS,
    Address,
    DatagramPort,
    Emulator,
    RunningEmulator,
    checked_delay,
)
from skyloop.vehicles.emulation.flight import SimulatedVehicle
from skyloop.vehicles.emulation.video import Encoder, Format, OneCamera, Piece, VideoEncoding, require_encoder
from skyloop.vehicles.tello.emulator.logic import TelloLogic
from skyloop.vehicles.tello.wire import FULL_CLIMB_M_S, FULL_SPEED_M_S, FULL_YAW_RATE_RAD_S, PADS, PORT, Sdk, pieces

if TYPE_CHECKING:
    from skyloop.sim.camera_pipeline import PipelineCamera

__all__ = ["Faults", "TelloFirmware", "with_tellos"]


REPORTS_HZ: Final = 50.0  #: rate at which the simulation reports to the logic
TAKEOFF_ALTITUDE_M: Final = 0.8  #: height at the end of a take-off, as in a recorded flight

#: A small, light drone. Mass, size and flight time come from Ryze's Tello specifications; it has 3-inch rotors. All
#: other parameters equal those of the simulator's own vehicle.
TELLO: Final = VehicleParameters(
    mass_kg=0.087,
    radius_m=0.1,
    half_height_m=0.02,
    rotor_radius_m=0.038,
    rotor_height_m=0.03,
    takeoff_climb_m_s=0.7,  # from a recorded flight: 0.8 m in the 1.3 s between leaving the ground and hovering
    battery_full_v=4.35,
    battery_empty_v=3.3,
    battery_charge_c=3960.0,  # 1100 mAh
    battery_resistance_ohm=0.03,
    hover_power_w=17.0,  # 4.18 Wh in 13 minutes, minus what the electronics use
    electronics_power_w=2.0,
)
LIMITS: Final = Limits(
    tilt_rad=0.35,
    climb_m_s=FULL_CLIMB_M_S,
    yaw_rate_rad_s=FULL_YAW_RATE_RAD_S,
    altitude_m=10.0,
    speed_m_s=FULL_SPEED_M_S * 2**0.5,  # speed with the stick in a corner
    takeoff_altitude_m=TAKEOFF_ALTITUDE_M,
)

#: The calibration of one drone for 960×720 images, published with tello_ros.
FRONT: Final = replace(
    FRONT_CAMERA,
    width=960,
    height=720,
    fps=30.0,
    fx=921.170702,
    fy=919.018377,
    cx=459.904354,
    cy=351.238301,
    distortion=(-0.033458, 0.105152, 0.001256, -0.006647, 0.0),
    position_m=(0.05, 0.0, 0.0),
)
BOTTOM: Final = replace(BOTTOM_CAMERA, width=320, height=240, fps=30.0)  #: the lens parameters are an estimate


def with_tellos(options: SimOptions | None = None) -> SimOptions:
    """Return the options for a world of Tellos. The firmware has its own cameras and ignores those in the options."""
    return replace(options or SimOptions(), parameters=TELLO, rate_hz=REPORTS_HZ, cameras=())


@dataclass(frozen=True, slots=True)
class TelloSettings:
    """The arguments passed to :class:`skyloop.vehicles.tello.emulator.TelloFirmware`."""

    sdk: Sdk
    bind: str
    port: int
    faults: Faults
    delay_s: float
    pads: Mapping[int, tuple[float, float]]  #: x and y in the world by pad number


STATE_HZ: Final = 10.0  #: rate of the state strings, as in the SDK's guides
GROUP: Final = 30  #: number of images from one key frame to the next
FULL_KBPS: Final = 2500  #: bitrate that makes images of about 10 kB
LEAST_KBPS: Final = 300  #: lowest automatic bitrate, an estimate
BUFFER_S: Final = 0.1  #: buffer of the encoder's rate control; short, to keep images about equally large


def automatic_kbps(loss: float) -> int:
    """Return the bitrate for a fraction of lost datagrams. An estimate: how a Tello adapts its bitrate is unknown."""
    return max(LEAST_KBPS, round(FULL_KBPS * (1 - 9 * loss)))


class TelloPacker:
    """Encodes images in H.264 as a Tello does."""

    def __init__(self) -> None:
        self._made: tuple[tuple[int, int, float, int], Encoder] | None = None
        self.size = (FRONT.width, FRONT.height)

    def pack(self, picture: NDArray[np.uint8], settings: OneCamera, _captured_ns: int) -> Piece | None:
        """Encode an image; return None if the encoder produced no output."""
        width, height = self.size
        wanted = width, height, settings.fps, settings.bitrate_kbps
        if self._made is None or self._made[0] != wanted:
            form = Format("h264", width, height, 0)
            encoder = Encoder(form, settings.fps, settings.bitrate_kbps, group=GROUP, profile="Main", buffer_s=BUFFER_S)
            self._made = wanted, encoder
        encoded = self._made[1].encode(picture)
        return None if encoded is None else Piece(encoded.payload, encoded.key)


class RunningFirmware(RunningEmulator):
    """A Tello that is switched on. Use its logic and ports only on the loop's thread."""

    def __init__(self, host: SimHost, drone: int, settings: TelloSettings) -> None:
        super().__init__(host, drone, "skyloop-tello")
        self._settings = settings
        self._state_due_ns = 0
        vehicle = SimulatedVehicle(host.simulation, drone)
        vehicle.set_limits(LIMITS)
        self.logic = TelloLogic(
            vehicle,
            self._answer,
            monotonic_ns,
            sdk=settings.sdk,
            pads=settings.pads,
            link_quality=round(100 * (1 - settings.faults.drop)),
        )
        simulation = host.simulation
        self.logic.supervise(Report(simulation.feedback(drone), simulation.truth(drone), (), monotonic_ns()))
        self._packer = TelloPacker()
        self._shown = self._wanted_video()
        self._video = VideoEncoding(self._packer, lambda: self._shown, self._encoded)
        self._cameras: tuple[PipelineCamera, ...] = ()
        try:
            self._commands = self._datagrams("command", settings.port)
            self._video_port = self._datagrams("video", 0)
            self._video.start()
            self._loop.start()
            self._cameras = host.attach(drone, self, self, [FRONT, BOTTOM])
        except BaseException:
            self.stop()
            raise

    @property
    def port(self) -> int:
        """The actual UDP port for commands."""
        return self._commands.port

    def _datagrams(self, name: str, port: int) -> DatagramPort:
        settings = self._settings
        on_datagram = self._on_datagram if name == "command" else lambda _datagram, _sender: None
        opened = DatagramPort(
            self._loop, (settings.bind, port), on_datagram, name=name, faults=settings.faults, delay_s=settings.delay_s
        )
        self._open.append(opened)
        return opened

    # On the loop's thread ----------------------------------------------------------------------------------------

    def _on_datagram(self, datagram: bytes, sender: Address) -> None:
        self.logic.receive(datagram, sender)
        self._update_video()

    def _answer(self, text: str, to: Address) -> None:
        self._commands.send(text.encode("ascii"), to)

    def _tick(self, report: Report) -> None:
        self.logic.supervise(report)
        now_ns = monotonic_ns()
        state, client = self.logic.state_string(), self.logic.client
        if state is None or client is None or now_ns < self._state_due_ns:
            return
        self._state_due_ns = max(self._state_due_ns + nanoseconds(1 / STATE_HZ), now_ns)
        self._commands.send(state, (client, self.logic.state_port))

    def _wanted_video(self) -> OneCamera:
        logic = self.logic
        kbps = logic.bitrate_mbps * 1000 or automatic_kbps(self._settings.faults.drop)
        return OneCamera("bottom" if logic.looks_down else "front", logic.fps, kbps)

    def _update_video(self) -> None:
        """Apply the configured video settings."""
        logic, wanted = self.logic, self._wanted_video()
        self._packer.size = (BOTTOM.width, BOTTOM.height) if logic.looks_down else logic.size
        if wanted == self._shown:
            return
        self._shown = wanted
        for camera in self._cameras:
            camera.model = replace(camera.model, fps=wanted.fps)

    def _encoded(self, piece: Piece) -> None:
        """Send an encoded image. Runs on the encoder's thread."""
        self._loop.post(lambda: self._send_video(piece))

    def _send_video(self, piece: Piece) -> None:
        logic = self.logic
        if logic.client is None or not logic.streaming:
            return
        for datagram in pieces(piece.data):
            self._video_port.send(datagram, (logic.client, logic.video_port))

    # Called by the host on its threads ---------------------------------------------------------------------------

    def wanted_fps(self, camera: str) -> float:
        """Return the frame rate at which to render this camera: its full rate, or 0 if there is no client."""
        return super().wanted_fps(camera) if self.logic.streaming and self.logic.client is not None else 0.0


class TelloFirmware(Emulator[RunningFirmware]):
    """The firmware of one drone in a host's world. A host can have several Tellos, each with its own drone and address.

    Create the host with options from :func:`with_tellos`.

    Args:
        host: The simulated world.
        drone: Number of the drone in that world.
        sdk: 1.3, 2.0 or 3.0.
        bind: The local address to listen on.
        port: UDP port for commands; 0 for any free one.
        faults: Faults injected into all datagrams in both directions.
        delay_s: Delay added to all datagrams in each direction.
        pads: Mission pads on the floor: x and y in world axes [m] by pad number from 1 to 8.

    Raises:
        UsageError: An argument is invalid.
        MissingExtraError: A library that renders or encodes images is not installed.
    """

    def __init__(
        self,
        host: SimHost,
        drone: int = 0,
        *,
        sdk: str = Sdk.V3_0,
        bind: str = "127.0.0.1",
        port: int = PORT,
        faults: Faults = NO_FAULTS,
        delay_s: float = 0.0,
        pads: Mapping[int, tuple[float, float]] | None = None,
    ) -> None:
        if sdk not in list(Sdk):
            raise UsageError(f"sdk must be one of {', '.join(Sdk)}, got {sdk!r}")
        for number in pads or {}:
            if number not in PADS:
                raise UsageError(f"mission pads are numbered from {PADS[0]} to {PADS[-1]}, got {number!r}")
        require_encoder("the video of an emulated Tello")
        super().__init__(host, drone)
        self.settings = TelloSettings(Sdk(sdk), bind, port, faults, checked_delay(delay_s), dict(pads or {}))

    def _switched_on(self) -> RunningFirmware:
        running = RunningFirmware(self.host, self.drone, self.settings)
        self.settings = replace(self.settings, port=running.port)  # keeps the port the same after a restart
        return running

    @property
    def port(self) -> int:
        """The actual port; if 0 was given, the system chose it."""
        return self._started.port

    @property
    def logic(self) -> TelloLogic:
        """The logic of the running firmware, for tests. Use it only on the loop's thread."""
        return self._started.logic

"""The drone's logic: handles AT commands and maintains the link, the configuration and the state bits.

Pure: the clock is an argument, and output is passed to a function.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

from skyloop.clock import Clock, nanoseconds, seconds
from skyloop.sim.reports import VehicleFeedback
from skyloop.vehicles.ardrone.emulator.configuration import Configuration, Ids
from skyloop.vehicles.ardrone.emulator.flight import LOST_AFTER_S, ArdroneFlightControl, ProgressCommand, limits_of
from skyloop.vehicles.ardrone.wire.at import SILENCE_RESET_S, AtCommand, Ctrl, parse_commands, to_float
from skyloop.vehicles.ardrone.wire.configuration import VideoChannel, VideoCodec
from skyloop.vehicles.ardrone.wire.navdata import State
from skyloop.vehicles.emulation.flight import Vehicle

RESTART: Final = 1  #: the sequence number with which a client restarts the count


class CommandSequence:
    """Accepts a command only if its number is greater than the last accepted one, or is 1, which restarts the count.

    After two seconds without an accepted command, any number greater than 0 is accepted. The Developer Guide says that
    clients must begin with 1, but a drone that insisted on it would never obey a client whose first datagram was lost.
    """

    def __init__(self) -> None:
        self._last = 0
        self._taken_ns: int | None = None

    def takes(self, number: int, now_ns: int) -> bool:
        """Return whether to execute a command that has this number and arrived now."""
        if self._taken_ns is not None and now_ns - self._taken_ns > nanoseconds(SILENCE_RESET_S):
            self._last = 0
        if number != RESTART and number <= self._last:
            return False
        self._last, self._taken_ns = number, now_ns
        return True


WATCHDOG_S: Final = 0.05  #: time without commands before the watchdog bit is set: Developer Guide, 7.1.2

_ALWAYS: Final = (
    State.ALTITUDE_CONTROL
    | State.CAMERA_READY
    | State.PIC_VERSION_OK
    | State.AT_THREAD
    | State.NAVDATA_THREAD
    | State.VIDEO_THREAD
    | State.ACQUISITION_THREAD
)
_NOTHING_DETECTED: Final = 3  # value of detect:detect_type for no detection
_CAMERAS: Final = {
    VideoChannel.FRONT: ("front",),
    VideoChannel.BOTTOM: ("bottom",),
    VideoChannel.FRONT_WITH_BOTTOM: ("front", "bottom"),
    VideoChannel.BOTTOM_WITH_FRONT: ("bottom", "front"),
}
#: Size of the second camera's image within the first one's [px].
_INSETS: Final = {VideoChannel.FRONT_WITH_BOTTOM: (88, 72), VideoChannel.BOTTOM_WITH_FRONT: (58, 42)}
#: Legacy and factory commands, which a real drone accepts and which have no effect here.
_WITHOUT_EFFECT: Final = (*("PMODE", "MISC", "GAIN", "VISP", "VISO", "CAP", "MTRIM", "POL", "PWM", "AFLIGHT", "VICON"),)


@dataclass(frozen=True, slots=True)
class VideoSettings:
    """The video settings as configured."""

    channel: VideoChannel
    codec: VideoCodec
    fps: float
    bitrate_kbps: int

    @property
    def cameras(self) -> tuple[str, ...]:
        return _CAMERAS[self.channel]

    @property
    def inset(self) -> tuple[int, int]:
        return _INSETS.get(self.channel, (0, 0))


class ArdroneLogic:
    """The logic of one drone. Not thread-safe."""

    def __init__(self, vehicle: Vehicle, send_text: Callable[[bytes], None], clock: Clock, *, version: int) -> None:
        self._vehicle = vehicle
        self._send_text = send_text
        self._clock = clock
        self._sequence = CommandSequence()
        self._received_ns = clock()  # time of the last accepted command, or of the start
        self._linked = False  # whether a command has arrived since the start or the last link loss
        self._watchdog = True
        self._ack = False
        self.lost = False  #: whether the link counts as lost after a long time without commands
        self._ids: Ids | None = None  # ids received with the previous command
        self.configuration = Configuration(version)
        self.flight = ArdroneFlightControl(vehicle, self.configuration, version=version)
        self.bootstrap = True  #: whether the drone sends no options yet, until its mode is configured
        self.leds: tuple[int, float, int] | None = None  #: number, frequency [Hz] and duration [s] last requested
        self.malformed = 0  #: number of invalid lines, unknown commands and wrong arguments
        self.stale = 0  #: number of commands whose sequence number was not new
        self._handlers: dict[str, Callable[..., None]] = {
            "REF": lambda bits: self.flight.ref(int(bits)),
            "PCMD": self._pcmd,
            "PCMD_MAG": partial(self._pcmd_mag, version),
            "FTRIM": lambda *_: self.flight.flat_trim(),
            "CALIB": lambda device: self.flight.calibrate(device, clock()),
            "CONFIG": self._config,
            "CONFIG_IDS": self._config_ids,
            "COMWDG": self._comwdg,
            "CTRL": self._ctrl,
            "LED": self._led,
            "ANIM": lambda number, duration_ms: self.flight.animate(number, duration_ms, clock()),
            "ZAP": lambda channel: self._set("video:video_channel", str(channel)),
            "CAD": lambda kind, _: self._set("detect:detect_type", str(kind)),
        }
        self._apply_limits()

    # Receiving -------------------------------------------------------------------------------------------------

    def receive(self, datagram: bytes) -> None:
        """Execute the commands in a datagram. Never raises, regardless of content."""
        commands, malformed = parse_commands(datagram)
        self.malformed += malformed
        for command in commands:
            now_ns = self._clock()
            if not self._sequence.takes(command.sequence, now_ns):
                self.stale += 1
                continue
            self._received_ns, self._linked, self.lost = now_ns, True, False
            ids, self._ids = self._ids, None
            self._execute(command, ids)

    def supervise(self, believed: VehicleFeedback) -> None:
        """Run the watchdogs and check battery and angles, given the vehicle's own estimate. Called on every report."""
        silence_s = seconds(self._clock() - self._received_ns)
        if silence_s > WATCHDOG_S:
            self._watchdog = True
        if silence_s > LOST_AFTER_S and self._linked:
            self._lose_link()
        self.flight.supervise(believed, silence_s, self._clock())

    def _lose_link(self) -> None:
        """Reset the link: the next client starts in bootstrap with the default session, user and application."""
        self.lost, self._linked = True, False
        self.bootstrap = True
        self._ack = False
        self.configuration.forget_client()
        self._apply_limits()

    # Sending ---------------------------------------------------------------------------------------------------

    def state(self, *, video: bool) -> State:
        """Return the state bits. ``video``: whether any client is receiving video."""
        flight_state = self._vehicle.state
        bits = {
            State.FLYING: flight_state.airborne,
            State.VIDEO: video,
            State.VISION: flight_state.airborne or self.configuration.number("detect:detect_type") != _NOTHING_DETECTED,
            State.START_BUTTON: self.flight.start,
            State.COMMAND_ACK: self._ack,
            State.DEMO: self.demo,
            State.BOOTSTRAP: self.bootstrap,
            State.COMMUNICATION_LOST: self.lost,
            State.BATTERY_LOW: self.flight.battery_low,
            State.COMMUNICATION_WATCHDOG: self._watchdog,
        }
        state = _ALWAYS | self.flight.emergency_bits(flight_state)
        for bit, is_set in bits.items():
            if is_set:
                state |= bit
        return state

    @property
    def demo(self) -> bool:
        """Whether navdata is sent in demo mode, 15 times per second and with few options."""
        return bool(self.configuration["general:navdata_demo"])

    @property
    def video(self) -> VideoSettings:
        """The video settings as currently configured."""
        number, keys = self.configuration.number, self.configuration
        most = number("video:max_bitrate") if "video:max_bitrate" in keys else float("inf")
        return VideoSettings(
            channel=VideoChannel(int(number("video:video_channel"))),
            codec=VideoCodec(int(number("video:video_codec"))),
            fps=number("video:codec_fps" if "video:codec_fps" in keys else "video:camif_fps"),
            bitrate_kbps=int(min(number("video:bitrate"), most)),
        )

    # Commands --------------------------------------------------------------------------------------------------

    def _execute(self, command: AtCommand, ids: Ids | None) -> None:
        handler = self._handlers.get(command.name)
        if handler is None:
            self.malformed += command.name not in _WITHOUT_EFFECT
            return
        if command.name == "CONFIG":
            handler = partial(handler, ids)
        try:
            handler(*command.arguments)
        except (TypeError, ValueError, OverflowError):  # too few or too many arguments, or text instead of a number
            self.malformed += 1

    def _pcmd(self, flags: int, *values: int) -> None:
        roll, pitch, gaz, yaw = map(to_float, values)
        self.flight.follow(ProgressCommand(int(flags), roll, pitch, gaz, yaw), self._clock())

    def _pcmd_mag(self, version: int, flags: int, *values: int) -> None:
        roll, pitch, gaz, yaw, heading, _accuracy = map(to_float, values)
        if version > 1:
            self.flight.follow(ProgressCommand(int(flags), roll, pitch, gaz, yaw, heading), self._clock())

    def _comwdg(self, *_: int | str) -> None:
        self._watchdog = False

    def _ctrl(self, mode: int, _unused: int = 0) -> None:
        if mode in (Ctrl.NONE, Ctrl.CLEAR_ACK):  # the guide specifies 0, the SDK sends 5
            self._ack = False
        elif mode == Ctrl.GET_CONFIGURATION:
            self._answer(self.configuration.dump())
        elif mode == Ctrl.GET_CUSTOM_IDS:
            self._answer(self.configuration.custom_ids())

    def _answer(self, text: bytes) -> None:
        self._ack = True
        self._send_text(text)

    def _led(self, number: int, frequency: int, duration_s: int) -> None:
        self.leds = number, to_float(frequency), duration_s

    def _config_ids(self, session: str, user: str, application: str) -> None:
        self._ids = (str(session).lower(), str(user).lower(), str(application).lower())

    def _config(self, ids: Ids | None, name: str, value: str) -> None:
        self._ack = True  # acknowledges that the command was received, not that it was executed
        self._set(str(name), str(value), ids)

    def _set(self, name: str, text: str, ids: Ids | None = None) -> None:
        if not self.configuration.write(name, text, ids):
            return
        name = name.strip().lower()
        self._apply_limits()
        if name == "general:navdata_demo":
            self.bootstrap = False
        elif name == "control:flight_anim":
            number, duration_ms = map(int, text.split(","))
            self.flight.animate(number, duration_ms, self._clock())
        elif name == "leds:leds_anim":
            led, frequency, duration_s = map(int, text.split(","))
            self._led(led, frequency, duration_s)

    def _apply_limits(self) -> None:
        self._vehicle.set_limits(limits_of(self.configuration))

"""Addresses of motion capture systems, and :func:`main`, which receives data from them in a child process.

The ``motioncapture`` package waits in native code, without a timeout and partly while holding the interpreter lock. In
a separate process, it can't block anything else and can be killed at any time. Frames are written to standard output as
msgpack arrays, each preceded by its length, with the time of reception and the pose of each visible body.
"""

from __future__ import annotations

import os
import struct
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, BinaryIO, Final, cast
from urllib.parse import SplitResult, parse_qsl, urlsplit

import msgspec

from skyloop.child_process import ChildProcess, RestartingChild
from skyloop.errors import LinkError, MissingExtraError, UnknownNameError, UnsupportedError, UsageError
from skyloop.messages.geometry import quaternion_from_euler

if TYPE_CHECKING:
    from collections.abc import Iterable

    from skyloop.client import Drone
    from skyloop.messages import Feedback


#: Name in the ``motioncapture`` package and default up axis of each system, by address scheme. For VRPN, Skyloop has
#: its own client.
SYSTEMS: Final = {
    "vicon": ("vicon", "z"),
    "optitrack": ("optitrack", "y"),  # by default, Motive streams data with y up
    "qualisys": ("qualisys", "z"),
    "vrpn": ("vrpn", "z"),
}
VRPN: Final = "vrpn"
SIM: Final = "sim"
OPTIONS: Final = {
    "up": "the up axis of the system's data: y or z",
    "latency": "age of a pose on arrival [s], from exposure to here",
    "interface": "address of the network interface that receives the multicast (OptiTrack)",
    "port": "port of the system's command channel (OptiTrack; default 1510)",
    "sensor": "zero-based number of the sensor to use for trackers whose names in bodies specify none (VRPN)",
}


@dataclass(frozen=True, slots=True)
class System:
    """The parsed address of a motion capture system."""

    address: str
    kind: str  #: name in the ``motioncapture`` package, or ``sim``
    host: str
    up: str = "z"
    latency_s: float = 0.0
    settings: tuple[tuple[str, str], ...] = ()  #: additional settings for the ``motioncapture`` package
    port: int | None = None  #: port that follows the host in the address
    sensor: int | None = None  #: sensor of VRPN trackers for bodies whose names specify none

    @property
    def configuration(self) -> dict[str, str]:
        """Connection settings for the ``motioncapture`` package."""
        host = self.host if self.port is None else f"{self.host}:{self.port}"
        return {"hostname": host, **dict(self.settings)}


def parse_system(address: str) -> System:
    """Parse the address of a motion capture system.

    Args:
        address: ``vicon://HOST``, ``optitrack://HOST?up=z``, ``qualisys://HOST``, ``vrpn://HOST?sensor=2`` or
            ``sim://``.

    Raises:
        UsageError: The address is malformed, or an option has an invalid value.
        UnknownNameError: There is no such system or option.
    """
    parts = urlsplit(address) if isinstance(address, str) else urlsplit("")
    if not parts.scheme or "://" not in address:
        raise UsageError(f"{address!r} is not a motion capture system: give one such as vicon://192.168.0.10 or sim://")
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    for name in options:
        if name not in OPTIONS:
            raise UnknownNameError(f"option of {parts.scheme}://", name, OPTIONS)
    if parts.scheme == SIM:
        if options or parts.netloc:
            raise UsageError(f"{address!r}: sim:// takes neither host nor options; the bodies name the drones")
        return System(address, SIM, "")
    if parts.scheme not in SYSTEMS:
        raise UnknownNameError("motion capture system", parts.scheme, [*SYSTEMS, SIM])
    if not parts.hostname:
        raise UsageError(f"{address!r} has no host: give {parts.scheme}://192.168.0.10")
    kind, up = SYSTEMS[parts.scheme]
    up = options.get("up", up)
    if up not in ("y", "z"):
        raise UsageError(f"{address!r}: up is {up!r} and must be y or z")
    settings = [("interface_ip", options["interface"])] if "interface" in options else []
    if command := _port(address, options):
        settings.append(("port_command", command))
    if settings and kind != "optitrack":
        raise UsageError(f"{address!r}: interface and port are for optitrack:// only")
    sensor = options.get("sensor")
    if sensor is not None and kind != VRPN:
        raise UsageError(f"{address!r}: sensor is for vrpn:// only")
    if sensor is not None and not (sensor.isascii() and sensor.isdigit() and len(sensor) <= 9):
        raise UsageError(f"{address!r}: sensor is {sensor!r} and must be a whole number from 0")
    if kind == VRPN and parts.path.strip("/"):
        raise UsageError(f"{address!r}: name the tracker in bodies, as {{'alpha': {parts.path.strip('/')!r}}}")
    port = _port_of_host(address, parts)
    if port is not None and kind == "optitrack":
        raise UsageError(f"{address!r}: give the port of OptiTrack's command channel as an option, ?port={port}")
    if port is not None and kind == "qualisys":  # the package adds this number to its base port
        settings.append(("port", str(port)))
        port = None
    latency_s = _latency(address, options)
    number = None if sensor is None else int(sensor)
    return System(address, kind, parts.hostname, up, latency_s, tuple(settings), port, number)


def _latency(address: str, options: dict[str, str]) -> float:
    text = options.get("latency", "0")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.0 <= value <= 1.0:
        raise UsageError(f"{address!r}: latency is {text!r} and must be from 0 to 1 second")
    return value


def _port_of_host(address: str, parts: SplitResult) -> int | None:
    """Return the port that follows the host, or None if the address contains no port."""
    try:
        return parts.port
    except ValueError:
        raise UsageError(f"{address!r}: the port must be a whole number from 1 to 65535") from None


def _port(address: str, options: dict[str, str]) -> str | None:
    text = options.get("port")
    if text is not None and not (text.isascii() and text.isdigit() and 1 <= int(text) <= 65535):
        raise UsageError(f"{address!r}: port is {text!r} and must be a whole number from 1 to 65535")
    return text


LENGTH: Final = struct.Struct("<I")
MAX_FRAME: Final = 1 << 20  #: maximum size of a frame in bytes; enough for thousands of bodies
MISSING: Final = 3  #: exit code if the package is missing

Seen = tuple[tuple[float, float, float], tuple[float, float, float, float]]


class RawFrame(msgspec.Struct, frozen=True, array_like=True):
    """The bodies seen by a system at a point in time, in the system's own axes."""

    received_ns: int  #: time of reception on this host's ``time.monotonic_ns`` clock
    bodies: dict[str, Seen]  #: position [m] and quaternion (x, y, z, w) of each tracked body


def read(stream: BinaryIO) -> RawFrame | None:
    """Read the next frame; return None at the end of the stream, and raise ``msgspec.DecodeError`` for invalid data."""
    head = stream.read(LENGTH.size)
    if len(head) < LENGTH.size:
        return None
    (size,) = LENGTH.unpack(head)
    if size > MAX_FRAME:
        raise msgspec.DecodeError(f"a frame of {size} bytes")
    data = stream.read(size)
    return None if len(data) < size else msgspec.msgpack.decode(data, type=RawFrame)


def write(stream: BinaryIO, frame: RawFrame) -> None:
    """Write a frame and flush the stream."""
    data = msgspec.msgpack.encode(frame)
    stream.write(LENGTH.pack(len(data)) + data)
    stream.flush()


def seen(bodies: Any) -> dict[str, Seen]:
    """Convert the package's bodies to plain numbers."""
    found: dict[str, Seen] = {}
    for name, body in bodies.items():
        x, y, z = (float(value) for value in body.position)
        turn = body.rotation
        found[name] = ((x, y, z), (float(turn.x), float(turn.y), float(turn.z), float(turn.w)))
    return found


def open_output() -> BinaryIO:
    """Reserve standard output for frames, and redirect what native code prints to standard error."""
    output = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    return output


def main(kind: str, settings: str) -> int:
    """Connect and write frames until the reader is gone; ``settings`` is a JSON object of arguments for ``connect``.

    Returns 0 once the reader is gone, :data:`MISSING` if the package is missing and 1 after any other error.
    """
    try:
        import motioncapture
    except ImportError as error:
        print(error, file=sys.stderr)
        return MISSING
    output = open_output()
    try:
        system = motioncapture.connect(kind, msgspec.json.decode(settings, type=dict[str, str]))
        while True:
            system.waitForNextFrame()
            write(output, RawFrame(time.monotonic_ns(), seen(system.rigidBodies)))
    except BrokenPipeError:
        return 0  # the reader is gone
    except Exception as error:  # noqa: BLE001  native code can raise anything
        print(error, file=sys.stderr)
        return 1


class TruthSource:
    """Observes the proxies of simulated drones and reads true poses from their native telemetry."""

    def __init__(self, proxies: Iterable[str], take: Callable[[RawFrame], None]) -> None:
        """Initialise without connecting; ``take`` is called with each frame, on the thread that receives feedback."""
        self._proxies = tuple(proxies)
        self._take = take
        self._open = ExitStack()

    def start(self, timeout_s: float) -> None:
        """Connect to all proxies; raise UnsupportedError if a vehicle does not report its true pose."""
        from skyloop.client import connect

        with ExitStack() as opening:
            for name in self._proxies:
                drone = opening.enter_context(
                    connect(name, access="observe", name="skyloop mocap", timeout_s=timeout_s)
                )
                if true_pose(drone.feedback()) is None:
                    raise UnsupportedError(f"{name} reports no true pose: start it with truth=1, as sim://?truth=1")
                opening.enter_context(drone.on_feedback(self._taking(name, drone), inline=True))
            self._open = opening.pop_all()

    def close(self) -> None:
        """Disconnect from all proxies. Idempotent."""
        self._open.close()

    def _taking(self, name: str, drone: Drone) -> Callable[[Feedback], None]:
        def take(feedback: Feedback) -> None:
            pose = true_pose(feedback)
            if pose is not None:
                self._take(RawFrame(feedback.captured_ns - drone.clock_offset_ns, {name: pose}))

        return take


def true_pose(feedback: Feedback) -> tuple[tuple[float, float, float], tuple[float, float, float, float]] | None:
    """Return the position [m] and quaternion (x, y, z, w) in the simulator's native telemetry; None if missing."""
    native = feedback.native or {}
    try:
        x, y, z, roll, pitch, yaw = (
            float(native[f"truth.{name}"])  # type: ignore[arg-type]
            for name in ("x", "y", "z", "roll", "pitch", "yaw")
        )
    except (KeyError, TypeError, ValueError):
        return None
    return (x, y, z), quaternion_from_euler(roll, pitch, yaw)


#: Command of the child process. If run with ``-m``, Python would warn that the module is already imported.
WORKER: Final = (
    sys.executable,
    "-c",
    "import sys; from skyloop.motion_capture.source import main; sys.exit(main(*sys.argv[1:]))",
)
AGAIN_S: Final = 0.5  #: delay before restarting a child process that ended
SILENT_S: Final = 3.0  #: time without frames after which a child is killed, because its system may have restarted
FIRST_S: Final = 10.0  #: the same limit while waiting for a child's first frame


class ChildSource:
    """Runs :func:`main` in a child process and forwards each frame on a separate thread.

    Until :meth:`close` is called, a child that ends or stops sending frames is replaced.
    """

    def __init__(
        self,
        system: System,
        take: Callable[[RawFrame], None],
        trouble: Callable[[str], None],
        *,
        command: tuple[str, ...] = WORKER,
    ) -> None:
        """Initialise without starting the child.

        ``take`` is called with each frame on the reading thread; ``trouble`` is called with a description if the child
        fails. The system's kind and settings are appended to the command.
        """
        self._system = system
        self._take = take
        self._trouble = trouble
        self._received_s = 0.0
        self._first = threading.Event()
        self._failed: Exception | None = None
        self._stderr_tail = ""  # end of the last child's standard error output
        settings = msgspec.json.encode(system.configuration).decode()
        self._runner = RestartingChild(
            [*command, system.kind, settings],
            name="skyloop-mocap",
            read=self._read,
            ended=self._child_ended,
            started=self._child_started,
            silent=lambda: time.monotonic() - self._received_s > SILENT_S,  # native code would wait forever
            keep_errors=True,
        )

    @property
    def pid(self) -> int | None:
        """Process ID of the current child; None before the first one."""
        return None if self._runner.child is None else self._runner.child.pid

    def start(self, timeout_s: float) -> None:
        """Start the child process and wait for its first frame."""
        self._runner.start()
        if not self._first.wait(timeout_s) or self._failed is not None:
            failed, stderr_tail = self._failed, self._stderr_tail
            self.close()
            raise failed or LinkError(f"{self._system.address} sent no frame within {timeout_s:g} s{stderr_tail}")

    def close(self) -> None:
        """Terminate the child process. Idempotent."""
        child = self._runner.request_stop()
        if child is not None:
            child.kill()  # native code does not read its standard input
        self._runner.stop()

    # --- threads ---

    def _child_started(self, _child: ChildProcess) -> None:
        self._received_s = time.monotonic() + FIRST_S - SILENT_S

    def _read(self, child: ChildProcess) -> None:
        try:
            while (frame := read(cast(BinaryIO, child.stdout))) is not None:
                self._received_s = time.monotonic()
                self._first.set()
                self._take(frame)
        except msgspec.DecodeError as error:
            self._trouble(f"{self._system.address}: {error}")
        finally:
            child.kill()

    def _child_ended(self, child: ChildProcess | None, ending: str) -> float | None:
        words = ending if child is None else child.stderr_tail
        self._stderr_tail = f": {words}" if words else ""
        if child is not None and child.code == MISSING:
            self._failed = MissingExtraError(f"{self._system.kind} motion capture", "mocap", cause=words)
            self._first.set()
            return None
        if not self._runner.stopping:
            self._trouble(f"no data from {self._system.address}{self._stderr_tail}; trying again")
        return AGAIN_S

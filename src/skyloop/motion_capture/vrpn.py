"""VRPN, the Virtual-Reality Peripheral Network, as a source of frames: protocol decoder and TCP client.

Server and client each send a 24-byte cookie that states the protocol version. Messages follow, each with a 24-byte
header and a payload padded to a multiple of 8 bytes. The length in the header includes the header and the payload
without padding. All numbers are big-endian.

======  =====  ====================================================================================
offset  type   meaning
======  =====  ====================================================================================
0       u32    length
4       u32    time of the report, seconds; then microseconds at 8
12      i32    sender: number of a tracker, from the server's descriptions
16      i32    type: number of a message type, from the server's descriptions; negative: protocol messages
20      u32    sequence number, for sniffers only
======  =====  ====================================================================================

A description (type -1 for a sender, -2 for a type) has the number in its sender field. Its payload is the name's length
(u32, including the final NUL) and the name. Poses have the type with the description ``vrpn_Tracker Pos_Quat``. Their
payload is the sensor (i32), 4 bytes of padding, the position x, y, z [m] and the quaternion x, y, z, w (7 doubles).

A client that never sends a UDP port receives everything over TCP.

Sources: ``Format_Of_Protocol.txt``, ``vrpn_Connection.C`` (``marshall_message``, ``check_vrpn_cookie``) and
``vrpn_Tracker.C`` (``encode_to``) of https://github.com/vrpn/vrpn (Boost licence).
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.errors import DecodeError, LinkError, UsageError
from skyloop.motion_capture.source import RawFrame, Seen, System

# The protocol's numbers, from the sources above.
DEFAULT_PORT: Final = 3883
COOKIE_SIZE: Final = 24
COOKIE: Final = b"vrpn: ver. 07.38  0".ljust(COOKIE_SIZE, b"\0")  #: the 0 asks the server not to log
SENDER_DESCRIPTION: Final = -1
TYPE_DESCRIPTION: Final = -2
DISCONNECT: Final = -5
POS_QUAT: Final = "vrpn_Tracker Pos_Quat"
MAX_PAYLOAD: Final = 64_000  #: maximum payload in bytes: the buffer size of the reference implementation
MAX_NAMES: Final = 2_000  #: maximum number of senders, and of types, as in the reference implementation
MAX_NAME: Final = 100  #: maximum size of a name in bytes, including the NUL

HEADER: Final = struct.Struct(">IIIiiI")
NAME_LENGTH: Final = struct.Struct(">I")
POSE: Final = struct.Struct(">ii7d")
_SAME_MAJOR: Final = COOKIE[: COOKIE.rindex(b".") + 1]  # servers of other major versions speak another protocol


@dataclass(frozen=True, slots=True)
class TrackerPose:
    """The pose of a tracker's sensor in the server's own axes, whose values can be NaN or infinite."""

    tracker: str
    sensor: int
    position: tuple[float, float, float]  #: x, y, z [m]
    quaternion: tuple[float, float, float, float]  #: rotation from the sensor's axes to the server's: x, y, z, w


class Decoder:
    """Decodes a server's stream, starting with the cookie, from pieces of any size.

    It stores at most one incomplete message and the names described by the server.
    """

    def __init__(self) -> None:
        self._pending = bytearray()
        self._greeted = False
        self._names: dict[int, dict[int, str]] = {SENDER_DESCRIPTION: {}, TYPE_DESCRIPTION: {}}

    def feed(self, data: bytes) -> list[TrackerPose]:
        """Decode the next bytes of the stream; return the poses completed by them, in the order sent.

        Raises DecodeError if the data is not VRPN or the server ends the connection; the decoder is then unusable.
        """
        self._pending += data
        if not self._greeted:
            if not _SAME_MAJOR.startswith(self._pending[: len(_SAME_MAJOR)]):
                raise DecodeError(
                    f"a VRPN server of version 7 begins with {_SAME_MAJOR!r}, got {bytes(self._pending[:16])!r}"
                )
            if len(self._pending) < COOKIE_SIZE:
                return []
            del self._pending[:COOKIE_SIZE]
            self._greeted = True
        poses: list[TrackerPose] = []
        at = 0
        while len(self._pending) - at >= HEADER.size:
            length, _, _, sender, kind, _ = HEADER.unpack_from(self._pending, at)
            if not HEADER.size <= length <= HEADER.size + MAX_PAYLOAD:
                raise DecodeError(
                    f"a VRPN message has from {HEADER.size} to {HEADER.size + MAX_PAYLOAD} bytes, got {length}"
                )
            end = at + length + -length % 8
            if end > len(self._pending):
                break
            pose = self._message(sender, kind, bytes(self._pending[at + HEADER.size : at + length]))
            if pose is not None:
                poses.append(pose)
            at = end
        del self._pending[:at]
        return poses

    def _message(self, sender: int, kind: int, payload: bytes) -> TrackerPose | None:
        if kind in self._names:
            names = self._names[kind]
            names[sender] = _decode_name(payload)
            if len(names) > MAX_NAMES:
                raise DecodeError(f"the VRPN server describes more than {MAX_NAMES} senders or types")
        elif kind == DISCONNECT:
            raise DecodeError("the VRPN server ends the connection")
        elif self._names[TYPE_DESCRIPTION].get(kind) == POS_QUAT and sender in self._names[SENDER_DESCRIPTION]:
            if len(payload) != POSE.size:
                raise DecodeError(f"a VRPN pose has {POSE.size} bytes, got {len(payload)}")
            sensor, _, *numbers = POSE.unpack(payload)
            x, y, z, qx, qy, qz, qw = numbers
            return TrackerPose(self._names[SENDER_DESCRIPTION][sender], sensor, (x, y, z), (qx, qy, qz, qw))
        return None


def _decode_name(payload: bytes) -> str:
    if len(payload) < NAME_LENGTH.size:
        raise DecodeError(f"a VRPN description has at least {NAME_LENGTH.size} bytes, got {len(payload)}")
    (length,) = NAME_LENGTH.unpack_from(payload)
    text = payload[NAME_LENGTH.size : NAME_LENGTH.size + length]
    if not 1 <= length <= MAX_NAME or len(text) < length:
        raise DecodeError(
            f"a name in a VRPN description has from 1 to {MAX_NAME} bytes, got {length} in {len(payload)} bytes"
        )
    name = text.partition(b"\0")[0].decode(errors="backslashreplace")
    return name if name.isprintable() else name.encode("unicode_escape").decode()


CONNECT_S: Final = 1.0  #: maximum time for a server to accept a connection
AGAIN_S: Final = 0.5  #: delay before trying to connect again
SILENT_S: Final = 3.0  #: time without poses after which a connection is dropped, because the server may have restarted
SETTLE_S: Final = 0.3  #: time to wait for other sensors of a tracker before using its sensor 0
POLL_S: Final = 0.1  #: interval at which an idle reader checks whether to stop
CHUNK: Final = 65_536  #: maximum number of bytes to receive at once
MAX_SENSORS: Final = 1_000  #: maximum number of sensors to remember per tracker


class SensorSelection:
    """Decides which sensor of which tracker belongs to which body. Pure; the time is passed in.

    The name of a body is ``TRACKER:SENSOR``, or ``TRACKER`` for the sensor specified in the address. If neither
    specifies a sensor, sensor 0 is used as long as no other sensor of that tracker has reported. Otherwise the choice
    is ambiguous, and the body has no pose.
    """

    def __init__(self, names: Iterable[str], sensor: int | None = None) -> None:
        """Initialise the selection; ``sensor`` is used for bodies whose names specify none."""
        self._bodies: dict[tuple[str, int], str] = {}
        self._unnamed: set[str] = set()  # trackers without a specified sensor
        self._reported: dict[str, tuple[int, set[int]]] = {}  # time of the first report and sensors seen
        for name in names:
            tracker, named = split_name(name)
            number = sensor if named is None else named
            if number is None:
                self._unnamed.add(tracker)
                number = 0
            if (tracker, number) in self._bodies:
                other = self._bodies[tracker, number]
                raise UsageError(f"bodies {other!r} and {name!r} are both sensor {number} of tracker {tracker!r}")
            self._bodies[tracker, number] = name
        self._wanted = set(self._bodies.values())

    def select(self, poses: Iterable[TrackerPose], now_ns: int) -> dict[str, Seen]:
        """Return the newest pose of each body, given poses in order of arrival; other bodies are ``TRACKER:SENSOR``."""
        poses = list(poses)
        for pose in poses:
            if pose.tracker in self._unnamed:
                _, sensors = self._reported.setdefault(pose.tracker, (now_ns, set()))
                if len(sensors) < MAX_SENSORS:
                    sensors.add(pose.sensor)
        found: dict[str, Seen] = {}
        for pose in poses:
            name = self._bodies.get((pose.tracker, pose.sensor))
            if name is None:
                name = f"{pose.tracker}:{pose.sensor}"
                if name in self._wanted:  # the name collides with that of another body
                    continue
            elif name in self._unnamed and not self._certain(name, now_ns):
                continue
            found[name] = (pose.position, pose.quaternion)
        return found

    def settled(self, now_ns: int) -> bool:
        """Return whether all reporting trackers have had time to reveal further sensors."""
        return all(now_ns - since_ns >= nanoseconds(SETTLE_S) for since_ns, _ in self._reported.values())

    @property
    def refused(self) -> dict[str, str]:
        """Trackers whose sensor must be specified but isn't, with the reason and a remedy."""
        return {
            tracker: f"tracker {tracker!r} reports {_listed(sensors)}, but which one to use is not specified: "
            f"name it in bodies, such as {f'{tracker}:{min(sensors)}'!r}, or add ?sensor={min(sensors)} to the address"
            for tracker, (_, sensors) in self._reported.items()
            if sensors != {0}
        }

    def _certain(self, tracker: str, now_ns: int) -> bool:
        since_ns, sensors = self._reported[tracker]
        return sensors == {0} and now_ns - since_ns >= nanoseconds(SETTLE_S)


class VrpnSource:
    """Receives data from a VRPN server and forwards each frame on a separate thread.

    Until :meth:`close` is called, a connection that ends, stops delivering poses or delivers data other than VRPN is
    replaced. A backlog in the socket counts as one frame with the newest pose of each body.
    """

    def __init__(
        self, system: System, names: Iterable[str], take: Callable[[RawFrame], None], trouble: Callable[[str], None]
    ) -> None:
        """Initialise without connecting; ``names`` have the form ``TRACKER`` or ``TRACKER:SENSOR``.

        On the reading thread, ``take`` is called with each frame and ``trouble`` with a description of each problem.
        """
        self._system = system
        self._selection = SensorSelection(names, system.sensor)
        self._take = take
        self._trouble = trouble
        self._refused: dict[str, str] = {}  # copy of the refused trackers for use by other threads
        self._failure = ""  # why the last connection ended
        self._ended = threading.Event()
        self._ready = threading.Event()  # set once poses have arrived or been refused
        self._reader = threading.Thread(target=self._run, name="skyloop-mocap", daemon=True)

    def start(self, timeout_s: float) -> None:
        """Connect and wait for the first frame; raise UsageError if the choice of a tracker's sensor is ambiguous."""
        self._reader.start()
        ready = self._ready.wait(timeout_s)
        if ready and not self._refused:
            return
        self.close()
        if self._refused:
            raise UsageError(f"{self._system.address}: {'; '.join(self._refused.values())}")
        raise LinkError(f"{self._system.address} sent no frame within {timeout_s:g} s{self._failure}")

    def close(self) -> None:
        """Close the connection. Idempotent."""
        self._ended.set()
        if self._reader.ident is not None and self._reader is not threading.current_thread():
            self._reader.join(CONNECT_S + 1.0)  # name lookups may take longer, but always end

    # --- reader thread ---

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                self._receive()
            except (OSError, UnicodeError, LinkError, DecodeError) as error:
                self._failure = f": {error}"
                if not self._ended.is_set():
                    self._trouble(f"no data from {self._system.address}{self._failure}; trying again")
            self._ended.wait(AGAIN_S)

    def _receive(self) -> None:
        """Receive data over one connection until it ends."""
        address = self._system.host, self._system.port or DEFAULT_PORT
        with socket.create_connection(address, CONNECT_S) as connection:
            connection.settimeout(POLL_S)
            connection.sendall(COOKIE)
            decoder = Decoder()
            last_s = time.monotonic()
            while not self._ended.is_set():
                if time.monotonic() - last_s > SILENT_S:
                    raise LinkError(f"it sent no pose for {SILENT_S:g} s")
                try:
                    data = connection.recv(CHUNK)
                except TimeoutError:
                    continue
                except ConnectionResetError:  # servers that exit with unread data reset the connection
                    data = b""
                received_ns = monotonic_ns()
                if not data:
                    raise LinkError("the server ended the connection")
                if poses := decoder.feed(data):
                    last_s = time.monotonic()
                    self._publish(poses, received_ns)

    def _publish(self, poses: list[TrackerPose], received_ns: int) -> None:
        bodies = self._selection.select(poses, received_ns)
        refused = self._selection.refused
        for tracker in refused.keys() - self._refused.keys():
            self._trouble(f"{self._system.address}: {refused[tracker]}")
        self._refused = refused
        if bodies and not self._ended.is_set():
            self._take(RawFrame(received_ns, bodies))
        if refused or (bodies and self._selection.settled(received_ns)):
            self._ready.set()


def split_name(name: str) -> tuple[str, int | None]:
    """Split a body's name into tracker and sensor; the sensor is None unless the name ends in a colon and a number."""
    tracker, _, number = name.rpartition(":")
    if tracker and number.isascii() and number.isdigit() and len(number) <= 9:
        return tracker, int(number)
    return name, None


def _listed(sensors: set[int]) -> str:
    shown = ", ".join(str(sensor) for sensor in sorted(sensors)[:16])
    return f"sensor{'s' if len(sensors) > 1 else ''} {shown}{', …' if len(sensors) > 16 else ''}"

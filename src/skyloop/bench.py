"""Measure delays on the user's machine, compared to a bare transfer of the same bytes, and the simulator's speed.

``skyloop bench`` prints the results. The developers' own measurements are in ``benchmarks/`` in the repository.
"""

from __future__ import annotations

import math
import mmap
import multiprocessing
import os
import platform
import re
import socket
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib import metadata
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from skyloop.child_process import ChildProcess
from skyloop.client import Drone, Frame, connect
from skyloop.client.video import VideoOptions
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.uri import parse_uri
from skyloop.errors import LinkError, NoAnswerError, UnsupportedError
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    CameraInfo,
    Capabilities,
    EncodedFrame,
    Feedback,
    FlightState,
    LinkState,
    Takeoff,
    Velocity,
)
from skyloop.messages.feedback import typical_feedback
from skyloop.platform import usable_cores
from skyloop.proxy import Proxy
from skyloop.transport.base import TransportServer
from skyloop.transport.local import LocalServer
from skyloop.transport.local.system import serving_side

if TYPE_CHECKING:
    from skyloop.sim import Simulation
    from skyloop.sim.camera import CameraModel
    from skyloop.sim.instruments import Readings

Image = NDArray[np.uint8]
Setpoint = tuple[float, float, float]  #: forward and left [m/s], yaw rate [rad/s]
#: Called for each received sample with its channel and the time at which it was sent [ns, monotonic].
Received = Callable[[str, int], None]
#: Called with the fraction done so far (0 to 1) and the name of the next measurement.
Progress = Callable[[float, str], None]

COMMAND: Final = "command"
FEEDBACK: Final = "feedback"
VIDEO: Final = "video"
#: The channels and their periods [s], from the paper's experiment (Mellado-Bataller et al., IAS-12, 2013).
PERIODS_S: Final = {COMMAND: 0.03125, FEEDBACK: 0.03125, VIDEO: 0.0667}
LARGEST: Final = (1920, 1080)  #: largest frame size [px]

_PACKAGES: Final = ("skyloop", "numpy", "msgspec", "opencv-python-headless")


# The machine, and distributions of times ---------------------------------------------------------------------------


class Machine(msgspec.Struct, frozen=True):
    """The machine on which the figures were measured, without anything that identifies it or its user."""

    cpu: str
    cores: int  #: number of cores available to this process
    system: str
    kernel: str
    python: str
    packages: dict[str, str] = {}  #: versions of packages
    load: float | None = None  #: load average over the preceding minute

    @classmethod
    def here(cls) -> Machine:
        """Describe this machine."""
        return cls(
            cpu=cpu_model(_read("/proc/cpuinfo")) or platform.machine(),
            cores=usable_cores(),
            system=f"{os_name(_read('/etc/os-release')) or platform.system()} {platform.machine()}",
            kernel=f"{platform.system()} {numbers_of(platform.release())}",
            python=platform.python_version(),
            packages={name: version for name in _PACKAGES if (version := _version(name))},
            load=round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None,
        )

    def __str__(self) -> str:
        busy = "" if self.load is None else f", load {self.load:.1f} before"
        return f"{self.cpu}, {self.cores} cores, {self.system}, {self.kernel}, Python {self.python}{busy}"


def cpu_model(cpuinfo: str) -> str:
    """Return the model name in ``/proc/cpuinfo``; empty if it contains none."""
    found = re.search(r"^model name\s*:\s*(.+)$", cpuinfo, re.MULTILINE)
    return " ".join(found[1].split()) if found else ""


def os_name(os_release: str) -> str:
    """Return the display name in ``/etc/os-release``; empty if it contains none."""
    found = re.search(r'^PRETTY_NAME="?([^"\n]+)"?$', os_release, re.MULTILINE)
    return found[1] if found else ""


def numbers_of(release: str) -> str:
    """Return a kernel's release without the builder's suffix, which may contain the name of a machine."""
    found = re.match(r"\d+(\.\d+)*", release)
    return found[0] if found else ""


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError:
        return ""


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


class Spread(msgspec.Struct, frozen=True):
    """A distribution of times in µs."""

    median_us: float
    p99_us: float
    samples: int


def spread(times_ns: Sequence[float]) -> Spread:
    """Compute the median and the 99th percentile of times. Raises ``ValueError`` if there are none."""
    if not times_ns:
        raise ValueError("not one sample arrived")
    values = np.asarray(times_ns, np.float64) / 1e3
    return Spread(float(np.median(values)), float(np.percentile(values, 99)), len(times_ns))


# Skyloop's two ends -------------------------------------------------------------------------------------------------

CAMERA: Final = "bench"
USUAL_CAMERA: Final = CameraInfo(CAMERA, 320, 240, 15.0)
_WRAPS_NS: Final = 1 << 40  # 18 minutes
_UNIT_M_S: Final = 2.0**-46  # climb rate per nanosecond; 2**40 ns correspond to less than 2 cm/s


def stamped(sent_ns: int) -> float:
    """Encode a time as a climb rate below 2 cm/s, which a command represents exactly and all limits allow."""
    return (sent_ns % _WRAPS_NS) * _UNIT_M_S


def stamp_of(up: float, now_ns: int) -> int:
    """Decode a time [ns] within the last 18 minutes that :func:`stamped` encoded as a climb rate [m/s]."""
    return now_ns - (now_ns - round(up / _UNIT_M_S)) % _WRAPS_NS


class BenchVehicle(Driver):
    """A vehicle that always hovers and produces feedback and frames on request, to measure Skyloop alone.

    ``received`` is called with each new set-point, on the thread that applies it.
    """

    shared = False

    def __init__(self, received: Received, camera: CameraInfo = USUAL_CAMERA) -> None:
        super().__init__(parse_uri("bench://"))
        self._camera = camera
        self._received = received
        self._last_up = 0.0

    def capabilities(self) -> Capabilities:
        return Capabilities("bench", frozenset(ACTION_NAMES.values()), (self._camera,))

    def _open(self, sink: Sink) -> None:
        sink.link(LinkState.UP)
        self.publish_feedback(time.monotonic_ns())

    def _close(self) -> None:
        """Do nothing: there are no resources to release."""

    def _apply(self, action: AnyAction) -> AnyAction:
        now_ns = time.monotonic_ns()
        if type(action) is Velocity and action.up != self._last_up:  # an equal value is a repeat
            self._last_up = action.up
            self._received(COMMAND, stamp_of(action.up, now_ns))
        return action

    def show(self, captured_ns: int, image: Image) -> None:
        if (sink := self._sink) is not None:
            height, width, _ = image.shape
            sink.frame(CAMERA, image, captured_ns, width=width, height=height)

    def publish_feedback(self, captured_ns: int) -> None:
        """Publish feedback that contains as many values as a real vehicle sends."""
        if (sink := self._sink) is not None:
            sink.feedback(typical_feedback(captured_ns, FlightState.HOVERING))


def proxy_name(folder: str) -> str:
    return Path(folder).name.lower()


class Vehicle:
    """The proxy's end; its name comes from this run's folder."""

    camera = USUAL_CAMERA

    def __init__(self, folder: str, received: Received) -> None:
        name, server = self._server(folder)
        self._vehicle = BenchVehicle(received, self.camera)
        self._proxy = Proxy(self._vehicle, server, name=name)
        self._proxy.start()

    def _server(self, folder: str) -> tuple[str, TransportServer]:
        name = proxy_name(folder)
        return name, LocalServer(name)

    def feedback(self, sent_ns: int) -> None:
        self._vehicle.publish_feedback(sent_ns)

    def frame(self, sent_ns: int, image: Image) -> None:
        """Send a frame, shape (height, width, 3)."""
        self._vehicle.show(sent_ns, image)

    def close(self) -> None:
        self._proxy.end()


class Listening:
    """Reports each feedback sample and each frame once, on the connection's receiving thread."""

    def __init__(self, received: Received) -> None:
        self._received = received
        self._known_ns = 0

    def feedback(self, feedback: Feedback) -> None:
        if feedback.captured_ns > self._known_ns:  # when the authority changes hands, the proxy repeats the last state
            self._known_ns = feedback.captured_ns
            self._received(FEEDBACK, feedback.captured_ns)

    def frame(self, frame: Frame) -> None:
        self._received(VIDEO, frame.captured_ns)

    def picture(self, picture: EncodedFrame) -> None:
        self._received(VIDEO, picture.captured_ns)


class Application:
    """The application's end, which has the user's drone; start :class:`Vehicle` first."""

    looks = True  #: whether to receive the video
    video = VideoOptions()  #: format of the video

    def __init__(self, folder: str, received: Received) -> None:
        self._drone = self._connect(folder)
        listening = Listening(received)
        self._drone.on_feedback(listening.feedback, inline=True)
        if self.looks:
            self._drone.on_frame(listening.frame, camera=CAMERA, inline=True, **self.video)

    def _connect(self, folder: str) -> Drone:
        return connect(proxy_name(folder), name="bench", on_exit="hover")

    def command(self, sent_ns: int, setpoint: Setpoint) -> None:
        forward, left, yaw_rate = setpoint
        self._drone.velocity(forward=forward, left=left, up=stamped(sent_ns), yaw_rate=yaw_rate)

    def close(self) -> None:
        self._drone.close()


# The bare connection ------------------------------------------------------------------------------------------------

_STAMP: Final = struct.Struct("<qqq")  # sending time, columns, rows
_PACKET: Final = struct.Struct("<qqq3d52x")  # a stamp of size 0, three numbers, and padding to 100 bytes as in Skyloop
_LINUX: Any = socket  # with what other systems lack, as their type checkers know
_MEMORY_BYTES: Final = LARGEST[0] * LARGEST[1] * 3


class BareVehicle:
    """A connection without Skyloop: the minimum that any Python library must do to transfer the same bytes.

    Uses one ``SOCK_SEQPACKET`` socket, with a waiting thread at each end. A packet has 100 bytes, including the time at
    which it is sent. A frame is copied into memory that both processes map. A packet of 24 bytes announces the frame,
    and the receiver creates an array over the memory. The arguments and methods are those of :class:`Vehicle`.
    """

    def __init__(self, folder: str, received: Received) -> None:
        self._path = Path(folder) / "floor"
        self._descriptor = cast("Any", os).memfd_create("skyloop-bench-floor")
        os.ftruncate(self._descriptor, _MEMORY_BYTES)
        self._memory = np.frombuffer(mmap.mmap(self._descriptor, _MEMORY_BYTES), np.uint8)
        self._memory[:] = 1  # map the pages in advance: Skyloop's slots also stay mapped after their first use
        self._listener = socket.socket(_LINUX.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(self._path))
        self._listener.listen(1)
        self._received = received
        self._socket: socket.socket
        self._thread = threading.Thread(target=self._receive, name="floor-receive", daemon=True)
        self._thread.start()

    def feedback(self, sent_ns: int) -> None:
        self._socket.send(_PACKET.pack(sent_ns, 0, 0, 0.1, 0.2, 0.3))

    def frame(self, sent_ns: int, image: Image) -> None:
        height, width, _ = image.shape
        np.copyto(self._memory[: image.size], image.reshape(-1))
        self._socket.send(_STAMP.pack(sent_ns, width, height))

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)  # wakes the thread if there is no connection yet
        self._thread.join()
        self._listener.close()
        self._path.unlink()
        os.close(self._descriptor)

    def _receive(self) -> None:
        try:
            self._socket, _ = self._listener.accept()
        except OSError:
            return  # closed before a connection was made
        with self._socket as sock:
            _LINUX.send_fds(sock, [b"memory"], [self._descriptor])
            while packet := sock.recv(256):
                self._received(COMMAND, _STAMP.unpack_from(packet)[0])


class BareApplication:
    """The other end of :class:`BareVehicle`; arguments and methods are those of :class:`Application`."""

    def __init__(self, folder: str, received: Received) -> None:
        self._socket = socket.socket(_LINUX.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.connect(str(Path(folder) / "floor"))
        _, (descriptor, *_), _, _ = _LINUX.recv_fds(self._socket, 16, 1)
        self._memory = mmap.mmap(descriptor, _MEMORY_BYTES, access=mmap.ACCESS_READ)
        os.close(descriptor)
        self._received = received
        self._thread = threading.Thread(target=self._receive, name="floor-receive", daemon=True)
        self._thread.start()

    def command(self, sent_ns: int, setpoint: Setpoint) -> None:
        self._socket.send(_PACKET.pack(sent_ns, 0, 0, *setpoint))

    def close(self) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def _receive(self) -> None:
        sock, memory, received = self._socket, self._memory, self._received
        while packet := sock.recv(256):
            sent_ns, width, height = _STAMP.unpack_from(packet)
            if width:
                np.frombuffer(memory, np.uint8, width * height * 3).reshape(height, width, 3)
                received(VIDEO, sent_ns)
            else:
                received(FEEDBACK, sent_ns)


# Delays -------------------------------------------------------------------------------------------------------------

SKYLOOP: Final = "skyloop"
BARE: Final = "bare hand-over"
_ENDS: Final[dict[str, tuple[Callable[..., Any], Callable[..., Any]]]] = {
    BARE: (BareVehicle, BareApplication),
    SKYLOOP: (Vehicle, Application),
}
_TURN_S: Final = 5.0  # duration of each measurement of each kind of connection
_WARM_UP_S: Final = 0.4  # start of a measurement that is not counted: it sets up threads, slots and the connection
_SETTLE_S: Final = 0.3  # time for the last samples of a measurement to arrive
_AHEAD_NS: Final = 50_000_000  # how far ahead the start is scheduled, so that both processes start together
_ANSWERS_WITHIN_S: Final = 30.0  # time limit for a process to answer after the measurement
_GOLDEN: Final = 0.618034  # its multiples modulo 1 are evenly spread, however many there are
_BOOT: Final = "import sys; from skyloop.bench import _run_end; _run_end(int(sys.argv[1]), *sys.argv[2:])"

#: Times at which each sample was sent and received [ns], grouped by channel.
_Arrivals = dict[str, list[tuple[int, int]]]


class _Turn(msgspec.Struct, frozen=True):
    """A measurement of all three channels at once; ``number`` varies the phases between the channels."""

    number: int
    seconds: float
    size: tuple[int, int]

    def count(self, channel: str) -> int:
        return max(1, int(self.seconds / PERIODS_S[channel]))

    def paced(self, channel: str, begin_ns: int) -> Iterator[int]:
        """Yield the number of each sample when it is due, starting with the warm-up; late samples delay no others."""
        period_ns = PERIODS_S[channel] * 1e9
        phase = list(PERIODS_S).index(channel) * (1 + self.number) * _GOLDEN % 1.0
        for index in range(-int(_WARM_UP_S / PERIODS_S[channel]), self.count(channel)):
            time.sleep(max(0, begin_ns + round((index + phase) * period_ns) - time.monotonic_ns()) / 1e9)
            yield index


class DelayRow(msgspec.Struct, frozen=True):
    """Results of one channel for frames of one size."""

    size: str  #: size of the frames, such as ``320×240``
    channel: str
    skyloop: Spread
    bare: Spread
    lost: int  #: number of samples that never reached Skyloop's receiver


class DelayResults(msgspec.Struct, frozen=True, tag_field="what", tag="delays"):
    """Results of a run. ``seconds`` is the duration of each measurement for each size."""

    machine: Machine
    seconds: float
    rows: list[DelayRow]
    transport: str = ""  #: side of the local transport that was measured: fast or portable


def measure_delays(
    seconds: float, sizes: Sequence[tuple[int, int]], progress: Progress = lambda _share, _what: None
) -> DelayResults:
    """Measure Skyloop and a bare connection in turn, each between two processes.

    Each measurement takes ``seconds`` for each frame size (width and height, at most :data:`LARGEST`). Raises
    :class:`LinkError` if the processes do not find each other, or if nothing arrives, and :class:`UnsupportedError` on
    systems without the sockets of the bare connection.
    """
    if not hasattr(socket, "send_fds"):
        raise UnsupportedError("the delays are measured next to a bare connection that needs Linux; try: bench sim")
    machine, rounds = Machine.here(), max(1, round(seconds / _TURN_S))
    turns = [_Turn(number, seconds / rounds, size) for number in range(rounds) for size in sizes]
    found: dict[tuple[str, tuple[int, int], str], list[int]] = {}
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-"))
        pairs = {kind: stack.enter_context(_Pair(kind, folder)) for kind in _ENDS}
        for number, turn in enumerate(turns):
            for index, (kind, pair) in enumerate(pairs.items()):
                progress((number + index / len(pairs)) / len(turns), f"{kind}, {named(turn.size)}")
                for channel, delays_ns in pair.measure(turn).items():
                    found.setdefault((kind, turn.size, channel), []).extend(delays_ns)
    rows = []
    for size in sizes:
        sent = {channel: sum(turn.count(channel) for turn in turns if turn.size == size) for channel in PERIODS_S}
        for channel in PERIODS_S:
            ours, bare = (found[kind, size, channel] for kind in (SKYLOOP, BARE))
            if not ours or not bare:
                raise LinkError(f"not one sample of {channel} with frames of {named(size)} arrived")
            rows.append(DelayRow(named(size), channel, spread(ours), spread(bare), max(0, sent[channel] - len(ours))))
    return DelayResults(machine, seconds, rows, serving_side())


def named(size: tuple[int, int]) -> str:
    """Return a frame size for display."""
    return "×".join(map(str, size))


class _Pair:
    """The two processes of one kind of connection."""

    def __init__(self, kind: str, folder: str) -> None:
        self._kind = kind
        self._pipes: list[Any] = []  # connections
        self._processes: list[ChildProcess] = []
        for side in ("vehicle", "application"):
            ours, theirs = multiprocessing.Pipe()
            with theirs:
                number = theirs.fileno()
                command = [sys.executable, "-c", _BOOT, str(number), kind, side, folder]
                self._processes.append(ChildProcess(command, keep_errors=False, inherited=[number]))
            self._pipes.append(ours)

    def measure(self, turn: _Turn) -> dict[str, list[int]]:
        """Return the delays of the samples received in a measurement [ns], by channel."""
        for pipe in self._pipes:  # the vehicle must start first
            pipe.send(turn)
            self._answer(pipe)
        begin_ns = time.monotonic_ns() + round(_WARM_UP_S * 1e9) + _AHEAD_NS
        for pipe in self._pipes:
            pipe.send(begin_ns)
        delays_ns: dict[str, list[int]] = {channel: [] for channel in PERIODS_S}
        for pipe in reversed(self._pipes):
            arrivals: _Arrivals = self._answer(pipe, turn.seconds)
            for channel, pairs in arrivals.items():
                delays_ns[channel] += [received - sent for sent, received in pairs if sent >= begin_ns]
        return delays_ns

    def _answer(self, pipe: Connection, later_s: float = 0.0) -> Any:
        if not pipe.poll(_ANSWERS_WITHIN_S + later_s):
            raise NoAnswerError(f"a measuring process of {self._kind} did not answer")
        try:
            return pipe.recv()
        except (EOFError, ConnectionResetError):
            raise LinkError(f"a measuring process of {self._kind} ended; see its error above") from None

    def __enter__(self) -> _Pair:
        return self

    def __exit__(self, *_: object) -> None:
        for pipe in self._pipes:
            pipe.close()  # causes the process to exit
        for process in self._processes:
            process.close()


def _run_end(number: int, kind: str, side: str, folder: str) -> None:
    """Run one end of a measured connection until its pipe closes. This is the main function of a process."""
    make, work = _ENDS[kind][side == "application"], _WORK[side]
    with Connection(number) as pipe, suppress(KeyboardInterrupt, EOFError, BrokenPipeError):
        while True:
            turn: _Turn = pipe.recv()
            arrivals: _Arrivals = {}

            def received(channel: str, sent_ns: int, arrivals: _Arrivals = arrivals) -> None:
                now_ns = time.monotonic_ns()
                arrivals.setdefault(channel, []).append((sent_ns, now_ns))

            end = make(folder, received)
            try:
                pipe.send("open")
                work(end, turn, pipe.recv())
                time.sleep(_SETTLE_S)
            finally:
                end.close()
            pipe.send(arrivals)


def _produce(end: Vehicle, turn: _Turn, begin_ns: int) -> None:
    """Send feedback from one thread and frames from another, as drivers do."""

    def publish() -> None:
        for _ in turn.paced(FEEDBACK, begin_ns):
            end.feedback(time.monotonic_ns())

    publisher = threading.Thread(target=publish, name="bench-feedback", daemon=True)
    publisher.start()
    width, height = turn.size
    image = np.random.default_rng(1).integers(0, 255, (height, width, 3), np.uint8)
    for _ in turn.paced(VIDEO, begin_ns):
        end.frame(time.monotonic_ns(), image)
    publisher.join()


def _steer(end: Application, turn: _Turn, begin_ns: int) -> None:
    """Send a series of set-points, each different from the others."""
    for index in turn.paced(COMMAND, begin_ns):
        speed, angle = 0.5 + 0.4 * math.sin(0.05 * index), 0.03 * index
        end.command(time.monotonic_ns(), (speed * math.cos(angle), speed * math.sin(angle), 0.3))


_WORK: Final[dict[str, Callable[[Any, _Turn, int], None]]] = {"vehicle": _produce, "application": _steer}


# The simulator ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class BenchFleet:
    """Drones in a world: their number, their model, and whether firmware that reads all instruments flies them."""

    world: str
    drones: int
    model: str = "quadrotor"
    firmware: bool = False


#: The fleets to measure: drones in free flight in an open hall; a hundred drones crowded among gates, some of them
#: touching the gates; and drones modelled down to their rotors in steps of a millisecond, one with all instruments.
FLEETS: Final = (
    BenchFleet("empty", 1),
    BenchFleet("empty", 10),
    BenchFleet("empty", 100),
    BenchFleet("gates", 100),
    BenchFleet("empty", 1, "racer", firmware=True),
    BenchFleet("street", 1, "racer", firmware=True),
    BenchFleet("empty", 100, "crazyflie"),
)
SIZES: Final = (1.0, 2.0)  #: factors for the image width: 1 is the cameras' own size, 2 is twice as wide
CAMERAS_AT_ONCE: Final = 10  #: number of drones that see each other, each with its front camera
DRAWING_WORLD: Final = "room"  #: a furnished room with markers and a moving board
FRAMES_PER_S: Final = 30.0  #: frame rate of each camera; the drones fly for one period between images
#: Number of steps per batch: a multiple of all periods, which makes every batch do the same work.
BATCH_STEPS: Final = 100
LEAST_ROUNDS: Final = 3  #: minimum number of rounds, even if little time is available
_TAKE_OFF_S: Final = 5.0  # simulated time before a measurement begins
#: The drone flies circles with a radius of half a metre, fast enough for rotation to blur the front camera's images.
_CIRCLING: Final = Velocity(forward=0.5, yaw_rate=1.0)


class PhysicsRow(msgspec.Struct, frozen=True):
    """Results for drones that fly circles, or that firmware flies straight up and down, without rendering.

    ``step`` is the time per step, measured over batches of :data:`BATCH_STEPS`.
    """

    world: str
    drones: int
    step: Spread
    real_time: float  #: simulated seconds per second of real time
    model: str = "quadrotor"
    firmware: bool = False


class DrawingRow(msgspec.Struct, frozen=True):
    """Results for rendering, including the sensor's flaws. ``round`` is the time for ``pictures`` images."""

    cameras: str
    width: int
    height: int
    pictures: int
    round: Spread
    frames_per_s: float


class SimResults(msgspec.Struct, frozen=True):
    """The results of a run."""

    machine: Machine
    physics: list[PhysicsRow]
    drawing: list[DrawingRow]


def measure_sim(seconds: float, progress: Progress = lambda _share, _what: None) -> SimResults:
    """Measure physics and rendering for about ``seconds`` on the calling thread; OpenCV uses only that thread.

    Building the scenes takes additional time. If Numba is installed, compiled code renders even the first image.
    """
    from skyloop.sim.render.compiled import COMPILER

    parts = len(FLEETS) + len(SIZES) + 1
    share_s = seconds / parts
    physics: list[PhysicsRow] = []
    drawing: list[DrawingRow] = []

    def part(number: int, what: str) -> Callable[[float], None]:
        return lambda share: progress((number + share) / parts, what)

    COMPILER.start().join()
    with _one_core():
        for number, fleet in enumerate(FLEETS):
            physics.append(_measure_physics(fleet, share_s, part(number, f"{fleet.drones} in {fleet.world}")))
        for number, factor in enumerate(SIZES, len(FLEETS)):
            drawing += _measure_pair(factor, share_s, part(number, "drawing"))
        drawing.append(_measure_many(share_s, part(parts - 1, f"{CAMERAS_AT_ONCE} cameras")))
    return SimResults(Machine.here(), physics, drawing)


def _measure_physics(fleet: BenchFleet, seconds: float, progress: Callable[[float], None]) -> PhysicsRow:
    from skyloop.sim import STEP_S

    simulation = _flown_by_firmware(fleet) if fleet.firmware else _circling(fleet.world, fleet.drones, fleet.model)
    batches: list[int] = []
    for _ in rounds(seconds, progress):
        begin = time.perf_counter_ns()
        simulation.step(BATCH_STEPS)
        batches.append(time.perf_counter_ns() - begin)
    real_time = len(batches) * BATCH_STEPS * STEP_S / (sum(batches) * 1e-9)
    step = spread([ns / BATCH_STEPS for ns in batches])
    return PhysicsRow(fleet.world, fleet.drones, step, real_time, fleet.model, fleet.firmware)


def _measure_pair(factor: float, seconds: float, progress: Callable[[float], None]) -> list[DrawingRow]:
    """Render a drone's two cameras in turn; images are ``factor`` times as wide as the cameras' own."""
    from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA

    models = [FRONT_CAMERA.scaled(factor), BOTTOM_CAMERA.scaled(factor)]
    flight = BenchFlight(1, [(0, model) for model in models])
    pairs = [(flight.draw(0), flight.draw(1)) for _ in rounds(seconds, progress)]
    front, bottom = ([pair[n] for pair in pairs] for n in (0, 1))
    return [
        _drawing_row("front", models[0], 1, front),
        _drawing_row("bottom", models[1], 1, bottom),
        _drawing_row("front and bottom", models[0], 2, [sum(pair) for pair in pairs]),
    ]


def _measure_many(seconds: float, progress: Callable[[float], None]) -> DrawingRow:
    """Render the front cameras of drones that see each other."""
    from skyloop.sim.camera import FRONT_CAMERA

    flight = BenchFlight(CAMERAS_AT_ONCE, [(drone, FRONT_CAMERA) for drone in range(CAMERAS_AT_ONCE)])
    times = [sum(flight.draw(n) for n in range(CAMERAS_AT_ONCE)) for _ in rounds(seconds, progress)]
    return _drawing_row(f"{CAMERAS_AT_ONCE} × front", FRONT_CAMERA, CAMERAS_AT_ONCE, times)


def _drawing_row(cameras: str, model: CameraModel, pictures: int, times: list[int]) -> DrawingRow:
    rate = pictures * len(times) / (sum(times) * 1e-9)
    return DrawingRow(cameras, model.width, model.height, pictures, spread(times), rate)


class BenchFlight:
    """Drones that fly circles in the furnished room, with cameras that take turns capturing images."""

    def __init__(self, drones: int, cameras: list[tuple[int, CameraModel]]) -> None:
        from skyloop.sim import STEP_S
        from skyloop.sim.render import PlanarRenderer, Scene, SensorEffects

        self._simulation = _circling(DRAWING_WORLD, drones)
        self._renderer = PlanarRenderer(Scene(self._simulation.world, drones))
        self._cameras = [(drone, model, SensorEffects(model, n)) for n, (drone, model) in enumerate(cameras)]
        self._steps = max(1, math.floor(1.0 / (FRAMES_PER_S * STEP_S * len(cameras))))
        self._number = 0
        self.picture: Image = np.empty(0, np.uint8)  #: last image, BGR, shape (height, width, 3)
        for at in range(len(cameras)):
            self.draw(at)  # the first image of each lens also computes its tables

    def draw(self, at: int) -> int:
        """Advance the flight, then render a camera's view with its sensor's flaws; return the time this took [ns]."""
        from skyloop.sim.render import SceneState

        simulation, (drone, model, effects) = self._simulation, self._cameras[at]
        simulation.step(self._steps)
        positions, rotations = simulation.poses()
        rates = np.array(simulation.truth(drone).angular_velocity_rad_s)
        targets = simulation.target_states()
        self._number += 1
        begin = time.perf_counter_ns()
        state = SceneState(positions, rotations, targets)
        pose = model.pose(positions[drone], rotations[drone], drone)
        self.picture = effects.apply(self._renderer.render(state, pose, model), self._number, rates)
        return time.perf_counter_ns() - begin


class _Hops:
    """Firmware that makes a drone hop. Simulating all sensors for it takes time; its own computation does not."""

    def exchange(self, readings: Readings) -> tuple[float, ...]:
        """Return high rotor commands near the ground and low ones above 0.5 m."""
        thrust = 0.6 if (readings.range_m or 0.0) < 0.5 else 0.2
        return (thrust,) * 4


def _flown_by_firmware(fleet: BenchFleet) -> Simulation:
    from skyloop.sim import Simulation, load_world
    from skyloop.sim.vehicles import VEHICLES

    simulation = Simulation(load_world(fleet.world), fleet.drones, seed=1, parameters=VEHICLES[fleet.model])
    for drone in range(fleet.drones):
        simulation.fly_by(drone, _Hops())
    return simulation


def _circling(world: str, drones: int, model: str = "quadrotor") -> Simulation:
    """Create a world with drones that have taken off and fly circles."""
    from skyloop.sim import STEP_S, Simulation, load_world
    from skyloop.sim.vehicles import VEHICLES

    simulation = Simulation(load_world(world), drones, seed=1, parameters=VEHICLES[model])
    for action in (Takeoff(), _CIRCLING):
        for drone in range(drones):
            simulation.command(drone, action)
        simulation.step(round(_TAKE_OFF_S / STEP_S))
    return simulation


def rounds(seconds: float, progress: Callable[[float], None]) -> Iterator[None]:
    """Yield until the time is up, but at least :data:`LEAST_ROUNDS` times."""
    begin, limit = time.perf_counter_ns(), round(seconds * 1e9)
    done = 0
    while done < LEAST_ROUNDS or time.perf_counter_ns() - begin < limit:
        yield
        done += 1
        progress(min(1.0, (time.perf_counter_ns() - begin) / max(1, limit)))


@contextmanager
def _one_core() -> Iterator[None]:
    """Limit OpenCV to the calling thread; afterwards, restore its number of threads."""
    from skyloop.sim.render import use_one_core
    from skyloop.sim.render.quads import cv2

    before = cv2.getNumThreads()
    use_one_core()
    try:
        yield
    finally:
        cv2.setNumThreads(before)

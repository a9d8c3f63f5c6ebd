# Made by scripts/aio_stub.py (`make stubs`) of bridge.py and of the synchronous classes.

from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from skyloop import client
from skyloop.aio.bridge import Callback as Callback, Opening, T
from skyloop.client.authority import Authority, AuthorityStatus, TakeoverAnswer, TakeoverRequest, TakeoverWay
from skyloop.client.connect import ConnectOptions, NetworkChoice
from skyloop.client.drone import Access
from skyloop.client.frame import Arrival, Frame
from skyloop.client.monitoring import ChannelStats, Distribution
from skyloop.client.piloting import OnExit
from skyloop.client.preflight import PreflightFinding
from skyloop.client.results import Result
from skyloop.client.swarm import Missing, OnError, Target, Tick
from skyloop.client.telemetry import LinkStatus, Wanted
from skyloop.client.video import VideoOptions
from skyloop.messages import (
    Annotation,
    AnyAction,
    Applied,
    Capabilities,
    EncodedFrame,
    Event,
    EventKind,
    Feedback,
    LogEntry,
    Overview,
    Parameter,
    Severity,
    Value,
    Vector,
)
from skyloop.messages.relayed import Shape
from types import TracebackType
from typing import Any, Unpack

__all__ = ["Callback", "Config", "Drone", "Listener", "Swarm", "connect", "swarm"]

class Config:
    """Parameters: ``await drone.config.get("limits.tilt")``, ``await drone.config.set("limits.tilt", 0.2)``.

    Writing needs the authority. See :class:`skyloop.client.Config` for what becomes of values that were written.
    """

    sync: client.Config
    def __init__(self, sync: client.Config) -> None:
        """Wrap parameters of a connected drone."""
    async def get(self, name: str) -> Value:
        """Return the present value.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Raises:
            UnknownNameError: If there is no such parameter; carries suggestions.
        """
    async def set(self, name: str, value: object) -> None:
        """Write one value.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Raises:
            ParameterError: If the proxy refuses it, with its reason.
            AuthorityError: If the authority is not held.
            UnknownNameError: If there is no such parameter; carries suggestions.
            UsageError: If the value is of no type that a parameter can have.
            LinkError: If the link broke before the answer and the parameter is momentary: once may have been enough.
        """
    async def items(self) -> list[tuple[str, Value]]:
        """Return (name, value) of all parameters, sorted by name.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.
        """
    async def values(self) -> list[Value]:
        """Return the values of all parameters, sorted by name.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.
        """
    async def parameters(self) -> list[Parameter]:
        """Return all parameters, sorted by name.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.
        """
    async def describe(self, name: str) -> Parameter:
        """Return all that is known of a parameter: type, unit, range, default, value, description.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Raises:
            UnknownNameError: If there is no such parameter; carries suggestions.
        """

class Drone:
    """A connected vehicle, made by :func:`connect`.

    Methods have the names, arguments, results and errors of :class:`skyloop.Drone`; those that wait are coroutines.
    Callbacks, plain or coroutine functions, run on the event loop that was running when they were added. Those of
    images are plain functions on threads of their own, as work on images would block the event loop, and so is the
    predicate that :meth:`wait` is given.
    """

    sync: client.Drone
    config: Config
    def __init__(self, sync: client.Drone) -> None:
        """Wrap a connected drone."""
    async def __aenter__(self) -> Drone: ...
    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting."""
    @property
    def log(self) -> client.Logbook:
        """Publishes text and numbers beside the flight; see :class:`skyloop.client.Logbook`."""
    def frames(
        self, camera: str | None = None, *, timeout_s: float = 5.0, **how: Unpack[VideoOptions]
    ) -> AsyncIterator[client.Frame]:
        """Yield each newest frame until the drone is closed; a slow loop skips frames.

        A JPEG is decoded on another thread, while :meth:`frame` decodes on the event loop.

        Errors are raised by the first iteration, not by the call.

        Args:
            camera: Name of the camera; None: the vehicle's first.
            timeout_s: How long to wait for each frame [s].
            **how: ``max_fps``: at most so many frames a second. ``scale``: factor for width and height, above 0 and up
                to 1. ``part``: (k, n), only every n-th frame, for n workers with k from 0 that share them.
                ``encoding``: how frames travel over a network, ``"jpeg"`` (of ``quality`` 1 to 100, default 80),
                ``"h264"`` (of ``kbit_s`` kilobits a second; by default as much as the path carries, with smaller and
                fewer pictures where that is little) or ``"raw"``; on one host all travel raw. ``max_age_s``: what is
                older since its capture when its turn comes is left out, and counted as dropped.

        Raises:
            NoAnswerError: If no frame comes within ``timeout_s``.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            UsageError: If an option is out of range, or from an inline callback.
            ClosedError: If the drone was closed before.
        """
    def results(
        self, processor: str, *, max_age_s: float | None = None, timeout_s: float = 5.0
    ) -> AsyncIterator[client.Result]:
        """Yield each newest result of a processor until the drone is closed.

        A slow loop skips results; these and those that are too old are counted in :attr:`stats`. Errors are raised by
        the first iteration, not by the call.

        Args:
            processor: Name of the processor.
            max_age_s: Oldest age since the frame's capture that is accepted [s]; None: any.
            timeout_s: How long to wait for each result [s].

        Raises:
            NoAnswerError: If no result that is new enough comes in time.
            UsageError: If ``processor`` can't be a name, ``max_age_s`` is negative, or from an inline callback.
            ClosedError: If the drone was closed before.
        """
    async def close(self) -> None:
        """Release the authority, then end the connection, all threads and a private proxy.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Does not land, except that a private proxy lands what flies before it ends. Idempotent. Threads that wait for
        this drone get :class:`ClosedError`.
        """
    async def stats(self) -> dict[str, ChannelStats]:
        """Statistics by channel: ``command``, ``feedback``, ``video/<camera>``, ``results/<processor>``.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        The delay of ``command`` comes from the echoes of this application's commands while :meth:`on_command` has a
        callback. Otherwise the proxy is asked for the delay over all pilots, which waits up to 0.2 s.
        """
    async def preflight(self, *, video_s: float = 1.5, folder: str | Path | None = None) -> list[PreflightFinding]:
        """Return the checklist before a flight: what is as it should be, what is not, why it matters, what to do.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Asks the proxy for its parameters and, of each camera, for a picture. Nothing is flown, and no authority is
        needed.

        Args:
            video_s: How long to wait for pictures, in all [s]; 0: cameras are not checked.
            folder: Where recordings are to go: whether there is room for them; None: not checked.

        Raises:
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
    async def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> None:
        """Take off, then hover.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        While this waits, a take-off for which the vehicle is not ready yet is commanded again, twice a second. A call
        that fails, a time-out and Ctrl-C included, ends the take-off: the vehicle hovers if it is in the air, else it
        stays on the ground. Without ``wait`` a take-off that is refused is over.

        Args:
            wait: Wait until the vehicle hovers or flies; else only send the command.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If the vehicle does not hover in time; names its state and, if known, the reason.
            RefusedError: If the proxy refuses to take off in the present state; a failsafe, a lost link, a new lease or
                another command of this application ends it before it shows; the application lands the vehicle or stops
                its motors meanwhile; or it lands or disarms before it hovers, whoever made it.
            UnsupportedError: If the vehicle can't take off.
            LinkError: Without ``wait``, if the link is down; the vehicle does not take off later either.
            AuthorityError: If the authority is not held, or another application takes it over meanwhile.
            ClosedError: If the drone is closed.
            UsageError: If called with ``wait`` from an inline callback; nothing is sent.
        """
    async def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> None:
        """Land at the present position.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        While this waits, a landing that was ended by a failsafe, a lost link or a lost lease is commanded again. Where
        the vehicle's own link breaks the proxy goes on with the landing by itself, also if nobody waits.

        Args:
            wait: Wait until the vehicle has landed; else only send the command.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If the vehicle has not landed in time; names its state and, if known, the reason.
            RefusedError: If the proxy refuses to land in the present state.
            UnsupportedError: If the vehicle can't land.
            LinkError: Without ``wait``, if the link is down; the landing is sent all the same if it is back within half
                a second.
            AuthorityError: If the authority is not held, or another application takes it over meanwhile.
            ClosedError: If the drone is closed.
            UsageError: If called with ``wait`` from an inline callback; the landing is commanded all the same.
        """
    async def go_to(
        self,
        *,
        x: float | None = None,
        y: float | None = None,
        z: float | None = None,
        latitude_deg: float | None = None,
        longitude_deg: float | None = None,
        altitude_m: float | None = None,
        yaw: float | None = None,
        speed: float | None = None,
        wait: bool = True,
        timeout_s: float = 60.0,
        tolerance_m: float = 0.2,
        tolerance_rad: float = 0.15,
    ) -> None:
        """Fly straight to a place, and stay there.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        World axes are those of ``Feedback.position_m``. Where the vehicle knows its place on the earth
        (``Feedback.origin``), latitude and longitude may be given instead; they are converted when this is called.
        ArduPilot and PX4 fly there natively, elsewhere the proxy does it by velocity. Unlike a velocity it does not
        decay when the application falls silent: the vehicle stops there. The place is held until the next command, also
        after a time-out; after Ctrl-C, or a cancelled task, the vehicle hovers. Nothing keeps it away from obstacles.

        Args:
            x: East [m].
            y: North [m].
            z: Up [m].
            latitude_deg: [°], north positive; in place of x, y and z.
            longitude_deg: [°], east positive.
            altitude_m: Above mean sea level [m]; None: the present height.
            yaw: Counter-clockwise from x, turned to on the way [rad]; None: keep the present one.
            speed: Greatest speed on the way [m/s]; None: as fast as ``limits.speed`` and ``limits.climb`` allow, which
                hold in any case.
            wait: Wait until the vehicle is there and nearly at rest; else only send the command.
            timeout_s: How long to wait [s].
            tolerance_m: How far from the place is near enough [m].
            tolerance_rad: The same of ``yaw`` [rad].

        Raises:
            NoAnswerError: If the vehicle is not there in time; names its state and, if known, the reason.
            RefusedError: If the proxy refuses it, as where the position is not known, the place is outside of the
                safety box or in a no-fly zone, or a zone is in the way; or if a failsafe or another command ends it.
                Also if latitude and longitude are given and the vehicle does not report its place on the earth.
            UnsupportedError: If neither the vehicle nor its proxy can fly to a place.
            LinkError: Without ``wait``, if the link is down; the vehicle does not fly there later either.
            AuthorityError: If the authority is not held, or another application takes it over meanwhile.
            ClosedError: If the drone is closed.
            UsageError: If a number is not finite or makes no sense, or if called with ``wait`` from an inline callback;
                nothing is sent.
        """
    async def return_to_start(
        self, height_m: float | None = None, *, land: bool | None = None, wait: bool = True, timeout_s: float = 180.0
    ) -> None:
        """Fly back to where the vehicle took off, and land there or hover.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        It climbs straight up to a safe height if it is lower, kept below ``limits.altitude``, the ceiling of the room
        and the upper wall of the safety box, flies straight over its start (:attr:`start_position`) as :meth:`go_to`
        does, and lands. Any other command ends it, as do another pilot and a failsafe. Nothing keeps it away from
        obstacles.

        Args:
            height_m: Above the start, at least, on the way [m]; None: as the parameter ``return.height`` says.
            land: Land there, else hover above it; None: as the parameter ``return.land`` says.
            wait: Wait until it has landed, or hovers above its start; else only send the command.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If it is not over in time; names the vehicle's state and, if known, the reason.
            RefusedError: If the proxy refuses it, as where position or start are not known, the vehicle does not fly,
                or a no-fly zone is in the way; or if a failsafe or another command ends it.
            UnsupportedError: If neither the vehicle nor its proxy can fly to a place.
            LinkError: Without ``wait``, if the link is down; the vehicle does not return later either.
            AuthorityError: If the authority is not held, or another application takes it over meanwhile.
            ClosedError: If the drone is closed.
            UsageError: If an argument makes no sense, or if called with ``wait`` from an inline callback; nothing is
                sent.
        """
    async def request_authority(
        self,
        priority: int | None = None,
        *,
        wait_s: float = 0.0,
        for_s: float | None = None,
        takeover: TakeoverWay = "now",
        stay: bool = False,
    ) -> AuthorityStatus:
        """Ask for the authority and wait for it.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        A holder of lower priority is pre-empted at once, or with ``takeover="ask"`` asked first, and pre-empted when it
        agrees or after the proxy's ``authority.ask_s``. With ``"ask"`` a holder of the same or higher priority is asked
        too, and may decline. Once held the authority is kept: after a lost link it is requested again, and after a
        pre-emption it comes back when the other application releases it.

        Args:
            priority: 0 (highest) to 31 (lowest); None: as in the last request.
            wait_s: How long to wait in the queue [s].
            for_s: How long the authority is wanted [s], up to a day; then others can get it. None: open.
            takeover: ``"now"`` pre-empts a lower holder at once, ``"ask"`` asks the holder first.
            stay: Stay in the queue after ``wait_s`` instead of raising.

        Returns:
            The status: held, or with ``stay`` also queued, with the position and the expected wait.

        Raises:
            AuthorityError: If it is not held after ``wait_s`` (the message names the holder), if the proxy refuses it,
                or if this application only observes.
            NoAnswerError: If the proxy does not answer the request.
            UsageError: If ``priority``, ``for_s`` or ``takeover`` is out of range.
            ClosedError: If the drone was closed.
        """
    async def release_authority(self) -> None:
        """Release the authority, or leave the queue, and wait until the proxy has confirmed it.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Does nothing if the authority is neither held nor wanted.

        Raises:
            NoAnswerError: If the proxy does not answer.
            ClosedError: If the drone was closed.
        """
    async def next_feedback(self, timeout_s: float = 1.0, *, max_hz: float | None = None) -> Feedback:
        """Wait for feedback that was not read before, and return the newest.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Args:
            timeout_s: How long to wait [s].
            max_hz: As for :meth:`feedback`; samples that other consumers ask for are returned, too.

        Raises:
            NoAnswerError: If none comes in time.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback, or an option is out of range.
        """
    async def next_frame(self, camera: str | None = None, *, timeout_s: float = 1.0) -> Frame:
        """Wait for a frame that this method has not returned before, and return the newest.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        The first call subscribes to the camera, for good.

        Args:
            camera: Name of the camera; None: the vehicle's first.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If none comes in time.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
    async def wait(self, state: Wanted, timeout_s: float = 10.0) -> Feedback:
        """Wait until the newest feedback is as wanted.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Args:
            state: A flight state or its name, several of them, or a predicate on feedback, which is called on this
                thread.
            timeout_s: How long to wait [s].

        Returns:
            The feedback that met it.

        Raises:
            NoAnswerError: If it is not met in time; names the present state.
            UnknownNameError: If there is no flight state of that name.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
    async def overview(self, timeout_s: float = 2.0) -> Overview:
        """Return the newest overview of all vehicles that the proxy's process serves, a row each.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        It is sent once a second, and much smaller than feedback: for who watches many vehicles. The first call
        subscribes to it, for good, and waits for one.

        Args:
            timeout_s: How long to wait for the first one [s].

        Raises:
            NoAnswerError: If none comes in time, as from a proxy of an earlier version.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback before there is one.
        """
    @property
    def name(self) -> str:
        """Name of the proxy; empty before the first connection."""
    @property
    def uri(self) -> str:
        """Address of the vehicle; empty before the first connection."""
    @property
    def app_id(self) -> int:
        """Number of this application in this run of the proxy."""
    @property
    def capabilities(self) -> Capabilities:
        """Actions and cameras of the vehicle; ``vehicle`` is ``unknown`` before the first connection."""
    @property
    def authority(self) -> AuthorityStatus:
        """Current state of this application's authority."""
    @property
    def link(self) -> LinkStatus:
        """State of both hops, application to proxy and proxy to vehicle.

        ``reason`` is that of the last change or, while the proxy is lost, why the last attempt to reconnect failed.
        """
    @property
    def closed(self) -> bool:
        """Whether :meth:`close` was called."""
    @property
    def now_ns(self) -> int:
        """Estimate of the time on the proxy's clock [ns]; in a stepped replay, the time of the recorded flight."""
    @property
    def clock_offset_ns(self) -> int:
        """Estimate of the proxy's clock minus this process's clock [ns]."""
    @property
    def clock_uncertainty_ns(self) -> int:
        """Largest error of :attr:`clock_offset_ns` [ns], and so of each age and delay; 0 where both share one clock."""
    @property
    def start_position(self) -> Vector | None:
        """Where the vehicle took off last, east, north, up in world axes [m]; None where that is not known."""
    def age_s(self, sample: Feedback | Frame) -> float:
        """Return the time since the sample's capture [s], within ``clock_uncertainty_ns``."""
    def recent_events(self) -> list[Event]:
        """Return the last 256 events, oldest first."""
    def hover(self) -> bool:
        """Stop and hold the position. Returns and raises as every command; see :class:`Drone`."""
    def idle(self) -> bool:
        """Ask for nothing: keep the authority and leave the vehicle as it is."""
    def velocity(self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Fly with a velocity in the levelled body axes, which turn with the yaw but not with roll and pitch.

        Args:
            forward: Along x, forward [m/s].
            left: Along y, to the left [m/s].
            up: Along z, up [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].

        Returns:
            Whether it was handed to the transport now; see :class:`Drone` for this and for what is raised.
        """
    def attitude(self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Hold an attitude with a climb rate.

        Args:
            roll: Right side down is positive and accelerates to the right [rad].
            pitch: Nose down is positive and accelerates forward [rad].
            climb: Vertical velocity, up [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].

        Returns:
            Whether it was handed to the transport now; see :class:`Drone` for this and for what is raised.
        """
    def emergency_stop(self) -> bool:
        """Cut the motors at once: the vehicle falls.

        Needs no authority, only ``access="pilot"``. It is sent at once and repeated until the vehicle shows it
        (``FlightState.EMERGENCY``), or for 8 s: then it is given up, with an event (``vehicle_message``, reason
        ``stop_given_up``). Nothing else of this connection is sent meanwhile: :meth:`velocity`, :meth:`hover` and the
        like return False, :meth:`takeoff` and :meth:`land` raise :class:`RefusedError`. A program that flies over
        several connections has to silence the others itself. A stop that could not be sent for 2 s is not sent later.

        Returns:
            False if it can't be sent now, because the link is down.

        Raises:
            AuthorityError: If this application only observes.
            UnsupportedError: If the vehicle can't stop its motors, or takes no commands.
            ClosedError: If the drone was closed.
        """
    def reset_emergency(self) -> bool:
        """Leave the emergency state, on the ground.

        One that is asked for while a stop of this application has not shown is sent once it has, within 2 s.
        """
    def command(self, action: AnyAction) -> bool:
        """Make ``action`` the newest set-point.

        Returns:
            Whether it was handed to the transport now; see :class:`Drone` for this and for what is raised.
        """
    def send_external_pose(
        self,
        position: Vector,
        quaternion: tuple[float, float, float, float],
        *,
        at_ns: int | None = None,
        position_std_m: float | None = None,
        attitude_std_rad: float | None = None,
    ) -> bool:
        """Send the vehicle its own pose as measured from outside, for an autopilot that flies by it instead of GPS.

        May be called from any thread, does not wait, and needs no authority. A vehicle that takes no poses answers with
        an event (``command_refused``).

        Args:
            position: x east, y north, z up [m].
            quaternion: x, y, z, w of the rotation from body axes (x forward, y left, z up) to world axes.
            at_ns: When it was measured, on the proxy's clock [ns]; None: now.
            position_std_m: Standard deviation of the position [m], if known.
            attitude_std_rad: Standard deviation of the attitude [rad], if known.

        Returns:
            Whether it was handed to the transport.

        Raises:
            AuthorityError: If this application only observes.
            UsageError: If a number is missing or not finite, a standard deviation is negative, the quaternion's length
                differs from 1 by more than 0.001, or ``at_ns`` is out of range.
        """
    def emit(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: str) -> None:
        """Emit an event of this application's own (number 0), which only its own callbacks get.

        Args:
            kind: Kind of the event.
            text: What happened, for people.
            severity: How serious it is.
            **data: Details, by name.
        """
    def annotate(self, frame: Frame, shapes: Iterable[Shape], source: str | None = None) -> bool:
        """Publish shapes drawn over a frame, for the cockpit and for recordings.

        Args:
            frame: The frame that they belong to.
            shapes: Shapes in this frame's pixels; coordinates may be NumPy's.
            source: Name of what drew them; None: this application. The newest drawing of each source in each camera
                counts.

        Returns:
            Whether it was handed to the transport.

        Raises:
            UsageError: If something is no shape, there are too many, coordinates are not finite, or colours are not
                within 0 to 255.
        """
    def feedback(self, *, max_age_s: float | None = None, max_hz: float | None = None) -> Feedback:
        """Return the newest feedback.

        An observer is sent the least that gives each of its consumers what it asks for, and every sample whole while
        nobody asks for less; the first call of this method counts as a consumer, for good. A pilot is always sent all.

        Args:
            max_age_s: Oldest age since capture that is accepted [s]; None: any.
            max_hz: So many new samples a second are enough, 0.001 to 1000; None: all are wanted.

        Raises:
            NoAnswerError: If no feedback has come yet, or the newest is older than ``max_age_s``.
            ClosedError: If the drone was closed.
            UsageError: If ``max_hz`` is out of range.
        """
    def frame(self, camera: str | None = None, *, max_age_s: float | None = None) -> Frame | None:
        """Return the newest frame without waiting.

        The first call subscribes to the camera, for good.

        Args:
            camera: Name of the camera; None: the vehicle's first.
            max_age_s: Oldest age since capture that is accepted [s]; None: any.

        Returns:
            The frame; None if none has come yet, it is too old, or it can't be decoded.

        Raises:
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone was closed.
        """
    def result(self, processor: str, *, max_age_s: float | None = None) -> Result | None:
        """Return a processor's newest result without waiting.

        The first call subscribes to the processor, for good.

        Args:
            processor: Name of the processor.
            max_age_s: Oldest age since the frame's capture that is accepted [s]; None: any.

        Returns:
            The result; None if none has come yet or it is too old.

        Raises:
            UsageError: If ``processor`` can't be a name or ``max_age_s`` is negative.
            ClosedError: If the drone was closed.
        """
    def on_frame(
        self,
        function: Callable[[Frame], object],
        camera: str | None = None,
        *,
        depth: int = 1,
        inline: bool = False,
        **how: Unpack[VideoOptions],
    ) -> client.Listener[Arrival]:
        """Call ``function`` with the newest frame of a camera.

        Args:
            function: Called on a thread of its own with the newest ``depth`` frames that it has not seen.
            camera: Name of the camera; None: the vehicle's first, also once its proxy is started again with others.
            depth: How many frames may wait, at least 1; older ones are dropped and counted.
            inline: Call it on the receiving thread instead, with every frame. It must be quick and must not wait.
            **how: As for :meth:`frames`.

        Returns:
            The listener; ``cancel()`` ends it.

        Raises:
            UsageError: If ``function`` can't be called or an option is out of range.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone was closed.
        """
    def on_encoded(
        self,
        function: Callable[[EncodedFrame], object],
        camera: str | None = None,
        *,
        kbit_s: int | None = None,
        max_fps: float | None = None,
        scale: float = 1.0,
        depth: int = 30,
        inline: bool = False,
    ) -> client.Listener[EncodedFrame]:
        """Call ``function`` with a camera's pictures as they are encoded, to store them or to send them on.

        Each is an access unit of H.264 in Annex B form that can be decoded after those before it; the first one is a
        key picture. After a missing one nothing is given up to the next key picture, which the proxy is asked for.
        Where ``kbit_s``, ``max_fps`` and ``scale`` are left out, pictures come as the vehicle encoded them; from a
        vehicle that sends no H.264, encoded by the proxy at the rate that the path carries.

        Args:
            function: Called on a thread of its own.
            camera: Name of the camera; None: the vehicle's first.
            kbit_s: Encoded by the proxy at this rate, once for all who ask for the same [kbit/s].
            max_fps: Most pictures a second; None: all.
            scale: Factor for width and height, above 0 and up to 1.
            depth: How many pictures may wait, at least 1; if more come, some are missing.
            inline: Call it on the receiving thread instead. It must be quick and must not wait.

        Returns:
            The listener; ``cancel()`` ends it.

        Raises:
            UsageError: If ``function`` can't be called or an option is out of range.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone was closed.
        """
    def on_takeover(
        self, function: Callable[[TakeoverRequest], TakeoverAnswer | Awaitable[TakeoverAnswer]]
    ) -> Listener:
        """Call ``function`` when another application asks for the authority that this one holds.

        ``function``, plain or a coroutine function, runs on the event loop.

        Args:
            function: Called on the event loop. It returns True to hand the authority over, False or a reason (a
                text) to decline, and None to leave the decision to the proxy. In any case a strictly higher priority
                wins after the proxy's ``authority.ask_s``.

        Returns:
            The listener; ``cancel()`` ends it.

        Raises:
            UsageError: If ``function`` can't be called.
            ClosedError: If the drone was closed.
        """
    def on_overview(
        self, function: Callable[[Overview], object | Awaitable[object]], *, inline: bool = False
    ) -> Listener:
        """Call ``function`` with each overview of all vehicles that the proxy's process serves; see :meth:`overview`.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` has to be False.

        Args:
            function: Called on the event loop, once a second.
            inline: Call it on the receiving thread instead.
        """
    def on_feedback(
        self,
        function: Callable[[Feedback], object | Awaitable[object]],
        *,
        inline: bool = False,
        max_hz: float | None = None,
    ) -> Listener:
        """Call ``function`` with the newest feedback.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` has to be False.

        Like every ``on_...`` method it returns a :class:`Listener`, whose ``cancel()`` ends it, and raises
        :class:`UsageError` if ``function`` can't be called and :class:`ClosedError` if the drone was closed.

        Args:
            function: Called on the event loop; feedback that newer feedback overtakes is dropped and counted.
            inline: Call it on the receiving thread instead, with every sample. It must be quick and must not wait.
            max_hz: At most so many samples a second, 0.001 to 1000; None: all. An observer is sent no more, unless
                another consumer asks for it.
        """
    def on_event(self, function: Callable[[Event], object | Awaitable[object]], *, inline: bool = False) -> Listener:
        """Call ``function`` with each event, including the client's own (number 0).

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` has to be False.

        Args:
            function: Called on the event loop; up to 256 events wait for it.
            inline: Call it on the receiving thread instead, or for the client's own events on the thread that emits
                them.
        """
    def on_link(self, function: Callable[[LinkStatus], object | Awaitable[object]]) -> Listener:
        """Call ``function``, on the event loop, whenever one of the two hops changes its state; up to 256 wait.

        ``function``, plain or a coroutine function, runs on the event loop.
        """
    def on_command(
        self, function: Callable[[Applied], object | Awaitable[object]], *, inline: bool = False
    ) -> Listener:
        """Call ``function`` with what the proxy made of each command of any application.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` has to be False.

        Args:
            function: Called on the event loop; up to 256 wait for it.
            inline: Call it on the receiving thread instead.
        """
    def on_annotation(
        self, function: Callable[[Annotation], object | Awaitable[object]], *, inline: bool = False
    ) -> Listener:
        """Call ``function`` with what any application draws on a frame.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` has to be False.

        Args:
            function: Called on the event loop; up to 256 wait for it.
            inline: Call it on the receiving thread instead.
        """
    def on_log(self, function: Callable[[LogEntry], object | Awaitable[object]], *, inline: bool = False) -> Listener:
        """Call ``function`` with what any application logs, this one included (see ``drone.log``).

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` has to be False.

        Args:
            function: Called on the event loop; up to 256 entries wait for it.
            inline: Call it on the receiving thread instead.
        """
    def on_result(
        self,
        function: Callable[[Result], object | Awaitable[object]],
        processor: str | None = None,
        *,
        max_age_s: float | None = None,
        depth: int | None = None,
        inline: bool = False,
    ) -> Listener:
        """Call ``function`` with the results of one processor, or of all.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` has to be False.

        Args:
            function: Called on the event loop.
            processor: Name of the processor; None: all processors.
            max_age_s: Results older than this when their turn comes are left out, and counted in ``expired`` of the
                listener [s]; None: none are.
            depth: How many results may wait, at least 1; None: 1 for one processor, 256 for all.
            inline: Call it on the receiving thread instead. It must be quick and must not wait.

        Returns:
            The listener; ``cancel()`` ends it.

        Raises:
            UsageError: If ``function`` can't be called or another argument is out of range.
            ClosedError: If the drone was closed.
        """

class Listener:
    """A callback that runs on the event loop, one call at a time."""

    sync: client.Listener[Any]
    def __init__(self, sync: client.Listener[Any]) -> None:
        """Wrap a listener whose function hands over to the event loop."""
    def cancel(self) -> None:
        """Stop calling the function. Does not wait for a call that is under way."""
    @property
    def errors(self) -> int:
        """Calls that raised."""
    @property
    def delivered(self) -> int:
        """How often the function was called."""
    @property
    def dropped(self) -> int:
        """Samples that newer ones pushed out before the function was ready for them."""

class Swarm:
    """Drones by name, made by :func:`swarm`; ``drones["alpha"]`` is one :class:`Drone`, and iterating gives all.

    Methods have the names, arguments, results and errors of :class:`skyloop.Swarm`. All commands but
    :meth:`emergency_stop` are coroutines, and so is :meth:`feedback`: what ``on_error`` says may be a landing. One
    task at a time awaits them; :meth:`emergency_stop` may be called at any time.
    """

    sync: client.Swarm
    def __init__(self, sync: client.Swarm) -> None:
        """Wrap a connected swarm."""
    async def __aenter__(self) -> Swarm: ...
    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting."""
    @property
    def active(self) -> dict[str, Drone]:
        """Drones that commands go to, by name; see :attr:`skyloop.Swarm.active`."""
    def items(self) -> list[tuple[str, Drone]]:
        """Return (name, drone) of all drones, including those set aside."""
    def __getitem__(self, name: str) -> Drone: ...
    def __iter__(self) -> Iterator[Drone]: ...
    def __repr__(self) -> str: ...
    async def each(self, function: Callable[[Drone], Awaitable[T]], what: str = "") -> dict[str, T]:
        """Await ``function`` of all active drones at the same time, on this event loop. Cancelling it cancels them.

        Args:
            function: A coroutine function; what it raises counts as for :meth:`skyloop.Swarm.each`.
            what: Name of the action in the report of failures; empty: the function's.

        Returns:
            What it returned, by name.
        """
    def ticks(self, rate_hz: float = 20.0, seconds: float | None = None) -> AsyncIterator[Tick]:
        """Yield at a steady rate on absolute deadlines, for a loop that commands all drones.

        Ends with the swarm. After an iteration that takes longer than a period the deadlines restart from there. When
        the loop ends, by its time, a ``break``, an exception or Ctrl-C, drones that fly by a velocity or an attitude of
        it hover at once: nobody gives them a newer one.

        Args:
            rate_hz: Ticks a second, 0.1 to 200.
            seconds: For how long [s]; None: until the loop is left.

        Raises:
            UsageError: If ``rate_hz`` is out of range, at the first iteration.
        """
    async def close(self) -> None:
        """End all connections. Does not land. Idempotent.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.
        """
    async def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> None:
        """Take off with all active drones at the same time; see :meth:`Drone.takeoff`.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Args:
            wait: Wait until each hovers.
            timeout_s: How long to wait [s].

        Raises:
            SwarmError: As set by ``on_error``.
            ClosedError: If the swarm was closed.
        """
    async def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> None:
        """Land all active drones at their present positions, at the same time; see :meth:`Drone.land`.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Args:
            wait: Wait until each has landed.
            timeout_s: How long to wait [s].

        Raises:
            SwarmError: As set by ``on_error``.
            ClosedError: If the swarm was closed.
        """
    async def go_to(
        self,
        places: Mapping[str, Sequence[float]],
        *,
        speed: float | None = None,
        wait: bool = True,
        timeout_s: float = 60.0,
        tolerance_m: float = 0.2,
    ) -> None:
        """Fly each drone straight to its own place, all at the same time; see :meth:`Drone.go_to`.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Nothing keeps the drones apart on the way: :class:`skyloop.control.formation_flight.Formation` plans ways that
        do. Drones that are set aside are left out.

        Args:
            places: By name of the drone: x, y, z in its world axes [m], and if wanted the yaw [rad].
            speed: Greatest speed on the way [m/s]; None: as fast as the limits allow.
            wait: Wait until each is there; else only send the commands.
            timeout_s: How long to wait [s].
            tolerance_m: How far from its place is near enough [m].

        Raises:
            UnknownNameError: If no drone of the swarm has one of the names; nothing is sent then.
            UsageError: If a place can't be flown to; nothing is sent then.
            SwarmError: As set by ``on_error``.
            ClosedError: If the swarm was closed.
        """
    async def return_to_start(
        self, height_m: float | None = None, *, land: bool | None = None, wait: bool = True, timeout_s: float = 180.0
    ) -> None:
        """Fly all active drones back to where each took off, all at the same time; see :meth:`Drone.return_to_start`.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Nothing keeps the drones apart on the way.

        Args:
            height_m: Above the start, at least, on the way [m]; None: as each drone's ``return.height`` says.
            land: Land there, else hover above it; None: as each drone's ``return.land`` says.
            wait: Wait until each has landed, or hovers above its start; else only send the commands.
            timeout_s: How long to wait [s].

        Raises:
            UsageError: If an argument makes no sense; nothing is sent then.
            SwarmError: As set by ``on_error``.
            ClosedError: If the swarm was closed.
        """
    async def hover(self) -> dict[str, bool]:
        """Stop and hold the position, with all active drones.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        One that others fly is left to them: only its own ``drones[name].hover()`` takes it back.
        """
    async def idle(self) -> dict[str, bool]:
        """Ask for nothing: keep the authority and leave the vehicles as they are.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.
        """
    async def velocity(
        self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0
    ) -> dict[str, bool]:
        """Fly with the same velocity, each drone in its own levelled body axes.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Args:
            forward: Along x, forward [m/s].
            left: Along y, to the left [m/s].
            up: Along z, up [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].
        """
    async def attitude(
        self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0
    ) -> dict[str, bool]:
        """Hold the same attitude with all active drones; see :meth:`Drone.attitude`.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Args:
            roll: Right side down is positive [rad].
            pitch: Nose down is positive [rad].
            climb: Vertical velocity, up [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].
        """
    async def reset_emergency(self) -> dict[str, bool]:
        """Leave the emergency state, on the ground, with all active drones.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.
        """
    async def command(self, action: AnyAction) -> dict[str, bool]:
        """Make ``action`` the newest set-point of all active drones; see :meth:`send`.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.
        """
    async def send(self, actions: Mapping[str, AnyAction]) -> dict[str, bool]:
        """Make each action the newest set-point of the drone of its name, all sent together.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Drones that are set aside are left out. A hover takes no drone from others, see :meth:`hover`. :attr:`spread` is
        how far apart the first and the last command left.

        Args:
            actions: By name of the drone.

        Returns:
            By name, whether the command was handed to the transport now.

        Raises:
            UnknownNameError: If no drone of the swarm has one of the names; nothing is sent then.
            UsageError: If an action can't be commanded or has numbers that are not finite; nothing is sent then.
            SwarmError: As set by ``on_error``.
            ClosedError: If the swarm was closed.
        """
    async def request_authority(
        self,
        priority: int | None = None,
        *,
        wait_s: float = 0.0,
        for_s: float | None = None,
        takeover: TakeoverWay = "now",
        stay: bool = False,
    ) -> dict[str, AuthorityStatus]:
        """Ask for the authority over all active drones.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Args:
            priority: 0 (highest) to 31 (lowest); None: as in the last request.
            wait_s: As for :meth:`Drone.request_authority`.
            for_s: As for :meth:`Drone.request_authority`.
            takeover: As for :meth:`Drone.request_authority`.
            stay: As for :meth:`Drone.request_authority`.

        Returns:
            The status of each, by name.
        """
    async def release_authority(self) -> None:
        """Release the authority over all active drones.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.
        """
    async def feedback(self, *, max_age_s: float | None = None) -> dict[str, Feedback]:
        """Return the newest feedback of each active drone, by name.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        Args:
            max_age_s: Oldest age since capture that is accepted [s]; a drone whose feedback is older has failed.

        Raises:
            SwarmError: As set by ``on_error``.
            ClosedError: If the swarm was closed.
        """
    async def wait_all(self, wanted: Wanted, timeout_s: float = 10.0) -> dict[str, Feedback]:
        """Wait until all active drones are as wanted *at the same time*.

        It is awaited, and waits on a thread of its own. Cancelling the task ends the waiting.

        A drone whose link is lost is not as wanted, whatever its last feedback. Drones that are not as wanted in time
        have failed.

        Args:
            wanted: A flight state or its name, several of them, or a predicate on feedback.
            timeout_s: How long to wait [s].

        Returns:
            The feedback of those that are as wanted, by name.

        Raises:
            UnknownNameError: If there is no flight state of that name.
            SwarmError: As set by ``on_error``.
            ClosedError: If the swarm was closed.
        """
    @property
    def names(self) -> tuple[str, ...]:
        """Names of all drones, including those set aside."""
    @property
    def errors(self) -> dict[str, Exception]:
        """Why drones do not take part, by name: those set aside, and those that were never connected."""
    def readmit(self, *names: str) -> None:
        """Make drones that were set aside active again.

        Args:
            *names: Which; none: all.

        Raises:
            UnknownNameError: If no drone of the swarm has one of the names.
        """
    def emergency_stop(self) -> dict[str, bool]:
        """Cut the motors of all drones at once, including those set aside: they fall.

        Raises:
            SwarmError: If the command could not be sent to some, whatever ``on_error`` is.
        """
    @property
    def spread(self) -> Distribution | None:
        """How far apart the first and the last command of one :meth:`send` left this process [s]; None before any."""
    def __len__(self) -> int: ...
    def __contains__(self, name: object) -> bool: ...

def connect(
    target: str,
    *,
    access: Access = "pilot",
    name: str | None = None,
    timeout_s: float | None = None,
    rate_hz: float = 32.0,
    stall_s: float = 1.0,
    on_exit: OnExit = "land",
    authority: Authority | None = None,
    network: NetworkChoice = None,
) -> Opening[Drone]:
    """Connect to a drone.

    The result connects when it is awaited, or entered with ``async with``. ``speed=max`` is refused.

    Returns when the vehicle's state is known and, with ``access="pilot"``, when it may be commanded. A vehicle that was
    started just now is waited for until it can take off, and the log (``skyloop``) says so; after ``timeout_s``,
    or 60 s, the call returns all the same, and :meth:`Drone.takeoff` goes on waiting.

    Args:
        target: Name of a running proxy, or address of a vehicle such as ``sim://?seed=3`` or ``video://flight.mp4``.
            For an address a private proxy is started, which ends with the drone and with this process. A name is
            looked up on this host first and then, if ``network`` allows, on the network.
        access: ``"pilot"`` requests the authority, ``"observe"`` only reads.
        name: Name of this application, 1 to 64 characters; None: the running script's.
        timeout_s: Time for the proxy to answer and the vehicle to wake up [s]; None or 0: 5 s for a name and 20 s for
            an address, and then 60 s for the vehicle.
        rate_hz: Rate at which commands are repeated, 1 to 200 Hz.
        stall_s: Time without a call after which a velocity or attitude decays to hover [s]; ``math.inf``: never.
        on_exit: What an airborne vehicle does at the end of the block, ``"land"`` or ``"hover"``. One that
            others fly stays as it is; a warning in the log says so.
        authority: How a pilot asks for the authority: priority, waiting, asking its holder first. None:
            ``Authority()``.
        network: True, an address, or a :class:`Network` with keys; False stays on this host. None: as the variable
            ``SKYLOOP_NETWORK`` says, without which nothing leaves this host.

    Raises:
        UnknownNameError: If no proxy of this name runs; carries suggestions.
        NoAnswerError: If the proxy does not answer in time, or sends no feedback.
        AuthorityError: If the authority can't be had; names its holder.
        RefusedError: If the proxy refuses the connection.
        LinkError: If the proxy or the private proxy can't be reached, or ends.
        UsageError: If an argument is out of range, or the address makes no sense.
        MissingExtraError: If the network is asked for and the extra ``network`` is not installed.
    """

def swarm(
    *targets: Target, on_error: OnError = "continue", missing: Missing = "raise", **options: Unpack[ConnectOptions]
) -> Opening[Swarm]:
    """Connect to several drones at the same time; returns when all are connected.

    The result connects when it is awaited, or entered with ``async with``. ``speed=max`` is refused.

    Args:
        *targets: Names of running proxies, patterns such as ``"drone*"`` for all that run now, addresses of vehicles
            such as ``"sim://?seed=1"`` (named ``sim1``, ``sim2``, …), or mappings from a name of your choice to
            either, ``{"left": "sim://?seed=1"}``.
        on_error: What happens to the others when one fails; see :class:`Swarm`.
        missing: A drone that can't be connected to fails the call (``"raise"``) or is left out (``"skip"``), as long
            as one is left.
        **options: As for :func:`skyloop.connect`, for each drone.

    Returns:
        The swarm, a context manager.

    Raises:
        SwarmError: With the reason of each drone that can't be connected to, after leaving the others.
        UnknownNameError: If a pattern matches no running proxy.
        UsageError: If a drone is named twice, none is named, or ``on_error`` or ``missing`` is unknown.
    """

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

    Writing needs the authority. :class:`skyloop.client.Config` explains how written values are kept.
    """

    sync: client.Config
    def __init__(self, sync: client.Config) -> None:
        """Wrap parameters of a connected drone."""
    async def get(self, name: str) -> Value:
        """Return the current value. Raises :class:`UnknownNameError`, with suggestions, for an unknown name.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def set(self, name: str, value: object) -> None:
        """Write one value.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Raises:
            ParameterError: If the proxy refuses it, with its reason.
            AuthorityError: If the authority is not held.
            UnknownNameError: If there is no such parameter; carries suggestions.
            UsageError: If no parameter can have a value of this type.
            LinkError: If the link broke before the answer and the parameter is momentary: it may have been executed.
        """
    async def items(self) -> list[tuple[str, Value]]:
        """Return (name, value) of all parameters, sorted by name.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def values(self) -> list[Value]:
        """Return the values of all parameters, sorted by name.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def parameters(self) -> list[Parameter]:
        """Return all parameters, sorted by name.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def describe(self, name: str) -> Parameter:
        """Return a parameter's type, unit, range, default, value and description.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Raises :class:`UnknownNameError`, with suggestions, if there is no such parameter.
        """

class Drone:
    """A connected vehicle, made by :func:`connect`.

    Methods have the names, arguments, results and errors of :class:`skyloop.Drone`; those that wait are coroutines.
    Callbacks, plain or coroutine functions, run on the event loop that was running when they were added. Image
    callbacks are the exception: they are plain functions in their own threads, because image processing would block the
    event loop. The predicate of :meth:`wait` is a plain function, too.
    """

    sync: client.Drone
    config: Config
    def __init__(self, sync: client.Drone) -> None:
        """Wrap a connected drone."""
    async def __aenter__(self) -> Drone: ...
    async def __aexit__(self, *_: object) -> None:
        """This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting."""
    @property
    def log(self) -> client.Logbook:
        """Publishes text and numbers during the flight; see :class:`skyloop.client.Logbook`."""
    def frames(
        self, camera: str | None = None, *, timeout_s: float = 5.0, **how: Unpack[VideoOptions]
    ) -> AsyncIterator[client.Frame]:
        """Yield the newest frame repeatedly until the drone is closed; a slow loop skips frames.

        A JPEG is decoded on another thread, while :meth:`frame` decodes on the event loop.

        The first iteration raises the errors, not the call itself.

        Args:
            camera: Name of the camera; None: the vehicle's first.
            timeout_s: How long to wait for each frame [s].
            **how: ``max_fps``: maximum frames per second. ``scale``: factor for width and height, above 0 and up to 1.
                ``part``: (k, n), only every n-th frame, so that n workers, numbered by k from 0, can share the frames.
                ``encoding``: how frames are sent over a network: ``"jpeg"`` (with ``quality`` 1 to 100, default 80),
                ``"h264"`` (at ``kbit_s`` kilobits a second; by default at the rate that the network path can carry,
                with smaller and fewer frames if that is low) or ``"raw"``; within one host, all frames are raw.
                ``max_age_s``: frames older than this when their turn comes are skipped and counted as dropped.

        Raises:
            NoAnswerError: If no frame arrives within ``timeout_s``.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            UsageError: If an option is out of range, or if called from an inline callback.
            ClosedError: If the drone was already closed.
        """
    def results(
        self, processor: str, *, max_age_s: float | None = None, timeout_s: float = 5.0
    ) -> AsyncIterator[client.Result]:
        """Yield a processor's newest result repeatedly until the drone is closed.

        A slow loop skips results; :attr:`stats` counts them, as well as those that are too old. Errors are raised by
        the first iteration, not by the call.

        Args:
            processor: Name of the processor.
            max_age_s: Maximum age since the frame's capture [s]; None: any.
            timeout_s: How long to wait for each result [s].

        Raises:
            NoAnswerError: If no sufficiently new result arrives in time.
            UsageError: If ``processor`` is invalid, ``max_age_s`` is negative, or if called from an inline callback.
            ClosedError: If the drone was already closed.
        """
    async def close(self) -> None:
        """Release the authority, then end the connection, all threads and a private proxy.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Does not land, but a private proxy lands a flying vehicle before it ends. Idempotent. Threads that wait for this
        drone get :class:`ClosedError`.
        """
    async def stats(self) -> dict[str, ChannelStats]:
        """Statistics by channel: ``command``, ``feedback``, ``video/<camera>``, ``results/<processor>``.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        The delay of ``command`` comes from the echoes of this application's commands while :meth:`on_command` has a
        callback. Otherwise it is the delay for all pilots, which takes up to 0.2 s to request from the proxy.
        """
    async def preflight(self, *, video_s: float = 1.5, folder: str | Path | None = None) -> list[PreflightFinding]:
        """Run the pre-flight checklist; each finding comes with a reason and a remedy.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Reads the proxy's parameters and requests an image from each camera. Doesn't fly and needs no authority.

        Args:
            video_s: Total time to wait for frames [s]; 0: don't check cameras.
            folder: Folder for recordings, to check its free space; None: don't check.

        Raises:
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
    async def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> None:
        """Take off, then hover.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        If the vehicle is not ready yet, the take-off is retried twice a second during the wait. If the call fails, for
        example by a time-out or Ctrl-C, the take-off is cancelled: the vehicle hovers if it is in the air, otherwise
        it stays on the ground. Without ``wait``, a refused take-off is not retried.

        Args:
            wait: Wait until the vehicle hovers or flies; otherwise only send the command.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If the vehicle does not hover in time; the message gives its state and, if known, the reason.
            RefusedError: If the proxy refuses the take-off in the present state; if a failsafe, a lost link, a new
                lease or another command of this application ends it before it takes effect; if the application lands
                the vehicle or stops its motors; or if the vehicle lands or disarms before it hovers, for whatever
                reason.
            UnsupportedError: If the vehicle can't take off.
            LinkError: If the link is down and ``wait`` is False; the vehicle won't take off later, either.
            AuthorityError: If the authority is not held, or another application takes it over.
            ClosedError: If the drone is closed.
            UsageError: If called with ``wait`` from an inline callback; nothing is sent in that case.
        """
    async def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> None:
        """Land at the current position.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        A landing interrupted by a failsafe, a lost link or a lost lease is commanded again during the wait. If the
        vehicle's own link breaks, the proxy continues the landing, even if no application is waiting for it.

        Args:
            wait: Wait until the vehicle has landed; otherwise only send the command.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If the vehicle has not landed in time; the message gives its state and, if known, the reason.
            RefusedError: If the proxy refuses to land in the present state.
            UnsupportedError: If the vehicle can't land.
            LinkError: If the link is down and ``wait`` is False; the landing is still sent within 0.5 s if possible.
            AuthorityError: If the authority is not held, or another application takes it over.
            ClosedError: If the drone is closed.
            UsageError: If called with ``wait`` from an inline callback; the landing is commanded anyway.
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
        """Fly straight to a position and hold it.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        World axes are those of ``Feedback.position_m``. If the vehicle knows its geographic position
        (``Feedback.origin``), latitude and longitude may be given instead; they are converted during this call.
        ArduPilot and PX4 fly there natively; for other vehicles the proxy sends velocities. Unlike a velocity, a
        position does not decay when the application stops sending: the vehicle stops there. It is held until the next
        command, even after a time-out; after Ctrl-C or a cancelled task, the vehicle hovers. The flight does not avoid
        obstacles.

        Args:
            x: East [m].
            y: North [m].
            z: Up [m].
            latitude_deg: Latitude [°], north positive; an alternative to x, y and z.
            longitude_deg: Longitude [°], east positive.
            altitude_m: Altitude above mean sea level [m]; None: the current height.
            yaw: Yaw to reach on the way, counter-clockwise from x [rad]; None: keep the current yaw.
            speed: Maximum speed on the way [m/s]; None: ``limits.speed`` and ``limits.climb``, which always apply.
            wait: Wait until the vehicle has arrived and is nearly at rest; otherwise only send the command.
            timeout_s: How long to wait [s].
            tolerance_m: Maximum distance from the position at arrival [m].
            tolerance_rad: Maximum deviation from ``yaw`` at arrival [rad].

        Raises:
            NoAnswerError: If it has not arrived in time; the message gives its state and, if known, the reason.
            RefusedError: If the proxy refuses it, for example because the vehicle's position is unknown, the target is
                outside the safety box or in a no-fly zone, or a zone is in the way; or if a failsafe or another command
                ends it. Also if latitude and longitude are given but the vehicle's geographic position is unknown.
            UnsupportedError: If neither the vehicle nor its proxy can fly to a position.
            LinkError: If the link is down and ``wait`` is False; the vehicle won't fly there later, either.
            AuthorityError: If the authority is not held, or another application takes it over.
            ClosedError: If the drone is closed.
            UsageError: If a number is not finite or makes no sense, or if called with ``wait`` from an inline callback;
                nothing is sent in that case.
        """
    async def return_to_start(
        self, height_m: float | None = None, *, land: bool | None = None, wait: bool = True, timeout_s: float = 180.0
    ) -> None:
        """Fly back to where the vehicle took off, and land there or hover.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        The vehicle climbs straight up to a safe height if it is lower, within ``limits.altitude``, the ceiling of the
        room and the top of the safety box. It flies straight to a point above its start (:attr:`start_position`) as
        :meth:`go_to` does, and lands. Any other command, another pilot or a failsafe ends the flight. Obstacles are not
        avoided.

        Args:
            height_m: Minimum height above the start on the way [m]; None: the parameter ``return.height``.
            land: Whether to land there instead of hovering above it; None: the parameter ``return.land``.
            wait: Whether to wait until it has landed, or hovers above its start, rather than only send the command.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If it has not ended in time; the message gives the vehicle's state and, if known, the reason.
            RefusedError: If the proxy refuses it, for example because position or start are unknown, the vehicle is not
                flying, or a no-fly zone is in the way; or if a failsafe or another command ends it.
            UnsupportedError: If neither the vehicle nor its proxy can fly to a position.
            LinkError: If the link is down and ``wait`` is False; the vehicle won't return later, either.
            AuthorityError: If the authority is not held, or another application takes it over.
            ClosedError: If the drone is closed.
            UsageError: If an argument is invalid, or if called with ``wait`` from an inline callback; nothing is sent.
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
        """Request the authority and wait for it.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        A holder of lower priority is pre-empted at once. With ``takeover="ask"`` it is asked first, and pre-empted when
        it agrees or after the proxy's ``authority.ask_s``; a holder of the same or higher priority is also asked, and
        may decline. Once granted, the authority is kept: after the link is lost it is requested again, and after a
        pre-emption it is regained when the other application releases it.

        Args:
            priority: Priority from 0 (highest) to 31 (lowest); None: the priority of the last request.
            wait_s: Maximum time to wait in the queue [s].
            for_s: How long to hold the authority [s], up to a day; after that, others can acquire it. None: unlimited.
            takeover: ``"now"`` pre-empts a holder of lower priority at once, ``"ask"`` asks it first.
            stay: Whether to stay in the queue after ``wait_s`` instead of raising.

        Returns:
            The status: held or, if ``stay`` is True, possibly queued, including the position and the expected wait.

        Raises:
            AuthorityError: If it is not granted within ``wait_s`` (the message names the holder), if the proxy refuses
                it, or if this application only observes.
            NoAnswerError: If the proxy does not answer the request.
            UsageError: If ``priority``, ``for_s`` or ``takeover`` is out of range.
            ClosedError: If the drone was closed.
        """
    async def release_authority(self) -> None:
        """Release the authority or leave the queue, and wait until the proxy confirms it.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Does nothing if the authority is neither held nor requested.

        Raises:
            NoAnswerError: If the proxy does not answer.
            ClosedError: If the drone was closed.
        """
    async def next_feedback(self, timeout_s: float = 1.0, *, max_hz: float | None = None) -> Feedback:
        """Wait for feedback that has not been read yet, and return the newest.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            timeout_s: How long to wait [s].
            max_hz: As for :meth:`feedback`; samples requested by other consumers may be returned, too.

        Raises:
            NoAnswerError: If none arrives in time.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback, or an option is out of range.
        """
    async def next_frame(self, camera: str | None = None, *, timeout_s: float = 1.0) -> Frame:
        """Wait for a frame that this method has not returned yet, then return the newest one.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        The first call subscribes to the camera permanently.

        Args:
            camera: Name of the camera; None: the vehicle's first.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If none arrives in time.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
    async def wait(self, state: Wanted, timeout_s: float = 10.0) -> Feedback:
        """Wait until the newest feedback meets a condition.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            state: A flight state or its name, several of them, or a predicate on feedback, which runs on this thread.
            timeout_s: How long to wait [s].

        Returns:
            The feedback that met the condition.

        Raises:
            NoAnswerError: If it is not met in time; the message gives the current state.
            UnknownNameError: If there is no flight state of this name.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
    async def overview(self, timeout_s: float = 2.0) -> Overview:
        """Return the newest overview of all vehicles in the proxy's process, with one row per vehicle.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Overviews are sent once a second and are much smaller than feedback, so they suit applications that watch many
        vehicles. The first call subscribes permanently and waits for the first overview.

        Args:
            timeout_s: How long to wait for the first overview [s].

        Raises:
            NoAnswerError: If none arrives in time, for example from an older proxy.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback before the first one has arrived.
        """
    @property
    def name(self) -> str:
        """Name of the proxy; empty before the first connection."""
    @property
    def uri(self) -> str:
        """Address of the vehicle; empty before the first connection."""
    @property
    def app_id(self) -> int:
        """Number of this application in the proxy's current run."""
    @property
    def capabilities(self) -> Capabilities:
        """Actions and cameras of the vehicle; ``vehicle`` is ``unknown`` before the first connection."""
    @property
    def authority(self) -> AuthorityStatus:
        """Current state of this application's authority."""
    @property
    def link(self) -> LinkStatus:
        """State of both hops: application to proxy, and proxy to vehicle.

        ``reason`` explains the last change or, while the proxy is lost, the last failed attempt to reconnect.
        """
    @property
    def closed(self) -> bool:
        """Whether :meth:`close` was called."""
    @property
    def now_ns(self) -> int:
        """Estimate of the time on the proxy's clock [ns]; in a stepped replay, the time in the recorded flight."""
    @property
    def clock_offset_ns(self) -> int:
        """Estimate of the proxy's clock minus this process's clock [ns]."""
    @property
    def clock_uncertainty_ns(self) -> int:
        """Maximum error of :attr:`clock_offset_ns` [ns], and so of ages and delays; 0 if both use the same clock."""
    @property
    def start_position(self) -> Vector | None:
        """Position of the last take-off in world axes: east, north, up [m]; None if unknown."""
    def age_s(self, sample: Feedback | Frame) -> float:
        """Return the time since the sample's capture [s], within ``clock_uncertainty_ns``."""
    def recent_events(self) -> list[Event]:
        """Return the last 256 events, oldest first."""
    def hover(self) -> bool:
        """Stop and hold the position. For return values and exceptions, see :class:`Drone`."""
    def idle(self) -> bool:
        """Keep the authority and leave the vehicle as it is."""
    def velocity(self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Fly at a velocity in the levelled body axes, which turn with the yaw but not with roll and pitch.

        Args:
            forward: Along x, forward [m/s].
            left: Along y, to the left [m/s].
            up: Along z, up [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].

        Returns:
            True if the command was handed to the transport; :class:`Drone` explains this and lists the exceptions.
        """
    def attitude(self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Hold an attitude with a climb rate.

        Args:
            roll: Right side down is positive and accelerates to the right [rad].
            pitch: Nose down is positive and accelerates forward [rad].
            climb: Vertical velocity, up [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].

        Returns:
            True if the command was handed to the transport; :class:`Drone` explains this and lists the exceptions.
        """
    def emergency_stop(self) -> bool:
        """Cut the motors at once: the vehicle falls.

        Requires ``access="pilot"`` but not the authority. The stop is sent at once and repeated until the vehicle
        reports it (``FlightState.EMERGENCY``); after 8 s it is abandoned with an event (``vehicle_message``, reason
        ``stop_given_up``). Until then this connection sends nothing else: :meth:`velocity`, :meth:`hover` and similar
        return False, :meth:`takeoff` and :meth:`land` raise :class:`RefusedError`. A program that flies over several
        connections must itself stop the others from sending. A stop that could not be sent for 2 s is not sent later.

        Returns:
            False if the link is down and the stop can't be sent now.

        Raises:
            AuthorityError: If this application only observes.
            UnsupportedError: If the vehicle can't stop its motors, or has no commands.
            ClosedError: If the drone was closed.
        """
    def reset_emergency(self) -> bool:
        """Leave the emergency state while on the ground.

        If the vehicle has not yet reported this application's stop, the reset is sent as soon as it has, within 2 s.
        """
    def command(self, action: AnyAction) -> bool:
        """Make ``action`` the newest set-point.

        Returns:
            True if the command was handed to the transport; :class:`Drone` explains this and lists the exceptions.
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
        """Send the vehicle its own pose as measured from outside, for an autopilot that navigates by it instead of GPS.

        Thread-safe. Returns at once, without requiring the authority. Refusals cause events (``command_refused``).

        Args:
            position: x east, y north, z up [m].
            quaternion: x, y, z, w of the rotation from body axes (x forward, y left, z up) to world axes.
            at_ns: Time of the measurement, on the proxy's clock [ns]; None: now.
            position_std_m: Standard deviation of the position [m], if known.
            attitude_std_rad: Standard deviation of the attitude [rad], if known.

        Returns:
            True if it was handed to the transport.

        Raises:
            AuthorityError: If this application only observes.
            UsageError: If a number is missing or not finite, a standard deviation is negative, the quaternion's length
                differs from 1 by more than 0.001, or ``at_ns`` is out of range.
        """
    def emit(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: str) -> None:
        """Emit an event (number 0) to this application's own callbacks only.

        Args:
            kind: Kind of the event.
            text: Human-readable text.
            severity: Severity of the event.
            **data: Details, by name.
        """
    def annotate(self, frame: Frame, shapes: Iterable[Shape], source: str | None = None) -> bool:
        """Publish shapes drawn over a frame, for the cockpit and for recordings.

        Args:
            frame: The frame that the shapes belong to.
            shapes: Shapes in this frame's pixels; coordinates may be NumPy's.
            source: Name of the component that drew them; None: this application. For each source and camera, new shapes
                replace earlier ones.

        Returns:
            True if they were handed to the transport.

        Raises:
            UsageError: If an item is not a shape, there are too many, coordinates are not finite, or colours are not
                within 0 to 255.
        """
    def feedback(self, *, max_age_s: float | None = None, max_hz: float | None = None) -> Feedback:
        """Return the newest feedback.

        An observer receives only as much data as its consumers need, and every sample as long as none of them limits
        its request; the first call of this method adds a permanent consumer. A pilot always receives everything.

        Args:
            max_age_s: Maximum age since capture [s]; None: any.
            max_hz: Maximum rate of new samples that is needed, 0.001 to 1000 Hz; None: all.

        Raises:
            NoAnswerError: If there is no feedback yet, or the newest is older than ``max_age_s``.
            ClosedError: If the drone was closed.
            UsageError: If ``max_hz`` is out of range.
        """
    def frame(self, camera: str | None = None, *, max_age_s: float | None = None) -> Frame | None:
        """Return the newest frame without waiting.

        The first call subscribes to the camera permanently.

        Args:
            camera: Name of the camera; None: the vehicle's first.
            max_age_s: Maximum age since capture [s]; None: any.

        Returns:
            The frame; None if none has arrived yet, it is too old, or it can't be decoded.

        Raises:
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone was closed.
        """
    def result(self, processor: str, *, max_age_s: float | None = None) -> Result | None:
        """Return a processor's newest result without waiting.

        The first call subscribes to the processor permanently.

        Args:
            processor: Name of the processor.
            max_age_s: Maximum age since the frame's capture [s]; None: any.

        Returns:
            The result; None if none has arrived yet or it is too old.

        Raises:
            UsageError: If ``processor`` is not a valid name or ``max_age_s`` is negative.
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
            function: Called in its own thread with the newest unseen frames, at most ``depth`` of them.
            camera: Name of the camera; None: the vehicle's first, even if the proxy restarts with other cameras.
            depth: How many frames may wait, at least 1; older ones are dropped and counted.
            inline: Call it on the receiving thread instead, with every frame. It must be quick and must not wait.
            **how: As for :meth:`frames`.

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
        """Call ``function`` with a camera's encoded frames, to store or forward them.

        Each is an H.264 access unit in Annex B format that can be decoded after its predecessors; the first one is a
        key frame. After a loss, a key frame is requested from the proxy and delivered next. Without ``kbit_s``,
        ``max_fps`` and ``scale``, frames arrive as encoded by the vehicle or, if it doesn't send H.264, by the proxy at
        the rate that the network path can carry.

        Args:
            function: Called in its own thread.
            camera: Name of the camera; None: the vehicle's first.
            kbit_s: Rate at which the proxy encodes [kbit/s], once for all clients with the same request.
            max_fps: Maximum number of frames per second; None: all.
            scale: Factor for width and height, above 0 and up to 1.
            depth: How many frames may wait, at least 1; if there are more, some are lost.
            inline: Call it on the receiving thread instead. It must be quick and must not wait.

        Raises:
            UsageError: If ``function`` can't be called or an option is out of range.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone was closed.
        """
    def on_takeover(
        self, function: Callable[[TakeoverRequest], TakeoverAnswer | Awaitable[TakeoverAnswer]]
    ) -> Listener:
        """Call ``function`` when another application requests the authority that this one holds.

        ``function``, plain or a coroutine function, runs on the event loop.

        Args:
            function: Called on the event loop. It returns True to hand the authority over, False or a reason (a text)
                to decline, and None to leave the decision to the proxy. In any case, a strictly higher priority wins
                after the proxy's ``authority.ask_s``.

        Raises:
            UsageError: If ``function`` can't be called.
            ClosedError: If the drone was closed.
        """
    def on_overview(
        self, function: Callable[[Overview], object | Awaitable[object]], *, inline: bool = False
    ) -> Listener:
        """Call ``function`` once a second with an overview of all vehicles in the proxy's process (:meth:`overview`).

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        It is called on the event loop or, with ``inline``, on the receiving thread.
        """
    def on_feedback(
        self,
        function: Callable[[Feedback], object | Awaitable[object]],
        *,
        inline: bool = False,
        max_hz: float | None = None,
    ) -> Listener:
        """Call ``function`` with the newest feedback.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        Like every ``on_...`` method it returns a :class:`Listener`, whose ``cancel()`` ends the calls. It raises
        :class:`UsageError` if ``function`` is not callable and :class:`ClosedError` if the drone was closed.

        Args:
            function: Called on the event loop; feedback replaced by newer feedback is dropped and counted.
            inline: Call it on the receiving thread instead, with every sample. It must be quick and must not wait.
            max_hz: Maximum rate of samples, 0.001 to 1000 Hz; None: all. An observer does not receive more than that
                unless another consumer requests more.
        """
    def on_event(self, function: Callable[[Event], object | Awaitable[object]], *, inline: bool = False) -> Listener:
        """Call ``function`` with each event, including the client's own (number 0).

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        Args:
            function: Called on the event loop; up to 256 events wait for it.
            inline: Call it on the receiving thread instead. For the client's own events, this is the thread that emits
                them.
        """
    def on_link(self, function: Callable[[LinkStatus], object | Awaitable[object]]) -> Listener:
        """Call ``function`` on the event loop whenever one of the hops changes state; up to 256 changes may wait.

        ``function``, plain or a coroutine function, runs on the event loop.
        """
    def on_command(
        self, function: Callable[[Applied], object | Awaitable[object]], *, inline: bool = False
    ) -> Listener:
        """Call ``function`` with the proxy's echo of every command from any application; up to 256 echoes may wait.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        It is called on the event loop.
        """
    def on_annotation(
        self, function: Callable[[Annotation], object | Awaitable[object]], *, inline: bool = False
    ) -> Listener:
        """Call ``function`` with the annotations that applications draw on frames; up to 256 of them may wait.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        It is called on the event loop.
        """
    def on_log(self, function: Callable[[LogEntry], object | Awaitable[object]], *, inline: bool = False) -> Listener:
        """Call ``function`` with the log entries (``drone.log``) of all applications, also this one; up to 256 wait.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        It is called on the event loop.
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
        """Call ``function`` with the results of one processor or of all processors.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        Args:
            function: Called on the event loop.
            processor: Name of the processor; None: all processors.
            max_age_s: Maximum age [s]; results older than this when their turn comes are skipped and counted in the
                listener's ``expired``. None: no limit.
            depth: How many results may wait, at least 1; None: 1 for one processor, 256 for all.
            inline: Call it on the receiving thread instead. It must be quick and must not wait.

        Raises:
            UsageError: If ``function`` can't be called or another argument is out of range.
            ClosedError: If the drone was closed.
        """

class Listener:
    """A callback that runs on the event loop, one call at a time."""

    sync: client.Listener[Any]
    def __init__(self, sync: client.Listener[Any]) -> None:
        """Wrap a listener whose function hands samples to the event loop."""
    def cancel(self) -> None:
        """Stop calling the function. Does not wait for a call in progress."""
    @property
    def errors(self) -> int:
        """Number of calls that raised."""
    @property
    def delivered(self) -> int:
        """Number of calls of the function."""
    @property
    def dropped(self) -> int:
        """Samples replaced by newer ones before the function was ready for them."""

class Swarm:
    """Drones by name, made by :func:`swarm`; ``drones["alpha"]`` is one :class:`Drone`, and iterating yields all.

    Methods have the names, arguments, results and errors of :class:`skyloop.Swarm`. All commands but
    :meth:`emergency_stop` are coroutines. :meth:`feedback` is a coroutine too, because ``on_error`` may require a
    landing. Only one task at a time may await them; :meth:`emergency_stop` may be called at any time.
    """

    sync: client.Swarm
    def __init__(self, sync: client.Swarm) -> None:
        """Wrap a connected swarm."""
    async def __aenter__(self) -> Swarm: ...
    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting."""
    @property
    def active(self) -> dict[str, Drone]:
        """The drones that receive commands, by name; see :attr:`skyloop.Swarm.active`."""
    def items(self) -> list[tuple[str, Drone]]:
        """Return (name, drone) of all drones, including those set aside."""
    def __getitem__(self, name: str) -> Drone: ...
    def __iter__(self) -> Iterator[Drone]: ...
    def __repr__(self) -> str: ...
    async def each(self, function: Callable[[Drone], Awaitable[T]], what: str = "") -> dict[str, T]:
        """Await ``function`` for all active drones concurrently, on this event loop. Cancelling cancels all of them.

        A coroutine function. Exceptions, ``what`` and the result are the same as for :meth:`skyloop.Swarm.each`.
        """
    def ticks(self, rate_hz: float = 20.0, seconds: float | None = None) -> AsyncIterator[Tick]:
        """Yield at a steady rate with absolute deadlines, for a loop that commands all drones.

        Ends when the swarm is closed. If an iteration takes longer than a period, the schedule restarts from its end.
        When the loop ends, whether by time, a ``break``, an exception or Ctrl-C, drones still flying velocities or
        attitudes that it sent hover at once, because no newer ones would follow.

        Args:
            rate_hz: Ticks per second, 0.1 to 200.
            seconds: Duration [s]; None: until the loop ends.

        Raises:
            UsageError: If ``rate_hz`` is out of range; raised by the first iteration.
        """
    async def close(self) -> None:
        """End all connections. Does not land. Idempotent.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> None:
        """Take off with all active drones at the same time; see :meth:`Drone.takeoff`.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            wait: Wait until every drone hovers.
            timeout_s: How long to wait [s].
        """
    async def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> None:
        """Land all active drones at their current positions, at the same time; see :meth:`Drone.land`.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            wait: Wait until each has landed.
            timeout_s: How long to wait [s].
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
        """Fly each drone straight to its own position, all at the same time; see :meth:`Drone.go_to`.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Nothing keeps the drones apart on the way; use :class:`skyloop.control.formation_flight.Formation` to plan safe
        paths. Drones that are set aside are skipped.

        Args:
            places: Position of each drone, by name: x, y, z in its world axes [m], and optionally the yaw [rad].
            speed: Maximum speed on the way [m/s]; None: as fast as the limits allow.
            wait: Wait until each drone has arrived; otherwise only send the commands.
            timeout_s: How long to wait [s].
            tolerance_m: Maximum distance from the position at arrival [m].

        Raises:
            UnknownNameError: If no drone of the swarm has one of the names; nothing is sent in that case.
            UsageError: If a position is invalid; nothing is sent in that case.
            SwarmError: Depending on ``on_error``.
            ClosedError: If the swarm was closed.
        """
    async def return_to_start(
        self, height_m: float | None = None, *, land: bool | None = None, wait: bool = True, timeout_s: float = 180.0
    ) -> None:
        """Fly all active drones back to where each took off, all at the same time; see :meth:`Drone.return_to_start`.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Nothing keeps the drones apart on the way.

        Args:
            height_m: Minimum height above the start on the way [m]; None: each drone's ``return.height``.
            land: Whether to land there instead of hovering above it; None: each drone's ``return.land``.
            wait: Wait until each has landed, or hovers above its start; otherwise only send the commands.
            timeout_s: How long to wait [s].

        Raises:
            UsageError: If an argument makes no sense; nothing is sent in that case.
            SwarmError: Depending on ``on_error``.
            ClosedError: If the swarm was closed.
        """
    async def hover(self) -> dict[str, bool]:
        """Stop and hold the position, with all active drones.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Drones flown by other applications are left alone; only a drone's own ``drones[name].hover()`` takes it back.
        """
    async def idle(self) -> dict[str, bool]:
        """Keep the authority and leave the vehicles as they are.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def velocity(
        self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0
    ) -> dict[str, bool]:
        """Fly all active drones at the same velocity, each in its own levelled body axes.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

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

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            roll: Right side down is positive [rad].
            pitch: Nose down is positive [rad].
            climb: Vertical velocity, up [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].
        """
    async def reset_emergency(self) -> dict[str, bool]:
        """Leave the emergency state while on the ground, with all active drones.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def command(self, action: AnyAction) -> dict[str, bool]:
        """Make ``action`` the newest set-point of all active drones; see :meth:`send`.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def send(self, actions: Mapping[str, AnyAction]) -> dict[str, bool]:
        """Make each action the newest set-point of the drone it is for, sending them all at once.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Drones that are set aside are skipped. A hover doesn't take a drone from others (see :meth:`hover`).
        :attr:`spread` is the time between the first and the last command.

        Args:
            actions: Actions by name of the drone.

        Returns:
            By name, True if the command was handed to the transport.

        Raises:
            UnknownNameError: If no drone of the swarm has one of the names; nothing is sent in that case.
            UsageError: If an action can't be commanded or has non-finite numbers; nothing is sent in that case.
            SwarmError: Depending on ``on_error``.
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
        """Request the authority over all active drones; return the status of each, by name.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        The arguments are those of :meth:`Drone.request_authority`.
        """
    async def release_authority(self) -> None:
        """Release the authority over all active drones.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def feedback(self, *, max_age_s: float | None = None) -> dict[str, Feedback]:
        """Return the newest feedback of each active drone, by name.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            max_age_s: Maximum age since capture [s]; a drone with older feedback has failed.
        """
    async def wait_all(self, wanted: Wanted, timeout_s: float = 10.0) -> dict[str, Feedback]:
        """Wait until all active drones meet a condition *at the same time*.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        A drone with a lost link does not meet it, whatever its last feedback. Drones that don't meet it have failed.

        Args:
            wanted: A flight state or its name, several of these, or a predicate on feedback.
            timeout_s: How long to wait [s].

        Returns:
            The feedback of the drones that meet it, by name.

        Raises:
            UnknownNameError: If there is no flight state of this name.
            SwarmError: Depending on ``on_error``.
            ClosedError: If the swarm was closed.
        """
    @property
    def names(self) -> tuple[str, ...]:
        """Names of all drones, including those set aside."""
    @property
    def errors(self) -> dict[str, Exception]:
        """The reasons why drones do not take part, by name: drones that were set aside or never connected."""
    def readmit(self, *names: str) -> None:
        """Reactivate drones that were set aside.

        Args:
            *names: Names of the drones; all of them if none is given.

        Raises:
            UnknownNameError: If no drone of the swarm has one of the names.
        """
    def emergency_stop(self) -> dict[str, bool]:
        """Cut the motors of all drones at once, including those set aside: they fall.

        Raises:
            SwarmError: If the command could not be sent to some drones, whatever the value of ``on_error``.
        """
    @property
    def spread(self) -> Distribution | None:
        """Time between the first and the last command of each :meth:`send` [s]; None before the first call."""
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

    Returns when the vehicle's state is known and, with ``access="pilot"``, when it may be commanded. If the vehicle
    has just started, the call logs this (``skyloop``) and waits until the vehicle can take off. After ``timeout_s`` or
    60 s, it returns anyway, and :meth:`Drone.takeoff` waits for the rest of the time.

    Args:
        target: Name of a running proxy, or address of a vehicle such as ``sim://?seed=3`` or ``video://flight.mp4``.
            For an address, a private proxy is started; it ends with the drone, or with this process. A name is looked
            up first on this host and then, if ``network`` allows it, on the network.
        access: ``"pilot"`` requests the authority, ``"observe"`` only reads.
        name: Name of this application, 1 to 64 characters; None: the running script's.
        timeout_s: Time limit for the proxy to answer and the vehicle to start up [s]; None or 0: 5 s for a name and
            20 s for an address, followed by 60 s for the vehicle.
        rate_hz: Rate at which commands are repeated, 1 to 200 Hz.
        stall_s: Time without a call after which a velocity or attitude decays to hover [s]; ``math.inf``: never.
        on_exit: What an airborne vehicle does at the end of the block, ``"land"`` or ``"hover"``. A vehicle that
            others fly is left alone, with a warning in the log.
        authority: How a pilot requests the authority: its priority, how long it waits, whether it asks the holder
            first. None: ``Authority()``.
        network: True, an address, or a :class:`Network` with keys; False stays on this host. None: the value of the
            variable ``SKYLOOP_NETWORK`` or, if it is not set, this host only.

    Raises:
        UnknownNameError: If no proxy of this name is running; carries suggestions.
        NoAnswerError: If the proxy does not answer in time, or sends no feedback.
        AuthorityError: If the authority is not granted; the text names its holder.
        RefusedError: If the proxy refuses the connection.
        LinkError: If the proxy or the private proxy can't be reached, or ends.
        UsageError: If an argument is out of range, or the address makes no sense.
        MissingExtraError: If the network is requested and the extra ``network`` is not installed.
    """

def swarm(
    *targets: Target, on_error: OnError = "continue", missing: Missing = "raise", **options: Unpack[ConnectOptions]
) -> Opening[Swarm]:
    """Connect to several drones at the same time; returns when all are connected.

    The result connects when it is awaited, or entered with ``async with``. ``speed=max`` is refused.

    Args:
        *targets: Names of running proxies, patterns such as ``"drone*"`` for running proxies, addresses of vehicles
            such as ``"sim://?seed=1"`` (named ``sim1``, ``sim2``, …), or mappings from a name of your choice to
            either, ``{"left": "sim://?seed=1"}``.
        on_error: What the others do when a drone fails; see :class:`Swarm`.
        missing: How to handle drones that can't be connected: ``"raise"`` fails the call, ``"skip"`` leaves them out
            as long as at least one drone connects.
        **options: As for :func:`skyloop.connect`, for each drone.

    Returns:
        The swarm, a context manager.

    Raises:
        SwarmError: If drones can't be connected, with the reason for each; the others are closed.
        UnknownNameError: If a pattern matches no running proxy.
        UsageError: If a drone is named twice, none is named, or ``on_error`` or ``missing`` is unknown.
    """

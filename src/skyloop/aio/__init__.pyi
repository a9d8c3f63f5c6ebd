# Made by scripts/aio_stub.py (`make stubs`) of bridge.py and of the synchronous classes.

from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from skyloop import client
from skyloop.aio.bridge import Callback as Callback, Opening, T
from skyloop.client.authority import Authority, AuthorityStatus, TakeoverAnswer, TakeoverRequest, TakeoverWay
from skyloop.client.connect import ConnectOptions, NetworkChoice
from skyloop.client.drone import Access
from skyloop.client.frame import Frame, ReceivedFrame
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
    def __init__(self, sync: client.Config) -> None: ...
    async def get(self, name: str) -> Value:
        """Return the current value. Raises :class:`UnknownNameError`, with suggestions, if the name is unknown.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def set(self, name: str, value: object) -> None:
        """Write one value.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Raises:
            ParameterError: If the proxy refuses the value; the message gives the reason.
            AuthorityError: If this application does not hold the authority.
            UnknownNameError: If no parameter has this name; the error suggests similar names.
            UsageError: If no parameter can have a value of this type.
            LinkError: If the link broke before the answer and the parameter is momentary; it may have been executed.
        """
    async def items(self) -> list[tuple[str, Value]]:
        """Return the (name, value) pairs of all parameters, sorted by name.

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

        Raises :class:`UnknownNameError`, with suggestions, if no parameter has this name.
        """

class Drone:
    """A connected vehicle, returned by :func:`connect`.

    Methods have the same names, arguments, results and errors as in :class:`skyloop.Drone`; those that wait are
    coroutines. Callbacks are plain or coroutine functions, and run on the event loop that was running when they were
    added. Image callbacks are the exception: they are plain functions that run in their own threads, because image
    processing would block the event loop. The test passed to :meth:`wait` must be a plain function, too.
    """

    sync: client.Drone
    config: Config
    def __init__(self, sync: client.Drone) -> None: ...
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

        The first iteration raises the errors; the call itself does not.

        Args:
            camera: Name of the camera; None: the vehicle's first.
            timeout_s: How long to wait for each frame [s].
            **how: ``max_fps``: maximum number of frames per second. ``scale``: factor for width and height, above 0, at
                most 1. ``part``: (k, n) for only every n-th frame, which lets n workers, numbered by k from 0, share
                the frames. ``encoding``: how frames are sent over a network: ``"jpeg"`` (``quality`` 1 to 100, default
                80), ``"h264"`` (``kbit_s`` kilobits per second; by default the rate that the network path can carry,
                with smaller and fewer frames if that rate is low) or ``"raw"``; within one host, all frames are raw.
                ``max_age_s``: frames older than this on delivery are skipped and counted as dropped.

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

        A slow loop skips results; :attr:`stats` counts them and results that are too old. The first iteration raises
        the errors, not the call itself.

        Args:
            processor: Name of the processor.
            max_age_s: Maximum age since the frame's capture [s]; None: any.
            timeout_s: How long to wait for each result [s].

        Raises:
            NoAnswerError: If no result that is new enough arrives in time.
            UsageError: If ``processor`` is invalid or ``max_age_s`` is negative, or if called from an inline callback.
            ClosedError: If the drone was already closed.
        """
    async def close(self) -> None:
        """Release the authority, then end the connection, all threads and the private proxy, if any.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Does not land, but a private proxy lands a flying vehicle before it ends. Idempotent. Threads that wait on this
        drone get :class:`ClosedError`.
        """
    async def stats(self) -> dict[str, ChannelStats]:
        """Statistics by channel: ``command``, ``feedback``, ``video/<camera>``, ``results/<processor>``.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        While :meth:`on_command` has a callback, the delay of ``command`` is measured from the echoes of this
        application's own commands. Otherwise, it covers all pilots and is requested from the proxy (up to 0.2 s).
        """
    async def preflight(self, *, video_s: float = 1.5, folder: str | Path | None = None) -> list[PreflightFinding]:
        """Run the pre-flight checklist; each problem found has a reason and a remedy.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Reads the proxy's parameters and requests one image from each camera. Neither flies nor requires the authority.

        Args:
            video_s: Total time to wait for frames [s]; 0 skips the camera check.
            folder: Folder for recordings, whose free space is checked; None skips this check.

        Raises:
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
    async def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> None:
        """Take off, then hover.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        If the vehicle is not ready yet, the take-off is retried twice a second while the call waits. If the call fails,
        for example because of a time-out or Ctrl-C, the take-off is cancelled: the vehicle hovers if it is in the air,
        and otherwise stays on the ground. Without ``wait``, a refused take-off is not retried.

        Args:
            wait: Whether to wait until the vehicle hovers or flies, rather than only send the command.
            timeout_s: Maximum time to wait [s].

        Raises:
            NoAnswerError: If the vehicle does not hover in time; the message gives its state and the reason, if known.
            RefusedError: If the proxy refuses the take-off in the current state; if a failsafe, a lost link, a new
                lease or another command of this application ends it before it takes effect; if the application lands
                the vehicle or stops its motors; or if the vehicle lands or disarms before it hovers, for any reason.
            UnsupportedError: If the vehicle can't take off.
            LinkError: If the link is down and ``wait`` is False; the take-off is not sent later.
            AuthorityError: If this application does not hold the authority, or another application takes it over.
            ClosedError: If the drone is closed.
            UsageError: If called with ``wait`` from an inline callback; nothing is sent in that case.
        """
    async def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> None:
        """Land at the current position.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        During the wait, a landing interrupted by a failsafe, a lost link or a lost lease is commanded again. If the
        vehicle's own link breaks, the proxy continues the landing, even if no application is waiting for it.

        Args:
            wait: Whether to wait until the vehicle has landed, rather than only send the command.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If the vehicle has not landed in time; the message gives its state and the reason, if known.
            RefusedError: If the proxy refuses the landing in the current state.
            UnsupportedError: If the vehicle can't land.
            LinkError: If the link is down and ``wait`` is False; if possible, the landing is still sent within 0.5 s.
            AuthorityError: If the authority is not held, or another application takes it over.
            ClosedError: If the drone is closed.
            UsageError: If called with ``wait`` from an inline callback; the landing is still commanded.
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

        The world axes are the same as for ``Feedback.position_m``. If the vehicle knows its geographic position
        (``Feedback.origin``), you can give latitude and longitude instead; this call converts them. ArduPilot and PX4
        fly to the position natively; for other vehicles, the proxy sends velocities. Unlike a velocity, a position does
        not decay when the application stops sending: the vehicle stops there. The vehicle holds the position until the
        next command, even after a time-out; after Ctrl-C or a cancelled task, it hovers. It does not avoid obstacles.

        Args:
            x: Distance east of the origin [m].
            y: Distance north of the origin [m].
            z: Height above the origin [m].
            latitude_deg: Latitude [°], north positive; used instead of x, y and z.
            longitude_deg: Longitude [°], east positive.
            altitude_m: Altitude above mean sea level [m]; None: the current height.
            yaw: Yaw to turn to during the flight, counter-clockwise from x [rad]; None: keep the current yaw.
            speed: Maximum speed [m/s], within ``limits.speed`` and ``limits.climb``; None: these limits only.
            wait: Whether to wait until the vehicle has arrived and is nearly at rest, or only send the command.
            timeout_s: How long to wait [s].
            tolerance_m: Maximum distance from the position on arrival [m].
            tolerance_rad: Maximum deviation from ``yaw`` on arrival [rad].

        Raises:
            NoAnswerError: If the vehicle has not arrived in time; the message gives its state and the reason, if known.
            RefusedError: If the proxy refuses the flight, for example because the vehicle's position is unknown, the
                target is outside the safety box or in a no-fly zone, or a zone is in the way; or if a failsafe or
                another command ends the flight. Also if latitude and longitude are given but the vehicle's are unknown.
            UnsupportedError: If neither the vehicle nor its proxy can fly to a position.
            LinkError: If the link is down and ``wait`` is False; the command is not sent later.
            AuthorityError: If the authority is not held, or another application takes it over.
            ClosedError: If the drone is closed.
            UsageError: If a number is invalid, or if called with ``wait`` from an inline callback; nothing is sent.
        """
    async def return_to_start(
        self, height_m: float | None = None, *, land: bool | None = None, wait: bool = True, timeout_s: float = 180.0
    ) -> None:
        """Fly back to where the vehicle took off, and then land or hover.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        If the vehicle is below a safe height, it first climbs straight up, within ``limits.altitude``, the ceiling of
        the room and the top of the safety box. It then flies straight to a point above its start
        (:attr:`start_position`), as :meth:`go_to` does, and lands or hovers there. Any other command, another pilot or
        a failsafe ends the flight. The vehicle does not avoid obstacles.

        Args:
            height_m: Minimum height above the start during the flight [m]; None: the parameter ``return.height``.
            land: Whether to land at the start instead of hovering above it; None: the parameter ``return.land``.
            wait: Whether to wait until the vehicle has landed or hovers above its start, or only send the command.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If the flight does not end in time; the message gives the vehicle's state and a known reason.
            RefusedError: If the proxy refuses the flight, for example because the position or start is unknown, the
                vehicle is not flying, or a no-fly zone is in the way; or if a failsafe or another command ends it.
            UnsupportedError: If neither the vehicle nor its proxy can fly to a position.
            LinkError: If the link is down and ``wait`` is False; the command is not sent later.
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

        By default, a holder of lower priority is pre-empted immediately. With ``takeover="ask"``, the holder is asked
        first. A holder of lower priority is pre-empted when it agrees or after the proxy's ``authority.ask_s``. A
        holder of the same or higher priority may decline. Once granted, the authority is kept: it is requested again
        after a lost link, and regained after a pre-emption when the other application releases it.

        Args:
            priority: Priority from 0 (highest) to 31 (lowest); None: the priority of the previous request.
            wait_s: Maximum time to wait in the queue [s].
            for_s: How long to hold the authority [s], up to a day; after that, others can acquire it. None: unlimited.
            takeover: ``"now"`` pre-empts a holder of lower priority immediately; ``"ask"`` asks the holder first.
            stay: Whether to remain in the queue after ``wait_s`` instead of raising an error.

        Returns:
            The status: held or, if ``stay`` is True, possibly queued, with the position and the expected waiting time.

        Raises:
            AuthorityError: If the authority is not granted within ``wait_s`` (the message names the holder), if the
                proxy refuses the request, or if this application is only an observer.
            NoAnswerError: If the proxy does not answer the request.
            UsageError: If ``priority``, ``for_s`` or ``takeover`` is out of range.
            ClosedError: If the drone was closed.
        """
    async def release_authority(self) -> None:
        """Release the authority or leave the queue, and wait for the proxy's confirmation.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Does nothing if this application neither holds nor requests the authority.

        Raises:
            NoAnswerError: If the proxy does not answer.
            ClosedError: If the drone was closed.
        """
    async def next_feedback(self, timeout_s: float = 1.0, *, max_hz: float | None = None) -> Feedback:
        """Wait for feedback that has not been read yet, and return the newest sample.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            timeout_s: How long to wait [s].
            max_hz: As for :meth:`feedback`; may also return samples that other consumers requested.

        Raises:
            NoAnswerError: If no feedback arrives in time.
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
            NoAnswerError: If no frame arrives in time.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
    async def wait(self, state: Wanted, timeout_s: float = 10.0) -> Feedback:
        """Wait until the newest feedback meets a condition.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            state: A flight state or its name, several of them, or a function that tests feedback on this thread.
            timeout_s: How long to wait [s].

        Returns:
            The feedback that met the condition.

        Raises:
            NoAnswerError: If no feedback meets it in time; the message gives the current state.
            UnknownNameError: If no flight state has this name.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
    async def overview(self, timeout_s: float = 2.0) -> Overview:
        """Return the newest overview of all vehicles in the proxy's process, which has one row per vehicle.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Overviews arrive once a second and are much smaller than feedback, and therefore suit applications that watch
        many vehicles. The first call subscribes permanently and waits for the first overview.

        Args:
            timeout_s: How long to wait for the first overview [s].

        Raises:
            NoAnswerError: If no overview arrives in time, for example because the proxy is too old to send one.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback before the first overview has arrived.
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
        """Current status of this application's authority."""
    @property
    def link(self) -> LinkStatus:
        """State of both links: from the application to the proxy, and from the proxy to the vehicle.

        ``reason`` explains the last change or, while the proxy is lost, why the last attempt to reconnect failed.
        """
    @property
    def closed(self) -> bool:
        """Whether :meth:`close` has been called."""
    @property
    def now_ns(self) -> int:
        """Estimate of the time on the proxy's clock [ns]; in a stepped replay, the time in the recorded flight."""
    @property
    def clock_offset_ns(self) -> int:
        """Estimate of the proxy's clock minus this process's clock [ns]."""
    @property
    def clock_uncertainty_ns(self) -> int:
        """Maximum error of :attr:`clock_offset_ns`, and thus of ages and delays [ns]; 0 if both use the same clock."""
    @property
    def start_position(self) -> Vector | None:
        """Position of the last take-off in world axes: east, north, up [m]; None if unknown."""
    def age_s(self, sample: Feedback | Frame) -> float:
        """Return the time since a sample was captured [s]; the maximum error is ``clock_uncertainty_ns``."""
    def recent_events(self) -> list[Event]:
        """Return the last 256 events, oldest first."""
    def hover(self) -> bool:
        """Stop and hold position. See :class:`Drone` for return values and exceptions."""
    def idle(self) -> bool:
        """Keep the authority without changing what the vehicle does."""
    def velocity(self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Fly at a velocity given in the levelled body axes, which turn with the yaw but not with roll and pitch.

        See :class:`Drone` for return values and exceptions.

        Args:
            forward: Velocity along x, forward [m/s].
            left: Velocity along y, to the left [m/s].
            up: Velocity along z, up [m/s].
            yaw_rate: Yaw rate, counter-clockwise seen from above [rad/s].
        """
    def attitude(self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Hold an attitude while climbing or descending. See :class:`Drone` for return values and exceptions.

        Args:
            roll: Roll [rad]; right side down is positive and accelerates the vehicle to the right.
            pitch: Pitch [rad]; nose down is positive and accelerates the vehicle forward.
            climb: Vertical velocity, up positive [m/s].
            yaw_rate: Yaw rate, counter-clockwise seen from above [rad/s].
        """
    def emergency_stop(self) -> bool:
        """Cut the motors immediately: the vehicle falls.

        Requires ``access="pilot"`` but not the authority. The stop is sent immediately and repeated until the vehicle
        confirms it (``FlightState.EMERGENCY``). After 8 s it is abandoned with an event (``vehicle_message``, reason
        ``stop_given_up``). Until then, this connection sends nothing else: :meth:`velocity`, :meth:`hover` and similar
        methods return False; :meth:`takeoff` and :meth:`land` raise :class:`RefusedError`. A program with several
        connections must stop sending on the others itself. A stop not sent within 2 s is dropped.

        Returns:
            False if the link is down and the stop can't be sent immediately.

        Raises:
            AuthorityError: If this application is only an observer.
            UnsupportedError: If the vehicle can't stop its motors, or accepts no commands.
            ClosedError: If the drone was closed.
        """
    def reset_emergency(self) -> bool:
        """Leave the emergency state while on the ground.

        If the vehicle has not yet confirmed this application's stop, the reset is sent once it has, within 2 s.
        """
    def command(self, action: AnyAction) -> bool:
        """Make ``action`` the newest set-point. See :class:`Drone` for return values and exceptions."""
    def send_external_pose(
        self,
        position: Vector,
        quaternion: tuple[float, float, float, float],
        *,
        at_ns: int | None = None,
        position_std_m: float | None = None,
        attitude_std_rad: float | None = None,
    ) -> bool:
        """Send the vehicle its own externally measured pose, for an autopilot that uses it instead of GPS.

        Thread-safe; returns immediately. Requires no authority. Refusals cause events (``command_refused``).

        Args:
            position: Position [m]: x east, y north, z up.
            quaternion: Rotation from body axes (x forward, y left, z up) to world axes, as x, y, z, w.
            at_ns: Time of the measurement, on the proxy's clock [ns]; None: now.
            position_std_m: Standard deviation of the position [m], if known.
            attitude_std_rad: Standard deviation of the attitude [rad], if known.

        Returns:
            True if the pose was handed to the transport.

        Raises:
            AuthorityError: If this application only observes.
            UsageError: If a number is missing or not finite, if a standard deviation is negative, if the quaternion's
                length differs from 1 by more than 0.001, or if ``at_ns`` is out of range.
        """
    def emit(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: str) -> None:
        """Emit an event (number 0), only to this application's own callbacks.

        Args:
            kind: Kind of the event.
            text: Human-readable text.
            severity: Severity of the event.
            **data: Details, by name.
        """
    def annotate(self, frame: Frame, shapes: Iterable[Shape], source: str | None = None) -> bool:
        """Publish shapes drawn over a frame, for the cockpit and for recordings.

        Args:
            frame: The frame on which the shapes are drawn.
            shapes: Shapes in pixels of this frame; coordinates may be NumPy numbers.
            source: Name of the component that drew the shapes; None: this application. For each source and camera, new
                shapes replace the earlier ones.

        Returns:
            True if the shapes were handed to the transport.

        Raises:
            UsageError: If an item is not a shape, there are too many, coordinates are not finite, or colours are not
                within 0 to 255.
        """
    def feedback(self, *, max_age_s: float | None = None, max_hz: float | None = None) -> Feedback:
        """Return the newest feedback.

        An observer receives only as much data as its consumers need; if any of them sets no limit, it receives every
        sample. The first call of this method adds a permanent consumer. A pilot always receives everything.

        Args:
            max_age_s: Maximum age since capture [s]; None: no limit.
            max_hz: Maximum rate of new samples, 0.001 to 1000 Hz; None: no limit.

        Raises:
            NoAnswerError: If there is no feedback yet, or if the newest sample is older than ``max_age_s``.
            ClosedError: If the drone was closed.
            UsageError: If ``max_hz`` is out of range.
        """
    def frame(self, camera: str | None = None, *, max_age_s: float | None = None) -> Frame | None:
        """Return the newest frame without waiting. The first call subscribes to the camera permanently.

        Args:
            camera: Name of the camera; None: the vehicle's first camera.
            max_age_s: Maximum age since capture [s]; None: no limit.

        Returns:
            The frame; None if no frame has arrived yet, or if it is too old or can't be decoded.

        Raises:
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone was closed.
        """
    def result(self, processor: str, *, max_age_s: float | None = None) -> Result | None:
        """Return a processor's newest result without waiting. The first call subscribes to the processor permanently.

        Args:
            processor: Name of the processor.
            max_age_s: Maximum age since the frame's capture [s]; None: no limit.

        Returns:
            The result; None if no result has arrived yet or the newest one is too old.

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
    ) -> client.Listener[ReceivedFrame]:
        """Call ``function`` with the newest frame of a camera.

        Args:
            function: Called in its own thread with frames that it has not seen yet.
            camera: Name of the camera; None: the vehicle's first camera, whichever it is after a restart.
            depth: How many frames may wait, at least 1; older ones are dropped and counted.
            inline: Whether to call it on the receiving thread instead, with every frame. It must be quick and not wait.
            **how: As for :meth:`frames`.

        Raises:
            UsageError: If ``function`` is not callable or an option is out of range.
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

        Each frame is an H.264 access unit in Annex B format that can be decoded after its predecessors. The first one
        is a key frame. After a loss, the client requests a key frame from the proxy and delivers it next. Without
        ``kbit_s``, ``max_fps`` and ``scale``, frames arrive as the vehicle encoded them. If the vehicle doesn't send
        H.264, the proxy encodes them at the rate that the network path can carry.

        Args:
            function: Called in its own thread.
            camera: Name of the camera; None: the vehicle's first.
            kbit_s: Bit rate at which the proxy encodes [kbit/s]; clients with the same request share one encoder.
            max_fps: Maximum number of frames per second; None: no limit.
            scale: Factor for width and height, greater than 0 and at most 1.
            depth: How many frames may wait, at least 1; any further frames are lost.
            inline: Call it on the receiving thread instead. It must be quick and must not wait.

        Raises:
            UsageError: If ``function`` is not callable or an option is out of range.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone was closed.
        """
    def on_takeover(
        self, function: Callable[[TakeoverRequest], TakeoverAnswer | Awaitable[TakeoverAnswer]]
    ) -> Listener:
        """Call ``function`` when another application requests the authority that this application holds.

        ``function``, plain or a coroutine function, runs on the event loop.

        Args:
            function: Called on the event loop. It returns True to hand over the authority, False or a reason (a
                string) to decline, or None to leave the decision to the proxy. In any case, an application with a
                strictly higher priority wins after the proxy's ``authority.ask_s``.

        Raises:
            UsageError: If ``function`` is not callable.
            ClosedError: If the drone was closed.
        """
    def on_overview(
        self, function: Callable[[Overview], object | Awaitable[object]], *, inline: bool = False
    ) -> Listener:
        """Call ``function`` once a second with an overview of all vehicles in the proxy's process (:meth:`overview`).

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        It runs on the event loop.
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

        Like every ``on_...`` method, it returns a :class:`Listener`; the listener's ``cancel()`` ends the calls. It
        raises :class:`UsageError` if ``function`` is not callable and :class:`ClosedError` if the drone was closed.

        Args:
            function: Called on the event loop; samples replaced by newer ones are dropped and counted.
            inline: Whether to call it on the receiving thread instead, with every sample. It must not wait.
            max_hz: Maximum rate of samples, 0.001 to 1000 Hz; None: no limit. An observer receives no more than that
                unless another consumer requests more.
        """
    def on_event(self, function: Callable[[Event], object | Awaitable[object]], *, inline: bool = False) -> Listener:
        """Call ``function`` with each event, including the client's own (number 0).

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        Args:
            function: Called on the event loop; at most 256 events wait for it.
            inline: Whether to call it on the receiving thread instead. The client's own events are then delivered on
                the thread that emits them.
        """
    def on_link(self, function: Callable[[LinkStatus], object | Awaitable[object]]) -> Listener:
        """Call ``function`` on the event loop whenever one of the two links changes state; up to 256 changes wait.

        ``function``, plain or a coroutine function, runs on the event loop.
        """
    def on_command(
        self, function: Callable[[Applied], object | Awaitable[object]], *, inline: bool = False
    ) -> Listener:
        """Call ``function`` with the proxy's echo of every command from any application; up to 256 echoes may wait.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        It runs on the event loop.
        """
    def on_annotation(
        self, function: Callable[[Annotation], object | Awaitable[object]], *, inline: bool = False
    ) -> Listener:
        """Call ``function`` with the annotations that applications draw on frames; up to 256 annotations may wait.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        It runs on the event loop.
        """
    def on_log(self, function: Callable[[LogEntry], object | Awaitable[object]], *, inline: bool = False) -> Listener:
        """Call ``function`` with all applications' log entries (``drone.log``), including our own; up to 256 wait.

        ``function``, plain or a coroutine function, runs on the event loop; ``inline`` must be False.

        It runs on the event loop.
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
            max_age_s: Maximum age [s]. Results that are older when they would be delivered are skipped and counted in
                the listener's ``expired``. None: no limit.
            depth: How many results may wait, at least 1; None: 1 for a single processor, 256 for all processors.
            inline: Call it on the receiving thread instead. It must be quick and must not wait.

        Raises:
            UsageError: If ``function`` is not callable or another argument is out of range.
            ClosedError: If the drone was closed.
        """

class Listener:
    """A callback that runs on the event loop; its calls never overlap."""

    sync: client.Listener[Any]
    def __init__(self, sync: client.Listener[Any]) -> None: ...
    def cancel(self) -> None:
        """Stop calling the function. Does not wait for a running call."""
    @property
    def errors(self) -> int:
        """Number of calls that raised an exception."""
    @property
    def delivered(self) -> int:
        """Number of times the function has been called."""
    @property
    def dropped(self) -> int:
        """Number of samples replaced by newer ones before the function was ready for them."""

class Swarm:
    """Drones by name, returned by :func:`swarm`; ``drones["alpha"]`` is one :class:`Drone`; iterating yields all.

    Methods have the same names, arguments, results and errors as in :class:`skyloop.Swarm`. All commands except
    :meth:`emergency_stop` are coroutines. :meth:`feedback` is also a coroutine, because ``on_error`` may require a
    landing. Only one task at a time may await these coroutines; :meth:`emergency_stop` may be called at any time.
    """

    sync: client.Swarm
    def __init__(self, sync: client.Swarm) -> None: ...
    async def __aenter__(self) -> Swarm: ...
    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting."""
    @property
    def active(self) -> dict[str, Drone]:
        """The drones that receive commands, by name; see :attr:`skyloop.Swarm.active`."""
    def items(self) -> list[tuple[str, Drone]]:
        """Return the (name, drone) pairs of all drones, including drones that were set aside."""
    def __getitem__(self, name: str) -> Drone: ...
    def __iter__(self) -> Iterator[Drone]: ...
    def __repr__(self) -> str: ...
    async def each(self, function: Callable[[Drone], Awaitable[T]], what: str = "") -> dict[str, T]:
        """Await ``function`` for all active drones concurrently on this event loop.

        Cancelling this coroutine cancels all of its calls. Exceptions, ``what`` and the result work as in
        :meth:`skyloop.Swarm.each`.
        """
    def ticks(self, rate_hz: float = 20.0, seconds: float | None = None) -> AsyncIterator[Tick]:
        """Yield at a steady rate with absolute deadlines, for a loop that commands all drones.

        Ends when the swarm is closed. If an iteration takes longer than a period, the schedule restarts at the end of
        that iteration. When the loop ends, whether by time, a ``break``, an exception or Ctrl-C, any drone that still
        flies a velocity or attitude sent by the loop hovers immediately, because no newer command would follow.

        Args:
            rate_hz: Ticks per second, 0.1 to 200.
            seconds: Duration [s]; None: until the loop is left.

        Raises:
            UsageError: If ``rate_hz`` is out of range; the first iteration raises it.
        """
    async def close(self) -> None:
        """End all connections. Does not land the drones. Idempotent.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> None:
        """Make all active drones take off at the same time; see :meth:`Drone.takeoff`.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            wait: Whether to wait until every drone hovers.
            timeout_s: Maximum time to wait [s].
        """
    async def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> None:
        """Land all active drones at the same time, each at its current position; see :meth:`Drone.land`.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            wait: Whether to wait until every drone has landed.
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
        """Fly each drone straight to its own position, all of them at the same time; see :meth:`Drone.go_to`.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Nothing keeps the drones apart during the flight; use :class:`skyloop.control.formation_flight.Formation` to
        plan safe paths. Drones that were set aside are skipped.

        Args:
            places: Positions by name: x, y, z in the drone's world axes [m], optionally followed by the yaw [rad].
            speed: Maximum speed [m/s]; None: as fast as the limits allow.
            wait: Whether to wait until every drone has arrived, rather than only send the commands.
            timeout_s: How long to wait [s].
            tolerance_m: Maximum distance from the position on arrival [m].

        Raises:
            UnknownNameError: If a name is not that of a drone of the swarm; nothing is sent in that case.
            UsageError: If a position is invalid; nothing is sent in that case.
            SwarmError: Depending on ``on_error``.
            ClosedError: If the swarm was closed.
        """
    async def return_to_start(
        self, height_m: float | None = None, *, land: bool | None = None, wait: bool = True, timeout_s: float = 180.0
    ) -> None:
        """Fly all active drones back to where they took off, at the same time; see :meth:`Drone.return_to_start`.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Nothing keeps the drones apart during the flight.

        Args:
            height_m: Minimum height above the start during the flight [m]; None: each drone's ``return.height``.
            land: Whether to land at the start instead of hovering above it; None: each drone's ``return.land``.
            wait: Whether to wait until every drone has landed or hovers above its start.
            timeout_s: How long to wait [s].

        Raises:
            UsageError: If an argument is invalid; nothing is sent in that case.
            SwarmError: Depending on ``on_error``.
            ClosedError: If the swarm was closed.
        """
    async def hover(self) -> dict[str, bool]:
        """Make all active drones stop and hold position.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Drones flown by others are left alone; to take one of them back, call ``drones[name].hover()``.
        """
    async def idle(self) -> dict[str, bool]:
        """Keep the authority without changing what the vehicles do.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def velocity(
        self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0
    ) -> dict[str, bool]:
        """Fly all active drones at the same velocity, given in each drone's own levelled body axes.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            forward: Velocity along x, forward [m/s].
            left: Velocity along y, to the left [m/s].
            up: Velocity along z, up [m/s].
            yaw_rate: Yaw rate, counter-clockwise seen from above [rad/s].
        """
    async def attitude(
        self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0
    ) -> dict[str, bool]:
        """Make all active drones hold the same attitude; see :meth:`Drone.attitude`.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Args:
            roll: Roll [rad]; right side down is positive.
            pitch: Pitch [rad]; nose down is positive.
            climb: Vertical velocity, up positive [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].
        """
    async def reset_emergency(self) -> dict[str, bool]:
        """Make all active drones leave the emergency state while on the ground.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def command(self, action: AnyAction) -> dict[str, bool]:
        """Make ``action`` the newest set-point of all active drones; see :meth:`send`.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.
        """
    async def send(self, actions: Mapping[str, AnyAction]) -> dict[str, bool]:
        """Make each action the newest set-point of its drone, and send all of them at the same time.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        Drones that are set aside are skipped. A hover doesn't take a drone from someone else (see :meth:`hover`).

        Args:
            actions: Actions by drone name.

        Returns:
            For each name, True if the command was handed to the transport.

        Raises:
            UnknownNameError: If no drone of the swarm has one of the names; nothing is sent in that case.
            UsageError: If an action can't be commanded or has a number that is not finite; nothing is sent.
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
            max_age_s: Maximum age since capture [s]; a drone whose feedback is older has failed.
        """
    async def wait_all(self, wanted: Wanted, timeout_s: float = 10.0) -> dict[str, Feedback]:
        """Wait until all active drones meet a condition *at the same time*.

        This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.

        A drone whose link is lost does not meet the condition. Drones that don't meet it in time have failed.

        Args:
            wanted: A flight state or its name, several of them, or a function that tests feedback.
            timeout_s: How long to wait [s].

        Returns:
            The feedback of the drones that meet the condition, by name.

        Raises:
            UnknownNameError: If no flight state has this name.
            SwarmError: Depending on ``on_error``.
            ClosedError: If the swarm was closed.
        """
    @property
    def names(self) -> tuple[str, ...]:
        """Names of all drones, including drones that were set aside."""
    @property
    def errors(self) -> dict[str, Exception]:
        """Reasons, by name, why drones do not take part: they were set aside, or were never connected."""
    def readmit(self, *names: str) -> None:
        """Reactivate drones that were set aside.

        Args:
            *names: Names of the drones; if none are given, all drones.

        Raises:
            UnknownNameError: If no drone of the swarm has one of the names.
        """
    def emergency_stop(self) -> dict[str, bool]:
        """Cut the motors of all drones immediately, including drones that were set aside: they fall.

        Raises:
            SwarmError: If the command could not be sent to some drones, regardless of ``on_error``.
        """
    @property
    def spread(self) -> Distribution | None:
        """Times between the first and the last command of each :meth:`send` [s], over the last 1024; None if none."""
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

    Returns once the vehicle's state is known and, with ``access="pilot"``, once this application may command it. If the
    vehicle has just started, the call logs this (``skyloop``) and waits until the vehicle can take off. After
    ``timeout_s`` or 60 s it returns in any case, and :meth:`Drone.takeoff` waits for the remaining time.

    Args:
        target: Name of a running proxy, or a vehicle's address, such as ``sim://?seed=3`` or ``video://flight.mp4``.
            An address starts a private proxy, which ends when the drone is closed or this process ends. A name is
            looked up first on this host and then, if ``network`` allows it, on the network.
        access: ``"pilot"`` requests the authority; ``"observe"`` only reads.
        name: Name of this application, 1 to 64 characters; None: the name of the running script.
        timeout_s: Time limit for the proxy to answer and the vehicle to start up [s]. None or 0: 5 s for a name or 20 s
            for an address, then 60 s for the vehicle.
        rate_hz: Rate at which commands are repeated, 1 to 200 Hz.
        stall_s: Time without a call after which a velocity or attitude decays to hover [s]; ``math.inf``: never.
        on_exit: What an airborne vehicle does at the end of the ``with`` block: ``"land"`` or ``"hover"``. A vehicle
            flown by someone else is left alone, and the log warns about it.
        authority: How a pilot requests the authority: its priority, how long it waits, and whether it asks the holder
            first. None: ``Authority()``.
        network: True, an address, or a :class:`Network` with keys; False searches only this host. None: the value of
            the variable ``SKYLOOP_NETWORK``; if it is not set, only this host.

    Raises:
        UnknownNameError: If no proxy of this name is running; the error suggests similar names.
        NoAnswerError: If the proxy does not answer in time, or sends no feedback.
        AuthorityError: If the authority is not granted; the message names the holder.
        RefusedError: If the proxy refuses the connection.
        LinkError: If the proxy can't be reached or ends.
        UsageError: If an argument is out of range, or the address is invalid.
        MissingExtraError: If ``network`` is used and the extra ``network`` is not installed.
    """

def swarm(
    *targets: Target, on_error: OnError = "continue", missing: Missing = "raise", **options: Unpack[ConnectOptions]
) -> Opening[Swarm]:
    """Connect to several drones at the same time, and return once all of them are connected.

    The result connects when it is awaited, or entered with ``async with``. ``speed=max`` is refused.

    Args:
        *targets: Names of running proxies, patterns such as ``"drone*"`` for running proxies, addresses of vehicles
            such as ``"sim://?seed=1"`` (named ``sim1``, ``sim2``, …), or mappings from a name of your choice to either,
            ``{"left": "sim://?seed=1"}``.
        on_error: What the other drones do when one fails; see :class:`Swarm`.
        missing: How to handle drones that can't be connected: ``"raise"`` fails the call, ``"skip"`` leaves them out
            as long as at least one drone connects.
        **options: As for :func:`skyloop.connect`, for each drone.

    Returns:
        The swarm, a context manager.

    Raises:
        SwarmError: If drones can't be connected, with the reason for each; the others are closed.
        UnknownNameError: If a pattern matches no running proxy.
        UsageError: If a drone is named twice, no drone is named, or ``on_error`` or ``missing`` is unknown.
    """

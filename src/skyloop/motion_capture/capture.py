"""Motion capture for applications: newest poses, callbacks and calibration."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol, Self, TypeVar

from skyloop.client.channels import Channel, Listener
from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.control.waypoint import Fix
from skyloop.errors import ClosedError, NoAnswerError, UnknownNameError, UsageError
from skyloop.messages import Severity
from skyloop.messages.relayed import MOCAP
from skyloop.motion_capture.pose import REST_S, BodyPose, Calibration, Track, TrackState, calibrate, plausible, z_up
from skyloop.motion_capture.source import RawFrame, System

if TYPE_CHECKING:
    from skyloop.client import Drone

CHECK_S: Final = 0.05  #: interval between checks for lost bodies
EVENT_DEPTH: Final = 256  #: maximum number of events waiting for a slow callback
MAX_UNKNOWN: Final = 1000  #: maximum number of names to remember for bodies that were not requested
T = TypeVar("T")
_log = logging.getLogger("skyloop")


@dataclass(frozen=True, slots=True)
class TrackEvent:
    """A change in the tracking of a body, or a problem with the system."""

    at_ns: int  #: time on this host's monotonic clock
    body: str  #: name of the body; empty if the event concerns the system
    state: TrackState
    text: str


OnPose = Callable[[BodyPose], object]
OnEvent = Callable[[TrackEvent], object]


class Source(Protocol):
    """A source of frames."""

    def start(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...


#: Function that creates a source, given the system, its names for bodies, and callbacks for frames and problem texts.
MakeSource = Callable[[System, Iterable[str], Callable[[RawFrame], None], Callable[[str], None]], Source]


class MotionCapture:
    """Poses of bodies tracked by a motion capture system. A context manager created by :func:`skyloop.mocap`.

    Methods can be called from any thread. Callbacks run on separate threads. With ``inline=True``, callbacks run on the
    receiving thread (event callbacks also on the thread that checks for lost bodies) and must be quick. Exceptions in
    callbacks are counted and logged and do not affect other callbacks.

    Attributes:
        system: The system.
        bodies: Names of drones, mapped to the system's names for their bodies.
        latency_ns: Age of poses on arrival, as specified in the address.
        unknown: Bodies seen by the system but not named in ``bodies``.
    """

    def __init__(self, system: System, bodies: Mapping[str, str], make: MakeSource) -> None:
        """Initialise without connecting; :func:`skyloop.mocap` also opens the connection.

        Args:
            system: The system.
            bodies: Names of drones, mapped to the system's names for their bodies.
            make: A function that creates the source of frames.

        Raises:
            UsageError: ``bodies`` is empty or maps two names to one body.
        """
        if not bodies or not all(isinstance(one, str) and one for pair in bodies.items() for one in pair):
            raise UsageError(f'bodies is {bodies!r} and must map names, such as {{"alpha": "alpha_body"}}')
        if len(set(bodies.values())) < len(bodies):
            raise UsageError(f"bodies is {bodies!r} and must not map two names to one body")
        self.system = system
        self.bodies = dict(bodies)
        self.latency_ns = nanoseconds(system.latency_s)
        self.unknown: set[str] = set()
        self._names = {theirs: ours for ours, theirs in bodies.items()}
        self._tracks = {name: Track(name, may_freeze=system.kind == "sim") for name in bodies}
        self._reported = dict.fromkeys(bodies, TrackState.WAITING)
        self._troubled = ""  # last reported problem; empty once a frame arrives
        self._calibrations: dict[str, Calibration] = {}
        self._measured: dict[str, list[BodyPose]] = {}  # uncalibrated poses for calibrations in progress
        self._poses: Channel[BodyPose] = Channel()
        self._events: Channel[TrackEvent] = Channel()
        self._listeners: list[Listener[Any]] = []
        self._changed = threading.Condition()
        self._ended = threading.Event()
        self._source = make(system, self._names, self._take, self._trouble)
        self._watch = threading.Thread(target=self._watch_tracks, name="skyloop-mocap-watch", daemon=True)

    # Life cycle ------------------------------------------------------------------------------------------------

    def _open(self, timeout_s: float = 5.0) -> Self:
        """Connect and wait for the first frame."""
        self._source.start(timeout_s)
        self._watch.start()
        return self

    def close(self) -> None:
        """Disconnect and end the threads. Idempotent."""
        if self._ended.is_set():
            return
        self._ended.set()
        self._source.close()
        if self._watch.ident is not None and self._watch is not threading.current_thread():  # for inline callbacks
            self._watch.join()
        for listener in list(self._listeners):
            listener.cancel()
        with self._changed:
            for track in self._tracks.values():
                track.end()
            self._changed.notify_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Reading ---------------------------------------------------------------------------------------------------

    def pose(self, name: str) -> BodyPose | None:
        """Return the newest pose of a body if it is currently tracked, otherwise None; never an old pose.

        Raises:
            UnknownNameError: ``bodies`` does not contain this name.
        """
        track = self._track(name)
        with self._changed:
            track.update(monotonic_ns() - self.latency_ns)  # the watch thread may lag behind
            return track.pose

    def state(self, name: str) -> TrackState:
        """Return whether a body is tracked.

        Raises:
            UnknownNameError: ``bodies`` does not contain this name.
        """
        return self._track(name).state

    def wait(self, name: str, timeout_s: float = 5.0) -> BodyPose:
        """Wait until a body is tracked and return its pose.

        Args:
            name: One of the names in ``bodies``.
            timeout_s: Maximum time to wait [s].

        Raises:
            NoAnswerError: The body was not tracked within this time; the message lists the bodies seen by the system.
            ClosedError: The motion capture has been closed.
            UnknownNameError: ``bodies`` does not contain this name.
        """
        track = self._track(name)
        with self._changed:
            self._changed.wait_for(lambda: track.pose is not None or self._ended.is_set(), timeout_s)
            if track.pose is not None:
                return track.pose
        self._check_open()
        others = f"; it sees {', '.join(sorted(self.unknown))}" if self.unknown else "; it sees no other body"
        raise NoAnswerError(
            f"{self.system.address} does not track {self.bodies[name]!r} (for {name}) within {timeout_s:g} s{others}"
        )

    def on_pose(self, function: OnPose, *, depth: int = 1, inline: bool = False) -> Listener[BodyPose]:
        """Call ``function`` with the newest pose of any body.

        Like all ``on_...`` methods of a drone, it returns a :class:`skyloop.client.Listener`. To stop the calls, call
        its ``cancel()`` or leave its ``with`` block.

        Args:
            function: A function called on a separate thread; poses superseded by newer ones are dropped and counted.
            depth: Maximum number of poses waiting for the function, for example one per body.
            inline: Whether to call the function with every pose on the receiving thread, which it must not block.

        Raises:
            UsageError: ``function`` is not callable, or ``depth`` is less than 1.
            ClosedError: The motion capture has been closed.
        """
        return self._listen(self._poses, function, "pose", depth, inline)

    def on_event(self, function: OnEvent, *, inline: bool = False) -> Listener[TrackEvent]:
        """Call ``function`` whenever a body is found or lost, or the system has a problem.

        The return value and exceptions are the same as for :meth:`on_pose`.

        Args:
            function: A function called on a separate thread; up to 256 events wait for it.
            inline: Whether to call the function on the thread that detected the change instead of a separate one.
        """
        return self._listen(self._events, function, "event", EVENT_DEPTH, inline)

    def _listen(
        self, channel: Channel[T], function: Callable[[T], object], name: str, depth: int, inline: bool
    ) -> Listener[T]:
        self._check_open()
        if not callable(function):
            raise UsageError(f"{function!r:.80} can't be called: give a function with one argument")
        if isinstance(depth, bool) or not isinstance(depth, int) or depth < 1:
            raise UsageError(f"depth is {depth!r} and must be a whole number of at least 1")
        listener = Listener(
            function,
            channel,
            _reported_by_the_log,
            name=f"motion capture's {name} callback",
            depth=depth,
            inline=inline,
            on_cancel=self._cancelled,
        )
        self._listeners.append(listener)
        return listener

    def _cancelled(self, listener: Listener[Any]) -> None:
        with suppress(ValueError):
            self._listeners.remove(listener)

    # For drones and controllers ---------------------------------------------------------------------------------

    def link(self, drone: Drone, *, max_hz: float = 100.0, to_vehicle: bool = False) -> Linked:
        """Log a drone's poses in the drone's log, for recordings and the cockpit; losses of tracking are logged, too.

        Args:
            drone: The drone; its proxy's name must be in ``bodies``.
            max_hz: Maximum rate of the logged poses, 1 to 1000.
            to_vehicle: Whether to also send the poses to the vehicle (:meth:`Drone.send_external_pose`), which may use
                them to fly.

        Returns:
            A context manager; poses are logged within its block.

        Raises:
            UnknownNameError: ``bodies`` does not contain this name.
            UsageError: ``max_hz`` is out of range.
        """
        self._track(drone.name)
        return Linked(self, drone, max_hz, to_vehicle)

    def source(self, drone: Drone) -> Callable[[], Fix | None]:
        """Return a position source for controllers: ``FollowPath(drone, path, source=capture.source(drone))``.

        Raises:
            UnknownNameError: ``bodies`` does not contain this name.
        """
        name = drone.name
        self._track(name)  # raises UnknownNameError early if the name is unknown

        def newest() -> Fix | None:
            pose = self.pose(name)
            if pose is None:
                return None
            return Fix(pose.captured_ns + drone.clock_offset_ns, pose.position_m, pose.yaw_rad, pose.velocity_m_s)

        return newest

    # Calibration -----------------------------------------------------------------------------------------------

    def calibrate(self, drone: Drone, *, heading: float = 0.0, seconds: float = REST_S) -> Calibration:
        """Measure the rotation between a tracked body's axes and the axes of a drone that rests on the ground.

        Afterwards, poses of the body are converted to poses of the drone. Until then, an earlier calibration is used.

        Args:
            drone: The drone; its proxy's name must be in ``bodies``.
            heading: Heading of the drone's nose in world axes [rad], counter-clockwise from x.
            seconds: Time for collecting poses [s].

        Raises:
            UsageError: The drone is flying or moving, or there are too few poses.
            NoAnswerError: The drone is not tracked.
            ClosedError: The motion capture has been closed.
        """
        name = drone.name
        self.wait(name)
        if drone.feedback().state.airborne:
            raise UsageError(f"{name} is flying: land it before calibrating it")
        poses = self._measured[name] = []
        try:
            if self._ended.wait(seconds):
                self._check_open()
        finally:
            del self._measured[name]
        feedback = drone.feedback()
        found = calibrate(
            poses, roll=feedback.roll_rad or 0.0, pitch=feedback.pitch_rad or 0.0, yaw=feedback.yaw_rad, heading=heading
        )
        self._calibrations[name] = found
        return found

    # Called by the source -------------------------------------------------------------------------------------

    def _take(self, frame: RawFrame) -> None:
        """Handle a frame from the system."""
        self._troubled = ""
        captured_ns = frame.received_ns - self.latency_ns
        for theirs, (position, quaternion) in frame.bodies.items():
            name = self._names.get(theirs)
            if name is None:
                if len(self.unknown) < MAX_UNKNOWN:
                    self.unknown.add(theirs)
            elif plausible(position, quaternion):
                if self.system.up == "y":
                    position, quaternion = z_up(position, quaternion)
                self._add(self._tracks[name], captured_ns, BodyPose(name, captured_ns, position, quaternion))

    def _add(self, track: Track, captured_ns: int, seen: BodyPose) -> None:
        with self._changed:
            measured = self._measured.get(track.body)
            if measured is not None:
                measured.append(seen)
            calibration = self._calibrations.get(track.body)
            seen = seen if calibration is None else calibration.apply(seen)
            pose = track.add(captured_ns, seen.position_m, seen.quaternion)
            self._changed.notify_all()
        if pose is not None:
            self._report(track)
            self._poses.publish(pose)

    def _trouble(self, text: str) -> None:
        if text != self._troubled:  # a source may keep failing for the same reason
            self._troubled = text
            self._publish_event("", TrackState.LOST, text)

    def _watch_tracks(self) -> None:
        while not self._ended.wait(CHECK_S):
            for track in self._tracks.values():
                with self._changed:
                    track.update(monotonic_ns() - self.latency_ns)  # age of the poses on arrival
                self._report(track)

    def _report(self, track: Track) -> None:
        """Publish one event for each change in a body's state."""
        with self._changed:
            before, state = self._reported[track.body], track.state
            self._reported[track.body] = state
        if state is TrackState.LOST and before is not state:
            self._publish_event(track.body, state, f"{track.body} is no longer tracked")
        elif state is TrackState.TRACKED and before is not state:
            again = "again" if before is TrackState.LOST else "now"
            self._publish_event(track.body, state, f"{track.body} is tracked {again}")

    def _publish_event(self, body: str, state: TrackState, text: str) -> None:
        _log.log(logging.WARNING if state is TrackState.LOST else logging.INFO, "motion capture: %s", text)
        self._events.publish(TrackEvent(monotonic_ns(), body, state, text))

    def _track(self, name: str) -> Track:
        if name not in self._tracks:
            raise UnknownNameError("body", name, self._tracks)
        return self._tracks[name]

    def _check_open(self) -> None:
        if self._ended.is_set():
            raise ClosedError("this motion capture was closed")


def _reported_by_the_log(name: str, error: Exception | SystemExit) -> None:
    """Do nothing: motion capture has no events for program errors, and the listener logs them."""


class Linked:
    """Logs a drone's poses in the drone's log until closed. See :meth:`MotionCapture.link`."""

    def __init__(self, capture: MotionCapture, drone: Drone, max_hz: float, to_vehicle: bool = False) -> None:
        """Initialise; logging starts with the ``with`` block."""
        if not 1.0 <= max_hz <= 1000.0:
            raise UsageError(f"max_hz is {max_hz!r} and must be from 1 to 1000")
        self._capture = capture
        self._drone = drone
        self._period_ns = nanoseconds(1.0 / max_hz)
        self._to_vehicle = to_vehicle
        self._due_ns = 0
        self._listeners: list[Listener[Any]] = []

    def __enter__(self) -> Self:
        self._listeners.append(self._capture.on_pose(self._pose, inline=True))
        self._listeners.append(self._capture.on_event(self._event, inline=True))
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop logging. Idempotent."""
        while self._listeners:
            self._listeners.pop().cancel()

    def _pose(self, pose: BodyPose) -> None:
        if pose.body != self._drone.name or pose.captured_ns < self._due_ns:
            return
        # Accept poses a quarter of a period early; otherwise, a rate close to the system's own would be halved.
        self._due_ns = pose.captured_ns + self._period_ns * 3 // 4
        values = (*pose.position_m, *pose.quaternion, *(pose.velocity_m_s or ()))
        at_ns = pose.captured_ns + self._drone.clock_offset_ns
        if self._to_vehicle:  # sent first, because the vehicle uses the pose to fly
            self._drone.send_external_pose(pose.position_m, pose.quaternion, at_ns=at_ns)
        self._drone.log.array(MOCAP, values, at_ns=at_ns)

    def _event(self, event: TrackEvent) -> None:
        if event.body in ("", self._drone.name):
            lost = event.state is TrackState.LOST
            severity = Severity.WARNING if lost else Severity.INFO
            self._drone.log.text(event.text, name=MOCAP, severity=severity)

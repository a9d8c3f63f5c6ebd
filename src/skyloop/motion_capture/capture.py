"""Motion capture as an application sees it: where each body is, now and as it moves."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Final, Protocol, Self, TypeVar

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.errors import ClosedError, NoAnswerError, UnknownNameError, UsageError
from skyloop.motion_capture.address import System
from skyloop.motion_capture.calibration import REST_S, Calibration, calibrate
from skyloop.motion_capture.linking import Linked, fixes
from skyloop.motion_capture.pose import BodyPose, plausible, z_up
from skyloop.motion_capture.tracking import Track, TrackState
from skyloop.motion_capture.worker import RawFrame

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.control.position import Fix

LOOK_S: Final = 0.05  #: how often it is judged whether a body is lost
T = TypeVar("T")
_log = logging.getLogger("skyloop")


@dataclass(frozen=True, slots=True)
class TrackEvent:
    """The tracking of a body changed, or the system has something to tell."""

    at_ns: int  #: on this host's monotonic clock
    body: str  #: empty where it is about the system
    state: TrackState
    text: str


OnPose = Callable[[BodyPose], object]
OnEvent = Callable[[TrackEvent], object]


class Source(Protocol):
    """Where frames come from."""

    def start(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...


#: Makes a source for a system and the names of bodies in it; it hands each frame on, and tells in words of trouble.
MakeSource = Callable[[System, Iterable[str], Callable[[RawFrame], None], Callable[[str], None]], Source]


class MotionCapture:
    """Poses of the bodies that a motion capture system tracks; made by :func:`skyloop.mocap`. A context manager.

    Every method may be called from any thread; listeners are called on the receiving thread and must be quick.
    """

    def __init__(self, system: System, bodies: Mapping[str, str], make: MakeSource) -> None:
        """``bodies``: our names, those of the drones, to the names that the system knows them by."""
        if not bodies or not all(isinstance(one, str) and one for pair in bodies.items() for one in pair):
            raise UsageError(f'bodies is {bodies!r} and must map names, as {{"alpha": "alpha_body"}}')
        if len(set(bodies.values())) < len(bodies):
            raise UsageError(f"bodies is {bodies!r}: two names for one body")
        self.system = system
        self.bodies = dict(bodies)
        self.latency_ns = nanoseconds(system.latency_s)
        self.unknown: set[str] = set()  #: bodies that the system sees and nobody asked for
        self._names = {theirs: ours for ours, theirs in bodies.items()}
        self._tracks = {name: Track(name, may_freeze=system.kind == "sim") for name in bodies}
        self._told = dict.fromkeys(bodies, TrackState.WAITING)
        self._calibrations: dict[str, Calibration] = {}
        self._pose_listeners: list[OnPose] = []
        self._event_listeners: list[OnEvent] = []
        self._changed = threading.Condition()
        self._ended = threading.Event()
        self._source = make(system, self._names, self.take, self._trouble)
        self._watch = threading.Thread(target=self._look_on, name="skyloop-mocap-watch", daemon=True)

    # Life cycle ------------------------------------------------------------------------------------------------

    def open(self, timeout_s: float = 5.0) -> Self:
        """Connect; returns with the first frame. Raises :class:`LinkError` and :class:`MissingExtraError`."""
        self._source.start(timeout_s)
        self._watch.start()
        return self

    def close(self) -> None:
        """End it. Idempotent."""
        if self._ended.is_set():
            return
        self._ended.set()
        self._source.close()
        if self._watch.ident is not None:
            self._watch.join()
        with self._changed:
            for track in self._tracks.values():
                track.end()
            self._changed.notify_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    # Reading ---------------------------------------------------------------------------------------------------

    def pose(self, name: str) -> BodyPose | None:
        """The newest pose of a body while it is tracked; None while it is not. Never an old one."""
        track = self._track(name)
        with self._changed:
            track.look(monotonic_ns())  # the thread that looks on may be late
            return track.pose

    def state(self, name: str) -> TrackState:
        """Whether a body is tracked."""
        return self._track(name).state

    def wait(self, name: str, timeout_s: float = 5.0) -> BodyPose:
        """The pose of a body, once it is tracked. Raises :class:`NoAnswerError` with what the system sees instead."""
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

    @contextmanager
    def on_pose(self, function: OnPose) -> Iterator[None]:
        """While in this block, call a function with each pose of each body, on the receiving thread."""
        self.listen(pose=function)
        try:
            yield
        finally:
            self.listen_no_more(pose=function)

    @contextmanager
    def on_event(self, function: OnEvent) -> Iterator[None]:
        """While in this block, call a function whenever a body is found or lost, or the system has trouble."""
        self.listen(event=function)
        try:
            yield
        finally:
            self.listen_no_more(event=function)

    def listen(self, pose: OnPose | None = None, event: OnEvent | None = None) -> None:
        """As :meth:`on_pose` and :meth:`on_event`, until :meth:`listen_no_more`."""
        for function in (pose, event):
            if function is not None and not callable(function):
                raise UsageError(f"{function!r:.80} can't be called: a function with one argument is needed")
        if pose is not None:
            self._pose_listeners.append(pose)
        if event is not None:
            self._event_listeners.append(event)

    def listen_no_more(self, pose: OnPose | None = None, event: OnEvent | None = None) -> None:
        """Idempotent."""
        if pose in self._pose_listeners:
            self._pose_listeners.remove(pose)
        if event in self._event_listeners:
            self._event_listeners.remove(event)

    # For others ------------------------------------------------------------------------------------------------

    def link(self, drone: Drone, *, max_hz: float = 100.0, to_vehicle: bool = False) -> Linked:
        """While in the block of what this returns, tell a drone's poses with the drone: recorders write them, and the
        cockpit shows them. Lost tracking is told too. A drone is known by its proxy's name.

        ``to_vehicle``: tell them the vehicle itself besides (:meth:`Drone.tell_pose`), which may fly by them."""
        self._track(drone.name)
        return Linked(self, drone, max_hz, to_vehicle)

    def source(self, drone: Drone) -> Callable[[], Fix | None]:
        """What path controllers take as ``source``: ``FollowPath(drone, path, source=capture.source(drone))``."""
        return fixes(self, drone)

    # Calibration -----------------------------------------------------------------------------------------------

    def calibrate(self, drone: Drone, *, heading: float = 0.0, seconds: float = REST_S) -> Calibration:
        """Find how the tracked body's axes lie to the drone's, while it stands on the ground at rest, nose to
        ``heading`` [rad] in the world. Poses of that body are the drone's from then on.

        Raises :class:`UsageError` if it flies or moves, :class:`NoAnswerError` if it is not tracked.
        """
        name = drone.name
        self.wait(name)
        if drone.feedback().state.airborne:
            raise UsageError(f"{name} flies: a calibration needs it at rest on the ground")
        poses: list[BodyPose] = []
        self._calibrations.pop(name, None)
        with self.on_pose(lambda pose: poses.append(pose) if pose.body == name else None):
            if self._ended.wait(seconds):
                self._check_open()
        feedback = drone.feedback()
        found = calibrate(
            poses, roll=feedback.roll or 0.0, pitch=feedback.pitch or 0.0, yaw=feedback.yaw, heading=heading
        )
        self._calibrations[name] = found
        return found

    # What the source calls -------------------------------------------------------------------------------------

    def take(self, frame: RawFrame) -> None:
        """A frame of the system."""
        captured_ns = frame.received_ns - self.latency_ns
        for theirs, (position, quaternion) in frame.bodies.items():
            name = self._names.get(theirs)
            if name is None:
                self.unknown.add(theirs)
            elif plausible(position, quaternion):
                if self.system.up == "y":
                    position, quaternion = z_up(position, quaternion)
                self._add(self._tracks[name], captured_ns, BodyPose(name, captured_ns, position, quaternion))

    def _add(self, track: Track, captured_ns: int, seen: BodyPose) -> None:
        with self._changed:
            calibration = self._calibrations.get(track.body)
            seen = seen if calibration is None else calibration.apply(seen)
            pose = track.add(captured_ns, seen.position, seen.quaternion)
            self._changed.notify_all()
        if pose is not None:
            self._report(track)
            _call(self._pose_listeners, pose)

    def _trouble(self, text: str) -> None:
        self._tell("", TrackState.LOST, text)

    def _look_on(self) -> None:
        while not self._ended.wait(LOOK_S):
            for track in self._tracks.values():
                with self._changed:
                    track.look(monotonic_ns())
                self._report(track)

    def _report(self, track: Track) -> None:
        """Tell once of each change of a body's state."""
        with self._changed:
            before, state = self._told[track.body], track.state
            self._told[track.body] = state
        if state is TrackState.LOST and before is not state:
            self._tell(track.body, state, f"{track.body} is not tracked any more")
        elif state is TrackState.TRACKED and before is not state:
            again = "again" if before is TrackState.LOST else "now"
            self._tell(track.body, state, f"{track.body} is tracked {again}")

    def _tell(self, body: str, state: TrackState, text: str) -> None:
        _log.log(logging.WARNING if state is TrackState.LOST else logging.INFO, "motion capture: %s", text)
        _call(self._event_listeners, TrackEvent(monotonic_ns(), body, state, text))

    def _track(self, name: str) -> Track:
        if name not in self._tracks:
            raise UnknownNameError("body", name, self._tracks)
        return self._tracks[name]

    def _check_open(self) -> None:
        if self._ended.is_set():
            raise ClosedError("this motion capture was closed")


def _call(listeners: list[Callable[[T], object]], sample: T) -> None:
    """A listener that raises costs only itself, and is told of in the log."""
    for function in list(listeners):
        try:
            function(sample)
        except Exception:  # noqa: BLE001  the user's code may raise anything
            _log.exception("a motion capture listener failed")

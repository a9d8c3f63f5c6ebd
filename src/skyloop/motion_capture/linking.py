"""Poses for others: into recordings and the cockpit through the drone's log, and as a source for path controllers."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

from skyloop.clock import nanoseconds
from skyloop.control.position import Fix
from skyloop.errors import UsageError
from skyloop.messages import Severity
from skyloop.messages.log import MOCAP
from skyloop.motion_capture.pose import BodyPose
from skyloop.motion_capture.tracking import TrackState

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.motion_capture.capture import MotionCapture, TrackEvent


class Linked:
    """Logs each pose of a drone with the drone, until closed. A context manager; made by ``MotionCapture.link``."""

    def __init__(self, capture: MotionCapture, drone: Drone, max_hz: float, to_vehicle: bool = False) -> None:
        if not 1.0 <= max_hz <= 1000.0:
            raise UsageError(f"max_hz is {max_hz!r} and must be from 1 to 1000")
        self._capture = capture
        self._drone = drone
        self._period_ns = nanoseconds(1.0 / max_hz)
        self._to_vehicle = to_vehicle
        self._due_ns = 0

    def __enter__(self) -> Self:
        self._capture.listen(self._pose, self._event)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Log no more. Idempotent."""
        self._capture.listen_no_more(self._pose, self._event)

    def _pose(self, pose: BodyPose) -> None:
        if pose.body != self._drone.name or pose.captured_ns < self._due_ns:
            return
        # A little early is in time: else a rate near the system's own would halve it.
        self._due_ns = pose.captured_ns + self._period_ns * 3 // 4
        values = (*pose.position, *pose.quaternion, *(pose.velocity or ()))
        at_ns = pose.captured_ns + self._drone.clock_offset_ns
        if self._to_vehicle:  # first: it flies by it
            self._drone.tell_pose(pose.position, pose.quaternion, at_ns=at_ns)
        self._drone.log.array(MOCAP, values, at_ns=at_ns)

    def _event(self, event: TrackEvent) -> None:
        if event.body in ("", self._drone.name):
            lost = event.state is TrackState.LOST
            severity = Severity.WARNING if lost else Severity.INFO
            self._drone.log.text(event.text, name=MOCAP, severity=severity)


def fixes(capture: MotionCapture, drone: Drone) -> Callable[[], Fix | None]:
    """A ``source`` for path controllers: the newest pose of that drone, with its time on the proxy's clock."""
    name = drone.name
    capture.state(name)  # an unknown name is told now

    def newest() -> Fix | None:
        pose = capture.pose(name)
        if pose is None:
            return None
        return Fix(pose.captured_ns + drone.clock_offset_ns, pose.position, pose.yaw, pose.velocity)

    return newest

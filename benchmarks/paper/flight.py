"""The experiment's application: a path controller through waypoints by motion capture, with stamps of its inputs."""

from __future__ import annotations

import threading
from collections import deque
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

from benchmarks.paper.marks import (
    APPLICATION,
    CORNERS,
    FEEDBACK_HEARD,
    HOLD_S,
    SPEED_M_S,
    TARGET,
    VIDEO_HEARD,
    WAYPOINTS,
)
from skyloop.clock import monotonic_ns
from skyloop.control.path_law import Waypoints

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame
    from skyloop.control.waypoint import Fix, PositionSource
    from skyloop.messages import Feedback

FLUSH_S: Final = 1.0
_LEG_S: Final = 4.0  # time for the fastest leg, which bounds the number of waypoints
Row = tuple[int, int, int]


class PaperFlight(Waypoints):
    """Flies rounds through the corners for as long as it runs, and logs its planned position.

    It pauses while others fly; when control returns, it flies back to its position on the path and continues.
    """

    def __init__(self, drone: Drone, source: PositionSource, seconds: float) -> None:
        """Prepare the flight.

        Args:
            drone: The drone.
            source: Provides the vehicle's position.
            seconds: Maximum duration [s].
        """
        rounds = int(seconds / _LEG_S / len(CORNERS)) + 1
        super().__init__(drone, CORNERS * rounds, speed_m_s=SPEED_M_S, hold_s=HOLD_S, source=self._keep)
        self.takeovers = 0
        self.away = False  #: whether others fly, or it is on the way back to its path
        self._from = source
        self._fix: Fix | None = None

    @property
    def off_m(self) -> float | None:
        """Distance from the planned position now [m]; None while it does not fly the path."""
        return None if self._law is None or self.away else self._law.off_m

    def on_feedback(self, feedback: Feedback) -> None:
        """Continue to fly, or pause while others fly."""
        if self.drone.authority.state in ("preempted", "queued"):
            self.takeovers += not self.away
            self.away = True
            if self._law is not None:
                self._law.pause()
            return
        super().on_feedback(feedback)
        law, fix = self._law, self._fix
        if law is None or fix is None or self.lost:
            return
        if self.away and law.off_m <= self.settings.near_m:
            self.away = False
        if not self.away:
            self.drone.log.array(TARGET, [*law.target[0], float(self.reached)], at_ns=fix.at_ns)

    def _keep(self) -> Fix | None:
        self._fix = self._from()
        return self._fix


class DelayLog:
    """Stamps feedback and frames on this application's receiving thread, and logs the stamps each second.

    Runs within its ``with`` block.

    Args:
        drone: The drone.
        camera: The camera of the frames.
    """

    def __init__(self, drone: Drone, camera: str) -> None:
        self._drone = drone
        self._rows: dict[str, deque[Row]] = {FEEDBACK_HEARD: deque(), VIDEO_HEARD: deque()}
        self._ended = threading.Event()
        self._listeners = (
            drone.on_feedback(self._feedback, inline=True),
            drone.on_frame(self._frame, camera=camera, inline=True),
        )
        self._thread = threading.Thread(target=self._run, name="paper-delays", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for listener in self._listeners:
            listener.cancel()
        self._ended.set()
        self._thread.join()

    def _feedback(self, feedback: Feedback) -> None:
        self._add(FEEDBACK_HEARD, monotonic_ns(), feedback.published_ns, feedback.seq)

    def _frame(self, frame: Frame) -> None:
        self._add(VIDEO_HEARD, monotonic_ns(), frame.published_ns, frame.seq)

    def _add(self, name: str, now_ns: int, published_ns: int, seq: int) -> None:
        self._rows[name].append((published_ns, now_ns + self._drone.clock_offset_ns - published_ns, seq))

    def _run(self) -> None:
        log = self._drone.log
        while True:
            ended = self._ended.wait(FLUSH_S)
            log.number(APPLICATION, self._drone.app_id)
            log.array(WAYPOINTS, CORNERS)
            for name, row_queue in self._rows.items():
                rows = [row_queue.popleft() for _ in range(len(row_queue))]
                if rows:
                    log.array(name, rows)
            if ended:
                return

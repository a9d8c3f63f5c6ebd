"""One body over time: whether it is tracked, its newest pose, its velocity. Pure: the time is an argument."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from enum import StrEnum
from typing import Final

import numpy as np

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.motion_capture.pose import BodyPose, Quaternion, Vector

LOST_AFTER_S: Final = 0.2  #: a body without a pose for so long is lost: ten poses at 50 Hz
FROZEN_AFTER_S: Final = 0.5  #: a pose that stays the same to the last bit for so long is no measurement
WINDOW_S: Final = 0.1  #: of the poses from which the velocity is computed
MIN_POSES: Final = 4  #: for a velocity


class TrackState(StrEnum):
    """Whether a body's pose can be relied on."""

    WAITING = "waiting"  #: not seen yet
    TRACKED = "tracked"
    LOST = "lost"  #: seen before, but no new pose arrives
    ENDED = "ended"  #: the motion capture was closed


class Track:
    """Poses of one body.

    The velocity is the slope of a straight line (least squares) through the poses of the last :data:`WINDOW_S`. It lags
    by half of the window, and has far less noise than a difference of two poses.

    Attributes:
        body: The body's name.
        state: Whether it is tracked.
        pose: The newest one while it is tracked, else None.
    """

    def __init__(self, body: str, *, may_freeze: bool = False) -> None:
        """Initialise a body that was not seen yet.

        Args:
            body: Its name.
            may_freeze: Whether the same pose for long is possible, as from a simulator without noise.
        """
        self.body = body
        self.state = TrackState.WAITING
        self.pose: BodyPose | None = None  #: the newest one while it is tracked, else None
        self._may_freeze = may_freeze
        self._recent: deque[tuple[int, Vector]] = deque()
        self._seen_ns = 0
        self._moved_ns = 0
        self._last: tuple[Vector, Quaternion] | None = None

    def add(self, captured_ns: int, position: Vector, quaternion: Quaternion) -> BodyPose | None:
        """Update with a new pose.

        Args:
            captured_ns: When it was captured.
            position: [m]
            quaternion: x, y, z, w.

        Returns:
            The pose with its velocity; None if it is not newer than the last, or frozen.
        """
        if captured_ns <= self._seen_ns:
            return None
        self._seen_ns = captured_ns
        if (position, quaternion) != self._last:
            self._last, self._moved_ns = (position, quaternion), captured_ns
        elif not self._may_freeze and captured_ns - self._moved_ns >= nanoseconds(FROZEN_AFTER_S):
            return None
        if self.state is not TrackState.TRACKED:
            self._recent.clear()
        self.state = TrackState.TRACKED
        self._recent.append((captured_ns, position))
        while captured_ns - self._recent[0][0] > nanoseconds(WINDOW_S):
            self._recent.popleft()
        self.pose = replace(BodyPose(self.body, captured_ns, position, quaternion), velocity_m_s=self._velocity())
        return self.pose

    def look(self, now_ns: int) -> bool:
        """Update the state for a time [ns]; return whether the body has become lost."""
        if self.pose is None or now_ns - self.pose.captured_ns < nanoseconds(LOST_AFTER_S):
            return False
        self.state, self.pose = TrackState.LOST, None
        return True

    def end(self) -> None:
        """End the track: no pose will come any more."""
        self.state, self.pose = TrackState.ENDED, None

    def _velocity(self) -> Vector | None:
        if len(self._recent) < MIN_POSES:
            return None
        times = np.array([at_ns - self._recent[-1][0] for at_ns, _ in self._recent]) / NS_PER_S
        times -= times.mean()
        places = np.array([place for _, place in self._recent])
        x, y, z = (times @ places / (times @ times)).tolist()
        return x, y, z

"""Frames of a worker: its share of a camera's, the newest first."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

from skyloop.client import Drone, Frame
from skyloop.client.channels import Mailbox
from skyloop.client.frame import Arrival
from skyloop.client.publishing import Membership
from skyloop.client.video import VideoChannel
from skyloop.extend import video_channel
from skyloop.messages import ProcessorShare


class Frames:
    """The newest frame of a worker's share that it has not taken yet. A context manager: subscribed while open.

    Only frames of the share are requested, again whenever it changes, so that no others travel over a network.
    """

    def __init__(
        self, drone: Drone, membership: Membership, came: Callable[[], None], *, max_fps: float | None = None
    ) -> None:
        """Prepare to subscribe.

        Args:
            drone: Where the frames come from.
            membership: Knows the share.
            came: Called with each frame of the share, on the receiving thread.
            max_fps: Most frames a second; None: all.
        """
        self._drone = drone
        self._membership = membership
        self._came = came
        self._max_fps = max_fps
        self._usual = video_channel(drone, membership.camera)
        self._channel: VideoChannel | None = None  # subscribed now
        self._buffer: Mailbox[Arrival] = Mailbox()
        self._sink = self._arrived
        self._lock = threading.Lock()  # guards the change from one channel to another

    def __enter__(self) -> Self:
        self._membership.changed = self._follow
        if self._membership.share is not None:
            self._follow(self._membership.share)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._membership.changed = None
        self._turn_to(None)

    @property
    def dropped(self) -> int:
        """Frames of the share that newer ones replaced."""
        return self._buffer.dropped

    def wait(self, timeout_s: float) -> Arrival | None:
        """Take the newest frame; None if none comes within ``timeout_s`` [s]."""
        return self._buffer.wait(timeout_s)

    def picture(self, arrival: Arrival) -> Frame | None:
        """Decode the frame; None, and counted by its channel, if it can't be decoded."""
        return (self._channel or self._usual).picture(arrival)

    # On the receiving thread, except on entering --------------------------------------------------------------

    def _follow(self, share: ProcessorShare) -> None:
        part, fps = (share.part, share.parts), self._max_fps
        self._turn_to(video_channel(self._drone, share.camera, max_fps=fps, part=part) if share.parts else None)

    def _turn_to(self, channel: VideoChannel | None) -> None:
        with self._lock:
            before, self._channel = self._channel, channel
            if channel is before:
                return
            if channel is not None:
                already = self._buffer.dropped
                channel.add(self._sink, lambda: self._buffer.dropped - already)
            if before is not None:
                before.remove(self._sink)

    def _arrived(self, arrival: Arrival) -> None:
        share = self._membership.share  # the frame may be of an earlier share
        if share is not None and share.parts and arrival.header.seq % share.parts == share.part:
            self._came()
            self._buffer.put(arrival)

"""The drone's video as it comes to this host: datagrams to pictures that are not decoded yet."""

from __future__ import annotations

import select
from collections.abc import Callable
from typing import Final

from skyloop.clock import Clock, nanoseconds
from skyloop.drivers.backlog import Coded
from skyloop.drivers.tello.options import TelloOptions
from skyloop.drivers.tello.sockets import MAX_DATAGRAM, at
from skyloop.wire.tello.video import Assembly

POLL_S: Final = 0.1
SILENT_S: Final = 3.0  #: without a datagram for so long, the port is opened anew
BURST: Final = 64


class VideoStream:
    """The port that video comes to. Pictures have no stamps: they count as taken when their first datagram came.

    Raises OSError if the port can't be had, or the drone's address is not known yet.
    """

    def __init__(
        self, options: TelloOptions, addresses: Callable[[], tuple[str, str] | None], connection: int, clock: Clock
    ) -> None:
        known = addresses()
        if known is None:
            raise OSError("the drone's address is not known yet")
        self._drone, local = known
        self._connection = connection
        self._clock = clock
        self._assembly = Assembly()
        self._heard_ns = clock()
        self._socket = at(options, local, options.video_port)

    @property
    def broken(self) -> int:
        return self._assembly.missing

    @property
    def lost_bytes(self) -> int:
        return self._assembly.stray

    def read(self) -> list[Coded]:
        frames: list[Coded] = []
        if select.select([self._socket], [], [], POLL_S)[0]:
            self._drain(frames)
        if self._clock() - self._heard_ns > nanoseconds(SILENT_S):
            raise TimeoutError(f"no video came for {SILENT_S:g} s")
        return frames

    def close(self) -> None:
        self._socket.close()

    def _drain(self, frames: list[Coded]) -> None:
        """What came. Stops with a picture, so that it is decoded while the next one comes."""
        for _ in range(BURST):
            try:
                datagram, sender = self._socket.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return
            if sender[0] != self._drone:
                continue
            now_ns = self._heard_ns = self._clock()
            for unit in self._assembly.feed(datagram, now_ns):
                frames.append(Coded(unit, unit.is_key, unit.arrived_ns, now_ns, self._connection))
            if frames:
                return

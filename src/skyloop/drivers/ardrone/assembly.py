"""Bytes of an AR.Drone 2's video connection to frames with their times. Pure."""

from __future__ import annotations

from skyloop.drivers.ardrone.stamps import DroneStamps
from skyloop.drivers.backlog import Coded
from skyloop.wire.ardrone.pave import PaveFrame, PaveParser


class PaveAssembly:
    """One connection's frames.

    The first frame may be one that is seconds old (seen in a capture of a real drone). So it is given out with the
    second one, and only if their numbers follow one another.
    """

    def __init__(self, connection: int) -> None:
        self._connection = connection
        self._parser = PaveParser()
        self._stamps = DroneStamps()
        self._stale = 0
        self._first: tuple[int, Coded] | None = None  # and its number, until the second one came
        self._greeted = False

    @property
    def broken(self) -> int:
        """Frames that were begun and broken off, or stale."""
        return self._parser.broken_frames + self._stale

    @property
    def lost_bytes(self) -> int:
        """Bytes that belong to no whole frame."""
        return self._parser.skipped_bytes

    def feed(self, data: bytes, now_ns: int) -> list[Coded]:
        """Bytes that came at this time; the frames that are now complete. Never raises for what it is fed."""
        return [coded for frame in self._parser.feed(data) for coded in self._greet(frame, self._coded(frame, now_ns))]

    def end(self) -> None:
        """The connection has ended."""
        self._parser.end()
        self._stale += self._first is not None

    def _coded(self, frame: PaveFrame, now_ns: int) -> Coded:
        captured_ns = self._stamps.captured_ns(frame.timestamp_ms, now_ns)
        return Coded(frame, frame.is_key, captured_ns, now_ns, self._connection)

    def _greet(self, frame: PaveFrame, coded: Coded) -> list[Coded]:
        if self._greeted:
            return [coded]
        if self._first is None:
            self._first = frame.number, coded
            return []
        (number, first), self._first = self._first, None
        self._greeted = True
        if frame.number == number + 1 & 0xFFFFFFFF:
            return [first, coded]
        self._stale += 1
        return [coded]

"""The in-process recorder: subscriptions to drones, a backlog and the writing thread."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from skyloop.child_process import leave_to_parent
from skyloop.client import Drone
from skyloop.messages import Severity
from skyloop.recording.backlog import Backlog
from skyloop.recording.layout import ClockPair, DroneRecord, to_plain
from skyloop.recording.options import MB, Options, RecorderEvent, Status
from skyloop.recording.taps import Tap, check_names
from skyloop.recording.translation import Translator
from skyloop.recording.writer import FileWriter

_TOO_SLOW: Final = "the disk or the encoder is too slow"


class Engine:
    """Records drones from :meth:`start` to :meth:`stop`."""

    def __init__(
        self,
        drones: Sequence[Drone],
        path: Path,
        options: Options,
        on_event: Callable[[RecorderEvent], None] = lambda _: None,
        **writing: Any,
    ) -> None:
        """Initialise the recorder without opening a file. ``on_event`` is called on the writing thread.

        Raises:
            UsageError: Two drones have the same name.
            UnknownNameError: No drone has a camera named in the options.
        """
        check_names(drones, "recording")
        options.check_cameras(camera.name for drone in drones for camera in drone.capabilities.cameras)
        self._on_event = on_event
        self._backlog = Backlog(round(options.buffer_mb * MB))
        self._taps = [Tap(number, drone, options, self._backlog) for number, drone in enumerate(drones)]
        clock = ClockPair.now()
        self._started_ns = clock.monotonic_ns
        self._ended_ns: int | None = None
        records = [
            DroneRecord(drone.name, drone.uri, to_plain(drone.capabilities), drone.clock_offset_ns) for drone in drones
        ]
        translators = [
            Translator(drone.name, drone.capabilities, clock, lambda drone=drone: drone.clock_offset_ns)  # type: ignore[misc]
            for drone in drones
        ]
        self._writer = FileWriter(path, options, self._backlog, records, translators, clock, self._publish, **writing)
        self._writer.dropped = lambda: self._counts(Tap.dropped)
        self._writer.missed = lambda: self._counts(Tap.missed)
        self._writer.each_second = self._report_drops
        self._reported_unwritable = 0
        self._reported: dict[Tap, tuple[dict[str, int], dict[str, int]]] = {tap: ({}, {}) for tap in self._taps}

    def start(self) -> None:
        """Open the file and start recording.

        Raises:
            UsageError: The file can't be written.
            SkyloopError: Subscribing to a drone failed; the file has been closed.
        """
        self._writer.start()
        try:
            for tap in self._taps:
                tap.start()
        except BaseException:
            self.stop()
            raise
        leave_to_parent(self)

    def forked(self) -> None:
        """Leave the file to the parent process. Called in a child created by ``os.fork``."""
        self._ended_ns = time.monotonic_ns()

    def stop(self, timeout_s: float = 10.0) -> None:
        """Write all received samples and close the file. Idempotent."""
        if self._ended_ns is not None:
            return
        self._ended_ns = time.monotonic_ns()
        for tap in self._taps:
            tap.stop()
        self._writer.stop(timeout_s)

    @property
    def status(self) -> Status:
        """The current status. Safe to read from any thread."""
        writer = self._writer
        return Status(
            writer.state,
            writer.shown_reason,
            str(writer.path),
            tuple(map(str, writer.files)),
            ((self._ended_ns or time.monotonic_ns()) - self._started_ns) / 1e9,
            writer.bytes,
            writer.messages,
            self._backlog.size,
            self._counts(Tap.dropped),
            self._counts(Tap.missed),
        )

    def _counts(self, of: Callable[[Tap], dict[str, int]]) -> dict[str, dict[str, int]]:
        return {tap.drone.name: counts for tap in self._taps if (counts := of(tap))}

    # On the writing thread -------------------------------------------------------------------------------------

    def _publish(self, text: str, severity: Severity) -> None:
        for tap in self._taps:
            self._publish_to(tap, text, severity)
        self._on_event(RecorderEvent(text, severity))

    def _publish_to(self, tap: Tap, text: str, severity: Severity) -> None:
        """Write an event to the file and log it on the drone."""
        tap.put_event(text, severity, {"state": self._writer.state.value, "path": str(self._writer.path)})
        tap.drone.log.text(text, name="recording", severity=severity)

    def _report_drops(self) -> None:
        writer = self._writer
        unwritable = writer.unwritable > self._reported_unwritable
        self._reported_unwritable = writer.unwritable
        for tap in self._taps:
            tap.check_streams()
            now = (tap.dropped(), tap.missed())
            before, self._reported[tap] = self._reported[tap], now
            if now == before:
                continue
            tap.put_drops(*now)
            if now[0] != before[0]:
                more = {channel: count - before[0].get(channel, 0) for channel, count in now[0].items()}
                words = ", ".join(f"{count} of {channel}" for channel, count in more.items() if count)
                why = f"can't be written ({writer.unwritable_why})" if unwritable else _TOO_SLOW
                text = f"{tap.drone.name}: the recording leaves out {words}: {why}"
                self._publish_to(tap, text, Severity.WARNING)
                self._on_event(RecorderEvent(text, Severity.WARNING))

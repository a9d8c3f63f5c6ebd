"""Summarise a recording: counts, rates, gaps, drops and delays by channel; detect damage, and recover damaged files."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from skyloop.clock import NS_PER_S
from skyloop.errors import UsageError
from skyloop.files import replacing
from skyloop.messages import Applied, Event, Feedback
from skyloop.recording.layout import PROFILE, Channel, Drops, FrameRecord
from skyloop.recording.reader import Progress, Recording
from skyloop.recording.scan import Channel as ChannelRecord
from skyloop.recording.scan import Message, Scan, Schema, attachments, open_file, records

if TYPE_CHECKING:
    from mcap.writer import Writer

GAP_FACTOR: Final = 3.0  #: minimum length of a gap between two messages, as a multiple of the usual step
MIN_STEPS: Final = 5  #: minimum number of steps for determining the typical step


@dataclass(frozen=True, slots=True)
class Delay:
    """Statistics of the time between two timestamps of a sample [s]."""

    what: str  #: names of the two timestamps
    median_s: float
    p99_s: float


@dataclass(frozen=True, slots=True)
class Row:
    """Statistics of one channel."""

    topic: str
    schema: str
    count: int
    rate_hz: float | None  #: None if there is only one message, or if all messages have the same time
    gaps: int  #: number of steps longer than three typical steps, in steady channels only
    longest_s: float | None  #: longest step between two messages [s]
    missing: int  #: messages missing according to gaps in the samples' sequence numbers
    bytes: int
    steady: bool  #: whether messages arrive at a steady rate; otherwise rate and gaps have no meaning
    delays: tuple[Delay, ...] = ()


@dataclass(frozen=True, slots=True)
class Summary:
    """Statistics of a recording."""

    rows: tuple[Row, ...]
    seconds: float
    dropped: dict[str, dict[str, int]]  #: samples dropped by the recorder, by drone and channel
    missed: dict[str, dict[str, int]]  #: samples that never reached the recorder, by drone and channel
    events: dict[str, int]  #: number of events by severity
    notes: tuple[str, ...] = ()  #: descriptions of problems with the file


@dataclass(slots=True)
class _Tally:
    """The data gathered for one channel."""

    bytes: int = 0
    times: list[int] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    delays: dict[str, list[int]] = field(default_factory=dict)

    def delay(self, what: str, ns: int) -> None:
        self.delays.setdefault(what, []).append(ns)


#: Channels with a steady rate.
_STEADY: Final = frozenset({Channel.FEEDBACK, Channel.COMMANDS, Channel.FRAMES})


def summarise(recording: Recording, progress: Progress | None = None) -> Summary:
    """Compute the statistics of a recording in one pass from start to end."""
    series = {one.topic: one for one in recording.series}
    tallies: dict[str, _Tally] = {topic: _Tally() for topic in series}
    severities: dict[str, int] = {}
    drops: dict[str, Drops] = {}
    offsets = {drone.name: drone.clock_offset_ns for drone in recording.drones}
    for entry in recording.entries(progress=progress):
        tally = tallies.setdefault(entry.topic, _Tally())
        tally.bytes += len(entry.data)
        tally.times.append(entry.log_ns)
        own = series[entry.topic].own if entry.topic in series else None
        if own is None:
            continue
        value = recording.decoded(entry, own.channel)
        if isinstance(value, Drops):
            drops[own.drone] = value
        elif isinstance(value, Event):
            severities[value.severity.value] = severities.get(value.severity.value, 0) + 1
        if value is not None:
            received_ns = recording.clock.monotonic(entry.log_ns, offsets.get(own.drone, 0))
            _measure(tally, value, received_ns)
    end = recording.end
    return Summary(
        rows=tuple(_row(topic, tallies[topic], series) for topic in sorted(tallies)),
        seconds=recording.seconds,
        dropped=end.dropped if end else {name: known.dropped for name, known in drops.items() if known.dropped},
        missed=end.missed if end else {name: known.missed for name, known in drops.items() if known.missed},
        events=severities,
        notes=tuple(notes(recording)),
    )


def notes(recording: Recording) -> list[str]:
    """Describe the problems with the file."""
    found = []
    if recording.cut:
        found.append(f"cut off: {recording.cut} (skyloop log recover repairs it)")
    elif recording.end is None:
        found.append("repaired, or never closed: samples not yet written when the recorder stopped are missing")
    return [*found, *recording.damaged]


def _measure(tally: _Tally, value: Any, received_ns: int) -> None:
    """Record the numbers and delays of one sample; ``received_ns`` is on the proxy's clock."""
    if isinstance(value, Feedback):
        tally.numbers.append(value.seq)
        tally.delay("capture to proxy", value.published_ns - value.captured_ns)
        tally.delay("proxy to recorder", received_ns - value.published_ns)
    elif isinstance(value, FrameRecord):
        tally.numbers.append(value.header.seq)
        tally.delay("capture to proxy", value.header.published_ns - value.header.captured_ns)
        tally.delay("proxy to recorder", received_ns - value.header.published_ns)
    elif isinstance(value, Applied) and value.app_id:
        tally.delay("sent to vehicle", value.applied_ns - value.sent_ns)
    elif isinstance(value, Event) and value.seq:
        tally.numbers.append(value.seq)


def _row(topic: str, tally: _Tally, series: dict[str, Any]) -> Row:
    times = np.sort(np.array(tally.times, np.int64))
    steps = np.diff(times) / NS_PER_S
    known = series.get(topic)
    steady = known is not None and known.own is not None and known.own.channel in _STEADY
    usual = float(np.median(steps)) if len(steps) >= MIN_STEPS else 0.0
    gaps = int((steps > GAP_FACTOR * usual).sum()) if steady and usual > 0 else 0
    span = float(steps.sum())
    return Row(
        topic=topic,
        schema=known.schema if known is not None else "",
        count=len(times),
        rate_hz=len(steps) / span if span > 0 else None,
        gaps=gaps,
        longest_s=float(steps.max()) if len(steps) else None,
        missing=_missing(tally.numbers),
        bytes=tally.bytes,
        steady=steady,
        delays=tuple(
            Delay(what, float(np.median(ns)) / NS_PER_S, float(np.percentile(ns, 99)) / NS_PER_S)
            for what, ns in tally.delays.items()
        ),
    )


def _missing(numbers: list[int]) -> int:
    """Count the numbers missing from a sequence that increases by one; a number that is not higher restarts it."""
    steps = np.diff(np.array(numbers, np.int64))
    return int((steps[steps > 1] - 1).sum())


# Recovery -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Recovered:
    """The result of a recovery."""

    path: Path
    messages: dict[str, int]  #: number of messages by topic
    seconds: float
    size: int  #: size of the new file [bytes]
    lost: int  #: upper bound on the number of unreadable bytes in the old file
    why: tuple[str, ...]  #: problems with the old file


def problems(recording: Recording, progress: Progress | None = None) -> tuple[str, ...]:
    """Read every byte of a recording and describe its problems; empty if it is intact."""
    for _ in recording.entries(progress=progress):
        pass  # reading is enough, because it verifies the checksums
    return (*([recording.cut] if recording.cut else []), *recording.found.damaged)


def recover(recording: Recording, target: Path, progress: Progress | None = None) -> Recovered:
    """Write everything that is readable to a new file, which appears only once it is complete.

    Raise ``UsageError`` if ``target`` already exists or can't be written.
    """
    from mcap.writer import CompressionType, Writer

    if target.exists():
        raise UsageError(f"{target} already exists: choose another name (-o)")
    found = recording.found
    with replacing(target) as part, part.open("wb") as file:
        counts, read = _copy(found, Writer(file, compression=CompressionType.ZSTD), progress)
    mended = Recording.open(target)
    total = sum(piece.size for piece in found.pieces)
    why = (*([found.cut] if found.cut else []), *found.damaged)
    return Recovered(target, counts, mended.seconds, target.stat().st_size, total - read, why)


def _copy(found: Scan, writer: Writer, progress: Progress | None) -> tuple[dict[str, int], int]:
    """Return the number of messages by topic, and the number of bytes in fully read pieces."""
    writer.start(PROFILE, "skyloop log recover")
    for record in found.metadata:
        writer.add_metadata(record.name, record.metadata)
    for attachment in attachments(found):
        writer.add_attachment(
            attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
        )
    schemas = {0: 0}
    channels: dict[int, tuple[int, str]] = {}
    counts: dict[str, int] = {}
    total = sum(piece.size for piece in found.pieces) or 1
    seen = good = 0
    for schema in found.schemas.values():
        schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
    for channel in found.channels.values():
        channels[channel.id] = _register(writer, channel, schemas)
    with open_file(found.path) as file:
        for piece in found.pieces:
            bad: list[str] = []
            for one in records(file, piece, bad.append):
                if isinstance(one, Schema):
                    if one.id not in schemas:
                        schemas[one.id] = writer.register_schema(one.name, one.encoding, one.data)
                elif isinstance(one, ChannelRecord):
                    if one.id not in channels:
                        channels[one.id] = _register(writer, one, schemas)
                elif isinstance(one, Message) and one.channel_id in channels:
                    number, topic = channels[one.channel_id]
                    writer.add_message(number, one.log_time, one.data, one.publish_time, one.sequence)
                    counts[topic] = counts.get(topic, 0) + 1
            seen += piece.size
            for what in bad:
                found.damage(what)
            if not piece.cut and not bad:
                good += piece.size
            if progress is not None:
                progress(seen / total)
    writer.finish()  # type: ignore[no-untyped-call]
    return counts, good


def _register(writer: Writer, channel: ChannelRecord, schemas: dict[int, int]) -> tuple[int, str]:
    schema = schemas.get(channel.schema_id, 0)
    number = writer.register_channel(channel.topic, channel.message_encoding, schema, channel.metadata)
    return number, channel.topic

"""Reading a recording: its drones, and their samples in the order in which they were received."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError, UnknownNameError
from skyloop.logfile.h264 import Groups
from skyloop.logfile.layout import (
    META_CLOCK,
    META_END,
    META_RECORDING,
    TYPES,
    Channel,
    ClockPair,
    DroneRecord,
    End,
    FrameRecord,
    Start,
    Topic,
    decode,
    from_metadata,
    image_topic,
    parse_topic,
    video_topic,
)
from skyloop.logfile.pictures import Picture, compressed
from skyloop.logfile.scan import Message, Piece, Scan, note, open_file, records, scan
from skyloop.messages.encoded import H264

#: Told how much of a file has been read, from 0 to 1.
Progress = Callable[[float], object]


@dataclass(frozen=True, slots=True)
class Entry:
    """One message as it lies in the file; times are Unix time [ns]."""

    topic: str
    log_ns: int  #: when it was received
    publish_ns: int  #: when it was captured
    sequence: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Item:
    """One sample of a drone. ``value`` is of the channel's type in :data:`skyloop.logfile.layout.TYPES`."""

    channel: Channel
    camera: str  #: of frames; else empty
    entry: Entry
    value: Any


@dataclass(frozen=True, slots=True)
class Series:
    """A channel of the file."""

    topic: str
    schema: str
    own: Topic | None  #: None: for viewers, or somebody else's


@dataclass(slots=True)
class Recording:
    """An MCAP file that Skyloop recorded. Opening looks through it once; each iteration reads it anew.

    A file that was cut off is read as far as it goes, and ``cut`` says where it ends. What can't be read in its middle
    is left out, and ``damaged`` says where.
    """

    path: Path
    start: Start
    clock: ClockPair
    end: End | None  #: None for a file that was not closed
    found: Scan
    _bad: Counter[str] = field(default_factory=Counter)

    @classmethod
    def open(cls, path: str | Path) -> Recording:
        """Raises :class:`UsageError` for a file that is not there, and :class:`FileFormatError` for one that is no MCAP
        file or that something else wrote."""
        found = scan(path)
        texts = {record.name: record.metadata for record in found.metadata}
        if META_RECORDING not in texts or META_CLOCK not in texts:
            raise FileFormatError(_foreign(found))
        try:
            start, clock = from_metadata(texts[META_RECORDING], Start), from_metadata(texts[META_CLOCK], ClockPair)
            end = from_metadata(texts[META_END], End) if META_END in texts else None
        except FileFormatError as error:
            raise FileFormatError(f"{found.path}: {error}") from None
        return cls(found.path, start, clock, end, found)

    # What it is ------------------------------------------------------------------------------------------------

    @property
    def cut(self) -> str:
        """Why it is no whole file, in words; empty for a whole one."""
        return self.found.cut

    @property
    def damaged(self) -> list[str]:
        """What could not be read so far, in words."""
        return [*self.found.damaged, *(f"{count} × {what}" for what, count in self._bad.items())]

    @property
    def drones(self) -> tuple[DroneRecord, ...]:
        return self.start.drones

    def drone(self, name: str | None = None) -> DroneRecord:
        """The drone of that name, or the first. Raises :class:`UnknownNameError`."""
        if not self.drones:
            raise FileFormatError(f"{self.path} names no drone")
        if name is None:
            return self.drones[0]
        found = {drone.name: drone for drone in self.drones}
        if name not in found:
            raise UnknownNameError(f"drone in {self.path}", name, found)
        return found[name]

    @property
    def series(self) -> list[Series]:
        """The channels in the file, sorted by topic."""
        schemas = self.found.schemas
        return sorted(
            (
                Series(
                    channel.topic,
                    schemas[channel.schema_id].name if channel.schema_id in schemas else "",
                    parse_topic(channel.topic),
                )
                for channel in self.found.channels.values()
            ),
            key=lambda series: series.topic,
        )

    def cameras(self, drone: str) -> list[str]:
        """The cameras of which there are frames, in the vehicle's order."""
        own = (series.own for series in self.series)
        found = {topic.camera for topic in own if topic and topic.drone == drone and topic.camera}
        order = [camera.name for camera in self.drone(drone).described.cameras]
        return sorted(found, key=lambda name: (order.index(name) if name in order else len(order), name))

    @property
    def span_ns(self) -> tuple[int, int]:
        """Log time of the first and the last message, Unix time [ns]; zeros if there is none."""
        times = [(piece.start_ns, piece.end_ns) for piece in self.found.pieces if piece.end_ns]
        if not times:
            return 0, 0
        return min(time[0] for time in times if time[0]), max(time[1] for time in times)

    @property
    def seconds(self) -> float:
        """From the first message to the last [s]."""
        first, last = self.span_ns
        return (last - first) / NS_PER_S

    # What is in it ---------------------------------------------------------------------------------------------

    def entries(
        self, topics: Collection[str] | None = None, *, from_ns: int = 0, progress: Progress | None = None
    ) -> Iterator[Entry]:
        """Messages in the order of their log time, of some topics or of all, from a log time on (Unix time [ns])."""
        wanted = None if topics is None else set(topics)
        total = sum(piece.size for piece in self.found.pieces) or 1
        read = 0
        with open_file(self.path) as file:
            for piece in self.found.pieces:
                read += piece.size
                if not piece.end_ns or piece.end_ns >= from_ns:
                    found = [entry for entry in self._piece(file, piece, wanted) if entry.log_ns >= from_ns]
                    # Several threads feed a recorder: a message may stand a little before an older one.
                    yield from sorted(found, key=lambda entry: entry.log_ns)
                if progress is not None:
                    progress(read / total)

    def items(
        self,
        drone: str,
        channels: Collection[Channel] = tuple(Channel),
        *,
        from_ns: int = 0,
        progress: Progress | None = None,
    ) -> Iterator[Item]:
        """Our own samples of a drone, of some channels or of all. What can't be understood is left out, and counted."""
        topics = self._topics(drone, channels)
        for entry in self.entries(topics, from_ns=from_ns, progress=progress):
            topic = topics[entry.topic]
            value = self.decoded(entry, topic.channel)
            if value is not None:
                yield Item(topic.channel, topic.camera, entry, value)

    def items_and_pictures(
        self,
        drone: str,
        channels: Collection[Channel],
        progress: Progress | None = None,
    ) -> Iterator[Item | Picture]:
        """The same, with each frame as a :class:`Picture`, which is a :class:`FrameRecord` with what it shows."""
        return self._paired(self._topics(drone, channels), _image_topics(drone, self.cameras(drone)), progress)

    def pictures(self, drone: str, camera: str, progress: Progress | None = None) -> Iterator[Picture]:
        """The frames of one camera."""
        known = self.cameras(drone)
        if camera not in known:
            raise UnknownNameError(f"camera of {drone} in {self.path}", camera, known)
        frames = Topic(drone, Channel.FRAMES, camera)
        found = self._paired({str(frames): frames}, _image_topics(drone, (camera,)), progress)
        return (picture for picture in found if isinstance(picture, Picture))

    def decoded(self, entry: Entry, channel: Channel) -> Any:
        """A message of one of our own channels; None, and counted, if it can't be understood."""
        try:
            return decode(entry.data, TYPES[channel])
        except FileFormatError as error:
            self._bad[f"{entry.topic}: {error}"] += 1
            return None

    # Inside ----------------------------------------------------------------------------------------------------

    def _piece(self, file: IO[bytes], piece: Piece, wanted: Collection[str] | None) -> Iterator[Entry]:
        """Messages of a part of the file, as they lie there."""
        channels = self.found.channels
        for record in records(file, piece, self.found.damage):
            if not isinstance(record, Message):
                note(self.found, record)
                continue
            channel = channels.get(record.channel_id)
            if channel is not None and (wanted is None or channel.topic in wanted):
                yield Entry(channel.topic, record.log_time, record.publish_time, record.sequence, record.data)

    def _paired(
        self, topics: dict[str, Topic], images: dict[str, _Kind], progress: Progress | None
    ) -> Iterator[Item | Picture]:
        """Samples of some topics, with the pictures of others instead of their records."""
        pairs = _Pairs()
        for entry in self.entries([*topics, *images], progress=progress):
            topic = topics.get(entry.topic)
            value = None if topic is None else self.decoded(entry, topic.channel)
            if topic is None:
                picture = pairs.image(images[entry.topic], entry)
            elif value is None:
                continue
            elif topic.channel is Channel.FRAMES:
                picture = pairs.record(topic.camera, entry, value)
            else:
                yield Item(topic.channel, topic.camera, entry, value)
                continue
            if picture is not None:
                yield picture

    def _topics(self, drone: str, channels: Collection[Channel]) -> dict[str, Topic]:
        return {
            series.topic: series.own
            for series in self.series
            if series.own is not None and series.own.drone == drone and series.own.channel in channels
        }


_Kind = tuple[str, bool]  # camera, and whether it is H.264 as the vehicle sent it


def _image_topics(drone: str, cameras: Collection[str]) -> dict[str, _Kind]:
    """Where pictures are."""
    found: dict[str, _Kind] = {image_topic(drone, camera): (camera, False) for camera in cameras}
    return found | {video_topic(drone, camera): (camera, True) for camera in cameras}


class _Pairs:
    """Brings together each frame's record and its image, whichever comes first: both have the same sequence."""

    def __init__(self) -> None:
        self._records: dict[_Kind, tuple[Entry, FrameRecord]] = {}
        self._images: dict[_Kind, Entry] = {}
        self._groups: dict[str, Groups] = {}

    def record(self, camera: str, entry: Entry, record: FrameRecord) -> Picture | None:
        kind = camera, record.format == H264
        self._records[kind] = entry, record
        return self._pair(kind)

    def image(self, kind: _Kind, entry: Entry) -> Picture | None:
        self._images[kind] = entry
        return self._pair(kind)

    def _pair(self, kind: _Kind) -> Picture | None:
        image, known = self._images.get(kind), self._records.get(kind)
        if image is None or known is None or image.sequence != known[0].sequence:
            return None
        entry, record = known
        camera, encoded = kind
        group = None
        if encoded:
            groups = self._groups.setdefault(camera, Groups())
            with suppress(FileFormatError):  # it has no group then, and says so when it is looked at
                group = groups.add(record.header.seq, compressed(image.data, record), key=record.key)
        return Picture(camera, record, entry.log_ns, entry.publish_ns, image.data, group)


def _foreign(found: Scan) -> str:
    topics = sorted(channel.topic for channel in found.channels.values())
    if not found.pieces and found.cut:
        return f"{found.path} ends before its first sample: {found.cut}"
    shown = ", ".join(topics[:5]) + (", …" if len(topics) > 5 else "")
    return f"{found.path} is an MCAP file, but no recording of Skyloop's (its topics: {shown or 'none'})"

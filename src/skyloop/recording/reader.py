"""Read a recording: its drones, and their samples in the order they were received."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import zip_longest
from operator import attrgetter
from pathlib import Path
from typing import IO, Any

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError, UnknownNameError
from skyloop.messages.frame import H264
from skyloop.recording import layout, scan
from skyloop.recording.layout import Channel, ClockPair, DroneRecord, End, FrameRecord, Start, Topic
from skyloop.recording.listing import Described, describe, shown_name
from skyloop.recording.pictures import Groups, RecordedImage, compressed
from skyloop.recording.scan import Message, Piece, Scan

__all__ = ["Described", "Entry", "Item", "Recording", "Series", "describe", "shown_name"]

#: Called with the fraction of a file read so far, 0 to 1.
Progress = Callable[[float], object]


@dataclass(frozen=True, slots=True)
class Entry:
    """One message in the file; times are Unix time [ns]."""

    topic: str
    log_ns: int  #: time at which it was received
    publish_ns: int  #: time at which it was captured
    sequence: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Item:
    """One sample of a drone. ``value`` has the channel's type from ``skyloop.recording.layout.TYPES``."""

    channel: Channel
    camera: str  #: the camera for a frame; otherwise empty
    entry: Entry
    value: Any


@dataclass(frozen=True, slots=True)
class Series:
    """A channel in the file."""

    topic: str
    schema: str
    own: Topic | None  #: None for topics from viewers and from other programs


@dataclass(slots=True)
class Recording:
    """An MCAP file recorded by Skyloop. Opening it reads the index or, if there is none, scans the file.

    Each iteration reads the file again. A truncated file is read up to its end, and ``cut`` describes where it is
    truncated. Unreadable parts in the middle are skipped and listed in :attr:`damaged`.
    """

    path: Path
    start: Start
    clock: ClockPair
    end: End | None  #: None if the file was not closed
    found: Scan
    _bad: Counter[str] = field(default_factory=Counter)
    _complete: bool = False  # whether all channels are known

    @classmethod
    def open(cls, path: str | Path) -> Recording:
        """Open a recording.

        Raises:
            UsageError: The file does not exist or can't be read.
            FileFormatError: It is not an MCAP file, or was not recorded by Skyloop.
        """
        found = scan.indexed(path) or scan.scan(path)
        texts = {record.name: record.metadata for record in found.metadata}
        if layout.META_RECORDING not in texts or layout.META_CLOCK not in texts:
            raise FileFormatError(_foreign(found))
        try:
            start = layout.from_metadata(texts[layout.META_RECORDING], Start)
            clock = layout.from_metadata(texts[layout.META_CLOCK], ClockPair)
            end = layout.from_metadata(texts[layout.META_END], End) if layout.META_END in texts else None
        except FileFormatError as error:
            raise FileFormatError(f"{found.path}: {error}") from None
        if not 1 <= start.layout <= layout.VERSION:
            raise FileFormatError(
                f"{found.path} has layout {start.layout}, but this version of Skyloop reads layouts 1 to "
                f"{layout.VERSION}: use the version that recorded it, or a newer one"
            )
        return cls(found.path, start, clock, end, found)

    # Properties ------------------------------------------------------------------------------------------------

    @property
    def cut(self) -> str:
        """The reason why the file is incomplete; empty if it is complete."""
        return self.found.cut

    @property
    def damaged(self) -> list[str]:
        """Descriptions of the unreadable parts found so far."""
        return [*self.found.damaged, *(f"{count} × {what}" for what, count in self._bad.items())]

    @property
    def drones(self) -> tuple[DroneRecord, ...]:
        """The drones in the recording."""
        return self.start.drones

    def drone(self, name: str | None = None) -> DroneRecord:
        """Return the drone with this name, or the first one if no name is given.

        Raises:
            UnknownNameError: The recording has no such drone.
            FileFormatError: The recording has no drones.
        """
        if not self.drones:
            raise FileFormatError(f"{self.path} has no drone")
        if name is None:
            return self.drones[0]
        found = {drone.name: drone for drone in self.drones}
        if name not in found:
            raise UnknownNameError(f"drone in {self.path}", name, found)
        return found[name]

    @property
    def series(self) -> list[Series]:
        """The channels in the file, sorted by topic. For a truncated file, the first access reads all of it."""
        if self.found.cut and not self._complete:
            scan.find_channels(self.found)
        self._complete = True
        schemas = self.found.schemas
        return sorted(
            (
                Series(
                    channel.topic,
                    schemas[channel.schema_id].name if channel.schema_id in schemas else "",
                    layout.parse_topic(channel.topic),
                )
                for channel in self.found.channels.values()
            ),
            key=lambda series: series.topic,
        )

    def cameras(self, drone: str) -> list[str]:
        """Return the cameras that have frames, in the vehicle's order.

        Raises:
            UnknownNameError: The recording has no such drone.
        """
        own = (series.own for series in self.series)
        found = {topic.camera for topic in own if topic and topic.drone == drone and topic.camera}
        order = [camera.name for camera in self.drone(drone).described.cameras]
        return sorted(found, key=lambda name: (order.index(name) if name in order else len(order), name))

    @property
    def span_ns(self) -> tuple[int, int]:
        """Log times of the first and last messages, Unix time [ns]; zeros if there are none."""
        times = [(piece.start_ns, piece.end_ns) for piece in self.found.pieces if piece.end_ns]
        if not times:
            return 0, 0
        return min(time[0] for time in times), max(time[1] for time in times)

    @property
    def seconds(self) -> float:
        """Time between the first and last messages."""
        first, last = self.span_ns
        return (last - first) / NS_PER_S

    # Content --------------------------------------------------------------------------------------------------

    def entries(
        self, topics: Collection[str] | None = None, *, from_ns: int = 0, progress: Progress | None = None
    ) -> Iterator[Entry]:
        """Yield messages in order of their log time.

        Args:
            topics: Topics to yield, or None to yield all topics.
            from_ns: Log time to start from, Unix time [ns].
            progress: Called with the fraction read so far, 0 to 1.

        Raises:
            UsageError: The file can no longer be read.
        """
        wanted = None if topics is None else set(topics)
        total = sum(piece.size for piece in self.found.pieces) or 1
        read = 0
        with scan.open_file(self.path) as file:
            # Several threads feed a recorder, so a slightly older message may appear later, even in the next piece.
            held: list[Entry] = []
            for piece, after in zip_longest(self.found.pieces, self.found.pieces[1:]):
                read += piece.size
                if not piece.end_ns or piece.end_ns >= from_ns:
                    held += (entry for entry in self._piece(file, piece, wanted) if entry.log_ns >= from_ns)
                    held.sort(key=attrgetter("log_ns"))
                    until = len(held)
                    if after is not None and after.start_ns > 0:  # otherwise the time of the first message is unknown
                        until = bisect_left(held, after.start_ns, key=attrgetter("log_ns"))
                    yield from held[:until]
                    held = held[until:]
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
        """Yield Skyloop's own samples of a drone. Skip samples that can't be decoded, and list them in :attr:`damaged`.

        Args:
            drone: The drone's name.
            channels: Channels to yield.
            from_ns: Log time to start from, Unix time [ns].
            progress: Called with the fraction read so far, 0 to 1.
        """
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
        *,
        from_ns: int = 0,
    ) -> Iterator[Item | RecordedImage]:
        """Yield samples like :meth:`items`, but combine each frame's record and image into a :class:`RecordedImage`.

        Args:
            drone: The drone's name.
            channels: Channels to yield.
            progress: Called with the fraction read so far, 0 to 1.
            from_ns: Log time to start from, Unix time [ns].
        """
        images = _image_topics(drone, self.cameras(drone))
        return self._paired(self._topics(drone, channels), images, progress, from_ns)

    def pictures(self, drone: str, camera: str, progress: Progress | None = None) -> Iterator[RecordedImage]:
        """Yield the frames of one camera.

        Raises:
            UnknownNameError: The recording has no such drone or camera.
        """
        known = self.cameras(drone)
        if camera not in known:
            raise UnknownNameError(f"camera of {drone} in {self.path}", camera, known)
        frames = Topic(drone, Channel.FRAMES, camera)
        found = self._paired({str(frames): frames}, _image_topics(drone, (camera,)), progress)
        return (picture for picture in found if isinstance(picture, RecordedImage))

    def decoded(self, entry: Entry, channel: Channel) -> Any:
        """Decode a message from one of Skyloop's own channels; note damage in :attr:`damaged` and return None."""
        try:
            return layout.decode(entry.data, layout.TYPES[channel])
        except FileFormatError as error:
            self._bad[f"{entry.topic}: {error}"] += 1
            return None

    # Internals -------------------------------------------------------------------------------------------------

    def _piece(self, file: IO[bytes], piece: Piece, wanted: Collection[str] | None) -> Iterator[Entry]:
        """Yield the messages in a part of the file, in file order."""
        channels = self.found.channels
        for record in scan.records(file, piece, self.found.damage):
            if not isinstance(record, Message):
                scan.note(self.found, record)
                continue
            channel = channels.get(record.channel_id)
            if max(record.log_time, record.publish_time) > scan.MAX_TIME_NS:
                self._bad["a message with a time after the year 2262"] += 1
            elif channel is not None and (wanted is None or channel.topic in wanted):
                yield Entry(channel.topic, record.log_time, record.publish_time, record.sequence, record.data)

    def _paired(
        self, topics: dict[str, Topic], images: dict[str, _Kind], progress: Progress | None, from_ns: int = 0
    ) -> Iterator[Item | RecordedImage]:
        """Yield the samples of the given topics, with frames as pictures instead of records."""
        pairs = _Pairs()
        for entry in self.entries([*topics, *images], from_ns=from_ns, progress=progress):
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


_Kind = tuple[str, bool]  # camera name, and whether the image is the vehicle's own H.264


def _image_topics(drone: str, cameras: Collection[str]) -> dict[str, _Kind]:
    """Return the topics that hold images."""
    found: dict[str, _Kind] = {layout.image_topic(drone, camera): (camera, False) for camera in cameras}
    return found | {layout.video_topic(drone, camera): (camera, True) for camera in cameras}


class _Pairs:
    """Pairs each frame's record with its image by sequence number; either may come first."""

    def __init__(self) -> None:
        self._records: dict[_Kind, tuple[Entry, FrameRecord]] = {}
        self._images: dict[_Kind, Entry] = {}
        self._groups: dict[str, Groups] = {}

    def record(self, camera: str, entry: Entry, record: FrameRecord) -> RecordedImage | None:
        kind = camera, record.format == H264
        self._records[kind] = entry, record
        return self._pair(kind)

    def image(self, kind: _Kind, entry: Entry) -> RecordedImage | None:
        self._images[kind] = entry
        return self._pair(kind)

    def _pair(self, kind: _Kind) -> RecordedImage | None:
        image, known = self._images.get(kind), self._records.get(kind)
        if image is None or known is None or image.sequence != known[0].sequence:
            return None
        entry, record = known
        camera, encoded = kind
        group = None
        if encoded:
            groups = self._groups.setdefault(camera, Groups())
            with suppress(FileFormatError):  # raised when a picture without a group is decoded
                group = groups.add(record.header.seq, compressed(image.data, record), key=record.key)
        return RecordedImage(camera, record, entry.log_ns, entry.publish_ns, image.data, group)


def _foreign(found: Scan) -> str:
    topics = sorted(channel.topic for channel in found.channels.values())
    if not found.pieces and found.cut:
        return f"{found.path} ends before its first sample: {found.cut}"
    shown = ", ".join(topics[:5]) + (", …" if len(topics) > 5 else "")
    return f"{found.path} is an MCAP file, but not a Skyloop recording (its topics: {shown or 'none'})"

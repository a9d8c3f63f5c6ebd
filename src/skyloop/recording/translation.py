"""Translate received samples to messages in a file: Skyloop's own messages, and other messages for viewers. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from skyloop.errors import DecodeError
from skyloop.messages import (
    Annotation,
    Applied,
    CameraInfo,
    Capabilities,
    Event,
    Feedback,
    FrameHeader,
    Intrinsics,
    LogEntry,
    Parameter,
    ProcessorResult,
)
from skyloop.messages.frame import H264
from skyloop.messages.relayed import MOCAP, unpack
from skyloop.recording import foxglove, layout
from skyloop.recording.backlog import Item
from skyloop.recording.layout import Channel, ClockPair, Drops, FrameRecord, ResultRecord, Topic

if TYPE_CHECKING:
    from google.protobuf.message import Message as Protobuf

_SEQUENCES: Final = 1 << 32  # number of MCAP's sequence numbers, which have 32 bits
_PLACES: Final = 400  # maximum number of points in a path; when it is exceeded, every second one is removed
_PATH_EVERY_NS: Final = 1_000_000_000  # interval between messages that hold a path


@dataclass(frozen=True, slots=True)
class Message:
    """A message for the file. ``kind`` is the class of a Skyloop sample, or a protobuf class."""

    topic: str
    kind: type[msgspec.Struct | Protobuf]
    data: bytes
    log_ns: int  #: Unix time
    publish_ns: int
    sequence: int = 0


@dataclass(frozen=True, slots=True)
class Schema:
    """Describes a kind of message to programs that do not know it."""

    name: str
    encoding: str  #: encoding of the schema itself
    data: bytes
    message_encoding: str

    @classmethod
    def of(cls, kind: type[Any]) -> Schema:
        """Return the schema for a kind of :class:`Message`."""
        if issubclass(kind, msgspec.Struct):
            return cls(layout.schema_name(kind), layout.JSON_SCHEMA, layout.schema(kind), layout.JSON)
        return cls(kind.DESCRIPTOR.full_name, layout.PROTOBUF, foxglove.schema(kind), layout.PROTOBUF)


@dataclass(slots=True, eq=False)
class TranslatedImage:
    """A frame as it is written to the file."""

    record: FrameRecord
    data: bytes


class Trail:
    """The points of a drone's path, oldest first, thinned to a limited number."""

    def __init__(self) -> None:
        self.places: list[Any] = []
        self._step = 1
        self._count = 0

    def add(self, place: Any) -> None:
        """Append a point, or skip it: of a path that had to be thinned, only every second, fourth, … point is kept."""
        if self._count % self._step == 0:
            self.places.append(place)
            if len(self.places) > _PLACES:
                del self.places[1::2]
                self._step *= 2
        self._count += 1


class Translator:
    """Creates the messages for one drone."""

    def __init__(
        self, drone: str, capabilities: Capabilities, clock: ClockPair, offset_ns: Callable[[], int] = lambda: 0
    ) -> None:
        """Initialise the translator. ``offset_ns`` returns the proxy's clock minus the recorder's."""
        self._drone = drone
        self._cameras = capabilities.cameras
        self._camera_names = frozenset(camera.name for camera in capabilities.cameras)
        self._clock = clock
        self._offset_ns = offset_ns
        self._topics: dict[Channel, str] = {
            channel: str(Topic(drone, channel)) for channel in Channel if channel is not Channel.FRAMES
        }
        self._parameters: dict[str, Parameter] = {}
        self._intrinsics: dict[str, tuple[int, int, Intrinsics]] = {}
        self._path = Trail()
        self._path_due_ns = 0
        self._makers: dict[type, Callable[[Any, int], Iterator[Message]]] = {
            Feedback: self._feedback,
            Applied: self._applied,
            Event: self._event,
            Parameter: self._parameter,
            Annotation: self._annotation,
            LogEntry: self._log,
            ProcessorResult: self._result,
            TranslatedImage: self._picture,
            Drops: self._drops,
        }

    def messages(self, item: Item) -> Iterator[Message]:
        """Create the messages for a sample."""
        return self._makers[type(item.sample)](item.sample, self._clock.unix(item.received_ns))

    def prelude(self, now_ns: int) -> Iterator[Message]:
        """Create the messages that make each file self-contained: parameters, mountings and calibrations."""
        at_ns = self._clock.unix(now_ns)
        for parameter in list(self._parameters.values()):
            yield from self._parameter(parameter, at_ns)
        for camera in self._cameras:
            yield from self._mounting(camera, at_ns)
            if camera.intrinsics is not None:
                yield from self._calibration(camera.name, camera.width, camera.height, camera.intrinsics, at_ns)
        for name, (width, height, intrinsics) in list(self._intrinsics.items()):
            yield from self._calibration(name, width, height, intrinsics, at_ns)

    # Kinds of samples -----------------------------------------------------------------------------------------------

    def _own(self, channel: Channel, sample: Any, log_ns: int, publish_ns: int, sequence: int = 0) -> Message:
        data = layout.encode(sample)
        return Message(self._topics[channel], type(sample), data, log_ns, publish_ns, sequence % _SEQUENCES)

    def _unix(self, proxy_ns: int) -> int:
        """Convert a time on the proxy's clock to Unix time."""
        return self._clock.unix(proxy_ns, self._offset_ns())

    def _feedback(self, feedback: Feedback, log_ns: int) -> Iterator[Message]:
        at_ns = self._unix(feedback.captured_ns)
        yield self._own(Channel.FEEDBACK, feedback, log_ns, at_ns, feedback.seq)
        place = foxglove.pose(feedback)
        if place is None:
            return
        drone = self._drone
        pose = foxglove.pose_in_world(at_ns, place)
        yield Message(layout.pose_topic(drone), foxglove.PoseInFrame, pose, log_ns, at_ns)
        transform = foxglove.world_to_drone(drone, at_ns, place)
        yield Message(layout.TF, foxglove.FrameTransform, transform, log_ns, at_ns)
        if feedback.position_m is not None:
            self._path.add(place)
            if at_ns >= self._path_due_ns:
                self._path_due_ns = at_ns + _PATH_EVERY_NS
                path = foxglove.path_in_world(at_ns, self._path.places)
                yield Message(layout.path_topic(drone), foxglove.PosesInFrame, path, log_ns, at_ns)

    def _applied(self, applied: Applied, log_ns: int) -> Iterator[Message]:
        yield self._own(Channel.COMMANDS, applied, log_ns, self._unix(applied.applied_ns), applied.seq)

    def _event(self, event: Event, log_ns: int) -> Iterator[Message]:
        at_ns = self._unix(event.at_ns)
        yield self._own(Channel.EVENTS, event, log_ns, at_ns, event.seq)
        line = foxglove.log(self._drone, at_ns, event.severity, event.text, event.kind.value)
        yield Message(layout.LOG, foxglove.Log, line, log_ns, log_ns)

    def _parameter(self, parameter: Parameter, log_ns: int) -> Iterator[Message]:
        self._parameters[parameter.name] = parameter
        yield self._own(Channel.PARAMETERS, parameter, log_ns, log_ns)

    def _annotation(self, annotation: Annotation, log_ns: int) -> Iterator[Message]:
        at_ns = self._unix(annotation.captured_ns)
        yield self._own(Channel.ANNOTATIONS, annotation, log_ns, at_ns)
        if annotation.camera not in self._camera_names:
            return  # an unknown camera; names chosen by applications must not create topics
        topic = layout.drawing_topic(self._drone, annotation.camera)
        yield Message(topic, foxglove.ImageAnnotations, foxglove.drawing(annotation, at_ns), log_ns, at_ns)

    def _log(self, entry: LogEntry, log_ns: int) -> Iterator[Message]:
        at_ns = self._unix(entry.at_ns)
        # Applications choose an entry's own time, which is stored inside the entry. If this time were used as the
        # publish time, times could run backwards and viewers would re-sort the whole topic.
        yield self._own(Channel.LOGS, entry, log_ns, log_ns)
        if entry.name == MOCAP and entry.values is not None and len(entry.values) >= 7:
            pose = foxglove.pose_in_world(at_ns, foxglove.pose_of(entry.values))
            yield Message(layout.mocap_topic(self._drone), foxglove.PoseInFrame, pose, log_ns, at_ns)
        if entry.text is not None:
            text = f"{entry.name}: {entry.text}" if entry.name else entry.text
            line = foxglove.log(self._drone, at_ns, entry.severity, text, entry.source)
            yield Message(layout.LOG, foxglove.Log, line, log_ns, log_ns)

    def _result(self, result: ProcessorResult, log_ns: int) -> Iterator[Message]:
        try:
            value = _listed(unpack(result.payload))
        except DecodeError:
            value = None  # a payload that can't be decoded is recorded without a value
        record = ResultRecord(
            result.processor,
            result.worker,
            result.number,
            result.camera,
            result.seq,
            result.captured_ns,
            result.made_ns,
            result.took_ns,
            value,
        )
        yield self._own(Channel.RESULTS, record, log_ns, self._unix(result.captured_ns), result.seq)

    def _drops(self, drops: Drops, log_ns: int) -> Iterator[Message]:
        yield self._own(Channel.DROPS, drops, log_ns, log_ns)

    def _picture(self, picture: TranslatedImage, log_ns: int) -> Iterator[Message]:
        record = picture.record
        header: FrameHeader = record.header
        drone, camera = self._drone, header.camera
        at_ns = self._unix(header.captured_ns)
        sequence = header.seq % _SEQUENCES
        if header.intrinsics is not None:
            now = (header.width, header.height, header.intrinsics)
            if self._intrinsics.get(camera) != now:
                self._intrinsics[camera] = now
                yield from self._calibration(camera, *now, log_ns)
        topic = str(Topic(drone, Channel.FRAMES, camera))
        yield Message(topic, FrameRecord, layout.encode(record), log_ns, at_ns, sequence)
        if record.format == H264:
            unit = foxglove.video(drone, camera, at_ns, picture.data)
            yield Message(layout.video_topic(drone, camera), foxglove.CompressedVideo, unit, log_ns, at_ns, sequence)
        else:
            image = foxglove.image(drone, camera, at_ns, picture.data, record.format)
            yield Message(layout.image_topic(drone, camera), foxglove.CompressedImage, image, log_ns, at_ns, sequence)

    def _calibration(
        self, camera: str, width: int, height: int, intrinsics: Intrinsics, at_ns: int
    ) -> Iterator[Message]:
        data = foxglove.calibration(self._drone, camera, at_ns, width, height, intrinsics)
        yield Message(layout.calibration_topic(self._drone, camera), foxglove.CameraCalibration, data, at_ns, at_ns)

    def _mounting(self, camera: CameraInfo, at_ns: int) -> Iterator[Message]:
        transform = foxglove.drone_to_camera(self._drone, camera, at_ns)
        if transform is not None:
            yield Message(layout.TF, foxglove.FrameTransform, transform, at_ns, at_ns)


def _listed(value: Any) -> Any:
    """Convert to JSON types: arrays become lists, keys become strings."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {str(key): _listed(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_listed(one) for one in value]
    return value

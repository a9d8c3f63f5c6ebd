"""The layout of a recording: topics, schemas and times, encoding and decoding. See docs/recording.md.

Pure, and independent of the MCAP library. Skyloop's own samples are JSON objects, encoded by :func:`encode` and decoded
by :func:`decode`; :mod:`skyloop.recording.foxglove` encodes the messages for viewers.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final, TypeVar

import msgspec
from msgspec import inspect

from skyloop.clock import boot_id
from skyloop.errors import FileFormatError
from skyloop.messages import (
    Annotation,
    Applied,
    Capabilities,
    Event,
    Feedback,
    FrameHeader,
    LogEntry,
    Parameter,
)
from skyloop.recording.plain import decode, encode, from_json, from_plain, limited, schema, schema_name, to_plain

__all__ = ["decode", "encode", "from_plain", "schema", "schema_name", "to_plain"]  # re-exported for other modules

T = TypeVar("T")

PROFILE: Final = "skyloop"  #: profile in the MCAP header
VERSION: Final = 2  #: version of this layout; files with layout 1, which uses older names, can also be read
JSON: Final = "json"  #: message encoding of Skyloop's own samples
JSON_SCHEMA: Final = "jsonschema"  #: schema encoding of Skyloop's own samples
PROTOBUF: Final = "protobuf"  #: both message and schema encoding of messages for viewers

# Names of the metadata records. All values in these records are strings; see :class:`ClockPair` and :class:`Start`.
META_CLOCK: Final = "skyloop.clock"
META_RECORDING: Final = "skyloop.recording"
META_END: Final = "skyloop.end"  #: name of the metadata record at the end; absent if the file was not closed

LOG: Final = "/log"  #: topic of foxglove.Log for all drones: events and log text
TF: Final = "/tf"  #: topic of foxglove.FrameTransform: world → NAME, NAME → NAME/CAMERA
WORLD: Final = "world"  #: the fixed frame: x east, y north, z up [m]


# Times ---------------------------------------------------------------------------------------------------------


_LAST_UNIX_NS: Final = 2**63 - 1  #: largest 64-bit time, in the year 2262


class ClockPair(msgspec.Struct, frozen=True):
    """Metadata ``skyloop.clock``: one moment read on both of the recorder's clocks.

    A message's ``log_time`` is when it was received; its ``publish_time`` is when it was captured (sent, published).
    This pair converts both to Unix time [ns]. Times *within* Skyloop's samples stay on the proxy's monotonic clock.
    """

    monotonic_ns: int
    unix_ns: int
    pid: int
    boot: str = ""  #: boot id of the host: monotonic times from different boots can't be compared

    @classmethod
    def now(cls) -> ClockPair:
        """Read both clocks."""
        before = time.monotonic_ns()
        unix = time.time_ns()
        return cls((before + time.monotonic_ns()) // 2, unix, os.getpid(), boot_id())

    def unix(self, monotonic_ns: int, offset_ns: int = 0) -> int:
        """Convert a monotonic time to Unix time [ns]; ``offset_ns`` is that time's clock minus the recorder's.

        The result is clamped to the range that a file can hold, so that a sample with an absurd time can't corrupt it.
        """
        return min(max(0, monotonic_ns - offset_ns - self.monotonic_ns + self.unix_ns), _LAST_UNIX_NS)

    def monotonic(self, unix_ns: int, offset_ns: int = 0) -> int:
        """Convert Unix time [ns] to monotonic time; the inverse of :meth:`unix`."""
        return unix_ns - self.unix_ns + self.monotonic_ns + offset_ns


# Metadata ------------------------------------------------------------------------------------------------------


class DroneRecord(msgspec.Struct, frozen=True):
    """One drone in a recording, from metadata ``skyloop.recording``."""

    name: str
    uri: str = ""
    capabilities: dict[str, Any] = {}  #: :class:`Capabilities`, converted by :func:`to_plain`
    clock_offset_ns: int = 0  #: the proxy's clock minus the recorder's, measured at the start

    @property
    def described(self) -> Capabilities:
        """Decode the drone's capabilities. Raise ``FileFormatError`` if the capabilities can't be decoded."""
        return from_plain(self.capabilities, Capabilities)


class Start(msgspec.Struct, frozen=True):
    """The ``skyloop.recording`` metadata, written at the start of each file."""

    layout: int
    skyloop: str  #: Skyloop's version
    drones: tuple[DroneRecord, ...]
    started_unix_ns: int  #: start of the whole recording; the same in all its files
    file: int = 1  #: this file's number within the recording, starting at 1
    options: dict[str, Any] = {}  #: recorder options: channels, encoding, quality


class End(msgspec.Struct, frozen=True):
    """Metadata ``skyloop.end``, written at the end of a closed file. Losses are counted from the recording's start."""

    reason: str  #: ``closed``, or ``rotated`` if another file may follow
    ended_unix_ns: int
    written: dict[str, int]  #: number of messages in *this file*, by topic
    dropped: dict[str, dict[str, int]] = {}  #: samples received but dropped, by drone and channel
    missed: dict[str, dict[str, int]] = {}  #: samples never received, by drone and channel, from gaps in their numbers


def to_metadata(record: msgspec.Struct) -> dict[str, str]:
    """Convert a metadata record to strings: strings stay as they are, everything else becomes JSON."""
    fields = msgspec.to_builtins(record)
    return {
        key: value if isinstance(value, str) else msgspec.json.encode(value).decode() for key, value in fields.items()
    }


def from_metadata(texts: Mapping[str, str], kind: type[T]) -> T:
    """Convert strings back to a metadata record. Raise ``FileFormatError`` if the strings do not match the record."""
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    try:
        fields = {
            field.name: texts[field.name]
            if isinstance(field.type, inspect.StrType)
            else limited(from_json(texts[field.name]))
            for field in info.fields
            if field.name in texts
        }
        return msgspec.convert(fields, kind)
    except (msgspec.ValidationError, FileFormatError, ValueError) as error:
        raise FileFormatError(f"metadata can't be read as {kind.__name__}: {error}") from None


# Skyloop's own samples -----------------------------------------------------------------------------------------


class Channel(StrEnum):
    """Skyloop's own channels; topics are ``/NAME/CHANNEL``, or ``/NAME/frames/CAMERA`` for frames."""

    FEEDBACK = "feedback"
    COMMANDS = "commands"
    EVENTS = "events"
    PARAMETERS = "parameters"
    ANNOTATIONS = "annotations"
    LOGS = "logs"
    RESULTS = "results"
    FRAMES = "frames"
    DROPS = "drops"


class FrameRecord(msgspec.Struct, frozen=True):
    """A recorded frame. The image of the frame is a separate message with the same sequence number and times.

    The image is on the topic given by :func:`image_topic` or, for H.264, by :func:`video_topic`.
    """

    header: FrameHeader  #: header as received
    received_ns: int  #: time of reception on the recorder's monotonic clock
    format: str  #: format of the image in the file: ``jpeg``, ``png`` or ``h264``
    key: bool = True  #: whether it can be decoded on its own; false only for some ``h264`` frames


class ResultRecord(msgspec.Struct, frozen=True):
    """A processor's result for a frame: a ``ProcessorResult`` whose value is in JSON, with NumPy arrays as lists."""

    processor: str
    worker: int
    number: int
    camera: str
    seq: int  #: the frame's sequence number
    captured_ns: int  #: time at which the frame was captured
    made_ns: int  #: time at which the result was completed, on the proxy's clock
    took_ns: int
    value: Any = None


class Drops(msgspec.Struct, frozen=True):
    """Totals by channel (``feedback``, ``video.front``) since the start of the recording, written after each change."""

    at_ns: int  #: time on the recorder's monotonic clock
    dropped: dict[str, int]  #: samples received but dropped, because the disk or the encoder was too slow
    missed: dict[str, int]  #: samples dropped by the proxy because the recorder was slow, or lost in transport


#: Message types of Skyloop's own channels.
TYPES: Final[dict[Channel, type[msgspec.Struct]]] = {
    Channel.FEEDBACK: Feedback,
    Channel.COMMANDS: Applied,
    Channel.EVENTS: Event,
    Channel.PARAMETERS: Parameter,
    Channel.ANNOTATIONS: Annotation,
    Channel.LOGS: LogEntry,
    Channel.RESULTS: ResultRecord,
    Channel.FRAMES: FrameRecord,
    Channel.DROPS: Drops,
}


@dataclass(frozen=True, slots=True)
class Topic:
    """The components of the name of one of Skyloop's own topics."""

    drone: str
    channel: Channel
    camera: str = ""

    def __str__(self) -> str:
        return "/" + "/".join(map(_quoted, (self.drone, self.channel.value, *([self.camera] if self.camera else []))))


def parse_topic(topic: str) -> Topic | None:
    """Parse one of Skyloop's own topics; return None for all other topics."""
    parts = [_unquoted(part) for part in topic.split("/")]
    if len(parts) not in (3, 4) or parts[0] or parts[2] not in set(Channel):
        return None
    channel = Channel(parts[2])
    if (channel is Channel.FRAMES) != (len(parts) == 4):
        return None
    return Topic(parts[1], channel, parts[3] if len(parts) == 4 else "")


def image_topic(drone: str, camera: str) -> str:
    """Return the topic of a camera's images, foxglove.CompressedImage."""
    return f"/{_quoted(drone)}/camera/{_quoted(camera)}/image"


def video_topic(drone: str, camera: str) -> str:
    """Return the topic of a camera's H.264, foxglove.CompressedVideo."""
    return f"/{_quoted(drone)}/camera/{_quoted(camera)}/video"


def calibration_topic(drone: str, camera: str) -> str:
    """Return the topic of a camera's intrinsics, foxglove.CameraCalibration."""
    return f"/{_quoted(drone)}/camera/{_quoted(camera)}/calibration"


def drawing_topic(drone: str, camera: str) -> str:
    """Return the topic of the annotations drawn on a camera's frames, foxglove.ImageAnnotations."""
    return f"/{_quoted(drone)}/camera/{_quoted(camera)}/annotations"


def pose_topic(drone: str) -> str:
    """Return the topic of the drone's pose, foxglove.PoseInFrame."""
    return f"/{_quoted(drone)}/pose"


def mocap_topic(drone: str) -> str:
    """Return the topic of the drone's pose from motion capture, foxglove.PoseInFrame."""
    return f"/{_quoted(drone)}/mocap"


def path_topic(drone: str) -> str:
    """Return the topic of the drone's path since the start of the recording, foxglove.PosesInFrame."""
    return f"/{_quoted(drone)}/path"


def optical_frame(drone: str, camera: str) -> str:
    """Return the name of a camera's coordinate frame: x right, y down, z forward."""
    return f"{drone}/{camera}"


def _quoted(name: str) -> str:
    return name.replace("%", "%25").replace("/", "%2F")


def _unquoted(part: str) -> str:
    return part.replace("%2F", "/").replace("%25", "%")

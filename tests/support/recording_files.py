"""Recordings, read with the public MCAP and protobuf classes alone."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory


class Read(NamedTuple):
    """One message."""

    topic: str
    schema: str
    encoding: str
    log_ns: int
    publish_ns: int
    sequence: int
    data: bytes

    @property
    def json(self) -> dict[str, Any]:
        assert self.encoding == "json"
        value: dict[str, Any] = json.loads(self.data)
        return value


def read(path: Path) -> list[Read]:
    """All messages, in the order in which they were written, of a file that may end anywhere."""
    with path.open("rb") as stream:
        return list(_messages(NonSeekingReader(stream)))


def _messages(reader: NonSeekingReader) -> Iterator[Read]:
    try:
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            yield Read(
                channel.topic,
                schema.name,
                channel.message_encoding,
                message.log_time,
                message.publish_time,
                message.sequence,
                message.data,
            )
    except EndOfFile:
        return


def of(path: Path, topic: str) -> list[Read]:
    return [message for message in read(path) if message.topic == topic]


def decoded(path: Path, topic: str) -> list[Any]:
    """Protobuf messages of a topic, decoded by the schema in the file."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [found.decoded_message for found in reader.iter_decoded_messages(topics=[topic])]


def metadata(path: Path) -> dict[str, dict[str, str]]:
    """The last record of each name; the file may be cut off."""
    found: dict[str, dict[str, str]] = {}
    with path.open("rb") as stream:
        try:
            for record in NonSeekingReader(stream).iter_metadata():
                found[record.name] = dict(record.metadata)
        except EndOfFile:
            pass
    return found


def is_complete(path: Path) -> bool:
    """Whether it has a summary, and all that this announces."""
    with path.open("rb") as stream:
        try:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            count = sum(1 for _ in reader.iter_messages())
        except Exception:  # noqa: BLE001  (what a reader raises for a file without an end is its own affair)
            return False
    return summary is not None and summary.statistics is not None and summary.statistics.message_count == count


def until(condition: Callable[[], bool], what: str, timeout_s: float = 10.0) -> None:
    """Wait in steps that leave the machine to others: looking into a file costs time."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"not within {timeout_s} s: {what}"
        time.sleep(0.03)


def read_image(data: bytes | memoryview) -> tuple[bytes, str]:
    """A foxglove.CompressedImage: its bytes and their format."""
    message = CompressedImage.FromString(bytes(data))
    return message.data, message.format


def read_pose(data: bytes) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """A foxglove.PoseInFrame: position [m] and quaternion (x, y, z, w)."""
    place = PoseInFrame.FromString(data).pose
    at, turned = place.position, place.orientation
    return (at.x, at.y, at.z), (turned.x, turned.y, turned.z, turned.w)

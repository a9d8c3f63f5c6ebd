"""Recovery of recordings that were cut off or damaged: what can be read goes into a new file, with an index."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from skyloop.errors import UsageError
from skyloop.files import replacing
from skyloop.recording.layout import PROFILE
from skyloop.recording.reader import Progress, Recording
from skyloop.recording.scan import Channel, Message, Scan, Schema, attachments, open_file, records

if TYPE_CHECKING:
    from mcap.writer import Writer


@dataclass(frozen=True, slots=True)
class Recovered:
    """What was recovered."""

    path: Path
    messages: dict[str, int]  #: by topic
    seconds: float
    size: int  #: of the new file [bytes]
    lost: int  #: bytes of the old one that could not be read, at most
    why: tuple[str, ...]  #: what was wrong with it


def problems(recording: Recording, progress: Progress | None = None) -> tuple[str, ...]:
    """Read every byte of a recording, and describe what is wrong with it; empty if it is intact.

    Args:
        recording: The recording.
        progress: Called with the share that was read, 0 to 1.
    """
    for _ in recording.entries(progress=progress):
        pass  # checksums are looked at as it is read
    return (*([recording.cut] if recording.cut else []), *recording.found.damaged)


def recover(recording: Recording, target: Path, progress: Progress | None = None) -> Recovered:
    """Write what can be read to a new file, which is complete at the end or not there at all.

    Args:
        recording: The damaged recording.
        target: The new file.
        progress: Called with the share that was read, 0 to 1.

    Raises:
        UsageError: ``target`` exists already, or can't be written.
    """
    from mcap.writer import CompressionType, Writer

    if target.exists():
        raise UsageError(f"{target} exists already: choose another name (-o)")
    found = recording.found
    with replacing(target) as part, part.open("wb") as file:
        counts, read = _copy(found, Writer(file, compression=CompressionType.ZSTD), progress)
    mended = Recording.open(target)
    total = sum(piece.size for piece in found.pieces)
    why = (*([found.cut] if found.cut else []), *found.damaged)
    return Recovered(target, counts, mended.seconds, target.stat().st_size, total - read, why)


def _copy(found: Scan, writer: Writer, progress: Progress | None) -> tuple[dict[str, int], int]:
    """Return messages by topic, and the bytes of pieces that were read to their end."""
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
                elif isinstance(one, Channel):
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


def _register(writer: Writer, channel: Channel, schemas: dict[int, int]) -> tuple[int, str]:
    schema = schemas.get(channel.schema_id, 0)
    number = writer.register_channel(channel.topic, channel.message_encoding, schema, channel.metadata)
    return number, channel.topic

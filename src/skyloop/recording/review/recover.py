"""Mends a recording that was cut off or damaged: what can be read goes into a new file, with an index and a summary."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from skyloop.errors import UsageError
from skyloop.logfile.layout import PROFILE
from skyloop.logfile.reader import Progress, Recording
from skyloop.logfile.scan import Channel, Message, Scan, Schema, open_file, records

if TYPE_CHECKING:
    from mcap.writer import Writer


@dataclass(frozen=True, slots=True)
class Recovered:
    """What was saved."""

    path: Path
    messages: dict[str, int]  #: by topic
    seconds: float
    size: int  #: of the new file [bytes]
    lost: int  #: bytes of the old one that could not be read, at most
    why: tuple[str, ...]  #: what was wrong with it


def problems(recording: Recording, progress: Progress | None = None) -> tuple[str, ...]:
    """What is wrong with a file, looking at every byte of it; empty for one that is whole."""
    for _ in recording.entries(progress=progress):
        pass  # checksums are looked at as it is read
    return (*([recording.cut] if recording.cut else []), *recording.found.damaged)


def recover(recording: Recording, target: Path, progress: Progress | None = None) -> Recovered:
    """Write what can be read to ``target``, which is there at the end or not at all.

    Raises :class:`UsageError` where it exists already or can't be written.
    """
    from mcap.writer import CompressionType, Writer

    if target.exists():
        raise UsageError(f"{target} exists already: choose another name (-o)")
    part = target.with_name(target.name + ".part")
    found = recording.found
    try:
        with part.open("wb") as file:
            counts, read = _copy(found, Writer(file, compression=CompressionType.ZSTD), progress)
            file.flush()
            os.fsync(file.fileno())
        part.rename(target)
    except OSError as error:
        raise UsageError(f"{target} can't be written: {error.strerror}") from error
    finally:
        part.unlink(missing_ok=True)
    mended = Recording.open(target)
    total = sum(piece.size for piece in found.pieces)
    why = (*([found.cut] if found.cut else []), *found.damaged)
    return Recovered(target, counts, mended.seconds, target.stat().st_size, total - read, why)


def _copy(found: Scan, writer: Writer, progress: Progress | None) -> tuple[dict[str, int], int]:
    """Messages by topic, and bytes of pieces that were read to their end."""
    writer.start(PROFILE, "skyloop log recover")
    for record in found.metadata:
        writer.add_metadata(record.name, record.metadata)
    for attachment in found.attachments:
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

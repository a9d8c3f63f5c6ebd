"""Tables of contents on disk, by their fingerprint, so that a known firmware's tables are not read again."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from skyloop import files
from skyloop.errors import DecodeError, SkyloopError
from skyloop.vehicles.crazyflie.wire.contents import ContentsInfo, Entry, answer_item, decode_contents
from skyloop.vehicles.crazyflie.wire.crtp import CrtpPacket, CrtpPort

_MOST_BYTES = 1 << 20


def cache_folder() -> Path:
    import platformdirs

    return Path(platformdirs.user_cache_dir("skyloop", appauthor=False)) / "crazyflie"


class ContentsCache:
    """Tables in a folder. A file is the table's answers as the vehicle sent them, and a checksum.

    Whatever is wrong with a file or the folder, the table is unknown, and is read from the vehicle.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder

    def load(self, port: CrtpPort, info: ContentsInfo) -> list[Entry] | None:
        """Return a known table; None if it has to be read."""
        try:
            content = files.read_bytes(self._path(port, info), "a table of contents", _MOST_BYTES)
            checksum, rest = struct.unpack_from("<I", content)[0], content[4:]
            if zlib.crc32(rest) != checksum:
                return None
            entries = []
            while rest:
                entry = decode_contents(CrtpPacket.decode(rest[1 : 1 + rest[0]]))
                if not isinstance(entry, Entry) or entry.number != len(entries):
                    return None
                entries.append(entry)
                rest = rest[1 + rest[0] :]
        except (OSError, SkyloopError, DecodeError, struct.error):
            return None
        return entries if len(entries) == info.count else None

    def save(self, port: CrtpPort, info: ContentsInfo, entries: Sequence[Entry]) -> None:
        packets = [answer_item(port, entry).encode() for entry in entries]
        content = b"".join(bytes((len(packet),)) + packet for packet in packets)
        path = self._path(port, info)
        with suppress(OSError, SkyloopError):
            path.parent.mkdir(parents=True, exist_ok=True)
            files.write(path, struct.pack("<I", zlib.crc32(content)) + content)

    def _path(self, port: CrtpPort, info: ContentsInfo) -> Path:
        folder = cache_folder() if self._folder is None else self._folder
        return folder / f"{port.name.lower()}-{info.crc:08x}.bin"

"""The size of the picture in a JPEG or PNG file, read from its header without decoding it.

A decoder reserves memory for what the header announces: a file of a few kilobytes may ask for gigabytes. Formats:
ITU-T T.81 (JPEG), annex B; W3C PNG, section 5.
"""

from __future__ import annotations

import struct
from typing import Final

#: The largest picture that is decoded, 8K UHD: no camera of a small drone comes near, and it takes 100 MB as BGR.
MAX_PIXELS: Final = 7680 * 4320
#: Of a progressive JPEG, each of which goes over the whole picture; encoders make about ten.
MAX_SCANS: Final = 100

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_JPEG: Final = b"\xff\xd8"
_SCAN: Final = b"\xff\xda"
_START_OF_FRAME: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH: Final = frozenset({0x01, *range(0xD0, 0xD8)})
_ENDS: Final = frozenset({0xD8, 0xD9, 0xDA})  #: no head goes on behind a second start, the end, or the first scan


def image_size(data: bytes | memoryview) -> tuple[int, int] | None:
    """Return width and height [px] that the header of a JPEG or PNG announces.

    Returns:
        None for anything else, or a damaged header.
    """
    if data[:8] == _PNG:
        if data[12:16] != b"IHDR" or len(data) < 24:
            return None
        width, height = struct.unpack_from(">II", data, 16)
        return (width, height) if width and height else None
    if data[:2] == _JPEG:
        return _jpeg_size(data)
    return None


def why_not_decoded(data: bytes | memoryview) -> str:
    """Return why a picture must not be given to a decoder; empty if it may be."""
    size = image_size(data)
    if size is None:
        return "it is neither JPEG nor PNG, or it is damaged"
    width, height = size
    if width * height > MAX_PIXELS:
        return f"it announces {width} × {height} pixels, and at most {MAX_PIXELS} are decoded"
    if data[:2] == _JPEG and (scans := bytes(data).count(_SCAN)) > MAX_SCANS:
        return f"it is a JPEG of {scans} scans, and at most {MAX_SCANS} are decoded"
    return ""


def _jpeg_size(data: bytes | memoryview) -> tuple[int, int] | None:
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF or data[at + 1] in (0x00, 0xFF):  # fill bytes, and what a decoder skips
            at += 1
            continue
        marker = data[at + 1]
        at += 2
        if marker in _WITHOUT_LENGTH:
            continue
        if marker in _ENDS or at + 2 > len(data):
            return None
        (length,) = struct.unpack_from(">H", data, at)
        if marker in _START_OF_FRAME:
            if length < 8 or at + 7 > len(data):
                return None
            height, width = struct.unpack_from(">HH", data, at + 3)
            return (width, height) if width and height else None
        if length < 2:
            return None
        at += length
    return None

"""Encode and resize frames as requested. Pure."""

from __future__ import annotations

from typing import Any

import msgspec

from skyloop.errors import LinkError, MissingExtraError
from skyloop.messages import Encoding, FrameHeader, Intrinsics
from skyloop.messages.fields import CHANNELS
from skyloop.messages.subscription import VideoRequest
from skyloop.transport.base import Pixels


def encode_frame(header: FrameHeader, pixels: Pixels, request: VideoRequest) -> tuple[FrameHeader, bytes]:
    """Encode a frame as requested. Return the header that describes the result, and the result's bytes.

    A frame that is already a JPEG is returned unchanged, regardless of the request. Raises :class:`MissingExtraError`
    if OpenCV is needed but not installed, and :class:`LinkError` if OpenCV could not encode the frame.
    """
    channels = CHANNELS.get(header.encoding)
    if channels is None or (request.encoding == "raw" and request.scale == 1.0):
        return header, pixels.tobytes()
    picture: Any = pixels.reshape(header.height, header.width, channels)
    if request.scale != 1.0:
        header = scaled_header(header, request.scale)
        picture = resized(picture, header)
    if request.encoding == "raw":
        return header, picture.tobytes()
    cv2 = _opencv()
    if header.encoding is Encoding.RGB8:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    done, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, request.quality])
    if not done:
        raise LinkError(f"frame {header.seq} of {header.camera} could not be encoded as JPEG")
    return msgspec.structs.replace(header, encoding=Encoding.JPEG, size=int(jpeg.size)), jpeg.tobytes()


def scaled_header(header: FrameHeader, scale: float) -> FrameHeader:
    """Return the header of a scaled-down frame as plain pixels, with matching intrinsics."""
    return resized_header(header, max(1, round(header.width * scale)), max(1, round(header.height * scale)))


def resized_header(header: FrameHeader, width: int, height: int) -> FrameHeader:
    """Return the header of a frame resized to ``width`` × ``height`` plain pixels, with matching intrinsics."""
    x, y = width / header.width, height / header.height
    lens = header.intrinsics
    if lens is not None:
        # The first pixel's centre is at (0, 0). Scaling therefore leaves that pixel's corner at (-0.5, -0.5) in place.
        lens = Intrinsics(
            lens.fx * x, lens.fy * y, (lens.cx + 0.5) * x - 0.5, (lens.cy + 0.5) * y - 0.5, lens.distortion, lens.model
        )
    size = width * height * CHANNELS.get(header.encoding, 3)
    return msgspec.structs.replace(header, width=width, height=height, size=size, intrinsics=lens)


def resized(picture: Any, header: FrameHeader) -> Any:
    """Resize an image of shape (height, width, channels) to the header's size by averaging areas."""
    size = (header.width, header.height)
    return _opencv().resize(picture, size, interpolation=_opencv().INTER_AREA).reshape(header.height, header.width, -1)


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("smaller or encoded video", "network", cause=str(error)) from None
    return cv2

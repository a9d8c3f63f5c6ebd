"""What travels with a frame of video."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import msgspec

from skyloop.messages.fields import Encoding
from skyloop.messages.numbers import Count, Finite, TimeNs

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Name = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
Pixels = Annotated[int, msgspec.Meta(ge=1, le=16384)]


class Intrinsics(msgspec.Struct, frozen=True, array_like=True):
    """A camera's intrinsics in OpenCV's convention, in pixels of the frame that they come with."""

    fx: Finite
    fy: Finite
    cx: Finite
    cy: Finite
    #: k1, k2, p1, p2[, k3, …] (pinhole) or k1 … k4 (fisheye)
    distortion: Annotated[tuple[Finite, ...], msgspec.Meta(max_length=14)] = ()
    model: str = "pinhole"  #: ``pinhole`` or ``fisheye``

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The camera matrix K, shape (3, 3)."""
        import numpy as np

        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


class FrameHeader(msgspec.Struct, frozen=True, array_like=True):
    """Describes one frame; its pixels travel beside it."""

    camera: Name
    seq: Count  #: grows by one with each frame that this camera gave, dropped ones included
    captured_ns: TimeNs  #: middle of the exposure as near as the vehicle reports it, on the proxy's clock
    published_ns: TimeNs  #: when the proxy had it
    width: Pixels
    height: Pixels
    encoding: Encoding
    size: Count  #: bytes of pixels
    intrinsics: Intrinsics | None = None


class CameraInfo(msgspec.Struct, frozen=True, array_like=True):
    """A camera that a vehicle has. Known before the first frame."""

    name: Name
    width: Pixels
    height: Pixels
    fps: Finite  #: nominal
    encoding: Encoding = Encoding.BGR8
    intrinsics: Intrinsics | None = None
    #: rotation from the camera's optical axes (x right, y down, z forward) to the body's axes, row by row
    rotation: tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite, Finite, Finite] | None = None
    position_m: tuple[Finite, Finite, Finite] | None = None  #: of the optical centre in body axes [m]
    stream: str = ""  #: codec in which its pictures can be had as they come, ``h264``; empty: as frames only

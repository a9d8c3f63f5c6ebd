"""A camera's calibration as a file: JSON with the intrinsics, the size of the pictures, and how well they are known."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Final

import msgspec

from skyloop import files
from skyloop.errors import UsageError
from skyloop.messages import Intrinsics

MAX_BYTES: Final = 1 << 20  #: of a file; it takes less than a kilobyte
_Side = Annotated[int, msgspec.Meta(ge=1, le=16384)]
_Count = Annotated[int, msgspec.Meta(ge=0)]
_LENGTHS = {"pinhole": (0, 4, 5, 8), "fisheye": (0, 4)}
_SAME_SHAPE = 0.01  # how much the ratio of the sides may differ: rounding of small pictures


class Calibration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What :func:`skyloop.vision.calibrate` found; raises :class:`UsageError` for values that no camera has."""

    width: _Side  #: of the pictures [px]
    height: _Side
    model: str  #: ``pinhole`` or ``fisheye``
    fx: float  #: [px], for pictures of this size, as all of them
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  #: as :class:`Intrinsics` has it
    rms_px: float | None = None  #: of the corners' distances to where they should be by this calibration
    views: _Count = 0  #: pictures of the board that it is made of
    rejected: _Count = 0  #: pictures that did not go with the others
    coverage: float | None = None  #: share of the picture's area in which corners were seen, 0 to 1
    fx_deviation: float | None = None  #: standard deviation of the focal length [px], as far as the corners show it
    camera: str = ""  #: a name for people

    def __post_init__(self) -> None:
        if self.model not in _LENGTHS:
            raise UsageError(f"model is {self.model!r} and must be 'pinhole' or 'fisheye'")
        if not all(math.isfinite(value) for value in (self.fx, self.fy, self.cx, self.cy, *self.distortion)):
            raise UsageError("a camera's intrinsics must be finite")
        if not (self.fx > 0.0 and self.fy > 0.0):
            raise UsageError(f"the focal lengths are {self.fx:g} and {self.fy:g} and must be above 0")
        if len(self.distortion) not in _LENGTHS[self.model]:
            lengths = " or ".join(str(length) for length in _LENGTHS[self.model])
            raise UsageError(f"the distortion of a {self.model} has {lengths} numbers, not {len(self.distortion)}")

    @property
    def intrinsics(self) -> Intrinsics:
        """For pictures of :attr:`width` × :attr:`height`."""
        return Intrinsics(self.fx, self.fy, self.cx, self.cy, self.distortion, self.model)

    def fits(self, width: int, height: int) -> bool:
        """Whether pictures of this size have the shape of those that it was made of."""
        return abs(width / height - self.width / self.height) <= _SAME_SHAPE * width / height

    def intrinsics_for(self, width: int, height: int) -> Intrinsics:
        """For pictures of another size that show the same, by scaling. Raises :class:`UsageError` for another shape."""
        if not self.fits(width, height):
            raise UsageError(
                f"the calibration is for {self.width}x{self.height} or the same aspect ratio, got {width}x{height}"
            )
        across, down = width / self.width, height / self.height
        return Intrinsics(
            self.fx * across,
            self.fy * down,
            (self.cx + 0.5) * across - 0.5,  # pixels are counted from the middle of the first one
            (self.cy + 0.5) * down - 0.5,
            self.distortion,
            self.model,
        )

    def save(self, path: str | Path) -> None:
        """Write it as JSON. Raises :class:`UsageError` where that can't be written."""
        files.write(Path(path), msgspec.json.format(msgspec.json.encode(self)) + b"\n")


def load_calibration(path: str | Path) -> Calibration:
    """Raises :class:`FileFormatError` for a file that can't be read or is no calibration."""
    return files.read_json(path, Calibration, "a calibration of a camera", MAX_BYTES)

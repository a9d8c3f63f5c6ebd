"""Read and write camera calibrations as JSON files: the intrinsics, the image size, and the accuracy."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Final

import msgspec

from skyloop import files
from skyloop.errors import UsageError
from skyloop.messages import Intrinsics

MAX_BYTES: Final = 1 << 20  #: maximum size of a file [bytes]; a calibration takes less than 1000
_Side = Annotated[int, msgspec.Meta(ge=1, le=16384)]
_Count = Annotated[int, msgspec.Meta(ge=0)]
_LENGTHS = {"pinhole": (0, 4, 5, 8), "fisheye": (0, 4)}  # allowed numbers of distortion coefficients, by model
_SAME_SHAPE = 0.01  # tolerance for comparing aspect ratios; the sizes of small images are rounded


class Calibration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera calibration made by :func:`skyloop.vision.calibrate`; raises :class:`UsageError` for invalid values."""

    width: _Side  #: width of the images [px]
    height: _Side
    model: str  #: ``pinhole`` or ``fisheye``
    fx: float  #: focal length [px]; all parameters are for images of this size
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  #: distortion coefficients, as in :class:`Intrinsics`
    rms_px: float | None = None  #: root mean square reprojection error of the corners
    views: _Count = 0  #: number of images of the board that the calibration used
    rejected: _Count = 0  #: number of images rejected as outliers
    coverage: float | None = None  #: fraction of the image area in which corners were seen, 0 to 1
    fx_deviation: float | None = None  #: standard deviation of the focal length [px], estimated from the corners
    camera: str = ""  #: name of the camera, for display only

    def __post_init__(self) -> None:
        if self.model not in _LENGTHS:
            raise UsageError(f"model is {self.model!r} and must be 'pinhole' or 'fisheye'")
        if not all(math.isfinite(value) for value in (self.fx, self.fy, self.cx, self.cy, *self.distortion)):
            raise UsageError("a camera's intrinsics must be finite")
        if not (self.fx > 0.0 and self.fy > 0.0):
            raise UsageError(f"the focal lengths are {self.fx:g} and {self.fy:g} and must be above 0")
        if len(self.distortion) not in _LENGTHS[self.model]:
            lengths = " or ".join(str(length) for length in _LENGTHS[self.model])
            raise UsageError(f"the distortion of a {self.model} needs {lengths} numbers, got {len(self.distortion)}")

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics for images of :attr:`width` × :attr:`height`."""
        return Intrinsics(self.fx, self.fy, self.cx, self.cy, self.distortion, self.model)

    def fits(self, width: int, height: int) -> bool:
        """Return whether images of this size have the calibrated aspect ratio."""
        return abs(width / height - self.width / self.height) <= _SAME_SHAPE * width / height

    def intrinsics_for(self, width: int, height: int) -> Intrinsics:
        """Scale the intrinsics to a different image size. Raises :class:`UsageError` if the aspect ratio differs."""
        if not self.fits(width, height):
            raise UsageError(
                f"the calibration is for {self.width}x{self.height} or the same aspect ratio, got {width}x{height}"
            )
        across, down = width / self.width, height / self.height
        return Intrinsics(
            self.fx * across,
            self.fy * down,
            (self.cx + 0.5) * across - 0.5,  # pixel coordinates start at the centre of the first pixel
            (self.cy + 0.5) * down - 0.5,
            self.distortion,
            self.model,
        )

    def save(self, path: str | Path) -> None:
        """Write the calibration as JSON. Raises :class:`UsageError` if the file can't be written."""
        files.write(Path(path), msgspec.json.format(msgspec.json.encode(self)) + b"\n")


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration file. Raises :class:`FileFormatError` if the file can't be read or contains no calibration."""
    return files.read_json(path, Calibration, "a camera calibration", MAX_BYTES)

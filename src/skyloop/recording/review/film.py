"""The video of one camera in a dataset for learning, and what a dataset says of its numbers and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import FileFormatError, MissingExtraError, UsageError
from skyloop.files import replacing
from skyloop.recording.reader import Recording
from skyloop.recording.review.episodes import Times
from skyloop.recording.review.video import even

_KEY_EVERY: Final = 2  #: pictures: training reads them in any order
_LOOKED_AT_EVERY: Final = 16  #: a row of these, for what is said of all
_THINNED: Final = 4  #: of a picture that is looked at, each fourth row and column
_QUANTILES: Final = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Pixels = NDArray[np.uint8]


class Film:
    """One camera's pictures of all episodes, one after the other, at a steady rate: H.264 in an MP4 file.

    Args:
        path: The file; it stands there once the film is closed without an error.
        fps: Pictures a second.

    Attributes:
        width: Of the pictures [px]; 0 before the first.
        height: Of the pictures [px].
        repeated: Rows whose picture could not be decoded, for which the one before stands.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.width = self.height = self.repeated = 0
        self._path, self._fps = path, Fraction(fps).limit_denominator(1000)
        self._opened = ExitStack()
        self._container: Any = None
        self._stream: Any = None
        self._rows = 0
        self._looked_at: list[NDArray[np.uint8]] = []

    def __enter__(self) -> Film:
        """Open the file."""
        import av

        self._path.parent.mkdir(parents=True, exist_ok=True)
        part = self._opened.enter_context(replacing(self._path))
        file = self._opened.enter_context(part.open("wb"))
        self._container = self._opened.enter_context(av.open(file, "w", format="mp4"))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete the file; after an error it is removed."""
        if kind is None and self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._opened.__exit__(kind, error, trace)

    def add(self, recording: Recording, drone: str, camera: str, wanted_ns: Sequence[Times]) -> None:
        """Encode the pictures of a recording's rows.

        Args:
            recording: The recording.
            drone: The drone's name.
            camera: The camera's name.
            wanted_ns: The capture of each row's picture, of each episode, in order.

        Raises:
            FileFormatError: The first picture can't be decoded.
            UsageError: A picture has another size than the first.
            MissingExtraError: OpenCV, or a PyAV with x264, is not installed.
        """
        wanted = np.concatenate([np.empty(0, np.int64), *wanted_ns])
        at = 0
        image: Pixels | None = None
        for picture in recording.pictures(drone, camera):
            captured_ns = picture.header.captured_ns
            if at >= len(wanted):
                return
            if captured_ns < wanted[at]:
                continue
            try:
                image = even(picture.pixels())
            except FileFormatError:
                if image is None:
                    raise
                self.repeated += int(np.count_nonzero(wanted == captured_ns))
            while at < len(wanted) and wanted[at] <= captured_ns:
                self._encode(image, recording.path)
                at += 1
        for _ in wanted[at:]:  # their pictures are missing at the end of a file that was cut off
            if image is None:
                raise FileFormatError(f"{recording.path}: no picture of {camera} can be decoded")
            self.repeated += 1
            self._encode(image, recording.path)

    def stats(self) -> dict[str, Any]:
        """Return least, greatest, mean, deviation and quantiles of each channel: red, green, blue, 0 to 1."""
        pixels = np.concatenate([image.reshape(-1, 3) for image in self._looked_at])[:, ::-1] / 255.0
        found = numbers_stats(pixels)
        return {name: [self._rows] if name == "count" else [[[v]] for v in value] for name, value in found.items()}

    def _encode(self, image: Pixels, path: Path) -> None:
        import av

        height, width = image.shape[:2]
        if self._stream is None:
            self._begin(width, height)
        if (width, height) != (self.width, self.height):
            raise UsageError(
                f"{path} has pictures of {width}×{height}, the first ones were {self.width}×{self.height}: "
                "export what does not go together one by one"
            )
        if self._rows % _LOOKED_AT_EVERY == 0:
            self._looked_at.append(image[::_THINNED, ::_THINNED].copy())
        frame = av.VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts, frame.time_base = self._rows, 1 / self._fps
        self._rows += 1
        self._container.mux(self._stream.encode(frame))

    def _begin(self, width: int, height: int) -> None:
        try:
            stream = self._container.add_stream("libx264", rate=self._fps)
        except ValueError as error:
            raise MissingExtraError("encoding H.264", "video", cause="this PyAV comes without x264") from error
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.time_base = stream.codec_context.time_base = 1 / self._fps
        stream.options = {"crf": "18", "preset": "veryfast", "g": str(_KEY_EVERY), "bf": "0"}
        self._stream, self.width, self.height = stream, width, height


def numbers_stats(values: NDArray[Any]) -> dict[str, Any]:
    """Return what a dataset says of a column's numbers, each as a list: one, or one for each of a row's.

    Args:
        values: Shape (rows,) or (rows, n).
    """
    columns = values.reshape(len(values), -1).astype(np.float64)
    found = {"min": columns.min(0), "max": columns.max(0), "mean": columns.mean(0), "std": columns.std(0)}
    found |= {name: np.quantile(columns, share, axis=0) for name, share in _QUANTILES.items()}
    return {"count": [len(values)], **{name: value.tolist() for name, value in found.items()}}

"""Export of a recording's samples to CSV, Parquet and NumPy, and of its frames to MP4."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError, MissingExtraError, UsageError
from skyloop.files import replacing
from skyloop.logfile.layout import Channel
from skyloop.logfile.reader import Progress, Recording
from skyloop.recording.review.tables import Table, begin_ns, tables

#: Channels that become a table; frames are listed with their times.
TABLES: Final = tuple(Channel)
_FORMULA: Final = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")  #: formulas' first characters
_NUMBER: Final = r"[-+]?(?:[0-9.]+(?:e[-+]?[0-9]+)?|inf|nan)"
_NUMBERS: Final = re.compile(rf"{_NUMBER}(?: {_NUMBER})*")
_TIME_BASE: Final = Fraction(1, 60_000)  #: of MP4: each picture keeps its own time; MPEG-4 takes no more than 65535
_CODECS: Final = ("libx264", "libopenh264", "mpeg4")  #: the first that this PyAV has


def export_csv(found: dict[str, Table], folder: Path) -> list[Path]:
    """Write ``CHANNEL.csv`` for each table: UTF-8, comma, a header line; what is not known is empty.

    A text that a spreadsheet would take for a formula gets an apostrophe before it, because applications, and those who
    made the file, choose such texts.

    Args:
        found: Tables by their names.
        folder: Is created if needed.

    Returns:
        The files.
    """
    _make_folder(folder)
    written = []
    for name, table in found.items():
        path = folder / f"{name}.csv"
        columns = [[_text(cell) for cell in column.tolist()] for column in table.columns.values()]
        with replacing(path) as part, part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(map(_harmless, table.columns))
            writer.writerows(zip(*columns, strict=True))
        written.append(path)
    return written


def export_parquet(found: dict[str, Table], folder: Path) -> list[Path]:
    """Write ``CHANNEL.parquet`` for each table; what is not known is null.

    Args:
        found: Tables by their names.
        folder: Is created if needed.

    Returns:
        The files.

    Raises:
        MissingExtraError: PyArrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise MissingExtraError("exporting Parquet", "parquet", cause=str(error)) from None
    _make_folder(folder)
    written = []
    for name, table in found.items():
        arrays = {column: pa.array(values, from_pandas=True) for column, values in _nulls(table).items()}
        path = folder / f"{name}.parquet"
        with replacing(path) as part:
            pq.write_table(pa.table(arrays), part)
        written.append(path)
    return written


def export_npz(found: dict[str, Table], path: Path) -> list[Path]:
    """Write one compressed ``.npz`` with an array ``CHANNEL/COLUMN`` for each column.

    Args:
        found: Tables by their names.
        path: Gets the ending ``.npz`` if it has another one.

    Returns:
        The file.
    """
    arrays = {f"{name}/{column}": values for name, table in found.items() for column, values in table.columns.items()}
    path = path if path.suffix == ".npz" else path.with_suffix(".npz")
    with replacing(path) as part:
        np.savez_compressed(part, **arrays)  # type: ignore[arg-type]
    return [path]


def read(
    recording: Recording, drone: str, channels: Collection[Channel] | None, progress: Progress | None = None
) -> dict[str, Table]:
    """Read the tables to export.

    Args:
        recording: The recording.
        drone: The drone's name.
        channels: Which ones; None reads all.
        progress: Called with the share that was read, 0 to 1.

    Raises:
        FileFormatError: The recording has none of these channels.
    """
    found = tables(recording, drone, channels or TABLES, progress)
    if not found:
        raise FileFormatError(f"{recording.path} holds none of these channels of {drone}")
    return found


def export_mp4(
    recording: Recording,
    drone: str,
    camera: str,
    path: Path,
    *,
    burn_time: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write one camera's frames as a video with the times of their capture.

    Damaged frames, and frames of another size than the first, are left out.

    Args:
        recording: The recording.
        drone: The drone's name.
        camera: The camera's name.
        path: The file.
        burn_time: Whether to draw the time since the recording's start into a corner of each frame.
        progress: Called with the share that was read, 0 to 1.

    Returns:
        The number of frames.

    Raises:
        UnknownNameError: The recording has no such drone or camera.
        FileFormatError: No frame can be decoded.
        MissingExtraError: PyAV or OpenCV is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise MissingExtraError("exporting MP4", "video", cause=str(error)) from None
    begin = begin_ns(recording, drone) if burn_time else None
    # PyAV would open the file only with the first frame, and raise errors of its own kinds.
    with replacing(path) as part:
        with part.open("wb") as file, av.open(file, "w", format="mp4") as container:
            count = _encode(av, recording, drone, camera, container, begin, progress)
        if not count:
            raise FileFormatError(f"{recording.path}: no frame of {camera} can be decoded")
    return count


def _encode(
    av: Any,
    recording: Recording,
    drone: str,
    camera: str,
    container: Any,
    begin: int | None,
    progress: Progress | None,
) -> int:
    """Encode the frames; return how many. ``begin``: the recording's start [ns] to burn in the time, or None."""
    first_ns: int | None = None
    newest = -1
    count = 0
    stream: Any = None
    for picture in recording.pictures(drone, camera, progress=progress):
        try:
            image = _even(picture.pixels())
        except FileFormatError:
            continue  # a damaged frame is left out; the others keep their times
        if stream is None:
            stream = _stream(av, container, image)
        if image.shape[:2] != (stream.height, stream.width):
            continue  # the camera was switched to another size, and a video has only one
        captured_ns = picture.header.captured_ns
        first_ns = captured_ns if first_ns is None else first_ns
        if begin is not None:
            _burn(image, (captured_ns - begin) / NS_PER_S)
        stamp = max(newest + 1, round((captured_ns - first_ns) / NS_PER_S / _TIME_BASE))
        newest = stamp
        frame = av.VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts, frame.time_base = stamp, _TIME_BASE
        container.mux(stream.encode(frame))
        count += 1
    if stream is not None:
        container.mux(stream.encode(None))
    return count


def _stream(av: Any, container: Any, image: NDArray[np.uint8]) -> Any:
    for codec in _CODECS:
        try:
            stream = container.add_stream(codec, rate=30)
        except (ValueError, av.error.FFmpegError):
            continue
        stream.height, stream.width = image.shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.time_base = stream.codec_context.time_base = _TIME_BASE
        if codec == "libx264":
            stream.options = {"crf": "20", "preset": "veryfast"}
        else:
            stream.bit_rate = 4_000_000
        return stream
    raise MissingExtraError("encoding MP4", "video", cause=f"PyAV has none of {', '.join(_CODECS)}")


def _even(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Video codecs want even sizes: an odd last row or column is left out."""
    height, width = image.shape[0] & ~1, image.shape[1] & ~1
    return np.ascontiguousarray(image[:height, :width])


def _burn(image: NDArray[np.uint8], seconds: float) -> None:
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("burning the time into frames", "vision", cause=str(error)) from None
    minutes, rest = divmod(abs(seconds), 60.0)
    text = f"{'-' if seconds < 0 else ''}{int(minutes):02d}:{rest:06.3f}"
    scale = max(0.35, image.shape[0] / 720)
    at = (round(12 * scale), image.shape[0] - round(14 * scale))
    for colour, thickness in (((0, 0, 0), 5), ((255, 255, 255), 2)):
        width = max(1, round(thickness * scale))
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, width, cv2.LINE_AA)


def _nulls(table: Table) -> dict[str, Any]:
    """Columns in which what is not known is None."""
    return {
        name: [cell or None for cell in values.tolist()] if values.dtype.kind == "U" else values
        for name, values in table.columns.items()
    }


def _text(cell: Any) -> str:
    if isinstance(cell, float):
        return "" if np.isnan(cell) else repr(cell)
    return _harmless(str(cell))


def _harmless(text: str) -> str:
    """A text that a spreadsheet would take for a formula, with an apostrophe before it; numbers stay as they are."""
    return f"'{text}" if text.startswith(_FORMULA) and not _NUMBERS.fullmatch(text) else text


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} can't be made: {error.strerror}") from error

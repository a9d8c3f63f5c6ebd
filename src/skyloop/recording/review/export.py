"""A recording's samples as files that other programs read: CSV, Parquet, NumPy and, of the pictures, MP4."""

from __future__ import annotations

import csv
from collections.abc import Collection
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError, MissingExtraError, UsageError
from skyloop.logfile.layout import Channel
from skyloop.logfile.reader import Progress, Recording
from skyloop.recording.review.tables import Table, begin_ns, tables

#: Channels that make a table; frames are listed with their times.
TABLES: Final = tuple(Channel)
_TIME_BASE: Final = Fraction(1, 60_000)  #: of MP4: each picture keeps its own time; MPEG-4 takes no more than 65535
_CODECS: Final = ("libx264", "libopenh264", "mpeg4")  #: the first that this PyAV has


def export_csv(found: dict[str, Table], folder: Path) -> list[Path]:
    """``CHANNEL.csv`` for each table, UTF-8, comma, a head line; what is not known is empty."""
    _make_folder(folder)
    written = []
    for name, table in found.items():
        path = folder / f"{name}.csv"
        columns = [[_text(cell) for cell in column.tolist()] for column in table.columns.values()]
        with _create(path) as file:
            writer = csv.writer(file)
            writer.writerow(table.columns)
            writer.writerows(zip(*columns, strict=True))
        written.append(path)
    return written


def export_parquet(found: dict[str, Table], folder: Path) -> list[Path]:
    """``CHANNEL.parquet`` for each table; what is not known is null. Raises :class:`MissingExtraError`."""
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
        try:
            pq.write_table(pa.table(arrays), path)
        except OSError as error:
            raise UsageError(f"{path} can't be written: {error.strerror or error}") from error
        written.append(path)
    return written


def export_npz(found: dict[str, Table], path: Path) -> list[Path]:
    """One compressed ``.npz`` with an array ``CHANNEL/COLUMN`` for each column."""
    arrays = {f"{name}/{column}": values for name, table in found.items() for column, values in table.columns.items()}
    path = path if path.suffix == ".npz" else path.with_suffix(".npz")
    try:
        np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
    except OSError as error:
        raise UsageError(f"{path} can't be written: {error.strerror}") from error
    return [path]


def read(
    recording: Recording, drone: str, channels: Collection[Channel] | None, progress: Progress | None = None
) -> dict[str, Table]:
    """The tables to export. Raises :class:`FileFormatError` if there are none."""
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
    """One camera's frames as a video with their own times; how many. Times are those of the captures.

    ``burn_time`` writes the time since the recording's begin into each picture's corner. Raises
    :class:`MissingExtraError`, :class:`FileFormatError` for a camera without frames.
    """
    try:
        import av
    except ImportError as error:
        raise MissingExtraError("exporting MP4", "video", cause=str(error)) from None
    begin = begin_ns(recording, drone)
    first_ns: int | None = None
    newest = -1
    count = 0
    try:
        file = path.open("wb")  # PyAV would open it with the first picture, and call the reason by a name of its own
    except OSError as error:
        raise UsageError(f"{path} can't be written: {error.strerror}") from error
    with file, av.open(file, "w", format="mp4") as container:
        stream: Any = None
        for picture in recording.pictures(drone, camera, progress=progress):
            try:
                image = _even(picture.pixels())
            except FileFormatError:
                continue  # a damaged picture is left out; the others keep their times
            if stream is None:
                stream = _stream(av, container, image)
            if image.shape[:2] != (stream.height, stream.width):
                continue  # the camera was switched to another size: one video has one
            captured_ns = picture.header.captured_ns
            first_ns = captured_ns if first_ns is None else first_ns
            if burn_time:
                _burn(image, (captured_ns - begin) / NS_PER_S)
            stamp = max(newest + 1, round((captured_ns - first_ns) / NS_PER_S / _TIME_BASE))
            newest = stamp
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts, frame.time_base = stamp, _TIME_BASE
            container.mux(stream.encode(frame))
            count += 1
        if stream is not None:
            container.mux(stream.encode(None))
    if not count:
        path.unlink(missing_ok=True)
        raise FileFormatError(f"{recording.path}: no frame of {camera} can be decoded")
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
        raise MissingExtraError("burning the time into pictures", "vision", cause=str(error)) from None
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
    return str(cell)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} can't be made: {error.strerror}") from error


def _create(path: Path) -> Any:
    try:
        return path.open("w", newline="", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path} can't be written: {error.strerror}") from error

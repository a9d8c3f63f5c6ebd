"""Export of a recording's samples to CSV, Parquet and NumPy."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any, Final

import numpy as np

from skyloop.errors import FileFormatError, MissingExtraError, UsageError
from skyloop.files import replacing
from skyloop.recording.layout import Channel
from skyloop.recording.reader import Progress, Recording
from skyloop.recording.review.tables import Table, tables

#: Channels that become a table; frames are listed with their times.
TABLES: Final = tuple(Channel)
_FORMULA: Final = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")  #: formulas' first characters
_NUMBER: Final = r"[-+]?(?:[0-9.]+(?:e[-+]?[0-9]+)?|inf|nan)"
_NUMBERS: Final = re.compile(rf"{_NUMBER}(?: {_NUMBER})*")


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

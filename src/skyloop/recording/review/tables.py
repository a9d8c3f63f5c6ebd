"""Convert one drone's samples to columns, which are the basis of reports and comparisons, and export them to files."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError, MissingExtraError, UsageError
from skyloop.files import replacing
from skyloop.messages import (
    AnyAction,
    Applied,
    Event,
    Feedback,
    LogEntry,
    Parameter,
)
from skyloop.recording.layout import Channel, Drops, FrameRecord, ResultRecord
from skyloop.recording.plain import TimeCourse
from skyloop.recording.reader import Item, Progress, Recording

#: Column names for the components of feedback's vectors, in order.
VECTORS: Final[dict[str, tuple[str, str, str]]] = {
    "velocity_m_s": ("velocity_forward_m_s", "velocity_left_m_s", "velocity_up_m_s"),
    "angular_velocity_rad_s": ("angular_velocity_x_rad_s", "angular_velocity_y_rad_s", "angular_velocity_z_rad_s"),
    "acceleration_m_s2": ("acceleration_x_m_s2", "acceleration_y_m_s2", "acceleration_z_m_s2"),
    "position_m": ("position_x_m", "position_y_m", "position_z_m"),
}
#: All values that actions can have, in column order.
ACTION_FIELDS: Final = (
    *("roll", "pitch", "climb", "forward", "left", "up", "yaw_rate"),
    *("x", "y", "z", "yaw", "speed", "turn_rate"),
)
_ABSURD: Final = 1e30  #: maximum value in any unit, so that sums of many squared values do not overflow
Cell = float | int | str | bool | None


@dataclass(slots=True)
class Table:
    """Columns of equal length that hold numbers (NaN: unknown) or strings (empty: unknown).

    ``t_s`` is the time since the recording's first sample [s] on the proxy's clock; all other times are in ns.
    """

    name: str
    columns: dict[str, NDArray[Any]] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(next(iter(self.columns.values()))) if self.columns else 0

    def __getitem__(self, column: str) -> NDArray[Any]:
        return self.columns[column]

    def numbers(self, column: str) -> NDArray[np.float64]:
        """Return a column as floats, with NaN for absurdly large numbers, or all NaN if there is no such column."""
        found = self.columns.get(column)
        if found is None:
            return np.full(len(self), np.nan)
        numbers = found.astype(np.float64)
        return np.where(np.abs(numbers) < _ABSURD, numbers, np.nan)

    def known(self, column: str) -> bool:
        """Return whether a column has at least one finite number."""
        return bool(np.isfinite(self.numbers(column)).any())


class _Builder:
    """Collects rows whose columns are not known until they arrive."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._rows = 0
        self._columns: dict[str, list[Cell]] = {}

    def add(self, row: dict[str, Cell]) -> None:
        for name, cell in row.items():
            column = self._columns.get(name)
            if column is None:
                column = self._columns[name] = [None] * self._rows
            column.append(cell)
        self._rows += 1
        for column in self._columns.values():
            if len(column) < self._rows:
                column.append(None)

    def table(self) -> Table:
        return Table(self._name, {name: _array(cells) for name, cells in self._columns.items()})


def _array(cells: list[Cell]) -> NDArray[Any]:
    """Convert cells to integers if all of them are, to floats if all are numbers, and otherwise to strings."""
    kinds = {type(cell) for cell in cells}
    if kinds <= {int}:
        return np.array(cells, np.int64)
    if kinds <= {bool}:
        return np.array(cells, np.bool_)
    if kinds <= {int, float, bool, type(None)}:
        return np.array([np.nan if cell is None else float(cell) for cell in cells], np.float64)
    return np.array(["" if cell is None else str(cell) for cell in cells], np.str_)


def tables(
    recording: Recording,
    drone: str,
    channels: Collection[Channel] = tuple(Channel),
    progress: Progress | None = None,
) -> dict[str, Table]:
    """Read a drone's tables, keyed by name (``feedback``, ``frames.CAMERA`` …), in channel order."""
    builders: dict[str, _Builder] = {}
    for item, at_ns, first_ns in timed(recording, drone, channels, progress):
        name = item.channel.value + (f".{item.camera}" if item.camera else "")
        builder = builders.get(name)
        if builder is None:
            builder = builders[name] = _Builder(name)
        builder.add({"t_s": (at_ns - first_ns) / NS_PER_S, **row(item)})
    order = list(Channel)
    names = sorted(builders, key=lambda name: (order.index(Channel(name.partition(".")[0])), name))
    return {name: builders[name].table() for name in names}


def timed(
    recording: Recording, drone: str, channels: Collection[Channel], progress: Progress | None = None
) -> Iterator[tuple[Item, int, int]]:
    """Yield samples with their own time and the time of the recording's first sample, both on the proxy's clock [ns].

    The first sample is determined across all channels, so that tables from several calls have the same start.
    """
    first_ns = begin_ns(recording, drone)
    course = TimeCourse()
    for item in recording.items(drone, channels, progress=progress):
        yield item, max(first_ns, course.follow(item.value, item.entry.log_ns)), first_ns


def begin_ns(recording: Recording, drone: str) -> int:
    """Return the time of the first sample that has a time, on the proxy's clock [ns]; 0 if no sample has one."""
    course = TimeCourse()
    for item in recording.items(drone):
        course.follow(item.value)
        if course.first_ns is not None:
            return course.first_ns
    return 0


def row(item: Item) -> dict[str, Cell]:
    """Convert a sample to cells, keyed by column name."""
    value = item.value
    cells: dict[str, Cell]
    if isinstance(value, Feedback):
        cells = _feedback(value)
    elif isinstance(value, Applied):
        cells = {
            "seq": value.seq,
            "app_id": value.app_id,
            "sent_ns": value.sent_ns,
            "applied_ns": value.applied_ns,
            **_action("asked", value.asked),
            **_action("applied", value.applied),
        }
    elif isinstance(value, Event):
        cells = {"kind": value.kind.value, "severity": value.severity.value, "app": value.app or "", "text": value.text}
        cells |= {"at_ns": value.at_ns, **{f"data.{name}": _cell(one) for name, one in value.data.items()}}
    elif isinstance(value, Parameter):
        cells = {"name": value.name, "value": str(_cell(value.value)), "unit": value.unit}
    elif isinstance(value, LogEntry):
        cells = {"source": value.source, "name": value.name, "number": value.number, "text": value.text or ""}
        cells["at_ns"] = value.at_ns
        if value.values is not None:
            cells["values"] = _cell(value.values)
    elif isinstance(value, FrameRecord):
        header = value.header
        cells = {"seq": header.seq, "captured_ns": header.captured_ns, "published_ns": header.published_ns}
        cells |= {"received_ns": value.received_ns, "width": header.width, "height": header.height}
    elif isinstance(value, Drops):
        cells = {f"dropped.{name}": count for name, count in value.dropped.items()}
        cells |= {f"missed.{name}": count for name, count in value.missed.items()}
    elif isinstance(value, ResultRecord):
        cells = {"processor": value.processor, "worker": value.worker, "camera": value.camera, "seq": value.seq}
        cells |= {"captured_ns": value.captured_ns, "made_ns": value.made_ns, "took_ns": value.took_ns}
        parts = value.value.items() if isinstance(value.value, dict) else [("", value.value)]
        cells |= {f"value.{name}" if name else "value": _flat(one) for name, one in parts}
    else:
        cells = {"source": value.source, "camera": value.camera, "captured_ns": value.captured_ns}
        cells["shapes"] = len(value.shapes)
    return cells | {"received_unix_ns": item.entry.log_ns}


def _feedback(feedback: Feedback) -> dict[str, Cell]:
    cells: dict[str, Cell] = {}
    for name in feedback.__struct_fields__:
        value = getattr(feedback, name)
        if name in VECTORS:
            cells |= zip(VECTORS[name], value or (None, None, None), strict=True)
        elif name == "outcome":
            cells["fate"] = "" if value is None else value.fate
        elif name != "native":
            cells[name] = "" if value is None and name == "owner" else value
    for name, value in (feedback.native or {}).items():
        cells[f"native.{name}"] = _cell(value)
    return cells


def _action(prefix: str, action: AnyAction) -> dict[str, Cell]:
    numbers: dict[str, Cell] = {f"{prefix}_{name}": getattr(action, name, None) for name in ACTION_FIELDS}
    return {prefix: action.name, **numbers}


def _flat(value: Any) -> Cell:
    """Convert lists and dictionaries to JSON text."""
    cell: Cell = msgspec.json.encode(value).decode() if isinstance(value, list | dict) else value
    return cell


def _cell(value: Any) -> Cell:
    """Convert a tuple to text, with its numbers separated by spaces."""
    if isinstance(value, tuple | list):
        return " ".join(f"{number:.9g}" for number in value)
    cell: Cell = value
    return cell


# Files ----------------------------------------------------------------------------------------------------------


#: Channels exported as tables; a table of frames lists their times and sizes, not their images.
TABLES: Final = tuple(Channel)
_FORMULA: Final = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")  #: characters that start a formula
_NUMBER: Final = r"[-+]?(?:[0-9.]+(?:e[-+]?[0-9]+)?|inf|nan)"
_NUMBERS: Final = re.compile(rf"{_NUMBER}(?: {_NUMBER})*")


def export_csv(found: dict[str, Table], folder: Path) -> list[Path]:
    """Write ``CHANNEL.csv`` for each table: UTF-8, comma-separated, with a header line; unknown values are empty.

    Text that a spreadsheet would interpret as a formula gets a leading apostrophe, because an application or the author
    of the file may have chosen the text.
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
    """Write ``CHANNEL.parquet`` for each table; unknown values are null."""
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
    """Write a ``.npz`` file (the suffix replaces any other) with a compressed array ``CHANNEL/COLUMN`` per column."""
    arrays = {f"{name}/{column}": values for name, table in found.items() for column, values in table.columns.items()}
    path = path if path.suffix == ".npz" else path.with_suffix(".npz")
    with replacing(path) as part:
        np.savez_compressed(part, **arrays)  # type: ignore[arg-type]
    return [path]


def read(
    recording: Recording, drone: str, channels: Collection[Channel] | None, progress: Progress | None = None
) -> dict[str, Table]:
    """Read the tables to export. Raise ``FileFormatError`` if the recording has none of these channels."""
    found = tables(recording, drone, channels or TABLES, progress)
    if not found:
        raise FileFormatError(f"{recording.path} contains none of these channels for {drone}")
    return found


def _nulls(table: Table) -> dict[str, Any]:
    """Return columns with None in place of unknown values."""
    return {
        name: [cell or None for cell in values.tolist()] if values.dtype.kind == "U" else values
        for name, values in table.columns.items()
    }


def _text(cell: Any) -> str:
    if isinstance(cell, float):
        return "" if np.isnan(cell) else repr(cell)
    return _harmless(str(cell))


def _harmless(text: str) -> str:
    """Prefix an apostrophe to text that a spreadsheet would interpret as a formula; leave numbers unchanged."""
    return f"'{text}" if text.startswith(_FORMULA) and not _NUMBERS.fullmatch(text) else text


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} can't be created: {error.strerror}") from error

"""Tables of contents of log variables and parameters, log blocks, and parameters' values, both ways. Pure.

Requests are written for the driver and read by the emulated firmware, answers the other way round. Numbers of
variables, parameters and blocks are the vehicle's own. Only the second version of the requests is here, which all
firmware since protocol 4 understands.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from skyloop.errors import DecodeError
from skyloop.vehicles.crazyflie.wire.crtp import (
    CONTENTS,
    CONTROL,
    DATA,
    MAX_SENT_DATA,
    MISCELLANEOUS,
    READ,
    WRITE,
    CrtpPacket,
    CrtpPort,
)

# Types of values -----------------------------------------------------------------------------------------------------


class ValueType(IntEnum):
    """Type of a parameter or log variable; the numbers are those of parameters."""

    INT8 = 0x00
    INT16 = 0x01
    INT32 = 0x02
    INT64 = 0x03
    HALF = 0x05
    FLOAT = 0x06
    DOUBLE = 0x07
    UINT8 = 0x08
    UINT16 = 0x09
    UINT32 = 0x0A
    UINT64 = 0x0B

    @property
    def size(self) -> int:
        """Number of bytes."""
        return struct.calcsize(_FORMATS[self])

    @property
    def is_float(self) -> bool:
        return self in (ValueType.HALF, ValueType.FLOAT, ValueType.DOUBLE)

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and greatest value of an integer; infinite for floats."""
        if self.is_float:
            return -math.inf, math.inf
        bits = 8 * self.size
        return (0, 2**bits - 1) if self >= ValueType.UINT8 else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)

    def encode(self, value: float) -> bytes:
        """Return a value as bytes. Raises ``ValueError`` if it doesn't fit."""
        try:
            return struct.pack(_FORMATS[self], value if self.is_float else round(value))
        except (struct.error, OverflowError) as error:
            raise ValueError(f"{value} is no {self.name.lower()}: {error}") from None

    def decode(self, data: bytes) -> float:
        """Return the value of exactly :attr:`size` bytes; an ``int`` unless the type is a float's."""
        try:
            value: float = struct.unpack(_FORMATS[self], data)[0]
        except struct.error:
            raise DecodeError(f"a value of type {self.name.lower()} has {self.size} bytes, not {len(data)}") from None
        return value


_FORMATS: Final = {
    ValueType.INT8: "<b",
    ValueType.INT16: "<h",
    ValueType.INT32: "<i",
    ValueType.INT64: "<q",
    ValueType.HALF: "<e",
    ValueType.FLOAT: "<f",
    ValueType.DOUBLE: "<d",
    ValueType.UINT8: "<B",
    ValueType.UINT16: "<H",
    ValueType.UINT32: "<I",
    ValueType.UINT64: "<Q",
}
#: Log variables number their types differently.
_LOG_TYPES: Final = {
    1: ValueType.UINT8,
    2: ValueType.UINT16,
    3: ValueType.UINT32,
    4: ValueType.INT8,
    5: ValueType.INT16,
    6: ValueType.INT32,
    7: ValueType.FLOAT,
    8: ValueType.HALF,
}
_LOG_NUMBERS: Final = {type_: number for number, type_ in _LOG_TYPES.items()}

# Tables of contents --------------------------------------------------------------------------------------------------

_GET_ITEM, _GET_INFO = 2, 3
_TYPE, _EXTENDED, _READ_ONLY = 0x0F, 0x10, 0x40  # bits of a parameter's type byte


@dataclass(frozen=True, slots=True)
class Entry:
    """One log variable or parameter."""

    number: int
    group: str
    name: str
    type: ValueType
    read_only: bool = False  #: of a parameter
    extended: bool = False  #: of a parameter: whether it may be persistent

    @property
    def full_name(self) -> str:
        return f"{self.group}.{self.name}"


@dataclass(frozen=True, slots=True)
class ContentsInfo:
    """Size and fingerprint of a table; the last two only of the log's."""

    count: int
    crc: int
    max_blocks: int = 0
    max_variables: int = 0  #: in all blocks together


def ask_info(port: CrtpPort) -> CrtpPacket:
    """Return the request for the :class:`ContentsInfo` of LOG or PARAMETERS."""
    return CrtpPacket(port, CONTENTS, bytes((_GET_INFO,)))


def ask_item(port: CrtpPort, number: int) -> CrtpPacket:
    return CrtpPacket(port, CONTENTS, struct.pack("<BH", _GET_ITEM, number))


def decode_question(packet: CrtpPacket) -> int | None:
    """Return the number of the entry that a request on CONTENTS asks for; None if it asks for the info."""
    if packet.data[:1] == bytes((_GET_INFO,)):
        return None
    command, number = _unpack("<BH", packet.data)
    if command != _GET_ITEM:
        raise DecodeError(f"request {command} of a table of contents is not known")
    return number


def answer_info(port: CrtpPort, info: ContentsInfo) -> CrtpPacket:
    data = struct.pack("<BHI", _GET_INFO, info.count, info.crc)
    if port is CrtpPort.LOG:
        data += bytes((info.max_blocks, info.max_variables))
    return CrtpPacket(port, CONTENTS, data)


def answer_item(port: CrtpPort, entry: Entry | None) -> CrtpPacket:
    """Return the answer to :func:`ask_item`; None: there is no such entry."""
    if entry is None:
        return CrtpPacket(port, CONTENTS, bytes((_GET_ITEM,)))
    if port is CrtpPort.LOG:
        type_ = _LOG_NUMBERS[entry.type]
    else:
        type_ = entry.type | _EXTENDED * entry.extended | _READ_ONLY * entry.read_only
    head = struct.pack("<BHB", _GET_ITEM, entry.number, type_)
    return CrtpPacket(port, CONTENTS, head + _text(entry.group) + _text(entry.name))


def decode_contents(packet: CrtpPacket) -> ContentsInfo | Entry | None:
    """Read an answer on CONTENTS; None: there is no such entry."""
    data = packet.data
    if data == bytes((_GET_ITEM,)):
        return None
    if data[:1] == bytes((_GET_INFO,)):
        form = "<xHIBB" if packet.port == CrtpPort.LOG else "<xHI"
        return ContentsInfo(*_unpack(form, data[: struct.calcsize(form)]))
    command, number, type_ = _unpack("<BHB", data[:4])
    group, name, *_ = [*data[4:].split(b"\0"), b"", b""]
    if command != _GET_ITEM or not group or not name:
        raise DecodeError("an answer from a table of contents is damaged")
    texts = group.decode("ascii", "replace"), name.decode("ascii", "replace")
    try:
        if packet.port == CrtpPort.LOG:
            return Entry(number, *texts, _LOG_TYPES[type_ & _TYPE])
        kind = ValueType(type_ & _TYPE)
    except (KeyError, ValueError):
        raise DecodeError(f"{texts[0]}.{texts[1]} has the unknown type {type_:#x}") from None
    return Entry(number, *texts, kind, bool(type_ & _READ_ONLY), bool(type_ & _EXTENDED))


# Log blocks ----------------------------------------------------------------------------------------------------------

MAX_LOGGED: Final = 26  #: bytes of variables in one block
_PER_PACKET: Final = (MAX_SENT_DATA - 2) // 3  # variables in one request
PERIOD_UNIT_MS: Final = 10  #: periods are multiples of it


class LogCommand(IntEnum):
    """Requests on LOG's channel CONTROL."""

    DELETE = 2
    START = 3
    STOP = 4
    RESET = 5
    CREATE = 6
    APPEND = 7


@dataclass(frozen=True, slots=True)
class LogRequest:
    """A request about a log block: its variables' numbers and types, or its period."""

    command: LogCommand
    block: int = 0
    variables: tuple[tuple[int, ValueType], ...] = ()  #: for CREATE and APPEND
    period_ms: int = 0  #: for START; a multiple of :data:`PERIOD_UNIT_MS`, up to 2550

    def encode(self) -> CrtpPacket:
        data = bytes((self.command,))
        if self.command is not LogCommand.RESET:
            data += bytes((self.block,))
        if self.command is LogCommand.START:
            data += bytes((max(1, min(255, round(self.period_ms / PERIOD_UNIT_MS))),))
        for number, type_ in self.variables:
            data += struct.pack("<BH", _LOG_NUMBERS[type_], number)
        return CrtpPacket(CrtpPort.LOG, CONTROL, data)

    @classmethod
    def decode(cls, packet: CrtpPacket) -> LogRequest:
        """Read a request. Raises :class:`DecodeError`."""
        data = packet.data
        try:
            command = LogCommand(data[0])
            if command is LogCommand.RESET:
                return cls(command)
            block = data[1]
            if command is LogCommand.START:
                return cls(command, block, period_ms=data[2] * PERIOD_UNIT_MS)
            rows = struct.iter_unpack("<BH", data[2:]) if command in (LogCommand.CREATE, LogCommand.APPEND) else ()
            variables = tuple((number, _LOG_TYPES[type_ & _TYPE]) for type_, number in rows)
        except (IndexError, KeyError, ValueError, struct.error):
            raise DecodeError("a request about a log block is damaged") from None
        return cls(command, block, variables)


def create_block(block: int, entries: Sequence[Entry]) -> list[LogRequest]:
    """Return the requests that define a block of at most :data:`MAX_LOGGED` bytes."""
    variables = tuple((entry.number, entry.type) for entry in entries)
    first = LogRequest(LogCommand.CREATE, block, variables[:_PER_PACKET])
    rest = range(_PER_PACKET, len(variables), _PER_PACKET)
    return [first, *(LogRequest(LogCommand.APPEND, block, variables[at : at + _PER_PACKET]) for at in rest)]


def blocks_of(entries: Iterable[Entry]) -> list[list[Entry]]:
    """Distribute variables over blocks, in order, each as full as possible."""
    blocks: list[list[Entry]] = []
    left = 0
    for entry in entries:
        if entry.type.size > left:
            blocks.append([])
            left = MAX_LOGGED
        blocks[-1].append(entry)
        left -= entry.type.size
    return blocks


class CrtpError(IntEnum):
    """Results in answers: errno's numbers, as the firmware uses them."""

    NONE = 0
    NO_ENTRY = 2
    TOO_BIG = 7
    NOT_EXECUTABLE = 8
    NO_MEMORY = 12
    NO_ACCESS = 13
    EXISTS = 17
    INVALID = 22


def answer_log(request: LogRequest, error: int = CrtpError.NONE) -> CrtpPacket:
    return CrtpPacket(CrtpPort.LOG, CONTROL, bytes((request.command, request.block, error)))


def decode_log_answer(packet: CrtpPacket) -> tuple[LogCommand, int, int]:
    """Return command, block and error; 0: it was done."""
    command, block, error = _unpack("<BBB", packet.data[:3])
    try:
        return LogCommand(command), block, error
    except ValueError:
        raise DecodeError(f"an answer to the unknown log request {command}") from None


def log_data(block: int, time_ms: int, values: bytes) -> CrtpPacket:
    stamp = (time_ms & 0xFFFFFF).to_bytes(3, "little")
    return CrtpPacket(CrtpPort.LOG, DATA, bytes((block,)) + stamp + values)


def decode_log_data(packet: CrtpPacket) -> tuple[int, int, bytes]:
    """Return block, time stamp [ms, 24 bits] and values."""
    if len(packet.data) < 4:
        raise DecodeError("log data is too short")
    return packet.data[0], int.from_bytes(packet.data[1:4], "little"), packet.data[4:]


def decode_values(entries: Sequence[Entry], data: bytes) -> dict[str, float]:
    """Return a block's values by full name. Raises :class:`DecodeError` if there are too few bytes."""
    values, at = {}, 0
    for entry in entries:
        values[entry.full_name] = entry.type.decode(data[at : at + entry.type.size])
        at += entry.type.size
    return values


# Parameters ----------------------------------------------------------------------------------------------------------


class MiscCommand(IntEnum):
    """Requests on PARAMETERS' channel MISCELLANEOUS; the last two since protocol 11."""

    SET_BY_NAME = 0
    VALUE_UPDATED = 1  #: sent by the vehicle itself
    GET_EXTENDED_TYPE = 2
    STORE = 3
    GET_STATE = 4
    CLEAR = 5
    GET_DEFAULT = 6
    GET_EXTENDED_TYPE_2 = 7
    GET_DEFAULT_2 = 8


PERSISTENT: Final = 0x01  #: bit of an extended type


def read_parameter(number: int) -> CrtpPacket:
    return CrtpPacket(CrtpPort.PARAMETERS, READ, struct.pack("<H", number))


def write_parameter(number: int, value: bytes) -> CrtpPacket:
    """Return the request to write a value, which is also its answer."""
    return CrtpPacket(CrtpPort.PARAMETERS, WRITE, struct.pack("<H", number) + value)


def answer_read(number: int, value: bytes, error: int = CrtpError.NONE) -> CrtpPacket:
    return CrtpPacket(CrtpPort.PARAMETERS, READ, struct.pack("<HB", number, error) + value)


def decode_parameter(packet: CrtpPacket) -> tuple[int, bytes]:
    """Return number and bytes of a request on READ or WRITE, or of an answer on WRITE."""
    return _unpack("<H", packet.data[:2])[0], packet.data[2:]


def decode_read_answer(packet: CrtpPacket) -> tuple[int, int, bytes]:
    """Return number, error and value of an answer on READ."""
    number, error = _unpack("<HB", packet.data[:3])
    return number, error, packet.data[3:]


@dataclass(frozen=True, slots=True)
class MiscMessage:
    """A request about a parameter by its number, or the answer, whose data starts with the result or value."""

    command: MiscCommand
    number: int
    data: bytes = b""

    def encode(self) -> CrtpPacket:
        return CrtpPacket(CrtpPort.PARAMETERS, MISCELLANEOUS, struct.pack("<BH", self.command, self.number) + self.data)

    @classmethod
    def decode(cls, packet: CrtpPacket) -> MiscMessage:
        """Read any message except those of SET_BY_NAME. Raises :class:`DecodeError`."""
        command, number = _unpack("<BH", packet.data[:3])
        try:
            return cls(MiscCommand(command), number, packet.data[3:])
        except ValueError:
            raise DecodeError(f"request {command} about a parameter is not known") from None


def set_by_name(group: str, name: str, type_: ValueType, value: float) -> CrtpPacket:
    """Return the request to set a parameter without its number."""
    data = bytes((MiscCommand.SET_BY_NAME,)) + _text(group) + _text(name) + bytes((type_,)) + type_.encode(value)
    return CrtpPacket(CrtpPort.PARAMETERS, MISCELLANEOUS, data)


def decode_set_by_name(packet: CrtpPacket) -> tuple[str, str, int, bytes]:
    """Return group, name, type byte and value. Raises :class:`DecodeError`."""
    parts = packet.data[1:].split(b"\0", 2)
    if len(parts) < 3 or not parts[2]:
        raise DecodeError("a request to set a parameter by name is damaged")
    return parts[0].decode("ascii", "replace"), parts[1].decode("ascii", "replace"), parts[2][0], parts[2][1:]


def answer_set_by_name(group: str, name: str, error: int) -> CrtpPacket:
    data = bytes((MiscCommand.SET_BY_NAME,)) + _text(group) + _text(name) + bytes((error,))
    return CrtpPacket(CrtpPort.PARAMETERS, MISCELLANEOUS, data)


def _text(text: str) -> bytes:
    return text.encode("ascii", "replace") + b"\0"


def _unpack(form: str, data: bytes) -> tuple[int, ...]:
    try:
        return struct.unpack(form, data)
    except struct.error:
        raise DecodeError(f"{len(data)} bytes are too few or too many for {form!r}") from None

"""Answers to requests for missions, files and logs, of which the emulations have none. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m

MISSION_ACCEPTED: Final = 0
MISSION_ERROR: Final = 1
MISSION_UNSUPPORTED: Final = 3
MISSION_INVALID_X: Final = 10
MISSION_INVALID_Y: Final = 11
MISSION_INVALID_Z: Final = 12

# Of the files' protocol: what comes, and what is answered.
_END_SESSION: Final = 1
_END_SESSIONS: Final = 2
_NAMING: Final = (3, 4, 6, 8, 9, 10, 11, 12, 13, 14)  #: list, open, create, remove, ...: requests that name a file
_IN_SESSION: Final = (5, 7, 15)  #: read, write, read in a burst; nothing was opened
_ACK: Final = 128
_NAK: Final = 129
_INVALID_SESSION: Final = 4
_UNKNOWN_COMMAND: Final = 7
_FILE_NOT_FOUND: Final = 10
_SEQUENCE: Final = slice(0, 2)
_SESSION: Final = 2
_OPCODE: Final = 3
_SIZE: Final = 4
_ASKED: Final = 5
_DATA: Final = 12
_PAYLOAD: Final = 251


def mission_ack(message: Message, result: int) -> Message:
    """Return a ``MISSION_ACK`` to the sender of a message."""
    kind = getattr(message, "mission_type", 0)
    return m.MAVLink_mission_ack_message(message.get_srcSystem(), message.get_srcComponent(), result, kind)


def answers(message: Message) -> Iterable[Message]:
    """Yield the answers to a message; none for one that is no such request."""
    kind = message.get_type()
    sender = message.get_srcSystem(), message.get_srcComponent()
    if kind == "MISSION_REQUEST_LIST":
        yield m.MAVLink_mission_count_message(*sender, 0, message.mission_type)
    elif kind == "MISSION_COUNT":  # an upload; an empty one clears what is not there
        yield mission_ack(message, MISSION_UNSUPPORTED if message.count else MISSION_ACCEPTED)
    elif kind == "MISSION_CLEAR_ALL":
        yield mission_ack(message, MISSION_ACCEPTED)
    elif kind in ("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ITEM", "MISSION_ITEM_INT"):
        yield mission_ack(message, MISSION_ERROR)  # there is none; nobody asked for it
    elif kind == "LOG_REQUEST_LIST":
        yield m.MAVLink_log_entry_message(0, 0, 0, 0, 0)
    elif kind == "FILE_TRANSFER_PROTOCOL":
        yield _of_files(message)


def _of_files(message: Message) -> Message:
    asked = bytes(message.payload)
    opcode = asked[_OPCODE]
    answer = bytearray(_PAYLOAD)
    answer[_SEQUENCE] = (int.from_bytes(asked[_SEQUENCE], "little") + 1 & 0xFFFF).to_bytes(2, "little")
    answer[_SESSION] = asked[_SESSION]
    answer[_ASKED] = opcode
    if opcode in (_END_SESSION, _END_SESSIONS):
        answer[_OPCODE] = _ACK
    else:
        answer[_OPCODE], answer[_SIZE] = _NAK, 1
        answer[_DATA] = _error(opcode)
    return m.MAVLink_file_transfer_protocol_message(0, message.get_srcSystem(), message.get_srcComponent(), answer)


def _error(opcode: int) -> int:
    if opcode in _NAMING:
        return _FILE_NOT_FOUND
    return _INVALID_SESSION if opcode in _IN_SESSION else _UNKNOWN_COMMAND

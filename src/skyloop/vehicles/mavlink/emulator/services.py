"""The emulated autopilots' parameters, and replies to requests for missions, files and logs. Pure.

An ArduCopter stores a mission but does not fly it.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable, Mapping
from enum import IntEnum
from typing import Final

from skyloop.vehicles.mavlink.emulator.links import Port
from skyloop.vehicles.mavlink.wire.codec import REAL32, Message, bounds, from_field, is_integer, to_field
from skyloop.vehicles.mavlink.wire.codec import dialect as m

MOST_ITEMS: Final = 500  #: maximum number of items in a mission
_SCALE: Final = 1e7  #: scale of latitude and longitude in MISSION_ITEM_INT
_HOME_FRAME: Final = 0  #: MAV_FRAME_GLOBAL, with altitudes above mean sea level

# The file protocol's requests, replies and errors (MAVLink FTP).
_END_SESSION: Final = 1
_END_SESSIONS: Final = 2
_NAMING: Final = (3, 4, 6, 8, 9, 10, 11, 12, 13, 14)  #: requests with a file name: list, open, create, remove, ...
_IN_SESSION: Final = (5, 7, 15)  #: requests on an open file (no file is ever open here): read, write, read in a burst
_LIST: Final = 3
_ACK: Final = 128
_NAK: Final = 129
_INVALID_SESSION: Final = 4
_END_OF_FILE: Final = 6
_UNKNOWN_COMMAND: Final = 7
_FILE_NOT_FOUND: Final = 10
# Offsets of a payload's fields, and its size [bytes].
_SEQUENCE: Final = slice(0, 2)
_SESSION: Final = 2
_OPCODE: Final = 3
_SIZE: Final = 4
_ASKED: Final = 5
_DATA: Final = 12
_PAYLOAD: Final = 251


class MissionResult(IntEnum):
    """Values of ``MAV_MISSION_RESULT``."""

    ACCEPTED = 0
    ERROR = 1
    UNSUPPORTED = 3
    NO_SPACE = 4
    INVALID_X = 10
    INVALID_Y = 11
    INVALID_Z = 12
    INVALID_SEQUENCE = 13


def mission_ack(message: Message, result: int) -> Message:
    """Return a ``MISSION_ACK`` addressed to a message's sender."""
    kind = getattr(message, "mission_type", 0)
    return m.MAVLink_mission_ack_message(message.get_srcSystem(), message.get_srcComponent(), result, kind)


class Mission:
    """A mission stored as in ArduCopter: item 0 is always home, even after an upload."""

    def __init__(self) -> None:
        self.current = 0
        self._items: list[Message] = []  # items from number 1 onwards
        self._coming: list[Message] = []
        self._wanted = 0  # number of the item awaited in an upload; 0 if there is no upload

    def answers(self, message: Message, home: tuple[int, int, int]) -> list[Message] | None:
        """Return the replies to a message; None if the message is not about a mission."""
        kind = message.get_type()
        if getattr(message, "mission_type", 0) != 0:
            return None
        sender = message.get_srcSystem(), message.get_srcComponent()
        if kind == "MISSION_REQUEST_LIST":
            return [m.MAVLink_mission_count_message(*sender, len(self._items) + 1, 0)]
        if kind in ("MISSION_REQUEST", "MISSION_REQUEST_INT"):
            if not 0 <= message.seq <= len(self._items):
                return [mission_ack(message, MissionResult.INVALID_SEQUENCE)]
            return [self._item(message.seq, sender, home, whole=kind == "MISSION_REQUEST_INT")]
        if kind == "MISSION_COUNT":
            self._coming, self._wanted = [], 0
            if message.count > MOST_ITEMS:
                return [mission_ack(message, MissionResult.NO_SPACE)]
            if not message.count:
                self._items = []
                return [mission_ack(message, MissionResult.ACCEPTED)]
            self._wanted = message.count
            return [m.MAVLink_mission_request_message(*sender, 0, 0)]
        if kind in ("MISSION_ITEM", "MISSION_ITEM_INT") and self._wanted:
            return self._take(message, sender)
        if kind == "MISSION_CLEAR_ALL":
            self._items, self._wanted, self.current = [], 0, 0
            return [mission_ack(message, MissionResult.ACCEPTED)]
        if kind == "MISSION_SET_CURRENT":
            if not 0 <= message.seq <= len(self._items):
                return []
            self.current = message.seq
            return [m.MAVLink_mission_current_message(self.current)]
        return None

    def _take(self, message: Message, sender: tuple[int, int]) -> list[Message]:
        if message.seq != len(self._coming):
            return [mission_ack(message, MissionResult.INVALID_SEQUENCE)]
        self._coming.append(message)
        if len(self._coming) < self._wanted:
            return [m.MAVLink_mission_request_message(*sender, len(self._coming), 0)]
        self._items, self._coming, self._wanted, self.current = self._coming[1:], [], 0, 0
        return [mission_ack(message, MissionResult.ACCEPTED)]

    def _item(self, number: int, sender: tuple[int, int], home: tuple[int, int, int], *, whole: bool) -> Message:
        if number == 0:
            latitude, longitude, altitude_m = home[0] / _SCALE, home[1] / _SCALE, home[2] / 1000.0
            first = _HOME_FRAME, m.MAV_CMD_NAV_WAYPOINT, 0, 1, 0.0, 0.0, 0.0, 0.0
        else:
            kept = self._items[number - 1]
            scale = _SCALE if kept.get_type() == "MISSION_ITEM_INT" else 1.0
            latitude, longitude, altitude_m = kept.x / scale, kept.y / scale, kept.z
            rest = kept.param1, kept.param2, kept.param3, kept.param4
            first = kept.frame, kept.command, int(number == self.current), kept.autocontinue, *rest
        if whole:
            place = round(latitude * _SCALE), round(longitude * _SCALE), altitude_m
            return m.MAVLink_mission_item_int_message(*sender, number, *first, *place, 0)
        return m.MAVLink_mission_item_message(*sender, number, *first, latitude, longitude, altitude_m, 0)


def answers(message: Message) -> Iterable[Message]:
    """Yield the replies to a message; none if the message is not a request handled here."""
    kind = message.get_type()
    sender = message.get_srcSystem(), message.get_srcComponent()
    if kind == "MISSION_REQUEST_LIST":
        yield m.MAVLink_mission_count_message(*sender, 0, message.mission_type)
    elif kind == "MISSION_COUNT":  # an upload; an empty upload clears nothing
        yield mission_ack(message, MissionResult.UNSUPPORTED if message.count else MissionResult.ACCEPTED)
    elif kind == "MISSION_CLEAR_ALL":
        yield mission_ack(message, MissionResult.ACCEPTED)
    elif kind in ("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ITEM", "MISSION_ITEM_INT"):
        yield mission_ack(message, MissionResult.ERROR)  # the item was not requested
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
        named = asked[_DATA : _DATA + min(asked[_SIZE], _PAYLOAD - _DATA)].rstrip(b"\0")
        answer[_DATA] = _END_OF_FILE if opcode == _LIST and named == b"/" else _error(opcode)  # the root is empty
    return m.MAVLink_file_transfer_protocol_message(0, message.get_srcSystem(), message.get_srcComponent(), answer)


def _error(opcode: int) -> int:
    if opcode in _NAMING:
        return _FILE_NOT_FOUND
    return _INVALID_SESSION if opcode in _IN_SESSION else _UNKNOWN_COMMAND


AT_ONCE: Final = 16  #: number of listed parameters sent with each report
# MAV_PARAM_TYPE.
INT8: Final = 2
INT16: Final = 4
INT32: Final = 6


def _all(kind: int, **values: float) -> dict[str, tuple[float, int]]:
    return {name: (value, kind) for name, value in values.items()}


#: Default value and MAV_PARAM_TYPE of each parameter in ArduCopter 4.7-dev.
ARDUCOPTER: Final = {
    **_all(INT16, ANGLE_MAX=3000, LAND_SPEED=50, MAV_GCS_SYSID=255, RTL_ALT_FINAL=0, RTL_CLIMB_MIN=0),
    **_all(INT32, ARMING_CHECK=1, FS_OPTIONS=16, GUID_OPTIONS=0, RTL_ALT=1500, RTL_LOIT_TIME=5000),
    **_all(REAL32, ATC_RATE_Y_MAX=0.0, BATT_CRT_VOLT=0.0, BATT_LOW_VOLT=10.5, FENCE_ALT_MAX=100.0, FS_EKF_THRESH=0.8),
    **_all(REAL32, FS_GCS_TIMEOUT=5.0, GUID_TIMEOUT=3.0, MOT_SPIN_ARM=0.1, MOT_SPIN_MIN=0.15, RTL_CONE_SLOPE=3.0),
    **_all(REAL32, WPNAV_SPEED=1000.0, WPNAV_SPEED_DN=150.0, WPNAV_SPEED_UP=250.0),
    **_all(INT8, BATT_FS_CRT_ACT=0, BATT_FS_LOW_ACT=0, DISARM_DELAY=10, EK3_SRC1_POSXY=3, FENCE_ACTION=1),
    **_all(INT8, FENCE_ENABLE=0, FS_EKF_ACTION=1, FS_GCS_ENABLE=0, FS_THR_ENABLE=1),
}
#: Default value and MAV_PARAM_TYPE of each parameter in PX4 1.17.
PX4: Final = {
    **_all(REAL32, COM_DISARM_LAND=2.0, COM_DISARM_PRFLT=10.0, COM_FAIL_ACT_T=5.0, COM_OF_LOSS_T=1.0),
    **_all(REAL32, COM_RC_LOSS_T=0.5, COM_RC_STICK_OV=30.0, GF_MAX_VER_DIST=0.0, MIS_TAKEOFF_ALT=2.5),
    **_all(REAL32, MPC_MAN_Y_MAX=150.0, MPC_THR_HOVER=0.5, MPC_TILTMAX_AIR=45.0, MPC_XY_VEL_MAX=12.0),
    **_all(REAL32, MPC_Z_VEL_MAX_DN=1.5, MPC_Z_VEL_MAX_UP=3.0, NAV_ACC_RAD=2.0, RTL_DESCEND_ALT=10.0),
    **_all(REAL32, RTL_LAND_DELAY=0.0, RTL_MIN_DIST=10.0, RTL_RETURN_ALT=30.0),
    **_all(INT32, COM_DL_LOSS_T=10, COM_LOW_BAT_ACT=0, COM_OBL_RC_ACT=0, COM_RCL_EXCEPT=0, COM_RC_OVERRIDE=1),
    **_all(INT32, EKF2_EV_CTRL=15, GF_ACTION=2, NAV_DLL_ACT=0, NAV_RCL_ACT=2, RTL_CONE_ANG=45, SYS_AUTOSTART=10040),
}


class ParameterTable:
    """The parameters' values, and the lists being sent."""

    def __init__(self, standard: Mapping[str, tuple[float, int]], *, bytewise: bool) -> None:
        self._kinds = {name: kind for name, (_, kind) in standard.items()}
        self._values = {name: value for name, (value, _) in standard.items()}
        self._names = sorted(standard)
        self._bytewise = bytewise
        self._lists: dict[Port, deque[int]] = {}

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __setitem__(self, name: str, value: float) -> None:
        if name not in self._values:
            raise KeyError(name)
        self._values[name] = value

    def on_message(self, port: Port, message: Message) -> Iterable[Message]:
        """Handle a parameter message; yield the immediate replies."""
        kind = message.get_type()
        if kind == "PARAM_REQUEST_LIST":
            self._lists[port] = deque(range(len(self._names)))
        elif kind == "PARAM_REQUEST_READ":
            index = message.param_index
            name = self._names[index] if 0 <= index < len(self._names) else message.param_id
            if index < len(self._names) and name in self._values:
                yield self._value(name)
        elif kind == "PARAM_SET" and message.param_id in self._values:
            self._write(message.param_id, message.param_value)
            yield self._value(message.param_id)

    def pending(self, port: Port) -> list[Message]:
        """Return the part of a list to send now."""
        waiting = self._lists.get(port)
        if not waiting:
            return []
        return [self._value(self._names[waiting.popleft()]) for _ in range(min(AT_ONCE, len(waiting)))]

    def _write(self, name: str, field: float) -> None:
        kind = self._kinds[name]
        value = from_field(field, kind, bytewise=self._bytewise)
        if is_integer(kind):
            low, high = bounds(kind)
            value = max(low, min(high, value))
        else:
            value = struct.unpack("<f", struct.pack("<f", value))[0]
        self._values[name] = value

    def _value(self, name: str) -> Message:
        kind = self._kinds[name]
        field = to_field(self._values[name], kind, bytewise=self._bytewise)
        return m.MAVLink_param_value_message(name.encode(), field, kind, len(self._names), self._names.index(name))

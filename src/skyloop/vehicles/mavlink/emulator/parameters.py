"""The emulated autopilots' parameters, a small part of what the real ones have, and their protocol. Pure."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Final

from skyloop.vehicles.mavlink.emulator.links import Port
from skyloop.vehicles.mavlink.wire.codec import Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m
from skyloop.vehicles.mavlink.wire.parameter_values import REAL32, bounds, from_field, is_integer, to_field

AT_ONCE: Final = 16  #: parameters of a list that go out with each report
INT8: Final = 2
INT16: Final = 4
INT32: Final = 6

#: Name: value and MAV_PARAM_TYPE. As the defaults of ArduCopter 4.7-dev.
ARDUCOPTER: Final[dict[str, tuple[float, int]]] = {
    "ANGLE_MAX": (3000, INT16),
    "ARMING_CHECK": (1, INT32),
    "ATC_RATE_Y_MAX": (0.0, REAL32),
    "BATT_CRT_VOLT": (0.0, REAL32),
    "BATT_FS_CRT_ACT": (0, INT8),
    "BATT_FS_LOW_ACT": (0, INT8),
    "BATT_LOW_VOLT": (10.5, REAL32),
    "DISARM_DELAY": (10, INT8),
    "EK3_SRC1_POSXY": (3, INT8),
    "FENCE_ACTION": (1, INT8),
    "FENCE_ALT_MAX": (100.0, REAL32),
    "FENCE_ENABLE": (0, INT8),
    "FS_EKF_ACTION": (1, INT8),
    "FS_EKF_THRESH": (0.8, REAL32),
    "FS_GCS_ENABLE": (0, INT8),
    "FS_GCS_TIMEOUT": (5.0, REAL32),
    "FS_OPTIONS": (16, INT32),
    "FS_THR_ENABLE": (1, INT8),
    "GUID_OPTIONS": (0, INT32),
    "GUID_TIMEOUT": (3.0, REAL32),
    "LAND_SPEED": (50, INT16),
    "MAV_GCS_SYSID": (255, INT16),
    "MOT_SPIN_ARM": (0.1, REAL32),
    "MOT_SPIN_MIN": (0.15, REAL32),
    "RTL_ALT": (1500, INT32),
    "RTL_ALT_FINAL": (0, INT16),
    "RTL_CLIMB_MIN": (0, INT16),
    "RTL_CONE_SLOPE": (3.0, REAL32),
    "RTL_LOIT_TIME": (5000, INT32),
    "WPNAV_SPEED": (1000.0, REAL32),
    "WPNAV_SPEED_DN": (150.0, REAL32),
    "WPNAV_SPEED_UP": (250.0, REAL32),
}
#: As the defaults of PX4 1.17.
PX4: Final[dict[str, tuple[float, int]]] = {
    "COM_DISARM_LAND": (2.0, REAL32),
    "COM_DISARM_PRFLT": (10.0, REAL32),
    "COM_DL_LOSS_T": (10, INT32),
    "COM_FAIL_ACT_T": (5.0, REAL32),
    "COM_LOW_BAT_ACT": (0, INT32),
    "COM_OBL_RC_ACT": (0, INT32),
    "COM_OF_LOSS_T": (1.0, REAL32),
    "COM_RCL_EXCEPT": (0, INT32),
    "COM_RC_LOSS_T": (0.5, REAL32),
    "COM_RC_OVERRIDE": (1, INT32),
    "COM_RC_STICK_OV": (30.0, REAL32),
    "EKF2_EV_CTRL": (15, INT32),
    "GF_ACTION": (2, INT32),
    "GF_MAX_VER_DIST": (0.0, REAL32),
    "MIS_TAKEOFF_ALT": (2.5, REAL32),
    "MPC_MAN_Y_MAX": (150.0, REAL32),
    "MPC_THR_HOVER": (0.5, REAL32),
    "MPC_TILTMAX_AIR": (45.0, REAL32),
    "MPC_XY_VEL_MAX": (12.0, REAL32),
    "MPC_Z_VEL_MAX_DN": (1.5, REAL32),
    "MPC_Z_VEL_MAX_UP": (3.0, REAL32),
    "NAV_ACC_RAD": (2.0, REAL32),
    "NAV_DLL_ACT": (0, INT32),
    "NAV_RCL_ACT": (2, INT32),
    "RTL_CONE_ANG": (45, INT32),
    "RTL_DESCEND_ALT": (10.0, REAL32),
    "RTL_LAND_DELAY": (0.0, REAL32),
    "RTL_MIN_DIST": (10.0, REAL32),
    "RTL_RETURN_ALT": (30.0, REAL32),
    "SYS_AUTOSTART": (10040, INT32),
}


class ParameterTable:
    """The values, and the lists that are being sent.

    Args:
        standard: Value and ``MAV_PARAM_TYPE`` by name.
        bytewise: How integers are encoded.
    """

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
        """Handle a message of the parameters' protocol; yield the answers that are sent at once."""
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
        """Return the part of a list that is due now."""
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

"""Where something outside of a vehicle, such as motion capture, saw it: for vehicles that fly by that."""

from __future__ import annotations

import msgspec

from skyloop.messages.numbers import TimeNs


class VehiclePose(msgspec.Struct, frozen=True, array_like=True):
    """A pose for the vehicle itself, from a pilot's application. World axes x east, y north, z up."""

    captured_ns: TimeNs  #: when it was so, on the proxy's clock
    position: tuple[float, float, float]  #: of the body's origin [m]
    quaternion: tuple[float, float, float, float]  #: x, y, z, w, from body axes (forward, left, up) to world axes
    position_std_m: float | None = None  #: standard deviation, if it is known
    attitude_std_rad: float | None = None  #: standard deviation, if it is known

"""Set-points in SI as shares of the drone's own limits, with its signs."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages import Attitude
from skyloop.vehicles.ardrone.setpoints import HEADING_ACCURACY, ArdroneStick, StickLimits, limits_of, motion, stick_of
from skyloop.vehicles.ardrone.wire.at import Pcmd, format_command

LIMITS = StickLimits(tilt_rad=0.2, climb_m_s=0.7, yaw_rate_rad_s=1.75)
ANGLES = st.floats(-10.0, 10.0)


@pytest.mark.parametrize(
    ("asked", "stick"),
    [
        (Attitude(), ArdroneStick(0.0, 0.0, 0.0, 0.0)),
        (Attitude(roll=0.1), ArdroneStick(0.5, 0.0, 0.0, 0.0)),  # to the right
        (Attitude(pitch=0.1), ArdroneStick(0.0, -0.5, 0.0, 0.0)),  # nose down: forward
        (Attitude(climb=0.35), ArdroneStick(0.0, 0.0, 0.5, 0.0)),
        (Attitude(yaw_rate=0.875), ArdroneStick(0.0, 0.0, 0.0, -0.5)),  # counter-clockwise
        (Attitude(-0.2, -0.2, -0.7, -1.75), ArdroneStick(-1.0, 1.0, -1.0, 1.0)),
        (Attitude(-9.0, 9.0, 9.0, 9.0), ArdroneStick(-1.0, -1.0, 1.0, -1.0)),
        (Attitude(*[math.nan] * 4), ArdroneStick(0.0, 0.0, 0.0, 0.0)),  # and not full ones
    ],
)
def test_signs_and_scale(asked: Attitude, stick: ArdroneStick) -> None:
    assert stick_of(asked, LIMITS)[0] == stick


@given(ANGLES, ANGLES, ANGLES, ANGLES)
def test_the_applied_action_matches_the_stick(roll: float, pitch: float, climb: float, yaw_rate: float) -> None:
    asked = Attitude(roll, pitch, climb, yaw_rate)
    stick, applied = stick_of(asked, LIMITS)
    assert applied.roll == pytest.approx(stick.roll * LIMITS.tilt_rad)
    assert applied.pitch == pytest.approx(-stick.pitch * LIMITS.tilt_rad)
    assert applied.climb == pytest.approx(stick.climb * LIMITS.climb_m_s)
    assert applied.yaw_rate == pytest.approx(-stick.yaw * LIMITS.yaw_rate_rad_s)
    for name, limit in (("roll", 0.2), ("pitch", 0.2), ("climb", 0.7), ("yaw_rate", 1.75)):
        wanted, got = getattr(asked, name), getattr(applied, name)
        assert got == wanted if abs(wanted) <= limit else abs(got) == limit and got * wanted > 0


@pytest.mark.parametrize("stick", [None, ArdroneStick(0.0, 0.0, 0.0, 0.0), ArdroneStick(0.5, -0.5, 1.0, -1.0)])
def test_a_motion_can_be_sent(stick: ArdroneStick | None) -> None:
    name, arguments = motion(stick)
    assert (name, arguments[0]) == ("PCMD", int(Pcmd.HOVER if stick is None else Pcmd.PROGRESSIVE))
    line = format_command(name, 1, *arguments)
    assert b"-2147483648" not in line, "no negative zero"


def test_motion_along_a_heading() -> None:
    name, arguments = motion(ArdroneStick(0.5, -0.5, 0.0, 0.0), math.pi / 2)  # ours is counter-clockwise
    assert name == "PCMD_MAG"
    assert arguments == (int(Pcmd.PROGRESSIVE | Pcmd.ABSOLUTE), 0.5, -0.5, 0.0, 0.0, -0.5, HEADING_ACCURACY)


def test_limits_are_read_and_never_assumed() -> None:
    told = {
        "control:euler_angle_max": "2.094395e-01",
        "control:control_vz_max": "7.000000e+02",
        "control:control_yaw": "1.745329e+00",
    }
    assert limits_of(told) == StickLimits(0.2094395, 0.7, 1.745329)
    for key in told:
        assert limits_of({name: text for name, text in told.items() if name != key}) is None
        assert limits_of({**told, key: "0.0"}) is None
        assert limits_of({**told, key: "nan"}) is None

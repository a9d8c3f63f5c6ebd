"""MSP payloads: replies of Betaflight 4.6.0, both directions, and hostile bytes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.vehicles.msp.wire import firmwares
from skyloop.vehicles.msp.wire import messages as msp
from skyloop.vehicles.msp.wire.firmwares import explained, flag_names
from skyloop.vehicles.msp.wire.messages import MspStatus, Sensor

#: Answers of Betaflight 4.6.0 SITL, at rest and unconfigured.
STATUS_EX = bytes.fromhex("7d0000002300000000000000000400001d0403000000000004")
RX_CONFIG = bytes.fromhex("006c07dc051a0400750343080000e20400000000000000000000000000001e0100000000000000")
BOARD = bytes.fromhex("5349544c00000000045349544c") + bytes(44)
FAILSAFE = bytes.fromhex("0f3ce80300640001")
RC_TUNING = bytes.fromhex("07004343430032000000000707000064ce07ce07ce070332")
PID_ADVANCED = bytes(17) + bytes.fromhex("3c000000500000000000010100050078007d00780000282e00251400c80f64")


def test_status() -> None:
    status = MspStatus.of_betaflight(STATUS_EX)
    assert status.has(Sensor.ACCELEROMETER)
    assert status.has(Sensor.BAROMETER)
    assert not status.has(Sensor.GPS)
    assert (status.count, status.cycle_us, status.modes) == (29, 125, 0)
    assert status.flags is not None
    assert flag_names("BTFL", status.flags, status.count) == ["RXLOSS", "ANGLE", "BOOTGRACE"]
    assert MspStatus.of_betaflight(STATUS_EX[:15]).flags is None, "an old version does not report them"


@given(st.integers(0, 2**60 - 1), st.integers(0, 2**29 - 1), st.integers(0, 127))
def test_status_both_ways(modes: int, flags: int, sensors: int) -> None:
    status = MspStatus(sensors, modes, flags, 29, 312, 20)
    assert MspStatus.of_betaflight(status.betaflight()) == status


def test_status_of_inav() -> None:
    payload = bytes.fromhex("f4010000 6300 0500 10 04000c00 0300000000000000 00".replace(" ", ""))
    status = MspStatus.of_inav(payload)
    assert (status.sensors, status.load, status.modes) == (0x63, 5, 3)
    assert status.flags == 0x000C0004
    assert flag_names("INAV", status.flags, 32) == ["RC_LINK", "THROTTLE"]


def test_flags_have_names() -> None:
    assert flag_names("BTFL", 1 << 25, 26) == ["ARM_SWITCH"], "the last one of Betaflight 4.5"
    assert flag_names("BTFL", 1 << 25, 29) == ["FLIP_SWITCH"]
    assert flag_names("BTFL", 1 << 31, 0) == ["flag 31"]
    assert explained(["THROTTLE", "flag 31"]) == "THROTTLE (the throttle is not low); flag 31"


def test_settings_of_a_real_one() -> None:
    assert msp.board(BOARD) == "SITL"
    assert msp.board(b"SITL") == "SITL"
    rx = msp.RxConfig.decode(RX_CONFIG)
    assert (rx.low_us, rx.middle_us, rx.high_us, rx.least_us, rx.most_us) == (1050, 1500, 1900, 885, 2115)
    failsafe = msp.FailsafeConfig.decode(FAILSAFE)
    assert failsafe == msp.FailsafeConfig(1.5, 60.0, 1000, 10.0, 1)
    assert failsafe.encode() == FAILSAFE
    assert msp.rx_map(bytes((0, 1, 3, 2, 4, 5, 6, 7))) == msp.USUAL_MAP
    with pytest.raises(DecodeError, match="does not contain the sticks"):
        msp.rx_map(bytes((0, 1, 3, 3)))
    assert msp.angle_limit_deg(PID_ADVANCED) == 60
    assert msp.box_names(b"ARM;ANGLE;AIR MODE;") == ["ARM", "ANGLE", "AIR MODE"]


def test_mode_ranges() -> None:
    ranges = [msp.ModeRange(0, 0, 1700, 2100), msp.ModeRange(1, 1, 900, 2100)]
    assert msp.mode_ranges(msp.pack_mode_ranges(ranges)) == ranges


def test_states_both_ways() -> None:
    gps = msp.Gps(True, 14, 47.3977419, -8.5455938, 488.0, 1.23, 359.9)
    assert msp.Gps.decode(gps.encode()) == gps
    attitude = msp.MspAttitude(-12.3, 4.5, 271.0)
    assert msp.MspAttitude.decode(attitude.encode()) == attitude
    altitude = msp.Altitude(-1.25, 0.4)
    assert msp.Altitude.decode(altitude.encode()) == altitude
    imu = msp.Imu((1, -2, 512), (-200, 3, 0), (7, 8, 9))
    assert msp.Imu.decode(imu.encode()) == imu
    battery = msp.Battery(15.87, 12.5, 4)
    assert msp.Battery.of_state(battery.state()) == battery
    assert msp.Battery.of_analog(battery.analog()).voltage_v == 15.87
    assert msp.Battery.of_analog(battery.analog()[:7]).voltage_v == 15.9, "an old version reports tenths"
    assert msp.channels(msp.pack_channels([1000, 2000])) == [1000, 2000]
    assert msp.rx_fail(msp.pack_rx_fail([(0, 1500), (2, 1300)])) == [(0, 1500), (2, 1300)]
    inav = msp.Battery.of_inav(bytes.fromhex("40 a006 6400 00000000 00000000 00000000 00000000 4b".replace(" ", "")))
    assert inav == msp.Battery(16.96, 1.0, 4, 0.75)


def test_several_replies_in_one() -> None:
    assert msp.multiple(b"\2ab\0\1c", (1, 2, 3)) == [(1, b"ab"), (2, b""), (3, b"c")]
    assert msp.multiple(b"\2ab\5c", (1, 2)) == [(1, b"ab")], "replies that did not fit are missing"


READERS: list[Callable[[bytes], object]] = [
    msp.api_version,
    msp.version,
    msp.board,
    MspStatus.of_betaflight,
    MspStatus.of_inav,
    msp.MspAttitude.decode,
    msp.Altitude.decode,
    msp.Battery.of_state,
    msp.Battery.of_inav,
    msp.Battery.of_analog,
    msp.CellVoltages.decode,
    msp.Gps.decode,
    msp.Imu.decode,
    msp.channels,
    msp.mode_ranges,
    msp.box_names,
    msp.FailsafeConfig.decode,
    msp.rx_fail,
    msp.RxConfig.decode,
    msp.rx_map,
    msp.features,
    msp.angle_limit_deg,
    firmwares.betaflight_rates,
]


@given(st.sampled_from(READERS), st.binary(max_size=80))
def test_hostile_payloads(read: Callable[[bytes], object], payload: bytes) -> None:
    with suppress(DecodeError):
        assert read(payload) is not None


# Curves --------------------------------------------------------------------------------------------------------------


def test_rates_of_a_real_one() -> None:
    rates = firmwares.betaflight_rates(RC_TUNING)
    assert rates.kind == "actual"
    assert rates.yaw == firmwares.AxisRates(7, 0, 67)
    curve = firmwares.rate_curve(rates.kind, rates.roll)
    assert curve(1.0) == pytest.approx(670.0)
    assert curve(0.5) == pytest.approx(185.0), "as plotted in Betaflight's rates tab"
    assert firmwares.betaflight_rates(firmwares.pack_betaflight_rates(rates)) == rates


kinds = st.sampled_from(["betaflight", "raceflight", "kiss", "actual", "quick", "unknown"])


@given(kinds, st.integers(1, 255), st.integers(0, 100), st.integers(0, 99), st.floats(-1.0, 1.0))
def test_a_stick_is_found_for_every_rate(kind: str, centre: int, expo: int, most: int, share: float) -> None:
    curve = firmwares.rate_curve(kind, firmwares.AxisRates(centre, expo, most))
    wanted = share * curve(1.0)
    stick = firmwares.stick_for(curve, wanted)
    assert -1.0 <= stick <= 1.0
    reached = curve(abs(stick)) * (1 if stick >= 0 else -1)
    assert reached == pytest.approx(wanted, abs=max(0.5, abs(wanted) * 0.02))


def test_a_full_stick_is_the_maximum() -> None:
    assert firmwares.stick_for(firmwares.inav_curve(70, 30.0), 99.0) == 1.0
    assert firmwares.stick_for(firmwares.inav_curve(70, 30.0), -99.0) == -1.0
    assert firmwares.share_of(lambda _: 0.0)(0.3) == 0.3

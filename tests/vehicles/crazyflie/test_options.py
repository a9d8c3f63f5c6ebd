"""Addresses, and the conversion of log variables."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.drivers.uri import parse_uri
from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages import FlightState
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.vehicles.crazyflie.options import CrazyflieOptions, LinkKind, RadioAddress, options_of
from skyloop.vehicles.crazyflie.telemetry import MAIN, CrazyflieTelemetry, choose_variables, estimate_of
from skyloop.vehicles.crazyflie.wire.commander import Supervisor, compressed
from skyloop.vehicles.crazyflie.wire.contents import Entry, ValueType


def parsed(address: str) -> CrazyflieOptions:
    return options_of(parse_uri(address))


def test_addresses() -> None:
    radio = parsed("crazyflie://radio:1/90/250K/E7E7E7E701")
    assert radio.radio == RadioAddress(1, 90, "250K", bytes.fromhex("E7E7E7E701"))
    assert parsed("crazyflie://radio://0").radio == RadioAddress()
    udp = parsed("crazyflie://udp:127.0.0.1:19851?speed=0.5")
    assert (udp.kind, udp.host, udp.port) == (LinkKind.UDP, "127.0.0.1", 19851)
    assert dict(udp.limits)["limits.speed"] == 0.5
    assert parsed("crazyflie://udp://127.0.0.1").port == 19850
    for address in ("crazyflie://esp:192.168.43.42", "crazyflie://udp:192.168.43.42:2390?dialect=esp"):
        esp = parsed(address)
        assert (esp.checksum, esp.port) == (True, 2390)
    assert "channel 90" in str(radio)


@pytest.mark.parametrize(
    "address",
    [
        "crazyflie://",
        "crazyflie://127.0.0.1",
        "crazyflie://usb:0",
        "crazyflie://udp:",
        "crazyflie://udp:127.0.0.1:0",
        "crazyflie://radio:0/126",
        "crazyflie://radio:0/80/3M",
        "crazyflie://radio:0/80/2M/E7",
        "crazyflie://udp:127.0.0.1?speed=9",
    ],
)
def test_wrong_addresses_are_refused(address: str) -> None:
    with pytest.raises(UsageError):
        parsed(address)


@pytest.mark.parametrize("option", ["velocity=fast", "dialect=klingon", "sped=1"])
def test_unknown_names_are_refused(option: str) -> None:
    with pytest.raises(UnknownNameError):
        parsed(f"crazyflie://udp:127.0.0.1?{option}")


ANGLE = st.floats(-1.4, 1.4)


@given(ANGLE, ANGLE, st.floats(-3.1, 3.1))
def test_both_forms_of_the_estimate_agree(roll: float, pitch: float, yaw: float) -> None:
    numbers = {"x": 1.5, "y": -0.25, "z": 0.75, "vx": 0.5, "vy": -0.125, "vz": 0.25}
    packed = {f"stateEstimateZ.{name}": 1000 * value for name, value in numbers.items()}
    packed["stateEstimateZ.quat"] = compressed(quaternion_from_euler(roll, pitch, yaw))
    packed |= {"stateEstimateZ.rateRoll": 100, "stateEstimateZ.ratePitch": -200, "stateEstimateZ.rateYaw": 300}
    plain = {f"stateEstimate.{name}": value for name, value in numbers.items()}
    plain |= {
        "stateEstimate.roll": math.degrees(roll),
        "stateEstimate.pitch": -math.degrees(pitch),
        "stateEstimate.yaw": math.degrees(yaw),
    }
    one, other = estimate_of(packed), estimate_of(plain)
    assert one.position_m == other.position_m == (1.5, -0.25, 0.75)
    assert one.velocity_m_s == other.velocity_m_s == (0.5, -0.125, 0.25)
    assert one.rates_rad_s == (0.1, 0.2, 0.3)
    for name in ("roll_rad", "pitch_rad", "yaw_rad"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), abs=0.02)


def test_variables_are_chosen_from_what_there_is() -> None:
    entries = [Entry(i, *name.split("."), ValueType.FLOAT) for i, name in enumerate((*MAIN[3], "pm.vbat", "a.b"))]
    main, slow = choose_variables(entries)
    assert tuple(entry.full_name for entry in main) == MAIN[3]
    assert [entry.full_name for entry in slow] == ["pm.vbat"]
    assert choose_variables(entries[1:])[0] == []


def test_nothing_is_made_up() -> None:
    telemetry = CrazyflieTelemetry()
    assert telemetry.is_flying(0) is None
    telemetry.update(dict.fromkeys(MAIN[3], 0.0), 1)
    assert telemetry.knows_position
    telemetry.update({"kalman.varPX": 100.0}, 2)  # dead reckoning without any deck
    assert not telemetry.knows_position
    feedback = telemetry.feedback(FlightState.UNKNOWN, 3, {})
    assert feedback.position_m is None
    assert feedback.velocity_m_s is None
    assert feedback.battery is None
    telemetry.parameters["deck.bcFlow2"] = 1
    assert telemetry.knows_position
    telemetry.parameters["stabilizer.estimator"] = 1
    assert not telemetry.knows_position


def test_the_supervisor_prevents_takeoffs() -> None:
    telemetry = CrazyflieTelemetry()
    telemetry.update(dict.fromkeys(MAIN[3], 0.0), 1)
    assert telemetry.refusal() == ""
    for bit, text in (
        (Supervisor.IS_LOCKED, "locked"),
        (Supervisor.IS_CRASHED, "crashed"),
        (Supervisor.IS_TUMBLED, "upright"),
    ):
        telemetry.update({"supervisor.info": bit}, 2)
        assert text in telemetry.refusal()
        assert len(telemetry.changes()) == 1
        assert telemetry.changes() == []

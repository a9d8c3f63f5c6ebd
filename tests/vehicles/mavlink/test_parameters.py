"""Reading, writing and naming the autopilot's parameters."""

from __future__ import annotations

import math

import pytest

from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import ParameterType
from skyloop.vehicles.mavlink.autopilots import (
    ArduCopterProfile,
    ClimbRateThrust,
    CollectiveThrust,
    Px4Profile,
)
from skyloop.vehicles.mavlink.options import USUAL, limits_text, takeoff_height
from skyloop.vehicles.mavlink.parameters import (
    ParameterExchange,
    ReportedParameter,
    check_exact,
    limit_parameters,
    vehicle_parameters,
    with_limit,
    writable_parameter,
)
from skyloop.vehicles.mavlink.wire.codec import Message, to_field
from skyloop.vehicles.mavlink.wire.codec import dialect as m

S = 1_000_000_000


def value(name: str, number: float, kind: int, index: int, count: int = 3, *, bytewise: bool = False) -> Message:
    field = to_field(number, kind, bytewise=bytewise)
    return m.MAVLink_param_value_message(name.encode(), field, kind, count, index)


def test_lost_parameters_of_the_list_are_requested() -> None:
    exchange = ParameterExchange()
    exchange.request_all(0)
    (request,) = exchange.poll(1)
    assert request.get_type() == "PARAM_REQUEST_LIST"
    exchange.on_value(value("ONE", 1, 6, 0), 1)
    exchange.on_value(value("THREE", 3, 6, 2), 2)
    assert exchange.poll(S // 2) == []
    (missing,) = exchange.poll(S)
    assert (missing.get_type(), missing.param_index) == ("PARAM_REQUEST_READ", 1)
    exchange.on_value(value("TWO", 2, 6, 1), S)
    assert exchange.complete
    assert exchange.poll(10 * S) == []
    assert exchange.values == {"ONE": 1, "TWO": 2, "THREE": 3}


def test_a_list_that_never_arrives_is_given_up() -> None:
    exchange = ParameterExchange()
    exchange.request_all(0)
    said = [message for at in range(0, 30 * S, S // 10) for message in exchange.poll(at)]
    assert 5 <= len(said) <= 8
    assert exchange.given_up


def test_a_write_is_repeated_until_the_value_comes_back() -> None:
    exchange, ended = ParameterExchange(), list[str | None]()
    exchange.on_value(value("ONE", 1, 6, 0), 0)
    exchange.write("ONE", 5, S, ended.append)
    assert [each.param_value for each in exchange.poll(0)] == [5.0]
    exchange.on_value(value("ONE", 1, 6, 0xFFFF), 1)
    assert ended == []
    assert len(exchange.poll(S // 2)) == 1
    exchange.on_value(value("ONE", 5, 6, 0xFFFF), 2)
    assert ended == [None]


def test_a_rejected_value_is_reported() -> None:
    exchange, ended = ParameterExchange(), list[str | None]()
    exchange.on_value(value("ONE", 1, 6, 0), 0)
    exchange.write("ONE", 5, S, ended.append)
    exchange.poll(0)
    exchange.poll(S)
    assert ended[0] is not None
    assert "last reported 1" in ended[0]
    exchange.write("ONE", 6, 5 * S, ended.append)
    exchange.fail_writes("it is gone")
    assert ended[1] == "it is gone"


def test_px4_integers_are_bytes() -> None:
    exchange = ParameterExchange()
    exchange.bytewise = True
    exchange.on_value(value("COM_DL_LOSS_T", 10, 6, 0, bytewise=True), 0)
    exchange.on_value(value("NEGATIVE", -5, 6, 1, bytewise=True), 0)
    assert exchange.values == {"COM_DL_LOSS_T": 10, "NEGATIVE": -5}


def reported(**values: tuple[float, int]) -> dict[str, ReportedParameter]:
    return {name: ReportedParameter(name, number, kind) for name, (number, kind) in values.items()}


def test_names_types_units_and_ranges() -> None:
    entries = vehicle_parameters(
        reported(WPNAV_SPEED_UP=(250.0, 9), RTL_ALT=(1500, 6), SOMETHING_NEW=(0.1, 9), BAD=(math.nan, 9))
    )
    up = entries["mavlink.wpnav_speed_up"].parameter
    assert (up.type, up.value, up.unit, up.minimum, up.maximum) == (ParameterType.FLOAT, 250.0, "cm/s", 10, 1000)
    assert entries["mavlink.rtl_alt"].parameter.type is ParameterType.INT
    assert entries["mavlink.something_new"].parameter.value == 0.1
    assert entries["mavlink.bad"].parameter.read_only
    assert not any(name.startswith("limits.") for name in entries), "the autopilot's limits are not ours"


def test_the_drivers_own_limits_are_cautious_despite_the_autopilots() -> None:
    limits = {parameter.name: parameter for parameter in limit_parameters(USUAL)}
    assert {name: limits[name].value for name in ("limits.speed", "limits.climb", "limits.altitude")} == {
        "limits.speed": 2.0,
        "limits.climb": 1.0,
        "limits.altitude": 3.0,
    }
    assert "2 m/s, 1 m/s up and down, 3 m high" in limits_text(USUAL)
    raised = with_limit(with_limit(USUAL, "limits.speed", 8), "limits.altitude", 1.0)
    assert raised["limits.speed"] == 8.0
    assert takeoff_height(raised) == 1.0, "no take-off ends above the ceiling"


@pytest.mark.parametrize("value", [math.nan, True, "fast", 31.0, 0.0])
def test_an_invalid_limit_is_refused(value: float) -> None:
    with pytest.raises(ParameterError, match=r"limits\.speed"):
        with_limit(USUAL, "limits.speed", value)


@pytest.mark.parametrize("number", [16_777_217, -16_777_217, 2_147_483_647, 33_554_433])
def test_a_number_that_would_arrive_changed_is_refused_with_the_reason(number: int) -> None:
    with pytest.raises(ParameterError, match=f"would receive -?[0-9]+ instead of {number}"):
        check_exact("mavlink.brd_options", number, bytewise=False)
    assert check_exact("mavlink.brd_options", number, bytewise=True) == number


@pytest.mark.parametrize("number", [0, -5, 16_777_216, 16_777_218, 1 << 30])
def test_a_whole_number_that_single_precision_holds_is_written(number: int) -> None:
    assert check_exact("mavlink.brd_options", number, bytewise=False) == number


def test_wrong_names_and_values_are_refused() -> None:
    entries = vehicle_parameters(reported(RTL_ALT=(1500, 6), BAD=(math.inf, 9)))
    with pytest.raises(UnknownNameError, match="rtl_alt"):
        writable_parameter(entries, "mavlink.rtl_alti")
    with pytest.raises(ParameterError, match="read-only"):
        writable_parameter(entries, "mavlink.bad")
    for wrong in (1.5, True, "high", math.nan, 9_999_999):
        with pytest.raises(ParameterError):
            entries["mavlink.rtl_alt"].to_native(wrong)


def test_disabled_safety_nets_are_named_with_what_to_set() -> None:
    values = {"FS_GCS_ENABLE": 0, "MAV_GCS_SYSID": 255}
    found = {each.what: each for each in ArduCopterProfile().safety_diagnostics(values, 255)}
    assert not found["loss of this computer"].good
    assert "mavlink.fs_gcs_enable 7" in found["loss of this computer"].advice
    found = {each.what: each for each in Px4Profile().safety_diagnostics({"NAV_DLL_ACT": 1, "COM_OBL_RC_ACT": 0}, 255)}
    assert found["loss of this computer"].good
    assert "mavlink.com_obl_rc_act 5" in found["loss of set-points"].advice
    (other,) = ArduCopterProfile().safety_diagnostics({"MAV_GCS_SYSID": 254}, 255)
    assert "own_sysid=254" in other.advice


def test_arducopter_configured_for_thrust_gets_thrust() -> None:
    assert isinstance(ArduCopterProfile().thrust_model({}), ClimbRateThrust)
    assert isinstance(ArduCopterProfile().thrust_model({"GUID_OPTIONS": 8, "MOT_THST_HOVER": 0.3}), CollectiveThrust)
    newer = ArduCopterProfile().thrust_model({"WP_SPD_UP": 4.0})
    assert newer.limit_climb(9.0) == 4.0

"""Reading, writing and naming the autopilot's parameters."""

from __future__ import annotations

import math

import pytest

from skyloop.drivers.mavlink.dialects import CopterDialect, Px4Dialect
from skyloop.drivers.mavlink.lift import ClimbByShare, ClimbByThrust
from skyloop.drivers.mavlink.parameter_exchange import Held, ParameterExchange
from skyloop.drivers.mavlink.parameters import entries_of, entry_of
from skyloop.drivers.mavlink.safety import remarks_of
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import ParameterType
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m
from skyloop.wire.mavlink.parameter_values import to_field

S = 1_000_000_000


def value(name: str, number: float, kind: int, index: int, count: int = 3, *, bytewise: bool = False) -> Message:
    field = to_field(number, kind, bytewise=bytewise)
    return m.MAVLink_param_value_message(name.encode(), field, kind, count, index)


def test_what_is_lost_of_the_list_is_asked_for() -> None:
    exchange = ParameterExchange()
    exchange.begin(0)
    (request,) = exchange.step(1)
    assert request.get_type() == "PARAM_REQUEST_LIST"
    exchange.heard(value("ONE", 1, 6, 0), 1)
    exchange.heard(value("THREE", 3, 6, 2), 2)
    assert exchange.step(S // 2) == []
    (missing,) = exchange.step(S)
    assert (missing.get_type(), missing.param_index) == ("PARAM_REQUEST_READ", 1)
    exchange.heard(value("TWO", 2, 6, 1), S)
    assert exchange.complete
    assert exchange.step(10 * S) == []
    assert exchange.values == {"ONE": 1, "TWO": 2, "THREE": 3}


def test_a_list_that_never_comes_is_given_up() -> None:
    exchange = ParameterExchange()
    exchange.begin(0)
    said = [message for at in range(0, 30 * S, S // 10) for message in exchange.step(at)]
    assert 5 <= len(said) <= 8
    assert exchange.given_up


def test_writing_is_repeated_until_the_value_comes_back() -> None:
    exchange, ended = ParameterExchange(), list[str | None]()
    exchange.heard(value("ONE", 1, 6, 0), 0)
    exchange.write("ONE", 5, S, ended.append)
    assert [each.param_value for each in exchange.step(0)] == [5.0]
    exchange.heard(value("ONE", 1, 6, 0xFFFF), 1)
    assert ended == []
    assert len(exchange.step(S // 2)) == 1
    exchange.heard(value("ONE", 5, 6, 0xFFFF), 2)
    assert ended == [None]


def test_a_value_that_is_not_taken_is_told() -> None:
    exchange, ended = ParameterExchange(), list[str | None]()
    exchange.heard(value("ONE", 1, 6, 0), 0)
    exchange.write("ONE", 5, S, ended.append)
    exchange.step(0)
    exchange.step(S)
    assert ended[0] is not None
    assert "keeps 1" in ended[0]
    exchange.write("ONE", 6, 5 * S, ended.append)
    exchange.abandon("it is gone")
    assert ended[1] == "it is gone"


def test_bytes_for_integers_of_px4() -> None:
    exchange = ParameterExchange()
    exchange.bytewise = True
    exchange.heard(value("COM_DL_LOSS_T", 10, 6, 0, bytewise=True), 0)
    exchange.heard(value("NEGATIVE", -5, 6, 1, bytewise=True), 0)
    assert exchange.values == {"COM_DL_LOSS_T": 10, "NEGATIVE": -5}


def held(**values: tuple[float, int]) -> dict[str, Held]:
    return {name: Held(name, number, kind) for name, (number, kind) in values.items()}


def test_names_types_units_and_ranges() -> None:
    entries = entries_of(held(WPNAV_SPEED_UP=(250.0, 9), RTL_ALT=(1500, 6), SOMETHING_NEW=(0.1, 9), BAD=(math.nan, 9)))
    up = entries["mavlink.wpnav_speed_up"].parameter
    assert (up.type, up.value, up.unit, up.minimum, up.maximum) == (ParameterType.FLOAT, 250.0, "cm/s", 10, 1000)
    assert entries["mavlink.rtl_alt"].parameter.type is ParameterType.INT
    assert entries["mavlink.something_new"].parameter.value == 0.1
    assert entries["mavlink.bad"].parameter.read_only
    common = entries["limits.climb"]
    assert (common.parameter.value, common.parameter.unit) == (2.5, "m/s")
    assert common.to_native(1.5) == pytest.approx(150.0)


@pytest.mark.parametrize(
    ("given", "name", "expected"),
    [
        ({"ANGLE_MAX": (3000, 4)}, "limits.tilt", math.radians(30)),
        ({"ATC_ANGLE_MAX": (30.0, 9), "ANGLE_MAX": (4500, 4)}, "limits.tilt", math.radians(30)),
        ({"MPC_TILTMAX_AIR": (45.0, 9)}, "limits.tilt", math.radians(45)),
        ({"MPC_XY_VEL_MAX": (12.0, 9)}, "limits.speed", 12.0),
        ({"MPC_MAN_Y_MAX": (90.0, 9)}, "limits.yaw_rate", math.pi / 2),
        ({"FENCE_ALT_MAX": (100.0, 9), "FENCE_ENABLE": (1, 2)}, "limits.altitude", 100.0),
    ],
)
def test_the_names_that_all_drivers_share(given: dict[str, tuple[float, int]], name: str, expected: float) -> None:
    assert entries_of(held(**given))[name].parameter.value == pytest.approx(expected, rel=1e-5)


def test_a_fence_that_is_off_is_no_ceiling() -> None:
    assert "limits.altitude" not in entries_of(held(FENCE_ALT_MAX=(100.0, 9), FENCE_ENABLE=(0, 2)))
    assert "limits.altitude" not in entries_of(held(GF_MAX_VER_DIST=(0.0, 9)))


def test_wrong_names_and_values_are_refused() -> None:
    entries = entries_of(held(RTL_ALT=(1500, 6), BAD=(math.inf, 9)))
    with pytest.raises(UnknownNameError, match="rtl_alt"):
        entry_of(entries, "mavlink.rtl_alti")
    with pytest.raises(ParameterError, match="only be read"):
        entry_of(entries, "mavlink.bad")
    for wrong in (1.5, True, "high", math.nan, 9_999_999):
        with pytest.raises(ParameterError):
            entries["mavlink.rtl_alt"].to_native(wrong)


def test_safety_nets_that_are_off_are_named_with_what_to_set() -> None:
    found = {each.what: each for each in remarks_of(CopterDialect(), {"FS_GCS_ENABLE": 0, "MAV_GCS_SYSID": 255}, 255)}
    assert not found["loss of this computer"].good
    assert "mavlink.fs_gcs_enable=7" in found["loss of this computer"].advice
    found = {each.what: each for each in remarks_of(Px4Dialect(), {"NAV_DLL_ACT": 1, "COM_OBL_RC_ACT": 0}, 255)}
    assert found["loss of this computer"].good
    assert "mavlink.com_obl_rc_act=5" in found["loss of set-points"].advice
    (other,) = remarks_of(CopterDialect(), {"MAV_GCS_SYSID": 254}, 255)
    assert "own_sysid=254" in other.advice


def test_arducopter_that_is_set_to_take_thrust_gets_thrust() -> None:
    assert isinstance(CopterDialect().lift({}), ClimbByShare)
    assert isinstance(CopterDialect().lift({"GUID_OPTIONS": 8, "MOT_THST_HOVER": 0.3}), ClimbByThrust)
    newer = CopterDialect().lift({"WP_SPD_UP": 4.0})
    assert newer.climb_within(9.0) == 4.0

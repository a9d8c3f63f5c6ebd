"""Parameters: every kind of bad value is refused with the allowed ones."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Reply, Value, encode
from skyloop.proxy.parameters import MAX_PARAMETER, OWN, Parameters, check

P, T = Parameter, ParameterType
SPEED = P("x.speed", T.FLOAT, 1.0, "m/s", 0.5, 2.0)
COUNT = P("x.count", T.INT, 1, "", 0, 10)
FLAG = P("x.flag", T.BOOL, True)
TEXT = P("x.text", T.TEXT, "a")
MODE = P("x.mode", T.TEXT, "a", choices=("a", "b"))
PLACE = P("x.place", T.VECTOR, (0.0, 0.0, 0.0), "m", -5, 5)
FIXED = P("x.fixed", T.INT, 1, read_only=True)


@pytest.mark.parametrize(
    ("parameter", "value", "expected"),
    [
        (SPEED, 1.5, 1.5),
        (SPEED, 1, 1.0),
        (COUNT, 10, 10),
        (FLAG, False, False),
        (TEXT, "", ""),
        (MODE, "b", "b"),
        (PLACE, (1, 2.0, -5.0), (1.0, 2.0, -5.0)),
    ],
)
def test_good_values_get_the_parameters_type(parameter: Parameter, value: Value, expected: Value) -> None:
    checked = check(parameter, value)
    assert checked == expected
    assert type(checked) is type(expected)


@pytest.mark.parametrize(
    ("parameter", "value", "code", "words"),
    [
        (SPEED, True, Refusal.WRONG_TYPE, ["x.speed", "float", "m/s", "bool"]),
        (SPEED, "1.5", Refusal.WRONG_TYPE, ["float", "text"]),
        (SPEED, (1.0,), Refusal.WRONG_TYPE, ["float", "vector"]),
        (SPEED, math.nan, Refusal.NON_FINITE, ["finite"]),
        (SPEED, math.inf, Refusal.NON_FINITE, ["finite"]),
        (SPEED, 0.4, Refusal.OUT_OF_RANGE, ["at least 0.5 m/s", "at most 2 m/s", "0.4"]),
        (SPEED, 10**400, Refusal.OUT_OF_RANGE, ["x.speed"]),
        (COUNT, 1.0, Refusal.WRONG_TYPE, ["takes an int, not a float"]),
        (COUNT, True, Refusal.WRONG_TYPE, ["takes an int, not a bool"]),
        (COUNT, 11, Refusal.OUT_OF_RANGE, ["at least 0 and at most 10"]),
        (COUNT, 10**400, Refusal.OUT_OF_RANGE, ["at most 10"]),
        (FLAG, 1, Refusal.WRONG_TYPE, ["bool", "int"]),
        (TEXT, 1, Refusal.WRONG_TYPE, ["takes text, not an int"]),
        (TEXT, "x" * 1025, Refusal.OUT_OF_RANGE, ["1024"]),
        (MODE, "c", Refusal.OUT_OF_RANGE, ["'a'", "'b'", "'c'"]),
        (PLACE, (1.0, 2.0), Refusal.WRONG_TYPE, ["3 numbers", "2"]),
        (PLACE, (1.0, 2.0, math.nan), Refusal.NON_FINITE, ["finite"]),
        (PLACE, (1.0, 2.0, 6.0), Refusal.OUT_OF_RANGE, ["at most 5 m"]),
        (FIXED, 1, Refusal.READ_ONLY, ["only be read"]),
    ],
)
def test_bad_values_are_refused_with_the_allowed_ones(
    parameter: Parameter, value: Value, code: Refusal, words: list[str]
) -> None:
    with pytest.raises(ParameterError) as caught:
        check(parameter, value)
    assert caught.value.code == code
    for word in words:
        assert word in str(caught.value)


values = (
    st.booleans() | st.integers() | st.floats() | st.text(max_size=20) | st.lists(st.floats(), max_size=5).map(tuple)
)


@given(st.sampled_from([SPEED, COUNT, FLAG, TEXT, MODE, PLACE, FIXED, *OWN]), values)
def test_anything_is_checked_or_refused(parameter: Parameter, value: Value) -> None:
    refused: ParameterError | None = None
    try:
        checked = check(parameter, value)
    except ParameterError as error:
        refused = error
    if refused is None:
        assert type(checked) is type(parameter.value)
        assert check(parameter, checked) == checked
    else:
        assert parameter.name in str(refused)
        assert refused.code in set(Refusal)


def test_the_defaults_of_the_proxys_own_are_allowed_and_well_named() -> None:
    for parameter in OWN:
        if not parameter.read_only:
            assert check(parameter, parameter.value) == parameter.value
        assert parameter.value == parameter.default
        assert parameter.name.islower()
        assert parameter.description
    assert len({parameter.name for parameter in OWN}) == len(OWN)


def test_a_written_number_is_in_force() -> None:
    store = Parameters()
    assert store.number("limits.tilt") == 0.35
    written = store.set("limits.tilt", 0.2)
    assert (written.value, written.default, store.number("limits.tilt")) == (0.2, 0.35, 0.2)


def test_unknown_names_get_suggestions() -> None:
    store = Parameters()
    with pytest.raises(UnknownNameError, match=r"did you mean 'limits\.tilt'"):
        store.get("limits.tlt")
    with pytest.raises(UnknownNameError):
        store.set("limits.tlt", 0.1)


def test_the_driver_wins_on_shared_names() -> None:
    written: list[tuple[str, Value]] = []

    def write(name: str, value: Value) -> Value:
        written.append((name, value))
        return 0.21  # rounded by the vehicle

    native = P("limits.tilt", T.FLOAT, 0.5, "rad", 0.1, 0.52, 0.4)
    store = Parameters(lambda: [native, P("camera.fps", T.INT, 15)], write)
    store.refresh()
    assert store.get("limits.tilt") == native
    assert store.number("limits.tilt") == 0.5
    assert store.set("limits.tilt", 0.2).value == 0.21
    assert written == [("limits.tilt", 0.2)]
    assert store.number("limits.tilt") == 0.21
    store.set("limits.climb", 0.5)
    assert len(written) == 1  # the proxy's own never reaches the driver
    with pytest.raises(ParameterError, match=r"0\.52"):
        store.set("limits.tilt", 0.53)


def test_a_driver_that_uses_a_shared_name_differently_leaves_the_proxys_in_force() -> None:
    store = Parameters(lambda: [P("limits.tilt", T.TEXT, "steep"), P("limits.climb", T.FLOAT, math.nan)])
    store.refresh()
    assert store.number("limits.tilt") == 0.35
    assert store.number("limits.climb") == 1.0


def test_pages_hold_everything_once_in_order_and_fit_a_packet() -> None:
    many = [P(f"driver.{number:03}", T.TEXT, "x" * 900, description="d" * 50) for number in range(200)]
    store = Parameters(lambda: many)
    store.refresh()
    names: list[str] = []
    pages = 0
    while True:
        page = store.page(len(names))
        encode(Reply(2**63 - 1, page))
        assert page.first == len(names)
        names += [parameter.name for parameter in page.parameters]
        pages += 1
        if len(names) == page.total:
            break
    assert names == sorted([parameter.name for parameter in (*many, *OWN)])
    assert pages == 4
    assert store.page(10**9).parameters == ()


def test_a_parameter_too_large_to_send_is_skipped() -> None:
    store = Parameters(lambda: [P("a.huge", T.TEXT, "x" * MAX_PARAMETER), P("a.small", T.INT, 1)])
    store.refresh()
    assert store.left_out == ("a.huge",)
    assert store.get("a.small").value == 1
    with pytest.raises(UnknownNameError):
        store.get("a.huge")


NUMBERS = [parameter for parameter in OWN if parameter.type is T.FLOAT]


@given(
    st.lists(
        st.tuples(st.sampled_from(NUMBERS), st.floats(0.0, 1.0), st.sampled_from(["pilot", "vehicle", "gone"])),
        max_size=12,
    )
)
def test_settings_changed_one_by_one_equal_those_set_at_once(
    steps: list[tuple[Parameter, float, str]],
) -> None:
    native: dict[str, Parameter] = {}
    store = Parameters(lambda: native.values(), lambda _, value: value)
    own = {parameter.name: parameter.value for parameter in OWN}
    for parameter, share, who in steps:
        assert parameter.minimum is not None
        assert parameter.maximum is not None
        name, value = parameter.name, parameter.minimum + share * (parameter.maximum - parameter.minimum)
        if who == "pilot":
            try:
                store.set(name, value)
            except ParameterError:  # a wall of the box beyond the opposite one
                continue
            if name in native:
                native[name] = P(name, T.FLOAT, value)
            else:
                own[name] = value
        else:
            native.pop(name, None)
            if who == "vehicle":
                native[name] = P(name, T.FLOAT, value)
            store.refresh()
        store.flight_settings()
    fresh = Parameters(lambda: [*(P(name, T.FLOAT, own[name]) for name in own if name not in native), *native.values()])
    fresh.refresh()
    assert store.flight_settings() == fresh.flight_settings()


def test_unaffected_settings_stay_the_same_object() -> None:
    store = Parameters()
    before = store.flight_settings()
    store.set("alarms.video_age_s", 2.0)
    store.set("limits.speed", before.airspace.limits.speed)
    store.refresh()
    assert store.flight_settings() is before
    store.set("limits.speed", 0.5)
    after = store.flight_settings()
    assert after.airspace.limits.speed == 0.5
    assert after.airspace.space is before.airspace.space
    assert after.failsafe is before.failsafe
    assert after.returns is before.returns

"""Values from state strings."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.vehicles.tello.wire import TelloState, build, parse
from tests.vehicles.tello.rig import strings


def test_every_recorded_string_decodes_in_full() -> None:
    states = [parse(f"{line}\r\n".encode()) for line in strings()]
    assert len(states) == 9
    for line, state in zip(strings(), states, strict=True):
        told = dict(part.split(":") for part in line.strip(";").split(";"))
        assert dict(state.fields).keys() == told.keys()
        assert state.pitch_deg == float(told["pitch"])
        assert state.yaw_deg == float(told["yaw"])
        assert state.speed_dm_s == tuple(float(told[name]) for name in ("vgx", "vgy", "vgz"))
        assert state.temperature_c == (float(told["templ"]), float(told["temph"]))
        assert state.height_cm == float(told["h"])
        assert state.battery_percent == float(told["bat"])
        assert state.barometer == float(told["baro"])
        assert state.motor_s == int(told["time"])
        assert state.acceleration_mg is not None
        assert state.pads is ("mid" in told)
        assert state.pad is None  # no pad in any of them


def test_values_that_mean_unknown_are_none() -> None:
    flying = parse(strings()[3].encode())
    assert dict(flying.fields)["tof"] == 6553
    assert flying.distance_cm is None
    assert parse(b"tof:10;bat:101;pitch:1000;").battery_percent is None
    assert parse(b"tof:10;vgx:1;vgy:2;").speed_dm_s is None
    assert parse(b"tof:-3;").distance_cm is None


def test_attitude_and_acceleration_agree_on_their_axes() -> None:
    """At rest: nose up shows along x, right side down along negative y; z points down."""
    for line in strings():
        state = parse(line.encode())
        assert state.acceleration_mg is not None
        assert state.pitch_deg is not None
        x, _, z = state.acceleration_mg
        assert z == pytest.approx(-1000, abs=70)
        assert x == pytest.approx(1000 * math.sin(math.radians(state.pitch_deg)), abs=30)


def test_a_pad_in_view() -> None:
    state = parse(b"mid:3;x:12;y:-7;z:80;mpry:1,-2,30;pitch:0;")
    assert state.pad is not None
    assert (state.pad.number, state.pad.place_cm, state.pad.angles_deg) == (3, (12, -7, 80), (1, -2, 30))
    assert parse(b"mid:-2;x:0;y:0;z:0;mpry:0,0,0;").pad is None
    for mid in (b"0", b"9", b"257", b"2.5"):
        assert parse(b"mid:" + mid + b";x:0;y:0;z:0;mpry:0,0,0;").pad is None, "pads are 1 to 8"
    nowhere = parse(b"mid:8;x:-100;y:-100;z:-100;mpry:0,0,0;").pad
    assert nowhere is not None
    assert nowhere.place_cm is None


def test_a_truncated_string_keeps_its_whole_fields() -> None:
    whole = strings()[0]
    for end in range(len(whole)):
        try:
            state = parse(whole[:end].encode())
        except DecodeError:
            continue
        # The last one may have lost digits unnoticed; all others are as in the whole string.
        for name, value in state.fields[:-1]:
            assert dict(parse(whole.encode()).fields)[name] == value


@pytest.mark.parametrize("datagram", [b"", b"ok", b"\xff\xfe", b";;;", b"bat:;h:x;", b"a:1;" * 400])
def test_other_texts_are_refused(datagram: bytes) -> None:
    with pytest.raises(DecodeError):
        parse(datagram)


def test_a_built_state_is_read_back() -> None:
    datagram = build([("mid", "-1"), ("mpry", "0,0,0"), ("pitch", "-3"), ("baro", "-18.06")])
    assert datagram == b"mid:-1;mpry:0,0,0;pitch:-3;baro:-18.06;\r\n"
    assert parse(datagram).pitch_deg == -3


@given(st.binary(max_size=1200) | st.text(alphabet="abcmidxyz:;,.-0123456789", max_size=300).map(str.encode))
def test_no_bytes_raise_anything_else(datagram: bytes) -> None:
    try:
        state = parse(datagram)
    except DecodeError:
        return
    assert isinstance(state, TelloState)

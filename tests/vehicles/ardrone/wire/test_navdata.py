"""Navdata: recorded and made-up datagrams, and damaged ones."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.vehicles.ardrone.wire.navdata import (
    BY_TAG_AND_SIZE,
    LAYOUTS,
    MAX_DATAGRAM,
    ControlState,
    Demo,
    Gps,
    Magneto,
    PressureRaw,
    RawMeasures,
    State,
    Time,
    VisionDetect,
    Wifi,
    Zimmu3000,
    decode,
    encode,
)
from tests.support.recordings import content, needs_recordings

RECORDED = content("ardrone2/navdata-full-landed.bin")
BOOTSTRAPS = [
    (bytes.fromhex(line.split("|")[0]), "BAD" not in line)
    for line in content("ardrone2/navdata-bootstrap-hex.txt").decode().splitlines()
    if line and not line.startswith("#")
]
#: Sizes including tag and size, as in ``navdata_common.h``, by tag.
SIZES = {
    **{0: 148, 1: 8, 2: 52, 3: 46, 4: 16, 5: 12, 6: 88, 7: 16, 8: 24, 9: 76, 10: 56, 11: 16, 12: 44, 13: 92},
    **{14: 108, 15: 364, 16: 328, 17: 8, 18: 40, 19: 65, 20: 12, 21: 18, 22: 75, 23: 56, 24: 72, 25: 32, 26: 8},
}


def with_checksum(body: bytes) -> bytes:
    return body + struct.pack("<HHI", 0xFFFF, 8, sum(body) & 0xFFFFFFFF)


def header(state: int = 0, sequence: int = 1) -> bytes:
    return struct.pack("<IIII", 0x55667788, state, sequence, 0)


@needs_recordings
def test_the_recorded_datagram() -> None:
    navdata = decode(RECORDED)
    assert (len(RECORDED), len(navdata.options), navdata.unknown) == (1916, 28, ())
    assert navdata.sequence == 300711
    assert State.COMMUNICATION_WATCHDOG in navdata.state
    assert State.FLYING not in navdata.state
    assert State.EMERGENCY not in navdata.state
    demo = navdata.get(Demo)
    assert demo is not None
    assert (demo.ctrl_state >> 16, demo.battery, demo.altitude) == (ControlState.LANDED, 50, 0)
    assert (demo.theta, demo.phi, demo.psi) == (2974.0, 550.0, 1933.0)
    raw = navdata.get(RawMeasures)
    assert raw is not None
    assert raw.vbat == 11686
    pressure = navdata.get(PressureRaw)
    assert pressure is not None
    assert pressure.pressure == 101586
    magneto = navdata.get(Magneto)
    assert magneto is not None
    assert (magneto.mx, magneto.my, magneto.mz, magneto.calibrated) == (30, -56, 80, 1)
    assert navdata.get(Gps) is None
    assert navdata.get(Zimmu3000) is not None


@needs_recordings
def test_the_recorded_datagram_encoded_again() -> None:
    navdata = decode(RECORDED)
    assert encode(navdata.state, navdata.sequence, navdata.options.values(), navdata.vision_defined) == RECORDED


@needs_recordings
def test_recorded_bootstraps() -> None:
    assert [good for _, good in BOOTSTRAPS] == [True, True, False]
    for datagram, good in BOOTSTRAPS:
        if good:
            navdata = decode(datagram)
            assert (navdata.sequence, navdata.options) == (1, {})
            assert State.BOOTSTRAP in navdata.state
        else:
            with pytest.raises(DecodeError, match="checksum"):
                decode(datagram)


@pytest.mark.parametrize(("tag", "size"), SIZES.items())
def test_sizes_of_the_options(tag: int, size: int) -> None:
    assert (tag, size - 4) in BY_TAG_AND_SIZE


def test_the_two_options_of_tag_27() -> None:
    assert LAYOUTS[Zimmu3000].size + 4 == 12
    assert LAYOUTS[Gps].size + 4 == 216


@pytest.mark.parametrize("kind", LAYOUTS, ids=lambda kind: kind.__name__)
def test_an_option_survives_a_round_trip(kind: type[Any]) -> None:
    layout = LAYOUTS[kind]
    bytes_of_zeros = bytes(layout.size)
    option = layout.unpack(bytes_of_zeros, 0)
    assert option == kind(), "the defaults are zeros, of the right number in each field"
    assert layout.pack(option) == bytes_of_zeros
    assert decode(encode(0, 1, [option])).get(kind) == option


@given(st.data())
def test_any_content_of_an_option_survives_a_round_trip(data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(list(LAYOUTS)))
    layout = LAYOUTS[kind]
    content = data.draw(st.binary(min_size=layout.size, max_size=layout.size))
    datagram = with_checksum(header() + struct.pack("<HH", layout.tag, layout.size + 4) + content)
    option = decode(datagram).get(kind)
    assert option is not None
    if "nan" not in str(option):  # its other bits may change on the way
        assert layout.pack(option) == content


def test_unknown_options_are_listed() -> None:
    body = header() + struct.pack("<HHI", 1, 8, 5) + struct.pack("<HH3s", 99, 7, b"abc") + struct.pack("<HHI", 0, 8, 1)
    navdata = decode(with_checksum(body))
    assert navdata.get(Time) == Time(5)
    assert navdata.unknown == ((99, 7), (0, 8)), "a known tag with another size is also unknown"


def test_an_option_written_by_hand() -> None:
    body = header(0x0F8004D0, 77) + struct.pack("<HHI", 26, 8, 87)
    navdata = decode(with_checksum(body))
    assert (navdata.state, navdata.sequence, navdata.get(Wifi)) == (0x0F8004D0, 77, Wifi(87))
    assert encode(0x0F8004D0, 77, [Wifi(87)]) == with_checksum(body)


@pytest.mark.parametrize(
    ("datagram", "says"),
    [
        (b"", "0 bytes"),
        (header(), "16 bytes"),
        pytest.param(RECORDED[:-1], "checksum", marks=needs_recordings),
        (bytes(MAX_DATAGRAM + 1), "4097 bytes"),
        (with_checksum(b"\x89" + header()[1:]), "must begin with"),
        (with_checksum(header() + b"\x01\x00"), "belong to no option"),
        (with_checksum(header() + struct.pack("<HH", 1, 3)), "does not fit"),
        (with_checksum(header() + struct.pack("<HH", 1, 9) + b"1234"), "does not fit"),
        (with_checksum(header())[:-1] + b"\xff", "damaged"),
    ],
)
def test_other_bytes_are_refused(datagram: bytes, says: str) -> None:
    with pytest.raises(DecodeError, match=says):
        decode(datagram)


@given(st.binary(max_size=200))
def test_anything_is_decoded_or_refused(tail: bytes) -> None:
    for datagram in (tail, header() + tail, with_checksum(header() + tail)):
        try:
            decode(datagram)
        except DecodeError:
            continue


@needs_recordings
@given(st.integers(0, len(RECORDED) - 1), st.integers(0, 7))
def test_one_flipped_bit_is_always_detected(at: int, bit: int) -> None:
    damaged = bytearray(RECORDED)
    damaged[at] ^= 1 << bit
    with pytest.raises(DecodeError):
        decode(bytes(damaged))


@needs_recordings
@given(st.integers(0, len(RECORDED) - 1))
def test_a_truncated_datagram_is_always_detected(length: int) -> None:
    with pytest.raises(DecodeError):
        decode(RECORDED[:length])


def test_a_detected_tag() -> None:
    seen = VisionDetect(detected=1, kinds=(10, 0, 0, 0), xc=(500, 0, 0, 0), yc=(250, 0, 0, 0), distance=(150, 0, 0, 0))
    assert decode(encode(0, 3, [Demo(), seen])).get(VisionDetect) == seen

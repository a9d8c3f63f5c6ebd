"""Frames of both versions, damaged and signed, and a recorded flight."""

from __future__ import annotations

import struct
from collections import Counter
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyloop.errors import UsageError
from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m
from tests.support.recordings import recorded

FLIGHT = "mavlink/arduplane-flight.tlog"
KEY = bytes(range(32))


def attitude(boot_ms: int = 1234) -> Message:
    return m.MAVLink_attitude_message(boot_ms, 0.1, -0.2, 3.0, 0.0, 0.0, 0.5)


@pytest.mark.parametrize("version", [1, 2])
def test_a_message_comes_back_with_its_sender(version: int) -> None:
    sender, receiver = MavlinkCodec(7, 1), MavlinkCodec(255, 190)
    frame = sender.encode(attitude(), version=version)
    assert frame[0] == (0xFE if version == 1 else 0xFD)
    (back,) = receiver.decode(frame)
    assert (back.get_type(), back.get_srcSystem(), back.get_srcComponent()) == ("ATTITUDE", 7, 1)
    assert back.time_boot_ms == 1234
    assert back.yaw == pytest.approx(3.0)


def test_frames_are_numbered() -> None:
    sender, receiver = MavlinkCodec(1, 1), MavlinkCodec(255, 190)
    numbers = [receiver.decode(sender.encode(attitude()))[0].get_seq() for _ in range(257)]
    assert numbers[:3] == [0, 1, 2]
    assert numbers[256] == 0


@given(st.lists(st.integers(1, 60), max_size=30))
def test_a_stream_may_be_cut_anywhere(cuts: list[int]) -> None:
    sender, receiver = MavlinkCodec(1, 1), MavlinkCodec(255, 190)
    stream = b"".join(sender.encode(attitude(n), version=1 + n % 2) for n in range(6))
    found: list[Message] = []
    for cut in cuts:
        piece, stream = stream[:cut], stream[cut:]
        found += receiver.decode(piece)
    found += receiver.decode(stream)
    assert [each.time_boot_ms for each in found] == list(range(6))


def test_a_cut_datagram_spoils_no_other() -> None:
    sender, receiver = MavlinkCodec(1, 1), MavlinkCodec(255, 190)
    assert receiver.decode(sender.encode(attitude())[:20], whole=True) == []
    assert len(receiver.decode(sender.encode(attitude()), whole=True)) == 1


@given(st.binary(max_size=600))
def test_noise_never_raises(noise: bytes) -> None:
    receiver = MavlinkCodec(255, 190)
    receiver.decode(noise)
    receiver.decode(noise, whole=True)
    signed = MavlinkCodec(255, 190, key=KEY)
    signed.decode(noise)


@given(st.integers(0, 40 * 8 - 1), st.booleans())
def test_a_flipped_bit_is_detected(bit: int, whole: bool) -> None:
    sender, receiver = MavlinkCodec(1, 1), MavlinkCodec(255, 190)
    frame = bytearray(sender.encode(attitude()))
    frame[bit // 8 % len(frame)] ^= 1 << bit % 8
    assert receiver.decode(bytes(frame), whole=whole) == []
    for _ in range(12):  # a damaged length swallows some of the following bytes
        if receiver.decode(sender.encode(attitude()), whole=whole):
            return
    raise AssertionError("it did not find the frames that followed")


def test_unknown_messages_are_counted() -> None:
    receiver = MavlinkCodec(255, 190)
    number = 0xABCDEF
    frame = struct.pack("<BBBBBBBHB", 0xFD, 1, 0, 0, 0, 1, 1, number & 0xFFFF, number >> 16) + b"\x01\x00\x00"
    assert receiver.decode(frame, whole=True) == []
    assert (receiver.unknown, receiver.damaged) == (1, 0)


def test_signed_frames_need_the_key() -> None:
    sender, receiver = MavlinkCodec(1, 1, key=KEY), MavlinkCodec(255, 190, key=KEY)
    first = sender.encode(attitude())
    assert len(receiver.decode(first)) == 1
    assert receiver.decode(first) == [], "a frame is accepted only once"
    assert len(receiver.decode(sender.encode(attitude()))) == 1
    assert MavlinkCodec(255, 190, key=bytes(32)).decode(sender.encode(attitude())) == []
    assert receiver.decode(MavlinkCodec(1, 1).encode(attitude())) == [], "not signed"


def test_signatures_without_a_key_are_distinguished_from_damage() -> None:
    sender, receiver = MavlinkCodec(1, 1, key=KEY), MavlinkCodec(255, 190)
    assert receiver.decode(sender.encode(attitude())) == []
    assert (receiver.signed, receiver.damaged) == (1, 0)


def test_a_key_has_32_bytes() -> None:
    with pytest.raises(UsageError, match="32 bytes"):
        MavlinkCodec(255, 190, key=b"short")


def test_a_recorded_flight_decodes_in_full() -> None:
    """Each frame follows eight bytes of time. All 417 of 5.9 s decode; the file ends within the next one."""
    data, receiver, at = recorded(FLIGHT).read_bytes(), MavlinkCodec(255, 190), 0
    kinds: Counter[str] = Counter()
    times: list[int] = []
    while at + 9 < len(data) and at + data[at + 9] + 16 <= len(data):
        times.append(struct.unpack_from(">Q", data, at)[0])
        length = data[at + 9] + 8
        found = receiver.decode(data[at + 8 : at + 8 + length], whole=True)
        assert len(found) == 1, f"at byte {at}: {data[at : at + 32].hex()}"
        kinds[found[0].get_type()] += 1
        at += 8 + length
    assert sum(kinds.values()) == 417
    assert (receiver.damaged, receiver.unknown) == (0, 0)
    assert (times[-1] - times[0]) / 1e6 == pytest.approx(5.9, abs=0.1)
    assert kinds["ATTITUDE"] > 10


@settings(max_examples=50)
@given(st.data())
def test_a_damaged_recording_never_raises(data: st.DataObject) -> None:
    flight = bytearray(recorded(FLIGHT).read_bytes()[:2048])
    for _ in range(data.draw(st.integers(1, 30))):
        flight[data.draw(st.integers(0, len(flight) - 1))] = data.draw(st.integers(0, 255))
    MavlinkCodec(255, 190).decode(bytes(flight))


@pytest.mark.parametrize("version", [1, 2])
def test_a_datagram_decodes_like_the_same_bytes_of_a_stream(version: int) -> None:
    sender = MavlinkCodec(1, 1)
    one, two = (sender.encode(attitude(n), version=version) for n in range(2))
    damaged = one[:-1] + bytes([one[-1] ^ 1])
    for data, numbers, wrong in ((one, [0], 0), (one + two, [0, 1], 0), (b"\0" + one, [0], 1), (damaged, [], 1)):
        for whole in (True, False):
            receiver = MavlinkCodec(255, 190)
            assert [each.time_boot_ms for each in receiver.decode(data, whole=whole)] == numbers
            assert (receiver.frames, receiver.damaged) == (len(numbers), wrong)


NUMBERS = [kind for kind in m.mavlink_map.values() if not any(kind.array_lengths) and "char" not in kind.fieldtypes]


def values(kind: type[Message]) -> st.SearchStrategy[list[Any]]:
    """Return values for the fields of a kind of message, in the order of its constructor."""
    ranges = {"float": st.floats(width=32), "double": st.floats()}
    for bits in (8, 16, 32, 64):
        ranges[f"uint{bits}_t"] = st.integers(0, 2**bits - 1)
        ranges[f"int{bits}_t"] = st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return st.tuples(*(st.just(0) | ranges[each] for each in kind.fieldtypes)).map(list)


@given(st.data(), st.integers(1, 2))
def test_a_numeric_message_equals_pymavlinks(data: st.DataObject, version: int) -> None:
    kinds = [kind for kind in NUMBERS if version == 2 or kind.id < 256]
    kind = data.draw(st.sampled_from(kinds))
    frame = MavlinkCodec(7, 1).encode(kind(*data.draw(values(kind))), version=version)
    (ours,) = MavlinkCodec(255, 190).decode(frame, whole=True)
    theirs = m.MAVLink(None).decode(bytearray(frame))
    assert type(ours) is type(theirs)
    assert vars(ours.get_header()) == vars(theirs.get_header())
    assert _attributes(ours) == _attributes(theirs)


def _attributes(message: Message) -> dict[str, str]:
    """Return the attributes as text: a NaN equals nothing."""
    return {name: repr(value) for name, value in vars(message).items() if name != "_header"}


def test_a_longer_payload_than_known_is_cut() -> None:
    frame = bytearray(MavlinkCodec(7, 1).encode(attitude()))
    frame[1] += 2  # a later version of the message has another field
    frame[-2:] = b"\1\2"
    extra = bytes([m.MAVLink_attitude_message.crc_extra])
    frame += m.x25crc(bytes(frame[1:]) + extra).crc.to_bytes(2, "little")
    (back,) = MavlinkCodec(255, 190).decode(bytes(frame), whole=True)
    assert back.yawspeed == 0.5


def test_a_signed_datagram_is_checked_like_a_stream() -> None:
    sender, receiver, keyless = MavlinkCodec(1, 1, key=KEY), MavlinkCodec(255, 190, key=KEY), MavlinkCodec(255, 190)
    frame = sender.encode(attitude())
    assert len(receiver.decode(frame, whole=True)) == 1
    assert receiver.decode(frame, whole=True) == [], "a frame is accepted only once"
    assert receiver.decode(MavlinkCodec(1, 1).encode(attitude()), whole=True) == [], "not signed"
    assert keyless.decode(frame, whole=True) == []
    assert (keyless.signed, keyless.damaged) == (1, 0)


@pytest.mark.parametrize("size", [1, 20, 64, 200])
def test_a_stream_may_be_cut_across_datagrams(size: int) -> None:
    """As by a bridge from a serial line to the network; another sender's datagrams arrive in the middle."""
    sender, receiver, other = MavlinkCodec(1, 1), MavlinkCodec(255, 190), MavlinkCodec(2, 1)
    stream = b"".join(sender.encode(attitude(n), version=1 + n % 2) for n in range(220))
    found: list[Message] = []
    for at in range(0, len(stream), size):
        found += receiver.decode(stream[at : at + size], whole=True, source="bridge")
        assert len(receiver.decode(other.encode(attitude()), whole=True, source="other")) == 1
    assert [each.time_boot_ms for each in found] == list(range(220))
    assert receiver.damaged == 0


def test_a_cut_stream_continues_after_a_lost_datagram() -> None:
    sender, receiver = MavlinkCodec(1, 1), MavlinkCodec(255, 190)
    stream = b"".join(sender.encode(attitude(n)) for n in range(200))
    pieces = [stream[at : at + 100] for at in range(0, len(stream), 100)]
    del pieces[::10]
    found = [each for piece in pieces for each in receiver.decode(piece, whole=True)]
    assert len(found) > 140, "each loss costs a few frames"


def test_a_sender_of_fragments_can_not_fill_the_memory() -> None:
    receiver = MavlinkCodec(255, 190)
    for sender in range(1000):
        receiver.decode(b"\xfd\xff", whole=True, source=sender)
    assert len(receiver._rests) <= 16


class Wall:
    """The system's clock, set by the tests."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, now_s: float = 1.8e9) -> None:
        self.now_s = now_s
        monkeypatch.setattr("skyloop.vehicles.mavlink.wire.codec.time", self)

    def time(self) -> float:
        return self.now_s


def test_the_time_of_signatures_advances(monkeypatch: pytest.MonkeyPatch) -> None:
    """A vehicle switched on 80 s later accepts our frames, although it may be behind by at most a minute."""
    wall = Wall(monkeypatch)
    ours = MavlinkCodec(255, 190, key=KEY)
    ours.encode(attitude())
    wall.now_s += 80
    vehicle = MavlinkCodec(1, 1, key=KEY)
    assert len(vehicle.decode(ours.encode(attitude()))) == 1
    assert len(ours.decode(vehicle.encode(attitude()))) == 1


def test_a_clock_that_was_never_set_signs_and_follows_the_vehicles(monkeypatch: pytest.MonkeyPatch) -> None:
    """1970, as on a computer without a clock; the vehicle has satellite time."""
    wall = Wall(monkeypatch)
    vehicle = MavlinkCodec(1, 1, key=KEY)
    first = vehicle.encode(attitude())
    wall.now_s = 0.0
    ours = MavlinkCodec(255, 190, key=KEY)
    assert vehicle.decode(ours.encode(attitude())) == [], "an old frame"
    assert len(ours.decode(first)) == 1
    assert len(vehicle.decode(ours.encode(attitude()))) == 1


def test_a_signature_is_never_repeated_after_the_clock_goes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = Wall(monkeypatch)
    ours, vehicle = MavlinkCodec(255, 190, key=KEY), MavlinkCodec(1, 1, key=KEY)
    for _ in range(3):
        assert len(vehicle.decode(ours.encode(attitude()))) == 1
        wall.now_s -= 10.0


def test_a_sender_without_the_key_locks_no_one_out() -> None:
    """A forged frame from the far future changes nothing."""
    ours, vehicle = MavlinkCodec(255, 190, key=KEY), MavlinkCodec(1, 1, key=KEY)
    forged = bytearray(vehicle.encode(attitude()))
    forged[-12:-6] = b"\xff" * 6
    assert ours.decode(bytes(forged)) == []
    assert len(ours.decode(vehicle.encode(attitude()))) == 1

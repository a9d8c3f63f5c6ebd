"""CPX packets over TCP, and the AI-deck's images in them."""

from __future__ import annotations

import random
import struct
import zlib
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError, UsageError
from skyloop.vehicles.crazyflie.wire.cpx import (
    MOST_DATA_NEWER,
    Counting,
    Function,
    Packet,
    PacketParser,
    Target,
    encode,
    restart_camera,
)
from skyloop.vehicles.crazyflie.wire.pictures import (
    MOST_BYTES,
    DeckState,
    Format,
    Picture,
    PictureAssembly,
    newer_packets,
    older_packets,
)

targets = st.sampled_from(Target)
packets = st.builds(Packet, targets, targets, st.integers(0, 63), st.binary(max_size=200), st.booleans())


def fed(parser: PacketParser, data: bytes, seed: int) -> list[Packet]:
    """Return what a parser makes of bytes that arrive in pieces of random sizes."""
    chance, got = random.Random(seed), []
    while data:
        size = chance.randint(1, 60)
        got += parser.feed(data[:size])
        data = data[size:]
    return got


@given(st.lists(packets), st.sampled_from(Counting), st.integers(0, 9))
def test_packets_come_back_however_tcp_splits_them(sent: list[Packet], counting: Counting, seed: int) -> None:
    data = b"".join(encode(packet, counting) for packet in sent)
    assert fed(PacketParser(counting), data, seed) == sent


def test_a_packet_has_the_published_layout() -> None:
    packet = Packet(Target.GAP8, Target.HOST, Function.APP, b"ab")
    assert encode(packet) == bytes([4, 0, 1 << 6 | 4 << 3 | 3, 5]) + b"ab"
    assert encode(packet, Counting.DATA) == bytes([2, 0, 1 << 6 | 4 << 3 | 3, 5]) + b"ab"


@pytest.mark.parametrize("function", [Function.APP, Function.STREAMER, Function.CRTP])
def test_the_first_packet_tells_what_lengths_count(function: Function) -> None:
    counting = Counting.DATA if function is Function.STREAMER else Counting.ROUTE_AND_DATA
    sent = [Packet(Target.GAP8, Target.HOST, function, bytes(7)) for _ in range(3)]
    parser = PacketParser()
    assert parser.feed(b"".join(encode(packet, counting) for packet in sent)) == sent
    assert parser.counting is counting


@pytest.mark.parametrize(
    "header",
    [
        (0, 0x63, 5),  # shorter than the route that it counts
        (1, 0x63, 5),
        (MOST_DATA_NEWER + 3, 0x63, 5),
        (0xFFFF, 0x63, 5),
        (13, 0x00, 5),  # from nobody to nobody
        (13, 0x67, 5),  # to an unknown processor
        (13, 0x63, 5 | 1 << 6),  # another version
    ],
)
def test_impossible_headers_are_refused(header: tuple[int, int, int]) -> None:
    with pytest.raises(DecodeError):
        PacketParser().feed(struct.pack("<HBB", *header))


@given(st.binary(max_size=4000), st.integers(0, 9))
def test_whatever_arrives_is_parsed_or_refused_and_little_is_kept(data: bytes, seed: int) -> None:
    parser, assembly = PacketParser(), PictureAssembly()
    try:
        for packet in fed(parser, data, seed):
            assembly.feed(packet)
    except DecodeError:
        return
    assert len(parser._buffer) <= MOST_DATA_NEWER + 4


def test_what_cannot_be_sent_is_refused() -> None:
    with pytest.raises(UsageError):
        encode(Packet(Target.HOST, Target.GAP8, 64, b""))
    with pytest.raises(UsageError):
        encode(Packet(Target.HOST, Target.GAP8, 5, bytes(MOST_DATA_NEWER + 1)))


def test_a_restart_goes_to_the_wifi_chip_then_to_the_bootloader() -> None:
    reset, start = restart_camera()
    assert encode(reset) == bytes([3, 0, 1 << 6 | 3 << 3 | 2, 1, 0x10])
    assert encode(start) == bytes([3, 0, 1 << 6 | 3 << 3 | 4, 15, 0x06])


# Images --------------------------------------------------------------------------------------------------------------


def pixels(count: int, seed: int = 1) -> bytes:
    return random.Random(seed).randbytes(count)


def grey(number: int = 1, width: int = 324, height: int = 244) -> Picture:
    return Picture(width, height, Format.RAW, pixels(width * height, number), number)


def stamped(number: int = 1, state: DeckState | None = None) -> Picture:
    return Picture(162, 162, Format.RAW, pixels(162 * 162, number), number, 1000 * number, state)


def assembled(sent: list[Packet]) -> tuple[list[Picture], PictureAssembly]:
    assembly = PictureAssembly()
    return [picture for packet in sent if (picture := assembly.feed(packet)) is not None], assembly


@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 3))
def test_images_of_the_older_firmware_come_back(width: int, height: int, count: int) -> None:
    sent = [grey(number + 1, width, height) for number in range(count)]
    got, assembly = assembled([packet for picture in sent for packet in older_packets(picture)])
    assert got == sent
    assert (assembly.begun, assembly.broken, assembly.stray) == (count, 0, 0)


def test_an_image_of_the_older_firmware_is_announced_as_bitcrazes_viewer_reads_it() -> None:
    announcement, *parts = older_packets(grey())
    assert struct.unpack("<BHHBBI", announcement.data) == (0xBC, 324, 244, 1, 0, 324 * 244)
    assert {len(part.data) for part in parts[:-1]} == {1020}
    assert sum(len(part.data) for part in parts) == 324 * 244


def test_a_jpeg_comes_back_whatever_its_size() -> None:
    for size in (1, 11, 1019, 1020, 1021, 2040, 9000):
        jpeg = Picture(324, 244, Format.JPEG, pixels(size), 1)
        assert assembled(older_packets(jpeg))[0] == [jpeg]


@given(
    st.tuples(*[st.floats(-32, 32)] * 3),
    st.tuples(*[st.floats(-32, 32)] * 3),
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(e * e for e in q) > 0.1),
    st.booleans(),
)
def test_the_state_beside_an_image_comes_back(
    position: tuple[float, float, float],
    velocity: tuple[float, float, float],
    turned: tuple[float, float, float, float],
    checksum: bool,
) -> None:
    size = sum(element * element for element in turned) ** 0.5
    quaternion = tuple(element / size for element in turned)
    state = DeckState(7, position, velocity, quaternion)
    (got,), assembly = assembled(newer_packets(stamped(1, state), checksum=checksum))
    assert got.data == stamped().data
    assert (got.width, got.height, got.stamp_us, assembly.stray) == (162, 162, 1000, 0)
    assert got.state is not None
    assert got.state.heard_us == 7
    assert got.state.position_m == pytest.approx(position, abs=0.00051)
    if got.state.quaternion is None:
        return  # packed to 0, as by a vehicle that sends no attitude
    assert got.state.velocity_m_s == pytest.approx(velocity, abs=0.00051)
    aligned = abs(sum(one * other for one, other in zip(got.state.quaternion, quaternion, strict=True)))
    assert aligned == pytest.approx(1.0, abs=1e-3)


def test_a_vehicle_that_sends_only_its_position_has_no_velocity() -> None:
    (got,), _ = assembled(newer_packets(stamped(1, DeckState(9, (1.0, -2.0, 0.5)))))
    assert got.state == DeckState(9, (1.0, -2.0, 0.5))


def test_a_deck_that_heard_no_state_sends_none() -> None:
    assert assembled(newer_packets(stamped()))[0][0].state is None


def test_the_metadata_have_the_published_layout() -> None:
    state = DeckState(5, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
    first, *rest = newer_packets(stamped(3, state), checksum=True)
    command, kind, size, crc = struct.unpack_from("<BBII", first.data)
    assert (command, kind, size) == (0x10, 1, 148 + 162 * 162)
    assert all(part.data[0] == 0x11 and len(part.data) % 4 == 0 for part in rest)
    body = b"".join([first.data[12:], *(part.data[4:] for part in rest)])[:size]
    assert zlib.crc32(body) == crc
    assert struct.unpack_from("<BHHBBBII", body) == (10, 162, 162, 1, 0, 3, 3000, 5)
    assert struct.unpack_from("<9hI", body, 20) == (1000, 2000, 3000, 100, 200, 300, 0, 0, 0, 3 << 30)


@pytest.mark.parametrize("make", [older_packets, newer_packets])
@pytest.mark.parametrize("lost", [0, 1, 3, -1])
def test_an_image_with_a_lost_packet_is_left_out_and_the_next_one_is_whole(make: object, lost: int) -> None:
    assert callable(make)
    first, second = (grey(), grey(2)) if make is older_packets else (stamped(), stamped(2))
    damaged = make(first)
    del damaged[lost]
    got, assembly = assembled([*damaged, *make(second)])
    assert [picture.data for picture in got] == [second.data]
    assert (assembly.broken, assembly.stray > 0) == ((0, True) if lost == 0 else (1, False))


def test_a_wrong_checksum_is_noticed() -> None:
    sent = newer_packets(stamped(), checksum=True)
    sent[2] = replace(sent[2], data=sent[2].data[:-4] + bytes(4))
    got, assembly = assembled(sent)
    assert (got, assembly.broken) == ([], 1)


@pytest.mark.parametrize(
    "announced",
    [
        (0xBC, 0, 244, 1, 0, 0),
        (0xBC, 324, 244, 1, 0, 324 * 244 + 1),
        (0xBC, 324, 2000, 1, 0, 324 * 2000),
        (0xBC, 324, 244, 1, 1, 0),
        (0xBC, 324, 244, 1, 1, 0xFFFFFFFF),
        (0xBC, 324, 244, 1, 7, MOST_BYTES + 1),
    ],
)
def test_impossible_announcements_are_counted_and_skipped(announced: tuple[int, ...]) -> None:
    bad = Packet(Target.GAP8, Target.HOST, Function.APP, struct.pack("<BHHBBI", *announced))
    got, assembly = assembled([bad, *older_packets(grey())])
    assert ([picture.data for picture in got], assembly.broken) == ([grey().data], 1)


@pytest.mark.parametrize(("at", "value"), [(1, 0), (5, 2), (1, 161)])
def test_impossible_metadata_are_counted_and_skipped(at: int, value: int) -> None:
    first, *rest = newer_packets(stamped())
    damaged = bytearray(first.data)
    damaged[12 + at] = value
    got, assembly = assembled([replace(first, data=bytes(damaged)), *rest, *newer_packets(stamped(2))])
    assert ([picture.data for picture in got], assembly.broken) == ([stamped(2).data], 1)


def test_an_unknown_version_is_returned_without_pixels() -> None:
    (got,), _ = assembled(newer_packets(replace(stamped(), version=11)))
    assert (got.version, got.data) == (11, b"")

"""CRTP packets: both ways, and byte by byte what Bitcraze's own library sends."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import fields

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.vehicles.crazyflie.wire import commander as wire
from skyloop.vehicles.crazyflie.wire import contents
from skyloop.vehicles.crazyflie.wire.contents import ContentsInfo, Entry, LogCommand, LogRequest, MiscMessage, ValueType
from skyloop.vehicles.crazyflie.wire.crtp import (
    MAX_DATA,
    NEWEST_PROTOCOL,
    OLDEST_PROTOCOL,
    CrtpPacket,
    CrtpPort,
    with_checksum,
    without_checksum,
)

FLOAT = st.floats(width=32, allow_nan=False, allow_infinity=False)
BYTE = st.integers(0, 255)
SHORT = st.integers(-32768, 32767)
PROTOCOL = st.integers(OLDEST_PROTOCOL, NEWEST_PROTOCOL)
NAME = st.text("abcdefghijklmnopqrstuvwxyzABC_0123456789", min_size=1, max_size=10)
PACKET = st.builds(CrtpPacket, st.integers(0, 15), st.integers(0, 3), st.binary(max_size=MAX_DATA))
KINDS = {type_ for type_, _ in wire._BY_NUMBER.values()}


def _value(kind: type[wire.Message], name: str) -> st.SearchStrategy[object]:
    """Return values for a field by the letter for it in the newest layout."""
    form = kind.LAYOUTS[0].form
    letters = "".join(c * int(n or 1) for n, c in _groups(form))
    letter = letters[[field.name for field in fields(kind)].index(name)]
    table = {"f": FLOAT, "?": st.booleans(), "B": BYTE, "h": SHORT, "H": st.integers(0, 65535)}
    return table.get(letter, st.integers(0, 2**32 - 1))  # type: ignore[return-value]


def _groups(form: str) -> list[tuple[str, str]]:
    groups, number = [], ""
    for c in form:
        if c.isdigit():
            number += c
        else:
            groups.append((number, c))
            number = ""
    return groups


MESSAGE = st.sampled_from(sorted(KINDS, key=lambda kind: kind.__name__)).flatmap(
    lambda kind: st.builds(kind, **{field.name: _value(kind, field.name) for field in fields(kind)})  # type: ignore[arg-type]
)


@given(PACKET)
def test_packets(packet: CrtpPacket) -> None:
    assert CrtpPacket.decode(packet.encode()) == packet
    assert without_checksum(with_checksum(packet.encode())) == packet.encode()


@pytest.mark.parametrize("data", [b"", b"\xff" * 33])
def test_packets_of_no_length_are_refused(data: bytes) -> None:
    with pytest.raises(DecodeError):
        CrtpPacket.decode(data)


def test_a_damaged_packet_fails_its_checksum() -> None:
    good = with_checksum(b"\x3c\x01\x02")
    assert good == b"\x3c\x01\x02\x3f"
    for bad in (good[:-1] + b"\x40", good[:2], b"\x3c", b""):
        with pytest.raises(DecodeError):
            without_checksum(bad)


@given(MESSAGE, PROTOCOL)
def test_messages(message: wire.Message, protocol: int) -> None:
    """What is sent is what is read, in every version; a field that a layout lacks is read as false."""
    read = wire.decode_message(message.encode(protocol))
    layout = next(known for known in message.LAYOUTS if known.since <= protocol)
    assert type(read) is type(message)
    for field in fields(message):
        expected = False if field.name in layout.without else getattr(message, field.name)
        assert getattr(read, field.name) == expected


@given(PACKET)
def test_any_packet_is_read_or_refused(packet: CrtpPacket) -> None:
    readers = (
        wire.decode_message,
        wire.decode_packed_poses,
        wire.decode_version_answer,
        wire.decode_supervisor_answer,
        contents.decode_contents,
        contents.decode_question,
        contents.decode_log_answer,
        contents.decode_log_data,
        contents.decode_parameter,
        contents.decode_read_answer,
        contents.decode_set_by_name,
        LogRequest.decode,
        MiscMessage.decode,
    )
    for read in readers:
        with suppress(DecodeError):
            read(packet)


# As cflib 0.1.34 sends them: (protocol, message, port, channel, data)
SEEN: list[tuple[int, wire.Message, int, int, str]] = [
    (7, wire.RollPitchThrust(1, -2, -3, 10000), 3, 0, "0000803f000000c0000040401027"),
    (7, wire.NotifySetpointsStop(500), 7, 1, "00f4010000"),
    (7, wire.StopSetpoint(), 7, 0, "00"),
    (8, wire.VelocityWorldSetpoint(1, 2, 3, 4), 7, 0, "010000803f0000004000004040000080c0"),
    (9, wire.VelocityWorldSetpoint(1, 2, 3, 4), 7, 0, "080000803f000000400000404000008040"),
    (8, wire.ZDistanceSetpoint(1, 2, 3, 4), 7, 0, "020000803f00000040000040c000008040"),
    (9, wire.ZDistanceSetpoint(1, 2, 3, 4), 7, 0, "090000803f000000400000404000008040"),
    (8, wire.HoverSetpoint(1, 2, 3, 4), 7, 0, "050000803f00000040000040c000008040"),
    (9, wire.HoverSetpoint(1, 2, 3, 4), 7, 0, "0a0000803f000000400000404000008040"),
    (7, wire.PositionSetpoint(1, 2, 3, 4), 7, 0, "070000803f000000400000404000008040"),
    (7, wire.SetGroupMask(3), 8, 0, "0003"),
    (7, wire.HighLevelTakeoff(0, 1, 0, True, 2), 8, 0, "07000000803f000000000100000040"),
    (7, wire.HighLevelLand(0, 0, 0, False, 2), 8, 0, "080000000000000000000000000040"),
    (7, wire.HighLevelStop(), 8, 0, "0300"),
    (7, wire.GoTo(0, True, False, 1, 2, 3, 4, 5), 8, 0, "0400010000803f0000004000004040000080400000a040"),
    (8, wire.GoTo(0, False, True, 1, 2, 3, 4, 5), 8, 0, "0c0000010000803f0000004000004040000080400000a040"),
    (8, wire.Spiral(0, False, False, 1, 2, 3, 4, 5), 8, 0, "0b0000000000803f0000004000004040000080400000a040"),
    (9, wire.StartTrajectory(0, True, False, False, 1, 2), 8, 0, "050001000100000040"),
    (10, wire.StartTrajectory(0, True, True, False, 1, 2), 8, 0, "0d000101000100000040"),
    (7, wire.DefineTrajectory(1, 1, 0, 0, 4), 8, 0, "060101000000000004"),
    (7, wire.ExternalPosition(1, 2, 3), 6, 0, "0000803f0000004000004040"),
    (
        7,
        wire.ExternalPoseMessage(1, 2, 3, 0, 0, 0, 1),
        6,
        1,
        "080000803f00000040000040400000000000000000000000000000803f",
    ),
    (11, wire.EmergencyStopMessage(), 6, 1, "03"),
    (12, wire.EmergencyStopMessage(), 9, 1, "03"),
    (11, wire.EmergencyWatchdog(), 6, 1, "04"),
    (
        7,
        wire.FullStateSetpoint(
            1000, 2000, 3000, 4000, 5000, 6000, 7000, 8000, 9000, wire.compressed((0, 0, 0, 1)), 1000, 2000, 3000
        ),
        7,
        0,
        "06e803d007b80ba00f88137017581b401f2823000000c0e803d007b80b",
    ),
]


@pytest.mark.parametrize("case", SEEN, ids=lambda case: f"{type(case[1]).__name__}-{case[0]}")
def test_messages_are_those_of_bitcrazes_library(case: tuple[int, wire.Message, int, int, str]) -> None:
    protocol, message, port, channel, data = case
    assert message.encode(protocol) == CrtpPacket(port, channel, bytes.fromhex(data))


@pytest.mark.parametrize(
    ("quaternion", "packed"),
    [
        ((0.0, 0.0, 0.0, 1.0), 0xC0000000),
        ((1.0, 0.0, 0.0, 0.0), 0x00000000),
        ((0.5, 0.5, 0.5, 0.5), 0x1695A569),
        ((-0.5, 0.5, -0.5, 0.5), 0x3695A769),
        ((0.1, -0.2, 0.3, -0.9273618), 0xE48246D9),
    ],
)
def test_quaternions_are_those_of_bitcrazes_library(quaternion: tuple[float, ...], packed: int) -> None:
    assert wire.compressed(quaternion) == packed


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.01))
def test_quaternions(parts: tuple[float, ...]) -> None:
    quaternion = [part / math.hypot(*parts) for part in parts]
    read = wire.decompressed(wire.compressed(quaternion))
    # The opposite quaternion is the same rotation.
    assert abs(sum(a * b for a, b in zip(quaternion, read, strict=True))) > 0.9999


@given(st.lists(st.tuples(BYTE, st.tuples(*[st.floats(-30, 30)] * 3)), max_size=2))
def test_packed_poses(rows: list[tuple[int, tuple[float, float, float]]]) -> None:
    packet = wire.packed_poses([(number, place, (0.0, 0.0, 0.0, 1.0)) for number, place in rows])
    read = wire.decode_packed_poses(packet)
    assert [number for number, _, _ in read] == [number for number, _ in rows]
    for (_, place, _), (_, expected) in zip(read, rows, strict=True):
        assert place == pytest.approx(expected, abs=0.0006)


ENTRY = st.builds(
    Entry, st.integers(0, 65535), NAME, NAME, st.sampled_from(sorted(ValueType)), st.booleans(), st.booleans()
)
LOGGED = sorted(contents._LOG_NUMBERS)


@given(ENTRY)
def test_entries_of_parameters(entry: Entry) -> None:
    packet = contents.answer_item(CrtpPort.PARAMETERS, entry)
    assert contents.decode_contents(CrtpPacket.decode(packet.encode())) == entry


@given(ENTRY, st.sampled_from(LOGGED))
def test_entries_of_the_log(entry: Entry, type_: ValueType) -> None:
    entry = Entry(entry.number, entry.group, entry.name, type_)
    assert contents.decode_contents(contents.answer_item(CrtpPort.LOG, entry)) == entry


@given(st.integers(0, 65535), st.integers(0, 2**32 - 1), BYTE, BYTE)
def test_info(count: int, crc: int, blocks: int, variables: int) -> None:
    info = ContentsInfo(count, crc, blocks, variables)
    assert contents.decode_contents(contents.answer_info(CrtpPort.LOG, info)) == info
    short = contents.decode_contents(contents.answer_info(CrtpPort.PARAMETERS, info))
    assert short == ContentsInfo(count, crc)


def test_questions() -> None:
    assert contents.decode_question(contents.ask_info(CrtpPort.LOG)) is None
    assert contents.decode_question(contents.ask_item(CrtpPort.LOG, 300)) == 300
    assert contents.decode_contents(contents.answer_item(CrtpPort.LOG, None)) is None


@given(st.lists(st.sampled_from(LOGGED), min_size=1, max_size=40))
def test_log_blocks(types: list[ValueType]) -> None:
    """Blocks hold at most 26 bytes, keep the order, and are requested with packets that fit."""
    entries = [Entry(number, "g", f"n{number}", type_) for number, type_ in enumerate(types)]
    blocks = contents.blocks_of(entries)
    assert [entry for block in blocks for entry in block] == entries
    for block in blocks:
        assert sum(entry.type.size for entry in block) <= contents.MAX_LOGGED
        requests = contents.create_block(5, block)
        read = [LogRequest.decode(CrtpPacket.decode(request.encode().encode())) for request in requests]
        assert read == requests
        assert all(len(request.encode().data) <= 30 for request in requests)
        assert [number for request in read for number, _ in request.variables] == [entry.number for entry in block]


@given(st.sampled_from(LogCommand), BYTE, st.integers(1, 255))
def test_log_requests(command: LogCommand, block: int, period: int) -> None:
    request = LogRequest(command, 0 if command is LogCommand.RESET else block)
    if command is LogCommand.START:
        request = LogRequest(command, block, period_ms=10 * period)
    assert LogRequest.decode(request.encode()) == request
    assert contents.decode_log_answer(contents.answer_log(request, 7)) == (command, request.block, 7)


@given(BYTE, st.integers(0, 2**24 - 1), st.floats(width=32, allow_nan=False), st.integers(0, 65535))
def test_log_data(block: int, time_ms: int, first: float, second: int) -> None:
    entries = [Entry(1, "a", "b", ValueType.FLOAT), Entry(2, "a", "c", ValueType.UINT16)]
    values = ValueType.FLOAT.encode(first) + ValueType.UINT16.encode(second)
    read = contents.decode_log_data(contents.log_data(block, time_ms, values))
    assert read == (block, time_ms, values)
    assert contents.decode_values(entries, read[2]) == {"a.b": first, "a.c": second}


@given(st.sampled_from(sorted(ValueType)), st.data())
def test_values(type_: ValueType, data: st.DataObject) -> None:
    low, high = type_.limits
    value = data.draw(FLOAT.filter(lambda v: abs(v) < 6e4) if type_.is_float else st.integers(int(low), int(high)))
    read = type_.decode(type_.encode(value))
    assert read == (pytest.approx(value, rel=1e-3, abs=1e-7) if type_.is_float else value)


def test_values_that_do_not_fit_are_refused() -> None:
    for type_, value in ((ValueType.UINT8, 256), (ValueType.INT8, -129), (ValueType.UINT32, -1)):
        with pytest.raises(ValueError, match=type_.name.lower()):
            type_.encode(value)
    with pytest.raises(DecodeError):
        ValueType.FLOAT.decode(b"\0\0\0")


@given(st.integers(0, 65535), st.binary(max_size=8))
def test_parameters(number: int, value: bytes) -> None:
    assert contents.decode_parameter(contents.write_parameter(number, value)) == (number, value)
    assert contents.decode_parameter(contents.read_parameter(number)) == (number, b"")
    assert contents.decode_read_answer(contents.answer_read(number, value, 2)) == (number, 2, value)
    for command in contents.MiscCommand:
        message = MiscMessage(command, number, value)
        assert MiscMessage.decode(message.encode()) == message


def test_parameters_by_name() -> None:
    packet = contents.set_by_name("pm", "lowVoltage", ValueType.FLOAT, 3.0)
    assert contents.decode_set_by_name(packet) == ("pm", "lowVoltage", ValueType.FLOAT, ValueType.FLOAT.encode(3.0))


def test_versions_and_supervisor() -> None:
    assert wire.decode_version_answer(wire.answer_version(wire.VersionQuery.PROTOCOL, 7))[1] == 7
    assert wire.decode_version_answer(wire.answer_version(wire.VersionQuery.DEVICE, "CF21"))[2] == "CF21"
    bits = wire.Supervisor.IS_ARMED | wire.Supervisor.IS_FLYING
    assert wire.decode_supervisor_answer(wire.answer_supervisor(wire.GET_BITFIELD, bits)) == bits
    assert wire.answer_supervisor(2, bits).data == b"\x82\x01"
    assert wire.answer_arm(wire.Arm(True).encode(12), success=True, armed=True).data == b"\x81\x01\x01"
    assert wire.answer_arm(wire.Arm(True).encode(7), success=True, armed=True).data == b"\x01\x01\x01"


def test_only_finite_messages_are_sent() -> None:
    assert wire.is_finite(wire.HoverSetpoint(0, 0, 0, 1))
    assert not wire.is_finite(wire.HoverSetpoint(0, math.nan, 0, 1))

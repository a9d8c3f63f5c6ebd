"""The emulated Crazyflie's answers: tables, log blocks, parameters, memories, versions, and anything else."""

from __future__ import annotations

import struct
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.vehicles.crazyflie.emulator.tables import LOG_ROWS, PARAMETER_ROWS
from skyloop.vehicles.crazyflie.wire import contents
from skyloop.vehicles.crazyflie.wire.commander import Supervisor
from skyloop.vehicles.crazyflie.wire.contents import LogCommand, LogRequest, ValueType
from skyloop.vehicles.crazyflie.wire.crtp import CrtpPacket, CrtpPort
from tests.vehicles.crazyflie.emulator.bench import Bench

LOG, PARAMETERS, MEMORY = CrtpPort.LOG, CrtpPort.PARAMETERS, CrtpPort.MEMORY
LOGGED = {row.entry.full_name: row.entry for row in LOG_ROWS}
KNOWN = {row.entry.full_name: row.entry for row in PARAMETER_ROWS}


@pytest.fixture
def bench() -> Bench:
    return Bench()


def blocks(bench: Bench) -> list[tuple[int, int, bytes]]:
    sent = [packet for packet in bench.sent if packet.port == LOG]
    return [contents.decode_log_data(packet) for packet in sent]


@pytest.mark.parametrize(("port", "table"), [(LOG, LOG_ROWS), (PARAMETERS, PARAMETER_ROWS)])
def test_tables_of_contents(bench: Bench, port: CrtpPort, table: tuple[object, ...]) -> None:
    (answer,) = bench.logic.receive(contents.ask_info(port))
    info = contents.decode_contents(answer)
    assert isinstance(info, contents.ContentsInfo)
    assert info.count == len(table)
    entries = []
    for number in range(info.count):
        (answer,) = bench.logic.receive(contents.ask_item(port, number))
        assert len(answer.encode()) <= 32
        entry = contents.decode_contents(answer)
        assert isinstance(entry, contents.Entry)
        entries.append(entry)
    assert entries == [row.entry for row in (LOG_ROWS if port is LOG else PARAMETER_ROWS)]
    assert len({entry.full_name for entry in entries}) == info.count
    (answer,) = bench.logic.receive(contents.ask_item(port, info.count))
    assert contents.decode_contents(answer) is None


def test_log_blocks_arrive_at_their_periods_as_the_types_asked_for(bench: Bench) -> None:
    height, battery = LOGGED["stateEstimate.z"], LOGGED["pm.vbat"]
    create = LogRequest(LogCommand.CREATE, 3, ((height.number, ValueType.FLOAT), (battery.number, ValueType.HALF)))
    for request in (create, LogRequest(LogCommand.START, 3, period_ms=100)):
        (answer,) = bench.logic.receive(request.encode())
        assert contents.decode_log_answer(answer) == (request.command, 3, 0)
    bench.run(2.0)
    received = blocks(bench)
    assert 19 <= len(received) <= 21
    assert {block for block, _, _ in received} == {3}
    assert [b - a for (_, a, _), (_, b, _) in pairwise(received)] == [pytest.approx(100, abs=12) for _ in received[1:]]
    z, volts = struct.unpack("<fe", received[-1][2])
    assert z == pytest.approx(bench.place[2], abs=0.02)
    assert 3.9 < volts < 4.3
    bench.logic.receive(LogRequest(LogCommand.STOP, 3).encode())
    bench.run(1.0)
    assert len(blocks(bench)) == len(received)


def test_log_blocks_that_cannot_be(bench: Bench) -> None:
    float_, number = ValueType.FLOAT, LOGGED["gyro.x"].number

    def result(request: LogRequest) -> int:
        (answer,) = bench.logic.receive(request.encode())
        return contents.decode_log_answer(answer)[2]

    assert result(LogRequest(LogCommand.START, 1, period_ms=10)) == contents.CrtpError.NO_ENTRY
    assert result(LogRequest(LogCommand.CREATE, 1, ((9999, float_),))) == contents.CrtpError.NO_ENTRY
    assert result(LogRequest(LogCommand.CREATE, 1)) == contents.CrtpError.EXISTS
    assert result(LogRequest(LogCommand.APPEND, 1, ((number, float_),) * 7)) == contents.CrtpError.TOO_BIG
    assert result(LogRequest(LogCommand.DELETE, 1)) == 0
    assert result(LogRequest(LogCommand.CREATE, 1)) == 0
    assert result(LogRequest(LogCommand.RESET)) == 0
    assert [result(LogRequest(LogCommand.CREATE, block)) for block in range(17)] == [0] * 16 + [12]
    assert bench.ask(LOG, 1, "BB", 0x63, 1) == bytes((0x63, 1, 8))


def test_ranges_in_millimetres(bench: Bench) -> None:
    variables = tuple((LOGGED[f"range.{name}"].number, ValueType.UINT16) for name in ("front", "up", "back"))
    bench.logic.receive(LogRequest(LogCommand.CREATE, 0, variables).encode())
    bench.logic.receive(LogRequest(LogCommand.START, 0, period_ms=10).encode())
    bench.run(0.1)
    assert struct.unpack("<3H", blocks(bench)[-1][2]) == (1500, 32767, 0)


def test_parameters_are_read_and_written(bench: Bench) -> None:
    gain = KNOWN["pid_attitude.pitch_kd"].number
    assert bench.ask(PARAMETERS, 1, "H", gain) == struct.pack("<HBf", gain, 0, 0.0)
    assert bench.ask(PARAMETERS, 2, "Hf", gain, 0.25) == struct.pack("<Hf", gain, 0.25)
    assert bench.ask(PARAMETERS, 1, "H", gain) == struct.pack("<HBf", gain, 0, 0.25)
    assert bench.ask(PARAMETERS, 1, "H", 9999) == struct.pack("<HB", 9999, 2)
    deck = KNOWN["deck.bcFlow2"].number
    assert bench.logic.receive(contents.write_parameter(deck, b"\0")) == []  # read only
    assert bench.logic.parameter("deck.bcFlow2") == 1
    (answer,) = bench.logic.receive(contents.set_by_name("ring", "effect", ValueType.UINT8, 7))
    assert answer.data[-1] == 0
    assert bench.logic.parameter("ring.effect") == 7
    (answer,) = bench.logic.receive(contents.set_by_name("ring", "effect", ValueType.FLOAT, 7))
    assert answer.data[-1] == contents.CrtpError.INVALID


def test_persistent_parameters_survive_a_restart(bench: Bench) -> None:
    effect, heading = KNOWN["ring.effect"].number, KNOWN["kalman.initialYaw"].number
    assert bench.ask(PARAMETERS, 3, "BH", 2, effect)[3:] == b"\1"
    assert bench.ask(PARAMETERS, 3, "BH", 2, heading)[3:] == b"\2"
    assert bench.ask(PARAMETERS, 3, "BH", 3, heading)[3:] == b"\2"
    assert bench.ask(PARAMETERS, 3, "BH", 4, effect)[3:] == b"\0\6"
    bench.ask(PARAMETERS, 2, "HB", effect, 9)
    assert bench.ask(PARAMETERS, 3, "BH", 3, effect)[3:] == b"\0"
    bench.ask(PARAMETERS, 2, "HB", effect, 4)
    bench.restart()
    assert bench.ask(PARAMETERS, 1, "H", effect)[3:] == b"\x09"
    assert bench.ask(PARAMETERS, 3, "BH", 4, effect)[3:] == b"\1\6\x09"
    assert bench.ask(PARAMETERS, 3, "BH", 6, effect)[3:] == b"\6"
    bench.ask(PARAMETERS, 3, "BH", 5, effect)
    bench.restart()
    assert bench.ask(PARAMETERS, 1, "H", effect)[3:] == b"\6"


def test_memories(bench: Bench) -> None:
    assert bench.ask(MEMORY, 0, "B", 1) == b"\1\2"
    assert bench.ask(MEMORY, 0, "BB", 2, 0) == struct.pack("<BBBIQ", 2, 0, 0x12, 4096, 0)
    assert bench.ask(MEMORY, 0, "BB", 2, 7) == b"\2\7"
    assert bench.ask(MEMORY, 2, "BI4s", 0, 4092, b"abcd") == struct.pack("<BIB", 0, 4092, 0)
    assert bench.ask(MEMORY, 1, "BIB", 0, 4090, 6)[6:] == b"\0\0abcd"
    assert bench.ask(MEMORY, 2, "BI4s", 0, 4093, b"abcd")[5] != 0
    assert bench.ask(MEMORY, 1, "BIB", 5, 0, 4)[5] != 0


def test_versions_and_the_link(bench: Bench) -> None:
    assert bench.ask(CrtpPort.PLATFORM, 1, "B", 0) == b"\0\x0c"
    assert bench.ask(CrtpPort.PLATFORM, 1, "B", 2).startswith(b"\2CF21")
    assert bench.ask(CrtpPort.LINK, 0, "3s", b"abc") == b"abc"
    assert bench.ask(CrtpPort.LINK, 1, "").startswith(b"Bitcraze Crazyflie\0")
    assert bench.logic.receive(CrtpPacket(CrtpPort.LINK, 2, b"x")) == []
    assert bench.logic.receive(CrtpPacket(CrtpPort.LINK, 3, b"x")) == []
    bits = struct.unpack("<H", bench.ask(CrtpPort.SUPERVISOR, 0, "B", 0x0C)[1:])[0]
    assert bits & Supervisor.CAN_FLY
    assert not bits & Supervisor.IS_FLYING
    assert b"up and running" in b"".join(packet.data for packet in bench.sent if packet.port == CrtpPort.CONSOLE)


@given(st.lists(st.tuples(st.integers(0, 15), st.integers(0, 3), st.binary(max_size=31)), max_size=20))
def test_no_packet_breaks_it(packets: list[tuple[int, int, bytes]]) -> None:
    bench = Bench()
    for port, channel, data in packets:
        for answer in bench.logic.receive(CrtpPacket(port, channel, data)):
            assert len(answer.encode()) <= 32
    bench.tick()

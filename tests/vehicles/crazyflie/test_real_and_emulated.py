"""The emulated firmware answers each request as the real one does, where ``SKYLOOP_CRAZYFLIE`` names its program.

``docs/crazyflie.md`` lists what differs.
"""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from skyloop.drivers.uri import parse_uri
from skyloop.sim.host import Report, SimHost
from skyloop.sim.reports import Occurrence
from skyloop.vehicles.crazyflie.wire import commander as wire
from skyloop.vehicles.crazyflie.wire import contents, crtp
from skyloop.vehicles.crazyflie.wire.contents import ContentsInfo, Entry, LogCommand, LogRequest, ValueType
from skyloop.vehicles.crazyflie.wire.crtp import CrtpPacket, CrtpPort
from skyloop.vehicles.sim.firmware.crazyflie import Crazyflie
from skyloop.vehicles.sim.firmware.program import FirmwareEventKind
from skyloop.vehicles.sim.options import options_of
from tests.vehicles.crazyflie.emulator.bench import Bench

PROGRAM = os.environ.get("SKYLOOP_CRAZYFLIE", "")
ANSWERS_WITHIN_S = 10.0
QUIET_S = 0.4  # a request without an answer

Ask = Callable[[CrtpPacket], list[bytes]]

pytestmark = [
    pytest.mark.process,
    pytest.mark.timeout(180),
    pytest.mark.skipif(not PROGRAM, reason="SKYLOOP_CRAZYFLIE names no program"),
]


def _answers(answer: CrtpPacket, request: CrtpPacket) -> bool:
    """Return whether this is the answer to a request, and not a late one to another: it begins in the same way."""
    place = request.port, request.channel
    shared = {(CrtpPort.LINK, crtp.SOURCE): 0, (CrtpPort.LOG, crtp.CONTROL): 2, (CrtpPort.PARAMETERS, crtp.WRITE): 2}
    same = shared.get((CrtpPort(request.port), request.channel), 3)
    length = min(same, len(request.data), len(answer.data))
    return (answer.port, answer.channel) == place and answer.data[:length] == request.data[:length]


class Real:
    """The real firmware in a separate world."""

    def __init__(self) -> None:
        started = threading.Event()
        self._host = SimHost(options_of(parse_uri("sim://?autopilot=crazyflie&world=empty&cameras=none&wind=0")))
        self._firmware = Crazyflie(lambda event: started.set() if event.kind is FirmwareEventKind.ANSWERS else None)
        self._firmware.start()
        self._host.simulation.fly_by(0, self._firmware)
        self._host.attach(0, self, None, [])  # type: ignore[arg-type]
        assert started.wait(60.0), "the real firmware does not answer"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        host, _, port = self._firmware.address.rpartition(":")
        self._socket.connect((host.rpartition("/")[2].removeprefix("crazyflie:").removeprefix("udp:"), int(port)))

    def ask(self, packet: CrtpPacket, within_s: float = QUIET_S) -> list[bytes]:
        """Return the data of the answer; nothing if there is none in time. The firmware may lose requests."""
        until_s = time.monotonic() + within_s
        while (left_s := until_s - time.monotonic()) > 0:
            self._socket.send(packet.encode())
            again_s = time.monotonic() + min(left_s, QUIET_S)
            while (left_s := again_s - time.monotonic()) > 0:
                self._socket.settimeout(left_s)
                try:
                    answer = CrtpPacket.decode(self._socket.recv(64))
                except TimeoutError:
                    break
                if _answers(answer, packet):
                    return [answer.data]
        return []

    def close(self) -> None:
        self._socket.close()
        self._host.detach(0, self)
        self._host.simulation.release(0)
        self._firmware.close()

    # Called by the world -----------------------------------------------------------------------------------------

    def report(self, report: Report) -> None: ...

    def happened(self, occurrence: Occurrence) -> None: ...

    def wanted_fps(self, camera: str) -> float:
        return 0.0

    def failed(self, error: Exception) -> None:
        raise error


@pytest.fixture(scope="module")
def real() -> Iterator[Real]:
    made = Real()
    yield made
    made.close()


@pytest.fixture
def bench() -> Bench:
    return Bench(protocol=7)


def both(real: Real, bench: Bench, packet: CrtpPacket, *, answered: bool = True) -> tuple[list[bytes], list[bytes]]:
    return (
        real.ask(packet, ANSWERS_WITHIN_S if answered else QUIET_S),
        [answer.data for answer in bench.logic.receive(packet)],
    )


def table(ask: Ask, port: CrtpPort) -> dict[str, Entry]:
    info = contents.decode_contents(CrtpPacket(port, crtp.CONTENTS, ask(contents.ask_info(port))[0]))
    assert isinstance(info, ContentsInfo)
    found = {}
    for number in range(info.count):
        data = ask(contents.ask_item(port, number))
        entry = contents.decode_contents(CrtpPacket(port, crtp.CONTENTS, data[0]))
        assert isinstance(entry, Entry)
        found[entry.full_name] = entry
    return found


@pytest.mark.parametrize("port", [CrtpPort.LOG, CrtpPort.PARAMETERS], ids=str)
def test_what_both_have_has_the_same_type_and_flags(real: Real, bench: Bench, port: CrtpPort) -> None:
    theirs = table(lambda packet: real.ask(packet, ANSWERS_WITHIN_S), port)
    ours = table(lambda packet: [answer.data for answer in bench.logic.receive(packet)], port)
    common = theirs.keys() & ours.keys()
    assert len(common) > 100
    for name in common:
        a, b = theirs[name], ours[name]
        assert (a.type, a.read_only, a.extended) == (b.type, b.read_only, b.extended), name


REQUESTS = {
    "echo": CrtpPacket(CrtpPort.LINK, crtp.ECHO, b"abc"),
    "source": CrtpPacket(CrtpPort.LINK, crtp.SOURCE, b"\0"),
    "no log variable": contents.ask_item(CrtpPort.LOG, 9999),
    "no parameter": contents.ask_item(CrtpPort.PARAMETERS, 9999),
    "read no parameter": contents.read_parameter(9999),
    "write no parameter": contents.write_parameter(9999, b"\1"),
    "set no parameter by name": contents.set_by_name("no", "such", ValueType.UINT8, 1),
    "set a parameter by name": contents.set_by_name("commander", "enHighLevel", ValueType.UINT8, 0),
    "start no block": LogRequest(LogCommand.START, 9, period_ms=100).encode(),
    "append to no block": LogRequest(LogCommand.APPEND, 9, ((0, ValueType.FLOAT),)).encode(),
    "stop no block": LogRequest(LogCommand.STOP, 9).encode(),
    "delete no block": LogRequest(LogCommand.DELETE, 9).encode(),
    "unknown log request": CrtpPacket(CrtpPort.LOG, crtp.CONTROL, b"\x63\1"),
    "number of memories": CrtpPacket(CrtpPort.MEMORY, crtp.MEMORY_INFO, b"\1"),
    "memory for trajectories": CrtpPacket(CrtpPort.MEMORY, crtp.MEMORY_INFO, b"\2\0"),
    "memory for tests": CrtpPacket(CrtpPort.MEMORY, crtp.MEMORY_INFO, b"\2\1"),
    "write a memory": CrtpPacket(CrtpPort.MEMORY, crtp.MEMORY_WRITE, struct.pack("<BI4s", 0, 8, b"abcd")),
    "read a memory": CrtpPacket(CrtpPort.MEMORY, crtp.MEMORY_READ, struct.pack("<BIB", 0, 8, 4)),
    "write beyond a memory": CrtpPacket(CrtpPort.MEMORY, crtp.MEMORY_WRITE, struct.pack("<BI4s", 0, 4094, b"abcd")),
    "group mask": wire.SetGroupMask(0).encode(7),
    "define a trajectory": wire.DefineTrajectory(1, 1, 0, 0, 1).encode(7),
    "start no trajectory": wire.StartTrajectory(0, True, False, False, 9, 1.0).encode(7),
    "newer go_to": wire.GoTo(0, False, True, 0.0, 0.0, 1.0, 0.0, 1.0).encode(12),
    "spiral": wire.Spiral(0, False, False, 1.0, 1.0, 1.0, 0.0, 1.0).encode(12),
    "high-level stop": wire.HighLevelStop().encode(7),
}
UNANSWERED = {
    "sink": CrtpPacket(CrtpPort.LINK, crtp.SINK, b"abc"),
    "position from outside": wire.ExternalPosition(0.0, 0.0, 0.0).encode(7),
    "notify": wire.NotifySetpointsStop().encode(7),
    "newer supervisor": wire.ask_supervisor(),
}


@pytest.mark.parametrize("name", REQUESTS)
def test_answers(real: Real, bench: Bench, name: str) -> None:
    if name == "read a memory":
        both(real, bench, REQUESTS["write a memory"])
    theirs, ours = both(real, bench, REQUESTS[name])
    assert theirs
    if REQUESTS[name].port == CrtpPort.HIGH_LEVEL and len(REQUESTS[name].data) < 3:
        theirs, ours = (
            [answer[:2] + answer[3:] for answer in answers] for answers in (theirs, ours)
        )  # the rest is old
    assert theirs == ours


@pytest.mark.parametrize("name", UNANSWERED)
def test_unanswered(real: Real, bench: Bench, name: str) -> None:
    theirs, ours = both(real, bench, UNANSWERED[name], answered=False)
    assert theirs == ours == []


def test_parameters(real: Real, bench: Bench) -> None:
    theirs = table(lambda packet: real.ask(packet, ANSWERS_WITHIN_S), CrtpPort.PARAMETERS)
    ours = table(lambda packet: [answer.data for answer in bench.logic.receive(packet)], CrtpPort.PARAMETERS)

    def of(
        name: str, make: Callable[[int], CrtpPacket], within_s: float = ANSWERS_WITHIN_S
    ) -> tuple[list[bytes], list[bytes]]:
        answers = (
            real.ask(make(theirs[name].number), within_s),
            [answer.data for answer in bench.logic.receive(make(ours[name].number))],
        )
        return [each[2:] for each in answers[0]], [each[2:] for each in answers[1]]

    for name in sorted(theirs.keys() & ours.keys() - {"kalman.resetEstimation"}):
        a, b = of(name, contents.read_parameter)
        assert a == b, name
    a, b = of("pid_attitude.pitch_kd", lambda number: contents.write_parameter(number, struct.pack("<f", 0.25)))
    assert a == b == [struct.pack("<f", 0.25)]
    a, b = of("system.selftestPassed", lambda number: contents.write_parameter(number, b"\1"), QUIET_S)
    assert a == b == []  # read only
    for name in ("pid_attitude.pitch_kd", "kalman.initialX"):
        for command in (contents.MiscCommand.GET_EXTENDED_TYPE,):
            a, b = of(name, lambda number, command=command: contents.MiscMessage(command, number).encode())
            assert [each[1:] for each in a] == [each[1:] for each in b], (name, command)

"""A flight controller on a serial port: a pseudo-terminal in front of the emulated one."""

from __future__ import annotations

import os
import select
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from unittest.mock import create_autospec

import pytest

from skyloop.drivers.byte_stream import END_S, Rank, TcpStream
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.errors import MissingExtraError
from skyloop.messages import Attitude, EmergencyStop, Idle, LinkState, ResetEmergency
from skyloop.vehicles.msp.driver import MspDriver, MspLink
from skyloop.vehicles.msp.emulator import BetaflightFirmware
from skyloop.vehicles.msp.wire.frames import Parser
from skyloop.vehicles.msp.wire.messages import Function
from tests.support.betaflight import world
from tests.vehicles.msp.bench import Bench


class Wire(threading.Thread):
    """Copies bytes between a pseudo-terminal and the emulated firmware."""

    def __init__(self, port: int) -> None:
        import tty

        super().__init__(daemon=True)
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._line = socket.create_connection(("127.0.0.1", port), 5)
        self._ending = threading.Event()

    def run(self) -> None:
        while not self._ending.is_set():
            for ready in select.select([self._master, self._line.fileno()], [], [], 0.05)[0]:
                if ready == self._master:
                    self._line.sendall(os.read(self._master, 4096))
                else:
                    os.write(self._master, self._line.recv(4096))

    def hang(self) -> None:
        """Stop copying, and leave no room for new bytes."""
        self._ending.set()
        self.join()
        os.set_blocking(self._slave, False)
        while select.select([], [self._slave], [], 0.05)[1]:
            with suppress(BlockingIOError):
                while True:
                    os.write(self._slave, b"x")

    def stall(self) -> None:
        """Stop copying, like a paused process: bytes wait in the system."""
        self._ending.set()
        self.join()

    def waiting(self) -> bytes:
        """Return the waiting bytes."""
        return os.read(self._master, 65_536) if select.select([self._master], [], [], 0)[0] else b""

    def cut(self) -> None:
        self._ending.set()
        self.join()
        self._line.close()
        os.close(self._master)
        os.close(self._slave)


@pytest.fixture
def firmware() -> Iterator[BetaflightFirmware]:
    with BetaflightFirmware(world(), port=0) as firmware:
        yield firmware


def test_a_serial_port_is_read_and_lost(firmware: BetaflightFirmware) -> None:
    pytest.importorskip("serial")
    wire = Wire(firmware.port)
    wire.start()
    driver, sink = MspDriver(parse_uri(f"msp://{wire.path}?baud=230400")), RecordingSink()
    driver.open(sink)
    try:
        assert sink.wait(lambda: sink.link_state is LinkState.UP, 20.0), sink.links
        assert sink.wait(lambda: sink.feedback_count > 5, 10.0)
        assert driver.apply(Idle()) == Idle()
        assert driver.apply(ResetEmergency()) == ResetEmergency()
        assert driver.left_to() == ""
        wire.cut()
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, 10.0), sink.links
        assert sink.wait(lambda: f"there is no {wire.path}" in sink.links[-1][1], 10.0), sink.links
    finally:
        driver.close()


def test_an_unread_serial_port_blocks_nothing(firmware: BetaflightFirmware) -> None:
    """A flight controller hangs: commands return, the link is lost, and closing is quick."""
    pytest.importorskip("serial")
    wire = Wire(firmware.port)
    wire.start()
    driver, sink = MspDriver(parse_uri(f"msp://{wire.path}?baud=10000000")), RecordingSink()
    driver.open(sink)
    try:
        assert sink.wait(lambda: sink.link_state is LinkState.UP, 20.0), sink.links
        wire.hang()
        for action in (Attitude(), EmergencyStop()):
            driver.apply(action)
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, 10.0), sink.links
        driver.apply(EmergencyStop())
    finally:
        driver.close()
        wire.cut()


def test_a_paused_flight_controller_finds_few_old_sticks(firmware: BetaflightFirmware) -> None:
    """The system does not report bytes that wait in a pseudo-terminal: only missing answers show them."""
    pytest.importorskip("serial")
    wire = Wire(firmware.port)
    wire.start()
    driver, sink = MspDriver(parse_uri(f"msp://{wire.path}?baud=10000000")), RecordingSink()
    driver.open(sink)
    try:
        assert sink.wait(lambda: sink.link_state is LinkState.UP, 20.0), sink.links
        wire.stall()
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, 10.0), sink.links
        old = [frame for frame in Parser().feed(wire.waiting()) if frame.function == Function.SET_RAW_RC]
        assert len(old) <= 4 + 10 + 3
    finally:
        driver.close()
        wire.cut()


def test_a_stop_is_sent_with_its_own_rank_despite_a_backlog() -> None:
    """As a set-point it would be dropped when the line is behind."""
    bench, ranks = Bench(), list[Rank]()
    bench.take_off()
    link = MspLink(bench.session, lambda _: None, lambda: bench.clock.now_ns)
    line = create_autospec(TcpStream, instance=True)
    line.write.side_effect = lambda _, rank: ranks.append(rank)
    link._connection = line
    bench.clock.advance(0.1)
    link._send_due(bench.clock.now_ns)
    link.command(EmergencyStop())
    link.end()
    assert ranks == [*[Rank.SETPOINT] * (len(ranks) - 1), Rank.STOP], "one write for each frame"
    assert len(ranks) > 1


def test_the_last_connection_has_longer_to_deliver_its_bytes() -> None:
    link, line = MspLink(Bench().session, lambda _: None), create_autospec(TcpStream, instance=True)
    link._connection = line
    link._stopping.set()
    link.end()
    assert line.drain_s == END_S
    line.close.assert_called_once()


def test_without_pyserial_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    driver = MspDriver(parse_uri("msp:///dev/ttyACM0"))
    with pytest.raises(MissingExtraError, match=r"skyloop install msp"):
        driver.open(RecordingSink())

"""Streams never block: packets without room are dropped, cut frames are discarded, a slow line is paced."""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from unittest.mock import Mock

import pytest

from skyloop.clock import ManualClock
from skyloop.drivers.byte_stream import (
    END_S,
    STUCK_NS,
    LinePace,
    Rank,
    SerialStream,
    TcpStream,
    line_speed,
    serial_port,
)
from skyloop.transport.testing import wait_until
from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m
from tests.support.systems import PLATFORM, only_on


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """Open a serial line: its far end, and the device at this end."""
    if PLATFORM == "win32":
        pytest.skip("fills the port behind the threads that write to it on win32")
    import tty

    far, near = os.openpty()
    tty.setraw(near)
    os.set_blocking(far, False)
    yield far, os.ttyname(near)
    os.close(near)
    os.close(far)


def read_all(far: int) -> int:
    """Read everything and return the number of bytes."""
    count = 0
    with suppress(BlockingIOError):
        while True:
            count += len(os.read(far, 65_536))
    return count


def fill(stream: SerialStream) -> None:
    """Fill the buffer, as when the other end hangs. The system may free some room a moment later."""
    while select.select([], [stream], [], 0.05)[1]:
        with suppress(BlockingIOError):
            while True:
                os.write(stream.fileno(), b"x")


def test_a_serial_port_whose_other_end_does_not_read_drops_and_never_waits(line: tuple[int, str]) -> None:
    """With a full output buffer, writing returns at once, and raises after half a second without room."""
    pytest.importorskip("serial")
    far, device = line
    clock = ManualClock()
    with closing(SerialStream(device, 10_000_000, "x", "mavlink", clock)) as stream:
        fill(stream)
        stream.write(b"set-point")
        assert stream.dropped == 1
        clock.advance(STUCK_NS / 1e9 - 0.01)
        stream.write(b"set-point")
        read_all(far)
        stream.write(b"set-point")
        fill(stream)
        stream.write(b"set-point")
        assert stream.dropped == 3, "there was room in between"
        clock.advance(STUCK_NS / 1e9)
        with pytest.raises(OSError, match="no longer reads"):
            stream.write(b"set-point")


def test_the_vehicle_discards_a_frame_cut_by_a_full_port_but_not_the_next(
    line: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A port that is full for a moment cuts one frame in a hundred. That broke the connection: the vehicle hovered."""
    pytest.importorskip("serial")
    far, device = line
    station, vehicle = MavlinkCodec(255, 190), FlightControllerParser()
    old = m.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1.0, 0.0, 0.0, 0.0], 0.1, 0.2, 0.3, 0.5)
    new = m.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    write = os.write
    with closing(SerialStream(device, 10_000_000, "x", "mavlink", ManualClock())) as stream:
        for cut in range(1, len(station.encode(old))):
            with monkeypatch.context() as full:
                full.setattr("skyloop.drivers.byte_stream.os.write", lambda fd, data, cut=cut: write(fd, data[:cut]))
                stream.write(station.encode(old))
                full.setattr("skyloop.drivers.byte_stream.os.write", lambda fd, data: write(fd, data[:1]))
                stream.write(station.encode(old))
            stream.write(station.encode(new))
            came: list[Message] = []
            while not came:
                assert select.select([far], [], [], 5.0)[0]
                came = vehicle.feed(os.read(far, 65_536))
            assert [message.get_type() for message in came] == ["HEARTBEAT"], cut
        assert stream.dropped == 2 * cut


def test_a_cut_stop_is_resent_whole(line: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("serial")
    far, device = line
    write = os.write
    with closing(SerialStream(device, 10_000_000, "x", "msp", ManualClock())) as stream:
        monkeypatch.setattr(SerialStream, "_discard", lambda _: False)
        with monkeypatch.context() as full:
            full.setattr("skyloop.drivers.byte_stream.os.write", lambda fd, data: write(fd, data[:2]))
            stream.write(b"stop", Rank.STOP)
        stream.write(b"STOP", Rank.STOP)
        came = b""
        while not came.endswith(b"STOP"):
            assert select.select([far], [], [], 5.0)[0]
            came += os.read(far, 65_536)
        assert b"sto" in came
        assert b"stop" not in came


def test_a_port_that_takes_only_parts_of_frames_for_half_a_second_is_not_read(
    line: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("serial")
    clock, write = ManualClock(), os.write
    with closing(SerialStream(line[1], 10_000_000, "x", "mavlink", clock)) as stream:
        monkeypatch.setattr("skyloop.drivers.byte_stream.os.write", lambda fd, data: write(fd, data[:1]))
        stream.write(b"set-point")
        clock.advance(STUCK_NS / 1e9)
        with pytest.raises(OSError, match="no longer reads"):
            stream.write(b"set-point")


class Uart:
    """The same line with a UART's output buffer, whose level can be read and which can be emptied.

    Args:
        line: Its far end, and the device at this end.
    """

    def __init__(self, line: tuple[int, str]) -> None:
        self.waiting = 0
        self._far, self.device = line

    def read(self, most: int = 65_536) -> bytes:
        """Transmit some of the waiting bytes."""
        came, wanted = b"", min(most, self.waiting)
        while len(came) < wanted:
            assert select.select([self._far], [], [], 5.0)[0]
            came += os.read(self._far, wanted - len(came))
        self.waiting -= wanted
        return came


@pytest.fixture
def uart(line: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> Uart:
    serial, uart = pytest.importorskip("serial"), Uart(line)
    write = os.write

    def count(descriptor: int, data: bytes) -> int:
        sent = write(descriptor, data)
        uart.waiting += sent
        return sent

    monkeypatch.setattr("skyloop.drivers.byte_stream.os.write", count)
    monkeypatch.setattr(serial.Serial, "out_waiting", property(lambda _: uart.waiting))
    monkeypatch.setattr(serial.Serial, "reset_output_buffer", lambda _: uart.read())
    return uart


def test_a_stalled_line_counts_as_full(uart: Uart) -> None:
    """The reader stalls with room for thousands of bytes: only a few set-points wait, and then the newest is sent."""
    clock = ManualClock()
    with closing(SerialStream(uart.device, 921_600, "x", "mavlink", clock)) as stream:
        for number in range(25):
            stream.write(b"%08d" % number)
            clock.advance(0.04)
            uart.read()
        for number in range(25, 32):
            stream.write(b"%08d" % number)
            clock.advance(0.04)
        assert uart.waiting <= 4 * 8, "a tenth of a second waits"
        assert stream.dropped >= 3
        uart.read()
        stream.write(b"%08d" % 32)
        assert uart.read() == b"00000032"
        for number in range(33, 49):
            stream.write(b"%08d" % number)
            clock.advance(0.04)
        with pytest.raises(OSError, match="no longer reads"):
            stream.write(b"%08d" % number)


@pytest.mark.parametrize(("baud", "most"), [(57_600, 576), (115_200, 1152)])
def test_the_backlog_is_read_and_not_only_estimated(uart: Uart, baud: int, most: int) -> None:
    """The line is slower than its baud rate: the backlog is limited to a tenth of a second at that rate."""
    clock = ManualClock()
    with closing(SerialStream(uart.device, baud, "x", "mavlink", clock)) as stream:
        for _ in range(100):
            with suppress(ConnectionError):
                stream.write(bytes(50))
            clock.advance(0.02)
            uart.read(25)
            assert uart.waiting <= most + 50


class FlightControllerParser:
    """Finds frames like MAVLink's C library, which does not search inside a damaged frame."""

    def __init__(self) -> None:
        self._kept = bytearray()
        self._codec = MavlinkCodec(1, 1)

    def feed(self, data: bytes) -> list[Message]:
        self._kept += data
        found: list[Message] = []
        while (begin := self._kept.find(m.PROTOCOL_MARKER_V2)) >= 0:
            del self._kept[:begin]
            if len(self._kept) < 2 or len(self._kept) < (size := self._kept[1] + 12):
                break
            found += self._codec.decode(bytes(self._kept[:size]), whole=True)
            del self._kept[:size]
        return found


def test_a_stop_precedes_the_backlog_and_is_not_parsed_as_the_end_of_a_cut_frame(uart: Uart) -> None:
    """The reader stalls within a frame, whose rest is discarded: the next frame that it decodes is the stop."""
    clock, station, vehicle = ManualClock(), MavlinkCodec(255, 190), FlightControllerParser()
    target = m.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1.0, 0.0, 0.0, 0.0], 0.1, 0.2, 0.3, 0.5)
    stop = m.MAVLink_command_long_message(1, 1, m.MAV_CMD_COMPONENT_ARM_DISARM, 0, 0.0, 21196.0, 0, 0, 0, 0, 0)
    with closing(SerialStream(uart.device, 57_600, "x", "mavlink", clock)) as stream:
        for _ in range(10):
            stream.write(station.encode(target))
            clock.advance(0.001)
        vehicle.feed(uart.read(70))
        stream.write(station.encode(stop), Rank.STOP)
        stream.write(station.encode(target))
        (message,) = vehicle.feed(uart.read())
        assert message.get_type() == "COMMAND_LONG"
        for _ in range(5):
            stream.write(station.encode(stop), Rank.STOP)
            clock.advance(0.1)
        assert len(vehicle.feed(uart.read())) == 5, "a stop does not discard the previous one"


@pytest.mark.parametrize("bytes_per_s", [1000, 1500])
def test_a_stop_arrives_on_a_line_that_is_slower_than_its_baud_rate(uart: Uart, bytes_per_s: int) -> None:
    """Each repeat discarded the previous one, of which only the padding had been sent, so none ever arrived."""
    clock, came = ManualClock(), b""
    with closing(SerialStream(uart.device, 921_600, "x", "msp", clock)) as stream:
        for tick in range(100):
            stops = tick >= 50 and tick % 5 == 0
            stream.write(b"S" * 40 if stops else b"s" * 40, Rank.STOP if stops else Rank.SETPOINT)
            clock.advance(0.02)
            came += uart.read(bytes_per_s // 50)
            if b"S" * 40 in came:
                break
        assert tick < 50 + 25, "within half a second"


def test_a_stop_finds_room_in_a_full_port(line: tuple[int, str]) -> None:
    """The end of the buffer is discarded for it, even where its level can't be read."""
    pytest.importorskip("serial")
    far, device = line
    with closing(SerialStream(device, 10_000_000, "x", "mavlink")) as stream:
        fill(stream)
        stream.write(b"command", Rank.COMMAND)
        assert stream.dropped == 1
        stream.write(b"stop", Rank.STOP)
        came = b""
        while select.select([far], [], [], 0.2)[0]:
            came += os.read(far, 65_536)
        assert came.endswith(b"stop")


def test_a_stop_on_a_stalled_line_gets_a_moment_to_leave_when_the_port_is_closed(
    uart: Uart, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program that stopped the motors and exited discarded the bytes that it had just written."""
    clock, came = ManualClock(), bytearray()
    stream = SerialStream(uart.device, 57_600, "x", "mavlink", clock)
    for _ in range(12):
        stream.write(bytes(60))
        clock.advance(0.04)
    stream.write(b"stop", Rank.STOP)
    stream.write(b"words", Rank.COMMAND)
    monkeypatch.setattr("skyloop.drivers.byte_stream.time.sleep", lambda _: came.extend(uart.read(29)))
    stream.close()
    assert came.endswith(b"stopwords")


def test_a_port_is_empty_when_it_is_opened(uart: Uart) -> None:
    other = os.open(uart.device, os.O_WRONLY | os.O_NOCTTY)
    os.write(other, b"of the connection before")
    with closing(SerialStream(uart.device, 57_600, "x", "mavlink")) as stream:
        assert uart.waiting == 0
        stream.write(b"new")
        assert uart.read() == b"new"
        stream.write(b"stop", Rank.STOP)
        assert uart.read() == bytes(277) + b"stop", "the end of a frame may have been discarded"
        stream.write(b"stop", Rank.STOP)
        assert uart.read() == b"stop"
    os.close(other)


def test_a_port_without_a_readable_backlog_is_still_written_to(
    line: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    serial = pytest.importorskip("serial")
    far, device = line

    def untold(_: object) -> int:
        raise OSError("inappropriate ioctl for device")

    monkeypatch.setattr(serial.Serial, "out_waiting", property(untold))
    monkeypatch.setattr(serial.Serial, "reset_output_buffer", untold)
    clock = ManualClock()
    with closing(SerialStream(device, 57_600, "x", "mavlink", clock)) as stream:
        for _ in range(20):
            stream.write(bytes(50))
            stream.write(bytes(40), Rank.COMMAND)
            clock.advance(0.04)
        stream.write(bytes(40), Rank.STOP)
        assert stream.dropped == 0
        assert read_all(far) == 20 * 90 + 40


@pytest.fixture
def windows_port(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, SerialStream, ManualClock]]:
    """A serial port that is served as on Windows, and its far end."""
    pytest.importorskip("serial")
    tty = pytest.importorskip("tty")
    far, near = os.openpty()
    tty.setraw(near)
    os.set_blocking(far, False)
    clock = ManualClock()
    with monkeypatch.context() as windows:
        windows.setattr("skyloop.drivers.byte_stream.sys.platform", "win32")
        stream = SerialStream(os.ttyname(near), 10_000_000, "x", "mavlink", clock)
    os.close(near)
    yield far, stream, clock
    stream.close()
    with suppress(OSError):
        os.close(far)


def test_a_port_of_windows_carries_bytes_both_ways(windows_port: tuple[int, SerialStream, ManualClock]) -> None:
    far, stream, _ = windows_port
    assert stream.read() == b""
    for data in (b"one", b"two"):
        os.write(far, data)
        came = b""
        while came != data:
            assert select.select([stream], [], [], 10.0)[0], "a link can wait for it"
            came += stream.read()
        stream.write(data)
        came = b""
        while came != data:
            assert select.select([far], [], [], 10.0)[0]
            came += os.read(far, 100)
    wait_until(lambda: stream._waiting() == 0, "all is written")


def test_an_unread_port_of_windows_blocks_nothing(windows_port: tuple[int, SerialStream, ManualClock]) -> None:
    far, stream, clock = windows_port
    for _ in range(200):
        stream.write(bytes(250))
        clock.advance(0.001)
    assert stream.dropped > 10
    assert stream._waiting() > 1000
    stream.write(b"stop", Rank.STOP)
    sent = bytearray()
    while select.select([far], [], [], 0.3)[0]:
        sent += os.read(far, 65_536)
    assert sent.endswith(b"stop"), "it precedes what was waiting"
    assert len(sent) < 10_000 + 4096


def test_an_unplugged_port_of_windows_is_noticed(windows_port: tuple[int, SerialStream, ManualClock]) -> None:
    far, stream, _ = windows_port
    assert stream._threads is not None
    os.close(far)
    assert select.select([stream], [], [], 10.0)[0]
    with pytest.raises(ConnectionError, match="unplugged"):
        stream.read()
    threads = stream._threads
    wait_until(lambda: not threads._threads[0].is_alive(), "the reading thread has ended")
    threads._port.write = Mock(side_effect=OSError("gone"))
    stream.write(b"x", Rank.COMMAND)
    wait_until(lambda: threads._ended, "so has the writing one")
    with pytest.raises(ConnectionError, match="unplugged"):
        stream.write(b"x", Rank.COMMAND)


def test_a_write_that_a_stop_cut_off_ends_no_port_of_windows(
    windows_port: tuple[int, SerialStream, ManualClock],
) -> None:
    """pyserial calls it a time-out unless it reads the system's error before another call replaces that."""
    serial = pytest.importorskip("serial")
    _, stream, _ = windows_port
    assert stream._threads is not None
    stream._threads._port.write = write = Mock(side_effect=[serial.SerialTimeoutException("Write timeout"), 256, 256])
    stream.write(b"old")
    wait_until(lambda: write.call_count == 1, "it was cut off")
    stream.write(b"stop", Rank.STOP)
    wait_until(lambda: write.call_args.args[0].endswith(b"stop"), "the stop is written")


def test_ports_are_named_as_users_write_them() -> None:
    for given in ("COM3", "com3", "/COM3", r"\\.\COM3", "//./com3"):
        assert serial_port(given) == "COM3"
    assert serial_port("/dev/cu.usbmodem1") == "/dev/cu.usbmodem1"
    assert serial_port("ttyACM0") is None
    assert serial_port("COM") is None


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    """A server that accepts one connection, and has room for little."""
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        server.bind(("127.0.0.1", 0))
        server.listen()
        yield server


def received(connection: socket.socket) -> tuple[bytes, bool]:
    """Return everything received, and whether the connection was closed properly."""
    came = b""
    connection.settimeout(5.0)
    with connection:
        try:
            while more := connection.recv(65_536):
                came += more
        except ConnectionResetError:
            return came, False
    return came, True


@only_on("linux", reason="Windows' own kernel resets the connection, and macOS' own says what waits")
def test_data_buffered_at_closing_are_not_delivered_later(peer: socket.socket) -> None:
    """The vehicle's network may return when no one flies it any more: it must not be armed then."""
    stream = TcpStream("127.0.0.1", peer.getsockname()[1], ManualClock())
    connection, _ = peer.accept()
    with suppress(ConnectionError):
        stream.write(bytes(1 << 16), Rank.COMMAND)
        stream.write(b"arm", Rank.COMMAND)
    stream.close()
    came, ended = received(connection)
    assert not came.endswith(b"arm")
    assert not ended


def test_closing_on_windows_waits_for_a_second_and_then_resets(
    peer: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skyloop.drivers.byte_stream.sys.platform", "win32")
    stream = TcpStream("127.0.0.1", peer.getsockname()[1], ManualClock())
    with stream._socket:
        monkeypatch.setattr(stream, "_socket", asking := Mock())
        stream.close()
        asked = [call[0] for call in asking.method_calls]
        assert asked == ["setblocking", "setsockopt", "close"]
        asking.setsockopt.assert_called_with(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("HH", 1, 1))


@only_on("linux", "darwin", reason="Windows has no fcntl")
def test_what_waits_to_be_sent_is_counted_on_macos(peer: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skyloop.drivers.byte_stream.sys.platform", "darwin")
    with closing(TcpStream("127.0.0.1", peer.getsockname()[1], ManualClock())) as stream, stream._socket:
        monkeypatch.setattr(stream, "_socket", asking := Mock())
        asking.getsockopt.return_value = 123
        assert stream._waiting() == 123
        asking.getsockopt.assert_called_with(socket.SOL_SOCKET, 0x1024)
        asking.getsockopt.return_value = 0


@only_on("linux", "win32", reason="macOS' own kernel says what waits")
@pytest.mark.parametrize("system", [PLATFORM, "win32"])
def test_a_stalled_peer_gets_few_old_set_points(
    peer: socket.socket, system: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They filled megabytes of the system's buffers, and the vehicle followed each of them when it resumed."""
    clock = ManualClock()
    monkeypatch.setattr("skyloop.drivers.byte_stream.sys.platform", system)
    with closing(TcpStream("127.0.0.1", peer.getsockname()[1], clock)) as stream:
        connection, _ = peer.accept()
        for _ in range(100):
            stream.write(bytes(1000))
            clock.advance(0.02)
        assert stream.dropped > 50
        stream.write(b"land", Rank.COMMAND)
    came, _ = received(connection)
    assert len(came) < 40_000


def test_set_points_survive_a_short_network_outage(peer: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    """TCP delivers all of them when the network is back; one or two resent packets do not end the connection."""
    clock, out = ManualClock(), False
    with closing(TcpStream("127.0.0.1", peer.getsockname()[1], clock)) as stream:
        peer.accept()[0].close()
        sent: list[bytes] = []

        def write(data: bytes) -> int:
            sent.append(data)
            return len(data)

        monkeypatch.setattr(stream, "_write", write)
        monkeypatch.setattr(stream, "_waiting", lambda: 50 * len(sent) if out else 0)
        for tick in range(250):
            if tick in (50, 100):
                out = tick == 50
                sent.clear()
            stream.write(bytes(50))
            clock.advance(0.02)
            if tick == 99:
                assert len(sent) <= 17, "those of a third of a second"
        assert len(sent) == 150, "all, once it is back"


def test_the_last_packets_of_a_connection_are_delivered(peer: socket.socket) -> None:
    stream = TcpStream("127.0.0.1", peer.getsockname()[1])
    connection, _ = peer.accept()
    stream.write(b"disarm", Rank.COMMAND)
    stream.close()
    assert received(connection) == (b"disarm", True)


@only_on("linux", "darwin", reason="what waits to be sent can't be counted")
@pytest.mark.parametrize("last", [True, False])
def test_the_last_packets_may_be_lost_once(peer: socket.socket, monkeypatch: pytest.MonkeyPatch, last: bool) -> None:
    """TCP resends unacknowledged data after 0.2 s; closing does not wait if a new connection is to be opened."""
    stream = TcpStream("127.0.0.1", peer.getsockname()[1])
    connection, _ = peer.accept()
    stream.write(b"stop", Rank.STOP)
    acknowledged_s = time.monotonic() + 0.3
    monkeypatch.setattr(stream, "_waiting", lambda: 4 * (time.monotonic() < acknowledged_s))
    stream.drain_s = END_S if last else stream.drain_s
    stream.close()
    assert received(connection)[1] is last


def test_closing_does_not_wait_for_a_lost_connection(peer: socket.socket) -> None:
    """The system kept counting unacknowledged bytes, and the next connection waited for them."""
    stream = TcpStream("127.0.0.1", peer.getsockname()[1], ManualClock())
    connection, _ = peer.accept()
    stream.write(bytes(1 << 14), Rank.COMMAND)
    assert connection.recv(1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()
    assert select.select([stream], [], [], 5.0)[0]
    with pytest.raises(ConnectionError):
        stream.read()
    assert stream._waiting() == 0
    stream.close()


def test_a_slow_line_carries_set_points_before_poses_and_commands_before_all() -> None:
    """At 57,600 baud, a set-point every 20 ms and a pose every 10 ms are far too much, yet nothing waits for long."""
    pace, sent, latest_s = LinePace(5760.0), dict.fromkeys(Rank, 0), 0.0
    free_s = 0.0
    for step in range(1000):
        now_s = step * 0.01
        packets = [(Rank.POSE, 244), (Rank.SETPOINT, 65)] if step % 2 else [(Rank.POSE, 244)]
        if step % 100 == 0:
            packets += [(Rank.COMMAND, 45), (Rank.QUERY, 32)]
        for rank, size in sorted(packets):
            if pace.admits(rank, round(now_s * 1e9)):
                pace.on_written(size, round(now_s * 1e9))
                free_s = max(free_s, now_s) + size / 5760.0
                sent[rank] += 1
                if rank <= Rank.SETPOINT:
                    latest_s = max(latest_s, free_s - now_s)
    assert sent[Rank.COMMAND] == 10, "never held back"
    assert sent[Rank.SETPOINT] == 500
    assert sent[Rank.POSE] > 60, "they get the rest"
    assert latest_s < 0.12


def test_a_line_over_usb_has_no_pace(tmp_path: Path) -> None:
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyACM0")
    assert line_speed(str(tmp_path / "by-id"), 57600) is None
    assert line_speed("/dev/cu.usbmodem14201", 57600) is None
    assert line_speed("/dev/ttyUSB0", 57600) == 5760.0

"""The driver on every kind of connection, against emulated autopilots."""

from __future__ import annotations

import os
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import create_autospec

import numpy as np
import pytest

from skyloop.drivers.base import Driver, ExternalPose, ServedLink
from skyloop.drivers.byte_stream import END_S
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.errors import DriverError, UnsupportedError, UsageError
from skyloop.host.threads import LinkThread
from skyloop.messages import EmergencyStop, FlightState, Land, LinkState, Takeoff, Velocity
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.transport.testing import wait_until
from skyloop.vehicles.mavlink.driver import MavlinkDriver
from skyloop.vehicles.mavlink.emulator import Faults, Kind, MavlinkFirmware, Ports, with_multirotors
from skyloop.vehicles.mavlink.link import MavlinkLink, TcpClient
from skyloop.vehicles.mavlink.protocol import MavlinkSession
from skyloop.vehicles.mavlink.wire.codec import Landed, MavlinkCodec
from skyloop.vehicles.mavlink.wire.codec import dialect as m
from tests.support.systems import only_on
from tests.vehicles.mavlink.scripted import ARDUPILOT, Vehicle, options

shares_threads = only_on("linux", "darwin", reason="each link has a thread of its own")
PATIENCE_S = 15.0


def world(drones: int = 1, speed: float = 3.0) -> SimHost:
    return SimHost(with_multirotors(SimOptions(world="empty", seed=4, wind=0.0, speed=speed)), drones)


def firmware(host: SimHost | None = None, kind: Kind = Kind.PX4, **options: object) -> MavlinkFirmware:
    settings = {"kind": kind, "ports": Ports.free(kind), "boot_s": 0.5, **options}
    return MavlinkFirmware(host or world(), **settings)  # type: ignore[arg-type]


@contextmanager
def opened(address: str) -> Iterator[tuple[Driver, RecordingSink]]:
    driver, sink = MavlinkDriver(parse_uri(address)), RecordingSink(watch=set())
    driver.open(sink)
    try:
        yield driver, sink
    finally:
        driver.close()
    assert not sink.problems


def up(sink: RecordingSink) -> None:
    assert sink.wait(lambda: sink.link_state is LinkState.UP, PATIENCE_S), sink.links


def test_the_last_connection_has_longer_to_deliver_its_packets() -> None:
    link = MavlinkLink(MavlinkSession(options("mavlink://tcp:127.0.0.1:5760"), 0), lambda _: None)
    link._connection = line = create_autospec(TcpClient, instance=True)
    link._stopping.set()
    link.end()
    assert line.drain_s == END_S
    line.close.assert_called_once()


def test_udp_that_sends_first() -> None:
    with firmware() as it, opened(f"mavlink://udpout:127.0.0.1:{it.settings.ports.udp}") as (_, sink):
        up(sink)


@shares_threads
def test_a_shared_thread_serves_it_too() -> None:
    thread = LinkThread()
    with firmware() as it:
        driver = MavlinkDriver(parse_uri(f"mavlink://udpout:127.0.0.1:{it.settings.ports.udp}"))
        driver.serve_link = partial(thread.add, vehicle=driver)
        sink, threads = RecordingSink(watch=set()), set[str]()
        sink.feedback = lambda feedback: threads.add(threading.current_thread().name)  # type: ignore[method-assign]
        driver.open(sink)
        try:
            up(sink)
            wait_until(lambda: threads, "its state arrives")
            assert threads == {"skyloop-links"}
        finally:
            driver.close()
            thread.close()
    assert not sink.problems


@shares_threads
def test_an_unresolvable_name_delays_no_other_link(monkeypatch: pytest.MonkeyPatch) -> None:
    """The shared thread returns for the answer once there is one."""
    released, found = threading.Event(), socket.getaddrinfo("127.0.0.1", None, type=socket.SOCK_STREAM)

    def resolver(*_: object) -> object:
        released.wait(PATIENCE_S)
        return found

    given: list[ServedLink] = []
    driver = MavlinkDriver(parse_uri("mavlink://udpout:drone7.lab:9"))
    driver.serve_link = given.append
    driver.open(RecordingSink(watch=set()))
    (link,) = given
    assert isinstance(link, MavlinkLink)
    monkeypatch.setattr("skyloop.drivers.vehicle_link.socket.getaddrinfo", resolver)
    monkeypatch.setattr("skyloop.drivers.vehicle_link.NAME_WAIT_S", PATIENCE_S)
    begun_s = time.monotonic()
    for _ in range(3):
        link.serve(readable=False)
    assert time.monotonic() - begun_s < 0.5 * PATIENCE_S, "it never waits for the name"
    released.set()
    wait_until(lambda: link.serve(readable=False) is not None and link._connection is not None, "it is opened")
    monkeypatch.undo()
    link._stopping.set()
    assert link.serve(readable=False) is None
    link.end()
    driver.close()


def test_a_failure_on_a_shared_thread_is_an_event_and_raised_there() -> None:
    given: list[ServedLink] = []
    driver = MavlinkDriver(parse_uri("mavlink://udpout:127.0.0.1:9"))
    driver.serve_link = given.append
    sink = RecordingSink(watch=set())
    driver.open(sink)
    (link,) = given
    try:
        due_ns = link.serve(readable=False)
        assert due_ns is not None
        assert due_ns > 0
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(link, "_step", lambda **_: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                link.serve(readable=True)
        assert "the link to the vehicle failed: ZeroDivisionError" in sink.events[-1].text
    finally:
        ending = threading.Thread(target=driver.close)
        ending.start()  # waits until the serving thread reports its end
        wait_until(lambda: link.serve(readable=False) is None, "it should end")
        link.end()
        ending.join(PATIENCE_S)
    assert not ending.is_alive()


def test_tcp_is_up_with_a_heartbeat_not_with_the_connection() -> None:
    with firmware(kind=Kind.ARDUCOPTER) as it:
        assert it.settings.ports.tcp is not None
        with socket.create_connection(("127.0.0.1", it.settings.ports.tcp)) as first:
            first.recv(16)  # it has the autopilot to itself
            with opened(it.tcp_address) as (_, sink):
                assert sink.wait(lambda: sink.link_state is LinkState.LOST, PATIENCE_S), sink.links
                first.close()
                up(sink)
                assert sink.wait(lambda: sink.newest is not None and sink.newest.roll_rad is not None, PATIENCE_S)


def test_tcp_reconnects_after_the_vehicle_was_away() -> None:
    it = firmware(kind=Kind.ARDUCOPTER)
    with it, opened(it.tcp_address) as (_, sink):
        up(sink)
        it.stop()
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, PATIENCE_S)
        it.start()
        up(sink)


def test_a_serial_port() -> None:
    """A pseudo-terminal, whose other end is bridged to an autopilot's TCP port."""
    pytest.importorskip("serial")
    master, slave = os.openpty()
    with firmware(kind=Kind.ARDUCOPTER) as it:
        assert it.settings.ports.tcp is not None
        with socket.create_connection(("127.0.0.1", it.settings.ports.tcp)) as far:
            ends = [_carry(lambda: os.read(master, 4096), far.sendall), _carry(lambda: far.recv(4096), _into(master))]
            with opened(f"mavlink://serial:{os.ttyname(slave)}:921600") as (_, sink):
                up(sink)
            far.shutdown(socket.SHUT_RDWR)
            os.write(slave, b"\0")
            os.close(slave)
            for end in ends:
                end.join(5.0)
    os.close(master)


@only_on("linux", "darwin", reason="a pseudo-terminal that a stop has emptied takes all that follows")
def test_an_unread_serial_port_is_lost_and_blocks_nothing() -> None:
    """The vehicle sends but reads nothing: commands return, the link is lost, and closing is immediate."""
    pytest.importorskip("serial")
    import tty

    far, near = os.openpty()
    tty.setraw(near)
    vehicle, ending = Vehicle(ARDUPILOT), threading.Event()
    vehicle.mode, vehicle.armed, vehicle.landed, vehicle.place = "GUIDED", True, Landed.IN_AIR, (0.0, 0.0, -2.0)

    def send() -> None:
        while not ending.wait(0.02):
            vehicle.boot_ms += 20
            frames = [vehicle.codec.encode(each) for each in (vehicle.heartbeat(), *vehicle.telemetry())]
            os.write(far, b"".join(frames))

    sending = threading.Thread(target=send)
    sending.start()
    try:
        with opened(f"mavlink://serial:{os.ttyname(near)}:10000000?parameters=no") as (driver, sink):
            up(sink)
            assert sink.wait(lambda: sink.newest is not None and sink.newest.state is FlightState.HOVERING, PATIENCE_S)
            os.set_blocking(near, False)
            while select.select([], [near], [], 0.05)[1]:
                with suppress(BlockingIOError):
                    while True:
                        os.write(near, b"x")
            driver.apply(Velocity(forward=0.3))
            driver.apply(EmergencyStop())
            assert sink.wait(lambda: any(state is LinkState.LOST for state, _ in sink.links), PATIENCE_S)
            assert any("no longer reads" in reason for _, reason in sink.links)
            driver.apply(EmergencyStop())
            driver.close()
    finally:
        ending.set()
        sending.join(5.0)
        os.close(near)
        os.close(far)


def _into(descriptor: int) -> Callable[[bytes], object]:
    return lambda data: os.write(descriptor, data)


def _carry(read: Callable[[], bytes], write: Callable[[bytes], object]) -> threading.Thread:
    def run() -> None:
        try:
            while data := read():
                write(data)
        except OSError:
            return

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


@pytest.mark.parametrize("way", ["udpin:127.0.0.1:1", "tcp:127.0.0.1:1", "serial:/dev/nothing-of-the-kind:57600"])
def test_unreachable_vehicles_are_reported_with_the_reason(way: str) -> None:
    with opened(f"mavlink://{way}") as (driver, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, PATIENCE_S)
        if not way.startswith("udpin") or os.geteuid() != 0:  # root may listen anywhere
            assert "(" in sink.links[-1][1]
        with pytest.raises(DriverError, match="no data from"):
            driver.apply(Takeoff())


def test_two_vehicles_on_one_port_are_distinguished() -> None:
    host = world(2)
    remote = Ports.free(Kind.PX4).remote
    ports = [Ports(Ports.free(Kind.PX4).udp, remote) for _ in range(2)]
    with (
        firmware(host, drone=0, ports=ports[0]),
        firmware(host, drone=1, ports=ports[1]),
        opened(f"mavlink://udpin:127.0.0.1:{remote}?sysid=2") as (driver, sink),
    ):
        up(sink)
        fly(driver, sink)
        assert host.simulation.truth(0).state is FlightState.LANDED
        assert any("another vehicle" in event.text for event in sink.events)


def test_two_vehicles_with_one_id_are_distinguished_by_address() -> None:
    host = world(2)
    remote = Ports.free(Kind.PX4).remote
    ports = [Ports(Ports.free(Kind.PX4).udp, remote) for _ in range(2)]
    with (
        firmware(host, drone=0, ports=ports[0], system=1),
        firmware(host, drone=1, ports=ports[1], system=1),
        opened(f"mavlink://udpin:127.0.0.1:{remote}?peer=127.0.0.1:{ports[1].udp}") as (driver, sink),
    ):
        up(sink)
        fly(driver, sink)
        assert host.simulation.truth(0).state is FlightState.LANDED


def test_a_vehicle_that_replaces_the_first_is_flown_as_what_it_is() -> None:
    """A PX4, then an ArduCopter with the same system id on the same port, whose mode numbers differ."""
    ports = Ports.free(Kind.PX4)
    with opened(f"mavlink://udpin:127.0.0.1:{ports.remote}") as (driver, sink):
        with firmware(kind=Kind.PX4, ports=ports):
            up(sink)
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, PATIENCE_S)
        with firmware(kind=Kind.ARDUCOPTER, ports=replace(Ports.free(Kind.ARDUCOPTER), remote=ports.remote)):
            up(sink)
            assert any("another vehicle answers" in event.text for event in sink.events)
            assert "mavlink.fs_gcs_enable" in [each.name for each in driver.parameters()]
            assert "mavlink.nav_dll_act" not in [each.name for each in driver.parameters()]
            fly(driver, sink)


def fly(driver: Driver, sink: RecordingSink) -> None:
    """Take off and land."""

    def state() -> FlightState | None:
        return sink.newest.state if sink.newest is not None else None

    assert sink.wait(lambda: ready(sink), PATIENCE_S)
    driver.apply(Takeoff())
    assert sink.wait(lambda: state() is FlightState.HOVERING, PATIENCE_S), (sink.newest, list(sink.events))
    driver.apply(Land())
    assert sink.wait(lambda: state() is FlightState.LANDED, PATIENCE_S), sink.newest


def test_a_second_program_that_takes_the_vehicle_keeps_it() -> None:
    """On a separate connection it lands the vehicle, and the driver lets it."""
    with firmware(world(speed=1.0), kind=Kind.ARDUCOPTER) as it, opened(it.tcp_address) as (driver, sink):
        up(sink)
        wait_until(lambda: ready(sink), "it can be armed")
        driver.apply(Takeoff())
        assert sink.wait(lambda: sink.newest is not None and sink.newest.state is FlightState.HOVERING, PATIENCE_S)
        driver.apply(Velocity(forward=0.3))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            lands = m.MAVLink_command_long_message(1, 1, m.MAV_CMD_DO_SET_MODE, 0, 1, 9, 0, 0, 0, 0, 0)
            other.sendto(MavlinkCodec(250, 190).encode(lands), ("127.0.0.1", it.settings.ports.udp))
        assert sink.wait(lambda: any("changed to LAND" in event.text for event in sink.events), PATIENCE_S)
        with pytest.raises(DriverError, match="not chosen here"):
            driver.apply(Velocity(forward=0.3))
        assert sink.wait(lambda: sink.newest is not None and sink.newest.state is FlightState.LANDED, PATIENCE_S)


def ready(sink: RecordingSink) -> bool:
    return bool(((sink.newest and sink.newest.native) or {}).get("mavlink.ready"))


@pytest.mark.parametrize("kind", list(Kind))
def test_mavlink_1_flies(kind: Kind) -> None:
    with firmware(kind=kind, version=1) as it, opened(it.address) as (driver, sink):
        up(sink)
        fly(driver, sink)


def test_signed_messages_fly_with_the_key(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    with firmware(key=bytes(range(32))) as it, opened(f"{it.address}?signing_key={key}") as (driver, sink):
        up(sink)
        fly(driver, sink)


@pytest.mark.parametrize("kind", list(Kind))
def test_it_flies_with_a_tenth_of_all_datagrams_lost(kind: Kind) -> None:
    faults = Faults(seed=5, drop=0.1, duplicate=0.02, reorder=0.02, corrupt=0.02)
    with firmware(kind=kind, faults=faults) as it, opened(it.address) as (driver, sink):
        up(sink)
        assert len(driver.parameters()) > 20
        fly(driver, sink)


@pytest.mark.parametrize("kind", list(Kind))
@pytest.mark.parametrize("pose", ["odometry", "vision_position_estimate"])
def test_external_poses_make_it_fly_without_gps(kind: Kind, pose: str) -> None:
    with (
        firmware(kind=kind, gps=False) as it,
        opened(f"{it.address}?pose={pose}&origin=47.4,8.5,488") as (driver, sink),
    ):
        up(sink)
        stop = threading.Event()

        def capture() -> None:
            while not stop.wait(0.02):
                captured_ns = sink.newest.captured_ns if sink.newest is not None else 0
                pose = ExternalPose((0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0), captured_ns, 0.001, 0.01)
                with suppress(DriverError):  # too old before the first feedback or after a stall
                    driver.external_pose(pose)

        thread = threading.Thread(target=capture)
        thread.start()
        try:
            fly(driver, sink)
        finally:
            stop.set()
            thread.join()
        assert it.autopilot.poses > 20


def test_poses_are_checked() -> None:
    with pytest.raises(UsageError, match="length 1"):
        ExternalPose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0), 0)
    with pytest.raises(UsageError, match="finite"):
        ExternalPose((float("nan"), 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 0)
    for wrong in ({"position_std_m": -0.1}, {"attitude_std_rad": -0.1}):
        with pytest.raises(UsageError, match=f"{next(iter(wrong))} is -0.1 and must be 0 or more"):
            ExternalPose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 0, **wrong)
    nobody = f"mavlink://udpin:127.0.0.1:{Ports.free(Kind.PX4).remote}"
    with opened(nobody) as (driver, _), pytest.raises(DriverError, match="no data from"):
        driver.external_pose(ExternalPose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 0))


def test_a_vehicle_that_accepts_no_poses_reports_that() -> None:
    from skyloop.drivers.registry import make_driver

    with pytest.raises(UnsupportedError, match="sim://"):
        make_driver("sim://?cameras=none").external_pose(ExternalPose((0.0,) * 3, (0.0, 0.0, 0.0, 1.0), 0))


def test_a_camera_beside_the_autopilot_shows_its_newest_image() -> None:
    pytest.importorskip("av")
    port = Ports.free(Kind.PX4).remote
    host = SimHost(with_multirotors(SimOptions(world="room", seed=4, wind=0.0)))
    with firmware(host, video=("127.0.0.1", port)) as it:
        driver, sink = MavlinkDriver(parse_uri(f"{it.address}?camera=udp://127.0.0.1:{port}")), RecordingSink()
        driver.open(sink)
        try:
            assert sink.wait(lambda: sink.frame_counts["front"] >= 5, 20.0), list(sink.events)
            frame = sink.frames[-1]
            assert (frame.width, frame.height) == (320, 240)
            assert float(np.std(frame.pixels)) > 10.0
            assert frame.arrived_ns - frame.captured_ns < 1e9
        finally:
            driver.close()


def test_a_missing_camera_is_reported_and_does_no_harm() -> None:
    pytest.importorskip("av")
    with firmware() as it, opened(f"{it.address}?camera=/dev/video-of-nobody") as (_, sink):
        up(sink)
        wait_until(lambda: any("there is no such device" in event.text for event in sink.events), "it is reported")

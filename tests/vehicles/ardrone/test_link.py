"""The driver on real sockets: an emulated drone with a bad radio, one that disappears, and none at all."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.registry import make_driver
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import (
    Attitude,
    EmergencyStop,
    EventKind,
    FlightState,
    Hover,
    Land,
    LinkState,
    Refusal,
    ResetEmergency,
    Takeoff,
)
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Faults, Ports
from skyloop.vehicles.ardrone.protocol import ArdroneSession

NO_FAULTS = Faults()
PATIENCE_S = 15.0


@contextmanager
def firmware(faults: Faults = NO_FAULTS, *, version: int = 2) -> Iterator[ArdroneFirmware]:
    world = SimHost(SimOptions(world="empty", seed=3, wind=0.0, speed=2.0, rate_hz=125.0, cameras=()))
    with ArdroneFirmware(world, version=version, ports=Ports.free(), faults=faults) as drone:
        yield drone


@contextmanager
def opened(ports: Ports, options: str = "") -> Iterator[tuple[Driver, RecordingSink]]:
    driver = make_driver(
        f"ardrone://127.0.0.1?navdata_port={ports.navdata}&at_port={ports.at}&video_port={ports.video}"
        f"&control_port={ports.control}{options}"
    )
    sink = RecordingSink()
    driver.open(sink)
    try:
        yield driver, sink
    finally:
        driver.close()
    assert not sink.problems


def wait_up(sink: RecordingSink) -> None:
    assert sink.wait(lambda: sink.link_state is LinkState.UP, PATIENCE_S), sink.links


def wait_state(sink: RecordingSink, *states: FlightState) -> None:
    assert sink.wait(lambda: sink.newest is not None and sink.newest.state in states, PATIENCE_S), sink.newest


def test_a_flight_with_a_tenth_of_the_datagrams_lost() -> None:
    faults = Faults(seed=5, drop=0.1, duplicate=0.02, reorder=0.02)
    with firmware(faults) as drone, opened(drone.ports, "&video=0") as (driver, sink):
        wait_up(sink)
        assert driver.set_parameter("limits.tilt", 0.25) == pytest.approx(0.25)
        driver.apply(Takeoff())
        wait_state(sink, FlightState.HOVERING, FlightState.FLYING)
        assert driver.apply(Attitude(pitch=0.5)) == Attitude(pitch=0.25)
        assert sink.wait(
            lambda: sink.newest is not None and sink.newest.pitch_rad is not None and sink.newest.pitch_rad > 0.1,
            PATIENCE_S,
        )
        driver.apply(Hover())
        driver.apply(Land())
        wait_state(sink, FlightState.LANDED)
        newest = sink.newest
        assert newest is not None
        assert newest.native is not None
        missed, late = newest.native["navdata.missed"], newest.native["navdata.late"]
        assert isinstance(missed, int)
        assert isinstance(late, int)
        assert missed > 0
        assert late > 0


def test_an_ardrone_1_is_detected() -> None:
    with firmware(version=1) as drone, opened(drone.ports) as (driver, sink):
        wait_up(sink)
        assert sink.wait(lambda: sink.frame_counts["front"] > 0, PATIENCE_S)
        assert (sink.frames[0].width, sink.frames[0].height) == (320, 240)
        names = {parameter.name for parameter in driver.parameters()}
        assert "ardrone.network.at_port" in names
        assert "ardrone.absolute_control" not in names
        driver.apply(Takeoff())
        wait_state(sink, FlightState.HOVERING, FlightState.FLYING)
        assert driver.set_parameter("ardrone.flight_animation", "yaw_shake") == "yaw_shake"
        driver.apply(Land())
        wait_state(sink, FlightState.LANDED)


def test_a_drone_that_is_switched_off_and_on_in_flight() -> None:
    with firmware() as drone, opened(drone.ports, "&video=0") as (driver, sink):
        wait_up(sink)
        driver.set_parameter("limits.tilt", 0.15)
        driver.apply(Takeoff())
        wait_state(sink, FlightState.HOVERING, FlightState.FLYING)
        drone.stop()
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, PATIENCE_S)
        driver.failsafe(Hover())
        drone.start()
        wait_up(sink)
        limits = {parameter.name: parameter.value for parameter in driver.parameters()}
        assert limits["limits.tilt"] == pytest.approx(0.15), "forgotten values were written again"
        driver.failsafe(Land())
        wait_state(sink, FlightState.LANDED)


def test_an_emergency_is_reported_and_reset_only_on_request() -> None:
    with firmware() as drone, opened(drone.ports, "&video=0&navdata=full") as (driver, sink):
        wait_up(sink)
        driver.apply(Takeoff())
        wait_state(sink, FlightState.HOVERING, FlightState.FLYING)
        driver.apply(EmergencyStop())
        wait_state(sink, FlightState.EMERGENCY)
        assert sink.wait(lambda: any(event.kind is EventKind.EMERGENCY for event in sink.events), PATIENCE_S)
        event = next(event for event in sink.events if event.kind is EventKind.EMERGENCY)
        assert "user" in str(event.data["reason"])
        for _ in range(20):
            driver.apply(Hover())
            assert sink.wait(lambda: True, 0.01)
        assert sink.newest is not None
        assert sink.newest.state is FlightState.EMERGENCY
        assert sink.wait(lambda: sink.newest is not None and (sink.newest.altitude_m or 0.0) < 0.1, PATIENCE_S)
        driver.apply(ResetEmergency())
        wait_state(sink, FlightState.LANDED)


def test_parameters_that_the_drone_refuses() -> None:
    with firmware() as drone, opened(drone.ports, "&video=0&navdata=full") as (driver, sink):
        wait_up(sink)
        with pytest.raises(ParameterError, match="did not accept") as caught:
            driver.set_parameter("ardrone.control.altitude_max", 10**9)
        assert caught.value.code == "refused"
        with pytest.raises(UnknownNameError, match=r"limits\.tilt"):
            driver.set_parameter("limits.tild", 0.1)
        drone.stop()
        with pytest.raises(ParameterError) as lost:
            driver.set_parameter("limits.tilt", 0.1)
        assert lost.value.code in (Refusal.DRIVER_FAILED, Refusal.VEHICLE_LINK_LOST)


def test_the_bottom_camera() -> None:
    with firmware() as drone, opened(drone.ports, "&navdata=full") as (driver, sink):
        wait_up(sink)
        assert sink.wait(lambda: sink.frame_counts["front"] > 0, PATIENCE_S)
        assert driver.set_parameter("camera.active", "bottom") == "bottom"
        assert sink.wait(lambda: sink.frame_counts["bottom"] > 3, PATIENCE_S)
        newest = sink.newest
        assert newest is not None
        assert newest.native is not None
        assert "video.frames" in newest.native


def test_garbage_on_the_navdata_port() -> None:
    """Datagrams from a stranger at the drone's address and port do not end the thread."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger, opened(_ports_of(stranger)) as (_, sink):
        stranger.settimeout(PATIENCE_S)
        _, address = stranger.recvfrom(64)
        for datagram in (b"", b"\x88\x77\x66\x55", bytes(60_000), b"\xff" * 4096, b"\x88\x77\x66\x55" * 1000):
            stranger.sendto(datagram, address)
        for _ in range(3):
            assert stranger.recvfrom(64)[0] == b"\x01\x00\x00\x00", "it keeps requesting navdata"
        assert not [event for event in sink.events if event.kind is EventKind.DRIVER_ERROR]


def test_an_internal_error_is_reported_and_does_not_end_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = iter(range(1000))
    poll = ArdroneSession.poll

    def faulty(self: ArdroneSession, now_ns: int) -> bytes:
        if next(calls) == 3:
            raise RuntimeError("a fault")
        return poll(self, now_ns)

    monkeypatch.setattr(ArdroneSession, "poll", faulty)
    with firmware() as drone, opened(drone.ports, "&video=0") as (_, sink):
        wait_up(sink)
        failures = [event for event in sink.events if event.kind is EventKind.DRIVER_ERROR]
        assert [event.text for event in failures] == ["the link to the vehicle failed: RuntimeError('a fault')"]


def test_no_drone() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        ports = _ports_of(taken)
    with opened(ports) as (driver, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, PATIENCE_S)
        assert "no navdata from 127.0.0.1" in sink.links[-1][1]
        assert driver.failsafe(Land()), "the drone may receive it"
        with pytest.raises(ParameterError, match="not been read yet"):
            driver.set_parameter("limits.tilt", 0.1)


def test_a_host_without_an_address() -> None:
    driver = make_driver("ardrone://no-such-host.invalid")
    sink = RecordingSink()
    driver.open(sink)
    try:
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, PATIENCE_S)
        assert "no-such-host.invalid" in sink.links[-1][1]
    finally:
        driver.close()


def test_closing_while_a_parameter_is_written() -> None:
    with firmware() as drone, opened(drone.ports, "&video=0") as (driver, sink):
        wait_up(sink)
        failures: list[Exception] = []

        def write() -> None:
            try:
                for tilt in range(1, 30):
                    driver.set_parameter("limits.tilt", 0.1 + tilt / 100)
            except ParameterError as error:
                failures.append(error)

        writer = threading.Thread(target=write)
        writer.start()
        driver.close()
        writer.join(PATIENCE_S)
        assert not writer.is_alive()
        assert failures


def _ports_of(navdata: socket.socket) -> Ports:
    """Return this socket as the navdata port, and other ports without a listener."""
    navdata.bind(("127.0.0.1", 0))
    return Ports(navdata=navdata.getsockname()[1], video=9, at=9, control=9)

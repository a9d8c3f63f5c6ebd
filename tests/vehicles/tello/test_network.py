"""The driver on the network: parameters, several drones, ports in use, other senders' datagrams."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.registry import make_driver
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import FlightState, LinkState, Refusal, Takeoff
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.tello.emulator import TelloFirmware, with_tellos
from tests.support.systems import only_on
from tests.support.tello_addresses import Addresses

pytest.importorskip("av")
PATIENCE_S = 20.0


@contextmanager
def emulated(drones: int = 1, speed: float = 1.0, **settings: Any) -> Iterator[list[TelloFirmware]]:
    host = SimHost(with_tellos(SimOptions(world="empty", seed=5, wind=0.0, speed=speed)), drones)
    with ExitStack() as stack:
        yield [
            stack.enter_context(TelloFirmware(host, drone, bind=Addresses.free().drone, **settings))
            for drone in range(drones)
        ]


@contextmanager
def opened(uri: str) -> Iterator[tuple[Driver, RecordingSink]]:
    driver, sink = make_driver(uri), RecordingSink(keep_pixels=False)
    driver.open(sink)
    try:
        yield driver, sink
    finally:
        driver.close()
    assert not sink.problems, sink.problems


def up(sink: RecordingSink) -> None:
    assert sink.wait(lambda: sink.link_state is LinkState.UP, PATIENCE_S), sink.links


def address(firmware: TelloFirmware, **options: object) -> str:
    local = Addresses.free().pilot
    more = "".join(f"&{name}={value}" for name, value in options.items())
    return f"tello://{firmware.settings.bind}?local={local}{more}"


def test_two_drones_through_two_addresses_of_this_host() -> None:
    with emulated(2) as (one, two), ExitStack() as stack:
        _, first = stack.enter_context(opened(address(one, video=0)))
        second_driver, second = stack.enter_context(opened(address(two, video=0)))
        up(first)
        up(second)
        second_driver.apply(Takeoff())
        assert second.wait(lambda: second.newest is not None and second.newest.state.airborne, PATIENCE_S)
        assert first.newest is not None
        assert first.newest.state is FlightState.LANDED


def test_two_drones_through_two_pairs_of_ports() -> None:
    local = Addresses.free().pilot
    with emulated(2) as (one, two), ExitStack() as stack:
        uris = [
            f"tello://{one.settings.bind}?local={local}",
            f"tello://{two.settings.bind}?local={local}&state_port=8891&video_port=11112",
        ]
        sinks = [stack.enter_context(opened(uri))[1] for uri in uris]
        for sink in sinks:
            up(sink)
            assert sink.wait(lambda sink=sink: sink.frame_counts["front"] > 2, PATIENCE_S)  # type: ignore[misc]


def test_a_port_in_use_is_reported_and_taken_when_free() -> None:
    addresses = Addresses.free()
    with (
        emulated() as (firmware,),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        other.bind((addresses.pilot, 8890))
        uri = f"tello://{firmware.settings.bind}?local={addresses.pilot}&video=0"
        with opened(uri) as (_, sink):
            assert sink.wait(lambda: sink.link_state is LinkState.LOST, PATIENCE_S)
            assert f"UDP port 8890 on {addresses.pilot} is in use" in sink.links[-1][1]
            other.close()
            up(sink)


def test_a_missing_interface_is_reported() -> None:
    with opened("tello://127.0.0.1?interface=nosuch0&video=0") as (_, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, PATIENCE_S)
        assert "nosuch0" in sink.links[-1][1]


@only_on("linux", reason="sockets are bound to no interface there")
def test_the_loopback_interface_can_be_named() -> None:
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
    except OSError as error:
        pytest.skip(f"this system does not let us name an interface: {error}")
    with emulated() as (firmware,), opened(address(firmware, video=0, interface="lo")) as (_, sink):
        up(sink)


def test_datagrams_of_others_are_ignored() -> None:
    addresses = Addresses.free()
    with (
        emulated() as (firmware,),
        opened(f"tello://{firmware.settings.bind}?local={addresses.pilot}&video=0") as (_, sink),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        up(sink)
        stranger.bind((addresses.drone, 0))  # not the drone's port
        for _ in range(20):
            stranger.sendto(b"bat:1;h:500;tof:500;time:999;", (addresses.pilot, 8890))
        count = sink.feedback_count
        assert sink.wait(lambda: sink.feedback_count > count + 5, PATIENCE_S)
        assert all(feedback.battery == 1.0 for feedback in sink.feedbacks)


def test_parameters_reach_the_drone() -> None:
    with emulated() as (firmware,), opened(address(firmware, video=0)) as (driver, sink):
        up(sink)
        board = firmware.logic
        for name, value in (
            ("camera.active", "bottom"),
            ("camera.fps", 15),
            ("camera.resolution", "low"),
            ("camera.bitrate", 3),
            ("tello.mission_pads", True),
            ("tello.mission_pad_direction", "forward"),
        ):
            assert driver.set_parameter(name, value) == value
        assert (board.looks_down, board.fps, board.size, board.bitrate_mbps) == (True, 15.0, (640, 480), 3)
        assert board.looks_for_pads
        assert driver.set_parameter("limits.speed", 0.4) == 0.4
        told = {parameter.name: parameter.value for parameter in driver.parameters()}
        assert told["camera.fps"] == 15
        assert told["limits.speed"] == 0.4
        assert told["tello.sdk"] == "3.0"


@pytest.mark.parametrize(
    ("name", "value", "said", "code"),
    [
        ("camera.fps", 20, "no camera.fps named '20'", Refusal.OUT_OF_RANGE),
        ("camera.fps", "15", "takes a int", Refusal.WRONG_TYPE),
        ("limits.speed", "fast", "takes a number", Refusal.WRONG_TYPE),
        ("limits.speed", 99.0, "from 0.05 to 10", Refusal.OUT_OF_RANGE),
        ("tello.flip", "over", "no tello.flip named 'over'", Refusal.OUT_OF_RANGE),
        ("tello.flip", "left", "take off first", Refusal.WRONG_STATE),
        ("tello.sdk", "9", "can only be read", Refusal.READ_ONLY),
    ],
)
def test_bad_parameters_are_refused(name: str, value: object, said: str, code: Refusal) -> None:
    with emulated() as (firmware,), opened(address(firmware, video=0)) as (driver, sink):
        up(sink)
        with pytest.raises(ParameterError, match=said) as refused:
            driver.set_parameter(name, value)  # type: ignore[arg-type]
        assert refused.value.code is code


def test_an_old_drone_has_fewer_parameters() -> None:
    with emulated(sdk="1.3") as (firmware,), opened(address(firmware, video=0)) as (driver, sink):
        up(sink)
        names = {parameter.name for parameter in driver.parameters()}
        assert not {name for name in names if name.startswith(("camera.", "tello.mission"))}
        with pytest.raises(UnknownNameError):
            driver.set_parameter("camera.fps", 15)


def test_a_flip_is_sent_once_and_a_busy_drone_refuses_settings() -> None:
    with emulated(speed=3.0) as (firmware,), opened(address(firmware, video=0)) as (driver, sink):
        up(sink)
        driver.apply(Takeoff())
        with pytest.raises(ParameterError, match="does not reply while taking off"):
            driver.set_parameter("camera.fps", 15)
        assert sink.wait(lambda: sink.newest is not None and sink.newest.state is FlightState.HOVERING, PATIENCE_S)
        assert driver.set_parameter("tello.flip", "back") == "back"
        assert driver.set_parameter("tello.flip", "none") == "none"


def test_parameters_cannot_be_written_before_opening() -> None:
    driver = make_driver("tello://127.0.0.1")
    assert driver.parameters() == []
    with pytest.raises(ParameterError, match="is not open"):
        driver.set_parameter("limits.speed", 1.0)

"""The emulated AR.Drone over its sockets, as seen by a plain client."""

from __future__ import annotations

import random
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import astuple

import pytest

from skyloop.errors import LinkError, UsageError
from skyloop.messages import FlightState
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.transport.testing import wait_until
from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Faults, Ports, with_ardrones
from skyloop.vehicles.ardrone.wire import navdata as o
from skyloop.vehicles.ardrone.wire.navdata import Navdata, State
from skyloop.vehicles.ardrone.wire.pave import PaveFrame, PaveParser
from skyloop.vehicles.ardrone.wire.uvlc import UvlcDecoder
from tests.support.ardrone_pilot import EMERGENCY, HERE, LAND, TAKE_OFF, Pilot

av = pytest.importorskip("av")
pytest.importorskip("cv2")

FAST = 5.0
Switch = Callable[..., ArdroneFirmware]


@pytest.fixture
def switch_on() -> Iterator[Switch]:
    """Emulated drones that are switched off at the end of the test."""
    with ExitStack() as running:

        def make(*, host: SimHost | None = None, speed: float = FAST, **settings: object) -> ArdroneFirmware:
            host = host or SimHost(with_ardrones(SimOptions(world="empty", wind=0.0, seed=1, speed=speed)))
            firmware = ArdroneFirmware(host, ports=Ports.free(), **settings)  # type: ignore[arg-type]
            return running.enter_context(firmware)

        yield make


@pytest.fixture
def drone(switch_on: Switch) -> ArdroneFirmware:
    return switch_on()


@pytest.fixture
def pilot(drone: ArdroneFirmware) -> Iterator[Pilot]:
    with Pilot(drone.ports) as made:
        yield made


def in_state(major: int) -> Callable[[Navdata], bool]:
    def reached(navdata: Navdata) -> bool:
        demo = navdata.get(o.Demo)
        return demo is not None and demo.ctrl_state >> 16 == major

    return reached


def take_off(pilot: Pilot) -> None:
    pilot.ref = TAKE_OFF
    pilot.until(in_state(4), "it hovers")


# Navdata and configuration -------------------------------------------------------------------------------------


def test_navdata_begins_with_the_bootstrap_and_then_follows_the_configuration(pilot: Pilot) -> None:
    first = pilot.until(lambda n: True, "something comes")
    assert first.sequence == 1
    assert first.options == {}
    assert first.state & State.BOOTSTRAP
    pilot.configure("general:navdata_demo", "TRUE")
    demo = pilot.until(lambda n: n.options, "options come")
    assert set(demo.options) == {o.Demo, o.VisionDetect}
    assert demo.state & (State.DEMO | State.BOOTSTRAP) == State.DEMO
    pilot.configure("general:navdata_demo", "FALSE")
    full = pilot.until(lambda n: len(n.options) > 2, "all options arrive")
    assert len(full.options) == 28
    pilot.configure("general:navdata_options", str(1 << 1 | 1 << 27))
    assert set(pilot.until(lambda n: len(n.options) == 2, "the chosen ones arrive").options) == {o.Time, o.Gps}
    assert [n.sequence for n in pilot.seen] == list(range(1, len(pilot.seen) + 1))


def test_the_rates_of_demo_and_full_navdata(pilot: Pilot) -> None:
    rates = {}
    for demo, count in (("TRUE", 10), ("FALSE", 60)):
        pilot.configure("general:navdata_demo", demo)
        pilot.until(lambda n: bool(n.state & State.DEMO) is (demo == "TRUE"), "the mode is changed")  # noqa: B023
        begun_s, last = time.monotonic(), pilot.seen[-1].sequence + count
        pilot.until(lambda n: n.sequence >= last, "enough arrived")  # noqa: B023
        rates[demo] = count / (time.monotonic() - begun_s)
    # 15 a second and, here, some 100; fewer on a busy machine.
    assert 4 < rates["TRUE"] < 20
    assert 1.5 * rates["TRUE"] < rates["FALSE"] < 140


def test_several_clients_are_answered_at_their_own_ports(drone: ArdroneFirmware, pilot: Pilot) -> None:
    pilot.until(lambda n: n.sequence > 3, "navdata for the first one")
    with Pilot(drone.ports) as other:
        other.speaks = False
        assert other.until(lambda n: True, "navdata for the other one").sequence == 1
        pilot.until(lambda n: True, "more navdata for the first one")


def test_the_configuration_is_read_over_the_control_port(pilot: Pilot) -> None:
    pilot.configure("control:altitude_max", "2500")
    dump = pilot.read_configuration()
    assert dump["control:altitude_max"] == "2500"
    assert len(dump) == 103
    pilot.until(lambda n: n.state & State.COMMAND_ACK, "the dump is acknowledged")
    pilot.say("CONFIG", "custom:session_id", "0000000a")
    assert pilot.read_configuration(6) == {}  # ids, not keys


# Flight --------------------------------------------------------------------------------------------------------


def test_a_flight(drone: ArdroneFirmware, pilot: Pilot) -> None:
    pilot.configure("general:navdata_demo", "FALSE")
    take_off(pilot)
    assert 0.7 < drone.host.simulation.truth(0).position_m[2] < 1.1
    pilot.pcmd = (1, 0.0, -0.5, 0.0, 0.0)
    demo = pilot.until(lambda n: n.options[o.Demo].vx > 500, "it flies forward").get(o.Demo)
    assert demo is not None
    pilot.pcmd = (1, 0.0, 0.0, 0.0, 1.0)
    before = drone.host.simulation.truth(0).yaw_rad
    pilot.until(lambda n: drone.host.simulation.truth(0).yaw_rad < before - 0.2, "it turns clockwise")
    pilot.ref = LAND
    pilot.until(in_state(2), "it has landed")
    assert drone.host.simulation.state(0) is FlightState.LANDED


def test_the_motors_are_cut_and_the_emergency_is_reset(pilot: Pilot) -> None:
    pilot.configure("general:navdata_demo", "FALSE")
    take_off(pilot)
    pilot.ref = TAKE_OFF | EMERGENCY
    down = pilot.until(lambda n: n.state & State.EMERGENCY, "the motors are cut")
    assert down.state & State.USER_EMERGENCY
    pilot.ref = LAND
    pilot.until(lambda n: abs(n.options[o.Demo].altitude) < 60, "it has fallen")
    pilot.ref = EMERGENCY
    pilot.until(lambda n: not n.state & State.EMERGENCY, "the emergency is over")
    take_off(pilot)


def test_a_drone_without_its_pilot_lands(drone: ArdroneFirmware, pilot: Pilot) -> None:
    pilot.configure("general:navdata_demo", "FALSE")
    take_off(pilot)
    pilot.pcmd = (1, 0.0, -0.3, 0.0, 0.0)
    pilot.until(in_state(3), "it flies")
    pilot.speaks = False
    pilot.until(in_state(4), "it hovers")
    lost = pilot.until(lambda n: n.state & State.COMMUNICATION_LOST, "the link is lost")
    assert lost.state & (State.COMMUNICATION_WATCHDOG | State.BOOTSTRAP)
    wait_until(lambda: drone.host.simulation.state(0) is FlightState.LANDED, "it has landed")


def test_a_low_battery_lands_it(drone: ArdroneFirmware, pilot: Pilot) -> None:
    pilot.configure("general:navdata_demo", "FALSE")
    take_off(pilot)
    drone.host.simulation.set_charge(0, 0.02)
    pilot.until(lambda n: n.state & State.BATTERY_LOW and in_state(2)(n), "it has landed")
    pilot.say("REF", TAKE_OFF)
    pilot.until(lambda n: n.state & State.START_BUTTON, "the command arrived")
    assert drone.host.simulation.state(0) is FlightState.LANDED


# Video ---------------------------------------------------------------------------------------------------------


def frames(drone: ArdroneFirmware, count: int, parser: PaveParser | None = None) -> list[PaveFrame]:
    """Return this many frames of a new connection."""
    parser, taken = parser or PaveParser(), list[PaveFrame]()
    with socket.create_connection((HERE, drone.ports.video), 5) as video:
        video.settimeout(10)
        while len(taken) < count:
            data = video.recv(65536)
            assert data, "the drone closed the connection"
            taken += parser.feed(data)
    assert parser.skipped_bytes == 0
    return taken


def test_video_is_decoded_and_shows_the_world(drone: ArdroneFirmware) -> None:
    context = av.CodecContext.create("h264", "r")
    taken = frames(drone, 8)
    assert taken[0].is_key
    pictures = [picture for frame in taken for picture in context.decode(av.Packet(frame.payload))]
    image = pictures[-1].to_ndarray(format="bgr24")
    assert image.shape == (360, 640, 3)
    assert image.std() > 10, "a picture of something"
    stamps = [frame.timestamp_ms for frame in taken]
    assert stamps == sorted(stamps)


def test_a_second_client_begins_with_a_stale_picture_in_the_middle(drone: ArdroneFirmware) -> None:
    stale = frames(drone, 5)[-1]
    wait_until(lambda: not drone.logic.state(video=False) & State.VIDEO, "nobody looks")
    first, *others = frames(drone, 3)
    assert not first.is_key
    assert first.number >= stale.number
    assert others[0].number > first.number


def test_without_a_torn_start_a_client_begins_with_a_key_frame(switch_on: Switch) -> None:
    drone = switch_on(torn_start=False, header_size=64)
    frames(drone, 3)
    assert frames(drone, 1)[0].is_key


def test_the_channel_and_the_codec_are_switched_in_flight(drone: ArdroneFirmware, pilot: Pilot) -> None:
    pilot.until(lambda n: True, "it is there")
    for key, value in (("codec_fps", "15"), ("video_codec", "131"), ("video_channel", "1")):
        pilot.configure(f"video:{key}", value)
    taken = frames(drone, 3)
    assert {(frame.width, frame.height) for frame in taken if frame.number > 1} == {(1280, 720)}
    assert drone.logic.video.fps == 15


def test_the_video_of_an_ar_drone_1_arrives_in_datagrams(switch_on: Switch) -> None:
    drone = switch_on(version=1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as video:
        video.settimeout(10)
        video.sendto(b"\1\0\0\0", (HERE, drone.ports.video))
        decoder = UvlcDecoder()
        pictures = [decoder.decode(video.recv(65_535)) for _ in range(2)]
    assert [picture.pixels.shape for picture in pictures] == [(240, 320, 3)] * 2
    assert pictures[1].number == pictures[0].number + 1
    assert pictures[1].pixels.std() > 10


def test_an_ar_drone_1_stops_sending_pictures_when_its_pilot_is_gone(switch_on: Switch) -> None:
    drone = switch_on(version=1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as video, Pilot(drone.ports) as pilot:
        video.sendto(b"\1", (HERE, drone.ports.video))
        pilot.until(lambda n: n.state & State.VIDEO, "pictures are sent")
        pilot.speaks = False
        pilot.until(lambda n: n.state & State.COMMUNICATION_LOST, "the link is lost")
        pilot.until(lambda n: not n.state & State.VIDEO, "no pictures are sent")


# Robustness ----------------------------------------------------------------------------------------------------


def test_garbage_on_every_port_is_survived(drone: ArdroneFirmware, pilot: Pilot) -> None:
    noise = random.Random(4)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for _ in range(200):
            garbage = noise.randbytes(noise.randrange(0, 1500))
            for port in (drone.ports.at, drone.ports.navdata):
                stranger.sendto(garbage, (HERE, port))
    for port in (drone.ports.control, drone.ports.video):
        with socket.create_connection((HERE, port), 5) as client:
            client.sendall(noise.randbytes(50_000))
    pilot.configure("general:navdata_demo", "FALSE")
    pilot.until(in_state(2), "it works")


def test_a_flight_over_a_bad_link(switch_on: Switch) -> None:
    drone = switch_on(faults=Faults(seed=5, drop=0.1, duplicate=0.05, reorder=0.05), delay_s=0.01)
    with Pilot(drone.ports) as pilot:
        pilot.configure("general:navdata_demo", "FALSE")
        take_off(pilot)
        pilot.ref = LAND
        pilot.until(in_state(2), "it has landed")
        numbers = [n.sequence for n in pilot.seen]
    assert numbers[-1] > len(set(numbers)), "some were lost"
    assert len(set(numbers)) < len(numbers), "some arrived twice"


def test_a_restart_in_flight_on_the_same_ports(drone: ArdroneFirmware, pilot: Pilot) -> None:
    pilot.configure("general:navdata_demo", "FALSE")
    take_off(pilot)
    before = drone.ports
    with socket.create_connection((HERE, before.video), 5):
        drone.stop()
        with pytest.raises(UsageError, match="not started"):
            _ = drone.ports
        drone.start()
    assert astuple(drone.ports) == astuple(before)
    pilot.seen.clear()  # so that it requests navdata again
    assert pilot.until(lambda n: True, "it is there again").state & State.BOOTSTRAP
    pilot.configure("general:navdata_demo", "FALSE")
    assert in_state(4)(pilot.until(lambda n: n.options, "options arrive")), "the vehicle hovered meanwhile"
    pilot.ref = LAND
    pilot.until(in_state(2), "it has landed")


def test_two_drones_share_a_world(switch_on: Switch) -> None:
    host = SimHost(with_ardrones(SimOptions(world="empty", wind=0.0, speed=FAST)), drones=2)
    first, second = switch_on(host=host), switch_on(host=host, drone=1)
    with Pilot(first.ports) as one, Pilot(second.ports) as other:
        for pilot in (one, other):
            pilot.configure("general:navdata_demo", "FALSE")
        take_off(one)
        assert in_state(2)(other.until(lambda n: n.options, "the other one sends navdata"))
    assert host.simulation.state(1) is FlightState.LANDED


# Refusals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings", [{"version": 3}, {"header_size": 60}, {"delay_s": -1.0}, {"delay_s": float("nan")}]
)
def test_impossible_settings_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        ArdroneFirmware(SimHost(SimOptions(world="empty")), **settings)  # type: ignore[arg-type]


def test_ports_in_use_are_refused_without_leaks(drone: ArdroneFirmware) -> None:
    host = SimHost(SimOptions(world="empty"))
    with pytest.raises(LinkError, match="navdata port"):
        ArdroneFirmware(host, ports=drone.ports).start()
    with ArdroneFirmware(host, ports=Ports.free()) as another:
        with pytest.raises(UsageError, match="already running"):
            another.start()
        with pytest.raises(UsageError, match="already taken"):
            ArdroneFirmware(host, ports=Ports.free()).start()


@pytest.mark.parametrize("version", [1, 2])
def test_drones_on_free_ports_share_none(version: int) -> None:
    world = SimHost(with_ardrones(SimOptions(world="empty", seed=1)), 3)
    with ExitStack() as stack:
        made = [ArdroneFirmware(world, drone, version=version, ports=Ports.free()) for drone in range(3)]
        several = [astuple(stack.enter_context(firmware).ports) for firmware in made]
        for kind in zip(*several, strict=True):
            assert len({*kind}) == 3
        datagrams = [port for navdata, video, at, _ in several for port in (navdata, at, video)[: 4 - version]]
        assert len({*datagrams}) == len(datagrams)

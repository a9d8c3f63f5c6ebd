"""Flights to a place and back to the start: the proxy's on simulated vehicles, the autopilots' on emulated ones."""

from __future__ import annotations

import asyncio
import math
import queue
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from skyloop import aio
from skyloop.client import Drone, Swarm
from skyloop.client.drone import open_drone
from skyloop.clock import NS_PER_S
from skyloop.drivers.registry import make_driver
from skyloop.errors import NoAnswerError, RefusedError, SwarmError, UnknownNameError, UsageError
from skyloop.messages import Applied, EventKind, Feedback, FlightState, Hover, Vector, Velocity
from skyloop.proxy import Proxy
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.transport.memory import MemoryServer
from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors
from skyloop.vehicles.mavlink.emulator.manoeuvres import ORIGIN
from skyloop.vehicles.tello.emulator import TelloFirmware, with_tellos
from tests.support.scripted_proxy import WAIT_S
from tests.support.tello_addresses import Addresses

SIM = "sim://?world=empty&seed=2&wind=0&noise=0&cameras=none"
KINDS = {kind.value: kind for kind in Kind}
AUTOPILOTS = [pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS]
LONG_S = 60.0


@contextmanager
def flown(vehicle: str) -> Iterator[Drone]:
    """A drone in the air, given the address of a simulated one or the kind of an emulated autopilot."""
    with ExitStack() as stack:
        address = vehicle
        if vehicle in KINDS:
            world = SimHost(with_multirotors(SimOptions(world="empty", seed=4, wind=0.0)))
            kind = KINDS[vehicle]
            address = stack.enter_context(MavlinkFirmware(world, kind=kind, ports=Ports.free(kind), boot_s=0.5)).address
        server = MemoryServer("v")
        proxy = Proxy(make_driver(address), server, name="v")
        proxy.start()
        stack.callback(proxy.end)
        drone = stack.enter_context(open_drone(server.dial, app="me", on_exit="hover", timeout_s=WAIT_S))
        drone.wait(lambda feedback: feedback.vehicle_link == "up" and feedback.position_m is not None, LONG_S)
        drone.takeoff(timeout_s=LONG_S)
        yield drone


def place(feedback: Feedback) -> tuple[float, float, float]:
    assert feedback.position_m is not None
    return feedback.position_m


@pytest.mark.parametrize("vehicle", [SIM, *AUTOPILOTS])
def test_a_refused_place_is_not_flown_to_afterwards(vehicle: str) -> None:
    """``go_to(z=-4, wait=False)`` was refused, yet 3 s later its repeats had flown the vehicle to the floor."""
    with flown(vehicle) as drone:
        refused: queue.Queue[str] = queue.Queue()
        drone.on_event(lambda event: refused.put(event.text) if event.kind is EventKind.COMMAND_REFUSED else None)
        x, y, z = place(drone.feedback())
        drone.go_to(x=x + 1.0, y=y, z=z - 5.0, wait=False)
        assert "position refused: " in refused.get(timeout=WAIT_S)
        end_ns = drone.feedback().captured_ns + 4 * NS_PER_S
        while (now := drone.next_feedback()).captured_ns < end_ns:
            assert now.state.airborne
            assert math.dist(place(now), (x, y, z)) < 0.5


@pytest.mark.parametrize("vehicle", [SIM, SIM + "&native=velocity", SIM + "&native=attitude", *AUTOPILOTS])
def test_round_trip(vehicle: str) -> None:
    with flown(vehicle) as drone:
        native = "position" in drone.capabilities.actions
        assert native is (vehicle in KINDS)
        assert ("position" in drone.capabilities.software) is not native
        echoes: list[Applied] = []
        with drone.on_command(echoes.append, inline=True):
            x, y, z = place(drone.feedback())
            speeds: list[float] = []
            with drone.on_feedback(
                lambda feedback: speeds.append(math.hypot(*(feedback.velocity_m_s or ()))), inline=True
            ):
                drone.go_to(x=x + 2.0, y=y - 1.0, z=z + 0.6, yaw=1.0, speed=0.8, timeout_s=LONG_S)
            there = drone.feedback()
            assert math.dist(place(there), (x + 2.0, y - 1.0, z + 0.6)) <= 0.2
            assert there.yaw_rad == pytest.approx(1.0, abs=0.16)
            assert max(speeds) < 0.8 + 0.3, "it exceeded the requested speed by more than its overshoot"
            drone.go_to(x=x, y=y, z=z, timeout_s=LONG_S)
            back = drone.feedback()
            assert math.dist(place(back), (x, y, z)) <= 0.2
            assert back.yaw_rad == pytest.approx(1.0, abs=0.2), "the heading is kept"
        kinds = {type(echo.applied) for echo in echoes if echo.app_id == 0}
        assert kinds <= ({Hover} if native else {Velocity, Hover, *kinds}), (
            "the proxy steers only what the vehicle can't do itself"
        )
        drone.velocity(up=0.2)
        drone.wait("flying", WAIT_S)
        drone.hover()
        drone.wait("hovering", LONG_S)


def test_a_simulated_room_is_not_left() -> None:
    with flown("sim://?cameras=none") as drone:
        here = place(drone.feedback())
        assert drone.config["safety.room"] == "box -4 -3 0 4 3 3"
        for x, y, z in ((50.0, 0.0, -3.0), (0.0, 0.0, -0.5), (0.0, 3.5, 1.0)):
            with pytest.raises(RefusedError, match=r"outside the room, box .* \(safety\.room\)"):
                drone.go_to(x=x, y=y, z=z, timeout_s=LONG_S)
        assert math.dist(place(drone.feedback()), here) < 0.3


@pytest.mark.parametrize("vehicle", AUTOPILOTS)
def test_a_place_on_the_earth(vehicle: str) -> None:
    with flown(vehicle) as drone:
        drone.wait(lambda feedback: feedback.origin is not None, LONG_S)
        feedback = drone.feedback()
        origin, (x, y, z) = feedback.origin, place(feedback)
        assert origin is not None
        assert (origin.latitude_deg, origin.longitude_deg) == pytest.approx(ORIGIN[:2], abs=2e-6), (
            "the emulated earth is slightly rounder than the autopilot's: 0.2 m at most here"
        )
        latitude_deg, longitude_deg, altitude_m = origin.place_of((x + 2.0, y + 1.0, z + 0.5))
        drone.go_to(latitude_deg=latitude_deg, longitude_deg=longitude_deg, altitude_m=altitude_m, timeout_s=LONG_S)
        assert math.dist(place(drone.feedback()), (x + 2.0, y + 1.0, z + 0.5)) <= 0.25
        height_m = place(drone.feedback())[2]
        latitude_deg, longitude_deg, _ = origin.place_of((x, y, z))
        drone.go_to(latitude_deg=latitude_deg, longitude_deg=longitude_deg, timeout_s=LONG_S)
        assert math.dist(place(drone.feedback()), (x, y, height_m)) <= 0.35, "it did not stay at its height"
        with pytest.raises(UsageError, match=r"must be within 100000 m of the vehicle's origin"):
            drone.go_to(latitude_deg=0.0, longitude_deg=0.0)


def test_a_vehicle_that_does_not_know_its_place_on_the_earth_refuses_latitudes() -> None:
    with (
        flown(SIM) as drone,
        pytest.raises(RefusedError, match="does not report its geographic position"),
    ):
        drone.go_to(latitude_deg=47.0, longitude_deg=8.0)


@pytest.mark.parametrize("vehicle", [SIM, *AUTOPILOTS])
def test_walls_apply_to_the_place_and_the_way_there(vehicle: str) -> None:
    with flown(vehicle) as drone:
        x, y, z = place(drone.feedback())
        drone.config["safety.box.x_high"] = x + 1.5
        drone.config["safety.zones"] = f"cylinder {x - 1.5} {y} 0.4 0 50"
        with pytest.raises(RefusedError, match=r"outside the safety box, box .*safety\.box"):
            drone.go_to(x=x + 2.0, y=y, z=z)
        with pytest.raises(RefusedError, match="blocks the straight line"):
            drone.go_to(x=x - 3.0, y=y, z=z)
        with pytest.raises(RefusedError, match="the place is in a no-fly zone"):
            drone.go_to(x=x - 1.5, y=y, z=z)
        furthest = [x]
        with drone.on_feedback(lambda feedback: furthest.append(place(feedback)[0]), inline=True):
            drone.go_to(x=x + 1.2, y=y, z=z, speed=2.0, timeout_s=LONG_S, tolerance_m=0.3)
        assert max(furthest) < x + 1.5 + 0.1


def test_when_the_application_is_gone_on_the_way_the_failsafe_follows() -> None:
    with flown(SIM) as drone:
        x, y, z = place(drone.feedback())
        drone.go_to(x=x + 12.0, y=y, z=z, speed=1.0, wait=False)
        drone.wait(lambda feedback: place(feedback)[0] > x + 0.5, WAIT_S)
        drone.release_authority()
        drone.wait("hovering", WAIT_S)
        assert place(drone.feedback())[0] < x + 5.0
        assert drone.feedback().failsafe == "hover"


def test_a_place_too_far_for_the_time_out_is_still_flown_to() -> None:
    with flown(SIM) as drone:
        x, y, z = place(drone.feedback())
        with pytest.raises(NoAnswerError, match=r"position was not completed within 0\.5 s: the vehicle is flying"):
            drone.go_to(x=x + 3.0, y=y, z=z, timeout_s=0.5)
        drone.wait(lambda feedback: place(feedback)[0] > x + 2.0, WAIT_S)


def test_a_swarm_and_asyncio_fly_to_places() -> None:
    with ExitStack() as stack:
        servers = {name: MemoryServer(name) for name in ("a", "b")}
        for name, server in servers.items():
            proxy = Proxy(make_driver(SIM), server, name=name)
            proxy.start()
            stack.callback(proxy.end)
        drones = {name: open_drone(server.dial, app="me", timeout_s=WAIT_S) for name, server in servers.items()}
        swarm = stack.enter_context(Swarm(drones, on_error="raise"))
        swarm.takeoff(timeout_s=LONG_S)
        homes = {drone.name: place(drone.feedback()) for drone in swarm}
        places = {name: (x + 0.5, y, z + 0.2, 0.5) for name, (x, y, z) in homes.items()}
        swarm.go_to(places, speed=0.8)
        for drone in swarm:
            assert math.dist(place(drone.feedback()), places[drone.name][:3]) <= 0.2
        swarm.go_to(homes, wait=False)
        swarm.wait_all(lambda feedback: abs(place(feedback)[0] - homes["a"][0]) < 0.2, WAIT_S)
        with pytest.raises(UnknownNameError):
            swarm.go_to({"c": (0.0, 0.0, 1.0)})
        with pytest.raises(UsageError, match=r"position of a is \(0\.0, 1\.0\) and must be x, y, z"):
            swarm.go_to({"a": (0.0, 1.0)})
        with pytest.raises(SwarmError, match=r"limits\.altitude"):
            swarm.go_to({"a": (0.0, 0.0, 60.0)})
        x, y, z = homes["a"]
        asyncio.run(aio.Swarm(swarm).go_to({"a": (x, y, z + 0.3)}, timeout_s=WAIT_S))
        assert place(drones["a"].feedback())[2] == pytest.approx(z + 0.3, abs=0.2)
        asyncio.run(aio.Drone(drones["a"]).go_to(x=x, y=y, z=z, timeout_s=WAIT_S))
        assert drones["a"].feedback().state is FlightState.FLYING


# Back to the start -----------------------------------------------------------------------------------------------


def across(one: Vector, other: Vector) -> float:
    return math.dist(one[:2], other[:2])


def start(drone: Drone) -> Vector:
    assert drone.start_position is not None
    return drone.start_position


@pytest.mark.parametrize("vehicle", [SIM, *AUTOPILOTS])
def test_back_to_the_start(vehicle: str) -> None:
    with flown(vehicle) as drone:
        x, y, z = place(drone.feedback())
        assert across(start(drone), (x, y, z)) < 0.3
        drone.go_to(x=x + 1.3, y=y - 0.6, z=z, speed=1.0, timeout_s=LONG_S)
        phases = [""]
        heights = [0.0]

        def watch(feedback: Feedback) -> None:
            heights.append(place(feedback)[2])
            if phases[-1] != feedback.return_phase:
                phases.append(str(feedback.return_phase))

        top = z - start(drone)[2] + 0.8
        with drone.on_feedback(watch, inline=True):
            drone.return_to_start(top, timeout_s=LONG_S)
        assert [phase for phase in phases if phase not in ("", "none")] == ["climbing", "flying", "landing"]
        assert max(heights) == pytest.approx(start(drone)[2] + top, abs=0.35)
        assert drone.feedback().state is FlightState.LANDED
        assert across(place(drone.feedback()), start(drone)) < 0.7
        with pytest.raises(RefusedError, match="not possible while landed: take off first"):
            drone.return_to_start()
        with pytest.raises(UsageError, match="height is -1 m"):
            drone.return_to_start(-1.0)


@pytest.mark.slow
def test_above_its_start_it_stays_if_requested() -> None:
    with flown(SIM) as drone:
        x, y, z = place(drone.feedback())
        drone.go_to(x=x + 1.5, y=y, z=z, timeout_s=LONG_S)
        drone.return_to_start(0.0, land=False, timeout_s=LONG_S)
        assert drone.feedback().return_phase == "arrived"
        assert across(place(drone.feedback()), start(drone)) < 0.35


def test_a_low_battery_makes_it_return() -> None:
    with flown(SIM + "&battery=0.5") as drone:
        x, y, z = place(drone.feedback())
        drone.go_to(x=x + 1.5, y=y, z=z, timeout_s=LONG_S)
        drone.config["return.height"] = 0.0
        drone.config["battery.return"] = 0.6
        with pytest.raises(RefusedError, match=r"returns to its start, because the battery is low|failsafe"):
            drone.go_to(x=x + 1.5, y=y + 1.0, z=z, timeout_s=LONG_S)
        drone.wait("landed", LONG_S)
        assert across(place(drone.feedback()), start(drone)) < 0.7
        (told,) = [event for event in drone.recent_events() if event.data.get("returns")]
        assert told.text == "failsafe: return to the start and land there, because the battery is low"
        with pytest.raises(RefusedError, match=r"it would return at once \(battery\.return\): charge it"):
            drone.takeoff(timeout_s=WAIT_S)


@contextmanager
def tello() -> Iterator[str]:
    """The address of an emulated Tello, which reports no position."""
    world = SimHost(with_tellos(SimOptions(world="empty", seed=4, wind=0.0, speed=2.0)))
    addresses = Addresses.free()
    with TelloFirmware(world, bind=addresses.drone):
        yield addresses.uri()


@pytest.mark.parametrize("vehicle", ["sim", pytest.param("tello", marks=pytest.mark.slow)])
def test_a_vehicle_without_a_position_does_not_return(vehicle: str) -> None:
    server = MemoryServer("v")
    with ExitStack() as stack:
        address = stack.enter_context(tello()) if vehicle == "tello" else SIM + "&position=none"
        stack.enter_context(Proxy(make_driver(address), server, name="v"))
        drone = stack.enter_context(open_drone(server.dial, app="me", timeout_s=WAIT_S))
        drone.wait(lambda feedback: feedback.vehicle_link == "up", LONG_S)
        drone.takeoff(timeout_s=LONG_S)
        assert drone.start_position is None
        with pytest.raises(RefusedError, match="does not report its position"):
            drone.return_to_start()
        assert drone.feedback().state.airborne


@pytest.mark.slow
def test_a_swarm_and_asyncio_return() -> None:
    with ExitStack() as stack:
        drones = {}
        for name in ("a", "b"):
            server = MemoryServer(name)
            stack.enter_context(Proxy(make_driver(SIM), server, name=name))
            drones[name] = open_drone(server.dial, app="me", timeout_s=WAIT_S)
        swarm = stack.enter_context(Swarm(drones, on_error="raise"))
        swarm.takeoff(timeout_s=LONG_S)
        swarm.return_to_start(0.0, land=False, timeout_s=LONG_S)
        asyncio.run(aio.Drone(drones["a"]).return_to_start(timeout_s=LONG_S))
        assert aio.Drone(drones["a"]).start_position == drones["a"].start_position
        assert drones["a"].feedback().state is FlightState.LANDED
        with pytest.raises(UsageError, match="land is 1 and must be True, False or None"):
            swarm.return_to_start(land=1)  # type: ignore[arg-type]
        with pytest.raises(SwarmError, match="take off first"):
            asyncio.run(aio.Swarm(swarm).return_to_start())

"""Formations flown by vehicles that take on each velocity at once, over real proxies in this process."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from skyloop.client import Swarm
from skyloop.client.drone import open_drone
from skyloop.control.formation import line, placed
from skyloop.control.formation_flight import Formation, station
from skyloop.control.waypoint import WaypointSettings
from skyloop.drivers.base import Sink
from skyloop.errors import NoAnswerError, SwarmError, UnknownNameError, UsageError
from skyloop.messages import AnyAction, Feedback, FlightState, LinkState, Vector, Velocity
from skyloop.proxy.proxy import Proxy
from skyloop.transport.memory import MemoryServer
from tests.support.fake_vehicle import FakeVehicle

NAMES = ("a", "b", "c")
PERIOD_S = 0.01
BRISK = WaypointSettings(gain=3.0, speed_m_s=2.0, climb_m_s=2.0, slow_down_m_s2=4.0)


class Mover(FakeVehicle):
    """Takes on each velocity at once and reports its position."""

    def __init__(self, position: Vector, yaw: float = 0.0) -> None:
        super().__init__()
        self.at = np.array(position)
        self.yaw = yaw
        self.tells = True
        self.stuck = False
        self.velocity = Velocity()
        self._over = threading.Event()

    def _apply(self, action: AnyAction) -> AnyAction:
        self.velocity = action if isinstance(action, Velocity) else Velocity()
        return super()._apply(action)

    def _open(self, sink: Sink) -> None:
        self._over.clear()
        sink.link(LinkState.UP)
        self._mover = threading.Thread(target=self._move, args=(sink,), daemon=True)
        self._mover.start()

    def _close(self) -> None:
        self._over.set()
        self._mover.join()

    def _move(self, sink: Sink) -> None:
        before = time.monotonic()
        while not self._over.wait(PERIOD_S):
            now = time.monotonic()
            v, passed, before = Velocity() if self.stuck else self.velocity, now - before, now
            c, s = math.cos(self.yaw), math.sin(self.yaw)
            self.at = self.at + passed * np.array((c * v.forward - s * v.left, s * v.forward + c * v.left, v.up))
            self.yaw += passed * v.yaw_rate
            x, y, z = (float(value) for value in self.at)
            sample = Feedback(
                captured_ns=time.monotonic_ns(),
                state=self.state,
                yaw_rad=self.yaw,
                altitude_m=z,
                velocity_m_s=(v.forward, v.left, v.up),
                position_m=(x, y, z) if self.tells else None,
            )
            sink.feedback(sample)


@contextmanager
def flying(movers: dict[str, Mover], *, on_error: str = "raise") -> Iterator[Swarm]:
    servers = {name: MemoryServer(name) for name in movers}
    proxies = [Proxy(mover, servers[name], name=name) for name, mover in movers.items()]
    for proxy in proxies:
        proxy.start()
    drones = Swarm(
        {name: open_drone(servers[name].dial, app="test") for name in movers},
        on_error=on_error,  # type: ignore[arg-type]
    )
    try:
        drones.takeoff()
        yield drones
    finally:
        drones.close()
        for proxy in proxies:
            proxy.end()


def row(spacing: float = 1.0) -> dict[str, Mover]:
    """Three in a row along x, with different headings."""
    return {name: Mover((spacing * k, 0.0, 1.0), yaw=0.7 * k) for k, name in enumerate(NAMES)}


def test_all_fly_to_their_places_and_arrive_together() -> None:
    movers = row()
    slots = placed(line(3, 1.0), at=(1.0, 1.5, 1.2))  # side by side along y
    with flying(movers) as drones:
        report = Formation(drones, settings=BRISK).fly_to(slots, speed_m_s=2.0, yaw=1.0)
        assert set(report.slots) == set(NAMES)
        assert {tuple(round(value, 6) for value in slot) for slot in report.slots.values()} == {
            tuple(round(float(value), 6) for value in slot) for slot in slots
        }
        assert all(error < 0.5 for error in report.errors_m.values())
        assert report.closest_m > 0.69
        assert report.spread_s is not None
        assert all(abs(mover.yaw - 1.0) < 0.2 for mover in movers.values())
        drones.wait_all("hovering", 5.0)


def test_paths_that_cross_too_closely_are_refused_before_any_drone_moves() -> None:
    with flying(row(0.8)) as drones:
        crowded = [(0.0, 1.0, 1.0), (0.3, 1.0, 1.0), (0.6, 1.0, 1.0)]
        with pytest.raises(UsageError, match=r"a and b would come within 0\.30 m of each other"):
            Formation(drones).fly_to(crowded)
        with pytest.raises(UsageError, match="only 2 places"):
            Formation(drones).fly_to(crowded[:2])
        with pytest.raises(UsageError, match="speed_m_s is 0"):
            Formation(drones).fly_to(crowded, speed_m_s=0)
        with pytest.raises(UsageError, match="apart_m is -1"):
            Formation(drones, apart_m=-1)
        assert drones.spread is None or drones.feedback()["a"].state is FlightState.HOVERING


def test_drones_without_position_or_on_the_ground_are_refused() -> None:
    movers = row()
    movers["b"].tells = False
    with flying(movers) as drones:
        drones["c"].land()
        with pytest.raises(
            UsageError,
            match=r"b: the vehicle does not report its position: .*position=none.*; c: it is landed, take off first",
        ):
            Formation(drones).hold(1.0)


def test_a_drone_that_does_not_arrive_fails_and_the_others_arrive() -> None:
    movers = row()
    movers["b"].stuck = True
    with flying(movers, on_error="continue") as drones:
        report = Formation(drones, settings=BRISK).fly_to(
            [(x, 2.0, 1.0) for x in (0.0, 1.0, 2.0)], speed_m_s=4.0, timeout_s=4.0
        )
        assert report.errors_m["b"] == pytest.approx(2.0, abs=0.1)
        assert report.errors_m["a"] < 0.5
        assert list(drones.active) == ["a", "c"]
        assert isinstance(drones.errors["b"], NoAnswerError)
        assert "2.00 m from its place" in str(drones.errors["b"])


def test_holding_position() -> None:
    movers = row()
    with flying(movers) as drones:
        report = Formation(drones).hold(0.3)
        assert set(report.errors_m) == set(NAMES)
        assert max(report.errors_m.values()) < 0.1
        assert report.closest_m == pytest.approx(1.0, abs=0.1)


def test_followers_keep_their_places_beside_a_leader_that_moves_and_turns() -> None:
    movers = row()
    offsets = {"b": (-1.0, 1.0, 0.0), "c": (-1.0, -1.0, 0.3)}
    with flying(movers) as drones:
        formation = Formation(drones, settings=BRISK)
        report = formation.follow("a", offsets, 3.0, lead=lambda tick: Velocity(forward=0.5, yaw_rate=0.2))
        assert set(report.errors_m) == {"b", "c"}
        assert max(report.errors_m.values()) < 0.5
        assert movers["a"].at[0] > 0.5
        drones.wait_all("hovering", 5.0)
        with pytest.raises(UnknownNameError, match="drone in this swarm"):
            formation.follow("a", {"z": (0, 0, 0)}, 1.0)
        with pytest.raises(UsageError, match="can't follow itself"):
            formation.follow("a", {"a": (0, 0, 0)}, 1.0)


def test_followers_hover_when_the_leader_fails() -> None:
    movers = row()
    with flying(movers, on_error="continue") as drones:
        drones["a"].close()
        report = Formation(drones).follow("a", {"b": (-1.0, 0.0, 0.0)}, 30.0)
        assert report.errors_m == {}
        assert set(drones.wait_all("hovering", 5.0)) == {"b", "c"}
    with flying(row()) as drones:
        drones["a"].close()
        with pytest.raises(SwarmError, match="a: ClosedError"):
            Formation(drones).follow("a", {"b": (-1.0, 0.0, 0.0)}, 30.0)


@contextmanager
def watched(movers: dict[str, Mover]) -> Iterator[list[float]]:
    """Record how close the first two really come to each other."""
    nearest, over = [math.inf], threading.Event()
    first, second = list(movers.values())[:2]

    def watch() -> None:
        while not over.wait(PERIOD_S / 2):
            nearest[0] = min(nearest[0], float(np.linalg.norm(first.at - second.at)))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield nearest
    finally:
        over.set()
        thread.join()


def test_a_follower_does_not_fly_through_a_leader_that_turns_back() -> None:
    """It yielded only half, and its leader nothing: 0.18 m."""
    movers = {"a": Mover((0.0, 0.0, 1.0)), "b": Mover((-1.0, 0.02, 1.0))}
    with flying(movers) as drones, watched(movers) as nearest:
        threading.Timer(0.3, lambda: setattr(movers["a"], "yaw", math.pi)).start()
        report = Formation(drones, settings=BRISK).follow("a", {"b": (-1.0, 0.0, 0.0)}, 2.0)
    assert nearest[0] > 0.6
    assert report.closest_m == pytest.approx(nearest[0], abs=0.1)


@pytest.mark.parametrize("closed", [False, True])
def test_no_drone_flies_through_one_set_aside(closed: bool) -> None:
    """One came within 0.005 m of it, and 0.998 m was reported."""
    movers = {"a": Mover((1.0, 0.0, 1.0)), "b": Mover((0.0, 0.1, 1.0))}
    with flying(movers, on_error="continue") as drones, watched(movers) as nearest:

        def set_aside() -> None:
            if closed:
                drones["a"].close()
            else:
                drones.fail("a test", {"a": NoAnswerError("it is tired")})

        timer = threading.Timer(0.5, set_aside)
        timer.start()
        report = Formation(drones, settings=BRISK).fly_to(
            [(4.0, 0.0, 1.0), (3.0, 0.0, 1.0)], speed_m_s=2.0, timeout_s=5.0
        )
        assert "a" not in drones.active
    assert nearest[0] > 0.6
    if not closed:
        assert report.closest_m == pytest.approx(nearest[0], abs=0.1)


def test_a_drone_that_loses_its_position_is_set_aside_and_the_others_continue() -> None:
    """It ended the whole formation with an error about an array, regardless of on_error."""
    movers = row()
    with flying(movers, on_error="continue") as drones:
        timer = threading.Timer(0.5, lambda: setattr(movers["b"], "tells", False))
        timer.start()
        report = Formation(drones, settings=BRISK).fly_to([(x, 3.0, 1.0) for x in (0.0, 1.0, 2.0)], speed_m_s=2.0)
        assert list(drones.active) == ["a", "c"]
        assert str(drones.errors["b"]) == "the vehicle's position is not known"
        assert max(report.errors_m[name] for name in ("a", "c")) < 0.5
        assert drones["b"].wait("hovering", 5.0).state is FlightState.HOVERING
    movers = row()
    with flying(movers) as drones:
        timer = threading.Timer(0.3, lambda: setattr(movers["b"], "tells", False))
        timer.start()
        with pytest.raises(SwarmError, match=r"b: .*position is not known"):
            Formation(drones).hold(10.0)


def test_a_position_missing_for_a_moment_is_extrapolated() -> None:
    movers = row()
    with flying(movers) as drones:
        formation = Formation(drones)
        for at_s, tells in ((0.3, False), (0.55, True)):
            threading.Timer(at_s, lambda tells=tells: setattr(movers["b"], "tells", tells)).start()
        assert max(formation.hold(1.0).errors_m.values()) < 0.1


def test_the_place_beside_a_leader() -> None:
    leader = Feedback(captured_ns=0, position_m=(1.0, 2.0, 3.0), yaw_rad=math.pi / 2)
    assert np.allclose(station(leader, (1.0, 0.5, 0.2)), (0.5, 3.0, 3.2))
    assert np.allclose(station(leader, (1.0, 0.5, 0.2), turn=False), (2.0, 2.5, 3.2))
    with pytest.raises(UsageError, match="does not report its position"):
        station(Feedback(captured_ns=0), (1.0, 0.0, 0.0))
    with pytest.raises(UsageError, match=r"shape \(n, 3\)"):
        station(leader, (1.0, 0.0))


def test_with_all_drones_set_aside_there_is_none_to_fly() -> None:
    with flying(row(), on_error="continue") as drones:
        with pytest.raises(SwarmError):
            drones.fail("a test", {name: NoAnswerError("it is tired") for name in NAMES})
        formation = Formation(drones)
        with pytest.raises(UsageError, match=r"no drone of this swarm is active \(a: it is tired; .*readmit"):
            formation.fly_to([(0.0, 0.0, 1.0)])
        with pytest.raises(UsageError, match="no drone of this swarm is active"):
            formation.hold(0.1)

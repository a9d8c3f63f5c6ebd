"""Proxies for several vehicles that obey commands at once, some of which refuse actions."""

from __future__ import annotations

from typing import Any

from skyloop.client import Authority, Drone, Swarm
from skyloop.client.connection import RedialPolicy
from skyloop.client.drone import open_drone
from skyloop.client.monitoring import Thresholds
from skyloop.messages import AnyAction, FlightState
from skyloop.proxy.proxy import Proxy
from skyloop.transport.memory import MemoryServer
from tests.support.fake_vehicle import FakeVehicle

NAMES = ("alpha", "bravo", "charlie")
QUICK = RedialPolicy(first_s=0.005, cap_s=0.05, hello_s=0.3, thresholds=Thresholds(late_s=0.1, silent_s=0.3))


class Stubborn(FakeVehicle):
    """Refuses some actions, and ignores others."""

    def __init__(self) -> None:
        super().__init__()
        self.ignores: set[type[AnyAction]] = set()

    def _apply(self, action: AnyAction) -> AnyAction:
        if type(action) in self.ignores:
            self.applied.append(action)
            return action
        return super()._apply(action)


class Field:
    """Proxies by name, each with its vehicle."""

    def __init__(self, names: tuple[str, ...] = NAMES) -> None:
        self.vehicles = {name: Stubborn() for name in names}
        self.servers = {name: MemoryServer(name) for name in names}
        self.proxies = {name: Proxy(vehicle, self.servers[name], name=name) for name, vehicle in self.vehicles.items()}
        for proxy in self.proxies.values():
            proxy.start()

    def connect(self, name: str, *, priority: int = 16, **options: Any) -> Drone:
        options.setdefault("app", "test")
        return open_drone(self.servers[name].dial, policy=QUICK, **options, authority=Authority(priority=priority))

    def swarm(self, **options: Any) -> Swarm:
        return Swarm({name: self.connect(name) for name in self.vehicles}, **options)

    def broken(self, *names: str) -> None:
        """Make these vehicles refuse to take off; returns once their state is published."""
        self._become(names, FlightState.EMERGENCY)

    def mended(self, *names: str) -> None:
        self._become(names, FlightState.LANDED)

    def _become(self, names: tuple[str, ...], state: FlightState) -> None:
        for name in names:
            self.vehicles[name].state = state
            assert self.proxies[name].publisher.wait_for(lambda now: now is state, 10.0)

    def states(self) -> set[FlightState]:
        return {vehicle.state for vehicle in self.vehicles.values()}

    def stop(self) -> None:
        for proxy in self.proxies.values():
            proxy.end()

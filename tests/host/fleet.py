"""A host in this process whose vehicles can be made to hang and fail, and their pilots."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Sink
from skyloop.drivers.uri import VehicleUri, parse_uri
from skyloop.host.fleet import VehicleSettings
from skyloop.host.host import Host
from skyloop.host.vehicle import SharedVehicle
from skyloop.messages import AnyAction, EventKind, Failsafe, FlightState, Land, Role, Takeoff, Value, Velocity
from skyloop.transport.local import dial
from skyloop.transport.testing import wait_until
from tests.support.proxy_bench import App, FakeDriver

PATIENT: dict[str, Value] = {"failsafe.hover_after_s": 1.5, "authority.timeout_s": 5.0, "command.max_age_s": 5.0}


class Vehicle(FakeDriver):
    """Lands at once; hangs in the named calls until released."""

    def __init__(self) -> None:
        super().__init__(monotonic_ns)
        self.hangs: set[str] = set()
        self.let_go = threading.Event()
        self.stuck = threading.Event()
        self.lands = True

    def _may_hang(self, call: str) -> None:
        if call in self.hangs:
            self.stuck.set()
            self.let_go.wait(60.0)

    def _open(self, sink: Sink) -> None:
        self._may_hang("open")
        super()._open(sink)

    def _close(self) -> None:
        self._may_hang("close")
        super()._close()

    def set_parameter(self, name: str, value: Value) -> Value:
        self._may_hang("set_parameter")
        return super().set_parameter(name, value)

    def left_to(self) -> str:
        self._may_fail("left_to")
        return super().left_to()

    def _apply(self, action: AnyAction) -> AnyAction:
        self._may_hang(action.name)
        applied = super()._apply(action)
        if isinstance(action, Land) and self.lands:
            self.report(state=FlightState.LANDED)
        return applied


class Hosting:
    """A host, its drivers by name, and the applications connected to it."""

    def __init__(self) -> None:
        self.drivers: dict[str, Vehicle] = {}
        self.lines: list[str] = []
        self.host = Host(self.lines.append, self._make)
        self._apps: list[App] = []

    def __enter__(self) -> Hosting:
        return self

    def __exit__(self, *_: object) -> None:
        for driver in self.drivers.values():
            driver.let_go.set()
        self.host.close()
        for app in self._apps:
            app.end.close()
        until_s = time.monotonic() + 1.0
        for thread in threading.enumerate():  # hung threads continue now, before their directories are removed
            if thread.name == "skyloop-abandoned":
                thread.join(max(0.0, until_s - time.monotonic()))

    def _make(self, address: VehicleUri) -> Vehicle:
        return self.drivers[address.place]

    def vehicle(self, name: str) -> Vehicle:
        """Return a driver for a vehicle of this name, not yet served."""
        return self.drivers.setdefault(name, Vehicle())

    def add(self, name: str) -> Vehicle:
        """Serve a vehicle."""
        driver = self.vehicle(name)
        self.host.add(self.settings(name))
        return driver

    @staticmethod
    def settings(name: str) -> VehicleSettings:
        return VehicleSettings(name, parse_uri(f"fake://{name}"), presets=PATIENT)

    def app(self, name: str, role: Role = Role.OBSERVER) -> App:
        """Connect an application to a vehicle."""
        app = App(dial(name), monotonic_ns)
        self._apps.append(app)
        app.hello("pilot" if role is Role.PILOT else "witness", role)
        return app

    def airborne(self, name: str) -> App:
        """Connect a pilot whose vehicle hovers."""
        app = self.app(name, Role.PILOT)
        app.take_authority()
        app.command(Takeoff())
        self.drivers[name].report(state=FlightState.HOVERING)
        return app

    def condition(self, name: str) -> str:
        return next(row.condition.value for row in self.host.status() if row.name == name)

    def shared(self, name: str) -> SharedVehicle:
        vehicle = self.host.vehicles[name]
        assert isinstance(vehicle, SharedVehicle)
        return vehicle


class Flight:
    """Flies a vehicle with set-points at 32 Hz on a thread, and records the proxy's own actions."""

    def __init__(self, hosting: Hosting, name: str) -> None:
        self.driver = hosting.drivers[name]
        self.pilot = hosting.airborne(name)
        self.applied = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._fly, daemon=True)

    def __enter__(self) -> Flight:
        self._thread.start()
        wait_until(lambda: self.flown > 3, "it flies")
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    @property
    def flown(self) -> int:
        """Return the number of set-points that the vehicle received."""
        return sum(isinstance(action, Velocity) for action in list(self.driver.told))

    @property
    def failsafes(self) -> list[str]:
        return [event.text for event in self.pilot.events if event.kind is EventKind.FAILSAFE]

    def goes_on(self) -> None:
        """Wait until it has received more set-points, none of them from a failsafe."""
        before = self.flown
        wait_until(lambda: self.flown > before + 10, "it keeps flying")
        assert self.failsafes == []
        assert self.pilot.feedback[-1].failsafe is Failsafe.NONE
        assert self.pilot.closed_by.empty()

    def _fly(self) -> None:
        while not self._ended.wait(1 / 32):
            self.applied += 1
            self.pilot.command(Velocity(0.1 + 0.001 * (self.applied % 50), 0.0, 0.0, 0.0), sync=False)


def closing_reason(app: App) -> str:
    """Wait until a proxy has ended, and return its published reason."""
    wait_until(lambda: not app.closed_by.empty(), "its connection ended")
    (event,) = [event for event in app.events if event.kind is EventKind.PROXY_CLOSING]
    return event.text


def in_time(call: Callable[[], object], seconds: float) -> float:
    """Return how long a call took [s]; it must not exceed this limit."""
    began_s = time.monotonic()
    call()
    took_s = time.monotonic() - began_s
    assert took_s < seconds
    return took_s

"""A proxy whose vehicle journals its commands: ``python -m tests.promises.chaos.vehicle NAME FOLDER [LISTEN]``.

The vehicle stands for one that outlives its proxy: a new proxy finds it in the state in which the last one left it, and
without commands it hovers. ``LISTEN`` is an additional network address for the proxy.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import numpy as np

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.messages import (
    AnyAction,
    CameraInfo,
    Capabilities,
    EmergencyStop,
    Feedback,
    FlightState,
    Hover,
    Land,
    LinkState,
    ResetEmergency,
    Takeoff,
    Velocity,
)
from skyloop.proxy import serve as serving
from tests.promises.chaos.journal import Journal, read

PERIOD_S = 0.05
LANDING_S = 1.0
WIDTH, HEIGHT = 160, 120
#: A pilot's call is identified by its number, as a yaw rate that no limit reduces.
NUMBER_RAD_S = 1e-5
NUMBERS = 150_000  #: after which they start again


class JournalledVehicle(Driver):
    """Obeys at once, and journals it."""

    def __init__(self, folder: Path, name: str) -> None:
        super().__init__(VehicleUri("chaos", text=f"chaos://{name}"))
        before = read(folder / f"{name}.vehicle")
        states = [entry.what.removeprefix("state:") for entry in before if entry.what.startswith("state:")]
        self._state = FlightState(states[-1]) if states else FlightState.LANDED
        if self._state not in (FlightState.LANDED, FlightState.EMERGENCY):
            self._state = FlightState.HOVERING
        self._journal = Journal(folder / f"{name}.vehicle")
        self._state_lock = threading.Lock()
        self._closing = threading.Event()
        self._land_at_ns = 0
        self._thread: threading.Thread | None = None

    def capabilities(self) -> Capabilities:
        actions = frozenset({"takeoff", "hover", "land", "velocity", "emergency_stop", "reset_emergency"})
        return Capabilities("journalled", actions, (CameraInfo("front", WIDTH, HEIGHT, 1.0 / PERIOD_S),))

    def _open(self, sink: Sink) -> None:
        self._journal.write("open")
        self._journal.write(f"state:{self._state.value}")
        self._thread = threading.Thread(target=self._run, args=(sink,), name="vehicle", daemon=True)
        self._thread.start()

    def _close(self) -> None:
        self._closing.set()
        if self._thread is not None:
            self._thread.join()

    def failsafe(self, action: Hover | Land) -> bool:
        self._journal.write(f"failsafe:{action.name}")
        return super().failsafe(action)

    def _apply(self, action: AnyAction) -> AnyAction:
        if isinstance(action, Velocity):
            self._journal.write("velocity", round(action.yaw_rate / NUMBER_RAD_S))
            self._become(FlightState.FLYING)
        else:
            self._journal.write(action.name)
        if isinstance(action, (Takeoff, Hover)):
            self._become(FlightState.HOVERING)
        elif isinstance(action, Land):
            with self._state_lock:
                self._land_at_ns = monotonic_ns() + int(LANDING_S * 1e9)
            self._become(FlightState.LANDING)
        elif isinstance(action, EmergencyStop):
            self._become(FlightState.EMERGENCY)
        elif isinstance(action, ResetEmergency):
            self._become(FlightState.LANDED)
        return action

    def _become(self, state: FlightState) -> None:
        with self._state_lock:
            if state is not self._state:
                self._state = state
                self._journal.write(f"state:{state.value}")

    def _run(self, sink: Sink) -> None:
        sink.link(LinkState.UP)
        pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        while not self._closing.wait(PERIOD_S):
            now_ns = monotonic_ns()
            if self._state is FlightState.LANDING and now_ns >= self._land_at_ns:
                self._become(FlightState.LANDED)
            altitude = 0.0 if self._state is FlightState.LANDED else 1.0
            sink.feedback(Feedback(captured_ns=now_ns, state=self._state, battery=0.9, altitude_m=altitude))
            if sink.wants("front"):
                sink.frame("front", pixels, now_ns, width=WIDTH, height=HEIGHT)


def main() -> None:
    """Serve until killed."""
    name, folder, listen = sys.argv[1], Path(sys.argv[2]), sys.argv[3:]
    make_end = None
    if listen:
        from skyloop.cli.network import server_ends
        from skyloop.network import FabricSettings

        make_end = server_ends(FabricSettings(listen=(listen[0],), multicast=False), None)
    setattr(serving, "make_driver", lambda uri: JournalledVehicle(folder, name))  # noqa: B010  (it is imported there)
    serving.serve("chaos://", name, make_end=make_end, audit=folder / "disk" / f"{name}.audit")


if __name__ == "__main__":
    main()

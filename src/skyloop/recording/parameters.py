"""The drones' parameters for a viewer: read by everybody, written under a lease that is held for that moment."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from skyloop.client import Authority, Drone, connect
from skyloop.client.channels import Listener
from skyloop.errors import ParameterError, SkyloopError, UnknownNameError
from skyloop.messages import Event, Parameter, ParameterType, Value
from skyloop.recording.taps import Parameters

LOOKS_ONLY: Final = "this view only looks on: start it with --write to write parameters"


@dataclass(frozen=True, slots=True)
class Written:
    """What became of a parameter that was to be written."""

    name: str  #: with its drone's
    value: Value | None  #: in force now; None: that could not be read
    refused: str = ""  #: why it was not written


class ParameterDesk:
    """Reads and writes parameters by names such as ``alpha/limits.tilt``. May be used from any thread."""

    def __init__(
        self,
        drones: Sequence[Drone],
        priority: int | None,
        on_change: Callable[[str, Value], None] = lambda *_: None,
    ) -> None:
        """Initialise without a request.

        Args:
            drones: Observed ones, with different names.
            priority: Of whom writes, 0 (the highest) to 31; None: nobody does.
            on_change: Called with the name and value of each parameter at first, and again when it has changed, from
                :meth:`follow` on, on a thread of its own.
        """
        self._drones = {drone.name: drone for drone in drones}
        self._priority = priority
        self._on_change = on_change
        self._lock = threading.Lock()  # one write after the other, and one start
        self._following: list[tuple[Parameters, Listener[Event]]] = []

    def read(self, names: Iterable[str] = ()) -> dict[str, Value]:
        """Return the values of these parameters, or of all. Waits up to 2 s for a drone that does not answer.

        Raises:
            SkyloopError: A drone does not answer.
        """
        wanted = set(names)
        of = {name.partition("/")[0] for name in wanted} if wanted else self._drones.keys()
        found = {
            f"{drone.name}/{parameter.name}": parameter.value
            for name, drone in self._drones.items()
            if name in of
            for parameter in drone.config.parameters()
        }
        return {name: value for name, value in found.items() if not wanted or name in wanted}

    def write(self, name: str, value: object) -> Written:
        """Write a parameter, and return what is in force then."""
        refused = ""
        with self._lock:
            try:
                self._write(name, value)
            except SkyloopError as error:
                refused = f"{name} was not written: {error.reason}"
            return Written(name, self._present(name), refused)

    def follow(self) -> None:
        """Report every parameter, and from then on each that has changed. Idempotent."""
        with self._lock:
            if self._following:
                return
            for drone in self._drones.values():
                followed = Parameters(drone, self._reporter(drone.name))
                self._following.append((followed, drone.on_event(followed.event, inline=True)))
                followed.start()

    def close(self) -> None:
        """End what :meth:`follow` began."""
        for followed, listener in self._following:
            listener.cancel()
            followed.stop()

    def _reporter(self, drone: str) -> Callable[[Parameter], None]:
        return lambda parameter: self._on_change(f"{drone}/{parameter.name}", parameter.value)

    def _write(self, name: str, value: object) -> None:
        drone, key = self._found(name)
        parameter = drone.config.describe(key)
        if self._priority is None:
            raise ParameterError(LOOKS_ONLY)
        authority = Authority(priority=self._priority)
        with connect(drone.name, authority=authority, name="skyloop view", on_exit="hover") as writer:
            writer.config[key] = _typed(parameter, value)

    def _present(self, name: str) -> Value | None:
        try:
            drone, key = self._found(name)
            return drone.config[key]
        except SkyloopError:
            return None

    def _found(self, name: str) -> tuple[Drone, str]:
        drone, _, key = name.partition("/")
        if drone not in self._drones:
            raise UnknownNameError("drone in this view", drone, self._drones)
        return self._drones[drone], key


def _typed(parameter: Parameter, value: object) -> object:
    """Return a viewer's value as the parameter's type: viewers write 1 for 1.0."""
    if parameter.type is ParameterType.FLOAT and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if parameter.type is ParameterType.INT and isinstance(value, float) and value.is_integer():
        return int(value)
    return value

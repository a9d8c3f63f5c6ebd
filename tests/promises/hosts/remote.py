"""An application on another host that executes a test's calls one by one, and returns the results."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from importlib import import_module
from typing import Any, Concatenate, ParamSpec, TypeVar

from benchmarks.hosts.namespaces import Host
from benchmarks.measuring.workers import STARTS_WITHIN_S, Pipe, Workers
from skyloop.client import Drone

ANSWERS_WITHIN_S = 40.0
_Result = TypeVar("_Result")
_Arguments = ParamSpec("_Arguments")


class RemoteError(Exception):
    """An exception of a remote call, with its traceback."""


class Here:
    """An application's state: its drones and its records, with the time on its clock [ns]."""

    def __init__(self) -> None:
        self.drones: dict[str, Drone] = {}
        self.told: dict[str, list[tuple[int, Any]]] = {}
        self.objects: dict[str, Any] = {}

    def tell(self, what: str) -> Callable[[Any], None]:
        """A listener that records what it gets."""
        found = self.told.setdefault(what, [])
        return lambda value: found.append((time.monotonic_ns(), value))


class Remote:
    """``do(function, …)`` calls a function of a module there, as ``function(here, …)``, and returns its result."""

    def __init__(self, workers: Workers, host: Host) -> None:
        self.host = host
        self._worker = workers.start(serve, prefix=host.prefix)
        self._worker.answer(STARTS_WITHIN_S)

    def begin(
        self, work: Callable[Concatenate[Here, _Arguments], _Result], *args: _Arguments.args, **kw: _Arguments.kwargs
    ) -> None:
        """Start a call that a later :meth:`end` waits for."""
        self._worker.pipe.send((work.__module__, work.__qualname__, args, kw))

    def end(self, timeout_s: float = ANSWERS_WITHIN_S) -> Any:
        """The result of the call in progress. Raises :class:`RemoteError` for an exception there."""
        good, answer = self._worker.answer(timeout_s)
        if good:
            return answer
        raise RemoteError(f"on host {self.host.name!r}:\n{answer}")

    def do(
        self, work: Callable[Concatenate[Here, _Arguments], _Result], *args: _Arguments.args, **kw: _Arguments.kwargs
    ) -> _Result:
        self.begin(work, *args, **kw)
        result: _Result = self.end()
        return result

    @property
    def pid(self) -> int:
        return self._worker.pid


def serve(pipe: Pipe) -> None:
    """The main loop of a remote application's process."""
    here = Here()
    pipe.send("ready")
    try:
        while (call := pipe.recv()) is not None:
            module, name, arguments, keywords = call
            try:
                answer = (True, getattr(import_module(module), name)(here, *arguments, **keywords))
            except Exception:  # noqa: BLE001  (reported to the test)
                answer = (False, traceback.format_exc())
            pipe.send(answer)
    finally:
        for drone in here.drones.values():
            drone.close()

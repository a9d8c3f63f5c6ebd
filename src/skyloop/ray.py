"""Processors on a Ray cluster: what ``skyloop process`` runs, as actors that Ray places. Needs the extra ``ray``.

Frames and results travel between proxy and actors as always; Ray starts the actors, and starts them anew when they die.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final, Self

from skyloop.errors import LinkError, MissingExtraError, NoAnswerError, SkyloopError, UsageError
from skyloop.processing import Code, Settings, Status, Worker, load_processor

_ASK_S: Final = 10.0  #: how long an actor may take to say how it does
_LOOK_S: Final = 0.1
_START_S: Final = 60.0  #: for Ray to place and start all actors
#: Of the driver's environment, what decides whether a worker finds the proxy.
_ENVIRONMENT: Final = ("SKYLOOP_RUNTIME_DIR", "SKYLOOP_GROUP", "SKYLOOP_NETWORK", "SKYLOOP_KEYS")


@dataclass(frozen=True, slots=True)
class _Order:
    """What an actor is to do; it travels to the actor's host."""

    kind: type[Any]
    drone: str
    settings: Settings


class Workers:
    """The actors of one processor; made by :func:`process`. A context manager that ends them."""

    def __init__(self, actors: list[Any]) -> None:
        self.actors = actors  #: Ray's handles

    def statuses(self, timeout_s: float = _ASK_S) -> list[Status | None]:
        """How each does; None for one that does not answer, as while Ray starts it anew.

        Raises :class:`LinkError` with what ended an actor that can't go on, as when other code took the name.
        """
        ray = _ray()
        asked = [actor.status.remote() for actor in self.actors]
        ray.wait(asked, num_returns=len(asked), timeout=timeout_s)
        found: list[Status | None] = []
        for reference in asked:
            try:
                status, trouble = ray.get(reference, timeout=0.1)
            except (ray.exceptions.GetTimeoutError, ray.exceptions.RayActorError):
                found.append(None)
                continue
            if trouble:
                raise LinkError(f"a worker has ended: {trouble}")
            found.append(status)
        return found

    def stop(self) -> None:
        """End all actors. Idempotent."""
        ray = _ray()
        for actor in self.actors:
            ray.kill(actor, no_restart=True)
        self.actors = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()


def process(
    target: str | type[Any],
    drone: str,
    *,
    workers: int = 1,
    camera: str | None = None,
    name: str | None = None,
    shared: bool = True,
    max_age_s: float | None = 1.0,
    max_fps: float | None = None,
    stuck_s: float = 2.0,
    **options: Any,
) -> Workers:
    """Run a processor as actors of the Ray cluster that this program is connected to; starts one here if there is none.

    ``target``: the class, or where it is (``module:Class``, ``file.py:Class``). ``drone``: as found from the host of
    each actor. ``options`` are for Ray: ``num_cpus``, ``num_gpus``, ``resources`` … The rest is as for
    ``skyloop process``. Returns when all work. Raises :class:`MissingExtraError`, :class:`UsageError`,
    :class:`NoAnswerError` where Ray has no room for so many, :class:`LinkError` with what an actor said.
    """
    ray = _ray()
    if not isinstance(workers, int) or workers < 1:
        raise UsageError(f"workers is {workers!r} and must be at least 1")
    code = load_processor(target) if isinstance(target, str) else Code.of(target)
    settings = Settings(code.name if name is None else name, code.mark, camera, shared, max_age_s, max_fps, stuck_s)
    if not ray.is_initialized():
        ray.init(include_dashboard=False, log_to_driver=False)
    module = sys.modules[code.kind.__module__]
    if module.__name__.startswith("skyloop_user_"):  # a file's: not to be imported elsewhere
        ray.cloudpickle.register_pickle_by_value(module)
    variables = {key: os.environ[key] for key in _ENVIRONMENT if key in os.environ}
    options = {"max_restarts": -1, "runtime_env": {"env_vars": variables}, **options}
    actor = ray.remote(_Actor).options(**options)
    order = _Order(code.kind, drone, settings)
    found = Workers([actor.remote(order) for _ in range(workers)])
    try:
        _await_start(found)
    except BaseException:
        found.stop()
        raise
    return found


def _await_start(workers: Workers) -> None:
    deadline = time.monotonic() + _START_S
    while (left_s := deadline - time.monotonic()) > 0.0:
        if all(status is not None for status in workers.statuses(left_s)):
            return
        time.sleep(_LOOK_S)
    raise NoAnswerError(
        f"Ray did not start {len(workers.actors)} actors within {_START_S:g} s: has it so many CPUs free?"
    )


class _Actor:
    """One worker, on a host of Ray's choosing."""

    def __init__(self, order: _Order) -> None:
        self._trouble = ""
        self._worker: Worker | None = None
        try:
            self._begin(order)
        except SkyloopError as error:
            self._trouble = str(error)
        except Exception as error:  # noqa: BLE001  (the user's class may raise anything when it is made)
            self._trouble = f"{order.kind.__name__}() raised {error!r}"

    def _begin(self, order: _Order) -> None:
        from skyloop.client import connect

        name = f"{order.settings.name[:32]}@{os.uname().nodename[:20]}:{os.getpid()}"
        processor = Code(order.kind, order.settings.code).make()
        drone = connect(order.drone, access="observe", name=name)
        try:
            self._worker = Worker(drone, processor, order.settings, print)
        except BaseException:
            drone.close()
            raise
        threading.Thread(target=self._run, args=(self._worker,), name="skyloop-worker", daemon=True).start()

    def _run(self, worker: Worker) -> None:
        try:
            worker.run(math.inf)
        except SkyloopError as error:
            self._trouble = str(error)

    def status(self) -> tuple[Status | None, str]:
        """How it does, and why it does no more."""
        return None if self._worker is None else self._worker.status, self._trouble


def _ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise MissingExtraError("running processors on a Ray cluster", "ray", cause=str(error)) from None
    return ray

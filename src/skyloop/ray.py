"""Processors on a Ray cluster: what ``skyloop process`` runs, as actors that Ray places. Needs the extra ``ray``.

Frames and results travel between proxy and actors as always; Ray starts the actors and restarts them when they die.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final, Self

from skyloop.errors import LinkError, MissingExtraError, NoAnswerError, SkyloopError, UsageError
from skyloop.processing import Code, Settings, Status, Worker, load_processor

_ASK_S: Final = 10.0  #: time for an actor to return its status
_LOOK_S: Final = 0.1
_START_S: Final = 60.0  #: time for Ray to place and start all actors
#: Variables of this program's environment by which a worker finds the proxy.
_ENVIRONMENT: Final = ("SKYLOOP_RUNTIME_DIR", "SKYLOOP_GROUP", "SKYLOOP_NETWORK", "SKYLOOP_KEYS")


@dataclass(frozen=True, slots=True)
class _Order:
    """What an actor is to do; it travels to the actor's host."""

    kind: type[Any]
    drone: str
    settings: Settings


class Workers:
    """The actors of one processor, made by :func:`process`. A context manager that ends them."""

    def __init__(self, actors: list[Any]) -> None:
        """Keep Ray's handles of the actors."""
        self.actors = actors  #: Ray's handles

    def statuses(self, timeout_s: float = _ASK_S) -> list[Status | None]:
        """Return the statistics of each actor; None for one that does not answer, as while Ray restarts it.

        Args:
            timeout_s: How long to wait for all of them [s].

        Raises:
            LinkError: If an actor can't go on, as when other code took the name; says why.
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
    """Run a processor as actors of a Ray cluster; returns when all of them work.

    Uses the cluster that this program is connected to, and starts one on this host if there is none.

    Args:
        target: The class, or where it is: ``module:Class`` or ``file.py:Class``.
        drone: Name or address of the drone, as found from the host of each actor.
        workers: Number of actors, at least 1.
        camera: Name of the camera; None: the vehicle's first.
        name: Name of the processor; None: the class's in lower case.
        shared: Each frame goes to one of the workers; if False, each worker gets all.
        max_age_s: Frames older than this when their turn comes are left out [s]; None: none are.
        max_fps: Most frames a second for each worker; None: all.
        stuck_s: A call of ``process`` that takes longer gives the worker's share to the others [s].
        **options: For Ray's actors: ``num_cpus``, ``num_gpus``, ``resources``, … A ``runtime_env`` is merged with
            the variables of the environment by which an actor finds the proxy, and goes before them.

    Raises:
        MissingExtraError: If Ray is not installed.
        UsageError: If an argument is out of range, or the class is no processor.
        NoAnswerError: If Ray has no room for so many actors within 60 s.
        LinkError: If an actor fails; says why.
    """
    ray = _ray()
    if not isinstance(workers, int) or workers < 1:
        raise UsageError(f"workers is {workers!r} and must be at least 1")
    code = load_processor(target) if isinstance(target, str) else Code.of(target)
    settings = Settings(code.name if name is None else name, code.mark, camera, shared, max_age_s, max_fps, stuck_s)
    if not ray.is_initialized():
        ray.init(include_dashboard=False, log_to_driver=False)
    module = sys.modules[code.kind.__module__]
    if module.__name__.startswith("skyloop_user_"):  # loaded from a file: can't be imported on another host
        ray.cloudpickle.register_pickle_by_value(module)
    options = {"max_restarts": -1, **options, "runtime_env": _runtime_env(options.get("runtime_env"))}
    actor = ray.remote(_Actor).options(**options)
    task = _Order(code.kind, drone, settings)
    found = Workers([actor.remote(task) for _ in range(workers)])
    try:
        _await_start(found)
    except BaseException:
        found.stop()
        raise
    return found


def _runtime_env(wanted: Any) -> dict[str, Any]:
    """Return the user's ``runtime_env`` with the variables by which an actor finds the proxy."""
    wanted = {} if wanted is None else wanted
    variables = wanted.get("env_vars") or {} if isinstance(wanted, Mapping) else None
    if not isinstance(variables, Mapping):
        raise UsageError(
            f"runtime_env is {wanted!r} and must be a dict as Ray takes it, with a dict of env_vars if any"
        )
    ours = {key: os.environ[key] for key in _ENVIRONMENT if key in os.environ}
    return {**wanted, "env_vars": {**ours, **variables}}


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
    """One worker, on a host that Ray chooses."""

    def __init__(self, task: _Order) -> None:
        self._trouble = ""
        self._worker: Worker | None = None
        try:
            self._begin(task)
        except SkyloopError as error:
            self._trouble = str(error)
        except Exception as error:  # noqa: BLE001  (the user's class may raise anything when it is made)
            self._trouble = f"{task.kind.__name__}() raised {error!r}"

    def _begin(self, task: _Order) -> None:
        from skyloop.client import connect

        name = f"{task.settings.name[:32]}@{os.uname().nodename[:20]}:{os.getpid()}"
        processor = Code(task.kind, task.settings.code).make()
        drone = connect(task.drone, access="observe", name=name)
        try:
            self._worker = Worker(drone, processor, task.settings, print)
        except BaseException:
            drone.close()
            raise
        threading.Thread(target=self._run, args=(self._worker,), name="skyloop-worker", daemon=True).start()

    def _run(self, worker: Worker) -> None:
        try:
            worker.run(math.inf)
        except SkyloopError as error:
            self._trouble = str(error)
        except BaseException as error:  # noqa: BLE001  (nobody else learns of it: the status shows that it has ended)
            self._trouble = f"its thread raised {error!r}"

    def status(self) -> tuple[Status | None, str]:
        """The worker's statistics, and why it has ended, if it has."""
        return None if self._worker is None else self._worker.status, self._trouble


def _ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise MissingExtraError("running processors on a Ray cluster", "ray", cause=str(error)) from None
    return ray

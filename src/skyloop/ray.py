"""Run processors on a Ray cluster, as ``skyloop process`` does, but in actors that Ray places. Needs the ``ray`` extra.

Frames and results are exchanged with the proxy as usual. Ray starts the actors, and restarts them if they die.
"""

from __future__ import annotations

import math
import os
import platform
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any, Final, Self

from skyloop.errors import LinkError, MissingExtraError, NoAnswerError, SkyloopError, UsageError
from skyloop.processing import Code, Settings, Status, Worker, load_processor

_ASK_S: Final = 10.0  #: time limit for an actor to return its status
_CHECK_S: Final = 0.1  # how often to check whether all actors have started
_START_S: Final = 60.0  #: time limit for Ray to place and start all actors
#: Environment variables of this program that a worker needs to find the proxy.
_ENVIRONMENT: Final = ("SKYLOOP_RUNTIME_DIR", "SKYLOOP_GROUP", "SKYLOOP_NETWORK", "SKYLOOP_KEYS")


class Workers:
    """The actors of one processor, created by :func:`process`. It is a context manager, which ends them."""

    def __init__(self, actors: list[Any]) -> None:
        self.actors = actors  #: Ray's handles for the actors

    def statuses(self, timeout_s: float = _ASK_S) -> list[Status | None]:
        """Return each actor's statistics; None for an actor that does not answer, for example because it is restarting.

        Args:
            timeout_s: Maximum time to wait for all actors [s].

        Raises:
            LinkError: If an actor can't continue, for example because other code took its name.
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

    def __exit__(self, *_: object) -> None:
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
    """Run a processor as actors on a Ray cluster; return once all of them are working.

    Uses the cluster to which this program is connected, or else starts a cluster on this host.

    Args:
        target: The processor's class, or its location: ``module:Class`` or ``file.py:Class``.
        drone: Name or address at which each actor's host can reach the drone.
        workers: Number of actors, at least 1.
        camera: Name of the camera; None: the vehicle's first camera.
        name: Name of the processor; None: the class's name in lower case.
        shared: If True, each frame goes to only one worker; if False, each worker gets all frames.
        max_age_s: Maximum age of frames [s]; older frames are skipped when they would be processed; None: no limit.
        max_fps: Maximum frame rate of each worker; None: no limit.
        stuck_s: If a call to ``process`` takes longer than this [s], the worker's frames go to the others.
        **options: Options of Ray's actors: ``num_cpus``, ``num_gpus``, ``resources``, … A ``runtime_env`` is merged
            with, and takes precedence over, the environment variables with which an actor finds the proxy.

    Raises:
        MissingExtraError: If Ray is not installed.
        UsageError: If an argument is out of range, or if the class is not a processor.
        NoAnswerError: If Ray has no room for this many actors within 60 s.
        LinkError: If an actor fails; the message gives the reason.
    """
    ray = _ray()
    if not isinstance(workers, int) or workers < 1:
        raise UsageError(f"workers is {workers!r} and must be at least 1")
    code = load_processor(target) if isinstance(target, str) else Code.of(target)
    settings = Settings(code.name if name is None else name, code.mark, camera, shared, max_age_s, max_fps, stuck_s)
    if not ray.is_initialized():
        ray.init(include_dashboard=False, log_to_driver=False)
    module = sys.modules[code.kind.__module__]
    if module.__name__.startswith("skyloop_user_"):  # it was loaded from a file, and other hosts can't import it
        ray.cloudpickle.register_pickle_by_value(module)
    options = {"max_restarts": -1, **options, "runtime_env": _runtime_env(options.get("runtime_env"))}
    actor = ray.remote(_Actor).options(**options)
    found = Workers([actor.remote(code.kind, drone, settings) for _ in range(workers)])
    try:
        _await_start(found)
    except BaseException:
        found.stop()
        raise
    return found


def _runtime_env(wanted: Any) -> dict[str, Any]:
    """Return the user's ``runtime_env`` with the variables that an actor needs to find the proxy."""
    wanted = {} if wanted is None else wanted
    variables = wanted.get("env_vars") or {} if isinstance(wanted, Mapping) else None
    if not isinstance(variables, Mapping):
        raise UsageError(
            f"runtime_env is {wanted!r} and must be a dict that Ray accepts; env_vars, if given, must be a dict, too"
        )
    ours = {key: os.environ[key] for key in _ENVIRONMENT if key in os.environ}
    return {**wanted, "env_vars": {**ours, **variables}}


def _await_start(workers: Workers) -> None:
    deadline = time.monotonic() + _START_S
    while (left_s := deadline - time.monotonic()) > 0.0:
        if all(status is not None for status in workers.statuses(left_s)):
            return
        time.sleep(_CHECK_S)
    raise NoAnswerError(
        f"Ray did not start {len(workers.actors)} actors within {_START_S:g} s: does it have that many CPUs free?"
    )


class _Actor:
    """One worker, on a host that Ray chose."""

    def __init__(self, kind: type[Any], drone: str, settings: Settings) -> None:
        self._trouble = ""
        self._worker: Worker | None = None
        try:
            self._begin(kind, drone, settings)
        except SkyloopError as error:
            self._trouble = str(error)
        except Exception as error:  # noqa: BLE001  (the user's class may raise anything)
            self._trouble = f"{kind.__name__}() raised {error!r}"

    def _begin(self, kind: type[Any], target: str, settings: Settings) -> None:
        from skyloop.client import connect

        name = f"{settings.name[:32]}@{platform.node()[:20]}:{os.getpid()}"
        processor = Code(kind, settings.code).make()
        drone = connect(target, access="observe", name=name)
        try:
            self._worker = Worker(drone, processor, settings, print)
        except BaseException:
            drone.close()
            raise
        threading.Thread(target=self._run, args=(self._worker,), name="skyloop-worker", daemon=True).start()

    def _run(self, worker: Worker) -> None:
        try:
            worker.run(math.inf)
        except SkyloopError as error:
            self._trouble = str(error)
        except BaseException as error:  # noqa: BLE001  (otherwise the error is lost: the status shows that it has ended)
            self._trouble = f"its thread raised {error!r}"

    def status(self) -> tuple[Status | None, str]:
        """Return the worker's statistics and, if it has ended, why."""
        return None if self._worker is None else self._worker.status, self._trouble


def _ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise MissingExtraError("running processors on a Ray cluster", "ray", cause=str(error)) from None
    return ray

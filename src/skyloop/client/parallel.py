"""The same for several drones at once: what waits, each on a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import TypeVar

from skyloop.errors import SkyloopError

T = TypeVar("T")


def in_parallel(jobs: Mapping[str, Callable[[], T]]) -> tuple[dict[str, T], dict[str, Exception]]:
    """Do all at the same time and wait for the last; what each returned, and what each raised, both by name.

    Only a :class:`SkyloopError` is a drone's own failure; anything else comes out here when all are done. The threads
    are daemons: who interrupts the waiting leaves them to end by themselves.
    """
    results: dict[str, T] = {}
    raised: dict[str, BaseException] = {}

    def work(name: str, job: Callable[[], T]) -> None:
        try:
            results[name] = job()
        except BaseException as error:  # noqa: BLE001  (raised below, on the caller's thread)
            raised[name] = error

    threads = [
        threading.Thread(target=work, args=(name, job), name=f"skyloop-swarm-{name}", daemon=True)
        for name, job in jobs.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    errors: dict[str, Exception] = {}
    for name in jobs:
        error = raised.get(name)
        if isinstance(error, SkyloopError):
            errors[name] = error
        elif error is not None:
            raise error
    return {name: results[name] for name in jobs if name in results}, errors

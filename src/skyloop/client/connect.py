"""Connecting: to a proxy by its name, or to a vehicle by its address through a private proxy."""

from __future__ import annotations

import math
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path
from typing import Final

from skyloop.client.drone import Access, Drone, OnExit
from skyloop.client.pace import Way
from skyloop.errors import UsageError
from skyloop.messages import DEFAULT_PRIORITY, HIGHEST_PRIORITY, LOWEST_PRIORITY

NAME_TIMEOUT_S: Final = 5.0
START_TIMEOUT_S: Final = 20.0  #: for a private proxy and its vehicle
#: Entry points by the scheme of an address: a function that takes the address and returns a :class:`Way`, or None.
CONNECTORS: Final = "skyloop.connectors"


def connect(
    target: str,
    *,
    access: Access = "pilot",
    priority: int = DEFAULT_PRIORITY,
    name: str | None = None,
    wait_s: float = 0.0,
    timeout_s: float | None = None,
    rate_hz: float = 32.0,
    stall_s: float = 1.0,
    on_exit: OnExit = "land",
) -> Drone:
    """Connect to a drone; returns when its state is known and, with ``access="pilot"``, when it may be commanded.

    ``target``: the name of a running proxy of this host, or a vehicle's address such as ``sim://?seed=3`` or
    ``video://flight.mp4``, for which a private proxy is started that ends with the drone and with this process.
    ``access``: ``"pilot"`` requests the authority, ``"observe"`` only looks on. ``priority``: 0 is the highest, 31 the
    lowest; a higher one takes over. ``name``: of this application (default: of its script). ``wait_s``: how long to
    wait in line while somebody else flies. ``timeout_s``: for the proxy to answer (default 5 s, with an address 20 s).
    ``rate_hz``: of repeated commands. ``stall_s``: without a call for this long a velocity or attitude decays to hover
    (``math.inf``: never). ``on_exit``: what an airborne vehicle does at the block's end, ``"land"`` or ``"hover"``.

    Raises :class:`UnknownNameError` (no such proxy), :class:`NoAnswerError`, :class:`AuthorityError` (naming who
    flies), :class:`LinkError`, :class:`UsageError`.
    """
    if not isinstance(target, str) or not target:
        raise UsageError(f"{target!r} is neither the name of a proxy nor a vehicle's address such as sim://")
    if not isinstance(priority, int) or not HIGHEST_PRIORITY <= priority <= LOWEST_PRIORITY:
        raise UsageError(f"priority is {priority!r} and must be a whole number from 0 (highest) to 31 (lowest)")
    for what, seconds in (("wait_s", wait_s), ("timeout_s", timeout_s)):
        if seconds is not None and not (0.0 <= seconds < math.inf):
            raise UsageError(f"{what} is {seconds!r} and must be a number of seconds")
    app = name if name is not None else _script_name()
    deadline = time.monotonic() + (timeout_s or (START_TIMEOUT_S if "://" in target else NAME_TIMEOUT_S))
    if "://" in target:
        way = _way(target)
        dial, end, reach, pace = way.dialer(deadline), way.close, way.reach, way.pace
    else:
        from skyloop.transport.local import dial as local_dial

        dial, end, reach, pace = local_dial(target), None, target, None
    try:
        drone = Drone(
            dial,
            app=app,
            access=access,
            rate_hz=rate_hz,
            stall_s=stall_s,
            on_exit=on_exit,
            pace=pace,
            on_close=end,
            reach=reach,
        )
    except BaseException:
        if end is not None:
            end()
        raise
    return drone.open(priority=priority, wait_s=wait_s, timeout_s=deadline - time.monotonic())


def _way(uri: str) -> Way:
    """A private proxy, unless an installed package has another way to this address."""
    for entry in entry_points(group=CONNECTORS, name=uri.partition("://")[0]):
        own: Way | None = entry.load()(uri)
        if own is not None:
            return own
    from skyloop.client.private import PrivateProxy

    return PrivateProxy(uri)


def _script_name() -> str:
    """The running script's name, for people."""
    script = Path(sys.argv[0] if sys.argv and sys.argv[0] else "python")
    stem = script.parent.name if script.stem == "__main__" else script.stem
    return (stem.strip("-") or "python")[:64]

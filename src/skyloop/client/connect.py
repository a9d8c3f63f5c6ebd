"""Connecting: to a proxy by its name, or to a vehicle by its address through a private proxy."""

from __future__ import annotations

import math
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Final

from skyloop.client.drone import Access, Drone, OnExit
from skyloop.client.pace import Way
from skyloop.client.takeover import TakeoverWay, authority_wish
from skyloop.errors import UsageError
from skyloop.messages import DEFAULT_PRIORITY

if TYPE_CHECKING:
    from skyloop.transport.fabric.environment import Network

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
    network: Network = None,
    keys: Path | str | None = None,
    for_s: float | None = None,
    takeover: TakeoverWay = "now",
    stay: bool = False,
) -> Drone:
    """Connect to a drone; returns when its state is known and, with ``access="pilot"``, when it may be commanded.

    ``target``: the name of a running proxy, or a vehicle's address such as ``sim://?seed=3`` or
    ``video://flight.mp4``, for which a private proxy is started that ends with the drone and with this process.
    A name is looked for on this host first and then, if ``network`` says so, on the network: True searches by
    multicast, ``"10.0.0.5:7447"`` calls an address (several: with commas, and ``multicast`` among them to search as
    well), False stays on this host; default: the variable ``SKYLOOP_NETWORK``, without which nothing leaves this host.
    ``keys``: the folder of an identity for the network (default: the variable ``SKYLOOP_KEYS``).
    ``access``: ``"pilot"`` requests the authority, ``"observe"`` only looks on. ``priority``: 0 is the highest, 31 the
    lowest; a higher one takes over. ``name``: of this application (default: of its script). ``wait_s``: how long to
    wait in line while somebody else flies. ``timeout_s``: for the proxy to answer (default 5 s, with an address 20 s).
    ``rate_hz``: of repeated commands. ``stall_s``: without a call for this long a velocity or attitude decays to hover
    (``math.inf``: never). ``on_exit``: what an airborne vehicle does at the block's end, ``"land"`` or ``"hover"``.
    ``for_s``, ``takeover``, ``stay``: for how long the authority is wanted, whether its holder is asked first, and
    whether to stay in line without it; see :meth:`Drone.request_authority`.

    Raises :class:`UnknownNameError` (no such proxy), :class:`NoAnswerError`, :class:`AuthorityError` (naming who
    flies), :class:`LinkError`, :class:`UsageError`.
    """
    if not isinstance(target, str) or not target:
        raise UsageError(f"{target!r} is neither the name of a proxy nor a vehicle's address such as sim://")
    authority_wish(priority, for_s, takeover)
    for what, seconds in (("wait_s", wait_s), ("timeout_s", timeout_s)):
        if seconds is not None and not (0.0 <= seconds < math.inf):
            raise UsageError(f"{what} is {seconds!r} and must be a number of seconds")
    app = name if name is not None else _script_name()
    deadline = time.monotonic() + (timeout_s or (START_TIMEOUT_S if "://" in target else NAME_TIMEOUT_S))
    if "://" in target:
        way = _way(target)
        dial, end, reach, pace = way.dialer(deadline), way.close, way.reach, way.pace
    else:
        from skyloop.client.by_name import dial_by_name

        # Another process finds it by the name alone only where it would look by itself.
        others_find_it = keys is None and (network is None or network is False)
        dial, end, reach, pace = dial_by_name(target, network, keys), None, target if others_find_it else None, None
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
    left_s = deadline - time.monotonic()
    return drone.open(priority=priority, wait_s=wait_s, timeout_s=left_s, for_s=for_s, takeover=takeover, stay=stay)


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

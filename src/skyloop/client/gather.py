"""Which drones a swarm has, and connecting to all of them at the same time."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from skyloop.client.connect import connect
from skyloop.client.drone import Drone
from skyloop.client.parallel import in_parallel
from skyloop.client.swarm import OnError, Swarm
from skyloop.errors import SwarmError, UnknownNameError, UsageError

if TYPE_CHECKING:
    from skyloop.transport.fabric.environment import Network

Target = str | Mapping[str, str]
Missing = Literal["raise", "skip"]
_WILD: Final = frozenset("*?[")


def swarm(*targets: Target, on_error: OnError = "continue", missing: Missing = "raise", **options: Any) -> Swarm:
    """Connect to several drones at the same time; returns when all are connected, and is used as a block.

    ``targets``: names of running proxies, patterns such as ``"drone*"`` for all that run at this moment, vehicles'
    addresses such as ``"sim://?seed=1"`` (called ``sim1``, ``sim2``, … here), or mappings from a name of your choice
    to either, ``{"left": "sim://?seed=1"}``. ``on_error``: what happens to the others when one fails, see
    :class:`Swarm`. ``missing``: a drone that can't be connected to fails the whole (``"raise"``) or is left out
    (``"skip"``), as long as there is one left. All other options are those of :func:`skyloop.connect`.

    Raises :class:`SwarmError` with the reason of each drone that can't be connected to, after leaving the others;
    :class:`UnknownNameError` for a pattern that nothing matches, :class:`UsageError` for a drone that is named twice.
    """
    if missing not in ("raise", "skip"):
        raise UsageError(f'missing is {missing!r} and must be "raise" or "skip"')
    Swarm.check_policy(on_error)
    chosen = choose(targets, lambda: running_names(options.get("network"), options.get("keys")))

    def join(target: str) -> Callable[[], Drone]:
        return lambda: connect(target, **options)

    drones, errors = in_parallel({name: join(target) for name, target in chosen.items()})
    if errors and (missing == "raise" or not drones):
        in_parallel({name: drone.leave for name, drone in drones.items()})
        raise SwarmError("connecting", errors, len(chosen))
    return Swarm(drones, on_error=on_error, missing=errors)


def choose(targets: Iterable[Target], running: Callable[[], Iterable[str]]) -> dict[str, str]:
    """What to connect to, by name, in the order given; ``running`` is asked only if there is a pattern. Pure.

    Raises :class:`UsageError` and :class:`UnknownNameError`.
    """
    chosen: dict[str, str] = {}
    counts: dict[str, int] = {}
    for target in targets:
        for name, address in _named(target, running, counts):
            if name in chosen:
                raise UsageError(f"{name!r} is named twice: each drone can be in a swarm once")
            chosen[name] = address
    if not chosen:
        raise UsageError('a swarm needs at least one drone: swarm("alpha", "bravo"), or a pattern as swarm("drone*")')
    return chosen


def _named(target: Target, running: Callable[[], Iterable[str]], counts: dict[str, int]) -> Iterable[tuple[str, str]]:
    if isinstance(target, Mapping):
        for name, address in target.items():
            if not isinstance(name, str) or not name or not isinstance(address, str) or not address:
                raise UsageError(f"{name!r}: {address!r} is no drone: a name and what to connect to are needed")
        return list(target.items())
    if not isinstance(target, str) or not target:
        raise UsageError(f"{target!r} is neither the name of a proxy, a pattern, nor a vehicle's address")
    if "://" in target:
        scheme = target.partition("://")[0]
        counts[scheme] = counts.get(scheme, 0) + 1
        return [(f"{scheme}{counts[scheme]}", target)]
    if _WILD.isdisjoint(target):
        return [(target, target)]
    known = sorted(running())
    found = fnmatch.filter(known, target)
    if not found:
        raise UnknownNameError("running proxy", target, known)
    return [(name, name) for name in found]


def running_names(network: Network = None, keys: Path | str | None = None) -> list[str]:
    """The proxies that run and can be reached by name: on this host, and over the network where that is asked for."""
    from skyloop.client.by_name import network_settings
    from skyloop.transport.local import list_names

    near = {proxy.name for proxy in list_names()}
    settings = network_settings(network, keys)
    if settings is None:
        return sorted(near)
    from skyloop.transport.fabric import list_proxies

    return sorted(near | {about.name for about in list_proxies(settings)})

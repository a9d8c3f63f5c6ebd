"""Connect to a proxy by name, to a vehicle by address through a private proxy, or to several drones at once."""

from __future__ import annotations

import fnmatch
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import wraps
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final, Literal, ParamSpec, Protocol, TypeAlias, TypedDict, TypeVar, Unpack

from skyloop.client.authority import Authority, check_seconds
from skyloop.client.connection import Scheduler
from skyloop.client.core import Access, DroneCore, OnExit
from skyloop.client.drone import Drone
from skyloop.client.swarm import OnError, Swarm, check_policy, end_flights, in_parallel
from skyloop.client.warm_up import keeper
from skyloop.errors import Hint, LinkError, MissingExtraError, SwarmError, UnknownNameError, UsageError
from skyloop.transport.base import ClientHandler, Dialer, TransportClient, check_name
from skyloop.warmth import PERIOD_S

NAME_TIMEOUT_S: Final = 5.0
START_TIMEOUT_S: Final = 20.0  #: for a private proxy and its vehicle
#: Entry points by the scheme of an address: functions that take the address and return a :class:`Connector`, or None.
CONNECTORS: Final = "skyloop.connectors"
#: Entry points of what reaches proxies beyond this host: a module as :class:`NetworkTransport`.
NETWORKS: Final = "skyloop.networks"


P = ParamSpec("P")
R = TypeVar("R")
#: Where options of earlier versions are now.
_MOVED: Final = dict.fromkeys(("priority", "wait_s", "for_s", "takeover", "stay"), "authority=skyloop.Authority") | {
    "keys": "network=skyloop.Network"
}


@dataclass(frozen=True, slots=True)
class Network:
    """How a program joins the network: ``connect("alpha", network=Network("10.0.0.5:7447", keys=folder))``.

    Attributes:
        address: ``"10.0.0.5:7447"`` connects to an address (several with commas, with ``multicast`` among them to
            search as well); True searches by multicast; False stays on this host. None: as the variable
            ``SKYLOOP_NETWORK`` says, without which it searches by multicast.
        keys: Folder of an identity; None: from the variable ``SKYLOOP_KEYS``.
    """

    address: bool | str | None = None
    keys: Path | str | None = None


class NetworkSettings(Protocol):
    """How the network is reached: made, and understood, by the :class:`NetworkTransport` alone."""

    @property
    def reach(self) -> str:
        """Where proxies are searched for, for people."""


class NetworkTransport(Protocol):
    """What a package brings that carries connections beyond this host; :mod:`skyloop.network` is one."""

    def choose(self, network: bool | str | NetworkSettings | None, keys: Path | str | None) -> NetworkSettings | None:
        """Return how the network is reached; None to stay on this host. Raises :class:`UsageError`."""

    def dial(self, name: str, settings: NetworkSettings) -> Dialer:
        """Return a dialer of the proxy with this name."""

    def list_proxies(self, settings: NetworkSettings) -> Iterable[Any]:
        """Return what runs now: each has a ``name``."""


NetworkChoice: TypeAlias = "Network | NetworkSettings | bool | str | None"


class ConnectOptions(TypedDict, total=False):
    """Options of :func:`connect`, as it documents them."""

    access: Access
    name: str | None
    timeout_s: float | None
    rate_hz: float
    stall_s: float
    on_exit: OnExit
    authority: Authority | None
    network: NetworkChoice
    warm_s: float


def explains_moved_options(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function of :class:`ConnectOptions` so that options of old names raise a :class:`UsageError`."""

    @wraps(function)
    def call(*args: P.args, **options: P.kwargs) -> R:
        for name, value in options.items():
            if name in _MOVED:
                raise UsageError(f"{name}={value!r:.40} is written {_MOVED[name]}({name}={value!r:.40}) now")
        return function(*args, **options)

    return call


@explains_moved_options
def connect(
    target: str,
    *,
    access: Access = "pilot",
    name: str | None = None,
    timeout_s: float | None = None,
    rate_hz: float = 32.0,
    stall_s: float = 1.0,
    on_exit: OnExit = "land",
    authority: Authority | None = None,
    network: NetworkChoice = None,
    warm_s: float = PERIOD_S,
) -> Drone:
    """Connect to a drone.

    Returns when the vehicle's state is known and, with ``access="pilot"``, when it may be commanded. A vehicle that was
    started just now is waited for until it can take off, and the log (``skyloop``) says so; after ``timeout_s`` the
    call returns all the same, and :meth:`Drone.takeoff` goes on waiting.

    Args:
        target: Name of a running proxy, or address of a vehicle such as ``sim://?seed=3`` or ``video://flight.mp4``.
            For an address a private proxy is started, which ends with the drone and with this process. A name is
            looked up on this host first and then, if ``network`` allows, on the network.
        access: ``"pilot"`` requests the authority, ``"observe"`` only reads.
        name: Name of this application, 1 to 64 characters; None: the running script's.
        timeout_s: Time for the proxy to answer [s]; None or 0: 5 s for a name, 20 s for an address.
        rate_hz: Rate at which commands are repeated, 1 to 200 Hz.
        stall_s: Time without a call after which a velocity or attitude decays to hover [s]; ``math.inf``: never.
        on_exit: What an airborne vehicle does at the end of the block, ``"land"`` or ``"hover"``.
        authority: How a pilot asks for the authority: priority, waiting, asking its holder first. None:
            ``Authority()``.
        network: True, an address, or a :class:`Network` with keys; False stays on this host. None: as the variable
            ``SKYLOOP_NETWORK`` says, without which nothing leaves this host.
        warm_s: How often the code of commands, feedback and frames is run on a dummy while this application flies [s],
            so that it stays in the processor's caches and delays are shorter; 0: never.

    Raises:
        UnknownNameError: If no proxy of this name runs; carries suggestions.
        NoAnswerError: If the proxy does not answer in time, or sends no feedback.
        AuthorityError: If the authority can't be had; names its holder.
        RefusedError: If the proxy refuses the connection.
        LinkError: If the proxy or the private proxy can't be reached, or ends.
        UsageError: If an argument is out of range, or the address makes no sense.
        MissingExtraError: If the network is asked for and the extra ``network`` is not installed.
    """
    if not isinstance(authority, Authority | None):
        raise UsageError(f"authority is {authority!r:.80} and must be a skyloop.Authority, as Authority(priority=4)")
    core, deadline = prepare(
        target,
        access=access,
        name=name,
        timeout_s=timeout_s,
        rate_hz=rate_hz,
        stall_s=stall_s,
        on_exit=on_exit,
        network=network,
        warm_s=warm_s,
    )
    core.open(timeout_s=deadline - time.monotonic(), authority=authority)
    return Drone(core)


def prepare(
    target: str,
    *,
    access: Access = "pilot",
    name: str | None = None,
    timeout_s: float | None = None,
    rate_hz: float = 32.0,
    stall_s: float = 1.0,
    on_exit: OnExit = "land",
    network: NetworkChoice = None,
    warm_s: float = PERIOD_S,
) -> tuple[DroneCore, float]:
    """Return a drone that is not connected yet, and until when that may take, on ``time.monotonic``.

    A private proxy is started. Arguments and errors are those of :func:`connect`.
    """
    if not isinstance(target, str) or not target:
        raise UsageError(f"{target!r} is neither the name of a proxy nor a vehicle's address such as sim://")
    if timeout_s is not None:
        check_seconds("timeout_s", timeout_s)
    keep_warm = keeper(warm_s)
    app = name if name is not None else _script_name()
    deadline = time.monotonic() + (timeout_s or (START_TIMEOUT_S if "://" in target else NAME_TIMEOUT_S))
    if "://" in target:
        connector = _connector(target)
        dial, end, reach, scheduler = connector.dialer(deadline), connector.close, connector.reach, connector.scheduler
    else:
        # Another process can use the name alone only if it finds the proxy without network settings.
        others_find_it = network is None or network is False
        dial, end, reach, scheduler = dial_by_name(target, network), None, target if others_find_it else None, None
    try:
        core = DroneCore(
            dial,
            app=app,
            access=access,
            rate_hz=rate_hz,
            stall_s=stall_s,
            on_exit=on_exit,
            scheduler=scheduler,
            on_close=end,
            reach=reach,
            keep_warm=None if scheduler is not None and scheduler.in_step else keep_warm,
        )
    except BaseException:
        if end is not None:
            end()
        raise
    return core, deadline


def _connector(uri: str) -> Connector:
    """The connector that an installed package has for this scheme, else a private proxy."""
    for entry in entry_points(group=CONNECTORS, name=uri.partition("://")[0]):
        own: Connector | None = entry.load()(uri)
        if own is not None:
            return own
    from skyloop.client.private_proxy import PrivateProxy

    return PrivateProxy(uri)


def _script_name() -> str:
    """The running script's name, for people."""
    script = Path(sys.argv[0] if sys.argv and sys.argv[0] else "python")
    stem = script.parent.name if script.stem == "__main__" else script.stem
    return (stem.strip("-") or "python")[:64]


class Connector(Protocol):
    """How a vehicle's address is reached: by a private proxy, or within this process."""

    scheduler: Scheduler

    @property
    def reach(self) -> str | None:
        """What another process connects to for the same vehicle; None if it can't."""

    def dialer(self, deadline_s: float) -> Dialer:
        """Return a dialer that at first waits until the proxy serves.

        Args:
            deadline_s: Until when it waits at most, on ``time.monotonic``.
        """

    def close(self) -> None:
        """End whatever was started. Idempotent."""


NETWORK_VARIABLE: Final = "SKYLOOP_NETWORK"


def network_settings(network: NetworkChoice = None, keys: Path | str | None = None) -> NetworkSettings | None:
    """Return how to search the network; None if it is not to be searched.

    Args:
        network: As for :func:`connect`.
        keys: Folder of an identity, for the command line; None: from ``network``.

    Raises:
        UsageError: If an address or the folder is not valid.
    """
    if isinstance(network, Network):
        address, keys = network.address, network.keys or keys
        if address is None and NETWORK_VARIABLE not in os.environ:
            address = True
        return network_settings(address, keys)
    if network is False or (network is None and keys is None and not os.environ.get(NETWORK_VARIABLE)):
        return None  # without importing the network's packages
    return _network().choose(network, keys)


def _network() -> NetworkTransport:
    for entry in entry_points(group=NETWORKS):
        transport: NetworkTransport = entry.load()
        return transport
    raise MissingExtraError("the network", "network", cause="no package brings a transport for it")


def dial_by_name(name: str, network: NetworkChoice = None) -> Dialer:
    """Return the dialer of the proxy with this name.

    Each time it prefers a proxy on this host, where Linux' local transport is available. It raises
    :class:`UnknownNameError`, which says where it searched, and :class:`LinkError`.

    Args:
        name: Name of the proxy.
        network: As for :func:`connect`.

    Raises:
        UsageError: If ``name`` can't be a name.
    """
    check_name(name)
    settings = network_settings(network)
    if settings is None:
        return _hinting(_local(name))
    far = _network().dial(name, settings)
    if sys.platform != "linux":
        return far
    near = _local(name)

    def dialer(handler: ClientHandler) -> TransportClient:
        try:
            return near(handler)
        except LinkError:
            return far(handler)  # a killed proxy has left its socket, or it belongs to another user
        except UnknownNameError as here:
            known = here.known
        try:
            return far(handler)
        except UnknownNameError as there:
            place = f"proxy on this host or the network ({settings.reach})"
            raise UnknownNameError(place, name, {*known, *there.known}) from None

    return dialer


def _local(name: str) -> Dialer:
    from skyloop.transport.local import dial

    return dial(name)


def _hinting(near: Dialer) -> Dialer:
    def dialer(handler: ClientHandler) -> TransportClient:
        try:
            return near(handler)
        except UnknownNameError as error:
            raise error.with_hint(Hint.SEARCH_NETWORK) from None

    return dialer


Target = str | Mapping[str, str]
Missing = Literal["raise", "skip"]
_WILD: Final = frozenset("*?[")


@explains_moved_options
def swarm(
    *targets: Target, on_error: OnError = "continue", missing: Missing = "raise", **options: Unpack[ConnectOptions]
) -> Swarm:
    """Connect to several drones at the same time; returns when all are connected.

    Args:
        *targets: Names of running proxies, patterns such as ``"drone*"`` for all that run now, addresses of vehicles
            such as ``"sim://?seed=1"`` (named ``sim1``, ``sim2``, …), or mappings from a name of your choice to
            either, ``{"left": "sim://?seed=1"}``.
        on_error: What happens to the others when one fails; see :class:`Swarm`.
        missing: A drone that can't be connected to fails the call (``"raise"``) or is left out (``"skip"``), as long
            as one is left.
        **options: As for :func:`skyloop.connect`, for each drone.

    Returns:
        The swarm, a context manager.

    Raises:
        SwarmError: With the reason of each drone that can't be connected to, after leaving the others.
        UnknownNameError: If a pattern matches no running proxy.
        UsageError: If a drone is named twice, none is named, or ``on_error`` or ``missing`` is unknown.
    """
    if missing not in ("raise", "skip"):
        raise UsageError(f'missing is {missing!r} and must be "raise" or "skip"')
    check_policy(on_error)
    chosen = choose(targets, lambda: running_names(options.get("network")))

    def join(target: str) -> Callable[[], Drone]:
        return lambda: connect(target, **options)

    drones, errors = in_parallel({name: join(target) for name, target in chosen.items()})
    if errors and (missing == "raise" or not drones):
        end_flights(drones)
        raise SwarmError("connecting", errors, len(chosen))
    return Swarm(drones, on_error=on_error, missing=errors)


def choose(targets: Iterable[Target], running: Callable[[], Iterable[str]]) -> dict[str, str]:
    """Return what to connect to, by name, in the order given. Pure.

    Args:
        targets: As for :func:`swarm`.
        running: Returns the names of running proxies; called only if there is a pattern.

    Raises:
        UsageError: If a target makes no sense or is named twice, or there is none.
        UnknownNameError: If a pattern matches no running proxy.
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


def running_names(network: NetworkChoice = None) -> list[str]:
    """Return the names of running proxies, sorted: on this host, and on the network if it is asked for.

    Args:
        network: As for :func:`connect`.
    """
    from skyloop.transport.local import list_names

    near = {proxy.name for proxy in list_names()}
    settings = network_settings(network)
    if settings is None:
        return sorted(near)
    return sorted(near | {about.name for about in _network().list_proxies(settings)})

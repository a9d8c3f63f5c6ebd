"""Connect to a proxy by name, or to a vehicle by address through a private proxy in a child process."""

from __future__ import annotations

import itertools
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial, wraps
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final, ParamSpec, Protocol, TypeAlias, TypedDict, TypeVar, Unpack

from skyloop.address import shown_address
from skyloop.child_process import GRACE_S, ChildProcess
from skyloop.client.authority import Authority, check_seconds
from skyloop.client.connection import Scheduler
from skyloop.client.drone import Access, Drone, DroneOptions
from skyloop.client.piloting import OnExit
from skyloop.errors import Hint, LinkError, MissingExtraError, NoAnswerError, UnknownNameError, UsageError
from skyloop.platform import read_within
from skyloop.transport.base import ClientHandler, Dialer, TransportClient, check_name

NAME_TIMEOUT_S: Final = 5.0  #: time limit for a running proxy to answer
START_TIMEOUT_S: Final = 20.0  #: time limit for a private proxy and its vehicle to start
WAKE_S: Final = 60.0  #: time limit for a vehicle to start up; no driver needs longer
#: Entry-point group of connectors, named after address schemes; each returns a :class:`Connector` or None.
CONNECTORS: Final = "skyloop.connectors"
#: Entry-point group of transports to other hosts; each is a module that implements :class:`NetworkTransport`.
NETWORKS: Final = "skyloop.networks"
NETWORK_VARIABLE: Final = "SKYLOOP_NETWORK"
_USAGE_ERROR: Final = 2  #: exit code of a child that rejects its address after printing a one-line reason
_OUTPUT_WAIT_S: Final = 0.05  #: how long to wait for output from the child before checking whether it still runs
ORPHAN_LANDS_WITHIN_S: Final = 180.0  #: maximum time for which the child waits for its vehicle to land
_numbers = itertools.count(1)

P = ParamSpec("P")
R = TypeVar("R")
#: Maps each option that earlier versions took directly to the argument that contains it now.
_MOVED: Final = dict.fromkeys(("priority", "wait_s", "for_s", "takeover", "stay"), "authority=skyloop.Authority") | {
    "keys": "network=skyloop.Network"
}


@dataclass(frozen=True, slots=True)
class Network:
    """Where to find drones on other hosts: ``connect("alpha", network=Network("10.0.0.5:7447", keys=folder))``.

    Attributes:
        address: An address such as ``"10.0.0.5:7447"``, or several separated by commas (include ``multicast`` to search
            as well). True searches by multicast, and False stays on this host. None uses the variable
            ``SKYLOOP_NETWORK`` or, if it is not set, searches by multicast.
        keys: Folder that contains an identity; None: the folder given by the variable ``SKYLOOP_KEYS``.
    """

    address: bool | str | None = None
    keys: Path | str | None = None


class NetworkSettings(Protocol):
    """Settings that only the :class:`NetworkTransport` that created them can interpret."""

    @property
    def reach(self) -> str:
        """Human-readable description of where the transport searches for proxies."""


class NetworkTransport(Protocol):
    """A package's transport to other hosts, such as :mod:`skyloop.network`."""

    def choose(self, network: bool | str | NetworkSettings | None, keys: Path | str | None) -> NetworkSettings | None:
        """Return the network's settings; None to stay on this host. Raises :class:`UsageError`."""

    def dial(self, name: str, settings: NetworkSettings) -> Dialer:
        """Return a dialer for the proxy with this name."""

    def list_proxies(self, settings: NetworkSettings) -> Iterable[Any]:
        """Return the running proxies; each has a ``name``."""


NetworkChoice: TypeAlias = "Network | NetworkSettings | bool | str | None"


class ConnectOptions(TypedDict, total=False):
    """Options of :func:`connect`, which documents them."""

    access: Access
    name: str | None
    timeout_s: float | None
    rate_hz: float
    stall_s: float
    on_exit: OnExit
    authority: Authority | None
    network: NetworkChoice


def explains_moved_options(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that takes :class:`ConnectOptions` so that old options raise :class:`UsageError`."""

    @wraps(function)
    def call(*args: P.args, **options: P.kwargs) -> R:
        for name, value in options.items():
            if name in _MOVED:
                raise UsageError(f"{name}={value!r:.40} is now written {_MOVED[name]}({name}={value!r:.40})")
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
) -> Drone:
    """Connect to a drone.

    Returns once the vehicle's state is known and, with ``access="pilot"``, once this application may command it. If the
    vehicle has just started, the call logs this (``skyloop``) and waits until the vehicle can take off. After
    ``timeout_s`` or 60 s it returns in any case, and :meth:`Drone.takeoff` waits for the remaining time.

    Args:
        target: Name of a running proxy, or a vehicle's address, such as ``sim://?seed=3`` or ``video://flight.mp4``.
            An address starts a private proxy, which ends when the drone is closed or this process ends. A name is
            looked up first on this host and then, if ``network`` allows it, on the network.
        access: ``"pilot"`` requests the authority; ``"observe"`` only reads.
        name: Name of this application, 1 to 64 characters; None: the name of the running script.
        timeout_s: Time limit for the proxy to answer and the vehicle to start up [s]. None or 0: 5 s for a name or 20 s
            for an address, then 60 s for the vehicle.
        rate_hz: Rate at which commands are repeated, 1 to 200 Hz.
        stall_s: Time without a call after which a velocity or attitude decays to hover [s]; ``math.inf``: never.
        on_exit: What an airborne vehicle does at the end of the ``with`` block: ``"land"`` or ``"hover"``. A vehicle
            flown by someone else is left alone, and the log warns about it.
        authority: How a pilot requests the authority: its priority, how long it waits, and whether it asks the holder
            first. None: ``Authority()``.
        network: True, an address, or a :class:`Network` with keys; False searches only this host. None: the value of
            the variable ``SKYLOOP_NETWORK``; if it is not set, only this host.

    Raises:
        UnknownNameError: If no proxy of this name is running; the error suggests similar names.
        NoAnswerError: If the proxy does not answer in time, or sends no feedback.
        AuthorityError: If the authority is not granted; the message names the holder.
        RefusedError: If the proxy refuses the connection.
        LinkError: If the proxy can't be reached or ends.
        UsageError: If an argument is out of range, or the address is invalid.
        MissingExtraError: If ``network`` is used and the extra ``network`` is not installed.
    """
    if not isinstance(authority, Authority | None):
        raise UsageError(f"authority is {authority!r:.80} and must be a skyloop.Authority, e.g. Authority(priority=4)")
    drone, deadline = prepare(
        target, name, timeout_s, network, access=access, rate_hz=rate_hz, stall_s=stall_s, on_exit=on_exit
    )
    wake_s = 0.0 if timeout_s else WAKE_S
    drone._connect(timeout_s=deadline - time.monotonic(), authority=authority, wake_s=wake_s)
    return drone


def prepare(
    target: str,
    name: str | None = None,
    timeout_s: float | None = None,
    network: NetworkChoice = None,
    **options: Unpack[DroneOptions],
) -> tuple[Drone, float]:
    """Return an unconnected drone and the deadline for connecting to it (on ``time.monotonic``).

    Starts a private proxy if needed. Arguments and errors are those of :func:`connect`.
    """
    if not isinstance(target, str) or not target:
        raise UsageError(f"{target!r} is neither the name of a proxy nor a vehicle's address such as sim://")
    if timeout_s is not None:
        check_seconds("timeout_s", timeout_s)
    app = name if name is not None else _script_name()
    deadline = time.monotonic() + (timeout_s or (START_TIMEOUT_S if "://" in target else NAME_TIMEOUT_S))
    if "://" not in target:
        # Other processes can use the bare name only if they can find the proxy without network settings.
        options["reach"] = target if network is None or network is False else None
        return Drone(dial_by_name(target, network), app=app, **options), deadline
    way = _connector(target)
    try:
        options |= {"scheduler": way.scheduler, "on_close": way.close, "reach": way.reach}
        return Drone(way.dialer(deadline), app=app, **options), deadline
    except BaseException:
        way.close()
        raise


def _connector(uri: str) -> Connector:
    """Return the connector that an installed package provides for this scheme, or a private proxy."""
    for entry in entry_points(group=CONNECTORS, name=uri.partition("://")[0]):
        own: Connector | None = entry.load()(uri)
        if own is not None:
            return own
    return PrivateProxy(uri)


def _script_name() -> str:
    script = Path(sys.argv[0] if sys.argv and sys.argv[0] else "python")
    stem = script.parent.name if script.stem == "__main__" else script.stem
    return (stem.strip("-") or "python")[:64]


class Connector(Protocol):
    """Access to a vehicle by its address, either through a private proxy or within this process."""

    scheduler: Scheduler

    @property
    def reach(self) -> str | None:
        """The target with which other processes can reach the same vehicle; None if they can't reach it."""

    def dialer(self, deadline_s: float) -> Dialer:
        """Return a dialer whose first call waits for the proxy until ``deadline_s`` (on ``time.monotonic``)."""

    def close(self) -> None:
        """Stop everything that this connector started. Idempotent."""


class PrivateProxy:
    """Runs ``python -m skyloop proxy URI`` as a child process.

    The child ends on :meth:`close` or when this process ends. If the vehicle is still flying for this process, the
    child lands it first. Ctrl-C reaches only the application, which can then land the vehicle.
    """

    def __init__(self, uri: str, command: Sequence[str] = (sys.executable, "-m", "skyloop", "proxy")) -> None:
        """Start the child with the command line ``command``, to which the address is added."""
        scheme = re.sub(r"[^a-z0-9]", "", uri.partition("://")[0].lower()) or "vehicle"
        self.name = f"{scheme[:16]}-{os.getpid()}-{next(_numbers)}"
        self.reach = self.name
        self.uri = shown_address(uri)
        self.scheduler = Scheduler()
        self._served = False  # whether it has served a client, whose vehicle may be in the air
        self._process = ChildProcess([*command, self.uri, "--name", self.name, "--parent-fd", "0"], handed=uri)
        self.pid = self._process.pid  #: process id of the child

    def dialer(self, deadline_s: float) -> Dialer:
        """Return a dialer whose first call waits for the proxy until ``deadline_s``, a time on ``time.monotonic``.

        The dialer raises :class:`NoAnswerError` if the proxy takes too long and :class:`UsageError` if the address is
        invalid. If the child has ended, it raises :class:`LinkError` with the last part of the child's standard error.
        """
        inner = _local(self.name)

        def dial(handler: ClientHandler) -> TransportClient:
            while True:
                try:
                    end = inner(handler)
                except (LinkError, UsageError) as error:
                    self._check_alive()
                    if time.monotonic() > deadline_s:
                        if self._served:
                            raise
                        raise NoAnswerError(
                            f"the proxy for {self.uri} did not start in time{self._process.quoted_output}"
                        ) from error
                    self._wait_for_output()
                else:
                    self._served = True
                    return end

        return dial

    def close(self) -> None:
        """End the child; if it is still landing its vehicle after 4 s, return and let it finish. Idempotent.

        A child that never served a client is terminated after 4 s and killed after another 4 s.
        """
        self._process.part()
        if not self._served or self._process.wait(GRACE_S) is not None:
            self._process.close(GRACE_S, GRACE_S)
        else:
            end = partial(self._process.close, ORPHAN_LANDS_WITHIN_S + GRACE_S, GRACE_S)
            threading.Thread(target=end, name="skyloop-private-proxy", daemon=True).start()

    def _check_alive(self) -> None:
        child = self._process
        if child.code is None:
            return
        if child.code == _USAGE_ERROR and (words := child.stderr_tail.removeprefix("skyloop: ")):
            raise UsageError(words)
        raise LinkError(f"the proxy for {self.uri} {child.ending}{child.quoted_output}")

    def _wait_for_output(self) -> None:
        """Sleep until the child prints something (such as its readiness) or ends, or until a short time has passed."""
        if read_within(self._process.stdout, _OUTPUT_WAIT_S) == b"":
            time.sleep(0.005)  # the child has closed its output and is about to exit


def network_settings(network: NetworkChoice = None, keys: Path | str | None = None) -> NetworkSettings | None:
    """Return the settings for searching the network; None for this host only. ``keys``: from the command line.

    Raises :class:`UsageError` if an address or the folder is invalid.
    """
    if isinstance(network, Network):
        address, keys = network.address, network.keys or keys
        if address is None and NETWORK_VARIABLE not in os.environ:
            address = True
        return network_settings(address, keys)
    if network is False or (network is None and keys is None and not os.environ.get(NETWORK_VARIABLE)):
        return None  # avoids importing the network's packages
    return _network().choose(network, keys)


def _network() -> NetworkTransport:
    for entry in entry_points(group=NETWORKS):
        transport: NetworkTransport = entry.load()
        return transport
    raise MissingExtraError("the network", "network", cause="no package provides a transport for it")


def dial_by_name(name: str, network: NetworkChoice = None) -> Dialer:
    """Return a dialer for the proxy with this name.

    Each call prefers a proxy on this host. The dialer raises :class:`LinkError`, or :class:`UnknownNameError`, which
    lists where it searched. This function raises :class:`UsageError` if ``name`` is not a valid name.
    """
    check_name(name)
    settings = network_settings(network)
    if settings is None:
        return _hinting(_local(name))
    far = _network().dial(name, settings)
    near = _local(name)

    def dialer(handler: ClientHandler) -> TransportClient:
        try:
            return near(handler)
        except LinkError:
            return far(handler)  # the name is the leftover socket of a killed proxy, or belongs to another user
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


def running_names(network: NetworkChoice = None) -> list[str]:
    """Return the sorted names of the proxies running on this host and, if requested, on the network."""
    from skyloop.transport.local import list_names

    near = {proxy.name for proxy in list_names()}
    settings = network_settings(network)
    if settings is None:
        return sorted(near)
    return sorted(near | {about.name for about in _network().list_proxies(settings)})

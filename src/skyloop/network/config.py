"""Read network settings from arguments and the environment, and create Zenoh's configuration from them.

Pure, except that it reads the environment and finds a free port.
"""

from __future__ import annotations

import json
import logging
import os
import socket
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from skyloop.errors import Hint, LinkError, UsageError
from skyloop.network.layout import ANYONE, check_identity

if TYPE_CHECKING:
    from skyloop.network.keys import Credentials, Identity, KeyRing

LEASE_S: Final = 0.7  #: default time without any packet after which a peer is considered gone
MAX_LEASE_S: Final = 10.0  #: longest lease that can be set
DEFAULT_PORT: Final = 7447  #: Zenoh's default port
#: Time for an address to answer before the peer's next address is tried.
OPEN_MS: Final = 800
#: The same for addresses that were given explicitly. All are tried at once, and one may lead to a mobile network, where
#: answers after an outage are queued behind old video. An end that gives up just before the last answer leaves a
#: half-open link at the other end. Zenoh mistakes the next link for a duplicate and does not repeat declarations on it.
OPEN_GIVEN_MS: Final = 1500
#: How long a session waits to discover others when it is opened (Zenoh's default). An application with one address
#: waits only for the proxy at that address. With several, it must find all proxies with the name.
SETTLE_MS: Final = 500
MAX_MESSAGE: Final = 1 << 27  #: maximum size of a received frame [bytes]
#: Maximum size of a message to a proxy [bytes]. Frames travel the other way. Larger ones are dropped before reassembly.
MAX_MESSAGE_UP: Final = 1 << 18
_ENCRYPTED: Final = ("quic/", "tls/")
_PROTOCOLS: Final = (*_ENCRYPTED, "tcp/", "udp/", "ws/", "unixsock-stream/", "serial/", "unixpipe/", "vsock/")
_RETRY: Final = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
_log = logging.getLogger(__name__)

NETWORK_VARIABLE: Final = "SKYLOOP_NETWORK"
KEYS_VARIABLE: Final = "SKYLOOP_KEYS"
LEASE_VARIABLE: Final = "SKYLOOP_LEASE_S"
MULTICAST: Final = "multicast"
_ON: Final = frozenset({MULTICAST, "on", "1", "true", "yes"})
_OFF: Final = frozenset({"", "off", "0", "false", "no"})


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """An identity for mutual TLS, in PEM files."""

    ca: Path  #: certificate of the authority that signed all identities
    certificate: Path
    key: Path


@dataclass(frozen=True, slots=True)
class FabricSettings:
    """How to join the network: by default, via multicast on this host's network segments, without keys.

    ``listen`` and ``connect`` are addresses such as ``10.0.0.5:7447``, ``[::1]:0`` (any free port) or ``10.0.0.5``
    (port 7447). Each means TCP (packets that must arrive) and UDP (commands and feedback) without keys, and QUIC with
    keys. An address may also be a full Zenoh endpoint such as ``tcp/10.0.0.5:7447``, which is used unchanged.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    multicast: bool = True  #: discover by UDP multicast on this host's network segments
    tls: TlsFiles | None = None
    #: Silence after which a link is considered lost [s]. Peers learn this value, and applications add 0.3 s to it. A
    #: mobile network may be silent for seconds, and may need another second to deliver lost packets.
    lease_s: float = LEASE_S
    who: str = ANYONE  #: the identity, which is the certificate's common name
    #: Zenoh's ``access_control`` section (https://zenoh.io/docs/manual/access-control/), or None.
    access_control: dict[str, Any] | None = None
    #: The keys that ``tls`` and ``access_control`` were made from.
    ring: KeyRing | None = field(default=None, compare=False)

    def current(self) -> FabricSettings:
        """Return these settings with the folder's newest roster; raise :class:`LinkError` if it revokes our keys."""
        if self.ring is None:
            return self
        self.ring.refresh()
        credentials = self.ring.credentials
        if not self.ring.admits(credentials.identity):
            raise LinkError(f"the keys of {credentials.name} were revoked, or their rights changed: get new ones")
        if not self.ring.outdated:
            return self
        return secured(self, credentials)

    @property
    def excused_s(self) -> float:
        """How much longer than the default a silence may last [s]."""
        return self.lease_s - LEASE_S

    @property
    def reach(self) -> str:
        """Text that tells users where proxies are searched for."""
        ways = [*self.connect, *(["multicast"] if self.multicast else [])]
        return ", ".join(ways) or "nowhere"

    @property
    def identity(self) -> Identity | None:
        """The identity that the keys belong to; None without keys."""
        return None if self.ring is None else self.ring.credentials.identity

    def __post_init__(self) -> None:
        check_identity(self.who)
        if not LEASE_S <= self.lease_s <= MAX_LEASE_S:
            raise UsageError(f"the lease is {self.lease_s!r} and must be {LEASE_S:g} to {MAX_LEASE_S:g} seconds")
        if self.tls is None and self.who != ANYONE:
            raise UsageError(f"the identity {self.who!r} needs its certificate and key")


def secured(settings: FabricSettings, credentials: Credentials) -> FabricSettings:
    """Return these settings with keys added: mutual TLS over QUIC, and access control based on the keys' roster."""
    from skyloop.network.keys import KeyRing  # imported only if there are keys, because it needs cryptography
    from skyloop.network.keys.identity import access_control

    return replace(
        settings,
        tls=TlsFiles(credentials.authority_file, credentials.certificate_file, credentials.key_file),
        who=credentials.name,
        access_control=access_control(credentials.roster.identities),
        ring=KeyRing(credentials),
    )


#: ``True``: discover by multicast. A string: addresses to connect to, separated by commas, and ``multicast`` to
#: discover as well. ``False``: this host only. ``None``: the environment decides.
NetworkChoice = bool | str | FabricSettings | None


def choose(network: NetworkChoice = None, keys: Path | str | None = None) -> FabricSettings | None:
    """Return the network settings, or None to stay on this host. By default, they come from the environment.

    Log a warning if the key expires within a week. ``keys``: an identity's folder, by default ``SKYLOOP_KEYS``.
    """
    if isinstance(network, FabricSettings):
        found = network if keys is None else secure(network, keys)
    else:
        requested = os.environ.get(NETWORK_VARIABLE, "") if network is None else network
        if isinstance(requested, bool):
            requested = MULTICAST if requested else ""
        if requested.strip().lower() in _OFF:
            if keys is not None and network is None:
                raise UsageError("keys are for the network").with_hint(Hint.NAME_NETWORK)
            return None
        words = [word.strip() for word in requested.split(",") if word.strip()]
        connect = tuple(word for word in words if word.lower() not in _ON)
        found = settings(connect=connect, multicast=len(connect) < len(words), keys=keys)
    for change in () if found.ring is None else found.ring.poll():
        _log.warning("%s", change)
    return found


def serving(
    network: str,
    *,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    multicast: bool = True,
    keys: Path | str | None = None,
) -> FabricSettings:
    """Return the network settings for a proxy, a host or a router.

    ``network``: ``multicast``, or routers' addresses separated by commas. The list may include ``multicast`` to use
    both. ``multicast=False`` always forbids multicast. ``keys``: an identity's folder, by default ``SKYLOOP_KEYS``.
    """
    words = [word.strip() for word in network.split(",") if word.strip()]
    if not words:
        raise UsageError("the network is empty: give multicast, or addresses separated by commas")
    routers = [word for word in words if word.lower() != MULTICAST]
    return settings(
        listen=listen, connect=(*routers, *connect), multicast=multicast and len(routers) < len(words), keys=keys
    )


def settings(
    *,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    multicast: bool = True,
    keys: Path | str | None = None,
) -> FabricSettings:
    """Create network settings. ``keys`` is an identity's folder, by default ``SKYLOOP_KEYS``."""
    found = FabricSettings(listen=listen, connect=connect, multicast=multicast, lease_s=_lease_s())
    endpoints_of((*listen, *connect), found)  # reports invalid addresses before anything is opened
    folder = keys or os.environ.get(KEYS_VARIABLE) or None
    return found if folder is None else secure(found, folder)


def _lease_s() -> float:
    """Return the lease from the environment [s]. Raises :class:`UsageError`."""
    text = os.environ.get(LEASE_VARIABLE) or f"{LEASE_S:g}"
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"{LEASE_VARIABLE} is {text!r} and must be {LEASE_S:g} to {MAX_LEASE_S:g} seconds") from None


def secure(plain: FabricSettings, folder: Path | str) -> FabricSettings:
    """Return these settings with the identity from the given folder."""
    from skyloop.network.keys import load  # imported only if there are keys: needs cryptography

    found = secured(plain, load(folder))
    endpoints_of((*found.listen, *found.connect), found)  # fewer kinds of addresses are allowed with keys
    return found


class Part(StrEnum):
    """A session's role in the network."""

    PROXY = "proxy"  #: listens for applications, which connect to it
    APP = "app"  #: connects to proxies
    ROUTER = "router"  #: connects nodes that can't reach one another directly


#: Number of keep-alive packets per lease: enough for some to arrive on a path that loses three packets in ten.
KEEP_ALIVES: Final = 8
#: Number of messages queued for sending at each priority (Zenoh's maximum). Zenoh's default of 2 drops further messages
#: within a millisecond, and ten drones in one process can report the same event at the same moment.
_QUEUES: Final = dict.fromkeys(("real_time", "data_high", "data", "data_low"), 16)
#: Override what a neighbour requests, so that no slow reader blocks another, either here or through a router. Zenoh
#: sends replies with the settings of their query.
_NOBODY_WAITS: Final = {
    "id": "nobody waits",
    "messages": ["put", "delete", "query"],
    "flows": ["ingress", "egress"],
    "overwrite": {"congestion_control": "drop"},
}
#: Separates proxies from applications in Zenoh. A router forwards messages between regions, and assumes that the nodes
#: within a region reach one another without it (https://zenoh.io/docs/migration_1.9/regions/).
_REGIONS: Final = {Part.PROXY: "proxies", Part.APP: "apps"}


def make(settings: FabricSettings, part: Part, listen: Iterable[str] = ()) -> dict[str, Any]:
    """Return Zenoh's configuration by section; ``listen`` replaces the endpoints in the settings."""
    endpoints = list(listen) or endpoints_of(settings.listen, settings)
    connect = endpoints_of(settings.connect, settings)
    lease_ms = round(settings.lease_s * 1000)
    # Disconnect a neighbour that accepts none of Zenoh's own declarations for this long. Until then, it blocks one of
    # Zenoh's few receiving threads. All other messages are dropped when a link is congested.
    blocked_us = lease_ms * 1000
    kinds = _autoconnect(part, bool(connect))
    found_by_search = {"peer": kinds, "router": kinds}
    waits = settings.multicast or len(settings.connect) != 1 or part is not Part.APP
    usual = ["quic"] if settings.tls is not None else ["tcp", "udp"]  # with keys, nothing is accepted unencrypted
    found: dict[str, Any] = {
        "mode": "router" if part is Part.ROUTER else "peer",
        "listen": {"endpoints": endpoints},
        "connect": {"endpoints": connect, "timeout_ms": -1, "exit_on_failure": False, "retry": _RETRY},
        "scouting": {
            "delay": SETTLE_MS if waits else 0,
            "multicast": {"enabled": settings.multicast, "autoconnect": found_by_search},
            "gossip": {"enabled": True, "autoconnect": found_by_search},
        },
        "transport": {
            "unicast": {"max_links": 2, "open_timeout": OPEN_GIVEN_MS if connect else OPEN_MS},
            "link": {
                "protocols": sorted({*usual, *(each.partition("/")[0] for each in (*endpoints, *connect))}),
                "tx": {
                    "lease": lease_ms,
                    "keep_alive": KEEP_ALIVES,
                    "queue": {"size": _QUEUES, "congestion_control": {"block": {"wait_before_close": blocked_us}}},
                },
                "rx": {"max_message_size": MAX_MESSAGE_UP if part is Part.PROXY else MAX_MESSAGE},
            },
            "shared_memory": {"enabled": False},
        },
    }
    if part is not Part.APP:
        found["qos"] = {"network": [_NOBODY_WAITS]}
    if part is Part.ROUTER:
        found["gateway"] = {"south": [{"filters": [{"region_names": [name]}]} for name in _REGIONS.values()]}
    else:
        found["region_name"] = _REGIONS[part]
        # Don't act as a gateway for Zenoh "clients". Such nodes are not admitted, because all our nodes are peers. A
        # gateway would forward the declarations of every client, and thousands of them would block it for seconds.
        found["gateway"] = {"south": []}
    if settings.tls is not None:
        found["transport"]["link"]["tls"] = _tls(settings)
    if settings.access_control is not None:
        found["access_control"] = settings.access_control
    return found


def endpoints_of(addresses: Iterable[str], settings: FabricSettings) -> list[str]:
    """Convert addresses (``HOST:PORT``, ``HOST``, full endpoints) to Zenoh's: QUIC with keys, otherwise TCP and UDP."""
    found: list[str] = []
    for address in addresses:
        if "/" in address:
            if not address.startswith(_PROTOCOLS):
                raise UsageError(f"{address!r} is not a network address, such as 10.0.0.5:7447 or tcp/10.0.0.5:7447")
            if settings.tls is not None and not address.startswith(_ENCRYPTED):
                raise UsageError(f"with keys, nothing is sent unencrypted: {address!r} must begin with quic/ or tls/")
            found.append(address)
            continue
        place = _with_port(address)
        if settings.tls is not None:
            found.append(f"quic/{place}?mixed_rel=1")
        else:
            found += [f"tcp/{place}?rel=1", f"udp/{place}?rel=0"]
    return found


def to_json(sections: dict[str, Any]) -> str:
    """Return a configuration as JSON, in the form that Zenoh's own programs read."""
    return json.dumps(sections, indent=2)


def listening(settings: FabricSettings) -> list[str]:
    """Return the addresses to listen on, with free ports in place of port 0; by default one on all interfaces."""
    addresses = settings.listen or (f"{all_interfaces()}:0",)
    return [
        f"{address.removesuffix(':0')}:{free_port(address.rpartition(':')[0].strip('[]'))}"
        if address.endswith(":0") and "/" not in address
        else address
        for address in addresses
    ]


def free_port(host: str) -> int:
    """Return a port that is currently free for both TCP and UDP."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        for _ in range(50):
            with socket.socket(family, socket.SOCK_STREAM) as tcp, socket.socket(family, socket.SOCK_DGRAM) as udp:
                tcp.bind((host, 0))
                port = int(tcp.getsockname()[1])
                try:
                    udp.bind((host, port))
                except OSError:
                    continue
                return port
    except OSError as error:
        raise LinkError(f"cannot listen at {host}: {error.strerror or error}") from None
    raise LinkError(f"no port is free for TCP and UDP at {host}")


def _autoconnect(part: Part, has_addresses: bool) -> list[str]:
    """Return the kinds of nodes to connect to when they are discovered.

    Only applications connect to proxies, so a hundred proxies have no links to one another. A node that was given
    addresses connects to no other routers, because a discovered router is not retried as often as a given address.
    """
    if part is Part.APP:
        return ["router", "peer"]
    return [] if has_addresses or part is Part.ROUTER else ["router"]


def _tls(settings: FabricSettings) -> dict[str, Any]:
    assert settings.tls is not None
    certificate, key = str(settings.tls.certificate), str(settings.tls.key)
    return {
        "root_ca_certificate": str(settings.tls.ca),
        "listen_certificate": certificate,
        "listen_private_key": key,
        "connect_certificate": certificate,
        "connect_private_key": key,
        "enable_mtls": True,
        # A certificate proves an identity, independently of its address.
        "verify_name_on_connect": False,
        "close_link_on_expiration": True,
    }


def _with_port(address: str) -> str:
    """Return an address as HOST:PORT."""
    host, colon, port = address.rpartition(":")
    if address.startswith("[") and address.endswith("]"):
        return f"{address}:{DEFAULT_PORT}"
    if not colon:
        host, port = address, str(DEFAULT_PORT)
    bare = host.startswith("[") == host.endswith("]") and (":" not in host or host.startswith("["))
    if not host or not bare or not port.isdecimal() or int(port) > 65535:
        raise UsageError(f"{address!r} is not a network address, such as 10.0.0.5:7447, [fe80::1]:7447 or lab.local")
    return f"{host}:{port}"


def all_interfaces() -> str:
    """Return the address that stands for all interfaces of this host."""
    return "[::]" if socket.has_dualstack_ipv6() else "0.0.0.0"

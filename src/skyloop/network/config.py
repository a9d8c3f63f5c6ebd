"""Zenoh's configuration, made from the settings of this process; pure but for the search of a free port."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterable
from enum import StrEnum
from typing import Any, Final

from skyloop.errors import LinkError, UsageError
from skyloop.network.settings import FabricSettings

DEFAULT_PORT: Final = 7447  #: Zenoh's
#: An address that does not answer for so long is given up, and the next one of the same peer is tried.
OPEN_MS: Final = 800
#: The same where addresses were given: all of them are tried at once, and a mobile network may be behind one. After an
#: outage each answer waits there behind old video. Who gives up just before the last one comes has left a link at the
#: other end, and Zenoh takes the next for one more beside it, by which nothing is told again.
OPEN_GIVEN_MS: Final = 1500
#: How long opening a session waits for others to be found (Zenoh's default). An application that was given one address
#: waits for its proxy itself, and goes on as soon as that shows; with several it has to know all that have the name.
SETTLE_MS: Final = 500
MAX_MESSAGE: Final = 1 << 27  #: bytes of one frame that are taken from others
#: Bytes of one message that a proxy takes, as frames go the other way; more is dropped before it is put together.
MAX_MESSAGE_UP: Final = 1 << 18
_ENCRYPTED: Final = ("quic/", "tls/")
_PROTOCOLS: Final = (*_ENCRYPTED, "tcp/", "udp/", "ws/", "unixsock-stream/", "serial/", "unixpipe/", "vsock/")
_RETRY: Final = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}


class Part(StrEnum):
    """The part that a session plays in the network."""

    PROXY = "proxy"  #: listens, and is called by applications
    APP = "app"  #: calls proxies
    ROUTER = "router"  #: joins those that can't reach one another


#: Signs of life in the time of a lease: so many that on a path that loses three packets in ten some arrive.
KEEP_ALIVES: Final = 8
#: Messages that wait to be sent, by priority (Zenoh's most). Its default is 2, and what comes then is dropped within a
#: millisecond: ten drones of one process report the same event in the same moment.
_QUEUES: Final = dict.fromkeys(("real_time", "data_high", "data", "data_low"), 16)
#: Whatever a neighbour asks for: who does not read holds up nobody, neither here nor through a router. An answer is
#: sent as its question came.
_NOBODY_WAITS: Final = {
    "id": "nobody waits",
    "messages": ["put", "delete", "query"],
    "flows": ["ingress", "egress"],
    "overwrite": {"congestion_control": "drop"},
}
#: What keeps proxies apart from applications for Zenoh: a router passes on from one region to another, and takes those
#: of one region to reach one another without it (https://zenoh.io/docs/migration_1.9/regions/).
_REGIONS: Final = {Part.PROXY: "proxies", Part.APP: "apps"}


def make(settings: FabricSettings, part: Part, listen: Iterable[str] = ()) -> dict[str, Any]:
    """Return Zenoh's configuration, as its sections by name.

    Args:
        settings: How this process joins the network.
        part: What the session is.
        listen: Endpoints to listen at, in place of those of the settings.

    Raises:
        UsageError: An address is not valid.
    """
    endpoints = list(listen) or endpoints_of(settings.listen, settings)
    connect = endpoints_of(settings.connect, settings)
    lease_ms = round(settings.lease_s * 1000)
    # A neighbour that takes none of Zenoh's own declarations for as long is cut off; one of Zenoh's few receiving
    # threads waits for it meanwhile. All else is dropped when a link is congested.
    blocked_us = lease_ms * 1000
    found_by_search = {"peer": _called(part, bool(connect)), "router": _called(part, bool(connect))}
    waits = settings.multicast or len(settings.connect) != 1 or part is not Part.APP
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
                "protocols": _protocols([*endpoints, *connect], settings),
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
        # Not a gateway for Zenoh's "clients", which are not let in: all our nodes are peers. A gateway would pass on
        # each of the clients' declarations, and thousands of them would block it for seconds.
        found["gateway"] = {"south": []}
    if settings.tls is not None:
        found["transport"]["link"]["tls"] = _tls(settings)
    if settings.access_control is not None:
        found["access_control"] = settings.access_control
    return found


def endpoints_of(addresses: Iterable[str], settings: FabricSettings) -> list[str]:
    """Convert addresses to Zenoh's endpoints.

    Args:
        addresses: ``HOST:PORT``, ``HOST`` or whole endpoints.
        settings: With keys each address stands for QUIC, without for TCP and UDP.

    Raises:
        UsageError: An address is not valid, or with keys not encrypted.
    """
    found: list[str] = []
    for address in addresses:
        if "/" in address:
            if not address.startswith(_PROTOCOLS):
                raise UsageError(f"{address!r} is no network address: it looks like 10.0.0.5:7447 or tcp/10.0.0.5:7447")
            if settings.tls is not None and not address.startswith(_ENCRYPTED):
                raise UsageError(f"with keys nothing travels unencrypted: {address!r} must begin with quic/ or tls/")
            found.append(address)
            continue
        place = _with_port(address)
        if settings.tls is not None:
            found.append(f"quic/{place}?mixed_rel=1")
        else:
            found += [f"tcp/{place}?rel=1", f"udp/{place}?rel=0"]
    return found


def to_json(sections: dict[str, Any]) -> str:
    """Return a configuration as JSON, for the files of Zenoh's own programs."""
    return json.dumps(sections, indent=2)


def listening(settings: FabricSettings) -> list[str]:
    """Return the addresses to listen at, with a free port in place of port 0.

    Without addresses in the settings that is a free port on all interfaces.

    Raises:
        LinkError: No port is free.
    """
    addresses = settings.listen or (f"{all_interfaces()}:0",)
    return [
        f"{address.removesuffix(':0')}:{free_port(_host(address))}"
        if address.endswith(":0") and "/" not in address
        else address
        for address in addresses
    ]


def free_port(host: str) -> int:
    """Return a port that is free for both TCP and UDP now.

    Raises:
        LinkError: There is none, or this host does not have the address.
    """
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


def _called(part: Part, has_addresses: bool) -> list[str]:
    """Return which kinds of node a node connects to when it learns of them.

    Only applications connect to proxies, so that a hundred proxies have no links to one another. A node that was given
    addresses connects to no other router: one that was found is not retried as often as an address is.
    """
    if part is Part.APP:
        return ["router", "peer"]
    return [] if has_addresses or part is Part.ROUTER else ["router"]


def _protocols(endpoints: list[str], settings: FabricSettings) -> list[str]:
    """Return the only protocols that are accepted; with keys, none that is not encrypted."""
    usual = ["quic"] if settings.tls is not None else ["tcp", "udp"]
    return sorted({*usual, *(endpoint.partition("/")[0] for endpoint in endpoints)})


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
        # A certificate names an identity, which may be at any address.
        "verify_name_on_connect": False,
        "close_link_on_expiration": True,
    }


def _with_port(address: str) -> str:
    """Return an address as HOST:PORT.

    Raises:
        UsageError: It is not an address.
    """
    host, colon, port = address.rpartition(":")
    if address.startswith("[") and address.endswith("]"):
        return f"{address}:{DEFAULT_PORT}"
    if not colon:
        host, port = address, str(DEFAULT_PORT)
    bare = host.startswith("[") == host.endswith("]") and (":" not in host or host.startswith("["))
    if not host or not bare or not port.isdecimal() or int(port) > 65535:
        raise UsageError(f"{address!r} is no network address: it looks like 10.0.0.5:7447, [fe80::1]:7447 or lab.local")
    return f"{host}:{port}"


def _host(address: str) -> str:
    return address.rpartition(":")[0].strip("[]")


def all_interfaces() -> str:
    """Return the address that stands for all interfaces of this host."""
    return "[::]" if socket.has_dualstack_ipv6() else "0.0.0.0"

"""Run the cockpit: bind its address, find drones, and serve the page until it is stopped."""

from __future__ import annotations

import asyncio
import signal
import ssl
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skyloop.clock import Clock, monotonic_ns
from skyloop.cockpit.addresses import bind, host_names, own_addresses, reachable
from skyloop.cockpit.listening import Acceptor, Admission, Connection, ProtocolFactory, limit_messages, places_here
from skyloop.errors import LinkError, MissingExtraError, UnknownNameError, UsageError
from skyloop.messages import Role
from skyloop.metrics import client_readings
from skyloop.metrics.endpoint import Reading
from skyloop.platform import on_signals, sees_peers

if TYPE_CHECKING:
    import uvicorn
    from starlette.applications import Starlette

    from skyloop.cockpit.access import Gate, SessionFile
    from skyloop.cockpit.discovery import Finder
    from skyloop.cockpit.fleet import CockpitFleet
    from skyloop.cockpit.station import Station
    from skyloop.messages.parameter import WorldGeometry
    from skyloop.metrics.endpoint import Source
    from skyloop.network import FabricSettings


RECORDINGS = Path("recordings")  #: the default folder for recordings
_LARGEST_MESSAGE = 4096  # maximum size of a message from a page [bytes]
_POLL_S = 0.05  # interval between checks whether ``stop`` is set
_PING_S = 10.0  # interval between pings on a WebSocket; one that does not answer for as long is closed


@dataclass(frozen=True, slots=True)
class Access:
    """Who may connect, and from where. By default, only this user can connect, on this machine, as a pilot.

    ``host``: the address to listen on; any address other than loopback requires ``token_file``, ``client_ca`` or
    ``pair``. ``token_file``: lines of the form ``ROLE TOKEN [NAME]``. ``tls_cert``, ``tls_key``: PEM files of the
    server's certificate and key, for TLS. ``client_ca``: PEM file of the authority that signed the clients'
    certificates; a certificate's OU is the role. ``role``: the role of every user, unless tokens or certificates
    determine it. ``hostnames``: names that browsers use to reach this machine if they don't use its address. ``pair``:
    admit the first browser that opens the address in the QR code, with role ``role``; each code works once.
    Browsers are also paired if there are neither tokens nor certificates and this system does not tell whose program
    connects (:func:`skyloop.platform.sees_peers`). ``page_authority``: PEM file of the authority that signed
    ``tls_cert``, offered for browsers to trust. ``observer_token``: admits the program that started the cockpit.

    Raises:
        UsageError: The options are contradictory.
    """

    host: str = "127.0.0.1"
    token_file: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None
    client_ca: Path | None = None
    role: Role = Role.PILOT
    hostnames: tuple[str, ...] = ()
    pair: bool = False
    page_authority: Path | None = None
    observer_token: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if (self.tls_cert is None) != (self.tls_key is None):
            raise UsageError("TLS needs both a certificate and its key: --tls-cert FILE and --tls-key FILE")
        if self.page_authority is not None and self.tls_cert is None:
            raise UsageError(
                "an authority for the page needs the page's certificate: also give --tls-cert and --tls-key"
            )
        if self.client_ca is not None and self.tls_cert is None:
            raise UsageError("client certificates need TLS: also give --tls-cert and --tls-key")
        if self.client_ca is not None and self.token_file is not None:
            raise UsageError("roles come from either tokens or certificates, not both")
        if self.client_ca is not None and self.pair:
            raise UsageError("browsers are either paired or have certificates: leave out --pair or --client-ca")

    @property
    def scheme(self) -> str:
        """``https`` with TLS, otherwise ``http``."""
        return "http" if self.tls_cert is None else "https"


def serve_cockpit(
    names: Sequence[str] = (),
    *,
    port: int | None = None,
    access: Access | None = None,
    recordings: Path = RECORDINGS,
    on_ready: Callable[[str], None] | None = None,
    stop: threading.Event | None = None,
    network: FabricSettings | None = None,
    world: str | Path | None = None,
    metrics: str | None = None,
) -> None:
    """Serve the page until ``stop`` is set or a signal (Ctrl-C, SIGTERM) arrives.

    Args:
        names: The drones to show; if empty, show every drone discovered, including any that appear later.
        port: The TCP port; 0 selects a free port (default: :data:`skyloop.cockpit.addresses.DEFAULT_PORT`, or the next
        free one).
        access: Who may connect, and from where; by default only this user, on this machine, as a pilot.
        recordings: The folder for recordings, which is created when needed.
        on_ready: Called once on this thread with the page's address, which contains a code where browsers have to be
            paired. By default, the address is printed, with a QR code if other machines can reach the page and standard
            output is a terminal.
        stop: Stops the server when set from any thread.
        network: Also show drones reachable over this network.
        world: File or name of a shipped world, used as the surroundings of drones that report none.
        metrics: ``[HOST:]PORT`` of a Prometheus endpoint, whose address is printed; None for no endpoint.

    Raises:
        UsageError: An address, port or file is invalid.
        UnknownNameError: No proxy has one of the ``names``.
        MissingExtraError: The extra ``cockpit`` or, with ``metrics``, the extra ``metrics`` is not installed.
    """
    try:
        import cv2  # noqa: F401
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
        import websockets  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("the cockpit", "cockpit", cause=str(error)) from error
    from skyloop.cockpit.access import TokenGate
    from skyloop.cockpit.addresses import Announcer
    from skyloop.cockpit.security import bind_address, own_names

    access = access or Access()
    address, loopback = bind_address(access.host)
    if not loopback and access.token_file is None and access.client_ca is None and not access.pair:
        raise UsageError(
            f"{access.host} can be reached by others: give --pair, --token-file, or --tls-cert, --tls-key and "
            "--client-ca, so that not everyone can watch and fly; or listen on loopback (127.0.0.1) and forward the "
            "port over SSH"
        )
    tls = None if access.tls_cert is None else _tls(access)
    with ExitStack() as closing:
        listening = bind(address, port)
        closing.callback(listening.close)
        given = None if world is None else _geometry(world)
        gate = _gate(access, listening.getsockname()[1])
        finder = _finder(names, network)
        closing.callback(finder.close)
        _check_names(names, finder)
        pairing = gate.pairing if isinstance(gate, TokenGate) else None
        ready = on_ready or Announcer(pairing, loopback)
        code = f"#pair={pairing.code()}" if on_ready is not None and pairing is not None and not access.pair else ""

        from skyloop.cockpit.app import create_app
        from skyloop.cockpit.fleet import CockpitFleet
        from skyloop.cockpit.recordings import Recordings
        from skyloop.cockpit.target_tracker import warm_up

        address, port = listening.getsockname()[:2]
        own_name = () if bind_address(address)[1] else host_names()
        hosts = own_names(address, port, (*access.hostnames, *own_name), access.scheme)
        admission = Admission(places_here())
        fleet = CockpitFleet(finder, kept=names)
        authority = None if access.page_authority is None else access.page_authority.read_bytes()
        kept = Recordings(recordings)
        app = create_app(fleet, kept, hosts, gate, admission=admission, world=given, page_authority=authority)
        server = quiet_server(app)
        seen_at = reachable(address)[0]
        page = f"{access.scheme}://{f'[{seen_at}]' if ':' in seen_at else seen_at}:{port}/"
        acceptor = Acceptor(listening, admission, http_protocol(server, admission), tls)
        if metrics is not None:
            from skyloop.metrics import serve

            endpoint = closing.enter_context(serve(lambda: fleet_sources(fleet), metrics))
            print(endpoint.announcement, file=sys.stderr, flush=True)
        expire_codes = pairing.expire if pairing is not None else lambda: None
        threading.Thread(target=warm_up, name="skyloop-warm-up").start()
        asyncio.run(_run(server, acceptor, lambda: ready(page + code), stop, expire_codes))


def with_certificate(access: Access, directory: Path) -> Access:
    """Return the same access over https, with a certificate for this machine that is created or renewed if necessary.

    Args:
        access: The settings to complete.
        directory: Folder for the certificate and its authority (:mod:`skyloop.network.keys.lab`).

    Raises:
        UsageError: ``access`` already names a certificate, the address can't be certified, or a file is invalid.
        MissingExtraError: The extra ``network`` is not installed.
    """
    from skyloop.cockpit.security import bind_address
    from skyloop.network.keys.lab import page_certificate

    if access.tls_cert is not None:
        raise UsageError("--https makes a certificate and --tls-cert names one: give one of them")
    address, loopback = bind_address(access.host)
    own = (
        ["localhost", "127.0.0.1"] if loopback else [*reachable(address), *own_addresses(), *host_names(), "127.0.0.1"]
    )
    made = page_certificate(directory, own, access.hostnames)
    if made.left_out:
        print(
            f"cockpit: the certificate does not cover {', '.join(made.left_out)}, which is not private: for browsers "
            "that use it, give --tls-cert and --tls-key",
            file=sys.stderr,
        )
    return replace(access, tls_cert=made.certificate, tls_key=made.key, page_authority=made.authority)


def _finder(names: Sequence[str], network: FabricSettings | None) -> Finder:
    from skyloop.cockpit.discovery import LocalFinder, NetworkFinder

    near = LocalFinder(names)
    return near if network is None else NetworkFinder(near, network, frozenset(names))


def _geometry(world: str | Path) -> WorldGeometry:
    from skyloop.sim.world import geometry_of
    from skyloop.sim.world_file import load_world

    return geometry_of(load_world(world))


def _check_names(names: Sequence[str], finder: Finder) -> None:
    from skyloop.transport.local import list_names

    known = {found.name for found in finder()} if names else set()
    for name in names:
        if name not in known:
            raise UnknownNameError("proxy", name, known | {proxy.name for proxy in list_names()})


def _gate(access: Access, port: int) -> Gate:
    from skyloop.cockpit.access import CertificateGate, OpenGate, Pairing, Person, Token, TokenGate, read_tokens

    if access.client_ca is not None:
        return CertificateGate()
    pairs = access.pair or (access.token_file is None and not sees_peers())
    if access.token_file is None and not pairs:
        return OpenGate(access.role)
    tokens = [] if access.token_file is None else read_tokens(access.token_file)
    if access.observer_token is not None:
        tokens.append(Token(Person(Role.OBSERVER), access.observer_token.encode()))
    cookie = f"skyloop-cockpit-{port}"  # browsers share cookies between all ports of a host
    return TokenGate(tokens, cookie, pairing=Pairing(access.role) if pairs else None, kept=_session_file(cookie))


def _session_file(cookie: str) -> SessionFile | None:
    """Return the file that keeps sessions between runs; None except on Linux."""
    if sys.platform != "linux":
        return None
    from skyloop.cockpit.access import SessionFile
    from skyloop.transport.local.directory import find_directory

    folder = find_directory()
    with suppress(LinkError, OSError):  # without this file, sessions end with the process, and a warning is logged
        folder.create()
    return SessionFile(folder.path / f"{cookie}.sessions")


def _tls(access: Access) -> ssl.SSLContext:
    """Create the server's TLS context. Raise ``UsageError`` if a file is invalid."""
    assert access.tls_cert is not None
    for file in filter(None, (access.tls_cert, access.tls_key)):
        if not file.exists():
            raise UsageError(f"{file} does not exist: make certificate and key with openssl, as docs/cockpit.md shows")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(access.tls_cert, access.tls_key)
    except (OSError, ssl.SSLError) as error:
        raise UsageError(f"{access.tls_cert} and {access.tls_key} can't be used for TLS: {error}") from None
    if access.client_ca is not None:
        try:
            context.load_verify_locations(access.client_ca)
        except (OSError, ssl.SSLError) as error:
            raise UsageError(f"{access.client_ca} can't be used to check certificates: {error}") from None
        context.verify_mode = ssl.CERT_REQUIRED
    return context


def http_protocol(server: uvicorn.Server, admission: Admission, clock: Clock = monotonic_ns) -> ProtocolFactory:
    """Return a factory for the HTTP protocol of connections to a server that has started."""
    from uvicorn.protocols.http.h11_impl import H11Protocol

    from skyloop.cockpit.access import CERTIFICATE
    from skyloop.cockpit.security import ADMIT

    class Protocol(H11Protocol):
        """uvicorn's protocol, which also passes on the client's certificate and reports progress to the admission."""

        def __init__(self, connection: Connection) -> None:
            super().__init__(server.config, server.server_state, server.lifespan.state)
            self._connection = connection

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self.client = self.client or (self._connection.address, 0)  # the client may have disconnected already
            self._connection.end = transport.abort
            tls = transport.get_extra_info("ssl_object")
            self.app_state = {
                **self.app_state,
                CERTIFICATE: None if tls is None else tls.getpeercert(),
                ADMIT: lambda person: admission.requested(self._connection, person, clock()),
            }

        def on_response_complete(self) -> None:
            admission.answered(self._connection, clock())
            super().on_response_complete()

    return Protocol


def quiet_server(app: Starlette) -> uvicorn.Server:
    """Create a server for the cockpit that neither opens a listening socket nor handles signals.

    uvicorn would raise the signals again when it ends, which would cut the cockpit's own shutdown short.
    """
    import uvicorn

    class QuietServer(uvicorn.Server):
        @contextmanager
        def capture_signals(self) -> Iterator[None]:
            yield

    limit_messages()
    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,  # take the client's address from the kernel, not from a header
        ws_max_size=_LARGEST_MESSAGE,
        ws_ping_interval=_PING_S,
        ws_ping_timeout=_PING_S,
        ws_per_message_deflate=False,  # pictures are already compressed
        lifespan="on",
        # Data that is still buffered for a stalled page must not delay shutdown.
        timeout_graceful_shutdown=2,
    )
    return QuietServer(config)


async def _run(
    server: uvicorn.Server,
    acceptor: Acceptor,
    on_ready: Callable[[], None],
    stop: threading.Event | None,
    expire_codes: Callable[[], None],
) -> None:
    ending = asyncio.Event()
    if threading.current_thread() is threading.main_thread():
        on_signals((signal.SIGINT, signal.SIGTERM), ending.set)
    serving = asyncio.create_task(server.serve(sockets=[]))
    while not server.started and not serving.done():
        await asyncio.sleep(_POLL_S / 10)
    listening = asyncio.create_task(acceptor.run())
    await asyncio.sleep(0)  # the first step of the event loop starts listening
    if not serving.done():
        on_ready()
    while not serving.done():
        await asyncio.wait([serving], timeout=_POLL_S)
        expire_codes()
        if ending.is_set() or listening.done() or (stop is not None and stop.is_set()):
            listening.cancel()
            server.should_exit = True
    await asyncio.gather(listening, return_exceptions=True)
    await serving
    if not listening.cancelled():
        await listening  # raises the error that ended the acceptor


def fleet_sources(fleet: CockpitFleet) -> list[Source]:
    """Return the current sources of metrics: one per drone, and one for the fleet."""
    stations = fleet.stations.copy()
    return [partial(_fleet_readings, fleet), *(partial(_readings, name, one) for name, one in stations.items())]


def _fleet_readings(fleet: CockpitFleet) -> Iterator[Reading]:
    yield Reading("skyloop_cockpit_unreachable", float(len(fleet.problems)))


def _readings(name: str, station: Station) -> Iterator[Reading]:
    yield Reading("skyloop_cockpit_pilots", float(len(station.pilots)), (name,))
    yield from client_readings(name, station.drone)

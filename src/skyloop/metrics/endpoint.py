"""All metrics, as listed in ``docs/operations.md``, and the HTTP endpoint for Prometheus.

The endpoint has its own threads, so a slow or stalled reader does not delay anything else.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple
from urllib.parse import urlsplit

from skyloop.address import is_loopback
from skyloop.errors import MissingExtraError, UsageError
from skyloop.platform import allow_restart

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry
    from prometheus_client.metrics_core import Metric

Kind = Literal["gauge", "counter", "info"]


@dataclass(frozen=True, slots=True)
class Family:
    """One metric with all its labels. Names follow OpenMetrics: base units, and ``_total`` for counters."""

    name: str
    kind: Kind
    labels: tuple[str, ...]
    meaning: str


class Reading(NamedTuple):
    """The current value of a metric."""

    name: str
    value: float
    labels: tuple[str, ...] = ()  #: label values, in the order of the family's labels


_VEHICLE: Final = ("vehicle",)
_CHANNEL: Final = ("vehicle", "channel")

FAMILIES: Final[dict[str, Family]] = {
    family.name: family
    for family in (
        # Metrics of each proxy. The label ``vehicle`` is the proxy's name.
        Family("skyloop_vehicle_info", "info", ("vehicle", "family"), "the vehicle's family"),
        Family("skyloop_vehicle_state", "gauge", ("vehicle", "state"), "1 for the current flight state, else 0"),
        Family(
            "skyloop_vehicle_link_state",
            "gauge",
            ("vehicle", "state"),
            "1 for the current state of the link between proxy and vehicle, else 0",
        ),
        Family("skyloop_vehicle_battery_ratio", "gauge", _VEHICLE, "charge left, 0 to 1; absent while unknown"),
        Family("skyloop_vehicle_battery_volts", "gauge", _VEHICLE, "voltage of the battery; absent while unknown"),
        Family("skyloop_failsafe", "gauge", ("vehicle", "step"), "1 for the failsafe's current step, else 0"),
        Family("skyloop_feedback_age_seconds", "gauge", _VEHICLE, "age of the vehicle's newest state"),
        Family("skyloop_feedback_published_total", "counter", _VEHICLE, "samples of feedback published"),
        Family("skyloop_feedback_selected_total", "counter", _VEHICLE, "samples published at reduced rates"),
        Family("skyloop_feedback_missed_total", "counter", _VEHICLE, "samples that a subscriber had no room for"),
        Family("skyloop_commands_received_total", "counter", _VEHICLE, "commands received"),
        Family("skyloop_commands_applied_total", "counter", _VEHICLE, "commands handed to the vehicle"),
        Family("skyloop_commands_clamped_total", "counter", _VEHICLE, "commands lowered to a limit"),
        Family("skyloop_commands_superseded_total", "counter", _VEHICLE, "waiting commands replaced by newer ones"),
        Family("skyloop_commands_refused_total", "counter", ("vehicle", "reason"), "commands refused, by reason"),
        Family(
            "skyloop_command_delay_seconds",
            "gauge",
            ("vehicle", "statistic"),
            "from sending to applying, of the last 2000 commands: median, p99, max",
        ),
        Family(
            "skyloop_command_age_seconds",
            "gauge",
            _VEHICLE,
            "since the pilot's newest valid command; absent while no application has the authority",
        ),
        Family("skyloop_authority_held", "gauge", _VEHICLE, "1 while an application has the authority, else 0"),
        Family("skyloop_authority_priority", "gauge", _VEHICLE, "its priority, 0 the highest; absent without one"),
        Family("skyloop_authority_waiting", "gauge", _VEHICLE, "applications waiting for the authority"),
        Family("skyloop_authority_leases_total", "counter", _VEHICLE, "how often the authority was granted"),
        Family("skyloop_applications", "gauge", _VEHICLE, "applications connected"),
        Family("skyloop_requests_total", "counter", _VEHICLE, "requests received"),
        Family("skyloop_requests_refused_total", "counter", _VEHICLE, "requests refused"),
        Family("skyloop_packets_malformed_total", "counter", _VEHICLE, "packets that could not be decoded"),
        Family("skyloop_packets_refused_total", "counter", _VEHICLE, "packets that the sender's keys do not allow"),
        Family("skyloop_events_total", "counter", ("vehicle", "kind"), "events published, by kind"),
        Family("skyloop_events_missed_total", "counter", _VEHICLE, "events that a subscriber had no room for"),
        Family("skyloop_driver_errors_total", "counter", _VEHICLE, "failed calls of the driver"),
        Family("skyloop_frames_received_total", "counter", ("vehicle", "camera"), "frames received from the vehicle"),
        Family("skyloop_frames_published_total", "counter", ("vehicle", "camera"), "frames published"),
        Family("skyloop_frames_missed_total", "counter", ("vehicle", "camera"), "frames missed by a subscriber"),
        Family("skyloop_network_dropped_total", "counter", _VEHICLE, "dropped packets to single applications"),
        Family("skyloop_network_refused_total", "counter", _VEHICLE, "packets on a key that does not allow them"),
        Family("skyloop_network_strays_total", "counter", _VEHICLE, "packets and queries from unconnected senders"),
        Family("skyloop_network_turned_away_total", "counter", _VEHICLE, "connections refused for lack of room"),
        # Metrics of the cockpit, which is a client of each proxy.
        Family(
            "skyloop_client_link_state",
            "gauge",
            ("vehicle", "state"),
            "1 for the current state of the link to the proxy, else 0",
        ),
        Family("skyloop_client_received_total", "counter", _CHANNEL, "samples received"),
        Family("skyloop_client_lost_total", "counter", _CHANNEL, "samples missing, from gaps in their numbers"),
        Family("skyloop_client_dropped_total", "counter", _CHANNEL, "samples overtaken by newer ones here"),
        Family("skyloop_client_malformed_total", "counter", _CHANNEL, "samples that could not be decoded"),
        Family(
            "skyloop_client_delay_seconds",
            "gauge",
            ("vehicle", "channel", "statistic"),
            "from publishing to receiving, of the last 1024 samples: median, p99, max",
        ),
        Family("skyloop_client_age_seconds", "gauge", _CHANNEL, "age of the newest sample"),
        Family("skyloop_cockpit_unreachable", "gauge", (), "discovered proxies that can't be connected to"),
        Family("skyloop_cockpit_pilots", "gauge", _VEHICLE, "pages that have or await the authority, or may stop"),
        # Metrics of one router.
        Family("skyloop_router_links", "gauge", ("kind",), "links to others: router, peer (a proxy), client"),
        Family("skyloop_router_shut_out", "gauge", (), "linked nodes whose keys were revoked or changed"),
        # Metrics of each endpoint.
        Family("skyloop_scrape_errors_total", "counter", (), "readings that failed and are missing, see the log"),
    )
}


LOOPBACK: Final = "127.0.0.1"
PATH: Final = "/metrics"
MAX_SCRAPES: Final = 8  #: maximum number of scrapes; one more closes the connection waiting longest for its request
ANSWER_S: Final = 1.0  #: before this time, a scrape is not closed to make room for a new connection
DEADLINE_S: Final = 10.0  #: maximum duration of a connection, from its first byte to its last
_POLL_S: Final = 0.1  # interval at which the server thread checks whether to stop
_log = logging.getLogger(__name__)

#: Reads the current metrics of one source.
Source = Callable[[], Iterable[Reading]]


def serve(sources: Callable[[], Iterable[Source]], where: str, *, deadline_s: float = DEADLINE_S) -> Endpoint:
    """Serve metrics over HTTP until the endpoint is closed.

    ``sources`` is called on the endpoint's threads for each scrape, and so is each source. ``where``: ``[HOST:]PORT``.
    The host defaults to 127.0.0.1, and port 0 picks a free port. ``deadline_s``: maximum duration of a connection [s].
    At most :data:`MAX_SCRAPES` connections are open at a time.
    """
    return Endpoint(sources, parse_where(where), deadline_s)


def parse_where(where: str) -> tuple[str, int]:
    """Return host and port from ``[HOST:]PORT``; IPv6 addresses are in brackets."""
    host, colon, port = where.rpartition(":")
    if not (port.isascii() and port.isdigit() and int(port) <= 65535) or (colon and not host):
        raise UsageError(f"{where!r:.80} is not an address for metrics: give a port, 0 to 65535, or HOST:PORT")
    return (host.removeprefix("[").removesuffix("]") if colon else LOOPBACK), int(port)


class Endpoint(AbstractContextManager["Endpoint"]):
    """Serves metrics over HTTP. Created by :func:`serve`. The context manager closes it."""

    def __init__(self, sources: Callable[[], Iterable[Source]], where: tuple[str, int], deadline_s: float) -> None:
        """Start listening and answering; see :func:`serve`."""
        self._server = _Server(where, _registry(sources), deadline_s)
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(_POLL_S,), name="skyloop-metrics", daemon=True
        )
        self._thread.start()

    @property
    def port(self) -> int:
        return int(self._server.server_address[1])

    @property
    def url(self) -> str:
        """The URL of the metrics, for Prometheus."""
        host = str(self._server.server_address[0])
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}{PATH}"

    @property
    def announcement(self) -> str:
        """A line that tells users where the metrics are and who can read them."""
        open_to = "" if self._server.own else " (WARNING: anyone who reaches this address can read them)"
        return f"metrics: {self.url}{open_to}"

    def close(self) -> None:
        """Stop answering. Idempotent."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def __exit__(self, *_: object) -> None:
        self.close()


class MetricsCollector:
    """Reads all sources on request, in the form that ``prometheus_client`` expects.

    If a source fails, it is skipped, counted and logged. The other sources are still served.
    """

    def __init__(self, sources: Callable[[], Iterable[Source]]) -> None:
        self._sources = sources
        self._errors = 0
        self._lock = threading.Lock()

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics that currently have a value."""
        from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily

        made: dict[str, Any] = {}
        for reading in self._read():
            metric = made.get(reading.name)
            if metric is None:
                family = FAMILIES[reading.name]
                kinds = {"gauge": GaugeMetricFamily, "counter": CounterMetricFamily, "info": InfoMetricFamily}
                name = family.name.removesuffix("_info") if family.kind == "info" else family.name
                labels = family.labels[:1] if family.kind == "info" else family.labels
                metric = made[reading.name] = kinds[family.kind](name, family.meaning, labels=labels)
            if FAMILIES[reading.name].kind == "info":
                names = FAMILIES[reading.name].labels
                metric.add_metric(reading.labels[:1], dict(zip(names[1:], reading.labels[1:], strict=True)))
            else:
                metric.add_metric(reading.labels, reading.value)
        yield from made.values()

    def _read(self) -> Iterator[Reading]:
        for source in self._sources():
            try:
                yield from list(source())
            except Exception:  # noqa: BLE001 (the others are still listed)
                with self._lock:
                    self._errors += 1
                _log.exception("metrics can't be read")
            time.sleep(0)  # lets a thread that has a command go first
        yield Reading("skyloop_scrape_errors_total", float(self._errors))


def _registry(sources: Callable[[], Iterable[Source]]) -> CollectorRegistry:
    try:
        from prometheus_client import CollectorRegistry, PlatformCollector, ProcessCollector
    except ImportError as error:
        raise MissingExtraError("metrics", "metrics", cause=str(error)) from None
    registry = CollectorRegistry()
    registry.register(MetricsCollector(sources))
    ProcessCollector(registry=registry)
    PlatformCollector(registry=registry)
    return registry


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, where: tuple[str, int], registry: CollectorRegistry, deadline_s: float) -> None:
        host, port = where
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            self.address_family = family
            super().__init__(address[:2], _Handler)  # type: ignore[arg-type]
        except OSError as error:
            raise UsageError(
                f"metrics can't be served at {host}, port {port}: {error.strerror or error}; choose another port, or 0"
            ) from None
        self.registry = registry
        self.own = is_loopback(str(self.server_address[0]))
        self._deadline_s = deadline_s
        self._lock = threading.Lock()
        self._open: dict[Any, float] = {}  # connections, each protected until a given time; oldest first

    def server_bind(self) -> None:
        # The method of HTTPServer would look up this machine's name on the network.
        allow_restart(self.socket)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            now_s = time.monotonic()
            if len(self._open) >= MAX_SCRAPES:
                idle = next((one for one, until_s in self._open.items() if until_s <= now_s), None)
                if idle is not None:  # the connection's thread ends with its next read or write
                    del self._open[idle]
                    _hang_up(idle)
            admitted = len(self._open) < MAX_SCRAPES
            if admitted:
                self._open[request] = 0.0
        if admitted:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def asked(self, request: Any) -> None:
        """Record that a connection has sent a complete request."""
        with self._lock:
            if request in self._open:
                self._open[request] = time.monotonic() + ANSWER_S

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        # Limit the connection's total time: a time limit per read would let a client that trickles bytes hold it open.
        guard = threading.Timer(self._deadline_s, _hang_up, (request,))
        guard.daemon = True
        guard.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            guard.cancel()
            with self._lock:
                self._open.pop(request, None)

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002 (the base class's signature)
        _log.debug("a scrape by %s ended early", client_address, exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    server_version = "skyloop"
    sys_version = ""

    def do_GET(self) -> None:
        self.server.asked(self.connection)
        if self.server.own and not _names_loopback(self.headers.get("Host", "")):
            # DNS rebinding: a script from another site, whose name resolves to this host, could read the answer.
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", b"use this machine's address\n")
        elif self.path.partition("?")[0] != PATH:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", f"the metrics are at {PATH}\n".encode())
        else:
            from prometheus_client.exposition import choose_encoder

            encode, content_type = choose_encoder(self.headers.get("Accept", ""))
            self._answer(HTTPStatus.OK, content_type, encode(self.server.registry))

    def _answer(self, status: HTTPStatus, content_type: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002 (the base class's signature)
        _log.debug(format, *arguments)


def _names_loopback(host: str) -> bool:
    """Return whether a Host header names this machine's loopback address, with any port."""
    try:
        return is_loopback(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return False


def _hang_up(request: socket.socket) -> None:
    with suppress(OSError):  # the other end has already left
        request.shutdown(socket.SHUT_RDWR)

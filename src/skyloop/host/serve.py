"""The host process that ``skyloop host fleet.toml`` runs, and its control socket: ``add``, ``remove`` and ``status``.

Each connection carries one request and one answer in JSON, split into packets. The socket ``NAME.host`` is next to the
proxies' sockets. The same users can access it: the host's own user, the superuser, and members of the host's group.
"""

from __future__ import annotations

import gc
import logging
import os
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from typing import Final

import msgspec

from skyloop.clock import SWITCH_INTERVAL_S, monotonic_ns
from skyloop.errors import (
    FileFormatError,
    LinkError,
    NameTakenError,
    NoAnswerError,
    RefusedError,
    SkyloopError,
    UnknownNameError,
    UsageError,
)
from skyloop.host.fleet import Defaults, Fleet, Vehicle, VehicleSettings, decoder_of_handed, encode_handed, settings_of
from skyloop.host.host import Host, check_known
from skyloop.host.vehicle import HostedVehicle, VehicleStatus, network_of, reason_of
from skyloop.messages import LinkState
from skyloop.metrics import serve_proxies
from skyloop.platform import wait_precisely
from skyloop.proxy.serve import LAND_WITHIN_S, LinkLines, Shutdown, announce, on_signals
from skyloop.toml_file import Place
from skyloop.transport.local.directory import find_directory
from skyloop.transport.local.system import HOST, Listener, PacketSocket, StrangerError

_POLL_S: Final = 0.2  # interval between checks for signals and updates
MAX_REQUEST: Final = 1 << 22  #: maximum size in bytes, sent in packets of ``_CHUNK``
MAX_PACKET: Final = 1 << 16  #: maximum size in bytes
MAX_ANSWER: Final = 1 << 22  #: maximum size in bytes
ANSWERS_WITHIN_S: Final = 60.0  #: time for an answer, including the landing before a removal
_CHUNK: Final = 1 << 15  # size of a packet in bytes
_AGAIN_S: Final = 0.1  # pause after accepting a connection has failed
_SLOW_S: Final = 2.0  # time for the other end to receive or send a packet
_log = logging.getLogger(__name__)


def serve(
    fleet: Fleet, *, group: str | None = None, land_within_s: float = LAND_WITHIN_S, metrics: str | None = None
) -> None:
    """Serve all vehicles of a fleet that start automatically. Blocks. Must run on the main thread.

    Like ``skyloop proxy``, this prints a line for each vehicle: ``failed NAME: …`` if it can't be served, and ``hosting
    …`` after all have been tried. SIGINT, SIGTERM or SIGHUP ends it. The host first lands all flying vehicles, for up
    to ``land_within_s`` [s]. A second signal ends this wait. Members of ``group`` may also add and remove vehicles.
    ``metrics``: ``[HOST:]PORT`` of an endpoint for Prometheus. The address is printed.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    wait_precisely()
    shutdown = Shutdown()
    with ExitStack() as stack:
        stack.enter_context(on_signals(shutdown, ignore_interrupt=False))
        host = Host(announce)
        stack.callback(lambda: host.close(shutdown.reason or "its host failed"))
        if metrics is not None:
            announce(stack.enter_context(serve_proxies(host.proxies, metrics)).announcement)
        control = ControlServer(fleet.name, partial(respond, host, fleet.defaults), group=group)
        control.start()
        stack.callback(control.stop)
        host.known.update((vehicle.name, vehicle) for vehicle in fleet.vehicles)
        problems = host.add_all([vehicle for vehicle in fleet.vehicles if vehicle.autostart])
        lines = _Lines()
        lines.update(list(host.vehicles.values()))
        served = sum(vehicle.runs for vehicle in host.vehicles.values())
        failed = f", {len(problems)} failed" if problems else ""
        announce(f"hosting {served} of {len(fleet.vehicles)} vehicles as {fleet.name}, process {os.getpid()}{failed}")
        polls = _key_changes(fleet)
        gc.collect()
        gc.freeze()  # skip long-lived objects: collecting them takes 20 ms
        # Poll, because the kernel may deliver a signal to another thread, which does not wake this one.
        while not shutdown.requested.wait(_POLL_S):
            lines.update(list(host.vehicles.values()))
            for poll in polls:
                for change in poll():
                    announce(change)
                    host.publish_keys(change)
        host.close(shutdown.reason, land_within_s, shutdown.hurry.is_set)


def respond(host: Host, defaults: Defaults, request: Request) -> HostAnswer:
    """Carry out a request, on that request's own thread. ``defaults`` are for vehicles specified only by address."""
    if isinstance(request, Remove):
        return HostAnswer((host.remove(request.name, land=request.land),))
    if isinstance(request, AddNamed):
        return HostAnswer((_add_named(host, defaults, request).status(),))
    if isinstance(request, Add):
        present = {name for name, vehicle in host.vehicles.items() if vehicle.runs}
        new = [vehicle for vehicle in request.vehicles if vehicle.name not in present]
        problems = host.add_all(new)
        known = {vehicle.name for vehicle in request.vehicles}
        return HostAnswer(tuple(row for row in host.status() if row.name in known), problems)
    return HostAnswer(tuple(host.status()))


def _add_named(host: Host, defaults: Defaults, request: AddNamed) -> HostedVehicle:
    if request.address is None:
        return host.add(check_known(host, request.name))
    process = {True: "own", False: "shared", None: None}[request.own_process]
    vehicle = Vehicle(name=request.name, address=request.address, process=process)  # type: ignore[arg-type]
    return host.add(settings_of(vehicle, defaults, Place("skyloop host add"), vehicle))


class _Lines:
    """Prints whether a vehicle is ready, or why it is not, whenever this changes."""

    def __init__(self) -> None:
        self._lines: dict[HostedVehicle, LinkLines] = {}

    def update(self, vehicles: Sequence[HostedVehicle]) -> None:
        for vehicle in vehicles:
            status = vehicle.status()
            if not status.link:
                continue
            state, lines = LinkState(status.link), self._lines.get(vehicle)
            if lines is None:
                lines = self._lines[vehicle] = LinkLines(status.name, _where(vehicle, status), monotonic_ns())
                announce(lines.first(state))
            elif line := lines.changed(state, status.link_reason, status.link_remedy, monotonic_ns()):
                announce(line)
        for gone in [vehicle for vehicle in self._lines if vehicle not in vehicles]:
            del self._lines[gone]


def _where(vehicle: HostedVehicle, status: VehicleStatus) -> str:
    if (proxy := vehicle.proxy) is not None:
        return f"{status.address} at {proxy.server.address}"
    return f"{status.address} at local:{status.name}, process {status.pid}"


def _key_changes(fleet: Fleet) -> list[Callable[[], list[str]]]:
    """Return one source of updates about the keys for each of the fleet's key folders."""
    polls: dict[str | None, Callable[[], list[str]]] = {}
    for vehicle in fleet.vehicles:
        with suppress(UsageError, ImportError):  # a vehicle whose key folder can't be used is not served
            settings = network_of(vehicle)
            if settings is not None and settings.ring is not None:
                polls[vehicle.keys] = settings.ring.poll
    return list(polls.values())


class StatusRequest(msgspec.Struct, frozen=True, tag="status"):
    """Request the status of all vehicles."""


class Add(msgspec.Struct, frozen=True, tag="add"):
    """Request to serve more vehicles. Vehicles that are already running are left unchanged."""

    vehicles: tuple[VehicleSettings, ...]


class AddNamed(msgspec.Struct, frozen=True, tag="add_named"):
    """Request to serve one more vehicle: either a vehicle in the host's file, by name, or any other, by address."""

    name: str
    address: str | None = None
    own_process: bool | None = None


class Remove(msgspec.Struct, frozen=True, tag="remove"):
    """Request to land a vehicle and stop serving it."""

    name: str
    land: bool = False


Request = StatusRequest | Add | AddNamed | Remove


class HostAnswer(msgspec.Struct, frozen=True):
    """The answer from a host."""

    vehicles: tuple[VehicleStatus, ...] = ()  #: all vehicles, or those in the request
    problems: dict[str, str] = {}  #: why vehicles could not be added, by name
    error: str = ""  #: the reason why nothing was done
    kind: str = ""  #: class name of the error
    code: str = ""


_requests: Final[msgspec.json.Decoder[Request]] = decoder_of_handed(Request)
_answers: Final = msgspec.json.Decoder(HostAnswer)
#: Carries out a request on the request's own thread. Raises :class:`skyloop.errors.SkyloopError`.
Responder = Callable[[Request], HostAnswer]
_ERRORS: Final[dict[str, type[SkyloopError]]] = {
    error.__name__: error for error in (UsageError, FileFormatError, NameTakenError, LinkError)
}


class ControlServer:
    """Between :meth:`start` and :meth:`stop`, accepts requests from this user and from the members of a group."""

    def __init__(self, name: str, answering: Responder, *, group: str | None = None) -> None:
        self._name = name
        self._answering = answering
        self._directory = find_directory(group, HOST)
        self._directory.socket_path(name)
        self._listener: Listener | None = None
        self._inode = 0
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()

    def start(self) -> None:
        self._listener, self._inode = self._directory.listen(self._name)
        self._thread = threading.Thread(
            target=self._run, args=(self._listener,), name="skyloop-host-control", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Stop listening. Pending requests continue. Idempotent."""
        listener, self._listener = self._listener, None
        if listener is None or self._thread is None:
            return
        self._ended.set()
        listener.hang_up()
        self._thread.join()
        self._directory.remove(self._name, self._inode, listener)

    def _run(self, listener: Listener) -> None:
        while self._listener is not None:
            try:
                sock, _ = listener.accept()
            except StrangerError as error:
                _log.warning("%s", error)
                continue
            except OSError:  # closing, the caller is gone, or no descriptors are left: pause before trying again
                self._ended.wait(_AGAIN_S)
                continue
            try:
                threading.Thread(target=self._serve, args=(sock,), name="skyloop-host-request", daemon=True).start()
            except RuntimeError as error:  # no thread is currently available
                _log.warning("a request was not answered: %s", error)
                sock.hang_up()

    def _serve(self, sock: PacketSocket) -> None:
        sock.limit_wait(_SLOW_S)
        try:
            if (answer := self._answer(sock)) is not None:
                _send(sock, msgspec.json.encode(answer))
        except OSError as error:
            _log.info("an answer was not received: %s", error)
        sock.hang_up()

    def _answer(self, sock: PacketSocket) -> HostAnswer | None:
        """Return the answer to a request; None if a client only checked whether a host exists."""
        if not self._directory.serving.may_connect(sock, self._directory.gid):
            return HostAnswer(error=f"{sock.who} may not use the host {self._name!r}", kind="RefusedError")
        received = bytearray()
        while len(received) <= MAX_REQUEST and (packet := sock.recv(MAX_PACKET)):
            received += packet
            if len(packet) != _CHUNK:  # that was the last packet
                break
            with suppress(msgspec.DecodeError, RecursionError):
                _requests.decode(received)
                break  # the request exactly filled the last packet
        if not received:
            return None
        if len(received) > MAX_REQUEST:
            text = f"the request is longer than {MAX_REQUEST} bytes: add fewer vehicles at once"
            return HostAnswer(error=text, kind="RefusedError", code="malformed")
        try:
            request = _requests.decode(received)
        except (msgspec.DecodeError, RecursionError) as error:
            return HostAnswer(error=f"malformed request: {error}", kind="RefusedError", code="malformed")
        try:
            return self._answering(request)
        except SkyloopError as error:
            code = error.code if isinstance(error, RefusedError) else ""
            return HostAnswer(error=reason_of(error), kind=type(error).__name__, code=code)
        except Exception as error:  # noqa: BLE001  the host continues, and the caller gets an answer
            _log.exception("a request failed")
            return HostAnswer(error=f"the host failed: {error!r}", kind="RefusedError", code="failed")


def _send(sock: PacketSocket, text: bytes) -> None:
    """Send a request or an answer, split into as many packets as needed."""
    for first in range(0, len(text), _CHUNK):
        sock.send_within(text[first : first + _CHUNK], _SLOW_S)


def running_hosts(group: str | None = None) -> list[str]:
    """Return the names of the hosts running on this machine that this user may reach."""
    return [host.name for host in find_directory(group, HOST).proxies()]


def chosen_host(name: str | None = None, group: str | None = None) -> str:
    """Return the host with this name, or the only host that is running."""
    running = running_hosts(group)
    if name is not None:
        if name not in running:
            raise UnknownNameError("host", name, running)
        return name
    if not running:
        raise UsageError("no host is running on this machine: start one with skyloop host fleet.toml")
    if len(running) > 1:
        raise UsageError(f"several hosts are running on this machine: choose one with --host {' or '.join(running)}")
    return running[0]


def ask(name: str, request: Request, *, group: str | None = None) -> HostAnswer:
    """Send a request to a host. Return or raise its answer, or raise :class:`LinkError` or :class:`NoAnswerError`."""
    directory = find_directory(group, HOST)
    try:
        sock = directory.connect(name)
    except OSError as error:
        raise LinkError(f"the host {name!r} can't be reached: {error.strerror}") from None
    sock.limit_wait(ANSWERS_WITHIN_S)
    received = bytearray()
    try:
        with suppress(BrokenPipeError):  # a caller that is refused gets its answer before it has sent its whole request
            _send(sock, encode_handed(request))
        while (packet := sock.recv(_CHUNK)) and len(received) < MAX_ANSWER:
            received += packet
    except BlockingIOError:
        raise NoAnswerError(f"the host {name!r} has not answered within {ANSWERS_WITHIN_S:g} s") from None
    except OSError as error:
        raise LinkError(f"the host {name!r} ended the connection: {error.strerror}") from None
    try:
        answer = _answers.decode(received)
    except msgspec.DecodeError:
        raise LinkError(f"the host {name!r} ended before it answered") from None
    if answer.error:
        if answer.kind in _ERRORS:
            raise _ERRORS[answer.kind](answer.error)
        if answer.kind == UnknownNameError.__name__:
            raise UsageError(answer.error)
        raise RefusedError(answer.error, code=answer.code or "refused")
    return answer

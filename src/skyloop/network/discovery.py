"""Discovery: list the network's proxies, find a proxy that comes back, and join a proxy.

Zenoh retries the addresses that it was given, but repeats its multicast search only after 1, 2, 4 and then every 8
seconds. An application that does not find a proxy therefore searches here, without a connection. If a node answers that
the current session does not know about, the application opens a new session, which finds that node within milliseconds.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from skyloop.errors import DecodeError, LinkError, NoAnswerError, UnknownNameError
from skyloop.network import config, layout, packets
from skyloop.network.admission import Admission, JoinRequest
from skyloop.network.config import FabricSettings, Part
from skyloop.network.packets import ProxyInfo
from skyloop.network.session import FabricSession, acquire, configure, host_name, load, release, retire

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh

#: Time that a newly opened session needs to find all nodes within reach, by multicast or at the given addresses.
SETTLE_S: Final = 0.6
ANSWER_S: Final = 0.5  #: time for proxies to send their descriptions
#: Time for a linked node to list the tokens that it knows. It needs milliseconds unless it is flooded with tokens.
SYNC_S: Final = 5.0
RUNS_PER_NAME: Final = 8  #: maximum number of proxies listed per name; a split network may have two or three
SEARCH_S: Final = 0.25  #: time to wait for answers to a search
YOUNG_S: Final = 1.0  #: maximum age of a session that does not need help with its search
FORGET_S: Final = 10.0  #: a peer that a new session could not reach is not tried again for this long
JOIN_S: Final = 1.0  #: time for a proxy to admit the application
TIMED_OUT: Final = "Timeout"  #: text of Zenoh's error reply to a query that timed out
MAX_CANDIDATES: Final = 4  #: with keys: maximum number of proxies of this name to ask until one proves its identity


def list_proxies(settings: FabricSettings) -> list[ProxyInfo]:
    """List the proxies that this process can reach over the network, sorted by name and age. Takes about a second."""
    session = acquire(settings, Part.APP)
    try:
        _settle(session)
        runs(session)  # once this request has been answered, all reachable nodes are known
        return sorted(_ask(session, "*"), key=lambda about: (about.name, about.since_ns))
    finally:
        release(session)


def ask(settings: FabricSettings, name: str) -> list[ProxyInfo]:
    """Return the proxies with this name, oldest first. There are several only if a network was split."""
    if not settings.multicast and not settings.connect:
        return []  # other nodes would have to connect to this one, which does not listen yet
    session = acquire(replace(settings, listen=()), Part.APP)
    try:
        _settle(session)
        runs(session, name)
        return oldest_first(session, name)
    finally:
        release(session)


def oldest_first(session: FabricSession, name: str) -> list[ProxyInfo]:
    """Return the proxies with this name, oldest first, using an open session."""
    return sorted(_ask(session, name), key=lambda about: about.since_ns)


def runs(session: FabricSession, name: str = "*") -> set[tuple[str, str]]:
    """Return NAME and RUN of the transport servers whose tokens are currently visible.

    This call takes as long as the linked nodes need to send their tokens, but no more than :data:`SYNC_S`.
    """
    return listed(session, name)[0]


def listed(session: FabricSession, name: str = "*", *, within_s: float = SYNC_S) -> tuple[set[tuple[str, str]], bool]:
    """Return the result of :func:`runs`, and whether the linked nodes have sent all their tokens."""
    found = set()
    deadline = time.monotonic() + within_s
    for reply in session.zenoh.liveliness().get(layout.alive(name, "*"), timeout=within_s):
        if reply.ok is not None:
            try:
                found.add(layout.parse_alive(str(reply.ok.key_expr)))
            except DecodeError:
                continue
    return found, time.monotonic() < deadline


def _settle(session: FabricSession) -> None:
    """Wait until a new session knows the nodes within reach."""
    time.sleep(max(0.0, session.opened + SETTLE_S - time.monotonic()))


def _ask(session: FabricSession, name: str) -> list[ProxyInfo]:
    z = load()
    found: dict[str, ProxyInfo] = {}
    replies = session.zenoh.get(
        layout.info(name), target=z.QueryTarget.ALL, consolidation=z.ConsolidationMode.NONE, timeout=ANSWER_S
    )
    for reply in replies:
        if reply.ok is None:
            continue
        try:
            about = packets.decode_info(packets.copied(reply.ok.payload, packets.MAX_OWN))
        except (DecodeError, msgspec.DecodeError):
            continue
        if str(reply.ok.key_expr) == layout.info(about.name):
            found[about.run] = about
    return _oldest_of_each(list(found.values()))


def _oldest_of_each(found: list[ProxyInfo]) -> list[ProxyInfo]:
    """Return the oldest proxies of each name, so that many answers for one name can't hide other names."""
    counts: Counter[str] = Counter()
    few = []
    for about in sorted(found, key=lambda about: about.since_ns):
        counts[about.name] += 1
        if counts[about.name] <= RUNS_PER_NAME:
            few.append(about)
    return few


class UnreachablePeers:
    """Peers that answered a search but could not be reached, for example those of a lab with other keys."""

    def __init__(self) -> None:
        self._tried: dict[str, float] = {}

    def any_new(self, answered: set[str], known: set[str], now_s: float) -> bool:
        """Return whether an unknown peer answered for which no session has been opened yet."""
        self._tried = {who: at for who, at in self._tried.items() if now_s - at < FORGET_S}
        new = answered - known - self._tried.keys()
        self._tried |= dict.fromkeys(new, now_s)
        return bool(new)

    def clear(self) -> None:
        """Forget the peers: once a proxy has been reached, earlier failures say nothing about the next attempt."""
        self._tried.clear()


_UNREACHABLE: Final = UnreachablePeers()
_lock: Final = threading.Lock()


def proxy_reached() -> None:
    """Forget unreachable peers, because a proxy was reached."""
    with _lock:
        _UNREACHABLE.clear()


def renew(session: FabricSession) -> bool:
    """Search for nodes that a session does not know about. If new ones answer, retire the session and return True."""
    if not session.settings.multicast or time.monotonic() - session.opened < YOUNG_S:
        return False
    answered = _search(session)
    known = {str(zid) for zid in (*session.zenoh.info.peers_zid(), *session.zenoh.info.routers_zid())}
    with _lock:
        found = _UNREACHABLE.any_new(answered, known, time.monotonic())
    if found:
        retire(session)
    return found


def _search(session: FabricSession) -> set[str]:
    """Return the identities of the nodes that currently answer and accept connections."""
    answered: set[str] = set()

    def hello(answer: Any) -> None:
        if answer.locators:
            answered.add(str(answer.zid))

    sections = config.make(session.settings, session.part, [])
    scouting = load().scout(
        session.callback(hello), what="peer|router", config=configure({"scouting": sections["scouting"]})
    )
    time.sleep(SEARCH_S)
    scouting.stop()
    return answered


class ProxyWatch:
    """Monitors which transport servers with a given name are alive.

    ``on_gone`` is called on one of Zenoh's threads with the run of each proxy that disappears. ``known``: the
    description of a proxy with this name, if it was received earlier. The description is then not requested again.
    """

    def __init__(
        self, session: FabricSession, name: str, on_gone: Callable[[str], None], known: packets.ProxyInfo | None = None
    ) -> None:
        self._session = session
        self._name = name
        self._on_gone = on_gone
        self._known = known
        self._runs: set[str] = set()
        self._changed = threading.Condition()

    def declare(self) -> Any:
        """Start watching. The caller must undeclare the result."""
        return self._session.zenoh.liveliness().declare_subscriber(
            layout.alive(self._name, "*"), self._session.callback(self._on_token), history=True
        )

    def find(self, within_s: float, list_s: float) -> list[tuple[str, packets.ProxyInfo | None]]:
        """Wait for a proxy with this name, then up to ``list_s`` [s] for linked nodes to list theirs.

        Returns each candidate's run and description, best first. The best one is the oldest. With keys, the others
        follow, because the oldest may have no key for this name. Raises :class:`UnknownNameError` if there is none, and
        :class:`NoAnswerError` if one was found but has disappeared, or a linked node does not list its tokens.
        """
        with self._changed:
            found = self._changed.wait_for(lambda: bool(self._runs), within_s)
        if not found:
            # A node that is flooded with tokens may list many others before the proxy's token, so wait for all of them.
            known, complete = listed(self._session, within_s=list_s)
            with self._changed:
                self._runs.update(run for other, run in known if other == self._name)
                found = bool(self._runs)
            if not found and not complete:
                raise NoAnswerError(
                    f"the network was reached, but not all nodes listed their proxies within {list_s:g} s: the proxy "
                    f"{self._name!r} may be among them"
                )
            if not found:
                others = {other for other, _ in known} - {self._name}
                where = f"on the network ({self._session.settings.reach})"
                raise UnknownNameError("proxy", self._name, others, where=where)
        return self._candidates()

    def _candidates(self) -> list[tuple[str, packets.ProxyInfo | None]]:
        known = self._known
        if known is not None and self._runs == {known.run}:
            return [(known.run, known)]
        running = [about for about in oldest_first(self._session, self._name) if about.run in self._runs]
        with self._changed:
            found: list[tuple[str, packets.ProxyInfo | None]] = [(about.run, about) for about in running]
            found += [(run, None) for run in sorted(self._runs - {run for run, _ in found})]
        if not found:
            raise NoAnswerError(f"the proxy {self._name!r} was found on the network but has disappeared")
        return found[: 1 if self._session.settings.ring is None else MAX_CANDIDATES]

    def _on_token(self, sample: zenoh.Sample) -> None:
        """Record that a proxy with this name has appeared or disappeared."""
        try:
            _, run = layout.parse_alive(str(sample.key_expr))
        except DecodeError:
            return
        alive = sample.kind == load().SampleKind.PUT
        with self._changed:
            (self._runs.add if alive else self._runs.discard)(run)
            self._changed.notify_all()
        if not alive:
            self._on_gone(run)


def join(session: FabricSession, name: str, run: str, connection: str) -> Admission:
    """Ask one run of a proxy to admit a connection, and return the connection's terms."""
    z, who, ring = load(), session.settings.who, session.settings.ring
    request = JoinRequest(ring, name, run, layout.Sender("join", who, connection))
    program = Path(sys.argv[0]).name[:64]
    asked = packets.Join(packets.REVISION, run, host_name(), os.getpid(), program, request.proof)
    impostor: LinkError | None = None
    replies = session.zenoh.get(
        layout.join(name, who, connection),
        payload=packets.encode_own(asked),
        target=z.QueryTarget.ALL,
        consolidation=z.ConsolidationMode.NONE,
        timeout=JOIN_S,
        priority=z.Priority.DATA_HIGH,
        express=True,
    )
    for reply in replies:
        if reply.err is not None:
            words = reply.err.payload.to_string()[:400]
            if words == TIMED_OUT:  # a router sent it after a time-out, so it is not a refusal
                continue
            raise LinkError(f"the proxy {name!r} does not admit us: {words}")
        try:
            ok = reply.ok
            welcome = None if ok is None else packets.decode_welcome(packets.copied(ok.payload, packets.MAX_OWN))
        except (DecodeError, msgspec.DecodeError):
            continue
        if welcome is None or welcome.run != run:
            continue
        try:
            return request.accept(welcome)
        except LinkError as error:  # the real proxy may still answer
            impostor = error
    if impostor is not None:
        raise LinkError(f"an impostor answers as the proxy {name!r}: {impostor}")
    raise NoAnswerError(
        f"the proxy {name!r} was found on the network but did not answer"
        + ("" if session.settings.tls is None else f"; the keys of {who!r} may not give access to it")
    )

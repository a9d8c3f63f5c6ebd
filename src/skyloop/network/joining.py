"""How an application's connection begins: find the proxy of a name, and be let in by it."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from skyloop.errors import DecodeError, LinkError, NoAnswerError, UnknownNameError
from skyloop.network import discovery, layout, packets
from skyloop.network.admission import Admission, JoinRequest
from skyloop.network.session import Session, host_name, load

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh

JOIN_S: Final = 1.0  #: how long a proxy that was found may take to let this application in
TIMED_OUT: Final = "Timeout"  #: the text of Zenoh's error reply to a query that nobody answered in time
MAX_CANDIDATES: Final = 4  #: with keys: so many proxies of one name are asked until one proves that it is it


class ProxyWatch:
    """Watches which transport servers with one name are alive.

    Args:
        session: The Zenoh session.
        name: The proxy's name.
        on_gone: Called with the run of a transport server that goes away, on one of Zenoh's threads.
        known: What a proxy with this name reported of itself before: it is not asked again.
    """

    def __init__(
        self,
        session: Session,
        name: str,
        on_gone: Callable[[str], None],
        known: packets.ProxyInfo | None = None,
    ) -> None:
        self._session = session
        self._name = name
        self._on_gone = on_gone
        self._known = known
        self._runs: set[str] = set()
        self._changed = threading.Condition()

    def declare(self) -> Any:
        """Begin to watch; the caller undeclares what is returned."""
        return self._session.zenoh.liveliness().declare_subscriber(
            layout.alive(self._name, "*"), self._session.callback(self._on_token), history=True
        )

    def find(self, within_s: float, list_s: float) -> list[tuple[str, packets.ProxyInfo | None]]:
        """Wait for a proxy with this name.

        Args:
            within_s: How long [s].
            list_s: How long the linked nodes may take after that to list the proxies that they know [s].

        Returns:
            The run of each candidate with what it reports of itself, the best first. That is the oldest; with keys the
            next ones follow, as the oldest may turn out to have no key for this name.

        Raises:
            UnknownNameError: None can be reached.
            NoAnswerError: One was found and is gone again, or a linked node does not list what it knows.
        """
        with self._changed:
            found = self._changed.wait_for(lambda: bool(self._runs), within_s)
        if not found:
            # A node that is flooded with tokens may list many others before the proxy's: this waits for all of them.
            known, complete = discovery.listed(self._session, within_s=list_s)
            with self._changed:
                self._runs.update(run for other, run in known if other == self._name)
                found = bool(self._runs)
            if not found and not complete:
                raise NoAnswerError(
                    f"the network was reached, but within {list_s:g} s not all said whether they know the proxy "
                    f"{self._name!r}"
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
        running = [about for about in discovery.oldest_first(self._session, self._name) if about.run in self._runs]
        with self._changed:
            found: list[tuple[str, packets.ProxyInfo | None]] = [(about.run, about) for about in running]
            found += [(run, None) for run in sorted(self._runs - {run for run, _ in found})]
        if not found:
            raise NoAnswerError(f"the proxy {self._name!r} was found on the network, and is gone again")
        return found[: 1 if self._session.settings.ring is None else MAX_CANDIDATES]

    def _on_token(self, sample: zenoh.Sample) -> None:
        """Note that a proxy with this name came or went."""
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


def join(session: Session, name: str, run: str, connection: str) -> Admission:
    """Ask a proxy to let a connection in.

    Args:
        session: The Zenoh session.
        name: The proxy's name.
        run: The run of the proxy that is meant.
        connection: The connection's id.

    Returns:
        The terms of the connection.

    Raises:
        LinkError: The proxy refuses, does not answer (:class:`NoAnswerError`), or somebody else answers in its place.
    """
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
            if words == TIMED_OUT:  # a router's, in place of an answer that did not come: no refusal
                continue
            raise LinkError(f"the proxy {name!r} does not let us in: {words}")
        try:
            ok = reply.ok
            welcome = None if ok is None else packets.decode_welcome(packets.copied(ok.payload, packets.MAX_OWN))
        except (DecodeError, msgspec.DecodeError):
            continue
        if welcome is None or welcome.run != run:
            continue
        try:
            return request.accept(welcome)
        except LinkError as error:  # perhaps somebody else answers, too
            impostor = error
    if impostor is not None:
        raise LinkError(f"who answers as the proxy {name!r} is not it: {impostor}")
    raise NoAnswerError(
        f"the proxy {name!r} was found on the network but did not answer"
        + ("" if session.settings.tls is None else f"; the keys of {who!r} may not give access to it")
    )

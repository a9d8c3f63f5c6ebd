"""The application's end of the fabric transport, and the topics that it has subscribed to."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from skyloop.errors import DecodeError, LinkError, NoAnswerError, UnknownNameError
from skyloop.messages import FrameHeader, Refusal, Refused, Reply, Request, decode, encode
from skyloop.network import layout, packets
from skyloop.network.admission import Admission
from skyloop.network.config import FabricSettings, Part
from skyloop.network.delivery import ACKNOWLEDGE_EVERY_S, DEPTH, AckPolicy, Outgoing, Receiver, RecentPackets
from skyloop.network.discovery import SYNC_S, ProxyWatch, join, proxy_reached, renew
from skyloop.network.frames import WINDOW
from skyloop.network.sealing import Opener, contents
from skyloop.network.session import FabricSession, acquire, load, release, retire, undeclare
from skyloop.transport.base import (
    MAX_PACKET,
    ClientHandler,
    Dialer,
    TransportClient,
    check_name,
    check_packet,
    check_topic,
    video,
)

if TYPE_CHECKING:
    import zenoh

    from skyloop.network.keys import Identity

GLANCE_S: Final = 0.25  #: time for one session to find a proxy before the search continues with another session
#: If a linked node takes longer than this to list its proxies after a loss, it has probably not noticed that its links
#: ended before they were re-established. The node then mistakes the new links for additional links and announces
#: nothing on them. The limit doubles each time, up to :data:`SYNC_S`, because the node may just be busy.
LIST_S: Final = 1.0
POLL_S: Final = 0.05  #: interval between checks for packets to resend
STALLED_S: Final = 5.0  #: after this time without an acknowledgement, a proxy is considered gone
KEYS_S: Final = 0.5  #: interval between checks for a newer roster
FAREWELL_S: Final = 0.3  #: time to wait for an answer to a bye
_VIDEO: Final = video("")
_UNNUMBERED: Final = packets.number(0)
_log = logging.getLogger(__name__)


def dial(name: str, settings: FabricSettings | None = None, *, find_s: float = 1.5) -> Dialer:
    """Return a dialer for a proxy on the network. The dialer may take up to ``find_s`` [s] to find the proxy.

    The dialer raises :class:`UnknownNameError` if no proxy with this name can be reached, and :class:`LinkError` if the
    proxy does not admit the application.
    """
    check_name(name)
    load()
    chosen = settings or FabricSettings()
    if chosen.identity is not None:
        chosen.identity.require_application()

    before: FabricClient | None = None  # the previous connection
    about: packets.ProxyInfo | None = None  # the proxy
    list_s = SYNC_S

    def attempt(handler: ClientHandler, within_s: float) -> FabricClient:
        nonlocal about, before, chosen, list_s
        chosen = chosen.current()
        if before is not None and not before.parted:
            # One end may have forgotten the other, which still knows it. Such a session finds no proxy or gets no
            # answers, and Zenoh does not detect this. A new session has a new identity.
            retire(before.session)
            before = None
        session = acquire(chosen, Part.APP)
        try:
            found = FabricClient(session, name, handler, within_s, list_s, about)
        except UnknownNameError:
            renew(session)
            release(session)
            raise
        except NoAnswerError:  # same cause: the links may have been re-established since the session was opened
            list_s = min(2.0 * list_s, SYNC_S)
            retire(session)
            release(session)
            raise
        except BaseException:
            release(session)
            raise
        proxy_reached()
        about, before, list_s = found.about or about, found, LIST_S
        return found

    def dialer(handler: ClientHandler) -> FabricClient:
        deadline = time.monotonic() + find_s
        while True:
            try:
                return attempt(handler, min(GLANCE_S, find_s))
            except UnknownNameError:
                if time.monotonic() > deadline:
                    raise

    return dialer


class Subscription:
    """Sorts a topic's packets on Zenoh's threads, and delivers them on the receiving thread.

    ``run``: the proxy's run. Packets that others publish under its name are ignored. ``enqueue``: called with an item
    whose packet (empty: a frame is due) and number must be passed to :meth:`deliver` in order. ``reject``: called with
    the reason when a packet did not come from the proxy.
    """

    def __init__(
        self,
        topic: str,
        run: bytes,
        opener: Opener,
        enqueue: Callable[[_Item], object],
        reject: Callable[[DecodeError], None],
    ) -> None:
        self._topic = topic
        self._run = run
        self._opener = opener
        self._enqueue = enqueue
        self._reject = reject
        #: Whether only the newest packet matters. Packets and their acknowledgements are then sent as datagrams.
        self.newest_wins = layout.newest_wins(topic)
        self._ack_policy = AckPolicy(ACKNOWLEDGE_EVERY_S) if self.newest_wins else AckPolicy()
        self._recent = RecentPackets()
        self._waiting = 0  # number of waiting packets
        self._frames: deque[tuple[int, FrameHeader, bytes]] = deque()
        self._newest = 0  # number of the newest frame received
        self._ended = False

    def declare(self, session: FabricSession, name: str, connection: str) -> list[Any]:
        """Subscribe on a Zenoh session. The caller must undeclare the returned declarations."""
        z, call, topic = session.zenoh, session.callback, self._topic
        if not topic.startswith(_VIDEO):
            return [z.declare_subscriber(layout.topic(name, topic), call(self._on_packet))]
        camera, _, form = topic.removeprefix(_VIDEO).partition("?")
        keys = (layout.video(name, camera, form), layout.video_for(name, camera, form, connection))
        return [z.declare_subscriber(key, call(self._on_frame)) for key in keys]

    def end(self) -> None:
        """Stop delivering frames, including frames that are already queued."""
        self._ended = True

    def deliver(self, handler: ClientHandler, packet: bytes, number: int) -> bytes:
        """Deliver the next item to the handler. Return the packet that acknowledges it; empty if none is needed."""
        if packet:
            self._waiting -= 1
            handler.packet(packet)
            return packets.taken(self._topic, number) if self._ack_policy.count(number, 0, time.monotonic()) else b""
        number, header, data = self._frames.popleft()
        if self._ended:
            return b""
        handler.frame(header, np.frombuffer(data, np.uint8), self._topic)
        return packets.seen(self._topic, number)

    # --- callbacks, on Zenoh's threads ---

    def _on_packet(self, sample: zenoh.Sample) -> None:
        try:
            opened = contents(self._opener, sample)
            if opened is None:
                return
            packet = opened[0]
            run, number = packets.parse_published(opened[1])
        except DecodeError as error:
            self._reject(error)
            return
        if run == self._run and self._waiting < DEPTH and self._recent.is_new(number, packet):
            self._waiting += 1
            self._enqueue((self, packet, number))

    def _on_frame(self, sample: zenoh.Sample) -> None:
        """Queue a frame, replacing any frame that is already queued."""
        opener = self._opener
        try:
            attachment = packets.copied(sample.attachment, packets.MAX_OWN)
            run, number, header = packets.parse_frame(attachment[: len(attachment) - opener.trailer])
            if run != self._run or number <= self._newest or len(sample.payload) != header.size + opener.tag:
                return
            opened = opener.open(str(sample.key_expr), attachment, bytes(sample.payload))
            if opened is None:
                return
        except DecodeError as error:
            self._reject(error)
            return
        self._newest = number
        if len(self._frames) >= WINDOW:
            self._frames[-1] = (number, header, opened[0])
        else:
            self._frames.append((number, header, opened[0]))
            self._enqueue((self, b"", number))


#: Items for the receiving thread: a topic (None: sent to this end only), its packet (empty: a frame), its number.
_Item = tuple[Subscription | None, bytes, int]
_WAKE: Final[_Item] = (None, b"", 0)


class FabricClient(TransportClient):
    """The application's end of the transport. The dialer from :func:`dial` creates it.

    It releases its session when the connection ends, but not if the constructor raises :class:`UnknownNameError` (no
    such proxy after ``find_s`` and, for linked nodes to list theirs, ``list_s`` [s]), :class:`LinkError` (the proxy
    does not admit this application) or :class:`NoAnswerError`. ``known``: the proxy's description, if received before.
    """

    def __init__(
        self,
        session: FabricSession,
        name: str,
        handler: ClientHandler,
        find_s: float,
        list_s: float,
        known: packets.ProxyInfo | None = None,
    ) -> None:
        self.session = session  #: the Zenoh session, which may be shared with other connections
        self.parted = False  #: whether the proxy has announced or accepted the end of this connection
        self._name = name
        self._handler = handler
        self._who = session.settings.who
        identity = session.settings.identity
        self._observer = None if identity is None or identity.may_fly(name) else identity
        self._id = layout.new_id()
        self._run = ""  # the proxy's run, set once a proxy has been asked to admit this application
        self._lock = threading.Lock()  # guards the following attributes; held while sending, to keep packets in order
        self._outgoing = Outgoing()
        self._subscriptions: dict[str, tuple[Subscription, list[Any]]] = {}  # each subscription with its declarations
        self._command: zenoh.Publisher | None = None
        self._command_key = layout.upward(layout.COMMAND, name, self._who, self._id)
        self._report: zenoh.Publisher | None = None
        self._report_key = layout.upward(layout.ASK, name, self._who, self._id)
        self._ring = session.settings.ring
        self._pause_s = None if self._ring is None else KEYS_S
        self._keys_s = 0.0  # time of the next check of the keys
        self._admission = Admission()  # with keys: the proxy's identity, and the seals for packets
        self.forged = 0  #: number of packets and frames that did not come from the proxy
        self._receiver = Receiver()  # packets that are only for this end
        self._inbox: SimpleQueue[_Item | None] = SimpleQueue()
        self._ended = False  # nothing more can be sent
        self._closing = False  # this end has closed the connection: nothing more is delivered
        self._farewell = threading.Event()  # set when the proxy has answered our bye, or has ended
        self._reason = ""
        self._held: list[Any] = []
        try:
            about = self.about = self._enter(find_s, list_s, known)  #: the proxy's description of itself, if known
        except BaseException:
            self._undeclare()
            raise
        self._address = f"fabric:{name} on {about.host} (pid {about.pid})" if about else f"fabric:{name}"
        self._thread = threading.Thread(target=self._receive, name=f"skyloop-{name}-fabric-client", daemon=True)
        self._thread.start()

    def _enter(self, find_s: float, list_s: float, known: packets.ProxyInfo | None) -> packets.ProxyInfo | None:
        session, name = self.session, self._name
        watch = ProxyWatch(session, name, self._on_proxy_gone, known)
        self._held.append(watch.declare())
        candidates = watch.find(find_s, list_s)
        mine = layout.to(name, self._id)
        self._held.append(session.zenoh.declare_subscriber(mine, session.callback(self._on_packet)))
        self._held.append(session.zenoh.liveliness().declare_token(layout.app(name, self._who, self._id)))
        while True:
            self._run, about = candidates.pop(0)
            try:
                self._admission = join(session, name, self._run, self._id)
            except LinkError:
                if not candidates:
                    raise
            else:
                return about

    # --- calls by the application ---

    def send(self, packet: bytes) -> bool:
        if not 0 < len(packet) <= MAX_PACKET:
            check_packet(packet)
        way = layout.way_of(packet)
        with self._lock:
            if self._ended:
                return False
            if way != layout.ASK and self._observer is not None:
                if (answer := refusal_reply(packet, self._observer, self._name)) is not None:
                    self._inbox.put((None, answer, 0))
                return answer is not None
            if way == layout.COMMAND:
                return self._send_command(packet)
            if layout.is_report(packet):
                return self._send_report(packet)
            return self._keep(way, packet)

    def subscribe(self, topic: str, on: bool = True) -> None:
        check_topic(topic)
        with self._lock:
            if self._ended or on == (topic in self._subscriptions):
                return
            if on:
                run, opener = bytes.fromhex(self._run), self._admission.topics
                wanted = Subscription(topic, run, opener, self._inbox.put, self._reject)
                self._subscriptions[topic] = wanted, wanted.declare(self.session, self._name, self._id)
            sent = self._keep(layout.ASK, packets.subscribe(topic, on), own=True)
            declared: list[Any] = []
            if not on:
                unwanted, declared = self._subscriptions.pop(topic)
                unwanted.end()
        undeclare(declared)
        if not sent:  # nothing would arrive on this connection; the next connection subscribes again
            self._end(f"the proxy accepts no packets: the subscription to {topic!r} can't be sent")

    def close(self) -> None:
        self._end("closed by the application")
        if threading.current_thread() is not self._thread:
            self._thread.join()

    @property
    def same_clock(self) -> bool:
        return False

    @property
    def variants(self) -> bool:
        return True

    @property
    def excused_s(self) -> float:
        return self.session.settings.excused_s

    @property
    def address(self) -> str:
        return self._address

    def _send_command(self, packet: bytes) -> bool:
        if self._command is None:
            self._command = self.session.publisher(self._command_key, "REAL_TIME", best_effort=True)
        return self._send_once(self._command, self._command_key, packet)

    def _send_report(self, packet: bytes) -> bool:
        if self._report is None:
            self._report = self.session.publisher(self._report_key, "DATA_HIGH", best_effort=True)
        return self._send_once(self._report, self._report_key, packet)

    def _send_once(self, publisher: zenoh.Publisher, key: str, packet: bytes) -> bool:
        """Send a packet that may be lost. Never waits."""
        payload, attachment = self._admission.sealer.seal(key, _UNNUMBERED, packet)
        try:
            publisher.put(payload, attachment=attachment)
        except load().ZError:
            return False
        return True

    def _keep(self, way: str, packet: bytes, *, own: bool = False) -> bool:
        """Send a packet, and again until it is acknowledged; False if there is no room. The caller holds the lock."""
        waits = self._outgoing.under_way
        if not self._outgoing.put(packet, way, own=own):
            return False
        self._send_due()
        if not waits:
            self._inbox.put(_WAKE)  # the receiving thread resends unacknowledged packets
        return True

    def _send_due(self) -> None:
        """Send the packets that are due. The caller holds the lock."""
        for number, packet, way in self._outgoing.due(time.monotonic()):
            self._put(way, packet, number)

    def _put(self, way: str, packet: bytes, number: int) -> bool:
        key = layout.upward(way, self._name, self._who, self._id)
        sealed = self._admission.sealer.seal(key, packets.number(number), packet)
        try:
            self.session.put(key, *sealed, "DATA_HIGH")
        except load().ZError as error:
            _log.debug("%s: not sent: %s", self._name, error)
            return False
        return True

    # --- callbacks, on Zenoh's threads ---

    def _on_proxy_gone(self, run: str) -> None:
        if run == self._run:
            self._farewell.set()
            self._end("the proxy is gone")

    def _on_packet(self, sample: zenoh.Sample) -> None:
        """Handle a packet that was sent only to this application."""
        try:
            opened = contents(self._admission.opener, sample)
            if opened is None:
                return  # the packet was already received by another path
            packet, number = opened[0], packets.parse_number(opened[1])
        except DecodeError as error:
            self._reject(error)
            return
        if not number:
            self._receiver.receive(packet, control=self._control, deliver=self._enqueue_unnumbered)
            return
        taken = self._receiver.receive_numbered(
            number, packet, has_room=self._has_room, control=self._control, deliver=self._enqueue
        )
        self._acknowledge(packets.taken("", taken))

    def _has_room(self) -> bool:
        return self._inbox.qsize() < 16 * DEPTH

    def _enqueue(self, packet: bytes) -> None:
        self._inbox.put((None, packet, 0))

    def _enqueue_unnumbered(self, packet: bytes) -> None:
        if self._has_room():
            self._enqueue(packet)

    def _control(self, message: packets.Message) -> bool:
        """Handle one of the transport's own packets; return False if it is left to the handler (garbage)."""
        if isinstance(message, packets.Taken):
            with self._lock:
                self._outgoing.taken(message.number, time.monotonic())
                self._send_due()
        elif isinstance(message, packets.Key):
            self._admission.topics.use(message.key, message.generation)
        elif isinstance(message, packets.Bye):
            self.parted = True
            self._farewell.set()
            self._end(message.reason)
        else:
            return False
        return True

    def _reject(self, error: DecodeError) -> None:
        """Count a sample that did not come from the proxy, and log the first such sample."""
        self.forged += 1
        if self.forged == 1:
            _log.warning("%s: ignored a packet that the proxy did not send: %s", self._name, error)

    # --- keys ---

    def _check_keys(self) -> None:
        """End the connection if a newer roster excludes the proxy or a linked node. Called on the receiving thread."""
        ring, proxy, expires = self._ring, self._admission.identity, self._admission.expires
        now_s = time.monotonic()
        if ring is None or proxy is None or now_s < self._keys_s:
            return
        self._keys_s = now_s + KEYS_S
        for change in ring.poll():
            _log.warning("%s", change)
        linked = self.session.shut_out()
        if not ring.admits(proxy):
            reason = f"the keys of the proxy, {proxy}, were revoked or changed"
        elif not ring.admits(ring.credentials.identity):
            reason = "our own keys were revoked or changed"
        elif expires is not None and datetime.now(UTC) >= expires:
            reason = "the keys of the proxy have expired"
        elif linked:
            reason = f"linked to a node whose keys were revoked or changed: {', '.join(sorted(linked))}"
        else:
            return
        retire(self.session)  # the next session will use the newer roster
        self._end(reason)

    # --- the end of the connection ---

    def _end(self, reason: str) -> None:
        """End the connection. Only the first call counts, and the receiving thread does the rest. Any thread."""
        with self._lock:
            if self._ended:
                return
            self._reason = self._reason or reason
            if not self._keep(layout.ASK, packets.bye(reason), own=True):  # sent after all previous packets
                self._put(layout.ASK, packets.bye(reason), 0)
            self._ended = True
        self._inbox.put(None)

    def _undeclare(self) -> None:
        """Undeclare everything. Must not be called on Zenoh's threads."""
        held, self._held = self._held, []
        for _, declared in self._subscriptions.values():
            held += declared
        self._subscriptions = {}
        held += [publisher for publisher in (self._command, self._report) if publisher is not None]
        undeclare(held)

    # --- on the receiving thread ---

    def _receive(self) -> None:
        while (item := self._next()) is not None:
            if self._closing or item is _WAKE:
                continue
            try:
                self._deliver(*item)
            except Exception as error:  # noqa: BLE001  (a handler may raise anything)
                _log.exception("the handler of %s failed; its connection ends", self._address)
                self._closing = True
                self._end(f"the application's handler failed: {error!r}")
        until = time.monotonic() + FAREWELL_S
        while not self._farewell.wait(POLL_S) and time.monotonic() < until:
            with self._lock:
                self._send_due()
        self._undeclare()
        release(self.session)
        try:
            self._handler.closed(self._reason)
        except Exception:  # noqa: BLE001  (a handler may raise anything)
            _log.exception("the handler of %s failed in closed()", self._address)

    def _next(self) -> _Item | None:
        """Return the next item. While waiting, resend packets to the proxy and check the keys."""
        while True:
            self._check_keys()
            with self._lock:
                self._send_due()
                waits, stalled_s = self._outgoing.under_way, self._outgoing.stalled_s(time.monotonic())
            most_s = STALLED_S + self.excused_s
            if stalled_s > most_s and not self._ended:
                self._end(f"the proxy acknowledged nothing for {most_s:g} s")
            try:
                return self._inbox.get(timeout=POLL_S if waits else self._pause_s)
            except Empty:
                continue

    def _deliver(self, subscription: Subscription | None, packet: bytes, number: int) -> None:
        if subscription is None:
            self._handler.packet(packet)
            return
        if answer := subscription.deliver(self._handler, packet, number):
            self._acknowledge(answer, once=subscription.newest_wins)

    def _acknowledge(self, packet: bytes, *, once: bool = False) -> None:
        """Acknowledge a packet. ``once``: in a datagram, which may be lost."""
        with self._lock:
            if self._ended:
                return
            if once:
                self._send_report(packet)
            else:
                self._put(layout.ASK, packet, 0)


def refusal_reply(packet: bytes, identity: Identity, drone: str) -> bytes | None:
    """Return the reply to a request that an application's keys don't allow. Such a request does not reach the proxy.

    None if the packet is not a request.
    """
    try:
        sample = decode(packet)
    except DecodeError:
        return None
    if not isinstance(sample, Request):
        return None
    text = f"these are the keys of {identity}: they give no right to fly or configure {drone!r}"
    return encode(Reply(sample.id, Refused(Refusal.OBSERVER, text)))

"""An application's end of the fabric transport."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections import deque
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from skyloop.errors import DecodeError, LinkError, NoAnswerError, UnknownNameError
from skyloop.messages import FrameHeader
from skyloop.transport.base import MAX_PACKET, ClientEnd, ClientHandler, Dialer, check_packet, check_topic, video
from skyloop.transport.fabric import finding, layout, packets, rights
from skyloop.transport.fabric.config import Part
from skyloop.transport.fabric.frames import WINDOW
from skyloop.transport.fabric.seeking import reached, renew
from skyloop.transport.fabric.server import host_name
from skyloop.transport.fabric.session import Session, acquire, load, release, retire, undeclare
from skyloop.transport.fabric.settings import FabricSettings
from skyloop.transport.fabric.window import DEPTH, Recent, Taker, Window
from skyloop.transport.names import check_name

if TYPE_CHECKING:
    import zenoh

GLANCE_S: Final = 0.25  #: how long one session is given to find a proxy, before there is a search for others
JOIN_S: Final = 1.0  #: how long a proxy that was found may take to let this application in
FAREWELL_S: Final = 0.3  #: how long to wait for the proxy to answer a bye
_VIDEO: Final = video("")
_log = logging.getLogger(__name__)


def dial(name: str, settings: FabricSettings | None = None, *, find_s: float = 1.5) -> Dialer:
    """The dialer of the proxy with this name on the network, which is looked for during ``find_s`` seconds.

    Raises :class:`UsageError` for what can't be a name and :class:`MissingExtraError`. The dialer itself raises
    :class:`UnknownNameError` where no such proxy can be reached and :class:`LinkError` where it does not let us in.
    """
    check_name(name)
    load()
    chosen = settings or FabricSettings()
    if chosen.identity is not None:
        chosen.identity.require_application()

    before: FabricClient | None = None  # the connection that was made last

    def attempt(handler: ClientHandler, within_s: float) -> FabricClient:
        nonlocal before
        if before is not None and not before.parted:
            # One end may have forgotten the other while the other has not: such a session finds nobody, or gets no
            # answers, and Zenoh does not notice. A new one has another identity, which nobody mistakes for the old.
            retire(before.session)
            before = None
        session = acquire(chosen, Part.APP)
        try:
            found = FabricClient(session, name, handler, within_s)
        except UnknownNameError:
            renew(session)
            release(session)
            raise
        except NoAnswerError:
            retire(session)
            release(session)
            raise
        except BaseException:
            release(session)
            raise
        reached()
        before = found
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


class _Queue:
    """What waits for the handler of one topic, from when it was subscribed to until that ends."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.taker = Taker()
        self.waiting = 0
        self.frames: deque[tuple[int, FrameHeader, bytes]] = deque()
        self.newest = 0  # number of the newest frame that came
        self.recent = Recent()  # packets


class FabricClient(ClientEnd):
    """An application's end, made by the dialer that :func:`dial` returns."""

    def __init__(self, session: Session, name: str, handler: ClientHandler, find_s: float) -> None:
        self._session = session
        self.parted = False  #: the proxy has said that it ends this connection, or let it end
        self._name = name
        self._handler = handler
        self._who = session.settings.who
        identity = session.settings.identity
        self._watches_only = None if identity is None or identity.may_fly(name) else identity
        self._id = layout.new_id()
        self._run = ""
        self._run_bytes = b""
        self._runs: set[str] = set()  # of server ends with this name that are alive
        self._found = threading.Condition()
        self._lock = threading.Lock()  # guards what follows; held while a packet is sent, so that order is kept
        self._window = Window()
        self._subscribers: dict[str, list[Any]] = {}
        self._command: zenoh.Publisher | None = None
        self._queues: dict[str, _Queue] = {}
        self._taker = Taker()
        self._recent = Recent()  # packets to this end alone
        self._inbox: SimpleQueue[tuple[_Queue | None, bytes, int] | None] = SimpleQueue()
        self._ended = False  # nothing can be sent any more
        self._closing = False  # by this end: nothing more is delivered
        self._farewell = threading.Event()  # the proxy has answered our bye, or is gone
        self._reason = ""
        self._held: list[Any] = []
        try:
            about = self._enter(find_s)
        except BaseException:
            self._undeclare()
            raise
        self._address = f"fabric:{name} on {about.host} (pid {about.pid})" if about else f"fabric:{name}"
        self._thread = threading.Thread(target=self._receive, name=f"skyloop-{name}-fabric-client", daemon=True)
        self._thread.start()

    # --- the begin of a connection ---

    def _enter(self, find_s: float) -> packets.ProxyInfo | None:
        """Find the proxy and be let in. Raises :class:`LinkError` or :class:`UnknownNameError`."""
        session, name, call = self._session, self._name, self._session.callback
        watch = session.zenoh.liveliness().declare_subscriber(
            layout.alive(name, "*"), call(self._proxy_token), history=True
        )
        self._held.append(watch)
        with self._found:
            if not self._found.wait_for(lambda: self._runs, find_s):
                others = {known for known, _ in finding.runs(session)}
                raise UnknownNameError(f"proxy on the network ({session.settings.reach})", name, others - {name})
        about = self._choose()
        self._run_bytes = bytes.fromhex(self._run)
        mine = layout.to(name, self._id)
        self._held.append(session.zenoh.declare_subscriber(mine, call(self._own_packet)))
        self._held.append(session.zenoh.liveliness().declare_token(layout.app(name, self._who, self._id)))
        self._ask_to_join()
        return about

    def _choose(self) -> packets.ProxyInfo | None:
        """Which proxy of this name is meant: the oldest, if there are several."""
        known = [about for about in finding.oldest_first(self._session, self._name) if about.run in self._runs]
        if known:
            self._run = known[0].run
            return known[0]
        with self._found:
            if not self._runs:
                raise NoAnswerError(f"the proxy {self._name!r} was found on the network, and is gone again")
            self._run = min(self._runs)
        return None

    def _ask_to_join(self) -> None:
        z = load()
        wish = packets.Join(packets.REVISION, self._run, host_name(), os.getpid(), Path(sys.argv[0]).name[:64])
        replies = self._session.zenoh.get(
            layout.join(self._name, self._who, self._id),
            payload=packets.encode_own(wish),
            target=z.QueryTarget.ALL,
            consolidation=z.ConsolidationMode.NONE,
            timeout=JOIN_S,
            priority=z.Priority.DATA_HIGH,
            express=True,
        )
        for reply in replies:
            if reply.err is not None:
                raise LinkError(f"the proxy {self._name!r} does not let us in: {reply.err.payload.to_string()[:400]}")
            try:
                welcome = packets.decode_welcome(bytes(reply.ok.payload)) if reply.ok is not None else None
            except msgspec.DecodeError:
                continue
            if welcome is not None and welcome.run == self._run:
                return
        raise NoAnswerError(
            f"the proxy {self._name!r} was found on the network but did not answer"
            + ("" if self._session.settings.tls is None else f"; the keys of {self._who!r} may not give access to it")
        )

    # --- use ---

    def send(self, packet: bytes) -> bool:
        if not 0 < len(packet) <= MAX_PACKET:
            check_packet(packet)
        way = rights.way_of(packet)
        with self._lock:
            if self._ended:
                return False
            if way != layout.ASK and self._watches_only is not None:
                answer = rights.refusal(packet, self._watches_only, self._name)
                if answer is not None:
                    self._inbox.put((None, answer, 0))
                return answer is not None
            if way == layout.COMMAND:
                return self._send_command(packet)
            number = self._window.send(len(packet))
            return number > 0 and self._put(way, packet, number)

    def subscribe(self, topic: str, on: bool = True) -> None:
        check_topic(topic)
        with self._lock:
            if self._ended or on == (topic in self._subscribers):
                return
            if on:
                queue = self._queues[topic] = _Queue(topic)
                self._subscribers[topic] = self._declare(queue)
            self._put(layout.ASK, packets.subscribe(topic, on), 0)
            gone = [] if on else self._subscribers.pop(topic)
            if not on:
                del self._queues[topic]
        undeclare(gone)

    def close(self) -> None:
        self._end("closed by the application")
        if threading.current_thread() is not self._thread:
            self._thread.join()

    @property
    def session(self) -> Session:
        """What it goes by, together with others."""
        return self._session

    @property
    def same_clock(self) -> bool:
        return False

    @property
    def variants(self) -> bool:
        return True

    @property
    def address(self) -> str:
        return self._address

    def _declare(self, queue: _Queue) -> list[Any]:
        z, call, name, topic = self._session.zenoh, self._session.callback, self._name, queue.topic
        if not topic.startswith(_VIDEO):
            return [
                z.declare_subscriber(layout.topic(name, topic), call(lambda sample: self._published(queue, sample)))
            ]
        camera, _, form = topic.removeprefix(_VIDEO).partition("?")
        keys = (layout.video(name, camera, form), layout.video_for(name, camera, form, self._id))
        return [z.declare_subscriber(key, call(lambda sample: self._frame(queue, sample))) for key in keys]

    def _send_command(self, packet: bytes) -> bool:
        z = load()
        if self._command is None:
            self._command = self._session.zenoh.declare_publisher(
                layout.upward(layout.COMMAND, self._name, self._who, self._id),
                congestion_control=z.CongestionControl.DROP,
                priority=z.Priority.REAL_TIME,
                reliability=z.Reliability.BEST_EFFORT,
                express=True,
            )
        try:
            self._command.put(packet, attachment=_UNNUMBERED)
        except z.ZError:
            return False
        return True

    def _put(self, way: str, packet: bytes, number: int) -> bool:
        z = load()
        try:
            self._session.zenoh.put(
                layout.upward(way, self._name, self._who, self._id),
                packet,
                attachment=packets.number(number),
                congestion_control=z.CongestionControl.BLOCK,
                priority=z.Priority.DATA_HIGH,
                express=True,
            )
        except z.ZError as error:
            _log.debug("%s: not sent: %s", self._name, error)
            return False
        return True

    # --- what Zenoh calls, on its own threads ---

    def _proxy_token(self, sample: zenoh.Sample) -> None:
        """A proxy with our name lives, or does no longer."""
        try:
            _, run = layout.parse_alive(str(sample.key_expr))
        except DecodeError:
            return
        with self._found:
            if sample.kind == load().SampleKind.PUT:
                self._runs.add(run)
            else:
                self._runs.discard(run)
            self._found.notify_all()
        if run == self._run and run not in self._runs:
            self._farewell.set()
            self._end("the proxy is gone")

    def _own_packet(self, sample: zenoh.Sample) -> None:
        """A packet to this application alone."""
        try:
            number = packets.parse_number(bytes(sample.attachment or b""))
        except DecodeError:
            return
        packet = bytes(sample.payload)
        if packets.is_own(packet):
            try:
                message = packets.parse(packet)
            except DecodeError:
                message = None
            if isinstance(message, packets.Taken):
                with self._lock:
                    self._window.taken(message.number)
                return
            if isinstance(message, packets.Bye):
                self.parted = True
                self._farewell.set()
                self._end(message.reason)
                return
        room = self._inbox.qsize() < 16 * DEPTH
        if room and 0 < len(packet) <= MAX_PACKET and self._recent.is_new(number, packet):
            self._inbox.put((None, packet, number))

    def _published(self, queue: _Queue, sample: zenoh.Sample) -> None:
        """A packet of a topic."""
        try:
            run, number = packets.parse_published(bytes(sample.attachment or b""))
        except DecodeError:
            return
        packet = bytes(sample.payload)
        if run != self._run_bytes or not 0 < len(packet) <= MAX_PACKET:
            return
        if queue.waiting < DEPTH and queue.recent.is_new(number, packet):
            queue.waiting += 1
            self._inbox.put((queue, packet, number))

    def _frame(self, queue: _Queue, sample: zenoh.Sample) -> None:
        """A frame. The newest take the place of those that wait."""
        try:
            run, number, header = packets.parse_frame(bytes(sample.attachment or b""))
        except DecodeError:
            return
        pixels = bytes(sample.payload)
        if run != self._run_bytes or number <= queue.newest or len(pixels) != header.size:
            return
        queue.newest = number
        if len(queue.frames) >= WINDOW:
            queue.frames[-1] = (number, header, pixels)
        else:
            queue.frames.append((number, header, pixels))
            self._inbox.put((queue, b"", number))

    # --- the end of a connection ---

    def _end(self, reason: str) -> None:
        """End the connection: the receiving thread does the rest. Any thread."""
        with self._lock:
            if self._ended:
                return
            self._reason = self._reason or reason
            self._put(layout.ASK, packets.bye(reason), 0)
            self._ended = True
        self._inbox.put(None)

    def _undeclare(self) -> None:
        """Give everything back. Not on Zenoh's threads."""
        held, self._held = self._held, []
        for subscribers in self._subscribers.values():
            held += subscribers
        self._subscribers = {}
        if self._command is not None:
            held.append(self._command)
        undeclare(held)

    # --- the receiving thread ---

    def _receive(self) -> None:
        while (item := self._inbox.get()) is not None:
            if self._closing:
                continue
            try:
                self._deliver(*item)
            except Exception as error:  # noqa: BLE001  (a handler may raise anything)
                _log.exception("the handler of %s failed; its connection ends", self._address)
                self._closing = True
                self._end(f"the application's handler failed: {error!r}")
        self._farewell.wait(FAREWELL_S)
        self._undeclare()
        release(self._session)
        try:
            self._handler.closed(self._reason)
        except Exception:  # noqa: BLE001  (a handler may raise anything)
            _log.exception("the handler of %s failed in closed()", self._address)

    def _deliver(self, queue: _Queue | None, packet: bytes, number: int) -> None:
        if queue is None:
            self._handler.packet(packet)
            if number and self._taker.took(number, len(packet)):
                self._tell(packets.taken("", number))
            return
        topic = queue.topic
        if packet:
            queue.waiting -= 1
            self._handler.packet(packet)
            if queue.taker.took(number, 0):
                self._tell(packets.taken(topic, number))
            return
        number, header, data = queue.frames.popleft()
        if self._queues.get(topic) is not queue:
            return  # nobody wants them any more
        self._handler.frame(header, np.frombuffer(data, np.uint8), topic)
        self._tell(packets.seen(topic, number))

    def _tell(self, packet: bytes) -> None:
        with self._lock:
            if not self._ended:
                self._put(layout.ASK, packet, 0)


_UNNUMBERED: Final = packets.number(0)

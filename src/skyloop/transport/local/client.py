"""An application's end of the local transport."""

from __future__ import annotations

import array
import logging
import os
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from skyloop.child_process import leave_to_parent
from skyloop.errors import DecodeError, LinkError, UnknownNameError
from skyloop.messages.codec import HEADER_SIZE, MAX_BODY
from skyloop.transport.base import MAX_PACKET, ClientHandler, Dialer, TransportClient, check_packet, check_topic
from skyloop.transport.local import packets
from skyloop.transport.local.directory import connect, find_directory
from skyloop.transport.local.packets import OWN
from skyloop.transport.local.slot_memory import Leases
from skyloop.transport.local.sockets import SEND_FLAGS, Socket, credentials, set_timeout

_MAX_RECEIVED: Final = HEADER_SIZE + MAX_BODY + 256  # a frame's packet has a few bytes more than its header's
_ANCILLARY: Final = socket.CMSG_SPACE(4 * array.array("i").itemsize)
_RETRY_S: Final = 0.25  # for what did not fit into a full socket
_LOOK_S: Final = 0.05  # how often a thread that leads looks whether its wait is over, while nothing comes
_STAND_BY_S: Final = 0.002  # how long nobody receives after the thread that led went away with what it waited for
_log = logging.getLogger(__name__)


def make_dialer(name: str, group: str | None) -> Dialer:
    """Return the dialer of a proxy; see :func:`skyloop.transport.local.dial`."""
    directory = find_directory(group)
    path = directory.socket_path(name)

    def dialer(handler: ClientHandler) -> LocalClient:
        try:
            directory.check()
            sock = connect(path)
        except FileNotFoundError:
            raise UnknownNameError("proxy", name, [proxy.name for proxy in directory.proxies()]) from None
        except ConnectionRefusedError:
            raise LinkError(f"the proxy {name!r} is not running: it was killed and left its socket {path}") from None
        except BlockingIOError:
            raise LinkError(f"the proxy {name!r} does not accept connections: it is stopped or overloaded") from None
        except OSError as error:
            raise LinkError(f"cannot connect to the proxy {name!r} at {path}: {error.strerror}") from None
        return LocalClient(sock, name, handler)

    return dialer


class LocalClient(TransportClient):
    """An application's end, made by the dialer that :func:`skyloop.transport.local.dial` returns.

    Args:
        sock: Connected to the proxy.
        name: The proxy's name.
        handler: Called on the receiving thread, which starts at once.
    """

    # Whoever holds ``_turn`` receives and delivers. That is the receiving thread, or a thread of the application that
    # waits for a sample and *leads* meanwhile: a sample wakes that thread alone, where handing it over from one to the
    # other takes a second wake-up, which costs as much as the whole way from the proxy. While somebody leads, the
    # receiving thread stands by, and receives again when nobody has for two milliseconds.

    def __init__(self, sock: Socket, name: str, handler: ClientHandler) -> None:
        self._address = f"local:{name} (pid {credentials(sock).pid})"
        sock.limit_backlog()
        set_timeout(sock, socket.SO_RCVTIMEO, _RETRY_S)
        self._socket: Socket | None = sock
        self._handler = handler
        self._unsent: deque[bytes] = deque()  # the transport's own packets that did not fit, in order
        self._leases = Leases(self._release)
        self._closing = False
        self._reason = ""
        self._turn = threading.Lock()
        self._receiver = 0  # identity of the thread that has the turn
        self._ended = ""  # why receiving is over
        self._candidate: Callable[[], None] | None = None  # wakes a thread that would lead
        self._releases: deque[bytes] = deque()  # of frames that were dropped while a packet was delivered
        self._send_own(packets.hello())
        self._thread = threading.Thread(target=self._run, args=(sock,), name=f"skyloop-{name}-client", daemon=True)
        self._thread.start()
        leave_to_parent(self)

    def forked(self) -> None:
        """Drop a forked child's copy of the connection; shutting it down would end the parent's."""
        sock, self._socket = self._socket, None
        self._ended = "the connection belongs to the parent process"
        if sock is not None:
            sock.close()

    def send(self, packet: bytes) -> bool:
        if not 0 < len(packet) <= MAX_PACKET:
            check_packet(packet)
        sock = self._socket
        if sock is None:
            return False
        try:
            sock.send(packet, SEND_FLAGS)
        except OSError:
            return False
        return True

    def subscribe(self, topic: str, on: bool = True) -> None:
        check_topic(topic)
        self._send_own(packets.subscribe(topic, on))

    def close(self) -> None:
        self._end("closed by the application")
        if not self.receiving:
            self._thread.join()

    def lead(self, ready: Callable[[], bool], wake: Callable[[], None], timeout_s: float) -> bool:
        sock = self._socket
        if sock is None or self._ended:
            return False
        if not self._turn.acquire(False):
            self._candidate = wake  # the receiving thread makes room after the next packet
            return False
        deadline_s = time.monotonic() + timeout_s
        try:
            self._take_turn(sock, lambda: ready() or time.monotonic() >= deadline_s)
        finally:
            self._turn.release()
        return True

    @property
    def receiving(self) -> bool:
        return self._receiver == threading.get_ident()

    @property
    def same_clock(self) -> bool:
        return True

    @property
    def address(self) -> str:
        return self._address

    def _end(self, reason: str) -> None:
        """End the connection once; the receiving thread does the rest."""
        sock = self._socket
        if sock is not None and not self._closing:
            self._reason = reason
            self._closing = True
            sock.hang_up(packets.bye(reason))

    def _release(self, slot: int) -> None:
        packet = packets.release(slot)
        if self._receiver == threading.get_ident():
            self._releases.append(packet)  # after the delivery, for which somebody waits
        else:
            self._send_own(packet)

    def _send_own(self, packet: bytes) -> None:
        """Send one of the transport's own packets, later if it does not fit now.

        The garbage collector may call this at any point of any thread, so it must not acquire a lock.
        """
        sock = self._socket
        if sock is None:
            return
        if not self._unsent:
            try:
                sock.send(packet, SEND_FLAGS)
            except BlockingIOError:
                pass
            except OSError:
                return  # it has ended
            else:
                return
        self._unsent.append(packet)

    # --- the receiving thread ---

    def _run(self, sock: Socket) -> None:
        while not self._ended:
            set_timeout(sock, socket.SO_RCVTIMEO, _RETRY_S)
            with self._turn:
                self._take_turn(sock, lambda: self._candidate is not None)
            wake, self._candidate = self._candidate, None
            if wake is not None and not self._ended:
                set_timeout(sock, socket.SO_RCVTIMEO, _LOOK_S)
                wake()
                self._stand_by()
        reason = self._ended
        self._end(reason)
        reason = self._reason
        self._socket = None
        self._unsent.clear()
        self._releases.clear()
        self._leases.end()
        try:
            self._handler.closed(reason)
        except Exception:  # noqa: BLE001  (a handler may raise anything)
            _log.exception("the handler of %s failed in closed()", self._address)

    def _stand_by(self) -> None:
        """Wait until nobody leads."""
        while not self._ended:
            time.sleep(_STAND_BY_S)
            if not self._turn.locked():
                return

    # --- whoever has the turn ---

    def _take_turn(self, sock: Socket, over: Callable[[], bool]) -> None:
        """Deliver until it is over, or the connection has ended.

        On the application's main thread, what a handler of a signal raises while nothing comes is raised from here.
        """
        self._receiver = threading.get_ident()
        try:
            self._ended = self._receive(sock, over)
        finally:
            self._receiver = 0

    def _receive(self, sock: Socket, over: Callable[[], bool]) -> str:
        """Deliver until it is over, or until the connection ends: then return why."""
        receive = sock.recvmsg
        deliver, deliver_frame = self._handler.packet, self._handler.frame
        while not self._closing:
            if self._releases or self._unsent:
                self._send_waiting(sock)
            try:
                packet, ancillary, _, _ = receive(_MAX_RECEIVED, _ANCILLARY, socket.MSG_CMSG_CLOEXEC)
            except BlockingIOError:
                if over():
                    return ""
                continue
            except ConnectionResetError:
                continue  # what was sent before it still comes, and then the end
            except OSError as error:
                if error.errno is None:
                    raise  # not the kernel's: a handler of a signal raised it, such as a TimeoutError
                return f"receiving failed: {error}"
            kind = packet[5:6]
            try:
                if kind < OWN and packet and not ancillary:
                    deliver(packet)
                elif not packet:
                    return self._reason or "the proxy is gone"
                elif ancillary or packets.is_own(packet):
                    try:
                        if kind != packets.FRAME or ancillary:
                            self._control(packet, _descriptors(ancillary))
                            continue
                        number, header = packets.parse_frame(packet)
                        pixels = self._leases.pixels(number, header.size)
                    except (DecodeError, LinkError, OSError) as error:
                        return f"the proxy does not keep to the protocol: {error}"
                    deliver_frame(header, pixels)
                    del pixels  # else their slot stayed leased until the next packet
                else:
                    deliver(packet)
            except Exception as error:  # noqa: BLE001  (a handler may raise anything)
                _log.exception("the handler of %s failed; its connection ends", self._address)
                return f"the application's handler failed: {error!r}"
            if over():
                return ""
        return self._reason or "closed by the application"

    def _control(self, packet: bytes, descriptors: list[int]) -> None:
        """Handle one of the transport's own packets that is no frame, and close the descriptors that came with it.

        Raises:
            DecodeError: It can't be parsed.
            LinkError: The proxy announced something that is not valid.
            OSError: A slot can't be mapped.
        """
        try:
            message = packets.parse(packet)
            if isinstance(message, packets.Frame):
                raise LinkError(f"a frame came with {len(descriptors)} descriptors and has none")
            if isinstance(message, packets.Slot):
                if len(descriptors) != 1:
                    raise LinkError(f"a slot was announced with {len(descriptors)} descriptors and needs one")
                self._leases.add(message.slot, message.camera, message.capacity, descriptors[0])
            elif isinstance(message, packets.Retire):
                self._leases.retire(message.camera, message.before)
            elif isinstance(message, packets.Bye):
                self._reason = self._reason or message.reason
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def _send_waiting(self, sock: Socket) -> None:
        """Send the releases of this turn, and what did not fit into the socket before."""
        while self._releases:
            self._unsent.append(self._releases.popleft())
        try:
            while self._unsent:
                # It stays in the queue until it is sent, so that nothing that comes later overtakes it.
                sock.send(self._unsent[0], SEND_FLAGS)
                self._unsent.popleft()
        except OSError:
            return


def _descriptors(ancillary: list[tuple[int, int, bytes]]) -> list[int]:
    """The descriptors that came with a packet."""
    descriptors = array.array("i")
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            descriptors.frombytes(data[: len(data) - len(data) % descriptors.itemsize])
    return descriptors.tolist()

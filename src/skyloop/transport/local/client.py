"""An application's end of the local transport, and its read-only views of the server's frame slots."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import numpy as np

from skyloop.child_process import leave_to_parent
from skyloop.errors import DecodeError, LinkError
from skyloop.messages.codec import HEADER_SIZE, MAX_BODY
from skyloop.transport.base import MAX_PACKET, ClientHandler, Pixels, TransportClient, check_packet, check_topic
from skyloop.transport.local import packets
from skyloop.transport.local.named_memory import map_named
from skyloop.transport.local.packets import OWN
from skyloop.transport.local.system import SEND_FLAGS, PacketSocket

_MAX_RECEIVED: Final = HEADER_SIZE + MAX_BODY + 256  # a frame's packet is slightly larger than its header's packet
_RETRY_S: Final = 0.25  # interval between retries for packets that did not fit into a full socket
_CHECK_S: Final = 0.05  # interval at which a leading thread checks whether its wait is over if nothing arrives
_STAND_BY_S: Final = 0.002  # how long no other thread receives after the leading thread has returned with its sample
_MAX_CAPACITY: Final = 1 << 31  # maximum memory that a client maps for a server
_log = logging.getLogger(__name__)


class LocalClient(TransportClient):
    """An application's end, made by the dialer from :func:`skyloop.transport.local.dial`. It receives at once."""

    # The thread that holds ``_turn`` receives and delivers. It is either the receiving thread or an application's
    # thread that waits for a sample and *leads* meanwhile, so that the sample wakes only that thread. Handing the
    # packet to another thread takes a second wake-up, which costs as much as the whole path from the proxy. While a
    # thread leads, the receiving thread stands by. It takes over once no thread has received for two milliseconds.

    def __init__(self, sock: PacketSocket, name: str, handler: ClientHandler) -> None:
        self._address = f"local:{name} (pid {sock.who.pid})"
        sock.limit_backlog()
        sock.limit_wait(_RETRY_S)
        self._socket: PacketSocket | None = sock
        self._handler = handler
        self._unsent: deque[bytes] = deque()  # the transport's own packets that did not fit, in order
        self._leases = Leases(self._release)
        self._closing = False
        self._reason = ""
        self._turn = threading.Lock()
        self._receiver = 0  # identity of the thread that holds ``_turn``
        self._ended = ""  # readable reason why receiving has ended; empty while it continues
        self._candidate: Callable[[], None] | None = None  # wakes a thread that is ready to start receiving
        self._releases: deque[bytes] = deque()  # packets that release frames that were dropped during a delivery
        self._send_own(packets.hello())
        self._thread = threading.Thread(target=self._run, args=(sock,), name=f"skyloop-{name}-client", daemon=True)
        self._thread.start()
        leave_to_parent(self)

    def forked(self) -> None:
        """Close a forked child's copy of the connection. A shutdown would also end the parent's connection."""
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
            self._candidate = wake  # the receiving thread yields after the next packet
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
        """End the connection. Idempotent. The receiving thread does the rest."""
        sock = self._socket
        if sock is not None and not self._closing:
            self._reason = reason
            self._closing = True
            sock.hang_up(packets.bye(reason))

    def _release(self, slot: int) -> None:
        packet = packets.release(slot)
        if self._receiver == threading.get_ident():
            self._releases.append(packet)  # sent after the delivery, because another thread is waiting for that
        else:
            self._send_own(packet)

    def _send_own(self, packet: bytes) -> None:
        """Send one of the transport's own packets, or queue the packet if it does not fit now.

        The garbage collector may call this on any thread at any point, so it must not acquire a lock.
        """
        sock = self._socket
        if sock is None:
            return
        if not self._unsent:
            try:
                sock.send(packet, sock.post_flags)
            except BlockingIOError:
                pass
            except OSError:
                return  # the connection has ended
            else:
                return
        self._unsent.append(packet)

    # --- on the receiving thread ---

    def _run(self, sock: PacketSocket) -> None:
        while not self._ended:
            sock.limit_wait(_RETRY_S)
            with self._turn:
                self._take_turn(sock, lambda: self._candidate is not None)
            wake, self._candidate = self._candidate, None
            if wake is not None and not self._ended:
                sock.limit_wait(_CHECK_S)
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
        """Wait until no thread is receiving for itself."""
        while not self._ended:
            time.sleep(_STAND_BY_S)
            if not self._turn.locked():
                return

    # --- on the thread that has the turn ---

    def _take_turn(self, sock: PacketSocket, over: Callable[[], bool]) -> None:
        """Deliver packets until ``over`` returns True or the connection ends.

        On the application's main thread, an exception raised by a signal handler during the wait propagates from here.
        """
        self._receiver = threading.get_ident()
        try:
            self._ended = self._receive(sock, over)
        finally:
            self._receiver = 0

    def _receive(self, sock: PacketSocket, over: Callable[[], bool]) -> str:
        """Deliver packets until ``over`` returns True or the connection ends. If it ended, return the reason."""
        receive = sock.receiver(_MAX_RECEIVED)
        deliver, deliver_frame = self._handler.packet, self._handler.frame
        while not self._closing:
            if self._releases or self._unsent:
                self._send_waiting(sock)
            try:
                packet, ancillary, _, _ = receive()
            except BlockingIOError:
                if over():
                    return ""
                continue
            except ConnectionResetError:
                continue  # packets sent earlier still arrive, followed by the end
            except OSError as error:
                if error.errno is None:
                    raise  # a signal handler raised this, not the kernel; for example, a TimeoutError
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
                            self._control(sock, packet, ancillary)
                            continue
                        number, header = packets.parse_frame(packet)
                        pixels = self._leases.pixels(number, header.size)
                    except (DecodeError, LinkError, OSError) as error:
                        return f"the proxy violates the protocol: {error}"
                    deliver_frame(header, pixels)
                    del pixels  # otherwise the frame's slot would stay leased until the next packet
                else:
                    deliver(packet)
            except Exception as error:  # noqa: BLE001  (a handler may raise anything)
                _log.exception("the handler of %s failed; its connection ends", self._address)
                return f"the application's handler failed: {error!r}"
            if over():
                return ""
        return self._reason or "closed by the application"

    def _control(self, sock: PacketSocket, packet: bytes, ancillary: Sequence[Any]) -> None:
        """Handle one of the transport's own packets other than a frame, and close the packet's descriptors."""
        descriptors = sock.descriptors(ancillary)
        try:
            message = packets.parse(packet)
            if isinstance(message, packets.Frame):
                raise LinkError(f"a frame arrived with {len(descriptors)} descriptors and must have none")
            if isinstance(message, packets.Slot):
                if len(descriptors) != 1:
                    raise LinkError(f"a slot was announced with {len(descriptors)} descriptors and must have one")
                pixels = sock.map_sealed(descriptors[0], _allowed(message.capacity))
                self._leases.add(message.slot, message.camera, pixels)
            elif isinstance(message, packets.NamedSlot):
                map_it = partial(map_named, message.name, message.slot, _allowed(message.capacity))
                self._leases.announce(message.slot, message.camera, map_it)
            elif isinstance(message, packets.Retire):
                self._leases.retire(message.camera, message.before)
            elif isinstance(message, packets.Bye):
                self._reason = self._reason or message.reason
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def _send_waiting(self, sock: PacketSocket) -> None:
        """Send the releases from this turn, and the packets that did not fit into the socket earlier."""
        while self._releases:
            self._unsent.append(self._releases.popleft())
        try:
            while self._unsent:
                # The packet stays in the queue until it is sent, so that later packets can't overtake it.
                sock.send(self._unsent[0], SEND_FLAGS)
                self._unsent.popleft()
        except OSError:
            return


def _allowed(capacity: int) -> int:
    """Return a slot's capacity [bytes]. Raises :class:`LinkError` for one that is too large."""
    if capacity > _MAX_CAPACITY:
        raise LinkError(f"the proxy offered a slot of {capacity} bytes, but only {_MAX_CAPACITY} bytes are allowed")
    return capacity


class SlotView:
    """One client's view of a slot. The slot is mapped once and is read-only."""

    __slots__ = ("_interface", "camera", "capacity", "held", "number", "pixels")

    def __init__(self, number: int, camera: int, pixels: Pixels, held: set[int]) -> None:
        self.number = number
        self.camera = camera
        self.capacity = pixels.size
        self.held = held  #: numbers of all slots of this camera that the application holds
        self.pixels = pixels
        self._interface = self._describe(pixels.size)

    def interface(self, size: int) -> dict[str, Any]:
        """Return NumPy's description of the first ``size`` bytes. It is cached until the size changes."""
        if self._interface["shape"][0] != size:
            self._interface = self._describe(size)
        return self._interface

    def _describe(self, size: int) -> dict[str, Any]:
        return {"data": (self.pixels.ctypes.data, True), "shape": (size,), "typestr": "|u1", "version": 3}


class Lease:
    """Owns a frame's pixels. As long as any array over the pixels exists, the server does not reuse the slot."""

    __slots__ = ("__array_interface__", "_leases", "_slot")

    def __init__(self, slot: SlotView, size: int, leases: Leases) -> None:
        self._slot = slot
        self._leases = leases
        self.__array_interface__ = slot.interface(size)

    def __del__(self) -> None:
        self._leases.released(self._slot)


class Leases:
    """The slots of one client. The garbage collector may call :meth:`released` on any thread at any point."""

    #: Number of frames per camera that an application may hold in place. Further frames are copied, so that an
    #: application that collects frames does not use up all slots of the server and starve itself.
    IN_PLACE: Final = 3

    def __init__(self, send_release: Callable[[int], None]) -> None:
        self._send_release = send_release
        self._slots: dict[int, SlotView] = {}
        self._unmapped: dict[int, tuple[int, Callable[[], Pixels]]] = {}
        self._held: dict[int, set[int]] = {}

    def add(self, number: int, camera: int, pixels: Pixels) -> None:
        """Add a slot that the server announced, as mapped."""
        self._slots[number] = SlotView(number, camera, pixels, self._held.setdefault(camera, set()))

    def announce(self, number: int, camera: int, map_it: Callable[[], Pixels]) -> None:
        """Add a slot that is mapped with its first frame. Until then, the server may free memory that has a name."""
        self._unmapped[number] = camera, map_it

    def retire(self, camera: int, before: int) -> None:
        """Forget a camera's slots with numbers below ``before``."""
        for slot in list(self._slots.values()):
            if slot.camera == camera and slot.number < before:
                del self._slots[slot.number]
        for number, (its_camera, _) in list(self._unmapped.items()):
            if its_camera == camera and number < before:
                del self._unmapped[number]

    def end(self) -> None:
        """Forget all slots at the end of the connection. Frames that the application still holds stay valid.

        Those frames refer to this object, and the garbage collector does not search arrays for cycles. A reference from
        here to the client, its handler and the frames that it stores would therefore keep all of them alive forever.
        """
        self._slots.clear()
        self._unmapped.clear()
        self._send_release = lambda _: None

    def pixels(self, number: int, size: int) -> Pixels:
        """Return a slot's frame: in place, or as a copy if the application already holds :attr:`IN_PLACE` frames."""
        if number in self._unmapped:
            camera, map_it = self._unmapped.pop(number)
            self.add(number, camera, map_it())
        slot = self._slots.get(number)
        if slot is None or not 0 <= size <= slot.capacity:
            raise LinkError(f"the proxy sent a frame of {size} bytes in slot {number}, which it has not announced")
        if len(slot.held) >= self.IN_PLACE:
            copy = slot.pixels[:size].copy()
            copy.flags.writeable = False
            self._send_release(number)
            return copy
        slot.held.add(number)
        return np.asarray(Lease(slot, size, self))

    def released(self, slot: SlotView) -> None:
        """Return a slot to the server, now that the application's last array backed by it is gone."""
        slot.held.discard(slot.number)
        self._send_release(slot.number)

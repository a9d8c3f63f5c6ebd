"""One application's connection, as the server keeps it."""

from __future__ import annotations

import array
import socket
from typing import Final

from skyloop.transport.base import Peer
from skyloop.transport.local import packets
from skyloop.transport.local.sockets import SEND_FLAGS, Socket

MAX_SUBSCRIPTIONS: Final = 64


class ServerConnection:
    """Sends from any thread without waiting; everything else belongs to its receiving thread."""

    __slots__ = ("_send", "_socket", "ending", "joined", "peer", "reason", "receive", "topics")

    def __init__(self, sock: Socket, peer: Peer) -> None:
        sock.limit_backlog()
        self._socket = sock
        self._send = sock.send
        self.receive = sock.recv
        self.peer = peer
        self.joined = False  #: it said hello, and the handler knows of it
        self.ending = False  #: by the server: what it sent before is not wanted any more
        self.reason = ""  #: why it ends, as soon as one end has said so
        self.topics: set[str] = set()

    def transmit(self, packet: bytes) -> None:
        """Send. Raises ``OSError`` if its buffer is full or it is gone."""
        self._send(packet, SEND_FLAGS)

    def transmit_descriptor(self, packet: bytes, descriptor: int) -> None:
        """The same, with a descriptor."""
        rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", (descriptor,)))
        self._socket.sendmsg((packet,), (rights,), SEND_FLAGS)

    def hang_up(self, reason: str) -> None:
        """End it and tell the application why; the receiving thread hears of it as of any end. Any thread."""
        if not self.ending:
            self.reason = self.reason or reason
            self.ending = True
            self._socket.hang_up(packets.bye(self.reason))

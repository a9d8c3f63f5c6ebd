"""An application's connection at the server."""

from __future__ import annotations

import array
import select
import socket

from skyloop.transport.base import MAX_PACKET, Peer
from skyloop.transport.local import packets
from skyloop.transport.local.sockets import RECEIVE_FLAGS, SEND_FLAGS, Credentials, Socket, set_timeout
from skyloop.transport.priority import MOST_PACKETS, Backlog


class ServerConnection:
    """An application's connection: any thread may send without waiting, all else belongs to its receiving thread.

    Args:
        sock: Accepted from the listener.
        peer: As the handler knows it.
        who: The process at the other end, as the kernel reports it.
    """

    __slots__ = (
        "_send",
        "_socket",
        "admitted",
        "backlog",
        "ending",
        "joined",
        "peer",
        "pilot",
        "poll",
        "reason",
        "receive",
        "topics",
        "who",
    )

    def __init__(self, sock: Socket, peer: Peer, who: Credentials) -> None:
        sock.limit_backlog()
        self.who = who  #: as the kernel reports it
        self._socket = sock
        self._send = sock.send
        self.receive = sock.recv
        poll = select.poll()
        poll.register(sock, select.POLLIN)
        self.poll = poll.poll  #: whether a packet, or the end, waits in the socket; for the receiving thread
        self.backlog = Backlog()  #: taken out of the socket, and not handled yet
        self.peer = peer
        self.joined = False  #: it sent Hello, and the handler knows of it
        self.admitted = False  #: it sent who it is, and the handler let it stay
        self.pilot = False  #: it stated that it is one
        self.ending = False  #: by the server: what it sent before is not wanted any more
        self.reason = ""  #: why it ends, as soon as one end has given a reason
        self.topics: set[str] = set()

    def fileno(self) -> int:
        """Return the socket's descriptor, for who waits for several."""
        return self._socket.fileno()

    def more(self) -> bool:
        """Return whether a packet of a pilot, or the end, waits in the socket; others' commands are refused anyway."""
        return self.pilot and bool(self.poll(0))

    def take_in(self) -> int:
        """Take what waits in the socket into the backlog; return how many commands that superseded."""
        superseded = 0
        backlog = self.backlog
        for _ in range(MOST_PACKETS):
            if backlog.full or not self.more():
                break
            try:
                packet = self.receive(MAX_PACKET + 1, RECEIVE_FLAGS)
            except OSError:
                break  # who waits for the next packet gets it, too
            if packet == packets.WAKE:
                continue
            superseded += backlog.put(packet)
            if not packet:
                break  # the end
        return superseded

    def limit_silence(self, seconds: float) -> None:
        """Set how long :attr:`receive` waits for a packet before it raises ``BlockingIOError``.

        Args:
            seconds: The limit [s]; 0 waits for ever.
        """
        set_timeout(self._socket, socket.SO_RCVTIMEO, seconds)

    def transmit(self, packet: bytes) -> None:
        """Send a packet without waiting. Any thread.

        Raises:
            OSError: The application's buffer is full, or the application is gone.
        """
        self._send(packet, SEND_FLAGS)

    def transmit_descriptor(self, packet: bytes, descriptor: int) -> None:
        """Send a packet with a file descriptor, without waiting. Any thread.

        Raises:
            OSError: The application's buffer is full, or the application is gone.
        """
        rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", (descriptor,)))
        self._socket.sendmsg((packet,), (rights,), SEND_FLAGS)

    def hang_up(self, reason: str) -> None:
        """End the connection and send the reason to the application. Any thread.

        The receiving thread detects the end as it does any other.
        """
        if not self.ending:
            self.reason = self.reason or reason
            self.ending = True
            self._socket.hang_up(packets.bye(self.reason))

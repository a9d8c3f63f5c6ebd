"""A TCP port of the drone that serves one client at a time, as a serial port behind it would."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Final

from skyloop.vehicles.emulation.datagrams import Address, bound
from skyloop.vehicles.emulation.loop import Loop

_BUFFER: Final = 1 << 16


class ByteServer:
    """Takes the next client when the last one is gone: until then it waits in the kernel, connected and unanswered.

    Used on the loop's thread.

    Args:
        loop: Calls back when something comes.
        bind: Address and port of this machine; port 0 is any free one.
        on_bytes: Called with what came.
        on_client: Called when another client begins.
        name: For errors.

    Raises:
        LinkError: The port is taken.
    """

    def __init__(
        self,
        loop: Loop,
        bind: Address,
        on_bytes: Callable[[bytes], None],
        on_client: Callable[[], None],
        *,
        name: str,
    ) -> None:
        self._loop = loop
        self._on_bytes = on_bytes
        self._on_client = on_client
        self._client: socket.socket | None = None
        self._server = bound(socket.SOCK_STREAM, bind, name)
        self._server.listen(4)
        loop.watch(self._server, self._accept)

    @property
    def port(self) -> int:
        """The real port, where 0 was asked for."""
        return int(self._server.getsockname()[1])

    def send(self, data: bytes) -> None:
        """Send to the client, if there is one; what does not fit is lost, as on a serial line.

        Raises:
            OSError: The client is gone.
        """
        if self._client is None:
            return
        try:
            self._client.send(data)
        except BlockingIOError:
            return
        except OSError:
            self.drop()
            raise

    def close(self) -> None:
        """Close the server and the connection."""
        self._loop.forget(self._server)
        self._server.close()
        if self._client is not None:
            self._loop.forget(self._client)
            self._client.close()

    def drop(self) -> None:
        """End the client's connection."""
        if self._client is not None:
            self._loop.forget(self._client)
            self._client.close()
            self._client = None
            self._loop.watch(self._server, self._accept)

    def _accept(self) -> None:
        self._client, _ = self._server.accept()
        self._client.setblocking(False)
        self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._loop.forget(self._server)
        self._loop.watch(self._client, self._receive)
        self._on_client()

    def _receive(self) -> None:
        assert self._client is not None
        try:
            data = self._client.recv(_BUFFER)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.drop()
            return
        self._on_bytes(data)

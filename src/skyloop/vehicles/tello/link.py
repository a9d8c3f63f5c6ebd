"""One drone's sockets: one for commands and their replies, one for state."""

from __future__ import annotations

import errno
import socket
import sys
from collections.abc import Callable
from functools import partial
from typing import Final

from skyloop.clock import Clock, monotonic_ns
from skyloop.drivers.vehicle_link import VehicleLink
from skyloop.drivers.vehicle_session import SinkCallback
from skyloop.messages import AnyAction
from skyloop.vehicles.tello.options import TelloOptions
from skyloop.vehicles.tello.protocol import TelloSession

_BUFFER: Final = 1 << 20  # requested size of receive buffers [bytes]; enough for half a second of video


def command_socket(options: TelloOptions, address: str) -> socket.socket:
    """Return a socket that sends commands and receives replies only from the drone's port."""
    made = _through(options)
    try:
        made.bind((options.local or "", 0))
        made.connect((address, options.port))
    except OSError:
        made.close()
        raise
    return made


def receiving_socket(options: TelloOptions, local: str, port: int) -> socket.socket:
    """Return a socket bound to a local UDP port. It receives from any sender, so the caller must check the sender."""
    made = _through(options)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        made.bind((local, port))
    except OSError as error:
        made.close()
        if error.errno == errno.EADDRINUSE:
            raise OSError(
                error.errno,
                f"UDP port {port} on {local} is in use: stop the other program, or see docs/tello.md for more drones",
            ) from error
        raise
    return made


def _through(options: TelloOptions) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setblocking(False)
    if options.interface is not None:
        try:
            if sys.platform != "linux":
                raise OSError(errno.ENOTSUP, "needs Linux; elsewhere, give local=ADDRESS")
            made.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, options.interface.encode() + b"\0")
        except OSError as error:
            made.close()
            raise OSError(error.errno, f"interface {options.interface}: {error.strerror}") from error
    return made


ASK_S: Final = 0.95  #: time limit for the reply to a command; the session gives up after three tries of 0.3 s


class TelloLink(VehicleLink[TelloSession]):
    """The link to one drone: commands, their replies, and state."""

    def __init__(
        self, session: TelloSession, deliver: Callable[[list[SinkCallback]], None], clock: Clock = monotonic_ns
    ) -> None:
        super().__init__("skyloop-tello", session, deliver, clock)
        self.addresses: tuple[str, str] | None = None  #: addresses of the drone, and of this host on the route to it
        self._commands: socket.socket | None = None
        self._states: socket.socket | None = None

    # From the proxy's threads ----------------------------------------------------------------------------------

    def command(self, action: AnyAction, *, new: bool = True) -> AnyAction:
        """Pass an action to the session; see :meth:`TelloSession.command`. May be called from any thread."""
        return self._decide(partial(self.session.command, action, new=new))

    def ask(self, text: str) -> str | None:
        """Send a command and wait up to 0.95 s for the reply; None if there is none. Not for the link's own thread."""
        return self._wait_for_answer(partial(self.session.ask, text), ASK_S, None)

    # On the link's thread --------------------------------------------------------------------------------------

    def _open_sockets(self) -> None:
        options = self.session.options
        with self.lock:
            self._close_sockets()  # done first, because the new socket for state needs the same port
        address = self._lookup.address(options.host)
        commands = command_socket(options, address)
        local = str(commands.getsockname()[0])
        try:
            states = receiving_socket(options, local, options.state_port)
        except OSError:
            commands.close()
            raise
        with self.lock:
            self._commands, self._states = commands, states
            self.addresses = address, local
            self.session.local = local
        self._watch(commands, lambda: self._read_datagrams(commands, self.session.on_reply, address))
        self._watch(states, lambda: self._read_datagrams(states, self.session.on_state, address))

    def _close_sockets(self) -> None:
        for port in (self._commands, self._states):
            if port is not None:
                self._forget(port)
        self._commands = self._states = None

    def _send_due(self, now_ns: int) -> None:
        for datagram in self.session.poll(now_ns):
            if self._commands is not None:
                self._send_datagram(self._commands, datagram)

"""The sockets of one drone and the thread that serves them: commands at their pace, answers, state."""

from __future__ import annotations

import selectors
import socket
from collections.abc import Callable
from functools import partial
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.drivers.tello.session import Session
from skyloop.drivers.tello.sockets import MAX_DATAGRAM, address_of, at, towards
from skyloop.drivers.vehicle_link import VehicleLink
from skyloop.drivers.vehicle_session import Telling
from skyloop.messages import AnyAction

BURST: Final = 32  #: datagrams that are read before commands get their turn
ASK_S: Final = 0.95  #: a command is answered within this, or it failed
RENEW_NS: Final = nanoseconds(2.0)  #: pace of new sockets while nothing is heard: this host's address may have changed


class Link(VehicleLink[Session]):
    """As :class:`VehicleLink`."""

    def __init__(self, session: Session, deliver: Callable[[list[Telling]], None], clock: Clock = monotonic_ns) -> None:
        super().__init__("skyloop-tello", session, deliver, clock)
        self.addresses: tuple[str, str] | None = None  #: the drone's, and this host's towards it
        self._commands: socket.socket | None = None
        self._states: socket.socket | None = None
        self._renewed_ns = -RENEW_NS

    # From the proxy's threads ----------------------------------------------------------------------------------

    def command(self, action: AnyAction) -> AnyAction:
        """Decide, and say it at once unless the last ``rc`` was just sent."""
        return self._decided(partial(self.session.command, action))

    def ask(self, text: str) -> str | None:
        """Say a command and wait for its answer; None if none came. Takes up to 0.95 s."""
        return self._answer(partial(self.session.ask, text), ASK_S, None)

    # On the link's thread --------------------------------------------------------------------------------------

    def _release(self) -> None:
        with self.lock:
            self._close_sockets()

    def _receive(self, ready: object) -> None:
        commands, states = self._commands, self._states
        if commands is not None and ready is commands:
            self._read(commands, self.session.reply_heard)
        elif states is not None and ready is states:
            self._read(states, self.session.state_heard)

    def _read(self, port: socket.socket, heard: Callable[[bytes, int], None]) -> None:
        for _ in range(BURST):
            try:
                datagram, sender = port.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError as error:
                with self.lock:
                    self.session.unreachable(error.strerror or str(error))
                return
            if self.addresses is not None and sender[0] == self.addresses[0]:
                with self.lock:
                    heard(datagram, self._clock())

    def _say(self, now_ns: int) -> None:
        for datagram in self.session.tick(now_ns):
            if self._commands is None:
                return
            try:
                self._commands.send(datagram)
            except BlockingIOError:
                pass  # lost, like any datagram may be
            except OSError as error:
                self.session.unreachable(error.strerror or str(error))

    # Sockets ---------------------------------------------------------------------------------------------------

    def _renew(self) -> None:
        """Make them, and make them anew now and then while the drone is not heard."""
        now_ns = self._clock()
        with self.lock:
            if self.session.is_heard or now_ns - self._renewed_ns < RENEW_NS:
                return
            self._renewed_ns = now_ns
            self._close_sockets()
            try:
                self._open_sockets()
            except OSError as error:
                self._close_sockets()
                self.session.unreachable(error.strerror or str(error))

    def _open_sockets(self) -> None:
        options = self.session.options
        address = address_of(options)
        self._commands = towards(options, address)
        self._selector.register(self._commands, selectors.EVENT_READ)
        local = str(self._commands.getsockname()[0])
        self._states = at(options, local, options.state_port)
        self._selector.register(self._states, selectors.EVENT_READ)
        self.addresses = address, local

    def _close_sockets(self) -> None:
        for port in (self._commands, self._states):
            if port is not None:
                self._selector.unregister(port)
                port.close()
        self._commands = self._states = None

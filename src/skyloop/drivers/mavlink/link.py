"""The connection to one vehicle and the thread that serves it, made anew for ever when it is lost."""

from __future__ import annotations

import selectors
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.drivers.mavlink.connections import Connection, connect
from skyloop.drivers.mavlink.session import Session
from skyloop.drivers.vehicle_link import VehicleLink
from skyloop.drivers.vehicle_session import Telling
from skyloop.messages import AnyAction
from skyloop.wire.mavlink.codec import Message

RETRY_NS: Final = nanoseconds(1.0)  #: pace of new connections
SILENT_NS: Final = nanoseconds(8.0)  #: a connected stream without a word for so long is made anew
WRITE_S: Final = 0.9  #: a parameter is written and confirmed within this, or it failed
_CLOSE_S: Final = 3.0


class Link(VehicleLink[Session]):
    """As :class:`VehicleLink`."""

    def __init__(self, session: Session, deliver: Callable[[list[Telling]], None], clock: Clock = monotonic_ns) -> None:
        super().__init__("skyloop-mavlink", session, deliver, clock, close_s=_CLOSE_S)
        self._connection: Connection | None = None
        self._connected_ns = -RETRY_NS
        self._broken = False  # nothing can be sent any more

    # From the proxy's threads ------------------------------------------------------------------------------------

    def command(self, action: AnyAction, *, alone: bool = False) -> AnyAction:
        """Decide, and say it at once."""
        return self._decided(partial(self.session.command, action, alone=alone))

    def say(self, message: Message) -> None:
        """Send a message to the vehicle now."""
        with self.lock:
            self.session.say(message)
            self._say(self._clock())

    def write(self, name: str, value: float) -> str | None:
        """Write a parameter by the autopilot's name. Returns why that failed, or None. Takes up to 0.9 s."""

        def ask(end: Callable[[str | None], None]) -> None:
            now_ns = self._clock()
            self.session.parameters.write(name, value, now_ns + nanoseconds(WRITE_S), end)
            self._say(now_ns)

        return self._answer(ask, WRITE_S + 0.2, "the driver did not get to it")

    # On the link's thread ----------------------------------------------------------------------------------------

    def _release(self) -> None:
        with self.lock:
            self._disconnect()

    def _receive(self, _ready: object) -> None:
        connection = self._connection
        if connection is None:
            return
        try:
            came = connection.receive()
        except OSError as error:
            self._drop(error)
            return
        now_ns = self._clock()
        with self.lock:
            for data, peer in came:
                self.session.heard(data, peer, now_ns, whole=connection.whole)

    def _say(self, now_ns: int) -> None:
        """With the lock held, on any thread."""
        packets = self.session.tick(now_ns)
        connection = self._connection
        if connection is None:
            return
        try:
            for data, peer in packets:
                connection.send(data, peer)
        except OSError as error:
            self.session.unreachable(_reason(error))
            self._broken = not connection.whole

    # The connection ----------------------------------------------------------------------------------------------

    def _renew(self) -> None:
        """Make it, and make a stream anew on which nothing comes."""
        now_ns = self._clock()
        connection = self._connection
        if connection is not None:
            with self.lock:
                silent = not self.session.is_heard and not connection.whole
            if not self._broken and (not silent or now_ns - self._connected_ns < SILENT_NS):
                return
        elif now_ns - self._connected_ns < RETRY_NS:
            return
        self._connected_ns = now_ns
        with self.lock:
            self._disconnect()
        try:
            made = connect(self.session.options.address)
        except OSError as error:
            with self.lock:
                self.session.unreachable(_reason(error))
            return
        with self.lock:
            self._connection = made
            self.session.connected()
        self._selector.register(made, selectors.EVENT_READ)

    def _drop(self, error: OSError) -> None:
        with self.lock:
            self.session.unreachable(_reason(error))
            self._disconnect()

    def _disconnect(self) -> None:
        self._broken = False
        if self._connection is not None:
            with suppress(KeyError, ValueError):
                self._selector.unregister(self._connection)
            self._connection.close()
            self._connection = None


def _reason(error: OSError) -> str:
    return error.strerror or str(error)

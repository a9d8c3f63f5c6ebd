"""One vehicle's socket, over UDP or to a Crazyradio's thread, and the thread that serves it."""

from __future__ import annotations

import socket
from collections.abc import Callable
from functools import partial
from typing import Final

from skyloop.clock import Clock, monotonic_ns
from skyloop.drivers.base import ExternalPose, ServedLink
from skyloop.drivers.vehicle_link import VehicleLink
from skyloop.drivers.vehicle_session import SinkCallback
from skyloop.messages import AnyAction
from skyloop.vehicles.crazyflie import radio
from skyloop.vehicles.crazyflie.options import LinkKind
from skyloop.vehicles.crazyflie.protocol import CrazyflieSession
from skyloop.vehicles.crazyflie.wire.crtp import CrtpPacket

ASK_S: Final = 0.95  #: time limit for the answer to the write of a parameter


class CrazyflieLink(VehicleLink[CrazyflieSession]):
    """The link to one vehicle over UDP or a Crazyradio."""

    def __init__(
        self,
        session: CrazyflieSession,
        deliver: Callable[[list[SinkCallback]], None],
        clock: Clock = monotonic_ns,
        *,
        serve: Callable[[ServedLink], None] | None = None,
    ) -> None:
        super().__init__("skyloop-crazyflie", session, deliver, clock, family=socket.AF_UNSPEC, serve=serve)
        self._socket: socket.socket | None = None
        self._lease: radio.RadioLease | None = None  # of a Crazyradio

    # From the proxy's threads ------------------------------------------------------------------------------------

    def command(self, action: AnyAction, *, new: bool = True) -> AnyAction:
        """Pass an action to :meth:`CrazyflieSession.command`. May be called from any thread."""
        return self._decide(partial(self.session.command, action, new=new))

    def send_pose(self, pose: ExternalPose) -> None:
        """Send an external pose now. May be called from any thread."""
        with self.lock:
            now_ns = self._clock()
            self.session.send_pose(pose, now_ns)
            self._send_due(now_ns)

    def ask(self, ask: Callable[[Callable[[CrtpPacket | None], None]], None]) -> CrtpPacket | None:
        """Send a request, and wait up to 0.95 s for its answer; None if there is none. Not for the link's thread.

        ``ask`` is called with the lock held, and gets the function to call with the answer.
        """
        answers: list[CrtpPacket | None] = []

        def begin(end: Callable[[str | None], None]) -> None:
            def done(answer: CrtpPacket | None) -> None:
                answers.append(answer)
                end(None)

            ask(done)

        self._wait_for_answer(begin, ASK_S, None)
        return answers[0] if answers else None

    # On the link's thread ----------------------------------------------------------------------------------------

    def _open_sockets(self) -> None:
        options = self.session.options
        with self.lock:
            self._close_sockets()
        if options.kind is LinkKind.RADIO:
            leased = radio.lease(options.radio)
            with self.lock:
                self._lease, self._socket = leased, leased.socket
            self._watch(leased.socket, lambda: self._read_datagrams(leased.socket, self.session.on_datagram))
            return
        host = self._lookup.address(options.host)
        made = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            made.setblocking(False)
            made.connect((host, options.port))
        except OSError:
            made.close()
            raise
        with self.lock:
            self._socket = made
        self._watch(made, lambda: self._read_datagrams(made, self.session.on_datagram))

    def _close_sockets(self) -> None:
        if self._socket is not None:
            self._forget(self._socket)
        if self._lease is not None:
            self._lease.close()
        self._socket = self._lease = None

    def _send_due(self, now_ns: int) -> None:
        for datagram in self.session.poll(now_ns):
            if self._socket is not None:
                self._send_datagram(self._socket, datagram)

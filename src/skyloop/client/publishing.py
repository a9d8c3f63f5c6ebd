"""Membership of this application in the workers of a processor: its share of the frames, and its results."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from skyloop.errors import LinkError, NameTakenError, RefusedError, SkyloopError
from skyloop.messages import (
    AnyReply,
    JoinProcessor,
    ProcessorResult,
    ProcessorShare,
    Refusal,
    Refused,
    Welcome,
    encode,
)
from skyloop.messages.payload import pack

if TYPE_CHECKING:
    from skyloop.client.connection import ProxyConnection
    from skyloop.client.frame import Frame
    from skyloop.client.telemetry import ClientState

RENEW_S: Final = 0.25  #: how often the membership is renewed [s]; a worker counts as silent after a second


class Membership:
    """One worker of a processor; made by :func:`skyloop.extend.join_processor`.

    Ends with :meth:`close`, and with the drone. The proxy forgets a worker when its connection ends; after a
    reconnection it joins again by itself.
    """

    def __init__(
        self,
        connection: ProxyConnection,
        state: ClientState,
        processor: str,
        code: str,
        find: Callable[[], str],
        *,
        shared: bool,
    ) -> None:
        """Prepare to join; :meth:`start` does it.

        Args:
            connection: Sends requests and results.
            state: Publishes shares and new connections.
            processor: Name of the processor.
            code: Identifies the code that runs, the same for all workers.
            find: Returns the name of the camera, also once the proxy was started again with other ones.
            shared: Each frame goes to one of the workers; if False, each worker gets all.
        """
        self.processor = processor
        self.camera = find()
        self._find = find
        self.code = code
        self.shared = shared
        #: Called at each renewal: whether this worker can take frames now; False gives its share to the others.
        self.ready: Callable[[], bool] = _always
        #: The newest share; None while it is not known. Set on the receiving thread.
        self.share: ProcessorShare | None = None
        #: Called with the share when it has changed, on the receiving thread.
        self.changed: Callable[[ProcessorShare], None] | None = None
        self.refused: SkyloopError | None = None  #: why it is a worker no longer
        self._connection = connection
        self._state = state
        self._wake = threading.Event()
        self._ended = False
        self._take_share, self._take_welcome = self._shared_out, self._welcomed
        self._thread = threading.Thread(target=self._run, name=f"skyloop-{processor}", daemon=True)

    def start(self, timeout_s: float) -> None:
        """Join, and renew the membership from then on, on a thread of its own.

        Args:
            timeout_s: How long to wait for the proxy's answer [s].

        Raises:
            NameTakenError: If another application runs other code under this name.
            RefusedError: If the proxy refuses for another reason.
            LinkError: If the proxy does not answer, or the drone is closed.
        """
        self._state.on_share.add(self._take_share, lambda: 0)
        self._state.on_welcome.add(self._take_welcome, lambda: 0)
        try:
            answer = self._connection.call(self._asked, timeout_s)
            if isinstance(answer, Refused):
                raise _error(answer)
        except BaseException:
            self._leave()
            raise
        self._thread.start()

    def renew(self) -> None:
        """Tell the proxy now, for example because :attr:`ready` has changed. Any thread."""
        self._wake.set()

    def publish(self, frame: Frame, value: Any, took_s: float = 0.0) -> bool:
        """Publish what was found in a frame.

        Args:
            frame: The frame.
            value: What was found; see :func:`skyloop.messages.payload.pack` for what can be sent.
            took_s: How long it took [s].

        Returns:
            Whether it was handed to the transport.

        Raises:
            UsageError: If the value can't be sent.
        """
        payload = pack(value)
        result = ProcessorResult(
            self.processor,
            frame.camera,
            frame.seq,
            frame.captured_ns,
            self._state.scheduler.clock() + self._connection.offset_ns,
            round(took_s * 1e9),
            self._state.results.next_number(self.processor),
            payload,
        )
        return self._connection.transmit(encode(result))

    def close(self) -> None:
        """End the membership. Idempotent.

        The proxy gives its share to the other workers when nothing more comes, or at once when the drone is closed.
        """
        self._leave()
        self._ended = True
        self._wake.set()
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _leave(self) -> None:
        self._state.on_share.remove(self._take_share)
        self._state.on_welcome.remove(self._take_welcome)
        self.share = None

    def _asked(self) -> JoinProcessor:
        return JoinProcessor(self.processor, self.code, self.camera, self.shared, self.ready())

    def _run(self) -> None:
        while not self._ended and self.refused is None:
            self._wake.wait(RENEW_S)
            self._wake.clear()
            if not self._ended:
                self._connection.ask(self._asked(), self._answered)

    def _answered(self, answer: AnyReply | LinkError) -> None:
        if isinstance(answer, Refused):
            self.refused = _error(answer)
            self.share = None

    def _shared_out(self, share: ProcessorShare) -> None:
        if (share.processor, share.camera) == (self.processor, self.camera):
            before, self.share = self.share, share
            if share != before and self.changed is not None:
                self.changed(share)

    def _welcomed(self, welcome: Welcome) -> None:  # noqa: ARG002  (as a topic calls it)
        self.share = None
        with suppress(SkyloopError):  # no such camera, which the proxy's answer says, too
            self.camera = self._find()
        self._wake.set()


def _error(refused: Refused) -> SkyloopError:
    if refused.code is Refusal.NAME_TAKEN:
        return NameTakenError(refused.message)
    return RefusedError(refused.message, code=refused.code.value)


def _always() -> bool:
    return True

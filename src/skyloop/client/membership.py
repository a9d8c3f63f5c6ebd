"""This application as a worker of a processor: its share of the frames, kept up, and the way for what it finds."""

from __future__ import annotations

import threading
from collections.abc import Callable
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
    from skyloop.client.frame import Frame
    from skyloop.client.link import Link
    from skyloop.client.reception import Reception

RENEW_S: Final = 0.25  #: how often the proxy is told that this worker works; it counts as silent after a second


class Membership:
    """Made by :meth:`skyloop.client.Drone.join_processor`; ends with :meth:`close`, and with the drone.

    The proxy forgets a worker when its connection ends: a lost one joins again by itself.
    """

    def __init__(
        self, link: Link, reception: Reception, processor: str, code: str, camera: str, *, shared: bool
    ) -> None:
        self.processor = processor
        self.camera = camera
        self.code = code
        self.shared = shared
        #: Asked at each renewal: whether this worker can take frames now; False gives its share to the others.
        self.ready: Callable[[], bool] = _always
        #: The share as told last; None while it is not known. Replaced on the receiving thread.
        self.share: ProcessorShare | None = None
        #: Called with the share when it has changed, on the receiving thread.
        self.changed: Callable[[ProcessorShare], None] | None = None
        self.refused: SkyloopError | None = None  #: why it is a worker no longer
        self._link = link
        self._reception = reception
        self._wake = threading.Event()
        self._ended = False
        self._take_share, self._take_welcome = self._shared_out, self._welcomed
        self._thread = threading.Thread(target=self._run, name=f"skyloop-{processor}", daemon=True)

    def start(self, timeout_s: float) -> None:
        """Join, and stay. Raises :class:`NameTakenError`, :class:`RefusedError`, :class:`LinkError`."""
        self._reception.on_share.add(self._take_share, lambda: 0)
        self._reception.on_welcome.add(self._take_welcome, lambda: 0)
        try:
            answer = self._link.call(self._asked, timeout_s)
            if isinstance(answer, Refused):
                raise _error(answer)
        except BaseException:
            self._leave()
            raise
        self._thread.start()

    def renew(self) -> None:
        """Tell the proxy now, as when :attr:`ready` has changed. Any thread."""
        self._wake.set()

    def publish(self, frame: Frame, value: Any, took_s: float = 0.0) -> bool:
        """Send what was found in a frame; False if it could not be handed over.

        Raises :class:`UsageError` for what can't be sent: see :func:`skyloop.messages.payload.pack`.
        """
        payload = pack(value)
        result = ProcessorResult(
            self.processor,
            frame.camera,
            frame.seq,
            frame.captured_ns,
            self._reception.pace.clock() + self._link.offset_ns,
            round(took_s * 1e9),
            self._reception.results.next_number(self.processor),
            payload,
        )
        return self._link.transmit(encode(result))

    def close(self) -> None:
        """Take no part any more; the proxy gives its share to the others when it hears nothing, or at once when the
        drone is closed. Idempotent."""
        self._leave()
        self._ended = True
        self._wake.set()
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _leave(self) -> None:
        self._reception.on_share.remove(self._take_share)
        self._reception.on_welcome.remove(self._take_welcome)
        self.share = None

    def _asked(self) -> JoinProcessor:
        return JoinProcessor(self.processor, self.code, self.camera, self.shared, self.ready())

    def _run(self) -> None:
        while not self._ended and self.refused is None:
            self._wake.wait(RENEW_S)
            self._wake.clear()
            if not self._ended:
                self._link.ask(self._asked(), self._answered)

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
        self._wake.set()


def _error(refused: Refused) -> SkyloopError:
    if refused.code is Refusal.NAME_TAKEN:
        return NameTakenError(refused.message)
    return RefusedError(refused.message, code=refused.code.value)


def _always() -> bool:
    return True

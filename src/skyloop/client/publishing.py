"""Publish an application's log entries, and its results as a worker of a processor."""

from __future__ import annotations

import math
import numbers
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from skyloop.client.channels import checked_name
from skyloop.client.connection import ProxyConnection
from skyloop.client.frame import Frame
from skyloop.errors import LinkError, NameTakenError, RefusedError, SkyloopError, UsageError
from skyloop.messages import (
    AnyReply,
    JoinProcessor,
    LogEntry,
    ProcessorResult,
    ProcessorShare,
    Refusal,
    Refused,
    Severity,
    Welcome,
    encode,
)
from skyloop.messages.fields import LATEST_NS
from skyloop.messages.relayed import MAX_CODE, MAX_DIMENSIONS, MAX_LOG_TEXT, MAX_VALUES, pack

if TYPE_CHECKING:
    from skyloop.client.telemetry import ClientState

RENEW_S: Final = 0.25  #: how often the membership is renewed [s]; without renewal, a worker counts as silent after 1 s


class Logbook:
    """Publishes text, numbers and arrays. Thread-safe; no method blocks.

    Each method returns whether everything was handed to the transport, and raises :class:`UsageError` for values that
    can't be logged. Names of series must have 1 to 64 characters.
    """

    def __init__(self, connection: ProxyConnection, source: str) -> None:
        self._connection = connection
        self._source = source

    def text(self, text: str, *, name: str = "", severity: Severity | str = Severity.INFO) -> bool:
        """Publish a line of text.

        Args:
            text: The text, at most 4096 characters.
            name: Name of the series to which the line belongs, if any.
            severity: Severity of the entry, or its name.
        """
        if name != "":
            _named(name)
        if not isinstance(text, str) or len(text) > MAX_LOG_TEXT:
            raise UsageError(f"only strings of at most {MAX_LOG_TEXT} characters can be logged, got {text!r:.80}")
        try:
            known = Severity(severity)
        except ValueError:
            wanted = ", ".join(one.value for one in Severity)
            raise UsageError(f"severity is {severity!r} and must be one of {wanted}") from None
        return self._send(name, text=text, severity=known)

    def number(self, name: str, value: float) -> bool:
        """Publish one finite value of the series ``name``."""
        return self._send(_named(name), number=_finite(name, value))

    def numbers(self, **values: float) -> bool:
        """Publish one finite value of each of these series: ``drone.log.numbers(range_m=1.2, bearing=0.1)``."""
        known = [(_named(name), _finite(name, value)) for name, value in values.items()]
        return sum(self._send(name, number=value) for name, value in known) == len(known)

    def array(self, name: str, values: ArrayLike, *, at_ns: int | None = None) -> bool:
        """Publish an array as the next sample of the series ``name``.

        Args:
            name: Name of the series.
            values: At most 4096 finite real numbers in up to 8 dimensions.
            at_ns: Time of the measurement, on the proxy's clock [ns]; None: now.
        """
        try:
            array = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError):
            raise UsageError(f"{name} can't be {values!r:.80}: expected an array of real numbers") from None
        if array.size > MAX_VALUES or array.ndim > MAX_DIMENSIONS:
            raise UsageError(
                f"{name} has {array.size} numbers in {array.ndim} dimensions; at most {MAX_VALUES} in {MAX_DIMENSIONS} "
                "can be logged"
            )
        if not np.isfinite(array).all():
            raise UsageError(f"{name} holds numbers that are not finite")
        return self._send(_named(name), at_ns, values=tuple(array.ravel().tolist()), shape=array.shape)

    def _send(self, name: str, at_ns: int | None = None, **fields: Any) -> bool:
        known_ns = self._connection.now_ns if at_ns is None else checked_time(at_ns)
        return self._connection.transmit(encode(LogEntry(self._source, name, known_ns, **fields)))


def checked_time(at_ns: object) -> int:
    """Return ``at_ns`` if it is a valid time on the proxy's clock [ns]; raise :class:`UsageError` otherwise."""
    if not isinstance(at_ns, int) or not -LATEST_NS <= at_ns <= LATEST_NS:
        raise UsageError(
            f"at_ns is {at_ns!r:.80} and must be a time on the proxy's clock, whole ns within ±{LATEST_NS}"
        )
    return at_ns


def _named(name: object) -> str:
    if not isinstance(name, str) or not 1 <= len(name) <= 64:
        raise UsageError(f"the name of a series must have 1 to 64 characters, got {name!r:.80}")
    return name


def _finite(name: str, value: object) -> float:
    if not isinstance(value, numbers.Real) or not math.isfinite(value):
        raise UsageError(f"{name} can't be {value!r:.80}: expected a finite number")
    return float(value)


class Membership:
    """One worker of a processor; created by :func:`skyloop.extend.join_processor`.

    It ends on :meth:`close` or when the drone is closed. The proxy forgets a worker when its connection ends; the
    worker rejoins after a reconnection.
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
        """Prepare to join; :meth:`start` joins. ``find`` returns the camera's name, even after the proxy restarts."""
        connection.check_may_wait()
        if not isinstance(code, str) or len(code) > MAX_CODE:
            raise UsageError(f"code is {code!r:.80} and must be a string of at most {MAX_CODE} characters")
        self.processor = checked_name(processor)
        self.camera = find()
        self._find = find
        self.code = code
        self.shared = shared
        #: Called at each renewal; returns whether this worker can take frames. If not, other workers get the frames.
        self.ready: Callable[[], bool] = lambda: True
        #: This worker's newest share of the frames; None while unknown. It is set on the receiving thread.
        self.share: ProcessorShare | None = None
        #: Called on the receiving thread when this worker's share has changed.
        self.changed: Callable[[ProcessorShare], None] | None = None
        self.refused: SkyloopError | None = None  #: why this application is no longer a worker
        self._connection = connection
        self._state = state
        self._wake = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name=f"skyloop-{processor}", daemon=True)

    def start(self, timeout_s: float) -> None:
        """Join the processor, then renew the membership in a separate thread.

        Raises :class:`NameTakenError` if another application runs other code under this name, :class:`RefusedError` if
        the proxy refuses for another reason, and :class:`LinkError` if it doesn't answer or the drone is closed.
        """
        self._state.on_share.add(self._shared_out, lambda: 0)
        self._state.on_welcome.add(self._welcomed, lambda: 0)
        try:
            answer = self._connection.call(self._asked, timeout_s)
            if isinstance(answer, Refused):
                raise _error(answer)
        except BaseException:
            self._leave()
            raise
        self._thread.start()
        self._state.to_close.append(self.close)

    def renew(self) -> None:
        """Renew immediately, for example because :attr:`ready` has changed. Thread-safe."""
        self._wake.set()

    def publish(self, frame: Frame, value: Any, took_s: float = 0.0) -> bool:
        """Publish the value found in a frame (see :func:`skyloop.messages.relayed.pack`) and the processing time [s].

        Returns whether the result was handed to the transport. Raises :class:`UsageError` if the value can't be sent.
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
        """Leave the group of workers. Idempotent.

        The proxy passes its frames to the other workers once renewals stop, or immediately when the drone is closed.
        """
        self._leave()
        self._ended = True
        self._wake.set()
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _leave(self) -> None:
        self._state.on_share.remove(self._shared_out)
        self._state.on_welcome.remove(self._welcomed)
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

    def _welcomed(self, welcome: Welcome) -> None:  # noqa: ARG002  (signature of the topic's callbacks)
        self.share = None
        with suppress(SkyloopError):  # there is no such camera; the proxy's answer reports this, too
            self.camera = self._find()
        self._wake.set()


def _error(refused: Refused) -> SkyloopError:
    if refused.code is Refusal.NAME_TAKEN:
        return NameTakenError(refused.message)
    return RefusedError(refused.message, code=refused.code.value)

"""Questions to the proxy and the answers to them, matched by number. The time is an argument."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from skyloop.clock import nanoseconds
from skyloop.errors import LinkError, NoAnswerError
from skyloop.messages import AnyReply, AnyRequest, Reply, Request, encode

RETRY_S = 0.3  #: an unanswered question is asked again after this; every one may be answered twice without harm

#: Called once with the answer, or with the reason why there is none.
Done = Callable[[AnyReply | LinkError], None]


@dataclass(slots=True)
class _Pending:
    packet: bytes
    what: str
    done: Done
    deadline_ns: int
    retry_ns: int
    timeout_s: float


class Requests:
    """The questions that are open on one connection."""

    def __init__(self, send: Callable[[bytes], bool]) -> None:
        self._send = send
        self._pending: dict[int, _Pending] = {}
        self._lock = threading.Lock()
        self._last_id = 0
        self._failed: LinkError | None = None

    def ask(self, body: AnyRequest, done: Done, timeout_s: float, now_ns: int) -> None:
        """Ask. ``done`` is called on the receiving thread, or on the one that calls :meth:`tick` or :meth:`fail`."""
        with self._lock:
            failed = self._failed
            if failed is None:
                self._last_id += 1
                number = self._last_id
                packet = encode(Request(number, body))
                self._pending[number] = _Pending(
                    packet,
                    type(body).__name__,
                    done,
                    now_ns + nanoseconds(timeout_s),
                    now_ns + nanoseconds(RETRY_S),
                    timeout_s,
                )
        if failed is not None:
            done(failed)
        else:
            self._send(packet)  # if it can't be handed over now, it is tried again

    def answered(self, reply: Reply) -> bool:
        """An answer came; False if nobody asked (any more)."""
        with self._lock:
            pending = self._pending.pop(reply.id, None)
        if pending is None:
            return False
        pending.done(reply.body)
        return True

    def tick(self, now_ns: int) -> None:
        """Ask again what was not answered, and give up what is overdue."""
        if not self._pending:
            return
        with self._lock:
            overdue = [number for number, pending in self._pending.items() if now_ns >= pending.deadline_ns]
            given_up = [self._pending.pop(number) for number in overdue]
            again = [pending for pending in self._pending.values() if now_ns >= pending.retry_ns]
            for pending in again:
                pending.retry_ns = now_ns + nanoseconds(RETRY_S)
        for pending in again:
            self._send(pending.packet)
        for pending in given_up:
            pending.done(NoAnswerError(f"the proxy did not answer {pending.what} within {pending.timeout_s:g} s"))

    def fail(self, error: LinkError) -> None:
        """The connection is gone: nothing will be answered."""
        with self._lock:
            self._failed = error
            pending, self._pending = list(self._pending.values()), {}
        for one in pending:
            one.done(error)

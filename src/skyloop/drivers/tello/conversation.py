"""Commands that are answered, one at a time, and which answer belongs to which. Pure."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.wire.tello.replies import Shape, answers, is_error, shape_of

PATIENCE_NS: Final = nanoseconds(0.3)  #: real ones answer within 29 ms, over a good link
TRIES: Final = 3
MOTION_NS: Final = nanoseconds(20.0)  #: the latest answer to a take-off or landing that is still expected

#: Takes the answer, or None if there was none.
Done = Callable[[str | None], None]


@dataclass(slots=True)
class Request:
    """A command whose answer is waited for."""

    text: str
    done: Done
    tries: int = TRIES
    sent_ns: int | None = None


class Conversation:
    """Asks one thing at a time. *Motions*, such as a take-off, are said by others, but answered through here, seconds
    later: while one is not, nothing is asked that is answered in the same words.

    ``counts``: ``answered``, ``unanswered`` requests, and ``stray`` replies that belong to nothing.
    """

    def __init__(self) -> None:
        self.counts = Counter(dict.fromkeys(("answered", "unanswered", "stray"), 0))
        self._queue: deque[Request] = deque()
        self._asked: Request | None = None
        self._motions: dict[str, int] = {}  # command and when it was said last

    @property
    def idle(self) -> bool:
        """Nothing is asked or waits for it."""
        return self._asked is None and not self._queue

    def ask(self, request: Request) -> None:
        """To be asked after what waits already."""
        self._queue.append(request)

    def moved(self, text: str, now_ns: int) -> None:
        """A motion was said."""
        self._motions[text] = now_ns

    def abandon(self) -> None:
        """The drone is gone."""
        waiting = [self._asked] if self._asked is not None else []
        waiting += self._queue
        self._queue.clear()
        self._asked = None
        self._motions.clear()
        for request in waiting:
            request.done(None)

    def heard(self, reply: str) -> str | None:
        """A reply. The motion that it answers, if it is one's."""
        asked = self._asked
        plain_error = is_error(reply) and ":" not in reply
        if asked is not None and answers(reply, asked.text) and not (plain_error and self._motions):
            self._asked = None
            self.counts["answered"] += 1
            asked.done(reply)
            return None
        for motion in self._motions:
            if answers(reply, motion):
                del self._motions[motion]
                return motion
        self.counts["stray"] += 1
        return None

    def messages(self, now_ns: int) -> list[str]:
        """What is to be said now."""
        self._motions = {text: at for text, at in self._motions.items() if now_ns - at < MOTION_NS}
        asked = self._asked
        if asked is not None and asked.sent_ns is not None:
            if now_ns - asked.sent_ns < PATIENCE_NS:
                return []
            asked.tries -= 1
            if asked.tries <= 0:
                self._asked = None
                self.counts["unanswered"] += 1
                asked.done(None)
        if self._asked is None:
            self._asked = self._next()
        if self._asked is None:
            return []
        self._asked.sent_ns = now_ns
        return [self._asked.text]

    def _next(self) -> Request | None:
        for request in self._queue:
            if not self._motions or shape_of(request.text) is not Shape.OK:
                self._queue.remove(request)
                return request
        return None

"""The forms in which samples are asked for: a limited number, each with its topic and any number of subscribers."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, Generic, Protocol, TypeVar

from skyloop.clock import Clock, nanoseconds

#: A form that was asked for and has no subscriber keeps its place for so long: its subscription may be under way.
KEEP_NS: Final = nanoseconds(5.0)


class Form(Protocol):
    """What is published on one topic."""

    topic: str
    asked_ns: int  #: when somebody asked for it last


F = TypeVar("F", bound=Form)


class Forms(Generic[F]):
    """The forms that have, or may soon have, subscribers. Any thread.

    Args:
        most: How many there are at a time.
        subscribers: Returns how many a topic has.
        clock: The proxy's clock [ns].
    """

    def __init__(self, most: int, subscribers: Callable[[str], int], clock: Clock) -> None:
        self.known: tuple[F, ...] = ()
        self._most = most
        self._subscribers = subscribers
        self._clock = clock
        self._lock = threading.Lock()  # guards changes of what is known

    def find(self, topic: str) -> F | None:
        """Return the form of a topic; None if nobody has asked for it."""
        return next((form for form in self.known if form.topic == topic), None)

    def claim(self, topic: str, make: Callable[[], F]) -> bool:
        """Give a form a place, or keep the one that it has.

        Args:
            topic: The form's.
            make: Makes it if it has none.

        Returns:
            False if all places are taken.
        """
        now_ns = self._clock()
        with self._lock:
            form = self.find(topic)
            if form is None:
                kept = [one for one in self.known if now_ns - one.asked_ns < KEEP_NS or self._subscribers(one.topic)]
                if len(kept) >= self._most:
                    return False
                form = make()
                self.known = (*kept, form)
            form.asked_ns = now_ns
        return True

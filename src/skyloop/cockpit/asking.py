"""Asking for control before it is taken: what a page that holds it is asked, and where one that asked stands.

:class:`Questions` and :class:`Line` are pure, the time is an argument; :class:`Asking` joins them to one page.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from skyloop.client import AuthorityStatus
from skyloop.client.takeover import TakeoverRequest, takeover_request
from skyloop.clock import monotonic_ns, nanoseconds, seconds
from skyloop.errors import RefusedError
from skyloop.messages import Event, EventKind

if TYPE_CHECKING:
    from skyloop.cockpit.hands import Hands
    from skyloop.cockpit.orders import Answer

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Question:
    """Somebody asks for the authority that this page holds."""

    request: TakeoverRequest
    until_ns: int  #: when the time to ask is over, on the proxy's clock
    declined: bool = False  #: by this page; who is of higher priority gets it all the same when the time is over

    def told(self, now_ns: int) -> Json:
        return {
            "id": self.request.by_id,
            "by": self.request.by,
            "priority": self.request.priority,
            "for_s": self.request.for_s,
            "left_s": max(0.0, seconds(self.until_ns - now_ns)),
            "declined": self.declined,
        }


class Questions:
    """Those that a page is asked, by the number of who asks. Each method that takes news returns whether they are
    others now; times are on the proxy's clock."""

    def __init__(self) -> None:
        self._open: dict[int, Question] = {}

    def find(self, by_id: int) -> Question | None:
        return self._open.get(by_id)

    def hear(self, event: Event, app_id: int) -> bool:
        """News for the application with this number."""
        if event.kind is EventKind.AUTHORITY_WITHDRAWN and event.data.get("app_id") == app_id:
            by_id = event.data.get("by_id")
            return isinstance(by_id, int) and self._open.pop(by_id, None) is not None
        request = takeover_request(event, app_id)
        if request is None:
            return False
        self._open[request.by_id] = Question(request, event.at_ns + nanoseconds(request.within_s))
        return True

    def decline(self, by_id: int) -> bool:
        """The page keeps it."""
        question = self._open.get(by_id)
        if question is None:
            return False
        self._open[by_id] = replace(question, declined=True)
        return True

    def look(self, lease: int, now_ns: int) -> bool:
        """What was asked under another lease, or for long enough, is asked no more."""
        left = {by_id: one for by_id, one in self._open.items() if one.request.lease == lease and now_ns < one.until_ns}
        changed, self._open = len(left) != len(self._open), left
        return changed

    def told(self, now_ns: int) -> Json:
        """The message to the page, who would get it before others first."""
        ordered = sorted(self._open.values(), key=lambda one: (one.request.priority, one.until_ns))
        return {"type": "asked", "questions": [one.told(now_ns) for one in ordered]}


@dataclass(frozen=True, slots=True)
class Place:
    """Where a page stands in the line."""

    position: int | None  #: 1 is next; None: not known
    until_ns: int | None  #: when it is expected to be its turn; None: not known
    asked: bool  #: the holder was asked first
    declined: str | None  #: and keeps it for this reason, which may be empty

    def told(self, now_ns: int) -> Json:
        wait_s = None if self.until_ns is None else max(0.0, seconds(self.until_ns - now_ns))
        return {"position": self.position, "wait_s": wait_s, "asked": self.asked, "declined": self.declined}


class Line:
    """A page's place in the line, with what became of its question."""

    def __init__(self) -> None:
        self._asked = False
        self._declined: str | None = None
        self._known: tuple[int, float | None] | None = None  # what the status said last
        self._until_ns: int | None = None

    def join(self, *, ask: bool) -> None:
        """The page asks for the authority, anew."""
        self._asked, self._declined, self._known = ask, None, None

    def hear(self, event: Event, app_id: int) -> None:
        """News for the application with this number."""
        if event.kind is EventKind.AUTHORITY_DECLINED and event.data.get("app_id") == app_id:
            self._declined = str(event.data.get("reason", ""))

    def look(self, status: AuthorityStatus, now_ns: int) -> Place | None:
        """The place; None for who does not wait. The same one again until there is news of it."""
        if status.state == "held":  # who is overruled afterwards has it back without asking
            self.join(ask=False)
        if status.state not in ("queued", "preempted"):
            return None
        known = status.position, status.expected_wait_s
        if known != self._known:
            self._known = known
            wait_s = status.expected_wait_s
            self._until_ns = None if wait_s is None else now_ns + nanoseconds(wait_s)
        return Place(status.position or None, self._until_ns, self._asked, self._declined)


class Asking:
    """Both sides of one page. On the event loop."""

    def __init__(self, say: Callable[[Json], None]) -> None:
        self._say = say
        self._questions = Questions()
        self._line = Line()

    def join(self, *, ask: bool) -> None:
        """The page asks for the authority, anew."""
        self._line.join(ask=ask)

    def hear(self, event: Event, hands: Hands) -> None:
        """An event that came over the page's own connection."""
        self._line.hear(event, hands.app_id)
        if self._questions.hear(event, hands.app_id):
            self._say(self._questions.told(hands.proxy_ns))

    def look(self, hands: Hands | None) -> Place | None:
        """Tell what is asked, if that is news; returns where the page stands in the line."""
        lease, now_ns = (0, 0) if hands is None else (hands.authority.lease, hands.proxy_ns)
        if self._questions.look(lease, now_ns):
            self._say(self._questions.told(now_ns))
        return None if hands is None else self._line.look(hands.authority, monotonic_ns())

    async def answer(self, order: Answer, hands: Hands) -> None:
        """The page answers. Raises :class:`RefusedError` and :class:`LinkError`."""
        question = self._questions.find(order.id)
        if question is None:
            raise RefusedError("nobody asks for control any more")
        await asyncio.to_thread(hands.answer, question.request.lease, order.id, order.grant, order.reason)
        if not order.grant and self._questions.decline(order.id):
            self._say(self._questions.told(hands.proxy_ns))

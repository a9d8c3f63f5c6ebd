"""How the link to a vehicle stands, and what its session has to tell: what the sessions of all vehicles share. Pure."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeAlias

from skyloop.clock import seconds
from skyloop.drivers.base import Sink
from skyloop.drivers.notices import Notice
from skyloop.messages import LinkState

Telling: TypeAlias = Callable[[Sink], None]


class Noticing(Protocol):
    """What flies the vehicle, and has something to say of it now and then."""

    def notices(self) -> Iterable[Notice]: ...


@dataclass(frozen=True, slots=True)
class Patience:
    """With a vehicle that is silent, ns."""

    degraded_ns: int
    lost_ns: int
    first_word_ns: int  #: who was never heard by then is told as lost


class VehicleSession(ABC):
    """The vehicle of one opened driver, from its first word on. Not thread-safe.

    The time comes as an argument; bytes go in and out. What is for the proxy's sink is collected as *tellings*, for the
    caller to deliver when it holds no lock. A kind of vehicle sets ``_heard_ns`` with whatever it understood, and calls
    :meth:`_look_at_silence` with each tick.
    """

    PATIENCE: ClassVar[Patience]
    pilot: Noticing | None

    def __init__(self, now_ns: int) -> None:
        self.due_ns = now_ns  #: when there is something to be said next
        self.link_state: LinkState | None = None  #: as told
        self._tellings: list[Telling] = []
        self._opened_ns = now_ns
        self._heard_ns: int | None = None  # None: not since it was opened or lost
        self._unreachable = ""

    @property
    def is_heard(self) -> bool:
        """Whether the vehicle is heard, or was until just now."""
        return self._heard_ns is not None

    @abstractmethod
    def close(self) -> None:
        """Nothing more will come: whoever waits for an answer is told."""

    def unreachable(self, reason: str) -> None:
        """The host said that nobody listens, or this host has no way to it, or the connection failed."""
        self._unreachable = reason

    def tellings(self) -> list[Telling]:
        """What is to be told to the sink since the last call, in order."""
        if self.pilot is not None:
            for notice in self.pilot.notices():
                self._notice(notice)
        tellings, self._tellings = self._tellings, []
        return tellings

    @abstractmethod
    def _silence(self, since: str, why: str) -> str:
        """That nothing comes, for people: with how long, and with what the host says of it, each empty or a phrase that
        begins with a blank."""

    @abstractmethod
    def _lose(self, reason: str, now_ns: int, /) -> None:
        """It is lost: from here on everything begins anew with its next word."""

    def _look_at_silence(self, now_ns: int) -> None:
        patience = self.PATIENCE
        if self._heard_ns is None:
            if self.link_state is LinkState.CONNECTING and now_ns - self._opened_ns >= patience.first_word_ns:
                self._tell_link(LinkState.LOST, self._told_silence())
            return
        silent_ns = now_ns - self._heard_ns
        if silent_ns >= patience.lost_ns:
            self._lose(self._told_silence(silent_ns), now_ns)
        elif silent_ns >= patience.degraded_ns and self.link_state is LinkState.UP:
            self._tell_link(LinkState.DEGRADED, self._told_silence(silent_ns))

    def _told_silence(self, silent_ns: int | None = None) -> str:
        since = f" for {seconds(silent_ns):.2g} s" if silent_ns is not None else ""
        return self._silence(since, f" ({self._unreachable})" if self._unreachable else "")

    def _tell_link(self, state: LinkState, reason: str = "") -> None:
        if state is not self.link_state:
            self.link_state = state
            self._tellings.append(lambda sink: sink.link(state, reason))

    def _notice(self, notice: Notice) -> None:
        self._tellings.append(lambda sink: sink.event(notice.kind, notice.text, notice.severity, **notice.data))

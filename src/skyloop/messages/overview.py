"""A few facts of each vehicle that a process serves, once a second: for who watches many of them."""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from skyloop.messages.event import Event
from skyloop.messages.feedback import LinkText, Vector
from skyloop.messages.fields import Failsafe, FlightState, LinkState, ReturnPhase
from skyloop.messages.numbers import Count, Finite, TimeNs

MAX_ADDRESS: Final = 200  #: characters of a vehicle's address
MAX_EVENT_TEXT: Final = 200  #: characters of the last event's text


class VehicleOverview(msgspec.Struct, frozen=True, array_like=True, kw_only=True):
    """What is to be known of one vehicle at a glance. What is not known is ``None``, as in :class:`Feedback`."""

    name: Annotated[str, msgspec.Meta(max_length=64)]  #: of its proxy
    uri: Annotated[str, msgspec.Meta(max_length=MAX_ADDRESS)] = ""  #: its address; cut if it is longer
    vehicle: Annotated[str, msgspec.Meta(max_length=64)] = ""  #: its family
    can_fly: bool = False  #: whether it takes commands at all
    captured_ns: TimeNs = 0  #: of its newest feedback, on the proxy's clock; 0: none has come
    state: FlightState = FlightState.UNKNOWN
    battery: Finite | None = None  #: charge left, 0 to 1
    position_m: Vector | None = None  #: in world axes [m]
    altitude_m: Finite | None = None  #: height above the ground below [m]
    yaw_rad: Finite | None = None  #: counter-clockwise from x [rad]
    vehicle_link: LinkState = LinkState.CONNECTING  #: the hop proxy–vehicle
    link_reason: LinkText = ""  #: why it is as it is; while it is up, what a vehicle waits for that still wakes up
    link_remedy: LinkText = ""  #: what a person can do about it
    owner: str | None = None  #: name of the application that holds the authority
    owner_priority: Annotated[int, msgspec.Meta(ge=0, le=31)] | None = None  #: 0 is the highest
    failsafe: Failsafe = Failsafe.NONE
    others: LinkText | None = None  #: why the proxy leaves the vehicle alone: another controller flies it
    return_phase: ReturnPhase = ReturnPhase.NONE
    applications: Count = 0  #: how many are connected
    event: Event | None = None  #: the last one, without its data; those of applications that come and go are left out


class Overview(msgspec.Struct, frozen=True, array_like=True, kw_only=True):
    """All vehicles of one process, or of one proxy, by name; a page of them where one packet can't hold all.

    The pages of one overview have the same ``seq``.
    """

    at_ns: TimeNs  #: when it was made, on the proxy's clock
    seq: Count  #: grows by one with each overview
    first: Count = 0  #: index of the first row on this page
    total: Count = 0  #: rows on all pages
    vehicles: tuple[VehicleOverview, ...] = ()


class OverviewPages:
    """Puts the pages of overviews together, in the order of their arrival."""

    def __init__(self) -> None:
        self._seq: int | None = None
        self._rows: list[VehicleOverview] = []

    def add(self, page: Overview) -> Overview | None:
        """Add a page; return the whole overview if this was its last page, else None.

        One of which a page is missing is left out: the next one follows within a second.
        """
        if page.first == 0:
            self._seq, self._rows = page.seq, []
        elif page.seq != self._seq or page.first != len(self._rows):
            self._seq = None
            return None
        self._rows.extend(page.vehicles)
        if len(self._rows) < page.total:
            return None
        self._seq = None
        return msgspec.structs.replace(page, first=0, vehicles=tuple(self._rows))

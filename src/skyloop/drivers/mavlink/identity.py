"""Who is who on a link: the vehicle that is flown, other vehicles, other programs, parts of vehicles. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skyloop.drivers.mavlink.connections import Peer
from skyloop.drivers.notices import Notice
from skyloop.messages import EventKind, Severity
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m
from skyloop.wire.mavlink.modes import Autopilot

AUTOPILOT_COMPONENT: Final = 1
MOST_OTHERS: Final = 16  #: that are told; a hostile sender can make up any number
_NO_AUTOPILOT: Final = m.MAV_AUTOPILOT_INVALID
_GROUND_STATION: Final = m.MAV_TYPE_GCS
#: MAV_TYPE of what holds itself in the air by several rotors.
_MULTIROTORS: Final = frozenset({2, 3, 4, 13, 14, 15, 29, 35})


@dataclass(frozen=True, slots=True)
class Identity:
    """A vehicle on a link."""

    system: int
    component: int
    peer: Peer


class Identities:
    """The vehicle with this ``system`` id and ``peer``, or the first that is heard; after that only that system."""

    def __init__(self, system: int | None, peer: tuple[str, int] | None) -> None:
        self.system = system
        self.chosen: Identity | None = None
        self._wanted_peer = peer
        self._told: set[Identity] = set()

    def hear(self, message: Message, peer: Peer) -> list[Notice]:
        """Any message; notices of others that are heard."""
        if message.get_type() != "HEARTBEAT" or not _is_vehicle(message):
            return []
        found = Identity(message.get_srcSystem(), message.get_srcComponent(), peer)
        if self.chosen == found:
            return []
        suits = self.system in (None, found.system) and self._wanted_peer in (None, peer)
        if self.chosen is None and suits:
            self.chosen, self.system = found, found.system
            return []
        return self._tell(found)

    def is_chosen(self, message: Message, peer: Peer) -> bool:
        """Whether the vehicle that is flown sent it."""
        chosen = self.chosen
        return (
            chosen is not None
            and message.get_srcSystem() == chosen.system
            and message.get_srcComponent() == chosen.component
            and peer == chosen.peer
        )

    def lose(self) -> None:
        """It may come back from elsewhere, as the same system."""
        self.chosen = None

    def _tell(self, found: Identity) -> list[Notice]:
        if found in self._told or len(self._told) >= MOST_OTHERS:
            return []
        self._told.add(found)
        where = f" at {found.peer[0]}:{found.peer[1]}" if found.peer is not None else ""
        text = f"another vehicle is heard, system {found.system}{where}: it is left alone"
        if self.chosen is not None and found.system == self.chosen.system:
            text += "; two with one id are told apart by ?peer=HOST:PORT"
        else:
            text += f"; ?sysid={found.system} chooses it"
        return [
            Notice(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, {"reason": "another", "system": found.system})
        ]


def _is_vehicle(heartbeat: Message) -> bool:
    return bool(
        heartbeat.get_srcComponent() == AUTOPILOT_COMPONENT
        and heartbeat.get_srcSystem() != 0
        and heartbeat.autopilot != _NO_AUTOPILOT
        and heartbeat.type != _GROUND_STATION
    )


def why_not(heartbeat: Message) -> str:
    """Why this vehicle can't be flown from here; empty if it can."""
    if heartbeat.autopilot not in tuple(Autopilot):
        return f"its autopilot is number {heartbeat.autopilot} of MAVLink; ArduCopter and PX4 are known here"
    if heartbeat.type not in _MULTIROTORS:
        return f"it is of MAVLink's type {heartbeat.type}, which is no multirotor or helicopter"
    return ""

"""One application's connection, as the server end keeps it."""

from __future__ import annotations

import threading
from typing import Final

from skyloop.transport.base import Peer
from skyloop.transport.fabric.window import DEPTH, Recent, Taker, Window

MAX_SUBSCRIPTIONS: Final = 64


class ServerConnection:
    """What the server end knows of an application. Its lock guards the windows and topics."""

    __slots__ = (
        "confirmed",
        "ended",
        "id",
        "joined_s",
        "lock",
        "peer",
        "reason",
        "recent",
        "taker",
        "topics",
        "waiting",
        "who",
        "window",
    )

    def __init__(self, peer: Peer, who: str, connection: str, joined_s: float) -> None:
        self.peer = peer
        self.who = who
        self.id = connection
        self.joined_s = joined_s  #: when it asked to be let in
        self.confirmed = False  #: its token was seen, so that its death will be told
        self.ended = False  #: what still comes is not wanted any more
        self.reason = ""  #: why it ends, as soon as one end has said so
        self.lock = threading.Lock()
        self.window = Window()  #: of packets to it
        self.taker = Taker()  #: of packets from it
        self.waiting = 0  #: packets of it that wait for the handler
        self.topics: dict[str, int] = {}  #: with the number up to which it has taken each
        self.recent = Recent()  #: packets of it

    def missed(self, topic: str, number: int) -> bool:
        """Whether so many packets of a topic are on the way to it that the one with this number does not fit."""
        return number - self.topics.get(topic, number) > DEPTH

    def took(self, topic: str, number: int) -> None:
        """It has taken the packets of a topic (empty: its own) up to this number."""
        with self.lock:
            if not topic:
                self.window.taken(number)
            elif topic in self.topics:
                self.topics[topic] = max(number, self.topics[topic])

"""Coming back: a session that looks for others less and less often is replaced as soon as there is somebody new.

Zenoh calls the addresses that it was given again and again, but searches by multicast after 1, 2, 4 and then every 8
seconds. Whoever misses a proxy searches here meanwhile, without a connection, and opens a new session when somebody
answers whom the present one does not know: that one is found within milliseconds.
"""

from __future__ import annotations

import threading
import time
from typing import Any, Final

from skyloop.transport.fabric import config
from skyloop.transport.fabric.session import Session, configure, load, retire

SEARCH_S: Final = 0.25  #: how long to wait for answers
YOUNG_S: Final = 1.0  #: for so long a new session searches well by itself
FORGET_S: Final = 10.0  #: whom a new session could not reach either is not tried again for so long


class Strangers:
    """Who was heard and could not be reached: another lab's, with keys that are not ours, say. Pure."""

    def __init__(self) -> None:
        self._tried: dict[str, float] = {}

    def news(self, heard: set[str], known: set[str], now_s: float) -> bool:
        """Whether somebody was heard who is not known and for whom no new session was opened yet."""
        self._tried = {who: at for who, at in self._tried.items() if now_s - at < FORGET_S}
        new = heard - known - self._tried.keys()
        self._tried |= dict.fromkeys(new, now_s)
        return bool(new)

    def reached(self) -> None:
        """Somebody was reached: what was tried before says nothing about the next time."""
        self._tried.clear()


_STRANGERS: Final = Strangers()
_lock: Final = threading.Lock()


def reached() -> None:
    """To be called when a proxy was reached."""
    with _lock:
        _STRANGERS.reached()


def renew(session: Session) -> bool:
    """Search; True if the session was retired because there is somebody new, so that another one has to be used."""
    if not session.settings.multicast or time.monotonic() - session.opened < YOUNG_S:
        return False
    heard = _search(session)
    known = {str(zid) for zid in (*session.zenoh.info.peers_zid(), *session.zenoh.info.routers_zid())}
    with _lock:
        news = _STRANGERS.news(heard, known, time.monotonic())
    if news:
        retire(session)
    return news


def _search(session: Session) -> set[str]:
    """Identities of those who answer now and can be called."""
    heard: set[str] = set()

    def hello(answer: Any) -> None:
        if answer.locators:
            heard.add(str(answer.zid))

    sections = config.make(session.settings, session.part, [])
    scouting = load().scout(
        session.callback(hello), what="peer|router", config=configure({"scouting": sections["scouting"]})
    )
    time.sleep(SEARCH_S)
    scouting.stop()
    return heard

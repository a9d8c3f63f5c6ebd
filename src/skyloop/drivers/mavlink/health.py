"""What the vehicle says of its health: each change told once, and its texts. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.drivers.mavlink.telemetry import SLOW_S, Telemetry
from skyloop.drivers.notices import Notice
from skyloop.messages import EventKind, Severity, Value
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.texts import Texts

DEBUG: Final = 7
GOOD_FIX: Final = 3  #: a place in three dimensions
_PREARM_WORDS: Final = ("prearm:", "arm:", "arming denied", "preflight fail")
_EKF: Final = ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS")
_PLACE: Final = 0x10 | 0x08
_LOST: Final = 0x80


class Health:
    """Remembers what was told."""

    def __init__(self) -> None:
        self._texts = Texts()
        self._told: dict[str, bool] = {}

    def text(self, message: Message) -> list[Notice]:
        """A ``STATUSTEXT``: whole texts, and whether they say why it can't be armed."""
        notices = []
        for severity, text in self._texts.heard(message):
            if severity >= DEBUG:
                continue
            weight = Severity.ERROR if severity <= 3 else Severity.WARNING if severity == 4 else Severity.INFO
            reason = "prearm" if text.lower().startswith(_PREARM_WORDS) else "text"
            data: dict[str, Value] = {"reason": reason, "mav_severity": severity}
            notices.append(Notice(EventKind.VEHICLE_MESSAGE, text, weight, data))
        return notices

    def look(self, telemetry: Telemetry, ready: bool | None, now_ns: int) -> list[Notice]:
        """What changed since the last call."""
        notices = self._changed("ready", ready, "the vehicle is ready to be armed", "the vehicle can't be armed now")
        gps = telemetry.newest("GPS_RAW_INT", now_ns, SLOW_S)
        if gps is not None:
            good = gps.fix_type >= GOOD_FIX
            notices += self._changed("gps", good, "the vehicle's GPS has a fix", "the vehicle's GPS has no fix")
        for kind in _EKF:
            ekf = telemetry.newest(kind, now_ns, SLOW_S)
            if ekf is not None:
                good = bool(ekf.flags & _PLACE) and not ekf.flags & _LOST
                notices += self._changed(
                    "ekf", good, "the vehicle knows where it is", "the vehicle does not know where it is"
                )
        return notices

    def _changed(self, name: str, good: bool | None, yes: str, no: str) -> list[Notice]:
        if good is None or self._told.get(name) is good:
            return []
        self._told[name] = good
        severity = Severity.INFO if good else Severity.WARNING
        return [Notice(EventKind.VEHICLE_MESSAGE, yes if good else no, severity, {"reason": name, "good": good})]

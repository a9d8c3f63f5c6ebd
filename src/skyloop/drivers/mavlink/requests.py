"""Messages are asked for at the rates that feedback needs, and again while they do not flow. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.mavlink.commander import Commander, Order
from skyloop.drivers.mavlink.telemetry import Telemetry
from skyloop.wire.mavlink.codec import dialect as m

AT_ONCE: Final = 4  #: requests a tick: a slow link has room for others
RETRY_S: Final = 3.0  #: accepted is not flowing
PATIENT_RETRY_S: Final = 20.0  #: of one that the vehicle does not have
TRIES: Final = 4


class Requests:
    """``rates``: name of a message to 1/s."""

    def __init__(self, rates: Mapping[str, float]) -> None:
        self._rates = dict(rates)
        self._asked: dict[str, tuple[int, int]] = {}  # when last, and how often
        self._slow: set[str] = set()

    def restart(self) -> None:
        """The vehicle may have forgotten all of it."""
        self._asked.clear()

    def step(self, telemetry: Telemetry, commander: Commander, now_ns: int) -> None:
        """Ask for what does not flow."""
        left = AT_ONCE
        for name, rate_hz in self._rates.items():
            if not left:
                return
            asked_ns, times = self._asked.get(name, (None, 0))
            if asked_ns is not None:
                wait_s = RETRY_S if times < TRIES else PATIENT_RETRY_S
                age_s = telemetry.age_s(name, now_ns)
                if age_s is not None and age_s < max(RETRY_S, 3.0 / rate_hz):
                    continue
                if now_ns - asked_ns < nanoseconds(wait_s):
                    continue
            self._asked[name] = now_ns, times + 1
            number = getattr(m, f"MAVLINK_MSG_ID_{name}")
            commander.say(Order(m.MAV_CMD_SET_MESSAGE_INTERVAL, (number, 1e6 / rate_hz)), now_ns, 0.0)
            left -= 1

"""``skyloop doctor ADDRESS``: connects to one vehicle and lists which of its settings need attention.

It flies nothing.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from skyloop.cli.findings import Finding, Health
from skyloop.messages import EventKind, LinkState, Severity

if TYPE_CHECKING:
    from skyloop.drivers.base import Driver
    from skyloop.drivers.recording_sink import RecordingSink
    from skyloop.messages.parameter import Diagnostic

ANSWER_S: Final = 3.5  #: for a vehicle to answer; the user gets a result within 5 s
PATIENCE_S: Final = 40.0  #: for one that answers to be read
FEEDBACK_S: Final = 3.0
SETTLE_S: Final = 2.0  #: for faults that end with our first messages, such as a receiver without sticks
LOOK_S: Final = 0.1


def examine_vehicle(address: str) -> Iterator[Finding]:
    """Return what is found, in the order to be read.

    Raises:
        SkyloopError: The address is not valid.
    """
    from skyloop.drivers.recording_sink import RecordingSink
    from skyloop.drivers.registry import make_driver

    driver, sink = make_driver(address), RecordingSink(watch=set())
    driver.open(sink)
    try:
        sink.wait(lambda: sink.link_state not in (None, LinkState.CONNECTING), ANSWER_S)
        if sink.link_state not in (LinkState.UP, LinkState.DEGRADED):
            yield _unreachable(sink)
            return
        if sink.link_state is LinkState.DEGRADED:
            yield Finding("vehicle", Health.GOOD, f"it answers: {sink.links[-1][1] or 'being read'}")
        if sink.wait(lambda: sink.link_state is LinkState.UP, PATIENCE_S):
            sink.wait(lambda: sink.newest is not None and sink.newest.battery is not None, FEEDBACK_S)
        else:
            yield _unreachable(sink)
        newest = sink.newest
        if newest is not None:
            battery = "unknown" if newest.battery is None else f"{newest.battery:.0%}"
            yield Finding("vehicle", Health.GOOD, f"{newest.state.value}, battery {battery}")
        for event in sink.events:
            if event.kind is EventKind.DRIVER_ERROR or event.severity is Severity.ERROR:
                yield Finding("vehicle", Health.MISSING, event.text)
        for diagnostic in _settled(driver):
            health = Health.GOOD if diagnostic.good else Health.MISSING
            yield Finding(diagnostic.what, health, diagnostic.detail, diagnostic.advice)
    finally:
        driver.close()


def _settled(driver: Driver) -> list[Diagnostic]:
    end = time.monotonic() + SETTLE_S
    while True:
        found = driver.checkup()
        if time.monotonic() >= end or all(each.good or not each.severe for each in found):
            return found
        time.sleep(LOOK_S)


def _unreachable(sink: RecordingSink) -> Finding:
    state, reason = sink.links[-1] if sink.links else (LinkState.CONNECTING, "nothing is known")
    advice = sink.remedy or "check power, cable, address"
    return Finding("vehicle", Health.BAD, f"its link is {state.value}: {reason}", advice)

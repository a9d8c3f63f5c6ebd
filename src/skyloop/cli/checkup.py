"""``skyloop doctor ADDRESS``: talks to one vehicle and says what of its settings wants attention. It flies nothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from skyloop.cli.findings import Finding, Health

PATIENCE_S: Final = 40.0  #: for a vehicle to be heard and read
FEEDBACK_S: Final = 3.0


def examine_vehicle(address: str) -> Iterator[Finding]:
    """What is found, in the order to be read. Raises :class:`skyloop.errors.SkyloopError` for a wrong address."""
    from skyloop.drivers.recording_sink import RecordingSink
    from skyloop.drivers.registry import make_driver
    from skyloop.messages import EventKind, LinkState, Severity

    driver, sink = make_driver(address), RecordingSink(watch=set())
    driver.open(sink)
    try:
        up = sink.wait(lambda: sink.link_state is LinkState.UP, PATIENCE_S)
        if up:
            sink.wait(lambda: sink.newest is not None and sink.newest.battery is not None, FEEDBACK_S)
        else:
            state, reason = sink.links[-1]
            yield Finding("vehicle", Health.BAD, f"its link is {state.value}: {reason}", "check power, cable, address")
        newest = sink.newest
        if newest is not None:
            battery = "unknown" if newest.battery is None else f"{newest.battery:.0%}"
            yield Finding("vehicle", Health.GOOD, f"{newest.state.value}, battery {battery}")
        for event in sink.events:
            if event.kind is EventKind.DRIVER_ERROR or event.severity is Severity.ERROR:
                yield Finding("vehicle", Health.MISSING, event.text)
        for remark in driver.checkup():
            health = Health.GOOD if remark.good else Health.MISSING
            yield Finding(remark.what, health, remark.detail, remark.advice)
    finally:
        driver.close()

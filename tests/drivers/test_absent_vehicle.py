"""An absent vehicle: the reason and the remedy are reported soon, and again when they change."""

from __future__ import annotations

import errno

from skyloop.clock import nanoseconds
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.vehicle_session import LinkTimeouts, VehicleSession
from skyloop.messages import AnyAction, LinkState

ABSENT = OSError(errno.ENETUNREACH, "Network is unreachable")
DENIED = OSError(errno.EACCES, "Permission denied")


class Session(VehicleSession):
    TIMEOUTS = LinkTimeouts(nanoseconds(0.5), nanoseconds(1.0), nanoseconds(2.0))

    def __init__(self) -> None:
        super().__init__(0)
        self._set_link_state(LinkState.CONNECTING, "waiting")

    def command(self, action: AnyAction, now_ns: int) -> AnyAction:
        return action

    def close(self) -> None: ...

    def _describe_silence(self, since: str, why: str) -> str:
        return f"silence{since}{why}"

    def _lose(self, reason: str, now_ns: int) -> None:
        self._received_ns = None
        self._set_link_state(LinkState.LOST, reason)

    def hear(self, now_ns: int) -> None:
        self._received_ns, self._unreachable = now_ns, ""
        self._set_link_state(LinkState.UP)

    def told(self, now_s: float) -> list[tuple[LinkState, str, str]]:
        """Return the new reports by that time."""
        sink, found = RecordingSink(watch=set()), []
        self._check_silence(nanoseconds(now_s))
        for publish in self.drain():
            publish(sink)
            found.append((*sink.links[-1], sink.remedy))
        return found


USUAL = "check the vehicle's power, and host and port in the address"


def test_a_vehicle_that_never_answered() -> None:
    session = Session()
    assert session.told(0.0) == [(LinkState.CONNECTING, "waiting", USUAL)]
    session.failed(ABSENT)
    assert session.told(1.9) == []
    assert session.told(2.0) == [(LinkState.LOST, "silence (Network is unreachable)", USUAL)]
    assert session.told(60.0) == []


def test_a_new_reason_is_reported_but_not_in_a_flood() -> None:
    session = Session()
    session.failed(ABSENT)
    session.told(2.0)
    session.failed(DENIED)
    assert session.told(3.9) == []
    assert session.told(4.0) == [(LinkState.LOST, "silence (Permission denied)", USUAL)]
    session.failed(DENIED)
    assert session.told(10.0) == []
    session.unreachable("")
    assert session.told(10.1) == [(LinkState.LOST, "silence", USUAL)]


def test_a_lost_vehicle_has_a_remedy_and_a_present_one_has_none() -> None:
    session = Session()
    session.told(0.0)
    session.hear(nanoseconds(0.1))
    assert session.told(0.1) == [(LinkState.UP, "", "")]
    assert session.told(0.7) == [(LinkState.DEGRADED, "silence for 0.6 s", "")]
    assert session.told(1.2) == [(LinkState.LOST, "silence for 1.1 s", USUAL)]
    session.failed(ABSENT)
    assert session.told(3.3) == [(LinkState.LOST, "silence (Network is unreachable)", USUAL)]

"""An application's emergency stop is repeated until the vehicle confirms it, whatever else it commands."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest

from skyloop.client import actions
from skyloop.client.actions import CommandSchedule
from skyloop.client.drone import Drone
from skyloop.clock import NS_PER_S, ManualClock
from skyloop.drivers.vehicle_session import GIVE_UP_NS
from skyloop.errors import RefusedError, UnsupportedError
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    Attitude,
    Capabilities,
    Command,
    EmergencyStop,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Land,
    ResetEmergency,
    Takeoff,
    Velocity,
    decode,
)
from skyloop.transport.base import Peer
from tests.support.scripted_proxy import WAIT_S, ScriptedProxy, flown, scripted

STICKS = Velocity(0.5)


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        yield proxy


@pytest.fixture
def drone(proxy: ScriptedProxy) -> Iterator[Drone]:
    with flown(proxy) as drone:
        yield drone


class LossyProxy(ScriptedProxy):
    """Loses the first packets with an emergency stop."""

    def __init__(self, lost: int) -> None:
        super().__init__()
        self.left = lost

    def packet(self, peer: Peer, packet: bytes) -> None:
        sample = decode(packet)
        if self.left and isinstance(sample, Command) and isinstance(sample.action, EmergencyStop):
            self.left -= 1
            return
        super().packet(peer, packet)


def test_a_lost_packet_does_not_end_a_stop_while_sticks_are_held() -> None:
    """The usual way to press it: the other hand still holds the sticks, whose set-points keep coming."""
    proxy = LossyProxy(lost=3)
    proxy.state = FlightState.FLYING
    proxy.start()
    released = threading.Event()
    try:
        with flown(proxy) as drone:
            drone.velocity(forward=0.5)
            proxy.until_commanded(STICKS)
            assert drone.emergency_stop()

            def hold() -> None:
                while not released.wait(0.01):
                    drone.velocity(forward=0.5)

            hand = threading.Thread(target=hold)
            hand.start()
            proxy.until_commanded(EmergencyStop())
            at = len(proxy.commands)
            proxy.until(lambda: len(proxy.commands) >= at + 10)
            assert proxy.left == 0
            assert set(proxy.actions()[at:]) == {EmergencyStop()}, "until it shows, nothing else is sent"
            proxy.state = FlightState.EMERGENCY
            drone.wait("emergency", WAIT_S)
            released.set()
            hand.join(WAIT_S)
    finally:
        released.set()
        proxy.stop()


def test_commands_blocked_by_a_stop_are_reported(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.state = FlightState.FLYING
    assert drone.emergency_stop()
    assert [drone.hover(), drone.idle(), drone.velocity(forward=0.1), drone.attitude(roll=0.1)] == [False] * 4
    calls: list[Callable[[], None]] = [
        drone.takeoff,
        drone.land,
        lambda: drone.go_to(x=0.0, y=0.0, z=1.0),
        lambda: drone.land(wait=False),
    ]
    for once in calls:
        with pytest.raises(RefusedError, match="emergency stop is not confirmed yet") as error:
            once()
        assert error.value.code == "wrong_state"
    assert drone.emergency_stop(), "another press counts"
    assert set(proxy.actions()) <= {EmergencyStop(), Idle()}
    proxy.state = FlightState.EMERGENCY
    drone.wait("emergency", WAIT_S)
    proxy.until(lambda: not drone._commands.schedule.stopping)
    assert drone.hover()


def test_closing_waits_for_the_stop_to_show() -> None:
    """The last line of a program, with its packet lost: the end of the connection must not end the stop."""
    proxy = LossyProxy(lost=5)
    proxy.state = FlightState.FLYING
    proxy.start()
    seen = threading.Event()

    def show() -> None:
        proxy.notifier.wait_for(lambda: EmergencyStop() in proxy.actions(), WAIT_S)
        proxy.state = FlightState.EMERGENCY
        seen.set()

    vehicle = threading.Thread(target=show)
    vehicle.start()
    try:
        with flown(proxy) as drone, drone:
            drone.emergency_stop()
        assert seen.wait(WAIT_S)
        assert Land() not in proxy.actions(), "there is nothing to land"
    finally:
        vehicle.join(WAIT_S)
        proxy.stop()


def test_a_vehicle_without_motor_stop_raises(proxy: ScriptedProxy) -> None:
    known = frozenset(ACTION_NAMES.values()) - {"emergency_stop"}
    proxy.capabilities = Capabilities("scripted", known)
    with flown(proxy) as drone:
        with pytest.raises(UnsupportedError, match="cannot stop its motors"):
            drone.emergency_stop()
        assert drone.hover()


# Its schedule --------------------------------------------------------------------------------------------------------


def feedback(state: FlightState) -> Feedback:
    return Feedback(captured_ns=1, state=state)


def test_nothing_may_be_commanded_until_it_shows_and_then_everything() -> None:
    clock, schedule = ManualClock(), CommandSchedule()
    schedule.ask(EmergencyStop(), clock())
    assert schedule.next(clock()) == EmergencyStop()
    others: list[AnyAction] = [Idle(), Hover(), Land(), Takeoff(), STICKS, Attitude()]
    assert not any(schedule.may_ask(action) for action in others)
    assert schedule.may_ask(EmergencyStop())
    clock.advance(1.0)
    schedule.observe(feedback(FlightState.EMERGENCY), clock())
    assert all(schedule.may_ask(action) for action in others)


@pytest.mark.parametrize(("after_s", "then"), [(1.0, ResetEmergency()), (2.5, Idle())])
def test_a_reset_is_sent_once_the_stop_has_shown_if_that_is_soon(after_s: float, then: AnyAction) -> None:
    clock, schedule = ManualClock(), CommandSchedule()
    schedule.ask(EmergencyStop(), clock())
    assert schedule.next(clock()) == EmergencyStop()
    schedule.ask(ResetEmergency(), clock())
    assert schedule.stopping
    clock.advance(after_s)
    schedule.observe(feedback(FlightState.FLYING), clock())
    assert schedule.next(clock()) == EmergencyStop()
    schedule.observe(feedback(FlightState.EMERGENCY), clock())
    clock.advance(0.05)
    assert schedule.next(clock()) == then


@pytest.mark.parametrize("there_is_room", [True, False])
def test_a_stop_is_repeated_at_once_however_rare_other_commands_are(there_is_room: bool) -> None:
    """At 1 Hz, one lost packet or a moment without room left the motors running for another 1.25 s."""
    clock, schedule = ManualClock(), CommandSchedule(rate_hz=1.0)
    schedule.ask(EmergencyStop(), clock())
    sent = []
    for _ in range(500):
        if (action := schedule.next(clock())) is not None:
            sent.append(action)
            if not there_is_room:
                schedule.not_sent(action, clock())
        clock.advance(0.001)
    assert sent == [EmergencyStop()] * 10
    assert schedule.due_ns - clock() <= 50_000_000


def test_a_stop_is_abandoned_before_the_driver_abandons_it() -> None:
    clock, schedule = ManualClock(), CommandSchedule()
    schedule.ask(EmergencyStop(), clock())
    begun_ns, sent = clock(), []
    while clock() - begun_ns < 12 * NS_PER_S:
        action = schedule.next(clock())
        if isinstance(action, EmergencyStop):
            sent.append(clock() - begun_ns)
        schedule.observe(feedback(FlightState.FLYING), clock())
        clock.advance(0.01)
    assert 7.9 * NS_PER_S < sent[-1] <= 8.0 * NS_PER_S < GIVE_UP_NS - NS_PER_S, "its last repeat is not a new press"
    assert not schedule.stopping
    assert schedule.may_ask(Land())


def test_an_unsent_stop_is_withdrawn_or_soon_over() -> None:
    clock, schedule = ManualClock(), CommandSchedule()
    schedule.ask(EmergencyStop(), clock())
    assert schedule.may_ask(Idle()), "it was reported as not sent"
    assert not schedule.may_ask(Hover())
    clock.advance(2.1)
    assert schedule.next(clock()) == Idle()


def test_an_unshown_stop_is_reported(proxy: ScriptedProxy, drone: Drone, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(actions._AT_MOST_NS, EmergencyStop, 200_000_000)
    proxy.state = FlightState.FLYING
    told = threading.Event()
    drone.on_event(lambda event: told.set() if event.data.get("reason") == "stop_given_up" else None)
    begun_s = time.monotonic()
    drone.emergency_stop()
    assert told.wait(WAIT_S)
    assert time.monotonic() - begun_s >= 0.2
    assert drone.hover()


def test_a_stop_without_room_is_withdrawn_or_abandoned_and_never_sent_later() -> None:
    """It counted as sent. Reported as unsent after 2 s, it cut the motors once there was room, up to 8 s later."""
    schedule = CommandSchedule()
    schedule.ask(EmergencyStop(), 0)
    for now_ns in range(0, 1_000_000_000, 40_000_000):
        if (action := schedule.next(now_ns)) is not None:
            schedule.not_sent(action, now_ns)
    assert schedule.stopping
    assert schedule.may_ask(Idle()), "it may be withdrawn"
    for now_ns in range(1_000_000_000, 2_100_000_000, 40_000_000):
        if (action := schedule.next(now_ns)) is not None:
            schedule.not_sent(action, now_ns)
    assert not schedule.stopping
    assert schedule.next(2_200_000_000) == Idle()
    assert schedule.owed is None
    schedule.ask(EmergencyStop(), 3_000_000_000)
    assert schedule.next(3_000_000_000) == EmergencyStop()
    assert schedule.next(3_100_000_000) == EmergencyStop()
    schedule.not_sent(EmergencyStop(), 3_100_000_000)
    assert not schedule.may_ask(Idle()), "a stop that was sent is not withdrawn, whatever happened to a repeat"

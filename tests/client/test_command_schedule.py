"""The schedule of commands."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.client.actions import CommandSchedule
from skyloop.clock import ManualClock, nanoseconds
from skyloop.errors import UsageError
from skyloop.messages import (
    AnyAction,
    EmergencyStop,
    Failsafe,
    Fate,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Land,
    Outcome,
    ResetEmergency,
    Takeoff,
    Velocity,
)

FORWARD = Velocity(forward=0.3)


def feedback(state: FlightState, failsafe: Failsafe = Failsafe.NONE) -> Feedback:
    return Feedback(captured_ns=0, state=state, failsafe=failsafe)


def wanted(commander: CommandSchedule) -> AnyAction:
    return commander.action


class Bench:
    """A schedule with a clock that notes what is sent and when [s]."""

    def __init__(self, **settings: float) -> None:
        self.clock = ManualClock()
        self.commander = CommandSchedule(**settings)
        self.commander.resume(self.clock())
        self.sent: list[tuple[float, AnyAction]] = []

    def ask(self, action: AnyAction) -> None:
        self.commander.ask(action, self.clock())
        self.step(0.0)

    def step(self, seconds: float) -> None:
        """Let time pass in steps of 1 ms, like a ticker that wakes when something is due."""
        for _ in range(max(1, round(seconds * 1000))):
            if seconds:
                self.clock.advance(0.001)
            action = self.commander.next(self.clock())
            if action is not None:
                self.sent.append((self.clock() / 1e9 - 1.0, action))

    @property
    def actions(self) -> list[AnyAction]:
        return [action for _, action in self.sent]


def test_idle_is_repeated_without_a_set_point() -> None:
    bench = Bench(rate_hz=32.0)
    bench.step(1.0)
    assert set(bench.actions) == {Idle()}
    assert len(bench.sent) in (32, 33)


def test_a_set_point_is_sent_at_once_and_repeated_at_a_steady_rate() -> None:
    bench = Bench(rate_hz=20.0)
    bench.step(0.02)
    bench.sent.clear()
    bench.ask(FORWARD)
    bench.step(0.5)
    assert set(bench.actions) == {FORWARD}
    times = [at for at, _ in bench.sent]
    assert times[0] == pytest.approx(0.02)
    assert times[1:] == pytest.approx([0.0325 + 0.05 * n for n in range(1, len(times))], abs=0.0011)
    assert len(times) == 10


@pytest.mark.parametrize("call_hz", [32.0, 30.0, 15.0, 50.0])
def test_repeats_never_delay_an_application_at_any_rate(call_hz: float) -> None:
    commander = CommandSchedule(rate_hz=32.0)
    commander.resume(0)
    now_ns, calls = 0, 0
    while now_ns < 3_000_000_000:
        commander.next(now_ns)
        if now_ns >= calls / call_hz * 1e9:
            commander.ask(Velocity(forward=1.0 / (2 + calls)), now_ns)
            assert commander.next(now_ns) == Velocity(forward=1.0 / (2 + calls))  # at once
            calls += 1
        now_ns += 100_000
    assert calls == 3 * call_hz


def test_deadlines_are_absolute() -> None:
    commander = CommandSchedule(rate_hz=10.0)
    commander.resume(0)
    late_ns = 0
    for beat in range(50):
        late_ns = (late_ns + 37_000_000) % 60_000_000  # up to 60 ms late, by a different time in each period
        assert commander.next(beat * 100_000_000 + late_ns) == Idle()
        assert commander.due_ns == (beat + 1) * 100_000_000
    assert commander.next(60 * 100_000_000 + 1) == Idle()  # a second late: one command, not ten
    assert commander.due_ns == 61 * 100_000_000 + 1


def test_set_points_are_spaced_and_the_newest_of_a_burst_wins() -> None:
    bench = Bench()
    bench.sent.clear()
    for number in range(1, 11):
        bench.commander.ask(Velocity(forward=number / 10), bench.clock())
        bench.step(0.001)
    bench.step(0.005)
    assert bench.actions[-1] == Velocity(forward=1.0)
    times = [at for at, _ in bench.sent]
    assert all(later - earlier >= 0.005 - 1e-9 for earlier, later in pairwise(times))
    assert len(times) == 3


def test_a_take_off_is_never_replaced_before_it_is_sent() -> None:
    bench = Bench()
    bench.ask(FORWARD)
    bench.ask(Takeoff())
    bench.ask(FORWARD)
    bench.step(0.01)
    assert bench.actions == [FORWARD, Takeoff(), FORWARD]


def not_sent(bench: Bench, action: AnyAction) -> None:
    bench.commander.ask(action, bench.clock())
    bench.step(0.0)
    assert bench.actions[-1] == action
    bench.commander.not_sent(action, bench.clock())


def owed(bench: Bench, action: AnyAction = FORWARD) -> AnyAction | None:
    """Return what is sent before an action that is requested now."""
    bench.commander.ask(action, bench.clock())
    first = bench.commander.first(action, bench.clock())
    return None if first is None else first.action


def test_a_landing_without_room_is_sent_before_later_set_points() -> None:
    bench = Bench()
    not_sent(bench, Land())
    assert bench.commander.first(Land(), bench.clock()) is None, "its repeat is the same"
    assert owed(bench) == Land()
    bench.clock.advance(0.6)
    assert owed(bench) is None, "by then no one expects it"


@pytest.mark.parametrize(
    ("unsent", "then", "first"),
    [
        (FORWARD, FORWARD, None),
        (Idle(), FORWARD, None),
        (Land(), Hover(), None),  # revoked
    ],
)
def test_actions_without_room(unsent: AnyAction, then: AnyAction, first: AnyAction | None) -> None:
    bench = Bench()
    not_sent(bench, unsent)
    assert owed(bench, then) == first


@pytest.mark.parametrize(("unsent", "first"), [(Takeoff(), None), (Land(), Land())])
def test_letting_go_sends_no_unsent_take_off(unsent: AnyAction, first: AnyAction | None) -> None:
    """It was sent just before the command that withdrew it."""
    bench = Bench()
    not_sent(bench, unsent)
    bench.commander.ask(Idle(), bench.clock(), automatic=True)
    found = bench.commander.first(Idle(), bench.clock())
    assert (None if found is None else found.action) == first


def test_nothing_replaces_an_emergency_stop_and_nothing_else_outlives_the_authority() -> None:
    bench = Bench()
    not_sent(bench, Land())
    bench.commander.clear(Fate.AUTHORITY)
    assert owed(bench) is None
    not_sent(bench, EmergencyStop())
    assert not bench.commander.may_ask(FORWARD)
    bench.commander.clear(Fate.AUTHORITY)
    bench.step(0.1)
    assert set(bench.actions[-3:]) == {EmergencyStop()}, "it is repeated until there is room"


def test_a_hover_is_sent_at_once_but_not_a_stream_of_them() -> None:
    bench = Bench()
    bench.ask(FORWARD)
    bench.ask(Hover())
    bench.ask(Hover())
    assert bench.actions == [FORWARD, Hover()]


def test_every_call_is_a_new_intent_and_repeats_keep_it() -> None:
    bench = Bench()
    bench.ask(FORWARD)
    bench.step(0.1)
    assert bench.commander.intent == 1
    bench.ask(FORWARD)
    assert bench.commander.intent == 2
    bench.commander.clear(Fate.AUTHORITY)
    bench.step(0.1)
    assert bench.commander.intent == 2


def test_a_stalled_application_ends_in_hover() -> None:
    bench = Bench(stall_s=0.5)
    bench.ask(FORWARD)
    bench.step(0.49)
    assert set(bench.actions) == {FORWARD}
    before = bench.commander.action
    bench.step(0.06)
    assert bench.actions[-1] == Hover()
    assert bench.commander.decayed(before)
    assert bench.commander.intent == 1
    bench.step(1.0)
    assert bench.actions[-1] == Hover()


def test_hover_and_infinite_patience_do_not_decay() -> None:
    bench = Bench(stall_s=math.inf)
    bench.ask(FORWARD)
    bench.step(3.0)
    assert set(bench.actions) == {FORWARD}
    asked = Hover()
    bench.ask(asked)
    assert not bench.commander.decayed(asked)


@pytest.mark.parametrize(
    ("action", "during", "done"),
    [
        (Takeoff(), FlightState.TAKING_OFF, FlightState.HOVERING),
        (Takeoff(), FlightState.LANDED, FlightState.FLYING),
        (Land(), FlightState.LANDING, FlightState.LANDED),
        (EmergencyStop(), FlightState.FLYING, FlightState.EMERGENCY),
        (ResetEmergency(), FlightState.EMERGENCY, FlightState.LANDED),
    ],
)
def test_manoeuvres_are_repeated_until_complete(action: AnyAction, during: FlightState, done: FlightState) -> None:
    bench = Bench()
    bench.ask(action)
    bench.step(0.5)
    bench.commander.observe(feedback(during), bench.clock())
    bench.step(0.5)
    assert set(bench.actions[1:]) == {action}
    bench.commander.observe(feedback(done), bench.clock())
    bench.step(0.2)
    assert bench.actions[-1] == Idle()


def test_a_state_from_before_the_command_does_not_end_it() -> None:
    bench = Bench()
    bench.ask(Land())
    bench.commander.observe(feedback(FlightState.LANDED), bench.clock())
    assert wanted(bench.commander) == Land()


def test_manoeuvres_are_not_repeated_for_ever() -> None:
    commander = CommandSchedule()
    commander.ask(EmergencyStop(), 0)
    assert commander.next(0) == EmergencyStop()
    assert commander.next(11_000_000_000) == Idle()


@pytest.mark.parametrize(
    ("state", "lasts"),
    [(FlightState.LANDING, True), (FlightState.HOVERING, True), (FlightState.UNKNOWN, False)],
)
def test_a_landing_is_repeated_for_as_long_as_the_proxy_continues_it(state: FlightState, lasts: bool) -> None:
    """From high up, it takes minutes. After 60 s it was no longer requested, while its caller still waited."""
    commander = CommandSchedule()
    intent = commander.ask(Land(), 0)
    under_way = Feedback(captured_ns=0, state=state, outcome=Outcome(7, intent))
    for second in range(100):
        commander.observe(under_way, second * 10**9, 7)
        action = commander.next(second * 10**9)
    assert action == (Land() if lasts else Idle()), "if nothing shows the landing, nothing shows its end either"
    assert commander.next(200 * 10**9) == Idle(), "it is no longer reported"


def test_a_failsafe_ends_the_set_point_but_not_the_calls_after_it() -> None:
    bench = Bench()
    bench.ask(FORWARD)
    bench.commander.observe(feedback(FlightState.HOVERING, Failsafe.HOVER), bench.clock())
    assert wanted(bench.commander) == Idle()
    bench.ask(FORWARD)
    bench.commander.observe(feedback(FlightState.HOVERING, Failsafe.HOVER), bench.clock())
    assert wanted(bench.commander) == FORWARD
    bench.commander.observe(feedback(FlightState.FLYING), bench.clock())
    bench.commander.observe(feedback(FlightState.LANDING, Failsafe.LAND), bench.clock())
    assert wanted(bench.commander) == Idle()


def test_an_emergency_ends_the_set_point_and_a_cleared_stop_continues() -> None:
    bench = Bench()
    bench.ask(FORWARD)
    bench.commander.observe(feedback(FlightState.EMERGENCY), bench.clock())
    assert wanted(bench.commander) == Idle()
    bench.ask(EmergencyStop())
    bench.commander.clear(Fate.AUTHORITY)
    assert wanted(bench.commander) == EmergencyStop()


@pytest.mark.parametrize(("age_s", "kept"), [(0.4, True), (0.6, False)])
def test_commands_given_while_the_link_was_down(age_s: float, kept: bool) -> None:
    clock = ManualClock()
    commander = CommandSchedule()
    commander.ask(FORWARD, clock())
    clock.advance(age_s)
    commander.resume(clock())
    assert commander.next(clock()) == (FORWARD if kept else Idle())


@pytest.mark.parametrize("action", [Land(), FORWARD, Takeoff()])
@pytest.mark.parametrize(("link_back_s", "fate"), [(0.0, Fate.AUTHORITY), (0.1, Fate.LINK)])
def test_a_command_dropped_while_awaiting_the_lease_says_whether_its_link_was_lost(
    action: AnyAction, link_back_s: float, fate: Fate
) -> None:
    """It is never sent, but a caller who still waits for a landing may request it again; that one is sent if only the
    lease was awaited."""
    clock = ManualClock()
    commander = CommandSchedule()
    connected_ns = clock() + nanoseconds(link_back_s)
    intent = commander.ask(action, clock())
    clock.advance(0.6)
    commander.resume(clock(), connected_ns)
    assert commander.next(clock()) == Idle()
    assert commander.over is not None
    assert (commander.over.intent, commander.over.fate) == (intent, fate)


def test_wants_flight() -> None:
    commander = CommandSchedule()
    assert not commander.wants_flight
    commander.ask(Takeoff(), 0)
    assert commander.wants_flight
    commander.ask(Land(), 0)
    assert not commander.wants_flight


@pytest.mark.parametrize("settings", [{"rate_hz": 0.0}, {"rate_hz": math.nan}, {"stall_s": 0.0}, {"stall_s": math.nan}])
def test_unusable_settings(settings: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="must be"):
        CommandSchedule(**settings)


@given(st.lists(st.tuples(st.booleans(), st.floats(0.0, 0.1)), max_size=100))
def test_never_faster_than_allowed_and_never_slower_than_the_rate(steps: list[tuple[bool, float]]) -> None:
    clock, commander = ManualClock(), CommandSchedule(rate_hz=50.0)
    commander.resume(clock())
    intents = {0}
    sent: list[int] = []
    for call, pause_s in steps:
        if call:
            commander.ask(FORWARD, clock())
        known = commander.intent in intents
        if commander.next(clock()) is not None and not known:
            intents.add(commander.intent)
            sent.append(clock())
        assert commander.due_ns <= clock() + 25_000_000
        clock.advance(pause_s)
    assert all(later - earlier >= 5_000_000 for earlier, later in pairwise(sent))

"""Decisions on whether a software-steered vehicle flies, and the proxy's behaviour until it knows."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from skyloop.clock import slept_ns
from skyloop.messages import (
    Attitude,
    EventKind,
    Failsafe,
    FlightState,
    Hover,
    Idle,
    Land,
    LinkState,
    Refusal,
    Takeoff,
    Velocity,
)
from tests.support.proxy_bench import App, Bench

VELOCITY = {"idle", "velocity", "emergency_stop", "reset_emergency"}
ATTITUDE = {"idle", "attitude", "emergency_stop", "reset_emergency"}


class Lift:
    """A vehicle that follows its set-points at 50 Hz, and reports so unless out of reach. It has no take-off."""

    def __init__(self, actions: set[str], *, says: bool) -> None:
        self.bench = Bench(actions)
        self.says = says  #: whether it reports to fly or to stand
        self.height = 0.0
        self.heard = True
        self.bench.driver.answers = False

    @property
    def climb(self) -> float:
        told = self.bench.driver.told[-1] if self.bench.driver.told else None
        return told.up if isinstance(told, Velocity) else told.climb if isinstance(told, Attitude) else 0.0

    def fly(self) -> None:
        if self.heard:  # otherwise it stays where it is
            self.height = max(0.0, self.height + self.climb * 0.02)
            self.report()

    def report(self) -> None:
        state = FlightState.FLYING if self.height > 0.0 else FlightState.LANDED
        self.bench.driver.report(altitude_m=self.height, state=state if self.says else FlightState.UNKNOWN)

    def run(self, seconds: float, pilot: App | None = None) -> None:
        def step() -> None:
            self.fly()
            if pilot is not None:
                pilot.command(Idle())

        self.bench.run(seconds, step)

    def hear(self, heard: bool) -> None:
        self.heard = heard
        self.bench.driver.link(LinkState.UP if heard else LinkState.LOST)

    @property
    def told(self) -> str:
        feedback = self.bench.proxy.publisher.feedback_now
        assert feedback is not None
        return feedback.state.value

    def hovering(self) -> App:
        self.report()
        pilot = self.bench.pilot()
        pilot.command(Takeoff())
        self.run(4.0, pilot)
        assert self.told == FlightState.HOVERING
        return pilot


@pytest.fixture(params=[(VELOCITY, False), (ATTITUDE, False), (VELOCITY, True)], ids=["velocity", "attitude", "says"])
def lift(request: pytest.FixtureRequest) -> Iterator[Lift]:
    actions, says = request.param
    lift = Lift(actions, says=says)
    with lift.bench:
        yield lift


def test_a_landing_continues_while_the_vehicle_is_out_of_reach(lift: Lift) -> None:
    """Its pilot is gone, and so is the link: it hangs in place, and the ladder lands it when it is received again."""
    lift.hovering().end.close()
    lift.hear(False)
    lift.run(30.0)
    assert (lift.told, lift.bench.proxy.handler.ladder.step) == (FlightState.LANDING, Failsafe.LAND)
    assert lift.bench.proxy.handler.airborne, "the end of the proxy has something to land"
    assert lift.height > 0.8
    lift.hear(True)
    lift.run(5.0)
    assert lift.height == 0.0
    assert lift.told == FlightState.LANDED
    lift.run(1.2)
    assert not lift.bench.proxy.handler.airborne


def test_a_gap_in_the_feedback_late_in_a_long_landing_does_not_end_it(lift: Lift) -> None:
    pilot = lift.hovering()
    lift.height = 8.0
    lift.report()
    pilot.command(Land())
    lift.run(15.5, pilot)
    assert lift.told == FlightState.LANDING
    lift.heard = False
    lift.run(0.7, pilot)
    assert lift.told == FlightState.LANDING
    lift.heard = True
    lift.run(8.0, pilot)
    assert (lift.told, lift.height) == (FlightState.LANDED, 0.0)


def test_a_vehicle_landed_by_others_does_not_take_off_unasked() -> None:
    """A pilot takes the sticks, lands and disarms; later someone requests a take-off, and hands the sticks back."""
    lift = Lift(ATTITUDE, says=True)
    driver = lift.bench.driver
    with lift.bench:
        pilot = lift.hovering()
        driver.left = "RECEIVER"
        driver.refuses = "arm it by the pilot's receiver"
        lift.run(0.2, pilot)
        assert lift.bench.proxy.handler.flight.others
        lift.height = 0.0
        driver.told.clear()
        lift.run(2.0, pilot)  # its driver reports that it stands, as someone flies past the driver
        assert lift.told == FlightState.FLYING
        driver.left = ""
        lift.run(2.0, pilot)
        assert lift.told == FlightState.LANDED
        pilot.command(Takeoff())
        assert pilot.refusals()[-1] == Refusal.WRONG_STATE
        assert "arm it by" in pilot.told(EventKind.COMMAND_REFUSED)[-1].text
        lift.run(1.0, pilot)
        assert driver.told == [], "nothing is steered, so nothing spools up"


def test_a_drifting_altimeter_makes_no_flight_of_a_vehicle_that_reports_to_stand() -> None:
    lift = Lift(ATTITUDE, says=True)
    with lift.bench as bench:
        bench.driver.report(altitude_m=0.6, state=FlightState.LANDED)
        bench.run(2.0, lambda: bench.driver.report())
        assert lift.told == FlightState.LANDED


def test_a_vehicle_that_reports_to_fly_flies(lift: Lift) -> None:
    """Also one that lands itself on no one's command: its driver's report counts, and a hover is not a take-off."""
    lift.report()
    pilot = lift.bench.pilot()
    lift.bench.driver.report(altitude_m=0.0, state=FlightState.FLYING)
    lift.bench.tick()
    assert lift.told == FlightState.FLYING
    pilot.command(Hover())
    lift.bench.tick()
    assert lift.climb == 0.0


# A computer that slept -------------------------------------------------------------------------------------------


def sleep(bench: Bench, seconds: float) -> None:
    bench.slept_ns += round(seconds * 1e9)


def test_requests_from_before_a_sleep_of_the_computer_are_not_executed(bench: Bench) -> None:
    """The program slept with it, and first of all repeats its velocity."""
    pilot = bench.airborne()
    pilot.command(Velocity(1.0))
    sleep(bench, 1.0)
    pilot.command(Velocity(1.0), repeat=True)
    assert pilot.refusals() == [Refusal.NOT_FRESH]
    assert bench.driver.told == [Velocity(1.0), Hover()]
    pilot.command(Velocity(0.5))
    assert bench.driver.told[-1] == Velocity(0.5)
    assert "slept for 1.0 s" in bench.published(EventKind.VEHICLE_MESSAGE)[-1].text


def test_a_command_that_waited_during_the_sleep_has_its_true_age(bench: Bench) -> None:
    """It was received only now."""
    pilot = bench.airborne()
    sent_ns = bench.clock()
    sleep(bench, 600.0)
    bench.clock.advance(0.02)
    bench.tick()
    pilot.take_authority()
    pilot.command(Velocity(1.0), sent_ns=sent_ns)
    assert pilot.refusals() == [Refusal.STALE]
    assert "it is 600.0" in pilot.told(EventKind.COMMAND_REFUSED)[-1].text


def test_silence_counts_while_the_computer_sleeps(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(1.0))
    sleep(bench, 6.0)
    bench.run(0.02)
    assert bench.driver.told[-1] == Land()
    assert bench.proxy.handler.authority.holder is None


def test_a_flight_after_a_long_sleep_may_be_others(bench: Bench) -> None:
    bench.airborne()
    sleep(bench, 3600.0)
    bench.run(6.0)
    assert bench.driver.told == []
    assert bench.proxy.handler.flight.others


def test_the_computers_own_sleep_is_measured() -> None:
    assert -(10**9) < slept_ns() < 10 * 365 * 24 * 3600 * 10**9


def test_the_pilot_is_warned_when_an_attitude_vehicle_drifts() -> None:
    """It went level when its velocity was lost, and silently flew on at its speed."""
    bench = Bench(ATTITUDE)
    bench.driver.answers = False
    with bench.proxy:
        pilot = bench.pilot()
        moving: dict[str, object] = {"state": FlightState.FLYING, "altitude_m": 1.0, "yaw_rad": 0.0}

        def run(velocity: tuple[float, float, float] | None) -> None:
            def step() -> None:
                bench.driver.report(**moving, velocity_m_s=velocity)
                pilot.command(Idle())

            bench.run(0.2, step)

        run((1.0, 0.0, 0.0))
        pilot.command(Hover())
        run((1.0, 0.0, 0.0))
        assert isinstance(bench.driver.told[-1], Attitude)
        assert bench.driver.told[-1].pitch < 0.0, "it brakes"
        told = [event for event in bench.events if event.data.get("reason") == "drift"]
        assert told == []
        run(None)
        assert bench.driver.told[-1] == Attitude()
        run((1.0, 0.0, 0.0))
        told = [event for event in bench.events if event.data.get("reason") == "drift"]
        assert [event.data["active"] for event in told] == [True, False]
        assert "it is held level, so it is not braked" in told[0].text

"""Whether a vehicle flies that is steered in software: what shows it, and what is done until it does."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

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
from tests.proxy.fake import App, Bench

VELOCITY = {"idle", "velocity", "emergency_stop", "reset_emergency"}
ATTITUDE = {"idle", "attitude", "emergency_stop", "reset_emergency"}


class Lift:
    """A vehicle that does what it is told at 50 Hz, and says so unless it is out of reach. It knows no take-off."""

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
        if self.heard:  # else it stays where it is
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


def test_a_landing_lasts_while_the_vehicle_is_out_of_reach(lift: Lift) -> None:
    """Its pilot is gone, and so is the link: it hangs where it is, and the ladder lands it when it is heard again."""
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


def test_what_others_landed_stands_and_is_not_taken_off_by_itself() -> None:
    """A pilot takes the sticks, lands and disarms; later on somebody asks for a take-off, and gives the sticks away."""
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
        lift.run(2.0, pilot)  # its driver says that it stands, as it flies past it
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
    """Also one that lands itself in nobody's mind: its driver's word is believed, and a hover is no take-off."""
    lift.report()
    pilot = lift.bench.pilot()
    lift.bench.driver.report(altitude_m=0.0, state=FlightState.FLYING)
    lift.bench.tick()
    assert lift.told == FlightState.FLYING
    pilot.command(Hover())
    lift.bench.tick()
    assert lift.climb == 0.0

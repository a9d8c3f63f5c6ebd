"""Flight ownership: starting a flight, taking one over, and leaving others' flights alone."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.messages import FlightState
from skyloop.proxy.core.flight import BELIEF_NS, CLAIM_NS, STANDING_NS, Flight, Whose

S = NS_PER_S
T0 = 100 * S
LANDED, FLYING, UNKNOWN = FlightState.LANDED, FlightState.FLYING, FlightState.UNKNOWN


def seen(flight: Flight, state: FlightState, now_ns: int = T0, left_to: str = "") -> Whose:
    flight.observe(state, left_to, now_ns)
    return flight.whose


def flying_here() -> Flight:
    """Return a flight after an application's take-off."""
    flight = Flight()
    seen(flight, LANDED)
    flight.claim(T0)
    seen(flight, FlightState.TAKING_OFF, T0 + S)
    return flight


@pytest.mark.parametrize("state", [each for each in FlightState if each.airborne])
def test_a_vehicle_found_in_the_air_is_others(state: FlightState) -> None:
    flight = Flight()
    assert seen(flight, UNKNOWN) is Whose.NOBODYS
    changed = flight.observe(state, "", T0)
    assert changed is not None
    assert changed.whose is Whose.OTHERS
    assert "left alone" in changed.why
    assert not flight.ours
    assert flight.observe(state, "", T0) is None


def test_a_take_off_without_us_is_others() -> None:
    flight = Flight()
    assert seen(flight, LANDED) is Whose.NOBODYS
    assert seen(flight, FlightState.TAKING_OFF, T0 + S) is Whose.OTHERS
    assert seen(flight, LANDED, T0 + 2 * S) is Whose.NOBODYS


def test_a_take_off_for_an_application_is_ours_until_it_stands() -> None:
    flight = flying_here()
    assert flight.ours
    assert seen(flight, UNKNOWN, T0 + 90 * S) is Whose.OURS, "a lost link does not give it away"
    assert seen(flight, FLYING, T0 + 91 * S) is Whose.OURS
    assert seen(flight, LANDED, T0 + 92 * S) is Whose.OURS
    assert seen(flight, FLYING, T0 + 92 * S + STANDING_NS // 2) is Whose.OURS, "it bounced"
    assert seen(flight, LANDED, T0 + 95 * S) is Whose.OURS
    assert seen(flight, LANDED, T0 + 95 * S + STANDING_NS) is Whose.NOBODYS
    assert seen(flight, FLYING, T0 + 97 * S) is Whose.OTHERS


def test_a_take_off_that_never_shows_is_forgotten() -> None:
    flight = Flight()
    seen(flight, LANDED)
    flight.claim(T0)
    assert seen(flight, LANDED, T0 + CLAIM_NS - 1) is Whose.OURS
    assert seen(flight, LANDED, T0 + CLAIM_NS) is Whose.NOBODYS
    assert seen(flight, FLYING, T0 + CLAIM_NS + 1) is Whose.OTHERS


def test_a_take_off_that_showed_claims_no_other_flight() -> None:
    flight = flying_here()
    seen(flight, LANDED, T0 + 2 * S)
    assert seen(flight, LANDED, T0 + 4 * S) is Whose.NOBODYS
    assert seen(flight, FLYING, T0 + 5 * S) is Whose.OTHERS


def test_a_mode_change_takes_it_until_an_application_takes_it_back() -> None:
    flight = flying_here()
    changed = flight.observe(FLYING, "RTL", T0 + 3 * S)
    assert changed is not None
    assert changed.why == "", "the driver has already reported it"
    assert "in RTL" in flight.others
    assert seen(flight, UNKNOWN, T0 + 4 * S) is Whose.OTHERS
    assert seen(flight, FLYING, T0 + 5 * S) is Whose.OTHERS
    flight.take()
    assert seen(flight, FLYING, T0 + 6 * S) is Whose.OURS
    assert flight.others == ""


def test_an_earlier_runs_flight_is_ours_if_found_in_the_air_but_no_later_one() -> None:
    flight = Flight()
    flight.began_before(T0 + BELIEF_NS)
    assert seen(flight, UNKNOWN) is Whose.NOBODYS
    changed = flight.observe(FLYING, "", T0)
    assert changed is not None
    assert "before its restart" in changed.why
    assert flight.ours

    landed_meanwhile = Flight()
    landed_meanwhile.began_before(T0 + BELIEF_NS)
    assert seen(landed_meanwhile, LANDED) is Whose.NOBODYS
    assert seen(landed_meanwhile, LANDED, T0 + STANDING_NS) is Whose.NOBODYS
    assert seen(landed_meanwhile, FLYING, T0 + 9 * S) is Whose.OTHERS


def test_sleep_of_the_computer_counts_for_beliefs_however_often_it_happens() -> None:
    """Belief in an earlier run's flight ended after 60 s of a clock that stops during sleep, or after one sleep."""
    flight = Flight()
    flight.began_before(T0 + BELIEF_NS)
    for _ in range(2):
        flight.slept(40 * S)
        assert seen(flight, UNKNOWN) is Whose.NOBODYS
    assert seen(flight, FLYING, T0 + S) is Whose.OTHERS
    claimed = Flight()
    claimed.claim(T0)
    claimed.slept(20 * S)
    assert not claimed.may_begin(T0)


steps = st.tuples(
    st.sampled_from(list(FlightState)), st.sampled_from(["", "", "LAND"]), st.sampled_from(["", "", "claim", "take"])
)


@given(st.lists(st.tuples(steps, st.integers(0, 3 * S)), max_size=30))
def test_nothing_is_ours_without_an_applications_request(
    history: list[tuple[tuple[FlightState, str, str], int]],
) -> None:
    flight, now, asked = Flight(), T0, False
    for (state, left_to, done), later in history:
        now += later
        if done == "claim":
            flight.claim(now)
        elif done == "take":
            flight.take()
        asked = asked or bool(done)
        flight.observe(state, left_to, now)
        assert asked or not flight.ours
        assert bool(flight.others) is (flight.whose is Whose.OTHERS)


def test_an_unshared_vehicle_is_never_others() -> None:
    """For example, a played recording belongs to anyone who commands it."""
    flight = Flight(shared=False)
    changed = flight.observe(FLYING, "", T0)
    assert changed is not None
    assert (changed.whose, changed.why) == (Whose.OURS, "")

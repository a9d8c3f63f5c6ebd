"""The proxy's handling of an emergency stop that the vehicle does not show, until it is abandoned and after."""

from __future__ import annotations

import pytest

from skyloop.messages import EmergencyStop, EventKind, FlightState, Hover, Land, LinkState, Takeoff, Velocity
from tests.support.proxy_bench import ALL, Bench

ATTITUDE_ONLY = ("idle", "attitude", "emergency_stop", "reset_emergency")


def test_repeats_of_a_stop_are_signs_of_life() -> None:
    """The vehicle takes seconds to show it: until then nothing else is sent, and no failsafe is needed."""
    with Bench() as bench:
        pilot = bench.airborne()
        bench.driver.answers = False
        pilot.command(EmergencyStop())
        bench.run(2.0, lambda: pilot.command(EmergencyStop(), repeat=True))
        assert pilot.told(EventKind.FAILSAFE) == []
        bench.run(0.7)
        assert len(pilot.told(EventKind.FAILSAFE)) == 1, "silence is not"


@pytest.mark.parametrize("off_s", [-0.3, 0.06, 3600.0])
def test_a_stop_with_a_wrong_timestamp_is_executed_but_is_not_a_sign_of_life(off_s: float) -> None:
    """A stop from the future counted as one: packets with such a timestamp could keep a dead pilot alive forever."""
    with Bench() as bench:
        pilot = bench.airborne()
        bench.driver.answers = False

        def stop() -> None:
            pilot.command(EmergencyStop(), sent_ns=bench.clock() + round(off_s * 1e9))

        bench.run(0.7, stop)
        assert EmergencyStop() in bench.driver.told
        assert len(pilot.told(EventKind.FAILSAFE)) == 1


def test_a_stop_from_another_application_keeps_no_silent_pilot_alive() -> None:
    with Bench() as bench:
        pilot, other = bench.airborne(), bench.join("other")
        bench.driver.answers = False
        bench.run(0.7, lambda: other.command(EmergencyStop()))
        assert len(pilot.told(EventKind.FAILSAFE)) == 1


@pytest.mark.parametrize("actions", [ALL, ATTITUDE_ONLY])
def test_a_vehicle_whose_stop_was_abandoned_is_reported_as_flying_and_landed(actions: tuple[str, ...]) -> None:
    """Also a vehicle that the software autopilot flies, and that was lost since; its pilot is gone."""
    with Bench(actions) as bench:
        pilot, watcher = bench.pilot(), bench.join("watcher")
        pilot.command(Takeoff())
        bench.driver.report(state=FlightState.FLYING, altitude_m=1.0)
        pilot.command(Hover())
        bench.run(0.2)
        bench.driver.answers = False
        bench.driver.link(LinkState.LOST, "no data")
        pilot.command(EmergencyStop())
        pilot.end.close()
        bench.run(11.0)
        bench.driver.told.clear()
        bench.driver.link(LinkState.UP)
        bench.driver.report(state=FlightState.FLYING)
        assert watcher.last_feedback().state.airborne
        bench.run(6.0, lambda: bench.driver.report(state=FlightState.FLYING))
        assert Land() in bench.driver.told or any(getattr(each, "climb", 0.0) < 0.0 for each in bench.driver.told)
        assert not [each for each in bench.driver.told if isinstance(each, EmergencyStop | Velocity)]

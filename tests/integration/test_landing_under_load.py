"""A landing requested while an overloaded machine makes every command late. The test controls the clock."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from skyloop.client.connection import Scheduler
from skyloop.client.drone import open_drone
from skyloop.messages import EventKind, Failsafe, FlightState, Hover, Land, Refusal, Takeoff
from skyloop.transport.testing import wait_until
from tests.support.proxy_bench import Bench

WAIT_S = 10.0


def test_a_landing_whose_commands_all_came_too_late_is_completed() -> None:
    with Bench() as bench, ThreadPoolExecutor(1) as user:
        driver, checks, witness = bench.driver, bench.proxy.handler.checks, bench.join("witness")

        def reported() -> bool:
            driver.report()
            return False

        opening = user.submit(open_drone, bench.dial, app="me", scheduler=Scheduler(bench.clock), timeout_s=WAIT_S)
        wait_until(lambda: reported() or opening.done(), "it is connected")
        with opening.result() as drone:
            drone.takeoff(wait=False)
            wait_until(lambda: Takeoff() in driver.told, "it takes off")
            driver.report(state=FlightState.HOVERING)
            drone.wait(lambda feedback: feedback.state is FlightState.HOVERING, WAIT_S)

            usual_ns, checks.max_age_ns = checks.max_age_ns, -1  # no command is recent enough
            landing = user.submit(drone.land, timeout_s=3 * WAIT_S)
            wait_until(lambda: any(echo.asked == Land() for echo in list(witness.applied)), "the command came")
            bench.run(0.6, driver.report)
            assert driver.told == [Takeoff(), Hover()]
            assert {event.data["reason"] for event in bench.published(EventKind.COMMAND_REFUSED)} == {Refusal.STALE}
            drone.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, WAIT_S)

            checks.max_age_ns = usual_ns
            bench.run(0.1, driver.report)
            wait_until(lambda: Land() in driver.told, "it lands")
            bench.run(0.2, driver.report)
            driver.report(state=FlightState.LANDED)
            landing.result(WAIT_S)

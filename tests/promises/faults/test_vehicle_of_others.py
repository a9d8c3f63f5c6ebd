"""A vehicle that others fly, land or take over in flight: an emulated autopilot commanded by two programs.

The other ground station sends its commands on another link. The proxy's commands are counted where the autopilot
receives them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from skyloop.cli import fly
from skyloop.cli.teleop import Teleop
from skyloop.client import Drone, Swarm
from skyloop.client.drone import open_drone
from skyloop.control import Controller, FlyRoute
from skyloop.control.route import Route, RouteWaypoint
from skyloop.control.route_law import RouteState
from skyloop.errors import NoAnswerError, RefusedError, SwarmError
from skyloop.messages import EventKind, Fate, Feedback
from skyloop.proxy.core.flight import Whose
from skyloop.proxy.proxy import Proxy
from skyloop.transport.testing import wait_until
from skyloop.vehicles.mavlink.emulator import Kind
from skyloop.vehicles.mavlink.wire.codec import dialect as m
from tests.promises.faults.scene import KINDS, WAIT_S, Scene, taken_off

pytestmark = pytest.mark.timeout(60)


@pytest.fixture
def note(tmp_path: Path) -> Path:
    return tmp_path / "alpha.flight"


@KINDS
@pytest.mark.parametrize("mode", ["GUIDED", "LOITER", "RTL"])
def test_a_proxy_started_during_the_flight_of_others_sends_nothing(kind: Kind, mode: str, note: Path) -> None:
    with Scene(kind, note) as scene:
        scene.station_flies()
        proxy = scene.proxy()
        wait_until(lambda: proxy.handler.flight.others != "", "it is seen whose flight it is")
        scene.station_mode(mode)
        scene.watched(proxy)
        assert scene.ours == []
        assert scene.set_points == 0


@KINDS
def test_a_landing_ordered_by_others_during_a_take_off_is_not_undone_and_the_caller_gets_the_reason(
    kind: Kind, note: Path
) -> None:
    with Scene(kind, note) as scene:
        proxy = scene.proxy()
        with scene.drone() as drone:
            drone.wait(lambda f: bool((f.native or {}).get("mavlink.ready")), timeout_s=WAIT_S)
            lands = threading.Thread(target=_land_when_up, args=(scene,))
            lands.start()
            with pytest.raises(RefusedError, match="LAND, which was not chosen here"):
                drone.takeoff(timeout_s=WAIT_S)
            lands.join()
            at = len(scene.ours)
            wait_until(lambda: not scene.armed, "it lands as the other one wants")
            assert scene.ours[at:] == []
        assert proxy.handler.flight.whose is not Whose.OURS


def _land_when_up(scene: Scene) -> None:
    deadline = time.monotonic() + WAIT_S
    while scene.height < 4.0 and time.monotonic() < deadline:
        time.sleep(0.01)
    scene.station_mode("LAND")


def test_sticks_that_a_pilot_moves_during_a_take_off_keep_the_vehicle_and_its_own_failsafe_too(note: Path) -> None:
    """PX4 only: an ArduCopter in GUIDED ignores the sticks."""
    with Scene(Kind.PX4, note) as scene:
        proxy = scene.proxy()
        scene.firmware.autopilot.parameters["COM_RC_LOSS_T"] = 3.0  # the tests' own threads may be late
        let_go = threading.Event()
        with scene.drone() as drone:
            drone.wait(lambda f: bool((f.native or {}).get("mavlink.ready")), timeout_s=WAIT_S)
            holds = threading.Thread(target=_hold_sticks, args=(scene, let_go))
            holds.start()
            try:
                with suppress(RefusedError):  # it may be seen flying a moment before its pilot is known
                    drone.takeoff(timeout_s=WAIT_S)
                told = drone.wait(lambda f: f.outcome is not None and f.outcome.fate is Fate.OTHERS, timeout_s=WAIT_S)
                assert told.outcome is not None
                assert "POSCTL, which was not chosen here" in told.outcome.text
                at = len(scene.ours)
                scene.watched(proxy)
                assert scene.mode == "POSCTL"
                assert scene.height < 6.0, "it did not continue to the requested 8 m"
            finally:
                let_go.set()
                holds.join()
            wait_until(lambda: not scene.armed, "without sticks it holds, returns and lands by itself")
            assert scene.ours[at:] == []


def _hold_sticks(scene: Scene, let_go: threading.Event) -> None:
    """Keep the sticks centred, and move one for a moment when the vehicle is 2 m up."""
    to_move = 15  # messages, 0.3 s of them if this thread is not delayed
    while not let_go.wait(0.02):
        moving = to_move > 0 and scene.height > 2.0
        to_move -= moving
        scene.station_says(m.MAVLink_manual_control_message(1, 0, 700 if moving else 0, 500, 0, 0))


@KINDS
@pytest.mark.parametrize("mode", ["LAND", "RTL"])
def test_orders_of_others_during_set_points_stand_when_the_application_continues_or_falls_silent(
    kind: Kind, mode: str, note: Path
) -> None:
    with Scene(kind, note) as scene:
        proxy = scene.proxy()
        with taken_off(scene) as drone:
            for _ in range(20):
                drone.velocity(forward=0.3)
                time.sleep(0.02)
            scene.station_mode(mode)
            wait_until(lambda: [drone.velocity(forward=0.3), proxy.driver.left_to() != ""][1], "it is seen")
            scene.ours.clear()
            refused = threading.Event()
            drone.on_event(lambda e: refused.set() if e.kind is EventKind.COMMAND_REFUSED else None)
            wait_until(lambda: [drone.velocity(forward=0.3), refused.is_set()][1], "set-points are refused")
            wait_until(lambda: not drone.velocity(forward=0.3), "and the program is told so by each of them")
            reason = next(e for e in reversed(drone.recent_events()) if e.kind is EventKind.COMMAND_REFUSED)
            assert "which was not chosen here: hover, take off or land first" in reason.text
            scene.watched(proxy, 150)  # the set-point decays to hover, and the failsafe ladder acts
            wait_until(lambda: not scene.armed, "it lands")
        assert scene.ours == []


class Flying(Controller):
    """Keeps flying whatever happens, until it fails."""

    fails = False

    def on_feedback(self, feedback: Feedback) -> None:
        if self.fails:
            raise ValueError("a bug of the user's")
        self.drone.velocity(forward=0.3)


def _controller(drone: Drone) -> None:
    controller = Flying(drone)
    controller.fails = True
    with pytest.raises(ValueError, match="a bug"):
        controller.run()


def _teleop(drone: Drone) -> None:
    Teleop(drone, 0.5, 0.8).obey("centre")


def _fly(drone: Drone) -> None:
    fly.land(drone)


def _swarm(drone: Drone) -> None:
    swarm = Swarm({"a": drone}, on_error="land")
    swarm.hover()
    with pytest.raises(SwarmError):
        swarm.fail("another's photo", {"b": ValueError("no light")})


def _block(drone: Drone) -> None:
    with drone:
        pass


@KINDS
@pytest.mark.parametrize("end", [_controller, _teleop, _fly, _swarm, _block])
def test_a_safety_pilot_keeps_the_vehicle_whatever_the_program_does(
    kind: Kind, end: Callable[[Drone], None], note: Path
) -> None:
    """A bug in a callback, a released key, the end of ``skyloop fly``, of a swarm or of a block: the library never
    takes the vehicle from whoever selected a mode unless the program requests it.
    """
    with Scene(kind, note) as scene:
        proxy = scene.proxy()
        drone = open_drone(scene.server.dial, app="me")
        drone.wait(lambda f: bool((f.native or {}).get("mavlink.ready")), timeout_s=WAIT_S)
        drone.takeoff(timeout_s=WAIT_S)
        for _ in range(10):
            drone.velocity(forward=0.3)
            time.sleep(0.02)
        scene.ours.clear()
        scene.station_mode("RTL")

        def seen() -> bool:
            drone.velocity(forward=0.3)
            return proxy.handler.flight.others != ""

        wait_until(seen, "it is seen")
        end(drone)
        scene.watched(proxy, 100)
        assert scene.ours == []
        assert "RTL" in scene.mode or not scene.armed
        assert proxy.handler.flight.whose is not Whose.OURS
        drone.close()


@KINDS
def test_a_safety_pilot_keeps_the_vehicle_on_a_route(kind: Kind, note: Path) -> None:
    """The route is paused when its place is refused, and that does not count as a decision to take the vehicle back."""
    with Scene(kind, note) as scene:
        proxy = scene.proxy()
        with taken_off(scene) as drone:
            x, y, z = drone.feedback().position_m or (0.0, 0.0, 0.0)
            flight = FlyRoute(drone, Route(waypoints=(RouteWaypoint(x + 20.0, y, z),)))

            def take() -> None:
                wait_until(lambda: flight.law.state is RouteState.FLYING and scene.set_points > 10, "it is on its way")
                scene.ours.clear()
                scene.station_mode("RTL")

            taking = threading.Thread(target=take)
            taking.start()
            flight.run(seconds=WAIT_S, until=lambda: flight.law.state is RouteState.PAUSED)
            taking.join()
            assert flight.law.state is RouteState.PAUSED
            scene.watched(proxy, 100)
            assert scene.ours == []
            assert proxy.handler.flight.whose is not Whose.OURS


@KINDS
def test_a_new_command_takes_the_vehicle_back(kind: Kind, note: Path) -> None:
    with Scene(kind, note) as scene:
        proxy = scene.proxy()
        with taken_off(scene) as drone:
            scene.station_mode("RTL")
            wait_until(lambda: proxy.driver.left_to() != "", "it is seen")
            wait_until(lambda: proxy.handler.flight.others != "", "it is told")
            drone.hover()
            guided = "GUIDED" if kind is Kind.ARDUCOPTER else "OFFBOARD"
            wait_until(lambda: scene.mode == guided, "it follows again")
            drone.land(timeout_s=WAIT_S)


@KINDS
def test_a_hover_takes_it_back_above_the_ceiling_too(kind: Kind, note: Path) -> None:
    """It was made a descent, and no set-point takes a vehicle back; a real PX4's RTL climbs to 30 m."""
    with Scene(kind, note) as scene:
        proxy = scene.proxy()
        with taken_off(scene) as drone:
            scene.station_mode("RTL" if kind is Kind.ARDUCOPTER else "LOITER")
            wait_until(lambda: proxy.handler.flight.others != "", "it is seen")
            drone.config["limits.altitude"] = 4.0
            drone.hover()
            guided = "GUIDED" if kind is Kind.ARDUCOPTER else "OFFBOARD"
            wait_until(lambda: scene.mode == guided, "it is ours again")
            wait_until(lambda: scene.height < 4.8, "it comes down to the ceiling")


@KINDS
@pytest.mark.parametrize("meanwhile", ["nobody", "station"])
def test_a_killed_proxy_ends_its_own_flight_when_it_is_back_unless_others_took_it(
    kind: Kind, meanwhile: str, note: Path
) -> None:
    with Scene(kind, note) as scene:
        first = scene.proxy()
        drone = taken_off(scene)
        wait_until(note.exists, "the flight is noted")
        scene.die(first)
        drone.close()
        if meanwhile == "station":
            scene.station_mode("RTL")
            wait_until(lambda: "RTL" in scene.mode, "it is on its way")
        note.write_text(scene.address)
        scene.ours.clear()
        second = scene.proxy()
        if meanwhile == "nobody":
            wait_until(lambda: m.MAV_CMD_DO_SET_MODE in scene.ours, "it is held, and then landed")
            wait_until(lambda: not scene.armed, "it stands")
        else:
            wait_until(lambda: second.handler.flight.others != "" or not scene.armed, "it is left")
            wait_until(lambda: not scene.armed, "it is home")
            assert scene.ours == []


# An intent that has ended stays ended ----------------------------------------------------------------------------


def ready(scene: Scene) -> Drone:
    """A drone on the ground that may be armed."""
    drone = scene.drone()
    drone.wait(lambda f: bool((f.native or {}).get("mavlink.ready")), timeout_s=WAIT_S)
    return drone


def stays_down(scene: Scene, proxy: Proxy) -> None:
    """Check that it stays disarmed on the ground for some simulated seconds."""
    wait_until(lambda: not scene.armed, "it stands")
    scene.watched(proxy, 150)
    assert not scene.armed
    assert scene.height < 0.3


@KINDS
def test_a_take_off_that_others_land_at_once_does_not_restart_on_the_ground(kind: Kind, note: Path) -> None:
    """0.1 s after touch-down, motors still turning, it took off again, to 7.8 m, with a person walking up to it."""
    with Scene(kind, note) as scene:
        proxy = scene.proxy()
        with ready(scene) as drone:
            drone.takeoff(wait=False)
            wait_until(lambda: scene.height > 1.0, "it climbs")
            scene.station_mode("LAND")
            stays_down(scene, proxy)


@KINDS
@pytest.mark.parametrize("wait", [True, False])
def test_a_vehicle_disarmed_in_its_take_off_stays_disarmed(kind: Kind, wait: bool, note: Path) -> None:
    """It tips over, or a switch disarms it: 0.1 s later it armed itself, and the call returned as a success."""
    with Scene(kind, note) as scene:
        proxy = scene.proxy()
        with ready(scene) as drone:

            def kill() -> None:
                wait_until(lambda: scene.armed, "it is armed")
                scene.station(m.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, 21196.0)

            killing = threading.Thread(target=kill)
            killing.start()
            if wait:
                with pytest.raises(RefusedError, match=r"landed or disarmed|which was not chosen here"):
                    drone.takeoff(timeout_s=WAIT_S)
            else:
                drone.takeoff(wait=False)
            killing.join()
            stays_down(scene, proxy)


def test_a_take_off_that_timed_out_before_the_autopilot_was_ready_is_not_flown_later(note: Path) -> None:
    """It raised at 4.0 s, yet took off at 14.6 s, while the program waited for a person."""
    with Scene(Kind.ARDUCOPTER, note, boot_s=6.0) as scene:
        proxy = scene.proxy()
        with scene.drone() as drone:
            drone.wait("landed", WAIT_S)
            with pytest.raises(NoAnswerError, match="takeoff was not completed"):
                drone.takeoff(timeout_s=0.7)
            wait_until(lambda: scene.firmware.autopilot.ready, "it may be armed")
            stays_down(scene, proxy)


def test_a_take_off_still_awaited_begins_when_the_autopilot_is_ready(note: Path) -> None:
    with Scene(Kind.ARDUCOPTER, note, boot_s=6.0) as scene:
        scene.proxy()
        with scene.drone() as drone:
            drone.wait("landed", WAIT_S)
            drone.takeoff(timeout_s=2 * WAIT_S)
            assert scene.height > 4.0


@KINDS
@pytest.mark.parametrize("meanwhile", ["hovers", "takes off"])
def test_the_repeats_of_a_refused_place_do_not_fly_there(kind: Kind, meanwhile: str, note: Path) -> None:
    """go_to(z=-4) was refused, yet 3 to 4 s later the vehicle stood on the floor with its motors running."""
    with Scene(kind, note) as scene:
        proxy = scene.proxy()
        with ready(scene) as drone:
            drone.takeoff(wait=meanwhile == "hovers", timeout_s=WAIT_S)
            wait_until(lambda: scene.height > 1.0, "it is in the air")
            drone.go_to(x=0.0, y=0.0, z=-4.0, wait=False)
            refused = drone.wait(lambda f: f.outcome is not None and f.outcome.failed, WAIT_S).outcome
            assert refused is not None
            assert "below the ground" in refused.text
            scene.watched(proxy, 150)
            assert scene.height > 1.0
            with pytest.raises(RefusedError, match="below the ground"):
                drone.go_to(x=0.0, y=0.0, z=-4.0)
            scene.watched(proxy, 60)
            assert scene.height > 1.0
            drone.land(timeout_s=WAIT_S)


@KINDS
def test_a_take_off_right_after_a_landing(kind: Kind, note: Path) -> None:
    """It was reported as "disarmed itself", because of an arming received before."""
    with Scene(kind, note) as scene:
        scene.proxy()
        with taken_off(scene) as drone:
            drone.land(timeout_s=WAIT_S)
            drone.takeoff(timeout_s=WAIT_S)
            assert not [event for event in drone.recent_events() if event.data.get("reason") == "no_takeoff"]
            drone.land(timeout_s=WAIT_S)

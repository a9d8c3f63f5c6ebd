"""Letting go of a vehicle: the library's own hover and landing, and the end of a flight."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator

import pytest

from skyloop.client import Drone, Swarm
from skyloop.client.actions import CommandSchedule
from skyloop.control import Controller
from skyloop.errors import ClosedError, SkyloopError, SwarmError
from skyloop.messages import (
    AnyAction,
    Command,
    EmergencyStop,
    EventKind,
    Failsafe,
    Fate,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Land,
    Outcome,
    Position,
    Refusal,
    ReturnPhase,
    Takeoff,
    Velocity,
)
from tests.support.scripted_proxy import WAIT_S, ScriptedProxy, background, flown, scripted

FLYING, LANDED, LANDING = FlightState.FLYING, FlightState.LANDED, FlightState.LANDING


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        proxy.state = FLYING
        yield proxy


@pytest.fixture
def drone(proxy: ScriptedProxy) -> Iterator[Drone]:
    with flown(proxy) as drone:
        drone.wait("flying", WAIT_S)
        yield drone


def newest(proxy: ScriptedProxy) -> Command:
    """Return the newest command other than a mere sign of life, once a later packet has arrived."""
    proxy.until(lambda: any(type(command.action) is not Idle for command in proxy.commands), "a command")
    return next(command for command in reversed(proxy.commands) if type(command.action) is not Idle)


# Letting go ------------------------------------------------------------------------------------------------------


def test_the_librarys_own_hover_is_marked_and_a_programs_is_not(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.velocity(forward=0.5)
    assert not newest(proxy).automatic
    assert drone._piloting.let_go("a test says so")
    hover = proxy.until_commanded(Hover())
    assert hover.automatic
    drone.hover()
    proxy.until(lambda: proxy.commands[-1].action == Hover() and not proxy.commands[-1].automatic, "its own")


def test_the_hover_after_a_decayed_set_point_is_the_librarys_own() -> None:
    schedule = CommandSchedule(stall_s=1.0)
    schedule.ask(Velocity(0.5), 0)
    assert (schedule.next(0), schedule.automatic) == (Velocity(0.5), False)
    assert (schedule.next(2_000_000_000), schedule.automatic) == (Hover(), True)
    schedule.ask(Hover(), 2_100_000_000)
    assert not schedule.automatic


@pytest.mark.parametrize(
    ("asked", "more", "sent"),
    [
        (Velocity(0.5), {}, Hover()),
        (Position(1.0, 0.0, 1.0), {}, Hover()),
        (Takeoff(), {"state": FlightState.TAKING_OFF}, Hover()),
        (Takeoff(), {"state": LANDED}, Land()),
        (Velocity(0.5), {"state": LANDED}, Idle()),
        (Velocity(0.5), {"state": LANDING}, Idle()),
        (Velocity(0.5), {"state": FlightState.UNKNOWN}, Hover()),
        (Velocity(0.5), {"others": "the vehicle is in RTL"}, Idle()),
        (Velocity(0.5), {"failsafe": Failsafe.LAND, "return_phase": ReturnPhase.FLYING}, Idle()),
        (Land(), {}, None),
        (EmergencyStop(), {}, None),
        (Hover(), {}, None),
    ],
)
def test_commands_of_letting_go(
    proxy: ScriptedProxy, drone: Drone, asked: AnyAction, more: dict[str, object], sent: AnyAction | None
) -> None:
    """It aborts no landing, takes no vehicle from others, ends no return, and leaves no take-off for later."""
    more = dict(more)
    proxy.state = more.pop("state", FLYING)  # type: ignore[assignment]
    proxy.more = more
    drone.wait(lambda f: all(getattr(f, name) == value for name, value in {"state": proxy.state, **more}.items()))
    drone._commands.command(asked)
    assert drone._piloting.let_go("a test says so") is (sent is not None)
    assert drone._commands.newest == (asked if sent is None else sent)


def test_without_the_authority_nothing_is_sent_now_or_later(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.take_over()
    drone.wait(lambda _: drone.authority.state == "preempted", WAIT_S)
    count = len(proxy.commands)
    assert not drone._piloting.let_go("a test says so")
    assert Hover() not in proxy.actions()[count:]
    drone.close()
    assert not drone._piloting.let_go("a test says so")


# Interrupts ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "action"),
    [
        (lambda drone: drone.go_to(x=8.0, y=0.0, z=1.0), Position(8.0, 0.0, 1.0)),
        (lambda drone: drone.return_to_start(), None),
    ],
)
def test_ctrl_c_in_go_to_hovers(
    proxy: ScriptedProxy, drone: Drone, call: Callable[[Drone], None], action: AnyAction | None
) -> None:
    count = len(proxy.commands)
    moves = ("position", "return_to_start")
    background(
        lambda: proxy.until(lambda: any(one.name in moves for one in proxy.actions()[count:])),
        lambda: signal.raise_signal(signal.SIGINT),
    )
    with pytest.raises(KeyboardInterrupt):
        call(drone)
    assert proxy.until_commanded(Hover(), count).automatic
    assert action is None or action in proxy.actions()
    assert drone._commands.newest == Hover()


def test_ctrl_c_in_a_take_off_that_does_not_start_ends_it(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.state = LANDED
    drone.wait("landed", WAIT_S)
    background(lambda: proxy.until_commanded(Takeoff()), lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        drone.takeoff()
    land = proxy.until_commanded(Land())
    assert land.automatic
    count = len(proxy.commands)
    proxy.until(lambda: len(proxy.commands) > count + 12, "the library goes on")
    assert Takeoff() not in proxy.actions()[count:]


def test_ctrl_c_in_a_landing_lets_it_continue(proxy: ScriptedProxy, drone: Drone) -> None:
    background(lambda: proxy.until_commanded(Land()), lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        drone.land()
    assert drone._commands.newest == Land()


@pytest.mark.parametrize("how", [KeyboardInterrupt, SystemExit])
def test_an_interrupted_controller_hovers_at_once(proxy: ScriptedProxy, drone: Drone, how: type[BaseException]) -> None:
    class Flying(Controller):
        def on_feedback(self, feedback: Feedback) -> None:
            self.drone.velocity(forward=0.5)

    looks = iter(range(5))

    def until() -> bool:
        if next(looks, None) is None:
            raise how
        return False

    with pytest.raises(how):
        Flying(drone).run(until=until)
    assert proxy.until_commanded(Hover()).automatic


def test_a_controller_that_fails_after_landing_lets_it_land(proxy: ScriptedProxy, drone: Drone) -> None:
    class Landing(Controller):
        def on_feedback(self, feedback: Feedback) -> None:
            self.drone.land(wait=False)
            raise ValueError("a bug of the user's")

    with pytest.raises(ValueError, match="a bug"):
        Landing(drone).run()
    assert drone._commands.newest == Land()


# The end ---------------------------------------------------------------------------------------------------------


def landing(proxy: ScriptedProxy) -> threading.Thread:
    """The vehicle lands at the first command to do so."""
    return background(
        lambda: proxy.until(lambda: Land() in proxy.actions(), "the landing"), lambda: setattr(proxy, "state", LANDED)
    )


def test_a_commanding_thread_does_not_prevent_the_landing_at_the_end_of_the_block(
    proxy: ScriptedProxy, drone: Drone
) -> None:
    raised: list[Exception] = []
    commanded, over = threading.Event(), threading.Event()

    def fly() -> None:
        while not over.is_set():
            try:
                drone.velocity(forward=0.5)
                commanded.set()
            except ClosedError as error:
                raised.append(error)
                over.set()

    flying = background(fly)
    with drone:
        assert commanded.wait(WAIT_S)
        listener = drone.on_feedback(lambda _: drone.velocity(forward=0.4))
        proxy.until_commanded(Velocity(0.4))
        down = background(
            lambda: proxy.until(lambda: Land() in proxy.actions()),
            lambda: over.wait(WAIT_S),
            lambda: setattr(proxy, "state", LANDED),
        )
    down.join(WAIT_S)
    flying.join(WAIT_S)
    actions = proxy.actions()
    assert {type(action) for action in actions[actions.index(Land()) :]} <= {Land, Idle}
    assert "the end of this flight has begun" in str(raised[0])
    assert listener.errors > 0
    assert not [event for event in drone.recent_events() if event.kind is EventKind.CALLBACK_ERROR]


def test_an_emergency_stop_passes_during_the_end(proxy: ScriptedProxy, drone: Drone) -> None:
    stopping = background(
        lambda: proxy.until(lambda: Land() in proxy.actions()),
        drone.emergency_stop,
        lambda: setattr(proxy, "state", FlightState.EMERGENCY),
    )
    assert drone._piloting.end_flight() is None
    stopping.join(WAIT_S)
    assert EmergencyStop() in proxy.actions()


def test_a_wait_for_another_command_ends_with_the_flight(proxy: ScriptedProxy, drone: Drone) -> None:
    raised: list[Exception] = []

    def fly() -> None:
        try:
            drone.go_to(x=8.0, y=0.0, z=1.0)
        except ClosedError as error:
            raised.append(error)

    thread = background(fly)
    proxy.until_commanded(Position(8.0, 0.0, 1.0))
    down = landing(proxy)
    assert drone._piloting.end_flight() is None
    thread.join(WAIT_S)
    down.join(WAIT_S)
    assert raised


def test_a_controller_on_another_thread_ends_with_the_block(proxy: ScriptedProxy, drone: Drone) -> None:
    class Flying(Controller):
        def on_feedback(self, feedback: Feedback) -> None:
            self.drone.velocity(forward=0.5)

    reasons: list[str] = []
    with drone:
        thread = background(lambda: reasons.append(Flying(drone).run().reason))
        proxy.until_commanded(Velocity(0.5))
        down = landing(proxy)
    thread.join(WAIT_S)
    down.join(WAIT_S)
    assert reasons == ["closed"]


@pytest.mark.parametrize("inline", [False, True])
def test_sys_exit_in_a_callback_ends_the_flight(proxy: ScriptedProxy, drone: Drone, inline: bool) -> None:
    """It would end the callback's thread, silently, and with ``inline`` all reception."""

    def leave(_: Feedback) -> None:
        sys.exit("enough")

    down = landing(proxy)
    drone.on_feedback(leave, inline=inline)
    proxy.until(lambda: drone.closed or drone._piloting.ending, "the end begins")
    down.join(WAIT_S)
    assert drone._piloting.end_flight() is None, "waits for the end in progress"
    assert drone.closed
    assert proxy.until_commanded(Land()).automatic
    told = [event.text for event in drone.recent_events() if event.kind is EventKind.CALLBACK_ERROR]
    assert told[0] == "feedback raised SystemExit: enough"


@pytest.mark.parametrize("inline", [False, True])
def test_sys_exit_in_a_callback_lands_even_without_a_thread_to_wait_for_it(
    proxy: ScriptedProxy, drone: Drone, inline: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From then on, commands were refused, and nothing ended the flight."""
    begin = threading.Thread.start

    def start(thread: threading.Thread) -> None:
        if thread.name == "skyloop-end":
            raise RuntimeError("can't start new thread")
        begin(thread)

    def end(_: Feedback) -> None:
        raise SystemExit("enough")

    monkeypatch.setattr(threading.Thread, "start", start)
    drone.velocity(forward=0.5)
    drone.on_feedback(end, inline=inline)
    assert proxy.until_commanded(Land()).automatic


def test_a_return_for_the_battery_is_awaited_without_further_commands(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.more = {"failsafe": Failsafe.LAND, "return_phase": ReturnPhase.FLYING}
    drone.wait(lambda f: f.return_phase is ReturnPhase.FLYING, WAIT_S)
    steps: list[str] = []

    def report(step: str) -> None:
        steps.append(step)
        proxy.notifier.notify()

    down = background(lambda: proxy.until(lambda: bool(steps)), lambda: setattr(proxy, "state", LANDED))
    assert drone._piloting.end_flight(report) is None
    down.join(WAIT_S)
    assert steps == ["it is returning to its start to land"]
    assert {action.name for action in proxy.actions()} <= {"idle"}


def landed_by_others(proxy: ScriptedProxy) -> None:
    proxy.state = LANDING
    proxy.more["others"] = "the vehicle is in LAND"


@pytest.mark.parametrize(
    ("take", "told"),
    [
        (lambda proxy: proxy.take_over("boss"), "boss took over: leaving the drone to it"),
        (
            lambda proxy: proxy.more.update(others="the vehicle is in RTL"),
            "the vehicle is in RTL: leaving the drone to it",
        ),
        (landed_by_others, "the vehicle is in LAND: leaving the drone to it"),
    ],
)
def test_a_vehicle_flown_by_others_is_left_to_them_at_the_end(
    proxy: ScriptedProxy,
    drone: Drone,
    take: Callable[[ScriptedProxy], None],
    told: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    take(proxy)
    drone.wait(lambda f: f.others is not None or drone.authority.state == "preempted", WAIT_S)
    steps: list[str] = []
    assert drone._piloting.end_flight(steps.append) is None
    assert steps == [told]
    assert ("not landing it" in caplog.text) == ("RTL" in told)
    assert {action.name for action in proxy.actions()} <= {"idle"}


def test_two_controllers_on_one_drone_end_with_it_and_a_failing_one_stops_it_only_briefly(
    proxy: ScriptedProxy, drone: Drone
) -> None:
    class Flying(Controller):
        def on_feedback(self, feedback: Feedback) -> None:
            self.drone.velocity(forward=0.5)

    class Failing(Controller):
        def on_feedback(self, feedback: Feedback) -> None:
            raise ValueError("a bug of the user's")

    reasons: list[str] = []
    with drone:
        thread = background(lambda: reasons.append(Flying(drone).run().reason))
        proxy.until_commanded(Velocity(0.5))
        with pytest.raises(ValueError, match="a bug"):
            Failing(drone).run()
        count = len(proxy.commands)
        proxy.until_commanded(Velocity(0.5), count)
        down = landing(proxy)
    thread.join(WAIT_S)
    down.join(WAIT_S)
    assert reasons == ["closed"]
    actions = proxy.actions()
    assert {type(action) for action in actions[actions.index(Land()) :]} <= {Land, Idle}


# Swarms ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def two(proxy: ScriptedProxy, drone: Drone) -> Iterator[tuple[ScriptedProxy, Swarm]]:
    """The other drone's proxy, and a swarm of both."""
    with scripted() as other:
        other.state = FLYING
        with flown(other) as second:
            second.wait("flying", WAIT_S)
            yield other, Swarm({"a": drone, "b": second}, on_error="land")


def test_a_foreign_error_keeps_no_drone_of_a_swarm_from_its_emergency_stop(
    two: tuple[ScriptedProxy, Swarm], drone: Drone, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, swarm = two

    def broken() -> bool:
        raise RuntimeError("a bug of a driver's")

    monkeypatch.setattr(drone, "emergency_stop", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        swarm.emergency_stop()
    other.until_commanded(EmergencyStop())


def test_a_swarms_hover_takes_no_drone_from_others_and_aborts_its_own_landing(
    proxy: ScriptedProxy, two: tuple[ScriptedProxy, Swarm]
) -> None:
    other, swarm = two
    swarm.velocity(forward=0.3)
    swarm.hover()
    assert proxy.until_commanded(Hover()).automatic
    assert other.until_commanded(Hover()).automatic
    swarm["b"].land(wait=False)
    count = len(other.commands)
    swarm.hover()
    assert not other.until_commanded(Hover(), count).automatic


def test_the_rest_of_a_swarm_is_landed_by_the_library_not_by_its_program(
    proxy: ScriptedProxy, two: tuple[ScriptedProxy, Swarm]
) -> None:
    other, swarm = two
    down = landing(other)
    with pytest.raises(SwarmError, match="photo"):
        swarm.fail("photo", {"a": RuntimeError("no light")})
    down.join(WAIT_S)
    assert other.until_commanded(Land()).automatic
    assert Land() not in proxy.actions()


def test_ctrl_c_at_the_end_of_a_swarm_stops_the_wait_but_no_landing(
    proxy: ScriptedProxy, two: tuple[ScriptedProxy, Swarm], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second Ctrl-C during the landing of the first drone left the others as they were."""
    other, swarm = two
    begin = threading.Thread.start

    def start(thread: threading.Thread) -> None:
        begin(thread)
        if thread.name == "skyloop-swarm-a":
            proxy.until_commanded(Land())
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), swarm:
        monkeypatch.setattr(threading.Thread, "start", start)
    assert Land() in other.actions()
    assert Land() in proxy.actions()
    assert all(drone.closed for drone in swarm)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_the_end_of_a_swarm_bars_all_its_drones_before_the_first_lands(
    proxy: ScriptedProxy, two: tuple[ScriptedProxy, Swarm], drone: Drone, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, swarm = two
    barred: list[bool] = []
    end = drone._piloting.end_flight

    def watched() -> SkyloopError | None:
        barred.append(swarm["b"]._piloting.ending)
        return end()

    monkeypatch.setattr(drone._piloting, "end_flight", watched)
    down = landing(proxy), landing(other)
    with swarm:
        pass
    for thread in down:
        thread.join(WAIT_S)
    assert barred == [True]
    assert Land() in proxy.actions()
    assert Land() in other.actions()


def test_a_controller_that_took_the_vehicle_a_moment_ago_keeps_it(proxy: ScriptedProxy, drone: Drone) -> None:
    """The proxy knows it before feedback shows it, and refuses the landing."""

    def take() -> None:
        intent = proxy.until_commanded(Land()).intent
        refused = Outcome(drone.app_id, intent, Fate.REFUSED, Refusal.WRONG_STATE, "it is in RTL")
        proxy.feedback(outcome=refused)
        proxy.more = {"outcome": refused, "others": "the vehicle is in RTL"}

    steps: list[str] = []
    taking = background(take)
    assert drone._piloting.end_flight(steps.append) is None
    taking.join(WAIT_S)
    assert steps == ["landing", "the vehicle is in RTL: leaving the drone to it"]

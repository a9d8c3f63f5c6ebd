"""Commands and authority with a scripted proxy."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from skyloop import extend
from skyloop.client import Authority, AuthorityStatus, Drone, actions
from skyloop.client.drone import open_drone
from skyloop.clock import NS_PER_S
from skyloop.errors import AuthorityError, ClosedError, NoAnswerError, RefusedError, UnsupportedError, UsageError
from skyloop.messages import (
    AnswerTakeover,
    AnyAction,
    Attitude,
    AuthorityGranted,
    Command,
    Done,
    EmergencyStop,
    Event,
    EventKind,
    Failsafe,
    Fate,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Land,
    LinkState,
    Outcome,
    Position,
    Refusal,
    Refused,
    ReleaseAuthority,
    RequestAuthority,
    Takeoff,
    Velocity,
)
from skyloop.messages.config import MAX_REASON
from skyloop.messages.feedback import WAKING_UP
from skyloop.proxy.core.command_checks import TAKEOFF_NS
from tests.support.scripted_proxy import QUICK, WAIT_S, ScriptedProxy, background, flown, scripted


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        yield proxy


@pytest.fixture
def drone(proxy: ScriptedProxy) -> Iterator[Drone]:
    with flown(proxy) as drone:
        yield drone


def test_a_command_is_sent_at_once_and_repeated(proxy: ScriptedProxy, drone: Drone) -> None:
    sent_ns = time.monotonic_ns()
    up: Any = np.float32(0.25)
    assert drone.velocity(forward=0.5, left=1, up=up, yaw_rate=-0.5)
    wanted = Velocity(0.5, 1.0, 0.25, -0.5)
    first = proxy.until_commanded(wanted)
    assert (first.lease, first.intent) == (1, 1)
    assert first.sent_ns >= sent_ns
    proxy.until(lambda: proxy.actions().count(wanted) >= 4)
    repeats = [command for command in proxy.commands if command.action == wanted]
    assert {command.intent for command in repeats} == {1}
    seqs = [command.seq for command in proxy.commands]
    assert seqs == sorted(set(seqs))
    assert drone.attitude(roll=0.1, pitch=0.2, climb=0.3, yaw_rate=0.4)
    assert proxy.until_commanded(Attitude(0.1, 0.2, 0.3, 0.4)).intent == 2
    assert drone.idle()
    assert drone.command(Hover())
    proxy.until_commanded(Hover())


def test_idle_keeps_the_authority_before_the_first_command(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.until(lambda: len(proxy.commands) >= 3)
    assert set(proxy.actions()) == {Idle()}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda drone: drone.velocity(forward=math.nan), "forward is nan and must be finite"),
        (lambda drone: drone.velocity(yaw_rate=math.inf), "yaw_rate is inf"),
        (lambda drone: drone.velocity(left="1"), "left is '1' and must be a number"),
        (lambda drone: drone.velocity(up=None), "up is None"),
        (lambda drone: drone.velocity(up=True), "up is True"),
        (lambda drone: drone.attitude(pitch=[0.1]), "pitch is "),
        (lambda drone: drone.attitude(climb=-math.inf), "climb is -inf"),
        (lambda drone: drone.command("hover"), "a command must be one of attitude, "),
        (lambda drone: drone.command(Velocity(forward=math.nan)), "NaN"),
        (lambda drone: drone.request_authority(32), "from 0"),
        (lambda drone: drone.go_to(x=math.nan, y=0.0, z=1.0), "x is nan and must be finite"),
        (lambda drone: drone.go_to(x=0.0, y="1", z=1.0), "y is '1' and must be a number"),
        (lambda drone: drone.velocity(forward=10**400), "forward is too large"),
        (lambda drone: drone.velocity(up=10**5000), "up is too large"),
        (lambda drone: drone.command(Velocity(10**400)), "velocity has a number that is too large"),
        (lambda drone: drone.velocity(yawrate=0.1), "argument of velocity .*'yawrate'.*did you mean 'yaw_rate'"),
        (lambda drone: drone.velocity(0.3), "by their names, as in velocity.forward=0.3"),
        (lambda drone: drone.attitude(0.1, 0.2), "roll, pitch, climb, yaw_rate by their names"),
        (lambda drone: drone.go_to(1.0, 2.0, 1.5), "go_to takes x, y, z, .* by their names, as in go_to.x=1.0"),
        (lambda drone: drone.go_to(x=1.0, y=2.0, z=1.5, sped=1.0), "argument of go_to .*'sped'.*did you mean 'speed'"),
        (lambda drone: drone.go_to(x=0.0, y=0.0, z=True), "z is True"),
        (lambda drone: drone.go_to(x=0.0, y=2e5, z=1.0), "y is 200000 m and must be within"),
        (lambda drone: drone.go_to(x=0.0, y=0.0, z=1.0, yaw=math.inf), "yaw is inf"),
        (lambda drone: drone.go_to(x=0.0, y=0.0, z=1.0, speed=0.0), "speed is 0 m/s and must be more than 0"),
        (lambda drone: drone.go_to(x=0.0, y=0.0, z=1.0, tolerance_m=0.0), "tolerance_m is 0 and must be more than 0"),
        (lambda drone: drone.go_to(x=0.0, y=0.0, z=1.0, tolerance_rad=-1), "tolerance_rad is -1"),
        (lambda drone: drone.go_to(), "go_to needs x, y and z, or latitude_deg"),
        (lambda drone: drone.go_to(x=1.0, z=1.0), "go_to needs x, y and z, or latitude_deg"),
        (lambda drone: drone.go_to(x=1.0, latitude_deg=47.0, longitude_deg=8.0), "but not both"),
        (lambda drone: drone.go_to(latitude_deg=47.0), "longitude_deg is None and must be a number"),
        (lambda drone: drone.go_to(latitude_deg=91.0, longitude_deg=8.0), "latitude_deg is 91"),
        (lambda drone: drone.go_to(latitude_deg=math.nan, longitude_deg=8.0), "latitude_deg is nan"),
        (lambda drone: drone.command(Position(0.0, 0.0, math.nan)), "NaN"),
        (lambda drone: drone.command(Position(0.0, 0.0, 1.0, speed=-1.0)), "position: speed is -1 m/s"),
        (lambda drone: drone.command(Position("a", 0.0, 1.0)), "that is not a number"),  # type: ignore[arg-type]
    ],
)
def test_unusable_arguments(drone: Drone, call: Callable[[Any], object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        call(drone)


def test_take_off_and_land(proxy: ScriptedProxy, drone: Drone) -> None:
    def vehicle() -> None:
        proxy.until_commanded(Takeoff())
        proxy.state = FlightState.TAKING_OFF
        proxy.until(lambda: proxy.actions().count(Takeoff()) > 3)
        proxy.state = FlightState.HOVERING
        proxy.until_commanded(Land())
        proxy.state = FlightState.LANDING
        proxy.until(lambda: proxy.actions().count(Land()) > 3)
        proxy.state = FlightState.LANDED

    thread = threading.Thread(target=vehicle)
    thread.start()
    drone.takeoff(timeout_s=WAIT_S)
    assert drone.feedback().state is FlightState.HOVERING
    drone.land(timeout_s=WAIT_S)
    assert drone.feedback().state is FlightState.LANDED
    thread.join(WAIT_S)
    after = len(proxy.commands)
    proxy.until(lambda: Idle() in proxy.actions()[after:], "a landed vehicle is told to land forever")


def test_a_landing_without_room_is_sent_before_the_next_set_point(proxy: ScriptedProxy, drone: Drone) -> None:
    connection = drone._connection
    transmit, full = connection.transmit, threading.Event()

    def through_a_full_socket(packet: bytes) -> bool:
        return not full.is_set() and transmit(packet)

    connection.transmit = through_a_full_socket
    drone.velocity(forward=0.1)
    proxy.until_commanded(Velocity(forward=0.1))
    full.set()
    assert not drone.command(Land())
    drone.velocity(forward=0.2)
    full.clear()
    proxy.until_commanded(Velocity(forward=0.2))
    actions = proxy.actions()
    assert actions[actions.index(Velocity(forward=0.2)) - 1] == Land()


def refuse(proxy: ScriptedProxy, command: Command, reason: Refusal, text: str, fate: Fate = Fate.REFUSED) -> None:
    """Report in feedback that this intent is over."""
    assert proxy.owner is not None
    proxy.more["outcome"] = Outcome(proxy.owner[0], command.intent, fate, reason, text)


def failsafe(proxy: ScriptedProxy, _: Command) -> None:
    proxy.more["failsafe"] = Failsafe.HOVER


def failsafe_before_others(proxy: ScriptedProxy, command: Command) -> None:
    """The application was silent, and a pilot takes the vehicle by hand from the failsafe."""
    proxy.more["others"] = "the vehicle is in LOITER, which was not chosen here"
    proxy.feedback()
    failsafe(proxy, command)


def not_fresh(proxy: ScriptedProxy, command: Command) -> None:
    refuse(proxy, command, Refusal.NOT_FRESH, "me: ask anew", Fate.AUTHORITY)


def lost_link(proxy: ScriptedProxy, _: Command) -> None:
    proxy.stop()
    proxy.start()


def lost_lease(proxy: ScriptedProxy, _: Command) -> None:
    assert proxy.owner is not None
    app_id, name, lease = proxy.owner
    proxy.owner = None
    proxy.event(EventKind.AUTHORITY_LOST, "", name, app_id=app_id, lease=lease, reason="silent")


def lost_lease_to_others(proxy: ScriptedProxy, command: Command) -> None:
    """A pilot takes the vehicle by hand while the application has no lease."""
    proxy.more["others"] = "the vehicle is in LOITER, which was not chosen here"
    proxy.feedback()
    lost_lease(proxy, command)


@pytest.mark.parametrize(
    "ending", [failsafe, failsafe_before_others, not_fresh, lost_link, lost_lease, lost_lease_to_others]
)
def test_an_ended_landing_is_requested_again(
    proxy: ScriptedProxy, drone: Drone, ending: Callable[[ScriptedProxy, Command], None]
) -> None:
    def vehicle() -> None:
        first = proxy.until_commanded(Land())
        assert not first.automatic
        ending(proxy, first)
        proxy.until(lambda: any(command.intent > first.intent for command in proxy.commands), "a new intent to land")
        proxy.more.clear()
        proxy.state = FlightState.LANDED

    proxy.state = FlightState.HOVERING
    drone.wait(lambda feedback: feedback.state is FlightState.HOVERING, WAIT_S)
    landing = background(vehicle)
    drone.land(timeout_s=2 * WAIT_S)
    landing.join(WAIT_S)
    assert {command.action for command in proxy.commands if command.intent > 0} <= {Land(), Idle()}
    again = [command for command in proxy.commands if command.action == Land()][-1]
    kept = ending in (failsafe_before_others, lost_link, lost_lease_to_others)
    assert again.automatic is kept, "a pilot who took the vehicle since keeps it; otherwise its requester does"


@pytest.mark.parametrize("pressed", ["before the lease is back", "long before the lease is back", "under the lease"])
def test_a_landing_requested_during_an_autopilots_return_stays_the_callers_when_repeated(
    proxy: ScriptedProxy, drone: Drone, pressed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was requested again as the library's own, and refused."""
    # Once the lease is back, everything that waited for it is too old to be sent, or nothing is.
    monkeypatch.setattr("skyloop.client.actions._KEEP_NS", -1 if pressed.startswith("long") else 10 * NS_PER_S)
    in_rtl = "the vehicle is in RTL, which was not chosen here"
    proxy.state = FlightState.FLYING
    drone.wait(lambda feedback: feedback.state is FlightState.FLYING, WAIT_S)
    if pressed == "under the lease":
        proxy.more["others"] = in_rtl
        drone.wait(lambda feedback: feedback.others == in_rtl, WAIT_S)
    else:
        proxy.answers[RequestAuthority] = None
        lost_lease(proxy, proxy.until_commanded(Idle()))
        drone._state.notifier.wait_for(lambda: drone.authority.state != "held", WAIT_S)

    def vehicle() -> None:
        if pressed == "under the lease":
            lost_lease(proxy, proxy.until_commanded(Land()))
        else:
            drone._state.notifier.wait_for(lambda: drone._commands.newest == Land(), WAIT_S)
            proxy.more["others"] = in_rtl
            drone.wait(lambda feedback: feedback.others == in_rtl, WAIT_S)
            del proxy.answers[RequestAuthority]
        proxy.until(lambda: any((c.action, c.lease) == (Land(), 2) for c in proxy.commands), "it is sent anew")
        proxy.more.clear()
        proxy.state = FlightState.LANDED

    landing = background(vehicle)
    drone.land(timeout_s=2 * WAIT_S)
    landing.join(WAIT_S)
    again = next(command for command in proxy.commands if (command.action, command.lease) == (Land(), 2))
    assert not again.automatic


@pytest.mark.parametrize("had", ["the lease", "no lease"])
def test_a_pilot_who_takes_over_a_landing_by_hand_keeps_it_whoever_had_the_vehicle(
    proxy: ScriptedProxy, drone: Drone, had: str
) -> None:
    """It was compared with the controller at the time of land(): the same words, or whatever preceded its lease."""
    others = "the vehicle is flown by others"
    proxy.state = FlightState.FLYING
    if had == "the lease":
        proxy.more["others"] = others
        drone.wait(lambda feedback: feedback.others == others, WAIT_S)
    else:
        proxy.answers[RequestAuthority] = None
        lost_lease(proxy, proxy.until_commanded(Idle()))
        drone._state.notifier.wait_for(lambda: drone.authority.state != "held", WAIT_S)

    def landings(lease: int) -> list[Command]:
        return [command for command in proxy.commands if (command.action, command.lease) == (Land(), lease)]

    def vehicle() -> None:
        if had == "no lease":
            drone._state.notifier.wait_for(lambda: drone._commands.newest == Land(), WAIT_S)
            del proxy.answers[RequestAuthority]
        # A landing on its way when the lease was lost may arrive first.
        proxy.until(lambda: proxy.owner is not None and landings(proxy.owner[2]) != [], "it lands under its lease")
        assert proxy.owner is not None
        first = landings(proxy.owner[2])[0]
        proxy.more["others"] = None
        proxy.more["outcome"] = Outcome(proxy.owner[0], first.intent)
        drone._state.notifier.wait_for(lambda: _told(drone) == first.intent, WAIT_S)
        del proxy.more["outcome"]
        proxy.more["others"] = others
        drone.wait(lambda feedback: feedback.others == others, WAIT_S)
        lost_lease(proxy, first)
        proxy.until(
            lambda: any(c.action == Land() and c.lease > first.lease for c in proxy.commands), "it is sent anew"
        )
        proxy.more.clear()
        proxy.state = FlightState.LANDED

    landing = background(vehicle)
    drone.land(timeout_s=2 * WAIT_S)
    landing.join(WAIT_S)
    assert [command for command in proxy.commands if command.action == Land()][-1].automatic


def _told(drone: Drone) -> int:
    told = drone._commands.newest_outcome
    return 0 if told is None else told.intent


def test_a_landing_abandoned_after_a_minute_is_not_requested_again(proxy: ScriptedProxy, drone: Drone) -> None:
    """Its caller may have forgotten it, and a vehicle that is back by then may be on another flight."""

    def vehicle() -> None:
        first = proxy.until_commanded(Land())
        refuse(proxy, first, Refusal.VEHICLE_LINK_LOST, "me: not heard for 60 s", Fate.TIMED_OUT)

    proxy.state = FlightState.HOVERING
    drone.wait(lambda feedback: feedback.state is FlightState.HOVERING, WAIT_S)
    losing = background(vehicle)
    with pytest.raises(RefusedError, match="not heard for 60 s"):
        drone.land(timeout_s=WAIT_S)
    losing.join(WAIT_S)
    assert len({command.intent for command in proxy.commands if command.action == Land()}) == 1


def test_a_landing_ended_by_a_newer_command_is_over(proxy: ScriptedProxy, drone: Drone) -> None:
    def change_of_mind() -> None:
        proxy.until_commanded(Land())
        drone.hover()
        proxy.until_commanded(Hover())
        proxy.more["failsafe"] = Failsafe.HOVER

    proxy.state = FlightState.HOVERING
    drone.wait(lambda feedback: feedback.state is FlightState.HOVERING, WAIT_S)
    changing = background(change_of_mind)
    with pytest.raises(NoAnswerError, match="land was not completed"):
        drone.land(timeout_s=0.5)
    changing.join(WAIT_S)
    assert len({command.intent for command in proxy.commands if command.action == Land()}) == 1


@pytest.mark.parametrize("ending", [Land(), EmergencyStop(), Hover(), Idle()])
def test_a_take_off_that_the_application_ends_raises_at_once(
    proxy: ScriptedProxy, drone: Drone, ending: AnyAction
) -> None:
    """It waited for its whole time-out, although another thread had landed the vehicle or stopped its motors."""

    def change_of_mind() -> None:
        proxy.until_commanded(Takeoff())
        drone.command(ending)
        at = len(proxy.commands)
        proxy.more["outcome"] = Outcome(drone.app_id, proxy.until_commanded(ending, at).intent, Fate.COMPLETED)

    changing = background(change_of_mind)
    begun_s = time.monotonic()
    with pytest.raises(RefusedError, match="takeoff was ended by another command") as raised:
        drone.takeoff(timeout_s=3 * WAIT_S)
    changing.join(WAIT_S)
    assert raised.value.code == "replaced"
    assert time.monotonic() - begun_s < 2 * WAIT_S
    assert drone._commands.newest in (ending, Idle()), "later commands are left alone"


@pytest.mark.parametrize("behind", [Hover(), Idle(), Velocity(forward=0.1)])
def test_commands_behind_a_started_take_off_do_not_end_it(
    proxy: ScriptedProxy, drone: Drone, behind: AnyAction
) -> None:
    def vehicle() -> None:
        proxy.until_commanded(Takeoff())
        proxy.state = FlightState.TAKING_OFF
        drone.wait("taking_off", WAIT_S)
        drone.command(behind)
        at = len(proxy.commands)
        proxy.more["outcome"] = Outcome(drone.app_id, proxy.until_commanded(behind, at).intent)
        drone.wait(lambda feedback: feedback.outcome is not None, WAIT_S)
        proxy.state = FlightState.HOVERING

    rising = background(vehicle)
    drone.takeoff(timeout_s=WAIT_S)
    rising.join(WAIT_S)


@pytest.mark.parametrize("since", [Hover(), Idle(), Velocity(forward=0.1), Land()])
def test_a_take_off_is_not_repeated_over_a_newer_command(
    proxy: ScriptedProxy, drone: Drone, monkeypatch: pytest.MonkeyPatch, since: AnyAction
) -> None:
    """Another thread gave a command between the check of the outcome and the repeat: the vehicle took off."""
    commands, looks = drone._commands, 0
    outcome = commands.outcome

    def seen(intent: int) -> Outcome | None:
        nonlocal looks
        found = outcome(intent)
        if found is not None and found.reason is Refusal.DRIVER_FAILED:
            looks += 1
            if looks == 2:  # the repeat
                time.sleep(0.6)
                drone.command(since)
        return found

    def vehicle() -> None:
        refuse(proxy, proxy.until_commanded(Takeoff()), Refusal.DRIVER_FAILED, "me: not yet")

    monkeypatch.setattr(commands, "outcome", seen)
    refusing = background(vehicle)
    with pytest.raises((NoAnswerError, RefusedError)):
        drone.takeoff(timeout_s=2.0)
    refusing.join(WAIT_S)
    assert looks >= 2
    assert len({command.intent for command in proxy.commands if command.action == Takeoff()}) == 1


def test_a_page_not_known_to_be_present_sends_no_flying_commands(proxy: ScriptedProxy, drone: Drone) -> None:
    """A page without reception flew on by its sticks: each of their messages was a new command, sent at once."""
    proxy.state = FlightState.FLYING
    drone.wait("flying", WAIT_S)
    commands = extend.commands(drone)
    commands.flown_by_person()
    commands.present_until(time.monotonic_ns() + 60_000_000_000)
    assert drone.velocity(forward=0.1)
    proxy.until_commanded(Velocity(forward=0.1))
    drone._commands._present_until_ns = time.monotonic_ns() - 1  # as if all that time had passed
    at = proxy.commands[-1].seq
    assert not drone.velocity(forward=0.2)
    assert not drone.command(Takeoff())
    with pytest.raises(AuthorityError, match="takeoff was not sent: the person flying is not known to be present"):
        drone.takeoff(wait=False)
    assert extend.let_go(drone, "the page is gone"), "a command that ends a flight is still sent"
    proxy.until_commanded(Hover())
    later = [command.action for command in proxy.commands if command.seq > at]
    assert Velocity(forward=0.2) not in later
    assert Takeoff() not in later
    assert drone.emergency_stop()
    proxy.until_commanded(EmergencyStop())


def test_a_reason_is_no_older_than_the_last_change_of_its_subject(proxy: ScriptedProxy, drone: Drone) -> None:
    """The link had been up for 4 s, and the error still said that it was connecting."""

    def vehicle() -> None:
        command = proxy.until_commanded(Takeoff())
        refuse(proxy, command, Refusal.VEHICLE_LINK_LOST, "me: the link is connecting")
        proxy.until(lambda: proxy.commands[-1].intent > command.intent)
        assert proxy.owner is not None
        proxy.more["outcome"] = Outcome(proxy.owner[0], proxy.commands[-1].intent)

    thread = background(vehicle)
    with pytest.raises(NoAnswerError, match=r"the vehicle is landed$"):
        drone.takeoff(timeout_s=2.0)
    thread.join(WAIT_S)


@pytest.mark.parametrize(
    ("ending", "why"),
    [
        (failsafe, "a failsafe took over"),
        (not_fresh, "the authority was granted again, lost or given back"),
        (lost_link, "the application's connection was lost"),
        (lost_lease, "the authority was granted again, lost or given back"),
    ],
)
@pytest.mark.parametrize("state", [FlightState.LANDED, FlightState.LANDING, FlightState.HOVERING])
def test_a_take_off_ended_by_a_failsafe_or_a_new_lease_raises_at_once_and_is_not_repeated(
    proxy: ScriptedProxy,
    drone: Drone,
    ending: Callable[[ScriptedProxy, Command], None],
    why: str,
    state: FlightState,
) -> None:
    """It waited for its whole time-out."""

    def vehicle() -> None:
        first = proxy.until_commanded(Takeoff())
        if state is not FlightState.LANDED:
            proxy.state = FlightState.TAKING_OFF
            drone.wait(lambda feedback: feedback.state is FlightState.TAKING_OFF, WAIT_S)
        ending(proxy, first)
        proxy.state = state

    taking_off = background(vehicle)
    if state is FlightState.HOVERING:
        drone.takeoff(timeout_s=100.0)  # a vehicle that has risen by then ends in a hover, as requested
    else:
        with pytest.raises(RefusedError, match=f"takeoff was ended because .*{why}: take off again") as raised:
            drone.takeoff(timeout_s=100.0)
        assert raised.value.code == "not_fresh"
    taking_off.join(WAIT_S)
    proxy.from_now_on(Idle())
    assert len({command.intent for command in proxy.commands if command.action == Takeoff()}) == 1


def test_a_take_off_that_does_not_happen(proxy: ScriptedProxy, drone: Drone) -> None:
    with pytest.raises(NoAnswerError, match=r"takeoff was not completed within 0\.05 s: the vehicle is landed$"):
        drone.takeoff(timeout_s=0.05)
    proxy.commands.clear()

    def vehicle() -> None:
        command = proxy.until_commanded(Takeoff())
        refuse(proxy, command, Refusal.VEHICLE_LINK_LOST, "me: no GPS")

    thread = threading.Thread(target=vehicle)
    thread.start()
    with pytest.raises(NoAnswerError, match="landed; me: no GPS"):
        drone.takeoff(timeout_s=1.5)
    thread.join(WAIT_S)


def test_a_reason_is_no_older_than_the_link_state_it_names(proxy: ScriptedProxy, drone: Drone) -> None:
    """Betaflight's take-off failed with "the link is connecting", seconds after it was up."""
    proxy.more["vehicle_link"] = "connecting"
    drone.wait(lambda feedback: feedback.vehicle_link is LinkState.CONNECTING, WAIT_S)

    def vehicle() -> None:
        command = proxy.until_commanded(Takeoff())
        refuse(proxy, command, Refusal.VEHICLE_LINK_LOST, "me: the link to the vehicle is connecting")
        drone.wait(lambda feedback: feedback.outcome is not None and feedback.outcome.failed, WAIT_S)
        proxy.more["vehicle_link"] = "up"

    comes_up = background(vehicle)
    with pytest.raises(NoAnswerError, match=r"the vehicle is landed$"):
        drone.takeoff(timeout_s=0.8)
    comes_up.join(WAIT_S)
    proxy.more |= {"vehicle_link": "lost", "link_reason": "no reply"}
    drone.wait(lambda feedback: feedback.vehicle_link is LinkState.LOST, WAIT_S)
    with pytest.raises(NoAnswerError, match=r"and its own link is lost \(no reply\)$"):
        drone.takeoff(timeout_s=0.2)


def test_a_reason_ends_with_the_take_off_that_it_delayed(proxy: ScriptedProxy, drone: Drone) -> None:
    def vehicle() -> None:
        first = proxy.until_commanded(Takeoff())
        refuse(proxy, first, Refusal.DRIVER_FAILED, "me: BOOTGRACE")
        proxy.until(lambda: proxy.commands[-1].intent > first.intent, "the next take-off")
        proxy.more["outcome"] = Outcome(drone.app_id, proxy.commands[-1].intent)

    rises = background(vehicle)
    with pytest.raises(NoAnswerError, match=r"the vehicle is landed$"):
        drone.takeoff(timeout_s=1.5)
    rises.join(WAIT_S)


def test_a_waking_vehicle_is_not_asked_repeatedly(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.more |= {"vehicle_link": "up", "link_reason": f"{WAKING_UP}: its own checks do not pass yet"}
    drone.wait(lambda feedback: feedback.waking_up, WAIT_S)

    def vehicle() -> None:
        refuse(proxy, proxy.until_commanded(Takeoff()), Refusal.DRIVER_FAILED, "me: not yet")

    refuses = background(vehicle)
    with pytest.raises(NoAnswerError, match=r"landed; it is still waking up: its own checks do not pass yet$"):
        drone.takeoff(timeout_s=1.5)
    refuses.join(WAIT_S)
    assert len({command.intent for command in proxy.commands if command.action == Takeoff()}) == 1


@pytest.mark.parametrize(
    ("reason", "error"), [(Refusal.UNSUPPORTED, UnsupportedError), (Refusal.WRONG_STATE, RefusedError)]
)
def test_a_take_off_that_is_refused_for_good(
    proxy: ScriptedProxy, drone: Drone, reason: Refusal, error: type[Exception]
) -> None:
    def vehicle() -> None:
        command = proxy.until_commanded(Takeoff())
        proxy.event(EventKind.COMMAND_REFUSED, "somebody: no", "somebody", reason=reason.value, seq=command.seq)
        refuse(proxy, command, reason, "me: never")

    thread = threading.Thread(target=vehicle)
    thread.start()
    with pytest.raises(error, match="me: never"):
        drone.takeoff(timeout_s=WAIT_S)
    thread.join(WAIT_S)
    after = len(proxy.commands)
    proxy.until(lambda: Idle() in proxy.actions()[after:], "what was refused is asked for no longer")


def test_a_refusal_from_an_earlier_session_has_no_effect(proxy: ScriptedProxy, drone: Drone) -> None:
    """After a reconnection, land(), takeoff() and go_to() raised within a millisecond, even under another's name."""
    proxy.more["outcome"] = Outcome(drone.app_id + 1, 1, Fate.REFUSED, Refusal.WRONG_STATE, "me: never")
    drone.wait(lambda feedback: feedback.outcome is not None, WAIT_S)
    with pytest.raises(NoAnswerError, match=r"within 0\.3 s: the vehicle is landed$"):
        drone.takeoff(timeout_s=0.3)


def test_the_outcome_of_another_command_does_not_affect_a_take_off(proxy: ScriptedProxy, drone: Drone) -> None:
    """A controller's velocity was refused on the ground, and takeoff() raised its refusal."""

    def vehicle() -> None:
        proxy.until_commanded(Takeoff())
        drone.velocity(forward=0.1)
        refuse(proxy, proxy.until_commanded(Velocity(forward=0.1)), Refusal.WRONG_STATE, "me: never")
        drone.wait(lambda feedback: feedback.outcome is not None, WAIT_S)
        proxy.state = FlightState.HOVERING

    flying = background(vehicle)
    drone.takeoff(timeout_s=WAIT_S)
    flying.join(WAIT_S)


@pytest.mark.parametrize("state", [FlightState.LANDED, FlightState.TAKING_OFF])
def test_a_take_off_that_times_out_is_withdrawn(proxy: ScriptedProxy, drone: Drone, state: FlightState) -> None:
    """It raised at 4 s and took off at 14.6 s, while the program waited for a person."""
    proxy.state = state
    drone.wait(state.value, WAIT_S)
    with pytest.raises(NoAnswerError):
        drone.takeoff(timeout_s=0.2)
    instead = Idle() if state is FlightState.LANDED else Hover()
    number = drone._commands.intent
    later = proxy.from_now_on(instead)
    assert Takeoff() not in [command.action for command in later]
    assert {command.intent for command in later} == {number}, "no new intent: it takes the vehicle from no one"


def test_another_priority_under_the_same_lease_does_not_withdraw_a_take_off(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.answers[RequestAuthority] = AuthorityGranted(drone.authority.lease)
    drone.takeoff(wait=False)
    proxy.until(lambda: proxy.actions().count(Takeoff()) > 20, "more than half a second passed")
    drone.request_authority(5)
    after = len(proxy.commands)
    proxy.until(lambda: len(proxy.commands) > after + 4, "it goes on")
    assert set(proxy.actions()[after + 1 :]) == {Takeoff()}


def interrupt(_: Feedback) -> bool:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("action", "state", "instead"),
    [
        (Takeoff(), FlightState.LANDED, Land()),
        (Takeoff(), FlightState.TAKING_OFF, Hover()),
        (Position(1.0, 2.0, 1.5), FlightState.FLYING, Hover()),
        (Land(), FlightState.LANDING, Land()),
    ],
)
def test_an_interrupted_call_leaves_nothing_for_later(
    proxy: ScriptedProxy, drone: Drone, action: AnyAction, state: FlightState, instead: AnyAction
) -> None:
    """Ctrl-C in go_to() or takeoff() stopped nothing: it flew on, or took off 6 s later. A landing continues."""
    proxy.state = state
    drone.wait(state.value, WAIT_S)
    with pytest.raises(KeyboardInterrupt):
        drone._piloting.complete(action, interrupt, True, WAIT_S)
    assert {command.action for command in proxy.from_now_on(instead)} == {instead}


def test_a_take_off_that_is_not_possible_yet_is_repeated_until_its_time_is_over(
    proxy: ScriptedProxy, drone: Drone
) -> None:
    """The driver gave up after 25 s, the vehicle was ready at 43 s, and the call waited for nothing until 120 s."""

    def vehicle() -> None:
        first = proxy.until_commanded(Takeoff())
        refuse(proxy, first, Refusal.DRIVER_FAILED, "me: no GPS")
        proxy.until(lambda: proxy.commands[-1].intent > first.intent and proxy.commands[-1].action == Takeoff())
        refuse(proxy, proxy.commands[-1], Refusal.DRIVER_FAILED, "me: it calibrates")

    refusing = background(vehicle)
    with pytest.raises(NoAnswerError, match="landed; me: it calibrates"):
        drone.takeoff(timeout_s=3.0)  # the vehicle has refused twice by then, on any machine
    refusing.join(WAIT_S)
    assert 2 <= len({command.intent for command in proxy.commands if command.action == Takeoff()}) <= 3


def test_a_take_off_ended_by_the_proxy_after_20_s_is_repeated_while_its_caller_waits(
    proxy: ScriptedProxy, drone: Drone
) -> None:
    """The library withdrew it earlier, and the call waited for nothing until its 120 s were over."""
    assert actions._AT_MOST_NS[Takeoff] >= TAKEOFF_NS + 500_000_000, "the proxy's report comes first"

    def vehicle() -> None:
        first = proxy.until_commanded(Takeoff())
        assert not first.automatic
        refuse(proxy, first, Refusal.NOT_FRESH, "me: it stands", Fate.TIMED_OUT)
        proxy.until(lambda: proxy.commands[-1].intent > first.intent and proxy.commands[-1].action == Takeoff())
        assert proxy.commands[-1].automatic, "no one decided again to take it from others"
        del proxy.more["outcome"]
        proxy.state = FlightState.FLYING

    flying = background(vehicle)
    drone.takeoff(timeout_s=WAIT_S)
    flying.join(WAIT_S)


def test_no_take_off_is_repeated_once_the_flight_ends(proxy: ScriptedProxy, drone: Drone) -> None:
    drone._commands.bar()
    with pytest.raises(ClosedError, match="too late"):
        drone._commands.ask(Takeoff(), automatic=True)


def test_a_refused_take_off_without_a_waiting_call_is_not_repeated(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.takeoff(wait=False)
    refuse(proxy, proxy.until_commanded(Takeoff()), Refusal.DRIVER_FAILED, "me: not yet")
    drone.wait(lambda feedback: feedback.outcome is not None, WAIT_S)
    assert {command.action for command in proxy.from_now_on(Idle())} == {Idle()}


def test_a_set_point_returns_false_while_set_points_are_refused(proxy: ScriptedProxy, drone: Drone) -> None:
    """After another's LAND it returned True 60 of 60 times, while each was refused."""
    proxy.state = FlightState.LANDING
    assert drone.velocity(forward=0.1)
    why = "me: velocity refused: the vehicle is in LAND"
    refuse(proxy, proxy.until_commanded(Velocity(forward=0.1)), Refusal.WRONG_STATE, why, Fate.OTHERS)
    drone.wait(lambda feedback: feedback.outcome is not None, WAIT_S)
    assert not drone.velocity(forward=0.2)
    assert not drone.velocity(forward=0.3)
    proxy.until_commanded(Velocity(forward=0.3))
    assert drone.hover()
    assert drone.velocity(forward=0.4), "a hover may have taken the vehicle back"


def test_a_landing_is_repeated_until_the_proxy_reports_it_as_complete(proxy: ScriptedProxy, drone: Drone) -> None:
    """Earlier feedback showed "landed": one packet was sent, then Idle. If that was lost, the drone kept hovering."""
    proxy.more["outcome"] = Outcome()
    drone.wait(lambda feedback: feedback.outcome is not None, WAIT_S)
    landing = background(lambda: drone.land(timeout_s=WAIT_S))
    command = proxy.until_commanded(Land())
    proxy.more["outcome"] = Outcome(drone.app_id, command.intent)
    proxy.until(lambda: proxy.actions().count(Land()) > 15, "it is repeated for more than 0.3 s")
    proxy.more["outcome"] = Outcome(drone.app_id, command.intent, Fate.COMPLETED)
    landing.join(WAIT_S)
    assert not landing.is_alive()
    after = len(proxy.commands)
    proxy.until(lambda: Idle() in proxy.actions()[after:], "it is done")


PLACE = Position(1.0, 2.0, 1.5, 0.5, 0.8)
THERE = {"position_m": (1.1, 2.0, 1.5), "yaw_rad": 0.45, "velocity_m_s": (0.0, 0.0, 0.0)}


def go_to(drone: Drone, timeout_s: float = WAIT_S) -> None:
    drone.go_to(x=1.0, y=2.0, z=1.5, yaw=0.5, speed=0.8, timeout_s=timeout_s)


@pytest.mark.parametrize(
    "not_yet",
    [
        {"position_m": (1.3, 2.0, 1.5)},
        {"position_m": None},
        {"yaw_rad": 0.8},
        {"yaw_rad": None},
        {"velocity_m_s": (0.5, 0.0, 0.0)},
    ],
)
def test_go_to_waits_until_the_vehicle_is_there(proxy: ScriptedProxy, drone: Drone, not_yet: dict[str, Any]) -> None:
    proxy.state = FlightState.FLYING
    proxy.more |= THERE | not_yet
    with pytest.raises(NoAnswerError, match=r"position was not completed within 0\.3 s: the vehicle is flying$"):
        go_to(drone, timeout_s=0.3)
    proxy.until_commanded(PLACE)
    arriving = background(lambda: proxy.until_commanded(PLACE, len(proxy.commands)), lambda: proxy.more.update(THERE))
    go_to(drone)
    arriving.join(WAIT_S)
    after = len(proxy.commands)
    proxy.until(lambda: proxy.actions()[after:].count(PLACE) > 3, "it is told to stay there")


def test_go_to_need_not_wait_and_does_not_decay(proxy: ScriptedProxy) -> None:
    with flown(proxy, stall_s=0.05) as drone:
        drone.go_to(x=1, y=2, z=1.5, wait=False)
        wanted = Position(1.0, 2.0, 1.5)
        proxy.until(lambda: proxy.actions().count(wanted) > 8, "a target is safe to hold")
        assert Hover() not in proxy.actions()
        assert {command.intent for command in proxy.commands if command.action == wanted} == {1}


@pytest.mark.parametrize(
    ("reason", "error"),
    [
        (Refusal.UNSUPPORTED, UnsupportedError),
        (Refusal.WRONG_STATE, RefusedError),
        (Refusal.OUT_OF_RANGE, RefusedError),
        (Refusal.DRIVER_FAILED, RefusedError),
    ],
)
def test_a_refused_place(
    proxy: ScriptedProxy, drone: Drone, reason: Refusal, error: type[RefusedError | UnsupportedError]
) -> None:
    proxy.state = FlightState.FLYING

    def vehicle() -> None:
        command = proxy.until_commanded(PLACE)
        refuse(proxy, command, reason, "me: never")

    refusing = background(vehicle)
    with pytest.raises(error, match="me: never"):
        go_to(drone)
    refusing.join(WAIT_S)
    after = len(proxy.commands)
    proxy.until(lambda: Idle() in proxy.actions()[after:], "what was refused is asked for no longer")


def test_a_failsafe_and_another_command_end_a_flight_to_a_place(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.state = FlightState.FLYING
    failing = background(lambda: failsafe(proxy, proxy.until_commanded(PLACE)))
    with pytest.raises(RefusedError, match="position was ended by a failsafe or a lost link"):
        go_to(drone)
    failing.join(WAIT_S)
    proxy.more["failsafe"] = Failsafe.NONE
    before = len(proxy.commands)
    hovering = background(lambda: proxy.until_commanded(PLACE, before), drone.hover)
    with pytest.raises(RefusedError, match="ended by another command"):
        go_to(drone)
    hovering.join(WAIT_S)


def test_losing_the_authority_ends_the_way(proxy: ScriptedProxy, drone: Drone) -> None:
    taking_over = background(lambda: proxy.until_commanded(PLACE), proxy.take_over)
    with pytest.raises(AuthorityError, match="boss took over"):
        go_to(drone)
    taking_over.join(WAIT_S)


def test_an_older_proxy_is_never_sent_unknown_actions(proxy: ScriptedProxy) -> None:
    older = frozenset({"takeoff", "land", "hover", "velocity"})
    proxy.capabilities = msgspec.structs.replace(proxy.capabilities, actions=older)
    with flown(proxy) as drone:
        for wait in (True, False):
            with pytest.raises(UnsupportedError, match="an older proxy must be updated"):
                drone.go_to(x=0.0, y=0.0, z=1.0, wait=wait)
        with pytest.raises(UnsupportedError, match="position is not possible"):
            drone.command(Position(0.0, 0.0, 1.0))
        drone.hover()
        proxy.until_commanded(Hover())
        assert Position not in map(type, proxy.actions())


def test_closing_or_losing_the_authority_ends_a_take_off(proxy: ScriptedProxy, drone: Drone) -> None:
    taking_over = background(lambda: proxy.until_commanded(Takeoff()), proxy.take_over)
    with pytest.raises(AuthorityError, match="boss took over"):
        drone.takeoff(timeout_s=WAIT_S)
    taking_over.join(WAIT_S)
    proxy.give_back(drone.app_id, "me")
    drone.wait(lambda _: drone.authority.state == "held", WAIT_S)
    closing = background(lambda: proxy.until(lambda: proxy.actions().count(Takeoff()) > 5), drone.close)
    with pytest.raises(ClosedError):
        drone.takeoff(timeout_s=WAIT_S)
    closing.join(WAIT_S)


def test_a_vehicle_that_cannot_fly() -> None:
    with scripted(can_fly=False) as proxy, flown(proxy) as drone:
        assert drone.authority.state == "held"
        for call in (drone.takeoff, drone.hover, drone.velocity, drone.land):
            with pytest.raises(UnsupportedError, match="it has no motors"):
                call()


def test_a_stalled_application_hovers_and_is_notified(proxy: ScriptedProxy) -> None:
    events: list[Event] = []
    with flown(proxy, stall_s=0.1) as drone, drone.on_event(events.append):
        drone.velocity(forward=1.0)
        proxy.until_commanded(Hover())
        drone.wait(lambda _: any(event.kind is EventKind.FAILSAFE for event in events), WAIT_S)
    told = [event for event in events if event.kind is EventKind.FAILSAFE]
    assert len(told) == 1
    assert (told[0].seq, told[0].data) == (0, {"step": "hover", "reason": "stalled"})


def test_pre_emption_and_return(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.velocity(forward=1.0)
    proxy.until_commanded(Velocity(forward=1.0))
    proxy.take_over("boss")
    drone.wait(lambda _: drone.authority.state == "preempted", WAIT_S)
    assert drone.authority == AuthorityStatus("preempted", 0, 16, "boss", 0)
    with pytest.raises(AuthorityError, match="boss took over"):
        drone.velocity(forward=1.0)
    seq = drone.feedback().seq
    before = len(proxy.commands)
    drone.wait(lambda feedback: feedback.seq > seq + 8, WAIT_S)
    assert len(proxy.commands) == before, "nothing is sent without the authority"
    proxy.give_back(drone.app_id, "me")
    drone.wait(lambda _: drone.authority.state == "held", WAIT_S)
    proxy.until(lambda: len(proxy.commands) > before + 3)
    assert set(proxy.actions()[before:]) == {Idle()}, "the old set-point is not resumed"
    assert proxy.commands[-1].lease == drone.authority.lease == 3
    assert drone.velocity(forward=0.7)
    assert proxy.until_commanded(Velocity(forward=0.7)).lease == 3


def test_a_pre_emption_with_a_lost_event_shows_in_feedback(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.grant(99, "boss")
    drone.wait(lambda _: drone.authority.state == "preempted", WAIT_S)
    proxy.grant(drone.app_id, "me")
    drone.wait(lambda _: drone.authority.state == "held", WAIT_S)


def test_a_lease_lost_by_silence_is_requested_again(proxy: ScriptedProxy, drone: Drone) -> None:
    assert proxy.owner is not None
    app_id, _, lease = proxy.owner
    proxy.owner = None
    proxy.event(EventKind.AUTHORITY_LOST, "", "me", app_id=app_id, lease=lease, reason="silent")
    drone.wait(lambda _: drone.authority.lease == lease + 1, WAIT_S)
    assert drone.authority.state == "held"


def test_a_failsafe_ends_the_set_point(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.velocity(forward=1.0)
    proxy.until_commanded(Velocity(forward=1.0))
    proxy.more["failsafe"] = Failsafe.HOVER
    drone.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, WAIT_S)
    before = len(proxy.commands)
    proxy.until(lambda: len(proxy.commands) > before + 3)
    assert set(proxy.actions()[before + 1 :]) == {Idle()}


def test_a_listeners_command_in_response_to_a_failsafe_stays(proxy: ScriptedProxy, drone: Drone) -> None:
    def answer(feedback: Feedback) -> None:
        if feedback.failsafe is Failsafe.HOVER and not answered:
            answered.append(drone.velocity(left=0.5))

    answered: list[bool] = []
    with drone.on_feedback(answer, inline=True):
        proxy.more["failsafe"] = Failsafe.HOVER
        proxy.until(lambda: proxy.actions().count(Velocity(left=0.5)) >= 4)
    assert len(answered) == 1


def test_released_and_requested_again(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.release_authority()
    assert drone.authority.state == "none"
    assert isinstance(proxy.requests[-1], ReleaseAuthority)
    with pytest.raises(AuthorityError, match="request_authority"):
        drone.hover()
    status = drone.request_authority(3)
    assert (status.state, status.priority) == ("held", 3)
    assert RequestAuthority(3) in proxy.requests
    assert drone.request_authority().priority == 3
    drone.release_authority()
    drone.release_authority()


def test_another_application_flies(proxy: ScriptedProxy) -> None:
    proxy.grant(99, "ada")
    with pytest.raises(AuthorityError, match=r"ada holds the authority: wait longer.*access=\"observe\"") as error:
        open_drone(proxy.server.dial, app="me", policy=QUICK, timeout_s=WAIT_S)
    assert error.value.code == "busy"
    with pytest.raises(AuthorityError, match=r"did not give it back within 0\.05 s"):
        open_drone(proxy.server.dial, app="me", policy=QUICK, authority=Authority(wait_s=0.05), timeout_s=WAIT_S)
    proxy.until(lambda: isinstance(proxy.requests[-1], ReleaseAuthority), "leaving the line")


def test_waiting_in_the_queue(proxy: ScriptedProxy) -> None:
    proxy.grant(99, "ada")
    answered = background(
        lambda: proxy.until(lambda: any(isinstance(request, RequestAuthority) for request in proxy.requests)),
        lambda: proxy.give_back(1, "me"),
    )
    with flown(proxy, wait_s=WAIT_S) as drone:
        assert drone.authority.state == "held"
    answered.join(WAIT_S)


def test_refused_and_not_answered(proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch) -> None:
    proxy.answers[RequestAuthority] = Refused(Refusal.BUSY, "closed today")
    with pytest.raises(AuthorityError, match="closed today"):
        open_drone(proxy.server.dial, app="me", policy=QUICK, timeout_s=WAIT_S)
    monkeypatch.setattr("skyloop.client.commands.ANSWER_S", 0.1)
    proxy.answers[RequestAuthority] = None
    with pytest.raises(NoAnswerError, match="did not answer the request for the authority"):
        open_drone(proxy.server.dial, app="me", policy=QUICK, timeout_s=WAIT_S)


def asked(proxy: ScriptedProxy) -> int:
    """Return how often the authority was requested."""
    return sum(isinstance(request, RequestAuthority) for request in list(proxy.requests))


def test_a_link_lost_before_the_answer_is_not_an_answer(proxy: ScriptedProxy) -> None:
    proxy.answers[RequestAuthority] = None
    lost = background(
        lambda: proxy.until(lambda: asked(proxy) > 0, "the request"),
        proxy.answers.clear,
        proxy.hang_up,
    )
    with flown(proxy) as drone:
        assert drone.authority.state == "held"
    lost.join(WAIT_S)
    assert asked(proxy) > 1


def test_a_link_lost_before_the_answer_is_reported(proxy: ScriptedProxy) -> None:
    drone = Drone(proxy.server.dial, app="me", policy=QUICK)
    drone._connect(timeout_s=WAIT_S, acquire=False)
    try:
        drone._commands.flown_by_person()
        drone._commands.present_until(time.monotonic_ns() + 60_000_000_000)
        proxy.answers[RequestAuthority] = None
        lost = background(lambda: proxy.until(lambda: asked(proxy) > 0, "the request"), proxy.hang_up)
        with pytest.raises(NoAnswerError, match="the link was lost, or the authority released"):
            drone._commands.request(RequestAuthority(), 0.0)
        lost.join(WAIT_S)
    finally:
        drone.close()


def test_a_reconnection_waits_until_the_earlier_session_is_forgotten(proxy: ScriptedProxy, drone: Drone) -> None:
    old = drone.authority.lease
    proxy.forgets = False
    before = asked(proxy)
    proxy.hang_up()
    proxy.until(lambda: asked(proxy) > before, "the request of the next session")
    drone.wait(lambda _: drone.authority.state == "queued", WAIT_S)
    assert drone.authority.holder == "me"
    assert drone.velocity(forward=0.1) is False  # nothing is raised: it is only a matter of time
    assert drone.authority.lease != old
    proxy.give_back(2, "me")
    drone.wait(lambda _: drone.authority.state == "held", WAIT_S)
    assert drone.velocity(forward=0.1)


def test_another_application_that_came_since_is_not_an_earlier_session(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.forgets = False
    proxy.hang_up()
    drone.wait(lambda _: drone.authority.state == "queued", WAIT_S)
    proxy.grant(99, "ada")
    drone.wait(lambda sample: sample.owner_id == 99 and drone.authority.holder == "ada", WAIT_S)
    with pytest.raises(AuthorityError, match="ada holds the authority"):
        drone.hover()


def test_a_new_connection_waits_until_the_earlier_drone_is_forgotten(proxy: ScriptedProxy) -> None:
    proxy.forgets = False
    with flown(proxy):
        proxy.answers[ReleaseAuthority] = Done()  # answered, but not done
    before = asked(proxy)
    free = background(
        lambda: proxy.until(lambda: asked(proxy) > before, "the request"), lambda: proxy.give_back(2, "me")
    )
    with flown(proxy) as drone:
        assert drone.authority.state == "held"
    free.join(WAIT_S)


def test_an_earlier_session_that_is_not_forgotten_is_named(
    proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skyloop.client.commands.OWN_S", 0.1)
    proxy.forgets = False
    with flown(proxy):
        proxy.answers[ReleaseAuthority] = Done()
    with pytest.raises(AuthorityError, match="holds the authority"), flown(proxy):
        pass


def test_an_observer_only_observes(proxy: ScriptedProxy) -> None:
    with flown(proxy, access="observe") as drone:
        assert drone.authority.state == "none"
        for call in (drone.hover, drone.emergency_stop, drone.request_authority):
            with pytest.raises(AuthorityError, match='access="pilot"') as error:
                call()
            assert error.value.code == "observer"
        assert drone.feedback().state is FlightState.LANDED


def test_emergency_stop_needs_no_authority(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.release_authority()
    assert drone.emergency_stop()
    assert proxy.until_commanded(EmergencyStop()).lease == 0
    proxy.until(lambda: proxy.actions().count(EmergencyStop()) >= 4)
    proxy.state = FlightState.EMERGENCY
    drone.wait("emergency", WAIT_S)
    seq = drone.feedback().seq
    drone.wait(lambda feedback: feedback.seq > seq + 3, WAIT_S)
    proxy.commands.clear()
    seq = drone.feedback().seq
    drone.wait(lambda feedback: feedback.seq > seq + 8, WAIT_S)
    assert proxy.commands == []
    assert drone.request_authority().state == "held"
    assert drone.reset_emergency()


def test_an_answer_to_a_takeover_request_can_be_awaited(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.answers[AnswerTakeover] = Done()
    extend.commands(drone).answer(1, 7, False, "a" * 10_000, wait=True)
    asked = proxy.requests[-1]
    assert isinstance(asked, AnswerTakeover)
    assert (asked.lease, asked.app_id, asked.grant, asked.reason) == (1, 7, False, "a" * MAX_REASON)
    proxy.answers[AnswerTakeover] = Refused(Refusal.NO_AUTHORITY, "it is not held any more")
    with pytest.raises(RefusedError, match="not held any more"):
        extend.commands(drone).answer(1, 7, True, "", wait=True)

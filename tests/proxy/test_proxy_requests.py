"""Requests: parameters, refusals, and the order in which requests wait for each other."""

from __future__ import annotations

import threading

import pytest

from skyloop.messages import (
    AnyRequest,
    Done,
    EventKind,
    FlightState,
    GetParameter,
    GetStatistics,
    Hello,
    LinkState,
    ListParameters,
    Parameter,
    ParameterPage,
    ParameterType,
    ParameterValue,
    Ping,
    Pong,
    Refusal,
    Refused,
    ReleaseAuthority,
    RequestAuthority,
    Role,
    SetParameter,
    Statistics,
    Value,
    Velocity,
    Welcome,
)
from skyloop.proxy.requests import MAX_KEPT, MAX_PENDING
from tests.support.proxy_bench import WAIT_S, App, Bench

FPS = Parameter("camera.fps", ParameterType.INT, 15, "1/s", 1, 30, 15)


def refused(app: App, body: AnyRequest) -> Refused:
    reply = app.ask(body)
    assert isinstance(reply, Refused), reply
    return reply


def test_the_welcome_has_the_identity_and_the_capabilities(bench: Bench) -> None:
    app = bench.stranger()
    welcome = app.hello("me", Role.OBSERVER)
    assert isinstance(welcome, Welcome)
    assert (welcome.app_id, welcome.proxy, welcome.uri, welcome.now_ns) == (1, "bench", "fake://", bench.clock())
    assert welcome.capabilities == bench.driver.capabilities()
    (event,) = app.told(EventKind.APPLICATION_LINK)
    assert (event.app, event.data["state"]) == ("me", "up")


@pytest.mark.parametrize(
    "body",
    [
        Ping(1),
        RequestAuthority(),
        ReleaseAuthority(),
        GetParameter("limits.tilt"),
        SetParameter("limits.tilt", 0.1, 1),
        ListParameters(),
        GetStatistics(),
    ],
    ids=lambda body: type(body).__name__,
)
def test_hello_comes_first(bench: Bench, body: AnyRequest) -> None:
    assert refused(bench.stranger(), body).code is Refusal.PROTOCOL


def test_hello_comes_once(bench: Bench) -> None:
    assert refused(bench.join("me"), Hello("you")).code is Refusal.PROTOCOL


def test_ping_returns_the_proxys_time(bench: Bench) -> None:
    assert bench.join("me").ask(Ping(77)) == Pong(77, bench.clock())


def test_a_parameter_is_written_reported_and_in_force(bench: Bench) -> None:
    pilot, witness = bench.airborne(), bench.join("witness", Role.OBSERVER)
    reply = pilot.ask(SetParameter("limits.speed", 1, pilot.lease))
    assert isinstance(reply, ParameterValue)
    assert reply.parameter.value == 1.0
    (event,) = witness.told(EventKind.PARAMETER_CHANGED)
    written = {"name": "limits.speed", "value": 1.0, "app_id": pilot.app_id}
    assert (event.app, event.data) == ("pilot", written)
    assert witness.ask(GetParameter("limits.speed")) == reply
    pilot.command(Velocity(5.0))
    assert bench.driver.told == [Velocity(1.0)]


@pytest.mark.parametrize(
    ("name", "value", "code", "words"),
    [
        ("limits.tlt", 0.2, Refusal.UNKNOWN_PARAMETER, "did you mean 'limits.tilt'"),
        ("limits.tilt", True, Refusal.WRONG_TYPE, "float"),
        ("limits.tilt", "steep", Refusal.WRONG_TYPE, "float"),
        ("limits.tilt", float("nan"), Refusal.NON_FINITE, "finite"),
        ("limits.tilt", 9.0, Refusal.OUT_OF_RANGE, "at most 1 rad"),
    ],
)
def test_a_bad_value_is_refused_with_its_reason(
    bench: Bench, name: str, value: Value, code: Refusal, words: str
) -> None:
    pilot = bench.pilot()
    reply = refused(pilot, SetParameter(name, value, pilot.lease))
    assert reply.code is code
    assert words in reply.message
    assert pilot.told(EventKind.PARAMETER_CHANGED) == []


def test_writing_needs_the_authority(bench: Bench) -> None:
    pilot, other = bench.pilot(), bench.join("other")
    assert refused(other, SetParameter("limits.tilt", 0.2, 0)).code is Refusal.NO_AUTHORITY
    assert refused(other, SetParameter("limits.tilt", 0.2, pilot.lease)).code is Refusal.FOREIGN_LEASE
    assert refused(pilot, SetParameter("limits.tilt", 0.2, pilot.lease + 1)).code is Refusal.FOREIGN_LEASE
    assert bench.proxy.parameters.number("limits.tilt") == 0.35


def test_all_parameters_are_listed_including_the_drivers() -> None:
    with Bench(parameters=[FPS]) as bench:
        page = bench.join("me").ask(ListParameters())
        assert isinstance(page, ParameterPage)
        names = [parameter.name for parameter in page.parameters]
        assert names == sorted(names)
        assert {"camera.fps", "limits.tilt"} <= set(names)


def test_the_timings_follow_their_parameters(bench: Bench) -> None:
    pilot = bench.airborne()
    for name, value in (("failsafe.hover_after_s", 1.0), ("authority.timeout_s", 0.5), ("command.max_age_s", 0.1)):
        assert isinstance(pilot.ask(SetParameter(name, value, pilot.lease)), ParameterValue)
    pilot.command(Velocity(0.1), sent_ns=bench.clock() - 110_000_000)
    assert pilot.refusals() == [Refusal.STALE]
    pilot.command(Velocity(0.1))
    bench.run(0.5)
    assert len(pilot.told(EventKind.AUTHORITY_LOST)) == 1
    assert bench.driver.told == [Velocity(0.1)]
    bench.run(0.5)
    assert len(bench.driver.told) == 2


@pytest.mark.parametrize("call", ["set_parameter", "parameters"])
def test_a_raising_driver_is_reported_and_refused(call: str) -> None:
    with Bench(parameters=[FPS]) as bench:
        pilot = bench.airborne()
        bench.driver.fail = {call}
        if call == "set_parameter":
            reply = refused(pilot, SetParameter("camera.fps", 20, pilot.lease))
            assert reply.code is Refusal.DRIVER_FAILED
            assert "set_parameter is broken" in reply.message
        else:  # those known before are still listed
            page = pilot.ask(ListParameters())
            assert isinstance(page, ParameterPage)
            assert "camera.fps" in [parameter.name for parameter in page.parameters]
        assert f"{call} is broken" in pilot.told(EventKind.DRIVER_ERROR)[0].text
        pilot.command(Velocity(0.5))
        assert bench.driver.told == [Velocity(0.5)]


def test_a_slow_driver_delays_neither_commands_nor_a_takeover() -> None:
    with Bench(parameters=[FPS]) as bench:
        alice, bob = bench.airborne("alice"), bench.join("bob")
        begun, go_on = threading.Event(), threading.Event()

        def hang() -> None:
            begun.set()
            assert go_on.wait(WAIT_S)

        bench.driver.while_setting = hang
        slow = alice.post(SetParameter("camera.fps", 20, alice.lease))
        assert begun.wait(WAIT_S)
        alice.command(Velocity(0.5), sync=False)
        bob.take_authority(0)
        bob.command(Velocity(0.25))
        assert bench.driver.told[0] == Velocity(0.5)
        assert bench.driver.told[-1] == Velocity(0.25)
        many = [bob.post(GetStatistics()) for _ in range(MAX_PENDING + 3)]
        for number in many[MAX_PENDING:]:  # refused at once, before the waiting ones
            reply = bob.answer(number)
            assert isinstance(reply, Refused)
            assert reply.code is Refusal.BUSY
        go_on.set()
        assert isinstance(alice.answer(slow), ParameterValue)
        for number in many[:MAX_PENDING]:
            assert isinstance(bob.answer(number), Statistics)
        assert isinstance(bob.ask(GetStatistics()), Statistics)


def test_releasing_without_holding_is_harmless(bench: Bench) -> None:
    assert bench.join("me").ask(ReleaseAuthority()) == Done()


def test_the_drivers_parameters_are_read_again_when_its_link_comes_up() -> None:
    with Bench() as bench:
        app = bench.join("me")
        bench.driver.native = [FPS]
        bench.driver.link(LinkState.LOST)
        bench.driver.link(LinkState.UP)
        app.ask(GetStatistics())  # the worker runs one job after another
        assert isinstance(app.ask(GetParameter("camera.fps")), ParameterValue)


def test_a_driver_parameter_too_large_to_send_is_reported() -> None:
    with Bench(parameters=[Parameter("a.huge", ParameterType.TEXT, "x" * 10_000), FPS]) as bench:
        app = bench.join("me")
        page = app.ask(ListParameters())
        assert isinstance(page, ParameterPage)
        assert "a.huge" not in [parameter.name for parameter in page.parameters]
        bench.run(1.0)  # it was reported when the proxy started: this is the sum
        assert "a.huge" in app.told(EventKind.DRIVER_ERROR)[-1].text


def test_a_repeated_request_joins_the_pending_one() -> None:
    """A write that takes the vehicle a second is written once, and the next read gets its answer."""
    with Bench(parameters=[FPS]) as bench:
        app, begun, go_on = bench.pilot(), threading.Event(), threading.Event()
        written: list[int] = []

        def slowly() -> None:
            written.append(1)
            begun.set()
            go_on.wait(WAIT_S)

        bench.driver.while_setting = slowly
        write = SetParameter("camera.fps", 20, app.lease)
        number = app.post(write)
        assert begun.wait(WAIT_S)
        for _ in range(MAX_PENDING + 4):
            app.repeat(number, write)
        app.sync()  # all of them have arrived
        go_on.set()
        assert isinstance(app.answer(number), ParameterValue)
        assert isinstance(app.ask(GetParameter("camera.fps")), ParameterValue)
        assert len(written) == 1


def test_a_repeated_write_is_answered_and_not_written_again() -> None:
    """The reply to a write was lost: its repeat gets the same reply."""
    with Bench(parameters=[FPS]) as bench:
        app = bench.pilot()
        written: list[int] = []
        bench.driver.while_setting = lambda: written.append(1)
        write = SetParameter("camera.fps", 20, app.lease)
        number = app.post(write)
        first = app.answer(number)
        app.repeat(number, write)
        assert app.answer(number) == first
        assert len(written) == 1


def test_a_momentary_write_that_waited_behind_a_slow_driver_is_dropped() -> None:
    """The flip's requester got a time-out after 2 s, and no longer expects it."""
    flip = Parameter("flip", ParameterType.TEXT, "none", choices=("none", "left"), momentary=True)
    with Bench(parameters=[FPS, flip]) as bench:
        app = bench.pilot()
        begun, go_on = threading.Event(), threading.Event()
        written: list[int] = []

        def slowly() -> None:
            written.append(1)
            begun.set()
            assert go_on.wait(WAIT_S)

        bench.driver.while_setting = slowly
        slow = app.post(SetParameter("camera.fps", 20, app.lease))
        assert begun.wait(WAIT_S)
        late = app.post(SetParameter("flip", "left", app.lease))
        value = app.post(SetParameter("camera.fps", 10, app.lease))
        app.sync()
        bench.clock.advance(2.1)
        go_on.set()
        assert isinstance(app.answer(slow), ParameterValue)
        refused = app.answer(late)
        assert isinstance(refused, Refused)
        assert refused.code is Refusal.STALE
        assert isinstance(app.answer(value), ParameterValue)
        assert len(written) == 2
        assert isinstance(app.ask(SetParameter("flip", "left", app.lease)), ParameterValue)


@pytest.mark.parametrize("why", ["closing", "battery", "failsafe", "others", ""])
def test_momentary_parameters_are_refused_while_others_have_the_vehicle(why: str) -> None:
    """A flip was written to the driver while the vehicle descended because its proxy was ending."""
    flip = Parameter("flip", ParameterType.TEXT, "none", choices=("none", "left"), momentary=True)
    with Bench(parameters=[flip, FPS]) as bench:
        done: list[object] = []
        bench.driver.while_setting = lambda: done.append("set")
        pilot = bench.airborne()
        if why == "closing":
            bench.proxy.handler.order_landing(bench.clock())
        elif why == "battery":
            bench.driver.report(battery=0.05)
        elif why == "failsafe":
            bench.driver.link(LinkState.LOST)
        elif why == "others":
            bench.driver.left = "LOITER"
            bench.driver.report(state=FlightState.FLYING)
        bench.tick()
        answer = pilot.ask(SetParameter("flip", "left", pilot.lease))
        if why:
            assert isinstance(answer, Refused)
            assert answer.code is Refusal.WRONG_STATE
            assert done == []
            assert isinstance(pilot.ask(SetParameter("camera.fps", 20, pilot.lease)), ParameterValue)
        else:
            assert isinstance(answer, ParameterValue)


def test_a_repeated_request_does_not_undo_a_release(bench: Bench) -> None:
    """The reply to a grant was lost: the library's repeat of the request must not take the authority back."""
    app = bench.join("app")
    request = RequestAuthority(16)
    number = app.post(request)
    granted = app.answer(number)
    assert app.ask(ReleaseAuthority()) == Done()
    app.repeat(number, request)
    assert app.answer(number) == granted  # it is not granted again
    assert bench.proxy.handler.authority.holder is None


def test_a_request_that_arrives_after_its_release_is_refused(bench: Bench) -> None:
    """The request itself was lost at first, and only its repeat arrives, after the release."""
    app = bench.join("app")
    late = app.reserve()
    assert app.ask(ReleaseAuthority()) == Done()
    app.repeat(late, RequestAuthority(16))
    reply = app.answer(late)
    assert isinstance(reply, Refused)
    assert reply.code is Refusal.NOT_FRESH
    assert bench.proxy.handler.authority.holder is None


def test_stored_answers_are_bounded_and_a_forgotten_request_is_not_executed_again() -> None:
    with Bench(parameters=[FPS]) as bench:
        app = bench.pilot()
        written: list[int] = []
        bench.driver.while_setting = lambda: written.append(1)
        write = SetParameter("camera.fps", 20, app.lease)
        first = app.post(write)
        app.answer(first)
        for _ in range(MAX_KEPT + 1):
            app.ask(write)
        app.repeat(first, write)
        app.sync()
        assert len(written) == MAX_KEPT + 2


def test_a_repeated_read_is_answered_with_the_current_value(bench: Bench) -> None:
    app = bench.pilot()
    read = GetParameter("limits.tilt")
    number = app.post(read)
    before = app.answer(number)
    app.ask(SetParameter("limits.tilt", 0.2, app.lease))
    app.repeat(number, read)
    after = app.answer(number)
    assert isinstance(before, ParameterValue)
    assert isinstance(after, ParameterValue)
    assert (before.parameter.value, after.parameter.value) == (0.35, 0.2)

"""The end of a proxy: everything is barred first, then a flying vehicle lands or hovers, and is no longer served."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from skyloop.messages import (
    AnyAction,
    Attitude,
    EmergencyStop,
    EventKind,
    FlightState,
    Hover,
    Land,
    Parameter,
    ParameterType,
    Refusal,
    ReleaseAuthority,
    SetParameter,
    Takeoff,
    Velocity,
)
from skyloop.proxy.serve import end_all
from skyloop.transport.testing import wait_until
from tests.support.proxy_bench import App, Bench

LONG_S = 30.0


@contextmanager
def ending(end: Callable[[], object]) -> Iterator[threading.Thread]:
    """Run it in a separate thread, which must have ended afterwards."""
    thread = threading.Thread(target=end)
    thread.start()
    yield thread
    thread.join(LONG_S)
    assert not thread.is_alive()


def land_told(bench: Bench) -> None:
    wait_until(lambda: Land() in bench.driver.told, "it is told to land")


@pytest.mark.parametrize("action", [Takeoff(), Velocity(0.5), Hover()])
def test_no_one_flies_it_while_it_lands(bench: Bench, action: AnyAction) -> None:
    """Neither its pilot nor a new one, whatever the priority; landing and emergency stop stay possible."""
    pilot = bench.airborne()
    with ending(lambda: bench.proxy.end(LONG_S)):
        land_told(bench)
        other = bench.pilot("other", priority=1)
        other.command(action)
        pilot.command(action)
        assert other.refusals() == [Refusal.WRONG_STATE]
        assert bench.driver.told == [Land()]
        other.command(Land())
        assert other.refusals() == [Refusal.WRONG_STATE]
        bench.driver.report(state=FlightState.HOVERING)
        other.command(Land())
        other.command(EmergencyStop())
        assert bench.driver.told == [Land(), Land(), EmergencyStop()]
    assert bench.driver.closed


def test_a_standing_vehicle_does_not_take_off_while_another_lands() -> None:
    """Both end on one signal, like those of a simulated world."""
    with Bench() as flying, Bench() as standing:
        flying.airborne()
        pilot = standing.pilot()
        ended = threading.Event()

        def end() -> None:
            end_all([flying.proxy, standing.proxy], LONG_S, reason="it is late", hurry=lambda: False)
            ended.set()

        with ending(end):
            land_told(flying)
            pilot.closed_by.get(timeout=LONG_S)
            assert not ended.is_set()
            flying.driver.report(state=FlightState.LANDED)
        assert standing.driver.told == []
        assert standing.driver.closed


def test_all_get_their_landing_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight drones of one simulated world got their landings 0.2 s apart."""
    with ExitStack() as stack:
        benches = [stack.enter_context(Bench()) for _ in range(4)]
        together = threading.Barrier(len(benches), timeout=LONG_S)
        for bench in benches:
            bench.airborne()
            apply = bench.driver._apply

            def meet(action: AnyAction, apply: Callable[[AnyAction], AnyAction] = apply) -> AnyAction:
                if isinstance(action, Land):
                    together.wait()  # broken, so that none lands, unless all get the command
                return apply(action)

            monkeypatch.setattr(bench.driver, "_apply", meet)
        proxies = [bench.proxy for bench in benches]
        with ending(lambda: end_all(proxies, LONG_S, reason="it is late", hurry=lambda: False)):
            for bench in benches:
                land_told(bench)
                bench.driver.report(state=FlightState.LANDED)


def test_a_failed_close_keeps_no_other_proxy_from_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    with Bench() as broken, Bench() as good:

        def fail() -> None:
            raise RuntimeError("close is broken")

        monkeypatch.setattr(broken.driver, "_close", fail)
        with pytest.raises(RuntimeError, match="close is broken"):
            end_all([broken.proxy, good.proxy], 1.0, reason="it is late", hurry=lambda: False)
        assert good.driver.closed
        assert good.proxy.ended
        assert broken.proxy.end(), "it ends once"


@pytest.mark.parametrize("at", ["the first begins", "all have begun"])
def test_ctrl_c_keeps_no_proxy_from_its_end(monkeypatch: pytest.MonkeyPatch, at: str) -> None:
    """Raised while the landings were sent one by one, it left the rest in the air. It only shortens the wait."""
    with ExitStack() as stack:
        benches = [stack.enter_context(Bench()) for _ in range(3)]
        for bench in benches:
            bench.airborne()
        begin, begun = threading.Thread.start, list[threading.Thread]()

        def start(thread: threading.Thread) -> None:
            begin(thread)
            if thread.name == "skyloop-end":
                begun.append(thread)
                if len(begun) == (1 if at == "the first begins" else len(benches)):
                    land_told(benches[0])
                    signal.raise_signal(signal.SIGINT)

        monkeypatch.setattr(threading.Thread, "start", start)
        proxies = [bench.proxy for bench in benches]
        with pytest.raises(KeyboardInterrupt):
            end_all(proxies, LONG_S, reason="it is late", hurry=lambda: False)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        for bench in benches:
            assert bench.driver.told
            assert set(bench.driver.told) <= {Land(), Hover()}
            assert bench.driver.closed


def test_proxies_that_end_in_turn_all_land_before_the_first_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a thread for each, the second flew on while the first landed."""
    with Bench() as first, Bench() as second:
        for bench in (first, second):
            bench.airborne()
        begin = threading.Thread.start

        def start(thread: threading.Thread) -> None:
            if thread.name == "skyloop-end":
                raise RuntimeError("can't start new thread")
            begin(thread)

        monkeypatch.setattr(threading.Thread, "start", start)
        with ending(lambda: end_all([first.proxy, second.proxy], LONG_S, reason="it is late", hurry=lambda: False)):
            land_told(second)
            assert not first.driver.closed
            for bench in (first, second):
                bench.driver.report(state=FlightState.LANDED)


def test_without_threads_for_all_the_rest_end_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    with Bench() as first, Bench() as second:
        first.airborne()
        second.airborne()
        begin, begun = threading.Thread.start, list[str]()

        def start(thread: threading.Thread) -> None:
            if thread.name == "skyloop-end" and begun:
                raise RuntimeError("can't start new thread")
            begun.append(thread.name)
            begin(thread)

        monkeypatch.setattr(threading.Thread, "start", start)
        end_all([first.proxy, second.proxy], 0.0, reason="it is late", hurry=lambda: False)
        assert (first.driver.closed, second.driver.closed) == (True, True)
        assert (first.driver.told[-1], second.driver.told[-1]) == (Hover(), Hover())


def broken(*_: object) -> None:
    raise RuntimeError("it is broken")


@pytest.mark.parametrize(
    "step",
    ["handler.leave_hovering", "overview.end", "_requests.stop", "publisher.streams.end", "server.stop"],
)
def test_a_failed_step_of_the_end_skips_no_other_step(monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    """The driver stayed open, and the flying vehicle got no command."""
    with Bench() as bench:
        bench.airborne()
        stopped: list[str] = []
        stop = bench.server.stop

        def stop_and_note() -> None:
            stop()
            stopped.append("server")

        monkeypatch.setattr(bench.server, "stop", stop_and_note)
        *path, name = step.split(".")
        owner: object = bench.proxy
        for part in path:
            owner = getattr(owner, part)
        monkeypatch.setattr(owner, name, broken)
        with pytest.raises(RuntimeError, match="it is broken"):
            bench.proxy.end()
        assert bench.driver.closed
        assert step == "server.stop" or stopped == ["server"]
        assert step == "handler.leave_hovering" or bench.driver.told[-1] == Hover()


def test_a_failed_landing_at_the_end_leaves_it_hovering(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bench.airborne()
    monkeypatch.setattr(bench.proxy.handler, "order_landing", broken)
    assert not bench.proxy.end(5.0)
    assert bench.driver.told[-1] == Hover()
    assert bench.driver.closed
    assert "the landing at the end of proxy bench failed" in caplog.text


def test_failures_of_an_abandoned_proxy_go_to_the_log(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """An exception in one of its threads ended in the interpreter's hook, or prevented the release of the rest."""
    monkeypatch.setattr(bench.proxy._requests, "stop", broken)
    monkeypatch.setattr(bench.server, "stop", broken)
    bench.proxy.end(reason="its driver hangs", hangs=True)
    assert bench.driver.closed
    assert caplog.text.count("proxy bench was abandoned, and not all of its resources could be released") == 2
    monkeypatch.undo()
    bench.server.stop()


def test_a_recent_take_off_is_cancelled(bench: Bench) -> None:
    """The vehicle does not show it yet; if it rises nevertheless, it is landed."""
    bench.driver.answers = False
    pilot = bench.pilot()
    pilot.command(Takeoff())
    with ending(lambda: bench.proxy.end(LONG_S)) as thread:
        wait_until(lambda: len(bench.driver.told) > 2, "it is told to land more than once")
        assert thread.is_alive()
        bench.driver.report(state=FlightState.TAKING_OFF)
        bench.driver.told.clear()
        land_told(bench)
        bench.driver.report(state=FlightState.LANDED)
        wait_until(lambda: not thread.is_alive(), "it has ended")
    assert set(bench.driver.told) == {Land()}


def test_a_cancelled_take_off_is_watched_for_a_moment(bench: Bench) -> None:
    bench.driver.answers = False
    bench.pilot().command(Takeoff())
    with ending(lambda: bench.proxy.end(LONG_S)) as thread:
        land_told(bench)
        assert thread.is_alive()
        bench.clock.advance(3.1)
    assert set(bench.driver.told) == {Takeoff(), Land()}


def test_a_vehicle_not_landed_in_time_keeps_landing_or_hovers(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.driver.answers = False
    assert not bench.proxy.end(0.05, unless_flying=True)
    pilot.command(Velocity(0.5))
    assert pilot.refusals() == [Refusal.WRONG_STATE], "it is still served, and lands"
    assert not bench.proxy.end(0.05)
    assert bench.driver.told[-1] == Hover(), "it never showed a landing"
    assert bench.driver.closed


def test_a_second_signal_ends_the_wait(bench: Bench) -> None:
    bench.airborne()
    hurry = threading.Event()
    with ending(lambda: bench.proxy.end(LONG_S, hurry=hurry.is_set)):
        land_told(bench)
        hurry.set()
    assert bench.driver.told == [Land()], "a landing in progress continues"


def test_a_vehicle_without_native_hover_is_landed_even_at_a_second_signal() -> None:
    with Bench({"velocity"}) as bench:
        bench.driver.answers = False
        bench.driver.report(altitude_m=2.0, state=FlightState.FLYING)
        bench.pilot().command(Hover())
        with ending(lambda: bench.proxy.end(LONG_S, hurry=lambda: True)) as thread:
            bench.run(1.0, lambda: bench.driver.report())
            assert bench.driver.told[-1] == Velocity(up=-0.4)
            assert thread.is_alive()
            bench.driver.report(altitude_m=0.0, state=FlightState.LANDED)
            bench.run(0.1)


@pytest.mark.parametrize("native", ["velocity", "attitude"])
def test_a_vehicle_without_native_hover_is_left_at_a_standstill(native: str) -> None:
    with Bench({native}) as bench:
        bench.driver.report(altitude_m=2.0, state=FlightState.FLYING)
        pilot = bench.pilot()
        pilot.command(Hover())
        bench.run(0.1, lambda: bench.driver.report())
        pilot.command(Velocity(1.0))
        bench.run(0.1, lambda: bench.driver.report())
        bench.proxy.end()
        assert bench.driver.told[-1] == (Velocity() if native == "velocity" else Attitude())


def test_a_software_landing_continues_when_the_proxy_ends() -> None:
    with Bench({"velocity"}) as bench:
        bench.driver.report(altitude_m=2.0, state=FlightState.FLYING)
        bench.pilot().command(Land())
        bench.run(0.1, lambda: bench.driver.report(state=FlightState.FLYING))
        bench.proxy.end()
        assert bench.driver.told[-1] == Velocity(up=-0.4)


def test_nothing_is_flown_while_the_end_waits_for_a_slow_request() -> None:
    """By then, nothing guards the flight."""
    done = threading.Event()
    with Bench(parameters=[Parameter("slow", ParameterType.FLOAT, 1.0)]) as bench:
        pilot = bench.airborne()
        bench.driver.while_setting = lambda: assert_set(done)
        pilot.post(SetParameter("slow", 2.0, pilot.lease))
        pilot.command(Velocity(1.0), sync=False)
        wait_until(lambda: bench.driver.told == [Velocity(1.0)], "it flies")
        with ending(bench.proxy.end):
            wait_until(lambda: Hover() in bench.driver.told, "it hovers")
            for action in (Velocity(1.0), Takeoff(), Hover()):
                pilot.command(action, sync=False)
            wait_until(lambda: len(refused(pilot)) == 1, "they are refused")
            assert bench.driver.told == [Velocity(1.0), Hover()]
            done.set()


def test_an_end_without_a_landing_also_bars_everything_first(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(1.0))
    barred: list[str] = []

    def end() -> None:
        pilot.command(Velocity(1.0))
        pilot.command(Hover())
        barred.extend(pilot.refusals())

    monkeypatch.setattr(bench.proxy.overview, "end", end)
    bench.proxy.end()
    assert set(barred) == {Refusal.WRONG_STATE}
    assert bench.driver.told == [Velocity(1.0), Hover()]


def assert_set(event: threading.Event) -> None:
    assert event.wait(LONG_S)


def refused(app: App) -> list[object]:
    return [event.data["reason"] for event in app.events if event.kind is EventKind.COMMAND_REFUSED]


def test_a_vehicle_left_hovering_is_not_landed_by_departures_or_a_late_tick(bench: Bench) -> None:
    """A late tick, and an application that left when the end was announced, made the ladder land it."""
    pilot = bench.airborne()
    bench.proxy.handler.leave_hovering(bench.clock())
    assert bench.driver.told[-1] == Hover()
    bench.driver.told.clear()
    pilot.ask(ReleaseAuthority())
    bench.run(1.0)
    assert bench.driver.told == []
    pilot.command(EmergencyStop())
    assert bench.driver.told == [EmergencyStop()]

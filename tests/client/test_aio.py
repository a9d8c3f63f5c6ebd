"""The asyncio API."""

from __future__ import annotations

import ast
import asyncio
import inspect
import threading
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from typing import Any

import aio_stub
import msgspec
import pytest

import skyloop.client
from skyloop import aio
from skyloop.aio.bridge import in_thread
from skyloop.client.drone import open_drone
from skyloop.client.swarm import in_parallel
from skyloop.errors import ClosedError, NoAnswerError, UsageError
from skyloop.messages import (
    AnyAction,
    Encoding,
    EventKind,
    FlightState,
    Hover,
    Idle,
    Land,
    Position,
    ResetEmergency,
    Takeoff,
    Velocity,
)
from skyloop.transport.base import results
from tests.support.scripted_proxy import QUICK, WAIT_S, ScriptedProxy, Sender, background, scripted


@pytest.fixture
def proxy(monkeypatch: pytest.MonkeyPatch) -> Iterator[ScriptedProxy]:
    with scripted() as proxy:

        def connect(target: str, **options: Any) -> skyloop.client.Drone:
            return open_drone(proxy.server.dial, app=target, policy=QUICK, **options)

        monkeypatch.setattr("skyloop.client.connect", connect)
        yield proxy


def run(coroutine: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(coroutine, 2 * WAIT_S))


def test_a_flight(proxy: ScriptedProxy) -> None:
    def vehicle() -> None:
        proxy.until_commanded(Takeoff())
        proxy.state = FlightState.HOVERING
        proxy.until_commanded(Land())
        proxy.state = FlightState.LANDED

    async def fly() -> None:
        async with aio.connect("me", stall_s=5.0) as drone:
            assert (drone.name, drone.uri, drone.app_id) == ("scripted", "scripted://", 1)
            assert drone.capabilities.vehicle == "scripted"
            assert drone.authority.state == "held"
            assert drone.link.application == "up"
            await drone.takeoff()
            assert drone.feedback().state is FlightState.HOVERING
            assert drone.velocity(forward=0.1)
            assert drone.attitude(pitch=0.1)
            await drone.go_to(x=0, y=0, z=1, wait=False)
            assert drone.hover()
            assert drone.idle()
            assert drone.command(Hover())
            assert (await drone.next_feedback()).seq > 0
            assert (await drone.wait("hovering")).state is FlightState.HOVERING
            assert await drone.config.get("limits.tilt") == 0.35
            await drone.config.set("limits.tilt", 0.2)
            assert dict(await drone.config.items())["limits.tilt"] == 0.2
            assert (await drone.config.describe("limits.tilt")).unit == "rad"
            assert (await drone.stats())["command"].count > 0
            assert drone.recent_events()
        with pytest.raises(ClosedError):
            drone.hover()

    flying = background(vehicle)
    run(fly())
    flying.join(WAIT_S)
    assert Land() in proxy.actions(), "the end of the block lands"


@pytest.mark.parametrize("target", ["replay://none.mcap?speed=max", "replay:///a/b.mcap?start=3&speed=max"])
def test_a_replay_in_step_is_refused_at_once(target: str) -> None:
    async def begin() -> None:
        with pytest.raises(UsageError, match=r"while a thread waits, .* use skyloop\.connect, or give a number"):
            await aio.connect(target)
        with pytest.raises(UsageError, match=r"use skyloop\.connect"):
            async with aio.connect(target):
                pass

    run(begin())


def test_other_replays_are_not_refused_for_that(proxy: ScriptedProxy) -> None:
    async def begin() -> None:
        async with aio.connect("replay://none.mcap?speed=2") as drone:
            assert drone.name == "scripted"

    run(begin())


def test_authority_and_emergency(proxy: ScriptedProxy) -> None:
    async def fly() -> None:
        drone = await aio.connect("me")
        async with drone:
            await drone.release_authority()
            assert (await drone.request_authority(2)).priority == 2
            assert drone.emergency_stop()
            assert drone.reset_emergency()
            proxy.state = FlightState.EMERGENCY
            await drone.wait(lambda _: ResetEmergency() in proxy.actions(), WAIT_S)
            await drone.land(wait=False)

    run(fly())


def test_frames(proxy: ScriptedProxy) -> None:
    async def look() -> None:
        async with aio.connect("me") as drone:
            seqs = []
            assert drone.frame() is None
            sending = background(lambda: _send(proxy, 30))
            async for frame in drone.frames(timeout_s=WAIT_S):
                seqs.append(frame.seq)
                drone.annotate(frame, [])
                assert drone.log.number("seq", frame.seq)
                if frame.seq >= 20:
                    break
            assert seqs == sorted(set(seqs))
            assert (await drone.next_frame()).seq >= 20
            sending.join(WAIT_S)
            with pytest.raises(NoAnswerError, match="no frame of bottom"):
                async for _ in drone.frames("bottom", timeout_s=0.02):
                    pass
            with pytest.raises(TypeError, match="max_age"):
                async for _ in drone.frames(max_age=0.2):  # type: ignore[call-arg]
                    pass

    run(look())


def test_frames_that_are_too_old_do_not_restart_the_time_out(proxy: ScriptedProxy) -> None:
    async def look() -> None:
        async with aio.connect("me") as drone:
            sending = background(lambda: _send(proxy, 200))
            begun_s = time.monotonic()
            with pytest.raises(NoAnswerError, match="no frame of front"):
                async for _ in drone.frames(timeout_s=0.3, max_age_s=0.0):
                    pass
            assert sending.is_alive(), "frames still arrived"
            assert time.monotonic() - begun_s < WAIT_S
            sending.join(WAIT_S)

    run(look())


def test_frames_follow_a_proxy_that_is_restarted_with_another_camera(proxy: ScriptedProxy) -> None:
    def restart() -> None:
        proxy.until(lambda: proxy.server.subscribers("video/front") == 1, "the first subscription")
        top = msgspec.structs.replace(proxy.capabilities.cameras[0], name="top")
        proxy.capabilities = msgspec.structs.replace(proxy.capabilities, cameras=(top,))
        proxy.stop()
        proxy.start()
        proxy.until(lambda: proxy.server.subscribers("video/top") >= 1, "the new camera's subscription")
        _send(proxy, 200, "top")

    async def look() -> None:
        async with aio.connect("me") as drone:
            restarting = background(restart)
            async for frame in drone.frames(timeout_s=WAIT_S):
                assert frame.camera == "top"
                break
            restarting.join(WAIT_S)

    run(look())


def test_waits_end_when_the_drone_is_closed(proxy: ScriptedProxy) -> None:
    async def look() -> None:
        async with aio.connect("me") as drone:

            async def all_of(samples: AsyncIterator[object]) -> list[object]:
                return [sample async for sample in samples]

            frames = asyncio.ensure_future(all_of(drone.frames(timeout_s=WAIT_S)))
            found = asyncio.ensure_future(all_of(drone.results("detector", timeout_s=WAIT_S)))
            await drone.wait(lambda _: proxy.server.subscribers(results("detector")) == 1)
            begin = time.monotonic()
            await drone.close()
            assert await frames == await found == []
            assert time.monotonic() - begin < WAIT_S / 2

    run(look())


def _send(proxy: ScriptedProxy, count: int, *camera: str) -> None:
    pause = threading.Event()
    for seq in range(1, count):
        proxy.frame(seq, *camera)
        pause.wait(0.005)


def test_a_broken_jpeg_is_skipped(proxy: ScriptedProxy) -> None:
    pytest.importorskip("cv2")

    async def look() -> None:
        async with aio.connect("me") as drone:
            drone.frame()
            frames = drone.frames(timeout_s=WAIT_S)
            task = asyncio.ensure_future(anext(frames))
            await asyncio.sleep(0)
            proxy.frame(1, encoding=Encoding.JPEG)
            await drone.wait(lambda _: drone.sync.stats["video/front"].malformed > 0)
            proxy.frame(2)
            assert (await task).seq == 2
            await frames.aclose()  # type: ignore[attr-defined]

    run(look())


def test_listeners_run_on_the_loop(proxy: ScriptedProxy) -> None:
    async def listen() -> None:
        loop_thread = threading.get_ident()
        async with aio.connect("me") as drone:
            came = asyncio.Event()
            threads: set[int] = set()
            events: list[EventKind] = []

            def on_feedback(feedback: object) -> None:
                threads.add(threading.get_ident())

            async def on_event(event: skyloop.Event) -> None:
                await asyncio.sleep(0)
                threads.add(threading.get_ident())
                events.append(event.kind)
                if event.kind is EventKind.BATTERY_LOW:
                    came.set()

            def raising(feedback: object) -> None:
                raise RuntimeError("boo")

            listeners = [
                drone.on_feedback(on_feedback),
                drone.on_event(on_event),
                drone.on_link(lambda status: None),
                drone.on_command(lambda applied: None),
                drone.on_annotation(lambda annotation: None),
                drone.on_log(lambda entry: None),
            ]
            bad = drone.on_feedback(raising)
            proxy.event(EventKind.BATTERY_LOW)
            await came.wait()
            await drone.wait(lambda _: bad.errors > 1)
            assert threads == {loop_thread}
            assert listeners[1].delivered >= 1
            assert listeners[1].dropped == 0
            for listener in [*listeners, bad]:
                listener.cancel()
            assert EventKind.CALLBACK_ERROR in [event.kind for event in drone.recent_events()]

    run(listen())


def test_results(proxy: ScriptedProxy) -> None:
    async def read() -> None:
        async with aio.connect("me", access="observe") as drone:
            got: list[int] = []
            listener = drone.on_result(lambda result: got.append(result.seq), "detector", max_age_s=60.0)
            assert drone.result("detector") is None
            await drone.wait(lambda _: proxy.server.subscribers(results("detector")) == 1)
            sender = Sender(proxy)
            coming = drone.results("detector", max_age_s=60.0, timeout_s=WAIT_S)
            task = asyncio.ensure_future(anext(coming))
            await asyncio.sleep(0)  # it listens from here on
            sender.send(1, age_s=90.0)
            sender.send(2, {"x": 1})
            assert (await task).value == {"x": 1}
            await drone.wait(lambda _: got == [2])
            newest = drone.result("detector")
            assert newest is not None
            assert newest.seq == 2
            listener.cancel()
            with pytest.raises(NoAnswerError, match="no result of processor detector arrived"):
                await anext(drone.results("detector", timeout_s=0.02))
            await coming.aclose()  # type: ignore[attr-defined]

    run(read())


def test_processors_are_plain_functions(proxy: ScriptedProxy) -> None:
    async def think(frame: object) -> None: ...

    async def listen() -> None:
        async with aio.connect("me") as drone:
            seen = threading.Event()
            drone.on_frame(lambda frame: seen.set())
            proxy.frame(1)
            assert await asyncio.to_thread(seen.wait, WAIT_S)
            with pytest.raises(UsageError, match="plain function"):
                drone.on_frame(think)
            await drone.close()

    run(listen())


def test_a_cancelled_wait_frees_the_loop_at_once(proxy: ScriptedProxy) -> None:
    async def wait() -> None:
        async with aio.connect("me") as drone:
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(drone.wait("flying", 0.5), 0.02)
            assert drone.hover()

    run(wait())


def test_a_cancelled_connect_leaves_no_drone(proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, closed = threading.Event(), threading.Event()
    connect: Any = skyloop.client.connect  # the one put in its place

    def slow(target: str, **options: Any) -> skyloop.client.Drone:
        go_on.wait(WAIT_S)
        drone: skyloop.client.Drone = connect(target, on_close=closed.set, **options)
        return drone

    monkeypatch.setattr("skyloop.client.connect", slow)

    async def give_up() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(aio.connect("me")._connect(), 0.02)
        go_on.set()
        assert await asyncio.to_thread(closed.wait, WAIT_S)

    run(give_up())


def test_a_connect_cancelled_as_it_succeeds_leaves_no_drone(
    proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A busy loop: the result of the connection and its cancellation arrive in the same round."""
    made, closed = threading.Event(), threading.Event()
    connect: Any = skyloop.client.connect

    def noted(target: str, **options: Any) -> skyloop.client.Drone:
        drone: skyloop.client.Drone = connect(target, on_close=closed.set, **options)
        made.set()
        return drone

    monkeypatch.setattr("skyloop.client.connect", noted)

    async def give_up() -> None:
        task = asyncio.ensure_future(aio.connect("me")._connect())
        await asyncio.sleep(0)
        assert made.wait(WAIT_S)
        for worker in [thread for thread in threading.enumerate() if thread.name == "skyloop-aio"]:
            worker.join()  # which has handed its result to the loop
        asyncio.get_running_loop().call_soon(task.cancel)
        with pytest.raises(asyncio.CancelledError):
            await task
        assert await asyncio.to_thread(closed.wait, WAIT_S)

    run(give_up())


def test_a_connect_whose_loop_has_ended_leaves_no_drone(proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, closed = threading.Event(), threading.Event()
    connect: Any = skyloop.client.connect  # the one put in its place

    def slow(target: str, **options: Any) -> skyloop.client.Drone:
        go_on.wait(WAIT_S)
        drone: skyloop.client.Drone = connect(target, on_close=closed.set, **options)
        return drone

    monkeypatch.setattr("skyloop.client.connect", slow)

    async def give_up() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(aio.connect("me")._connect(), 0.02)

    run(give_up())
    go_on.set()
    assert closed.wait(WAIT_S)


def test_errors_propagate(proxy: ScriptedProxy) -> None:
    async def ask() -> None:
        async with aio.connect("me") as drone:
            with pytest.raises(KeyError):
                await drone.config.get("limits.tild")
            with pytest.raises(RuntimeError, match="mine"):
                async with drone:
                    raise RuntimeError("mine")

    run(ask())


def test_the_asyncio_api_has_all_that_the_synchronous_one_has() -> None:
    def public(kind: type) -> set[str]:
        return {name for name in dir(kind) if not name.startswith("_")}

    assert public(skyloop.client.Drone) <= public(aio.Drone)
    assert public(skyloop.client.Swarm) - public(aio.Swarm) == {"fail"}, "for formations, which fly in threads"


def _methods(face: type, kind: type) -> list[tuple[Any, Any]]:
    names = {name for name in set(dir(face)) & set(dir(kind)) if name == "__len__" or name[0] != "_"}
    pairs = [(vars(face)[name], vars(kind)[name]) for name in sorted(names) if name in vars(kind)]
    return [pair for pair in pairs if inspect.isfunction(pair[0]) and inspect.isfunction(pair[1])]


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (aio.connect, skyloop.client.connect),
        (aio.swarm, skyloop.client.swarm),
        (aio.Config.get, skyloop.client.Config.__getitem__),
        (aio.Config.set, skyloop.client.Config.__setitem__),
        *_methods(aio.Config, skyloop.client.Config),
        *_methods(aio.Drone, skyloop.client.Drone),
        *_methods(aio.Swarm, skyloop.client.Swarm),
    ],
    ids=lambda function: function.__qualname__,
)
def test_both_apis_have_the_same_arguments(ours: Callable[..., Any], theirs: Callable[..., Any]) -> None:
    """Names, defaults, and which arguments are keyword-only."""

    def arguments(function: Callable[..., Any]) -> list[tuple[str, object, object]]:
        found = inspect.signature(function).parameters.values()
        return [(one.name, one.kind, one.default) for one in found]

    assert arguments(ours) == arguments(theirs)
    assert ours.__doc__ or ours.__name__ == "__len__", "it has a docstring"


def test_the_stub_matches_the_code() -> None:
    stub = ast.parse(aio_stub.STUB.read_text(encoding="utf-8"))
    assert ast.dump(stub) == ast.dump(ast.parse(aio_stub.stub())), "make stubs"


def test_a_callback_that_would_block_the_receiving_thread_is_refused(proxy: ScriptedProxy) -> None:
    async def listen() -> None:
        async with aio.connect("me") as drone:
            with pytest.raises(UsageError, match="inline must be False"):
                drone.on_feedback(lambda _: None, inline=True)
            with pytest.raises(UsageError, match="can't be called"):
                drone.on_event("not a function")  # type: ignore[arg-type]
            drone.on_result(lambda _: None, depth=4, inline=False).cancel()

    run(listen())


def test_a_coroutine_function_as_predicate_is_refused(proxy: ScriptedProxy) -> None:
    """Its result is truthy, so the wait ended at once, whatever the vehicle did."""

    async def is_there(_: object) -> bool:
        return False

    async def wait() -> None:
        async with aio.connect("me") as drone:
            with pytest.raises(UsageError, match="wait takes a plain function"):
                await drone.wait(is_there)  # type: ignore[arg-type]

    run(wait())


def test_clocks_poses_and_own_events_work_as_on_the_drone(proxy: ScriptedProxy) -> None:
    async def fly() -> None:
        async with aio.connect("me") as drone:
            assert not drone.closed
            assert drone.clock_offset_ns == drone.clock_uncertainty_ns == 0
            sample = await drone.next_feedback()
            assert sample.captured_ns <= drone.now_ns
            assert 0.0 <= drone.age_s(sample) < WAIT_S
            assert drone.send_external_pose((0.0, 1.0, 2.0), (0.0, 0.0, 0.0, 1.0))
            drone.emit(EventKind.VEHICLE_MESSAGE, "seen")
            assert any(event.text == "seen" for event in drone.recent_events())
        assert drone.closed

    run(fly())


@pytest.mark.parametrize(("state", "instead"), [(FlightState.LANDED, Idle()), (FlightState.TAKING_OFF, Hover())])
def test_a_cancelled_take_off_is_not_executed(proxy: ScriptedProxy, state: FlightState, instead: AnyAction) -> None:
    """Cancelling takeoff() left it climbing."""
    proxy.state = state

    async def fly() -> None:
        drone = await aio.connect("me", on_exit="hover")
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.3):
                await drone.takeoff(timeout_s=WAIT_S)
        after = len(proxy.commands)
        await asyncio.to_thread(proxy.until, lambda: proxy.actions()[after:].count(instead) >= 3)
        assert Takeoff() not in proxy.actions()[-2:]
        await drone.close()

    run(fly())


def test_a_cancelled_flight_of_a_swarm_is_not_executed(proxy: ScriptedProxy) -> None:
    async def fly() -> None:
        drone = await aio.connect("me", on_exit="hover")
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.3):
                await in_thread(lambda: in_parallel({"left": lambda: drone.sync.takeoff(timeout_s=WAIT_S)}))
        after = len(proxy.commands)
        await asyncio.to_thread(proxy.until, lambda: proxy.actions()[after:].count(Idle()) >= 3)
        assert Takeoff() not in proxy.actions()[-2:]
        await drone.close()

    run(fly())


def test_an_interrupted_flight_of_a_swarm_is_not_executed(
    proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Press Ctrl-C while the drones are awaited on separate threads."""
    drone = skyloop.client.connect("me")

    def interrupt(_thread: threading.Thread, _timeout_s: float | None = None) -> None:
        proxy.until_commanded(Takeoff())
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "join", interrupt)
        with pytest.raises(KeyboardInterrupt):
            in_parallel({"left": lambda: drone.takeoff(timeout_s=WAIT_S)})
    after = len(proxy.commands)
    proxy.until(lambda: proxy.actions()[after:].count(Idle()) >= 3)
    assert Takeoff() not in proxy.actions()[-2:]
    drone.close()


def test_a_command_cancelled_before_it_was_sent_is_never_sent(proxy: ScriptedProxy) -> None:
    """Its thread sent it after the hover that the program had commanded since."""
    proxy.state = FlightState.FLYING
    go_on, ended = threading.Event(), threading.Event()

    async def fly() -> None:
        drone = await aio.connect("me", on_exit="hover")

        def late() -> None:
            go_on.wait(WAIT_S)
            try:
                drone.sync.go_to(x=1.0, y=0.0, z=1.0, timeout_s=WAIT_S)
            finally:
                ended.set()

        with pytest.raises(TimeoutError):
            await asyncio.wait_for(in_thread(late), 0.02)
        assert drone.command(Velocity(forward=0.1))
        go_on.set()
        assert await asyncio.to_thread(ended.wait, WAIT_S)
        later = await asyncio.to_thread(proxy.from_now_on, Velocity(forward=0.1))
        assert not [one for one in proxy.actions() if isinstance(one, Position)]
        assert {command.action for command in later} == {Velocity(forward=0.1)}
        await drone.close()

    run(fly())


def test_a_command_within_another_wait_that_is_cancelled_ends_with_it(proxy: ScriptedProxy) -> None:
    """A coroutine awaited by a thread kept flying after no one waited for that thread any more."""
    proxy.state = FlightState.FLYING
    go_on = threading.Event()

    async def fly() -> None:
        drone = await aio.connect("me", on_exit="hover")
        loop = asyncio.get_running_loop()

        async def late() -> None:
            await asyncio.to_thread(go_on.wait, WAIT_S)
            await drone.go_to(x=1.0, y=0.0, z=1.0, timeout_s=WAIT_S)

        def work() -> None:
            asyncio.run_coroutine_threadsafe(late(), loop).result()

        with pytest.raises(TimeoutError):
            await asyncio.wait_for(in_thread(work), 0.02)
        go_on.set()
        for worker in [thread for thread in threading.enumerate() if thread.name == "skyloop-aio"]:
            await asyncio.to_thread(worker.join, WAIT_S)
        await asyncio.to_thread(proxy.from_now_on, Idle())
        assert not [one for one in proxy.actions() if isinstance(one, Position)]
        await drone.close()

    run(fly())


def test_a_cancelled_flight_leaves_later_commands_alone(proxy: ScriptedProxy) -> None:
    """Its hover, some milliseconds later, ended the new flight."""
    proxy.state = FlightState.FLYING

    async def fly() -> None:
        drone = await aio.connect("me", on_exit="hover")
        flight = asyncio.ensure_future(drone.go_to(x=1.0, y=0.0, z=1.0, timeout_s=WAIT_S))
        await asyncio.to_thread(proxy.until_commanded, Position(1.0, 0.0, 1.0))
        flight.cancel()
        assert drone.command(Position(2.0, 0.0, 1.0))
        for worker in [thread for thread in threading.enumerate() if thread.name == "skyloop-aio"]:
            await asyncio.to_thread(worker.join, WAIT_S)
        later = await asyncio.to_thread(proxy.from_now_on, Position(2.0, 0.0, 1.0))
        assert {command.action for command in later} == {Position(2.0, 0.0, 1.0)}
        await drone.close()

    run(fly())

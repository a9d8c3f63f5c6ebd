"""The asyncio swarm over the memory transport, with the proxies of the synchronous swarm's tests."""

from __future__ import annotations

import asyncio
import inspect
import sys
from collections.abc import Coroutine, Iterator
from typing import Any

import pytest

import skyloop
from skyloop import aio
from skyloop.client import Drone
from skyloop.errors import ClosedError, RefusedError, SwarmError, UnknownNameError, UsageError
from skyloop.messages import FlightState, Hover, Land, Velocity
from tests.integration.field import NAMES, Field

WAIT_S = 30.0


@pytest.fixture
def field(monkeypatch: pytest.MonkeyPatch) -> Iterator[Field]:
    field = Field()

    def connect(target: str, **options: Any) -> Drone:
        if target not in NAMES:
            raise UnknownNameError("running proxy", target, NAMES)
        return field.connect(target, **options)

    monkeypatch.setattr(sys.modules["skyloop.client.swarm"], "connect", connect)
    yield field
    field.stop()


def run(coroutine: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(coroutine, WAIT_S))


def test_a_flight(field: Field) -> None:
    async def fly() -> None:
        async with aio.swarm(*NAMES) as drones:
            assert drones.names == NAMES
            assert len(drones) == len(NAMES)
            assert "alpha" in drones
            assert [drone.name for drone in drones] == list(NAMES)
            assert {name: drone.name for name, drone in drones.items()} == {name: name for name in NAMES}
            assert "alpha" in repr(drones)
            await drones.takeoff()
            assert await drones.velocity(forward=0.3) == dict.fromkeys(NAMES, True)
            assert list(await drones.wait_all("flying", 5.0)) == list(NAMES)
            assert all(Velocity(0.3) in vehicle.applied for vehicle in field.vehicles.values())
            assert {one.state for one in (await drones.feedback()).values()} == {FlightState.FLYING}
            assert await drones.hover() == dict.fromkeys(NAMES, True)
            await drones.wait_all("hovering", 5.0)
            assert await drones.attitude(pitch=0.05) == dict.fromkeys(NAMES, True)
            assert await drones.idle() == dict.fromkeys(NAMES, True)
            assert await drones.send({"alpha": Hover()}) == {"alpha": True}
            assert await drones.command(Hover()) == dict.fromkeys(NAMES, True)
            assert drones.spread is not None
            assert [tick.number async for tick in drones.ticks(rate_hz=100.0, seconds=0.03)] == [0, 1, 2]
            await drones.land()
        assert field.states() == {FlightState.LANDED}
        with pytest.raises(ClosedError):
            await drones.hover()
        with pytest.raises(ClosedError):
            await drones.each(lambda drone: drone.land())

    run(fly())


def test_the_end_of_the_block_lands_all(field: Field) -> None:
    async def fly() -> None:
        async with aio.swarm(*NAMES) as drones:
            await drones.takeoff()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(fly())
    assert field.states() == {FlightState.LANDED}


def test_awaited_without_a_block(field: Field) -> None:
    async def fly() -> None:
        drones = await aio.swarm({"left": "alpha"})
        assert drones.names == ("left",)
        assert drones["left"].name == "alpha"
        with pytest.raises(UnknownNameError):
            drones["alpha"]
        assert (await drones.request_authority(8))["left"].state == "held"
        await drones.release_authority()
        assert drones["left"].authority.state == "none"
        async with drones:
            pass
        await drones.close()

    run(fly())


def test_each_awaits_all_drones_concurrently(field: Field) -> None:
    async def fly() -> None:
        async with aio.swarm(*NAMES) as drones:
            all_there = asyncio.Barrier(len(NAMES))

            async def meet(drone: aio.Drone) -> str:
                await all_there.wait()  # set only if each drone waits for the others
                return drone.name

            assert await drones.each(meet) == {name: name for name in NAMES}

            async def fail(drone: aio.Drone) -> None:
                if drone.name == "bravo":
                    raise RefusedError("not today", code="mine")

            await drones.each(fail, "trying")
            assert list(drones.errors) == ["bravo"]
            assert "bravo" not in drones.active
            drones.readmit()
            assert list(drones.active) == list(NAMES)

            async def wrong(drone: aio.Drone) -> None:
                raise KeyError(drone.name)

            with pytest.raises(KeyError):
                await drones.each(wrong)

    run(fly())


def test_a_cancelled_each_flies_no_more(field: Field) -> None:
    """Its coroutines kept running, and took back each landing requested since."""

    async def fly() -> None:
        async with aio.swarm(*NAMES) as drones:
            await drones.takeoff()
            flying = asyncio.Barrier(len(NAMES) + 1)
            ended: list[str] = []

            async def patrol(drone: aio.Drone) -> None:
                try:
                    await flying.wait()  # the cancellation may come before this one is resumed
                    while True:
                        drone.hover()  # this one is not refused by the cancelled wait
                        await asyncio.sleep(0.01)
                finally:
                    ended.append(drone.name)

            patrols = asyncio.create_task(drones.each(patrol))
            await flying.wait()
            patrols.cancel()
            with pytest.raises(asyncio.CancelledError):
                await patrols
            while sorted(ended) != sorted(NAMES):
                await asyncio.sleep(0.005)
            await drones.land()
            await asyncio.sleep(0.1)
            assert field.states() == {FlightState.LANDED}

    run(fly())


def test_a_policy_that_lands_the_others_does_not_hold_up_the_event_loop(field: Field) -> None:
    others = [field.vehicles[name] for name in NAMES if name != "bravo"]
    for vehicle in others:
        vehicle.ignores.add(Land)  # it lands when the event loop permits

    async def let_them_land() -> None:
        for vehicle in others:
            while Land() not in vehicle.applied:
                await asyncio.sleep(0.005)
            vehicle.state = FlightState.LANDED

    async def fly() -> None:
        async with aio.swarm(*NAMES, on_error="land") as drones:
            await asyncio.to_thread(field.broken, "bravo")
            letting = asyncio.create_task(let_them_land())
            with pytest.raises(SwarmError) as raised:
                await drones.takeoff(timeout_s=5.0)
            assert list(raised.value.errors) == ["bravo"], "the others have landed"
            await letting

    run(fly())


def test_an_emergency_stop_is_a_plain_call(field: Field) -> None:
    async def fly() -> None:
        async with aio.swarm(*NAMES) as drones:
            await drones.takeoff()
            assert drones.emergency_stop() == dict.fromkeys(NAMES, True)
            await drones.wait_all("emergency", 5.0)
            assert await drones.reset_emergency() == dict.fromkeys(NAMES, True)

    run(fly())


def test_an_address_that_can_not_be_connected_to(field: Field) -> None:
    async def fly() -> None:
        with pytest.raises(SwarmError, match="connecting failed for 1 of 2"):
            await aio.swarm("alpha", "delta")
        async with aio.swarm("alpha", "delta", missing="skip") as drones:
            assert drones.names == ("alpha",)
            assert list(drones.errors) == ["delta"]
        for target in ("replay://x.mcap?speed=max", {"left": "replay://x.mcap?speed=max"}):
            with pytest.raises(UsageError, match="speed=max"):
                await aio.swarm(target)

    run(fly())


def test_a_drone_whose_loop_stopped_waiting_for_it_is_closed(field: Field, monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[str] = []

    class Late:
        def close(self) -> None:
            closed.append("closed")

    async def fly() -> None:
        go_on = asyncio.Event()
        loop = asyncio.get_running_loop()

        def slow(*targets: str, **options: Any) -> Any:
            asyncio.run_coroutine_threadsafe(go_on.wait(), loop).result()
            return Late()

        monkeypatch.setattr("skyloop.client.swarm", slow)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(aio.swarm("alpha")._connect(), 0.02)
        go_on.set()
        while not closed:
            await asyncio.sleep(0.005)

    run(fly())


def test_it_has_the_names_of_the_other_swarm() -> None:
    """Names, and the arguments of each method."""
    ours, theirs = _public(aio.Swarm), _public(skyloop.Swarm)
    assert set(theirs) - set(ours) == {"fail"}, "everything else exists"
    for name in set(ours) & set(theirs) - {"active", "errors", "names", "spread"}:
        assert list(inspect.signature(ours[name]).parameters) == list(inspect.signature(theirs[name]).parameters), name


def _public(kind: type) -> dict[str, Any]:
    return {name: getattr(kind, name) for name in dir(kind) if not name.startswith("_")}


@pytest.mark.parametrize("kind", [aio.Drone, aio.Swarm, aio.connect, aio.swarm, aio.Config])
def test_everything_is_typed(kind: type) -> None:
    for name, method in vars(kind).items():
        if inspect.isfunction(method) and (name == "__init__" or not name.startswith("_")):
            options = [one for one in inspect.signature(method).parameters.values() if one.kind is one.VAR_KEYWORD]
            typed = ["Unpack[" in str(one.annotation) or one.annotation == "str" for one in options]
            assert all(typed), f"{kind.__name__}.{name}"

"""Several drones for ``asyncio``."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import TypeVar, Unpack

from skyloop import client
from skyloop.aio.bridge import Opening, in_thread, reject_in_step
from skyloop.aio.drone import Drone
from skyloop.client.authority import TakeoverWay
from skyloop.client.commands import by_name
from skyloop.client.connect import ConnectOptions, Missing, Target
from skyloop.client.statistics import Distribution
from skyloop.client.swarm import OnError, Tick
from skyloop.client.telemetry import Wanted
from skyloop.messages import AnyAction, Feedback

T = TypeVar("T")


class swarm(Opening["Swarm"]):  # noqa: N801  (used like the function skyloop.swarm)
    """Connect to several drones at the same time: ``async with swarm(…) as drones``, or ``drones = await swarm(…)``.

    Raises what :func:`skyloop.swarm` raises, and :class:`UsageError` for a stepped replay; see :class:`connect`.
    """

    def __init__(
        self,
        *targets: Target,
        on_error: OnError = "continue",
        missing: Missing = "raise",
        **options: Unpack[ConnectOptions],
    ) -> None:
        """Keep the arguments; awaiting or entering connects.

        Args:
            *targets: As for :func:`skyloop.swarm`.
            on_error: As for :func:`skyloop.swarm`.
            missing: As for :func:`skyloop.swarm`.
            **options: As for :func:`skyloop.connect`, for each drone.
        """
        self._targets = targets
        self._on_error: OnError = on_error
        self._missing: Missing = missing
        self._options = options

    async def _connect(self) -> Swarm:
        for target in self._targets:
            for address in target.values() if isinstance(target, Mapping) else [target]:
                reject_in_step(address)
        sync = await in_thread(
            lambda: client.swarm(*self._targets, on_error=self._on_error, missing=self._missing, **self._options),
            abandoned=lambda drones: drones.close(),
        )
        return Swarm(sync)


class Swarm:
    """Drones by name, made by :class:`swarm`; ``drones["alpha"]`` is one :class:`Drone`, and iterating gives all.

    Methods have the names, arguments, results and errors of :class:`skyloop.Swarm`. All commands but
    :meth:`emergency_stop` are coroutines, and so is :meth:`feedback`: what ``on_error`` says may be a landing. One
    task at a time awaits them; :meth:`emergency_stop` may be called at any time.
    """

    def __init__(self, sync: client.Swarm) -> None:
        """Wrap a connected swarm."""
        self.sync = sync  #: the wrapped swarm
        self._drones = {name: Drone(drone) for name, drone in sync.items()}

    async def __aenter__(self) -> Swarm:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await in_thread(lambda: self.sync.__exit__(kind, error, traceback))

    async def close(self) -> None:
        """End all connections. Does not land."""
        await in_thread(self.sync.close)

    # Who is in it ----------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all drones, including those set aside."""
        return self.sync.names

    @property
    def active(self) -> dict[str, Drone]:
        """Drones that commands go to, by name."""
        return {name: self._drones[name] for name in self.sync.active}

    @property
    def errors(self) -> dict[str, Exception]:
        """Why drones do not take part, by name: those set aside, and those that were never connected."""
        return self.sync.errors

    def readmit(self, *names: str) -> None:
        """Make drones that were set aside active again; none named: all."""
        self.sync.readmit(*names)

    def items(self) -> list[tuple[str, Drone]]:
        """Return (name, drone) of all drones, including those set aside."""
        return list(self._drones.items())

    def __getitem__(self, name: str) -> Drone:
        self.sync[name]  # raises for an unknown name
        return self._drones[name]

    def __iter__(self) -> Iterator[Drone]:
        return iter(self._drones.values())

    def __len__(self) -> int:
        return len(self._drones)

    def __contains__(self, name: object) -> bool:
        return name in self._drones

    def __repr__(self) -> str:
        return f"<aio.{repr(self.sync)[1:]}"

    # Commands --------------------------------------------------------------------------------------------------

    async def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> None:
        """Take off with all active drones at the same time; see :meth:`skyloop.Swarm.takeoff`."""
        await in_thread(lambda: self.sync.takeoff(wait=wait, timeout_s=timeout_s))

    async def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> None:
        """Land all active drones at their present positions, at the same time."""
        await in_thread(lambda: self.sync.land(wait=wait, timeout_s=timeout_s))

    async def go_to(
        self,
        places: Mapping[str, Sequence[float]],
        *,
        speed: float | None = None,
        wait: bool = True,
        timeout_s: float = 60.0,
        tolerance_m: float = 0.2,
    ) -> None:
        """Fly each drone straight to its own place; see :meth:`skyloop.Swarm.go_to`."""
        await in_thread(
            lambda: self.sync.go_to(places, speed=speed, wait=wait, timeout_s=timeout_s, tolerance_m=tolerance_m)
        )

    async def return_to_start(
        self,
        height_m: float | None = None,
        *,
        land: bool | None = None,
        wait: bool = True,
        timeout_s: float = 180.0,
    ) -> None:
        """Fly all active drones back to where each took off; see :meth:`skyloop.Swarm.return_to_start`."""
        await in_thread(lambda: self.sync.return_to_start(height_m, land=land, wait=wait, timeout_s=timeout_s))

    async def hover(self) -> dict[str, bool]:
        """Stop and hold the position, with all active drones."""
        return await in_thread(self.sync.hover)

    async def idle(self) -> dict[str, bool]:
        """Ask for nothing: keep the authority and leave the vehicles as they are."""
        return await in_thread(self.sync.idle)

    @by_name
    async def velocity(
        self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0
    ) -> dict[str, bool]:
        """Fly with the same velocity, each drone in its own levelled body axes.

        Args:
            forward: Along x, forward [m/s].
            left: Along y, to the left [m/s].
            up: Along z, up [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].
        """
        return await in_thread(lambda: self.sync.velocity(forward=forward, left=left, up=up, yaw_rate=yaw_rate))

    @by_name
    async def attitude(
        self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0
    ) -> dict[str, bool]:
        """Hold the same attitude with all active drones.

        Args:
            roll: Right side down is positive [rad].
            pitch: Nose down is positive [rad].
            climb: Vertical velocity, up [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].
        """
        return await in_thread(lambda: self.sync.attitude(roll=roll, pitch=pitch, climb=climb, yaw_rate=yaw_rate))

    async def reset_emergency(self) -> dict[str, bool]:
        """Leave the emergency state, on the ground, with all active drones."""
        return await in_thread(self.sync.reset_emergency)

    def emergency_stop(self) -> dict[str, bool]:
        """Cut the motors of all drones at once, including those set aside: they fall. Does not wait.

        Raises:
            SwarmError: If the command could not be sent to some, whatever ``on_error`` says.
        """
        return self.sync.emergency_stop()

    async def command(self, action: AnyAction) -> dict[str, bool]:
        """Make ``action`` the newest set-point of all active drones."""
        return await in_thread(lambda: self.sync.command(action))

    async def send(self, actions: Mapping[str, AnyAction]) -> dict[str, bool]:
        """Make each action the newest set-point of the drone of its name; see :meth:`skyloop.Swarm.send`."""
        return await in_thread(lambda: self.sync.send(actions))

    async def each(self, function: Callable[[Drone], Awaitable[T]], what: str = "") -> dict[str, T]:
        """Await ``function`` of all active drones at the same time.

        Args:
            function: A coroutine function. A :class:`SkyloopError` that it raises is that drone's failure; any other
                exception is raised here.
            what: Name of the action in the report of failures; empty: the function's.

        Returns:
            What it returned, by name.

        Raises:
            SwarmError: As ``on_error`` says.
            ClosedError: If the swarm was closed.
        """
        loop = asyncio.get_running_loop()
        ours = {id(drone.sync): drone for drone in self}

        async def call(drone: Drone) -> T:
            return await function(drone)

        def wait_for(drone: client.Drone) -> T:
            return asyncio.run_coroutine_threadsafe(call(ours[id(drone)]), loop).result()

        return await in_thread(lambda: self.sync.each(wait_for, what or getattr(function, "__name__", "each")))

    async def request_authority(
        self,
        priority: int | None = None,
        *,
        wait_s: float = 0.0,
        for_s: float | None = None,
        takeover: TakeoverWay = "now",
        stay: bool = False,
    ) -> dict[str, client.AuthorityStatus]:
        """Ask for the authority over all active drones; see :meth:`skyloop.Drone.request_authority`."""
        return await in_thread(
            lambda: self.sync.request_authority(priority, wait_s=wait_s, for_s=for_s, takeover=takeover, stay=stay)
        )

    async def release_authority(self) -> None:
        """Release the authority over all active drones."""
        await in_thread(self.sync.release_authority)

    # Reading ---------------------------------------------------------------------------------------------------

    async def feedback(self, *, max_age_s: float | None = None) -> dict[str, Feedback]:
        """Return the newest feedback of each active drone, by name; see :meth:`skyloop.Swarm.feedback`."""
        return await in_thread(lambda: self.sync.feedback(max_age_s=max_age_s))

    async def wait_all(self, wanted: Wanted, timeout_s: float = 10.0) -> dict[str, Feedback]:
        """Wait until all active drones are as wanted at the same time; see :meth:`skyloop.Swarm.wait_all`."""
        return await in_thread(lambda: self.sync.wait_all(wanted, timeout_s))

    async def ticks(self, rate_hz: float = 20.0, seconds: float | None = None) -> AsyncIterator[Tick]:
        """Yield at a steady rate on absolute deadlines; see :meth:`skyloop.Swarm.ticks`.

        Args:
            rate_hz: Ticks a second, 0.1 to 200.
            seconds: For how long [s]; None: until the loop is left.
        """
        ticks = self.sync.ticks(rate_hz, seconds)
        while (tick := await in_thread(lambda: next(ticks, None))) is not None:
            yield tick

    @property
    def spread(self) -> Distribution | None:
        """How far apart the first and the last command of one :meth:`send` left this process [s]; None before any."""
        return self.sync.spread

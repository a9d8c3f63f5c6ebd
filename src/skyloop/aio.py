"""The same drone for ``asyncio``: what waits is awaitable, what does not is a plain call.

::

    async with skyloop.aio.connect("sim://") as drone:
        await drone.takeoff()
        async for frame in drone.frames():
            drone.velocity(forward=0.3)

A thin face over :class:`skyloop.client.Drone`, which does the work on its own threads; :attr:`Drone.sync` is it.
A call that is cancelled while it waits is given up here; what it was waiting for is not undone.
"""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from types import TracebackType
from typing import Any, TypeVar, Unpack

from skyloop import client
from skyloop.client.frame import Arrival
from skyloop.client.logbook import Logbook
from skyloop.client.reading import VideoOptions, Wanted
from skyloop.client.result_reading import silence
from skyloop.client.results import ResultSlot, checked_age
from skyloop.client.slots import Buffer
from skyloop.client.takeover import TakeoverAnswer
from skyloop.drivers.uri import parse_uri
from skyloop.errors import NoAnswerError, UsageError
from skyloop.messages import (
    Annotation,
    AnyAction,
    Applied,
    Capabilities,
    Encoding,
    Event,
    Feedback,
    LogEntry,
    Parameter,
    Value,
)
from skyloop.messages.annotation import Shape

T = TypeVar("T")
#: A listener of an asyncio application: a function or a coroutine function. It runs on the event loop.
Callback = Callable[[T], object] | Callable[[T], Awaitable[object]]


class connect:  # noqa: N801  (used like the function skyloop.connect)
    """``async with connect(target, …) as drone``, or ``drone = await connect(…)``; see :func:`skyloop.connect`.

    Raises :class:`UsageError` also for a replay in step (``speed=max``), whose time moves only while its application
    waits with the calls of :class:`skyloop.client.Drone`.
    """

    def __init__(self, target: str, **options: Any) -> None:
        self._target = target
        self._options = options
        self._drone: Drone | None = None

    def __await__(self) -> Any:
        return self._connect().__await__()

    async def __aenter__(self) -> Drone:
        self._drone = await self._connect()
        return self._drone

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._drone is not None:
            await self._drone.__aexit__(kind, error, traceback)

    async def _connect(self) -> Drone:
        _reject_in_step(self._target)
        sync = await _in_thread(lambda: client.connect(self._target, **self._options), abandoned=lambda d: d.close())
        return Drone(sync)


class Config:
    """The parameters; see :class:`skyloop.client.Config`."""

    def __init__(self, sync: client.Config) -> None:
        self._sync = sync

    async def get(self, name: str) -> Value:
        """The present value."""
        return await _in_thread(lambda: self._sync[name])

    async def set(self, name: str, value: object) -> None:
        """Write one value."""
        await _in_thread(lambda: self._sync.__setitem__(name, value))

    async def items(self) -> list[tuple[str, Value]]:
        """(name, value) of all."""
        return await _in_thread(self._sync.items)

    async def describe(self, name: str) -> Parameter:
        """All that is known of one."""
        return await _in_thread(lambda: self._sync.describe(name))


class Drone:
    """One vehicle, connected. Made by :class:`connect`; names and errors are those of :class:`skyloop.client.Drone`."""

    def __init__(self, sync: client.Drone) -> None:
        self.sync = sync  #: the drone behind it
        self.config = Config(sync.config)

    async def __aenter__(self) -> Drone:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await _in_thread(lambda: self.sync.__exit__(kind, error, traceback))

    async def close(self) -> None:
        """Give the authority back and end the connection. Does not land."""
        await _in_thread(self.sync.close)

    # What it is: nothing here waits ----------------------------------------------------------------------------

    @property
    def name(self) -> str:
        return self.sync.name

    @property
    def uri(self) -> str:
        return self.sync.uri

    @property
    def app_id(self) -> int:
        return self.sync.app_id

    @property
    def capabilities(self) -> Capabilities:
        return self.sync.capabilities

    @property
    def authority(self) -> client.AuthorityStatus:
        return self.sync.authority

    @property
    def link(self) -> client.LinkStatus:
        return self.sync.link

    async def stats(self) -> client.Stats:
        """Statistics by channel."""
        return await _in_thread(lambda: self.sync.stats)

    def recent_events(self) -> list[Event]:
        return self.sync.recent_events()

    # Commands --------------------------------------------------------------------------------------------------

    async def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> bool:
        return await _in_thread(lambda: self.sync.takeoff(wait=wait, timeout_s=timeout_s))

    async def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> bool:
        return await _in_thread(lambda: self.sync.land(wait=wait, timeout_s=timeout_s))

    def hover(self) -> bool:
        return self.sync.hover()

    def idle(self) -> bool:
        return self.sync.idle()

    def velocity(self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Body's levelled axes [m/s]; counter-clockwise [rad/s]."""
        return self.sync.velocity(forward=forward, left=left, up=up, yaw_rate=yaw_rate)

    def attitude(self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Right side down, nose down [rad], up [m/s], counter-clockwise [rad/s]."""
        return self.sync.attitude(roll=roll, pitch=pitch, climb=climb, yaw_rate=yaw_rate)

    def emergency_stop(self) -> bool:
        return self.sync.emergency_stop()

    def reset_emergency(self) -> bool:
        return self.sync.reset_emergency()

    def command(self, action: AnyAction) -> bool:
        return self.sync.command(action)

    async def request_authority(self, priority: int | None = None, **options: Any) -> client.AuthorityStatus:
        return await _in_thread(lambda: self.sync.request_authority(priority, **options))

    def on_takeover(
        self, function: Callable[[client.TakeoverRequest], TakeoverAnswer | Awaitable[TakeoverAnswer]]
    ) -> Listener:
        """See :meth:`skyloop.client.Drone.on_takeover`; runs on the event loop."""
        return Listener(self.sync.on_takeover(_on_loop(function)))

    async def release_authority(self) -> None:
        await _in_thread(self.sync.release_authority)

    # Reading ---------------------------------------------------------------------------------------------------

    def feedback(self, *, max_age_s: float | None = None) -> Feedback:
        return self.sync.feedback(max_age_s=max_age_s)

    async def next_feedback(self, timeout_s: float = 1.0) -> Feedback:
        return await _in_thread(lambda: self.sync.next_feedback(timeout_s))

    def frame(self, camera: str | None = None, *, max_age_s: float | None = None) -> client.Frame | None:
        return self.sync.frame(camera, max_age_s=max_age_s)

    async def next_frame(self, camera: str | None = None, *, timeout_s: float = 1.0) -> client.Frame:
        return await _in_thread(lambda: self.sync.next_frame(camera, timeout_s=timeout_s))

    async def wait(self, state: Wanted, timeout_s: float = 10.0) -> Feedback:
        return await _in_thread(lambda: self.sync.wait(state, timeout_s))

    async def frames(
        self, camera: str | None = None, *, timeout_s: float = 5.0, **how: Unpack[VideoOptions]
    ) -> AsyncIterator[client.Frame]:
        """Each newest frame, until the drone is closed; ``how``: as of a drone without asyncio.

        Raises :class:`NoAnswerError`.
        """
        channel = self.sync.channel(camera, **how)
        buffer: Buffer[Arrival] = Buffer()
        came = asyncio.Event()
        loop = asyncio.get_running_loop()

        def sink(arrival: Arrival) -> None:
            buffer.put(arrival)
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(came.set)

        channel.topic.add(sink, lambda: buffer.dropped)
        try:
            while not self.sync.closed:
                try:
                    await asyncio.wait_for(came.wait(), timeout_s)
                except TimeoutError:
                    raise NoAnswerError(f"no frame of {channel.camera.name} came within {timeout_s:g} s") from None
                came.clear()
                arrival = buffer.take()
                if arrival is None:
                    continue
                if arrival.header.encoding is Encoding.JPEG:
                    frame = await _in_thread(lambda arrival=arrival: channel.picture(arrival))  # type: ignore[misc]
                else:
                    frame = channel.picture(arrival)
                if frame is not None:
                    yield frame
        finally:
            channel.topic.remove(sink)

    def result(self, processor: str, *, max_age_s: float | None = None) -> client.Result | None:
        return self.sync.result(processor, max_age_s=max_age_s)

    async def results(
        self, processor: str, *, max_age_s: float | None = None, timeout_s: float = 5.0
    ) -> AsyncIterator[client.Result]:
        """Each newest result of a processor, until the drone is closed. Raises :class:`NoAnswerError`."""
        topic = self.sync.result_channel(processor).topic
        slot = ResultSlot(checked_age(max_age_s))
        came = asyncio.Event()
        loop = asyncio.get_running_loop()

        def sink(result: client.Result) -> None:
            slot.put(result)
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(came.set)

        topic.add(sink, lambda: slot.dropped)
        try:
            deadline = loop.time() + timeout_s
            while not self.sync.closed:
                try:
                    await asyncio.wait_for(came.wait(), deadline - loop.time())
                except TimeoutError:
                    raise NoAnswerError(silence(processor, timeout_s, slot.expired)) from None
                came.clear()
                result = slot.take()
                if result is not None:
                    yield result
                    deadline = loop.time() + timeout_s
        finally:
            topic.remove(sink)

    # Listening -------------------------------------------------------------------------------------------------

    def on_feedback(self, function: Callback[Feedback]) -> Listener:
        return Listener(self.sync.on_feedback(_on_loop(function)))

    def on_event(self, function: Callback[Event]) -> Listener:
        return Listener(self.sync.on_event(_on_loop(function)))

    def on_link(self, function: Callback[client.LinkStatus]) -> Listener:
        return Listener(self.sync.on_link(_on_loop(function)))

    def on_command(self, function: Callback[Applied]) -> Listener:
        return Listener(self.sync.on_command(_on_loop(function)))

    def on_annotation(self, function: Callback[Annotation]) -> Listener:
        return Listener(self.sync.on_annotation(_on_loop(function)))

    def on_log(self, function: Callback[LogEntry]) -> Listener:
        return Listener(self.sync.on_log(_on_loop(function)))

    def on_result(
        self, function: Callback[client.Result], processor: str | None = None, *, max_age_s: float | None = None
    ) -> Listener:
        return Listener(self.sync.on_result(_on_loop(function), processor, max_age_s=max_age_s))

    def add_processor(
        self, function: Callable[[client.Frame], object], camera: str | None = None, **options: Any
    ) -> client.Processor[Any]:
        """On a thread of its own, as in the other face: looking at pictures would hold up the event loop."""
        if inspect.iscoroutinefunction(function):
            raise UsageError(
                "a processor is a plain function, which runs on its own thread; else iterate over frames()"
            )
        return self.sync.add_processor(function, camera, **options)

    def annotate(self, frame: client.Frame, shapes: Iterable[Shape], source: str | None = None) -> bool:
        return self.sync.annotate(frame, shapes, source)

    @property
    def log(self) -> Logbook:
        return self.sync.log


class Listener:
    """A listener whose function runs on the event loop, one call at a time, with the newest."""

    def __init__(self, sync: client.Listener[Any]) -> None:
        self._sync = sync

    def cancel(self) -> None:
        """Call the function no more."""
        self._sync.cancel(wait=False)  # its thread may be waiting for this very event loop

    @property
    def delivered(self) -> int:
        return self._sync.delivered

    @property
    def dropped(self) -> int:
        return self._sync.dropped

    @property
    def errors(self) -> int:
        return self._sync.errors


def _reject_in_step(target: str) -> None:
    """Raises :class:`UsageError` for a replay whose time would stand still here."""
    if isinstance(target, str) and target.startswith("replay://") and parse_uri(target).options.get("speed") == "max":
        raise UsageError(
            f"{target}: speed=max is in step with the one thread that waits, which an event loop never does: use "
            "skyloop.connect, or give a number, such as speed=10"
        )


def _on_loop(function: Callback[T]) -> Callable[[T], Any]:
    """The function, to be called from another thread, run on this event loop and waited for."""
    loop = asyncio.get_running_loop()

    async def call(sample: T) -> object:
        result = function(sample)
        return await result if inspect.isawaitable(result) else result

    def from_thread(sample: T) -> object:
        return None if loop.is_closed() else asyncio.run_coroutine_threadsafe(call(sample), loop).result()

    return from_thread


async def _in_thread(function: Callable[[], T], *, abandoned: Callable[[T], object] | None = None) -> T:
    """Run what waits on a thread of its own, so that no pool can be full when the vehicle has to land.

    If the caller is cancelled meanwhile, ``abandoned`` gets the result that nobody waits for.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[T] = loop.create_future()

    def settle(result: T | None, error: BaseException | None) -> None:
        if future.cancelled():
            if error is None and abandoned is not None:
                threading.Thread(target=abandoned, args=(result,), daemon=True).start()
        elif error is not None:
            future.set_exception(error)
        else:
            future.set_result(result)  # type: ignore[arg-type]

    def work() -> None:
        result, error = None, None
        try:
            result = function()
        except BaseException as problem:  # noqa: BLE001  (it is raised where the result is awaited)
            error = problem
        try:
            loop.call_soon_threadsafe(settle, result, error)
        except RuntimeError:  # the loop has ended
            if error is None and abandoned is not None:
                abandoned(result)  # type: ignore[arg-type]

    threading.Thread(target=work, name="skyloop-aio", daemon=True).start()
    return await future

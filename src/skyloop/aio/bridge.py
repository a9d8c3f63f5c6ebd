"""Build the asyncio API for drones and swarms: tables of members forwarded to the synchronous classes, and the rest."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import re
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Generator, Iterator, Mapping
from contextlib import AbstractAsyncContextManager
from functools import wraps
from types import TracebackType
from typing import Any, Generic, TypeVar, Unpack

from skyloop import client
from skyloop.client.channels import Mailbox, Notifier, checked_age
from skyloop.client.commands import cancelled
from skyloop.client.frame import ReceivedFrame
from skyloop.client.results import ResultMailbox, silence
from skyloop.client.swarm import Tick
from skyloop.client.video import VideoChannel, VideoOptions
from skyloop.drivers.uri import parse_uri
from skyloop.errors import NoAnswerError, UsageError
from skyloop.messages import Encoding

T = TypeVar("T")
Opened = TypeVar("Opened", bound=AbstractAsyncContextManager[Any, Any])
#: A callback in an asyncio application: a plain function or a coroutine function. It is run on the event loop.
Callback = Callable[[T], object] | Callable[[T], Awaitable[object]]


class LoopNotifier(Notifier):
    """Wakes the coroutine that waits in :meth:`within`, from any thread."""

    __slots__ = ("_loop", "_notified")

    def __init__(self) -> None:
        super().__init__()
        self._notified = asyncio.Event()
        self._loop = asyncio.get_running_loop()

    def notify(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._notified.set)

    async def within(self, timeout_s: float) -> bool:
        """Wait for a notification; return whether a new one arrived in time."""
        try:
            await asyncio.wait_for(self._notified.wait(), timeout_s)
        except TimeoutError:
            return False
        self._notified.clear()
        return True


async def in_thread(function: Callable[[], T], *, abandoned: Callable[[T], object] | None = None) -> T:
    """Run a blocking function in its own thread: a thread pool might be full when the vehicle has to land.

    If the caller is cancelled, the function stops waiting for a command (see
    :data:`skyloop.client.commands.cancelled`), and ``abandoned`` is called with the unclaimed result.
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

    outside = cancelled.get()  # whether an outer thread that waits for this coroutine was cancelled

    def work() -> None:
        result, error = None, None
        cancelled.set(lambda: future.cancelled() or outside())
        try:
            result = function()
        except BaseException as problem:  # noqa: BLE001  (it is re-raised where the result is awaited)
            error = problem
        try:
            loop.call_soon_threadsafe(settle, result, error)
        except RuntimeError:  # the loop has ended
            if error is None and abandoned is not None:
                abandoned(result)  # type: ignore[arg-type]

    threading.Thread(target=work, name="skyloop-aio", daemon=True).start()
    try:
        return await future
    except asyncio.CancelledError:
        # If the result arrived in the same iteration of the event loop as the cancellation, settle() did not see it.
        if future.done() and not future.cancelled() and future.exception() is None and abandoned is not None:
            threading.Thread(target=abandoned, args=(future.result(),), daemon=True).start()
        raise


def from_thread(function: Callback[T]) -> Callable[[T], Any]:
    """Wrap ``function`` for another thread, which can call it and wait while it runs on this event loop."""
    loop = asyncio.get_running_loop()

    async def call(sample: T) -> object:
        result = function(sample)
        return await result if inspect.isawaitable(result) else result

    def wait(sample: T) -> object:
        return None if loop.is_closed() else asyncio.run_coroutine_threadsafe(call(sample), loop).result()

    return wait


# Functions that turn a synchronous member into an asyncio one, keeping its name, defaults and docstring --------------


def mirrors(kind: type, rows: Mapping[Callable[[Any], Any], str]) -> Callable[[type[T]], type[T]]:
    """Decorate an asyncio class with members of ``kind``; ``rows`` maps each wrapper to the names of its members."""

    def fill(face: type[T]) -> type[T]:
        for way, names in rows.items():
            for name in names.split():
                setattr(face, name, way(getattr(kind, name)))
        return face

    return fill


def at_once(member: Any) -> Any:
    """Keep a non-blocking method or property unchanged."""
    return property(_forwarded(member)) if isinstance(member, property) else _forwarded(member)


def awaited(member: Any) -> Any:
    """Turn a blocking method or property into a coroutine function, which waits in its own thread."""
    plain = _forwarded(member)

    @wraps(plain)
    async def call(self: Any, *args: Any, **given: Any) -> Any:
        return await in_thread(lambda: plain(self, *args, **given))

    return _explained(call, "This is a coroutine, which waits in its own thread. Cancelling the task ends the waiting.")


def on_loop(member: Any) -> Any:
    """Make a method run its callback on the caller's event loop."""
    plain = _forwarded(member)

    @wraps(plain)
    def call(self: Any, function: Any, *args: Any, **given: Any) -> Any:
        if given.get("inline"):
            raise UsageError(f"{member.__name__}: inline must be False, because the function runs on the event loop")
        return Listener(plain(self, from_thread(function) if callable(function) else function, *args, **given))

    where = r"in its own thread( or, with ``inline``, on the receiving thread)?"
    call.__doc__ = re.sub(where, "on the event loop", call.__doc__ or "")
    signature = inspect.signature(member)
    takes = signature.parameters["function"].annotation
    either = re.sub(r"^(Callable\[\[.*\], )(.*)\]$", r"\1\2 | Awaitable[\2]]", takes)
    text = "``function``, plain or a coroutine function, runs on the event loop"
    text += "; ``inline`` must be False." if "inline" in signature.parameters else "."
    return _explained(_typed(call, signature, function=either, returns="Listener"), text)


def opener(face: Callable[[Any], Opened], function: Callable[..., Any]) -> Callable[..., Opening[Opened]]:
    """Turn a synchronous connect function into one whose result can be awaited or used as a context manager."""

    @wraps(function)
    def call(*targets: Any, **options: Any) -> Opening[Opened]:
        return Opening(face, function.__name__, targets, options)

    text = "The result connects when it is awaited, or entered with ``async with``. ``speed=max`` is refused."
    return _explained(_typed(call, inspect.signature(function), returns=f"Opening[{face.__name__}]"), text)


def like(member: Any, text: str = "") -> Callable[[T], T]:
    """Give a hand-written method the docstring of its counterpart, followed by one more paragraph."""

    def explain(function: T) -> T:
        function.__doc__ = member.__doc__
        return _explained(function, text)

    return explain


def _forwarded(member: Any) -> Callable[..., Any]:
    """Return a function that calls the method or reads the property of the wrapped object."""
    reads = isinstance(member, property)
    function = member.fget if reads else member

    @wraps(function)
    def call(self: Any, *args: Any, **given: Any) -> Any:
        if any(callable(one) and inspect.iscoroutinefunction(one) for one in (*args, *given.values())):
            raise UsageError(f"{function.__name__} takes a plain function, which it calls on another thread")
        found = getattr(self.sync, function.__name__)
        return found if reads else found(*args, **given)

    return call


def _explained(function: T, text: str) -> T:
    summary, _, rest = inspect.cleandoc(function.__doc__ or "").partition("\n\n")
    function.__doc__ = "\n\n".join(filter(None, (summary, text, rest)))
    return function


def _typed(made: T, signature: inspect.Signature, *, returns: str, **types: str) -> T:
    parameters = [one.replace(annotation=types.get(one.name, one.annotation)) for one in signature.parameters.values()]
    own: Any = made
    own.__signature__ = signature.replace(parameters=parameters, return_annotation=returns)
    own.__annotations__ = {one.name: one.annotation for one in parameters} | {"return": returns}
    del own.__wrapped__  # because its annotations would take precedence
    return made


# The asyncio classes -------------------------------------------------------------------------------------------------


@mirrors(client.Config, {awaited: "items values parameters describe"})
class Config:
    """Parameters: ``await drone.config.get("limits.tilt")``, ``await drone.config.set("limits.tilt", 0.2)``.

    Writing needs the authority. :class:`skyloop.client.Config` explains how written values are kept.
    """

    sync: client.Config  #: wrapped parameters

    def __init__(self, sync: client.Config) -> None:
        self.sync = sync

    get = awaited(client.Config.__getitem__)
    set = awaited(client.Config.__setitem__)


@mirrors(client.Listener, {at_once: "delivered dropped"})
class Listener:
    """A callback that runs on the event loop; its calls never overlap."""

    sync: client.Listener[Any]  #: wrapped listener; its thread waits for each call

    def __init__(self, sync: client.Listener[Any]) -> None:
        self.sync = sync

    def cancel(self) -> None:
        """Stop calling the function. Does not wait for a running call."""
        self.sync.cancel(wait=False)  # its thread may be waiting for this event loop

    @property
    def errors(self) -> int:
        """Number of calls that raised an exception."""
        return self.sync.errors


@mirrors(
    client.Drone,
    {
        awaited: """
            close stats preflight takeoff land go_to return_to_start request_authority release_authority
            next_feedback next_frame wait overview
        """,
        at_once: """
            name uri app_id capabilities authority link closed now_ns clock_offset_ns clock_uncertainty_ns
            start_position age_s recent_events hover idle velocity attitude emergency_stop reset_emergency command
            send_external_pose emit annotate feedback frame result on_frame on_encoded
        """,
        on_loop: """
            on_takeover on_overview on_feedback on_event on_link on_command on_annotation on_log on_result
        """,
    },
)
class Drone:
    """A connected vehicle, returned by :func:`connect`.

    Methods have the same names, arguments, results and errors as in :class:`skyloop.Drone`; those that wait are
    coroutines. Callbacks are plain or coroutine functions, and run on the event loop that was running when they were
    added. Image callbacks are the exception: they are plain functions that run in their own threads, because image
    processing would block the event loop. The test passed to :meth:`wait` must be a plain function, too.
    """

    sync: client.Drone  #: wrapped drone
    config: Config  #: parameters of the vehicle and of the proxy

    def __init__(self, sync: client.Drone) -> None:
        self.sync = sync
        self.config = Config(sync.config)

    async def __aenter__(self) -> Drone:
        return self

    __aexit__ = awaited(client.Drone.__exit__)

    @property
    def log(self) -> client.Logbook:
        """Publishes text and numbers during the flight; see :class:`skyloop.client.Logbook`."""
        return self.sync.log

    @like(client.Drone.frames, "A JPEG is decoded on another thread, while :meth:`frame` decodes on the event loop.")
    async def frames(
        self, camera: str | None = None, *, timeout_s: float = 5.0, **how: Unpack[VideoOptions]
    ) -> AsyncIterator[client.Frame]:
        state, notifier, clock = self.sync._state, LoopNotifier(), asyncio.get_running_loop().time
        channel, mailbox = state.follow(lambda: state.video.channel(camera, **how)), Mailbox[ReceivedFrame](1, notifier)
        with state.closing(mailbox), channel.into(mailbox):
            deadline = clock() + timeout_s
            while not self.sync.closed:
                if not await notifier.within(deadline - clock()):
                    raise state.no_frame(channel.current.camera.name, timeout_s)
                frame = await _decoded(channel.current, mailbox.take(), how.get("max_age_s"))
                if frame is not None:
                    yield frame
                    deadline = clock() + timeout_s

    @like(client.Drone.results)
    async def results(
        self, processor: str, *, max_age_s: float | None = None, timeout_s: float = 5.0
    ) -> AsyncIterator[client.Result]:
        state, notifier, clock = self.sync._state, LoopNotifier(), asyncio.get_running_loop().time
        mailbox = ResultMailbox(checked_age(max_age_s), notifier)
        with state.closing(mailbox), state.results.channel(processor).into(mailbox):
            deadline = clock() + timeout_s
            while not self.sync.closed:
                if not await notifier.within(deadline - clock()):
                    raise NoAnswerError(silence(processor, timeout_s, mailbox.expired))
                result = mailbox.take()
                if result is not None:
                    yield result
                    deadline = clock() + timeout_s


async def _decoded(video: VideoChannel, frame: ReceivedFrame | None, max_age_s: float | None) -> client.Frame | None:
    if frame is not None and frame.header.encoding is Encoding.JPEG:
        return await in_thread(lambda: video.picture(frame, max_age_s))
    return None if frame is None else video.picture(frame, max_age_s)


@mirrors(
    client.Swarm,
    {
        awaited: """
            close takeoff land go_to return_to_start hover idle velocity attitude reset_emergency command send
            request_authority release_authority feedback wait_all
        """,
        at_once: "names errors readmit emergency_stop spread __len__ __contains__",
    },
)
class Swarm:
    """Drones by name, returned by :func:`swarm`; ``drones["alpha"]`` is one :class:`Drone`; iterating yields all.

    Methods have the same names, arguments, results and errors as in :class:`skyloop.Swarm`. All commands except
    :meth:`emergency_stop` are coroutines. :meth:`feedback` is also a coroutine, because ``on_error`` may require a
    landing. Only one task at a time may await these coroutines; :meth:`emergency_stop` may be called at any time.
    """

    sync: client.Swarm  #: wrapped swarm

    def __init__(self, sync: client.Swarm) -> None:
        self.sync = sync
        self._drones = {name: Drone(drone) for name, drone in sync.items()}

    async def __aenter__(self) -> Swarm:
        return self

    __aexit__ = awaited(client.Swarm.__exit__)

    @property
    def active(self) -> dict[str, Drone]:
        """The drones that receive commands, by name; see :attr:`skyloop.Swarm.active`."""
        return {name: self._drones[name] for name in self.sync.active}

    @like(client.Swarm.items)
    def items(self) -> list[tuple[str, Drone]]:
        return list(self._drones.items())

    def __getitem__(self, name: str) -> Drone:
        self.sync[name]  # raises an error for an unknown name
        return self._drones[name]

    def __iter__(self) -> Iterator[Drone]:
        return iter(self._drones.values())

    def __repr__(self) -> str:
        return f"<aio.{repr(self.sync)[1:]}"

    async def each(self, function: Callable[[Drone], Awaitable[T]], what: str = "") -> dict[str, T]:
        """Await ``function`` for all active drones concurrently on this event loop.

        Cancelling this coroutine cancels all of its calls. Exceptions, ``what`` and the result work as in
        :meth:`skyloop.Swarm.each`.
        """
        loop = asyncio.get_running_loop()
        ours = {id(drone.sync): drone for drone in self}
        running: set[asyncio.Task[Any]] = set()  # changed on this event loop only, so that none is missed
        over = False

        async def call(drone: Drone) -> T:
            task = asyncio.current_task()
            if over or task is None:
                raise asyncio.CancelledError
            running.add(task)
            return await function(drone)

        def wait_for(drone: client.Drone) -> T:
            return asyncio.run_coroutine_threadsafe(call(ours[id(drone)]), loop).result()

        try:
            return await in_thread(lambda: self.sync.each(wait_for, what or getattr(function, "__name__", "each")))
        finally:  # after a cancellation, the tasks must not keep sending commands that conflict with later ones
            over = True
            for task in running:
                task.cancel()

    @like(client.Swarm.ticks)
    async def ticks(self, rate_hz: float = 20.0, seconds: float | None = None) -> AsyncIterator[Tick]:
        ticks = self.sync.ticks(rate_hz, seconds)
        while (tick := await in_thread(lambda: next(ticks, None))) is not None:
            yield tick


class Opening(Generic[Opened]):
    """Result of :func:`connect` and :func:`swarm`; connects when awaited, or for the duration of an ``async with``."""

    _opened: Opened | None = None

    def __init__(
        self, face: Callable[[Any], Opened], name: str, targets: tuple[Any, ...], options: dict[str, Any]
    ) -> None:
        self._face, self._name, self._targets, self._options = face, name, targets, options

    async def _connect(self) -> Opened:
        for target in (*self._targets, self._options.get("target")):
            for address in target.values() if isinstance(target, Mapping) else [target]:
                _reject_in_step(address)
        connect: Callable[..., Any] = getattr(client, self._name)
        sync = await in_thread(lambda: connect(*self._targets, **self._options), abandoned=lambda made: made.close())
        return self._face(sync)

    def __await__(self) -> Generator[Any, None, Opened]:
        return self._connect().__await__()

    async def __aenter__(self) -> Opened:
        self._opened = await self._connect()
        return self._opened

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._opened is not None:
            await self._opened.__aexit__(kind, error, traceback)


def _reject_in_step(target: object) -> None:
    """Raise an error for a stepped replay, because its time would never advance in asyncio."""
    if isinstance(target, str) and target.startswith("replay://") and parse_uri(target).options.get("speed") == "max":
        raise UsageError(
            f"{target}: speed=max advances only while a thread waits, which an event loop never does: use "
            "skyloop.connect, or give a number, such as speed=10"
        )


connect, swarm = opener(Drone, client.connect), opener(Swarm, client.swarm)

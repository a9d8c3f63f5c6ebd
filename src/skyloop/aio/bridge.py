"""Between the client's threads and an event loop."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import threading
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Generator
from contextlib import AbstractAsyncContextManager
from types import TracebackType
from typing import Any, Generic, TypeVar

from skyloop.client.commands import cancelled
from skyloop.client.mailbox import Notifier
from skyloop.drivers.uri import parse_uri
from skyloop.errors import UsageError

T = TypeVar("T")
Opened = TypeVar("Opened", bound=AbstractAsyncContextManager[Any, Any])
#: A callback of an asyncio application, a function or a coroutine function. It runs on the event loop.
Callback = Callable[[T], object] | Callable[[T], Awaitable[object]]


class LoopNotifier(Notifier):
    """Wakes the coroutine that waits for :attr:`came`, from any thread."""

    __slots__ = ("came", "loop")

    def __init__(self) -> None:
        super().__init__()
        self.came = asyncio.Event()
        self.loop = asyncio.get_running_loop()

    def notify(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self.loop.call_soon_threadsafe(self.came.set)


def reject_in_step(target: str) -> None:
    """Raise :class:`UsageError` for a stepped replay, whose time would stand still here."""
    if isinstance(target, str) and target.startswith("replay://") and parse_uri(target).options.get("speed") == "max":
        raise UsageError(
            f"{target}: speed=max is in step with the one thread that waits, which an event loop never does: use "
            "skyloop.connect, or give a number, such as speed=10"
        )


def on_loop(function: Callback[T]) -> Callable[[T], Any]:
    """Wrap ``function`` so that another thread can call it: it runs on this event loop and is waited for."""
    loop = asyncio.get_running_loop()

    async def call(sample: T) -> object:
        result = function(sample)
        return await result if inspect.isawaitable(result) else result

    def from_thread(sample: T) -> object:
        return None if loop.is_closed() else asyncio.run_coroutine_threadsafe(call(sample), loop).result()

    return from_thread


async def in_thread(function: Callable[[], T], *, abandoned: Callable[[T], object] | None = None) -> T:
    """Run a function that waits on a thread of its own: a pool could be full when the vehicle has to land.

    If the caller is cancelled meanwhile, a wait for a command ends (see :data:`skyloop.client.commands.cancelled`),
    and ``abandoned`` is called with the result that nobody waits for.
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
        cancelled.set(future.cancelled)
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
    try:
        return await future
    except asyncio.CancelledError:
        # Cancelled in the very round of the loop in which the result came: nobody else will ever see it.
        if future.done() and not future.cancelled() and future.exception() is None and abandoned is not None:
            threading.Thread(target=abandoned, args=(future.result(),), daemon=True).start()
        raise


class Opening(ABC, Generic[Opened]):
    """What is awaited for a drone or a swarm, or entered with ``async with`` so that it ends with the block."""

    _opened: Opened | None = None

    @abstractmethod
    async def _connect(self) -> Opened: ...

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

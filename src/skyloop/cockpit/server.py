"""Runs the cockpit: connects as an observer of the lowest priority, binds to loopback, serves until told to stop."""

from __future__ import annotations

import asyncio
import errno
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from skyloop.errors import MissingExtraError, UsageError
from skyloop.messages import LOWEST_PRIORITY

if TYPE_CHECKING:
    import uvicorn

    from skyloop.client import Drone

_LARGEST_MESSAGE = 4096  # bytes from a page: acknowledgements only
_LOOK_S = 0.05  # how often it is asked whether to end


def serve_cockpit(
    name: str,
    host: str = "127.0.0.1",
    port: int = 0,
    *,
    on_ready: Callable[[str], None] | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Serve the page for the drone of a running proxy, until ``stop`` is set or a signal (Ctrl-C, SIGTERM) comes.

    ``host`` is a loopback address; ``port`` 0 takes a free one. ``on_ready`` is called once on this thread with the
    page's address (default: it is printed). Raises :class:`UsageError` for another host or a port in use,
    :class:`UnknownNameError` if no such proxy runs, :class:`MissingExtraError` if the cockpit's parts are missing.
    """
    try:
        import cv2  # noqa: F401
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
        import websockets  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("the cockpit", "cockpit", cause=str(error)) from error
    from skyloop.client import connect
    from skyloop.cockpit.security import loopback_address

    listening = _bind(loopback_address(host), port)
    try:
        with connect(name, access="observe", priority=LOWEST_PRIORITY, name="cockpit") as drone:
            _serve(drone, listening, on_ready or _tell, stop)
    finally:
        listening.close()


def _bind(address: str, port: int) -> socket.socket:
    listening = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((address, port))
    except (OSError, OverflowError) as error:
        listening.close()
        taken = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        hint = "is in use; port 0 takes a free one" if taken else f"can't be used: {error}"
        raise UsageError(f"port {port} of {address} {hint}") from error
    return listening


def _serve(
    drone: Drone, listening: socket.socket, on_ready: Callable[[str], None], stop: threading.Event | None
) -> None:
    import uvicorn

    from skyloop.cockpit.app import create_app
    from skyloop.cockpit.security import own_names

    address, port = listening.getsockname()[:2]
    app = create_app({drone.name: drone}, own_names(address, port))
    config = uvicorn.Config(
        app, log_level="warning", access_log=False, server_header=False, ws_max_size=_LARGEST_MESSAGE, lifespan="on"
    )
    # What a page that stopped reading leaves in buffers must not hold up the end.
    config.timeout_graceful_shutdown = 2
    asyncio.run(_run(_quiet_server(config), listening, lambda: on_ready(_page_address(address, port)), stop))


def _quiet_server(config: uvicorn.Config) -> uvicorn.Server:
    """One that leaves signals alone: uvicorn raises them anew at its end, which would cut short our own."""
    import uvicorn

    class QuietServer(uvicorn.Server):
        @contextmanager
        def capture_signals(self) -> Iterator[None]:
            yield

    return QuietServer(config)


async def _run(
    server: uvicorn.Server, listening: socket.socket, on_ready: Callable[[], None], stop: threading.Event | None
) -> None:
    ending = asyncio.Event()
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, ending.set)
    serving = asyncio.create_task(server.serve(sockets=[listening]))
    while not server.started and not serving.done():
        await asyncio.sleep(_LOOK_S / 10)
    if not serving.done():
        on_ready()
    while not serving.done():
        await asyncio.wait([serving], timeout=_LOOK_S)
        if ending.is_set() or (stop is not None and stop.is_set()):
            server.should_exit = True
    await serving


def _tell(page: str) -> None:
    print(f"cockpit: {page}", flush=True)


def _page_address(address: str, port: int) -> str:
    return f"http://[{address}]:{port}/" if ":" in address else f"http://{address}:{port}/"

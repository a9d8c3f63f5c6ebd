"""Simulate pages without a browser, for tests and for measuring what pages cost.

::

    with Pages("http://127.0.0.1:8000/", "alpha", count=10) as pages:
        …
    print(pages.frames, pages.newest_age_s)

Each page opens the telemetry and video of one drone and acknowledges every frame, as a page in a browser does after
drawing the frame. Nothing is decoded, because drawing happens in the browser and costs the cockpit nothing.
"""

from __future__ import annotations

import asyncio
import json
import ssl
import struct
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final, Self

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Origin

from skyloop.clock import monotonic_ns, seconds
from skyloop.errors import LinkError

_LENGTH: Final = struct.Struct(">I")
STARTS_WITHIN_S: Final = 10.0  #: time limit for the first state of every page


class HeadlessPage:
    """One page that shows one drone. Must be used on one event loop; the counts may be read on any thread."""

    def __init__(
        self,
        address: str,
        drone: str,
        cameras: Sequence[str] | None = None,
        *,
        token: str | None = None,
        tls: ssl.SSLContext | None = None,
        draw_s: float = 0.0,
    ) -> None:
        """Initialise a page without opening anything.

        Args:
            address: Address of the cockpit, as printed.
            drone: The drone's name.
            cameras: The cameras to watch, by default only the first one.
            token: A token, if the cockpit requires one.
            tls: TLS context for an ``https`` address.
            draw_s: The simulated time it takes to draw a frame [s].
        """
        self.drone = drone
        self.states = 0  #: number of telemetry messages
        self.frames = 0
        self.bytes = 0  #: total size of all frames received
        self.newest_age_s: float | None = None  #: age of the newest frame on arrival, if both ends share a clock
        self.vehicle: dict[str, Any] = {}
        self.state: dict[str, Any] = {}  #: the newest state
        self._origin = address.rstrip("/")
        self._cameras = cameras
        self._headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._tls = tls
        self._draw_s = draw_s

    def open(self, path: str) -> connect:
        """Open one of the cockpit's WebSockets: ``async with page.open("/ws/overview") as socket``."""
        return connect(
            f"ws{self._origin.removeprefix('http')}{path}",
            origin=Origin(self._origin),
            additional_headers=self._headers,
            ssl=self._tls,
            max_size=None,
            compression=None,
        )

    async def run(self) -> None:
        """Watch until cancelled; raise ``LinkError`` if the cockpit closed the connection or refused the page."""
        base = f"/ws/drones/{self.drone}"
        try:
            async with self.open(f"{base}/telemetry") as socket:
                self.vehicle = json.loads(await socket.recv())
                cameras = self._cameras
                if cameras is None:
                    cameras = [camera["name"] for camera in self.vehicle["cameras"][:1]]
                async with asyncio.TaskGroup() as group:
                    group.create_task(self._listen(socket))
                    for camera in cameras:
                        group.create_task(self._watch(f"{base}/video/{camera}"))
        except (OSError, InvalidStatus, ConnectionClosed) as error:
            raise LinkError(f"the cockpit at {self._origin} closed the connection: {error}") from error
        except ExceptionGroup as group_of:
            raise LinkError(f"the cockpit at {self._origin} closed it: {group_of.exceptions[0]}") from group_of

    async def _listen(self, socket: ClientConnection) -> None:
        async for message in socket:
            content = json.loads(message)
            if content["type"] == "state":
                self.state = content
                self.states += 1
        raise LinkError("telemetry ended")

    async def _watch(self, path: str) -> None:
        async with self.open(path) as socket:
            async for message in socket:
                if isinstance(message, bytes):
                    head = unpack_head(message)
                    self.frames += 1
                    self.bytes += len(message)
                    self.newest_age_s = seconds(monotonic_ns() - int(head["captured_ns"]))
                    await asyncio.sleep(self._draw_s)
                    await socket.send(json.dumps({"ack": head["ack"]}))
        raise LinkError("video ended")


def unpack_head(message: bytes) -> dict[str, Any]:
    """Return the head of a binary message, which precedes the JPEG file."""
    (length,) = _LENGTH.unpack_from(message)
    head: dict[str, Any] = json.loads(message[_LENGTH.size : _LENGTH.size + length])
    return head


class Pages:
    """Several pages on a separate thread; a context manager for programs that don't use asyncio.

    Entering it waits until each page has received its first state; if this takes longer than :data:`STARTS_WITHIN_S`,
    :class:`LinkError` is raised.
    """

    def __init__(self, address: str, drone: str, count: int = 1, **options: Any) -> None:
        """Initialise the pages.

        Args:
            address: Address of the cockpit, as printed.
            drone: The drone's name.
            count: The number of pages.
            **options: Other arguments of :class:`HeadlessPage`.
        """
        self.clients = [HeadlessPage(address, drone, **options) for _ in range(count)]
        self.problem: BaseException | None = None  #: the error that ended the pages, if any
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None
        self._changed = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), name="pages", daemon=True)

    @property
    def frames(self) -> int:
        return sum(client.frames for client in self.clients)

    @property
    def newest_age_s(self) -> float | None:
        """The largest age of any page's newest frame [s]; None if a page has received no frame."""
        ages = [client.newest_age_s for client in self.clients]
        known = [age for age in ages if age is not None]
        return max(known) if known and len(known) == len(ages) else None

    def __enter__(self) -> Self:
        self._thread.start()
        self._changed.wait(STARTS_WITHIN_S)
        if self.problem is not None or not all(client.states for client in self.clients):
            self.close()
            raise LinkError(f"the pages did not open within {STARTS_WITHIN_S:g} s: {self.problem or 'no answer'}")
        return self

    def close(self) -> None:
        """Close all pages. Idempotent."""
        if self._loop is not None and self._stop is not None and not self._loop.is_closed():
            with suppress(RuntimeError):  # the loop was closed just now
                self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    def __exit__(self, *_: object) -> None:
        self.close()

    async def _run(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        pages = [asyncio.create_task(client.run()) for client in self.clients]
        stopping = asyncio.create_task(self._stop.wait())
        while not stopping.done():
            timeout_s = None if self._changed.is_set() else 0.02
            done, _ = await asyncio.wait([stopping, *pages], timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
            ended = next((page for page in pages if page in done), None)
            if ended is not None:
                self.problem = ended.exception()
                break
            if all(client.states for client in self.clients):
                self._changed.set()
        for task in (*pages, stopping):
            task.cancel()
        await asyncio.gather(*pages, stopping, return_exceptions=True)
        self._changed.set()

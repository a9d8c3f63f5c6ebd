"""Pass data other than frames from the client's threads to the event loop, and to pages at a steady rate.

This data includes the newest drawing from each source, the latest events, applications' logs, and the applied commands.
Everything runs on the event loop, except for the callbacks registered with the drone.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import msgspec

from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.messages import Annotation, Applied, Event, LogEntry, Points, Polyline, Text
from skyloop.messages.relayed import MOCAP

if TYPE_CHECKING:
    from skyloop.client import Drone, Listener

ROW_HZ: Final = 2.0  #: rate of a drone's feedback while pages show it only as a row of the overview
Wake = Callable[[], None]
KEPT_EVENTS = 256  #: maximum number of events kept per drone
KEPT_S = 10.0  #: older drawings and logs are removed from the display
MAX_SERIES = 256  #: maximum number of logged series shown per drone
MAX_SOURCES = 64  #: maximum number of sources of drawings shown per drone, across all of its cameras
MAX_WAYPOINTS = 256  #: maximum number of waypoints shown per path
WAYPOINTS = "waypoints"  #: name under which a controller logs its goals
MOCAP_S = 0.5  #: older poses from motion capture are not shown

_KEPT_NS = round(KEPT_S * 1e9)

_encode = msgspec.json.Encoder().encode


K = TypeVar("K")
V = TypeVar("V")


def call_soon(loop: asyncio.AbstractEventLoop, function: Callable[..., None], *arguments: Any) -> None:
    """Call a function on the loop, from any thread. Do nothing once the loop is closed: no pages are left then."""
    if not loop.is_closed():
        loop.call_soon_threadsafe(function, *arguments)


def start_task(work: Coroutine[Any, Any, None], running: set[asyncio.Task[None]]) -> None:
    """Run a coroutine as a task, which stays in the set until it has ended, because the loop does not keep it alive."""
    task = asyncio.create_task(work)
    running.add(task)
    task.add_done_callback(running.discard)


class PeriodicBroadcast:
    """Creates a message at a steady rate, once for all subscribers, while there are any. Used on the event loop."""

    def __init__(self, period_s: float, make: Callable[[], bytes], on_change: Callable[[bool], None]) -> None:
        """Initialise the broadcast without starting it; the first subscriber starts it.

        ``on_change``: called with True before the first subscriber is added, and with False after the last has left.
        """
        self.message = b""  #: the newest message
        self.closed = False  #: whether no more messages will be created
        self._period_s = period_s
        self._make = make
        self._on_change = on_change
        self._wakes: set[Wake] = set()
        self._task: asyncio.Task[None] | None = None

    @property
    def wanted(self) -> bool:
        return bool(self._wakes)

    def subscribe(self, wake: Wake) -> None:
        """Call ``wake`` now and for each new message; if the broadcast is closed, only now."""
        if self.closed:
            wake()
            return
        if not self._wakes:
            self._on_change(True)
            self.message = self._make()
            self._task = asyncio.create_task(self._run())
        self._wakes.add(wake)
        wake()

    def unsubscribe(self, wake: Wake) -> None:
        """Stop calling ``wake``; if it is not subscribed, do nothing."""
        if wake in self._wakes:
            self._wakes.discard(wake)
            if not self._wakes:
                self._stop()
                self._on_change(False)

    def close(self) -> None:
        """End the broadcast permanently and wake all subscribers."""
        self.closed = True
        self._stop()
        for wake in list(self._wakes):
            wake()

    def _stop(self) -> None:
        if self._task is not None:
            self._task.cancel()
            self._task = None

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            due = max(due + self._period_s, loop.time())  # skip missed periods
            await asyncio.sleep(due - loop.time())
            self.message = self._make()
            for wake in list(self._wakes):
                wake()


class Newest(Generic[K, V]):
    """The newest value for each of up to ``most`` keys; values are forgotten after :data:`KEPT_S`.

    A key keeps its place as long as its value is updated, however many other keys compete for a place. One thread calls
    :meth:`put`; other threads read.
    """

    def __init__(self, most: int, clock: Clock) -> None:
        self.refused = 0  #: number of values refused because there was no room
        self._most = most
        self._clock = clock
        self._values: dict[K, tuple[int, V]] = {}  # each with its arrival time; the most recently updated comes last

    def put(self, key: K, value: V) -> None:
        """Set a key's value. If there is no room for a new key, refuse the key and count the refusal."""
        now_ns = self._clock()
        if self._values.pop(key, None) is None and len(self._values) >= self._most:
            oldest = next(iter(self._values))
            if now_ns - self._values[oldest][0] < _KEPT_NS:
                self.refused += 1
                return
            del self._values[oldest]
        self._values[key] = now_ns, value

    def items(self) -> list[tuple[K, V]]:
        """Return the keys and values set within :data:`KEPT_S`."""
        oldest_ns = self._clock() - _KEPT_NS
        return [(key, value) for key, (at_ns, value) in list(self._values.items()) if at_ns > oldest_ns]

    def clear(self) -> None:
        self._values = {}


@dataclass
class Drawing:
    """A drawing for pages, encoded once for all of them."""

    annotation: Annotation

    @cached_property
    def text(self) -> str:
        """The JSON message sent to pages."""
        return _encode(drawing_values(self.annotation)).decode()


def drawing_values(annotation: Annotation) -> dict[str, Any]:
    return {
        "type": "drawing",
        "source": annotation.source,
        "captured_ns": str(annotation.captured_ns),  # too large for a JavaScript number
        "width": annotation.width,
        "height": annotation.height,
        "shapes": [_shape(shape) for shape in annotation.shapes],
    }


def _shape(shape: Polyline | Points | Text) -> dict[str, Any]:
    if isinstance(shape, Text):
        return {"kind": "text", "text": shape.text, "at": shape.at, "colour": shape.colour}
    if isinstance(shape, Points):
        return {"kind": "points", "points": shape.points, "colour": shape.colour}
    return {"kind": "line", "points": shape.points, "closed": shape.closed, "colour": shape.colour}


class EventFeed:
    """The annotations and events of the drone. Events are numbered here, because those of the client have no number."""

    def __init__(self, drone: Drone, clock: Clock = monotonic_ns) -> None:
        self.drawings: Newest[tuple[str, str], Drawing] = Newest(MAX_SOURCES, clock)  #: keyed by camera and source
        self.events: deque[tuple[int, Event]] = deque(enumerate(drone.recent_events(), 1), maxlen=KEPT_EVENTS)
        self._next = len(self.events) + 1
        self._wakes: set[Wake] = set()
        self._loop = loop = asyncio.get_running_loop()
        self._waking = False  # whether a wake-up of the pages has been scheduled
        self._listeners: list[Listener[Any]] = [
            drone.on_annotation(self._draw),
            drone.on_event(lambda event: call_soon(loop, self._on_event, event)),
        ]

    def subscribe(self, wake: Wake) -> None:
        """Call ``wake`` on the loop when there is a newer drawing."""
        self._wakes.add(wake)

    def unsubscribe(self, wake: Wake) -> None:
        self._wakes.discard(wake)

    def events_after(self, number: int) -> list[tuple[int, Event]]:
        """Return the events with numbers above ``number``, together with their numbers, oldest first."""
        return [(n, event) for n, event in self.events if n > number]

    def close(self) -> None:
        for listener in self._listeners:
            listener.cancel()

    def _draw(self, annotation: Annotation) -> None:
        """Store a drawing. Runs on the client's thread; several drawings schedule only one call on the loop."""
        self.drawings.put((annotation.camera, annotation.source), Drawing(annotation))
        if not self._waking:
            self._waking = True
            call_soon(self._loop, self._wake_pages)

    def _wake_pages(self) -> None:
        self._waking = False
        for wake in self._wakes:
            wake()

    def _on_event(self, event: Event) -> None:
        self.events.append((self._next, event))
        self._next += 1


class LogFeed:
    """The logs of applications, and the last command applied.

    Subscribed to only on demand, to spare the proxy work. The client's receiving thread replaces the values as a whole.
    """

    def __init__(self, drone: Drone, clock: Clock = monotonic_ns) -> None:
        self.applied: Applied | None = None
        self._drone = drone
        self._clock = clock
        self._numbers: Newest[str, float] = Newest(MAX_SERIES, clock)
        self._waypoints: tuple[int, tuple[tuple[float, ...], ...]] | None = None
        self._mocap: tuple[int, tuple[float, ...]] | None = None
        self._listeners: list[Listener[Any]] = []

    def want(self, wanted: bool) -> None:
        """Subscribe, or unsubscribe and forget the values."""
        if wanted and not self._listeners:
            self._listeners = [
                self._drone.on_command(self._command, inline=True),
                self._drone.on_log(self._log, inline=True),
            ]
        elif not wanted:
            for listener in self._listeners:
                listener.cancel()
            self._listeners = []
            self._numbers.clear()
            self._waypoints, self._mocap, self.applied = None, None, None

    def numbers(self) -> dict[str, float]:
        """Return the newest value in each series logged within :data:`KEPT_S`."""
        return dict(self._numbers.items())

    @property
    def refused(self) -> int:
        """Number of logged values refused because there was no room."""
        return self._numbers.refused

    def waypoints(self) -> tuple[tuple[float, ...], ...]:
        """Return recently logged waypoints, or nothing: rows of x, y, z [m] and possibly yaw [rad], in world axes."""
        newest = self._waypoints
        return newest[1] if newest is not None and seconds(self._clock() - newest[0]) <= KEPT_S else ()

    def mocap(self) -> tuple[float, ...] | None:
        """Return a recent motion-capture pose, or None: x, y, z [m] and the quaternion x, y, z, w."""
        newest = self._mocap
        return newest[1] if newest is not None and seconds(self._clock() - newest[0]) <= MOCAP_S else None

    def _command(self, applied: Applied) -> None:
        self.applied = applied

    def _log(self, entry: LogEntry) -> None:
        if entry.number is not None:
            self._numbers.put(entry.name, entry.number)
        elif entry.values is not None and entry.name == MOCAP and len(entry.values) >= 7:
            self._mocap = self._clock(), entry.values
        elif (
            entry.values is not None and entry.name == WAYPOINTS and len(entry.shape) == 2 and entry.shape[1] in (3, 4)
        ):
            rows, columns = entry.shape
            values = entry.values
            places = tuple(values[row * columns : (row + 1) * columns] for row in range(min(rows, MAX_WAYPOINTS)))
            self._waypoints = self._clock(), places

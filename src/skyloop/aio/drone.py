"""One drone for ``asyncio``."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Unpack

from skyloop import client
from skyloop.aio.bridge import Callback, LoopNotifier, Opening, in_thread, on_loop, reject_in_step
from skyloop.client.authority import TakeoverAnswer, TakeoverWay
from skyloop.client.channels import VideoOptions
from skyloop.client.commands import by_name
from skyloop.client.connect import ConnectOptions
from skyloop.client.drone import LOOK_S
from skyloop.client.frame import Arrival
from skyloop.client.logbook import Logbook
from skyloop.client.mailbox import Mailbox
from skyloop.client.results import ResultMailbox, checked_age, silence
from skyloop.client.telemetry import Wanted
from skyloop.errors import NoAnswerError, UsageError
from skyloop.messages import (
    Annotation,
    AnyAction,
    Applied,
    Capabilities,
    EncodedFrame,
    Encoding,
    Event,
    EventKind,
    Feedback,
    LogEntry,
    Overview,
    Parameter,
    Severity,
    Value,
    Vector,
)
from skyloop.messages.annotation import Shape


class connect(Opening["Drone"]):  # noqa: N801  (used like the function skyloop.connect)
    """Connect to a drone: ``async with connect(target, …) as drone``, or ``drone = await connect(…)``.

    Raises what :func:`skyloop.connect` raises, and :class:`UsageError` for a stepped replay (``speed=max``), whose time
    advances only while its application waits in calls of :class:`skyloop.Drone`.
    """

    def __init__(self, target: str, **options: Unpack[ConnectOptions]) -> None:
        """Keep the arguments; awaiting or entering connects.

        Args:
            target: As for :func:`skyloop.connect`.
            **options: As for :func:`skyloop.connect`.
        """
        self._target = target
        self._options = options

    async def _connect(self) -> Drone:
        reject_in_step(self._target)
        sync = await in_thread(lambda: client.connect(self._target, **self._options), abandoned=lambda d: d.close())
        return Drone(sync)


class Config:
    """Parameters; see :class:`skyloop.client.Config` for what each method raises."""

    def __init__(self, sync: client.Config) -> None:
        self._sync = sync

    async def get(self, name: str) -> Value:
        """Return the present value."""
        return await in_thread(lambda: self._sync[name])

    async def set(self, name: str, value: object) -> None:
        """Write one value."""
        await in_thread(lambda: self._sync.__setitem__(name, value))

    async def items(self) -> list[tuple[str, Value]]:
        """Return (name, value) of all parameters, sorted by name."""
        return await in_thread(self._sync.items)

    async def describe(self, name: str) -> Parameter:
        """Return all that is known of a parameter: type, unit, range, default, value, description."""
        return await in_thread(lambda: self._sync.describe(name))


class Drone:
    """A connected vehicle, made by :class:`connect`.

    Methods have the names, arguments, results and errors of :class:`skyloop.Drone`; those that wait are
    coroutines. Callbacks, plain or coroutine functions, run on the event loop that was running when they were added.
    """

    def __init__(self, sync: client.Drone) -> None:
        """Wrap a connected drone."""
        self.sync = sync  #: the wrapped drone
        self.config = Config(sync.config)

    async def __aenter__(self) -> Drone:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await in_thread(lambda: self.sync.__exit__(kind, error, traceback))

    async def close(self) -> None:
        """Release the authority and end the connection. Does not land."""
        await in_thread(self.sync.close)

    # Properties; nothing here waits ----------------------------------------------------------------------------

    @property
    def name(self) -> str:
        """Name of the proxy."""
        return self.sync.name

    @property
    def uri(self) -> str:
        """Address of the vehicle."""
        return self.sync.uri

    @property
    def app_id(self) -> int:
        """Number of this application in this run of the proxy."""
        return self.sync.app_id

    @property
    def capabilities(self) -> Capabilities:
        """Actions and cameras of the vehicle."""
        return self.sync.capabilities

    @property
    def authority(self) -> client.AuthorityStatus:
        """Current state of this application's authority."""
        return self.sync.authority

    @property
    def link(self) -> client.LinkStatus:
        """State of both hops, application to proxy and proxy to vehicle."""
        return self.sync.link

    @property
    def closed(self) -> bool:
        """Whether it was closed."""
        return self.sync.closed

    @property
    def now_ns(self) -> int:
        """Present time on the proxy's clock [ns]."""
        return self.sync.now_ns

    @property
    def clock_offset_ns(self) -> int:
        """The proxy's clock less this process's [ns]; see :attr:`skyloop.Drone.clock_offset_ns`."""
        return self.sync.clock_offset_ns

    @property
    def clock_uncertainty_ns(self) -> int:
        """Largest error of ``clock_offset_ns`` [ns]; see :attr:`skyloop.Drone.clock_uncertainty_ns`."""
        return self.sync.clock_uncertainty_ns

    @property
    def start_position(self) -> Vector | None:
        """Where the vehicle took off last, in world axes [m]; see :attr:`skyloop.Drone.start_position`."""
        return self.sync.start_position

    def age_s(self, sample: Feedback | client.Frame) -> float:
        """Return the time since the sample's capture [s], within ``clock_uncertainty_ns``."""
        return self.sync.age_s(sample)

    async def stats(self) -> client.Stats:
        """Return statistics by channel; see :attr:`skyloop.Drone.stats`."""
        return await in_thread(lambda: self.sync.stats)

    def recent_events(self) -> list[Event]:
        """Return the last 256 events, oldest first."""
        return self.sync.recent_events()

    # Commands --------------------------------------------------------------------------------------------------

    async def preflight(
        self, *, video_s: float = 1.5, folder: str | Path | None = None
    ) -> list[client.PreflightFinding]:
        """Return the checklist before a flight; see :meth:`skyloop.Drone.preflight`."""
        return await in_thread(lambda: self.sync.preflight(video_s=video_s, folder=folder))

    async def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> None:
        """Take off, then hover; see :meth:`skyloop.Drone.takeoff`."""
        await in_thread(lambda: self.sync.takeoff(wait=wait, timeout_s=timeout_s))

    async def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> None:
        """Land at the present position; see :meth:`skyloop.Drone.land`."""
        await in_thread(lambda: self.sync.land(wait=wait, timeout_s=timeout_s))

    def hover(self) -> bool:
        """Stop and hold the position."""
        return self.sync.hover()

    def idle(self) -> bool:
        """Ask for nothing: keep the authority and leave the vehicle as it is."""
        return self.sync.idle()

    @by_name
    def velocity(self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Fly with a velocity in the levelled body axes.

        Args:
            forward: Along x, forward [m/s].
            left: Along y, to the left [m/s].
            up: Along z, up [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].
        """
        return self.sync.velocity(forward=forward, left=left, up=up, yaw_rate=yaw_rate)

    @by_name
    async def go_to(
        self,
        *,
        x: float | None = None,
        y: float | None = None,
        z: float | None = None,
        latitude_deg: float | None = None,
        longitude_deg: float | None = None,
        altitude_m: float | None = None,
        yaw: float | None = None,
        speed: float | None = None,
        wait: bool = True,
        timeout_s: float = 60.0,
        tolerance_m: float = 0.2,
        tolerance_rad: float = 0.15,
    ) -> None:
        """Fly straight to a place, and stay there; see :meth:`skyloop.Drone.go_to`."""
        await in_thread(
            lambda: self.sync.go_to(
                x=x,
                y=y,
                z=z,
                latitude_deg=latitude_deg,
                longitude_deg=longitude_deg,
                altitude_m=altitude_m,
                yaw=yaw,
                speed=speed,
                wait=wait,
                timeout_s=timeout_s,
                tolerance_m=tolerance_m,
                tolerance_rad=tolerance_rad,
            )
        )

    async def return_to_start(
        self,
        height_m: float | None = None,
        *,
        land: bool | None = None,
        wait: bool = True,
        timeout_s: float = 180.0,
    ) -> None:
        """Fly back to where it took off, and land there or hover; see :meth:`skyloop.Drone.return_to_start`."""
        await in_thread(lambda: self.sync.return_to_start(height_m, land=land, wait=wait, timeout_s=timeout_s))

    @by_name
    def attitude(self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Hold an attitude with a climb rate.

        Args:
            roll: Right side down is positive [rad].
            pitch: Nose down is positive [rad].
            climb: Vertical velocity, up [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].
        """
        return self.sync.attitude(roll=roll, pitch=pitch, climb=climb, yaw_rate=yaw_rate)

    def emergency_stop(self) -> bool:
        """Cut the motors at once: the vehicle falls. Needs no authority, only ``access="pilot"``."""
        return self.sync.emergency_stop()

    def reset_emergency(self) -> bool:
        """Leave the emergency state, on the ground."""
        return self.sync.reset_emergency()

    def command(self, action: AnyAction) -> bool:
        """Make ``action`` the newest set-point."""
        return self.sync.command(action)

    def send_external_pose(
        self,
        position: Vector,
        quaternion: tuple[float, float, float, float],
        *,
        at_ns: int | None = None,
        position_std_m: float | None = None,
        attitude_std_rad: float | None = None,
    ) -> bool:
        """Send the vehicle its own pose, measured from outside; see :meth:`skyloop.Drone.send_external_pose`."""
        return self.sync.send_external_pose(
            position, quaternion, at_ns=at_ns, position_std_m=position_std_m, attitude_std_rad=attitude_std_rad
        )

    def emit(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: str) -> None:
        """Emit an event of this application's own; see :meth:`skyloop.Drone.emit`."""
        self.sync.emit(kind, text, severity, **data)

    async def request_authority(
        self,
        priority: int | None = None,
        *,
        wait_s: float = 0.0,
        for_s: float | None = None,
        takeover: TakeoverWay = "now",
        stay: bool = False,
    ) -> client.AuthorityStatus:
        """Ask for the authority and wait for it; see :meth:`skyloop.Drone.request_authority`."""
        return await in_thread(
            lambda: self.sync.request_authority(priority, wait_s=wait_s, for_s=for_s, takeover=takeover, stay=stay)
        )

    def on_takeover(
        self, function: Callable[[client.TakeoverRequest], TakeoverAnswer | Awaitable[TakeoverAnswer]]
    ) -> Listener:
        """Call ``function`` when another application asks for the authority that this one holds.

        See :meth:`skyloop.Drone.on_takeover`; here it runs on the event loop and may be a coroutine function.
        """
        return Listener(self.sync.on_takeover(on_loop(function)))

    async def release_authority(self) -> None:
        """Release the authority, or leave the queue."""
        await in_thread(self.sync.release_authority)

    # Reading ---------------------------------------------------------------------------------------------------

    def feedback(self, *, max_age_s: float | None = None, max_hz: float | None = None) -> Feedback:
        """Return the newest feedback; see :meth:`skyloop.Drone.feedback`."""
        return self.sync.feedback(max_age_s=max_age_s, max_hz=max_hz)

    async def next_feedback(self, timeout_s: float = 1.0, *, max_hz: float | None = None) -> Feedback:
        """Wait for feedback that was not read before; see :meth:`skyloop.Drone.next_feedback`."""
        return await in_thread(lambda: self.sync.next_feedback(timeout_s, max_hz=max_hz))

    def frame(self, camera: str | None = None, *, max_age_s: float | None = None) -> client.Frame | None:
        """Return the newest frame without waiting; see :meth:`skyloop.Drone.frame`.

        A JPEG is decoded on the event loop; :meth:`next_frame` and :meth:`frames` decode on another thread.
        """
        return self.sync.frame(camera, max_age_s=max_age_s)

    async def next_frame(self, camera: str | None = None, *, timeout_s: float = 1.0) -> client.Frame:
        """Wait for a frame that this method has not returned before, and return the newest."""
        return await in_thread(lambda: self.sync.next_frame(camera, timeout_s=timeout_s))

    async def wait(self, state: Wanted, timeout_s: float = 10.0) -> Feedback:
        """Wait until the newest feedback is as wanted; see :meth:`skyloop.Drone.wait`.

        A predicate is called on another thread.
        """
        return await in_thread(lambda: self.sync.wait(state, timeout_s))

    async def frames(
        self, camera: str | None = None, *, timeout_s: float = 5.0, **how: Unpack[VideoOptions]
    ) -> AsyncIterator[client.Frame]:
        """Yield each newest frame until the drone is closed; a slow loop skips frames.

        Args:
            camera: Name of the camera; None: the vehicle's first.
            timeout_s: How long to wait for each frame [s].
            **how: As for :meth:`skyloop.Drone.frames`.

        Raises:
            NoAnswerError: If no frame comes within ``timeout_s``.
        """
        core, notifier = self.sync._core, LoopNotifier()
        came, loop = notifier.came, notifier.loop
        max_age_s, deadline = how.get("max_age_s"), loop.time() + timeout_s
        now = core.channel(camera, **how)
        while not self.sync.closed:
            channel, mailbox = now, Mailbox[Arrival](notifier=notifier)
            with core.closing(mailbox), channel.into(mailbox):
                while not self.sync.closed and now is channel:
                    try:
                        await asyncio.wait_for(came.wait(), min(LOOK_S, deadline - loop.time()))
                    except TimeoutError:
                        if loop.time() >= deadline:
                            raise core.no_frame(channel.camera.name, timeout_s) from None
                        now = core.channel(camera, **how)  # another, once the proxy was started with other cameras
                        continue
                    came.clear()
                    arrival = mailbox.take()
                    if arrival is None:
                        continue
                    if arrival.header.encoding is Encoding.JPEG:
                        frame = await in_thread(lambda c=channel, a=arrival: c.picture(a, max_age_s))  # type: ignore[misc]
                    else:
                        frame = channel.picture(arrival, max_age_s)
                    if frame is not None:
                        yield frame
                        deadline = loop.time() + timeout_s

    def result(self, processor: str, *, max_age_s: float | None = None) -> client.Result | None:
        """Return a processor's newest result without waiting; see :meth:`skyloop.Drone.result`."""
        return self.sync.result(processor, max_age_s=max_age_s)

    async def results(
        self, processor: str, *, max_age_s: float | None = None, timeout_s: float = 5.0
    ) -> AsyncIterator[client.Result]:
        """Yield each newest result of a processor until the drone is closed; a slow loop skips results.

        Args:
            processor: Name of the processor.
            max_age_s: Oldest age since the frame's capture that is accepted [s]; None: any.
            timeout_s: How long to wait for each result [s].

        Raises:
            NoAnswerError: If no result that is new enough comes in time.
        """
        notifier = LoopNotifier()
        came, loop = notifier.came, notifier.loop
        mailbox = ResultMailbox(checked_age(max_age_s), notifier)
        with self.sync._core.closing(mailbox), self.sync._core.result_channel(processor).into(mailbox):
            deadline = loop.time() + timeout_s
            while not self.sync.closed:
                try:
                    await asyncio.wait_for(came.wait(), deadline - loop.time())
                except TimeoutError:
                    raise NoAnswerError(silence(processor, timeout_s, mailbox.expired)) from None
                came.clear()
                result = mailbox.take()
                if result is not None:
                    yield result
                    deadline = loop.time() + timeout_s

    # Callbacks -------------------------------------------------------------------------------------------------

    async def overview(self, timeout_s: float = 2.0) -> Overview:
        """Return the newest overview of the vehicles of the proxy's process; see :meth:`skyloop.Drone.overview`."""
        return await in_thread(lambda: self.sync.overview(timeout_s))

    def on_overview(self, function: Callback[Overview]) -> Listener:
        """Call ``function`` with each overview, on the event loop; see :meth:`skyloop.Drone.on_overview`."""
        return Listener(self.sync.on_overview(on_loop(function)))

    def on_feedback(self, function: Callback[Feedback], *, max_hz: float | None = None) -> Listener:
        """Call ``function`` with the newest feedback, on the event loop; see :meth:`skyloop.Drone.on_feedback`."""
        return Listener(self.sync.on_feedback(on_loop(function), max_hz=max_hz))

    def on_event(self, function: Callback[Event]) -> Listener:
        """Call ``function`` with each event, on the event loop."""
        return Listener(self.sync.on_event(on_loop(function)))

    def on_link(self, function: Callback[client.LinkStatus]) -> Listener:
        """Call ``function`` on the event loop whenever one of the two hops changes its state."""
        return Listener(self.sync.on_link(on_loop(function)))

    def on_command(self, function: Callback[Applied]) -> Listener:
        """Call ``function`` with what the proxy made of each command of any application, on the event loop."""
        return Listener(self.sync.on_command(on_loop(function)))

    def on_annotation(self, function: Callback[Annotation]) -> Listener:
        """Call ``function`` with what any application draws on a frame, on the event loop."""
        return Listener(self.sync.on_annotation(on_loop(function)))

    def on_log(self, function: Callback[LogEntry]) -> Listener:
        """Call ``function`` with what any application logs, on the event loop."""
        return Listener(self.sync.on_log(on_loop(function)))

    def on_result(
        self, function: Callback[client.Result], processor: str | None = None, *, max_age_s: float | None = None
    ) -> Listener:
        """Call ``function`` with results, on the event loop; see :meth:`skyloop.Drone.on_result`."""
        return Listener(self.sync.on_result(on_loop(function), processor, max_age_s=max_age_s))

    def on_frame(
        self,
        function: Callable[[client.Frame], object],
        camera: str | None = None,
        *,
        depth: int = 1,
        inline: bool = False,
        **how: Unpack[VideoOptions],
    ) -> client.Listener[Arrival]:
        """Call ``function`` with the newest frame, on a thread of its own: work on images would block the event loop.

        Args:
            function: A plain function.
            camera: Name of the camera; None: the vehicle's first.
            depth: As for :meth:`skyloop.Drone.on_frame`.
            inline: As for :meth:`skyloop.Drone.on_frame`.
            **how: As for :meth:`skyloop.Drone.frames`.

        Raises:
            UsageError: If it is a coroutine function.
        """
        if inspect.iscoroutinefunction(function):
            raise UsageError(
                "on_frame takes a plain function, which runs on a thread of its own; else iterate over frames()"
            )
        return self.sync.on_frame(function, camera, depth=depth, inline=inline, **how)

    def on_encoded(
        self,
        function: Callable[[EncodedFrame], object],
        camera: str | None = None,
        *,
        kbit_s: int | None = None,
        max_fps: float | None = None,
        scale: float = 1.0,
        depth: int = 30,
        inline: bool = False,
    ) -> client.Listener[EncodedFrame]:
        """Call ``function`` with pictures as they are encoded, on a thread of its own.

        Args:
            function: A plain function.
            camera: Name of the camera; None: the vehicle's first.
            kbit_s: As for :meth:`skyloop.Drone.on_encoded`.
            max_fps: As for :meth:`skyloop.Drone.on_encoded`.
            scale: As for :meth:`skyloop.Drone.on_encoded`.
            depth: As for :meth:`skyloop.Drone.on_encoded`.
            inline: As for :meth:`skyloop.Drone.on_encoded`.

        Raises:
            UsageError: If it is a coroutine function.
        """
        if inspect.iscoroutinefunction(function):
            raise UsageError("on_encoded takes a plain function, which runs on a thread of its own")
        return self.sync.on_encoded(
            function, camera, kbit_s=kbit_s, max_fps=max_fps, scale=scale, depth=depth, inline=inline
        )

    def annotate(self, frame: client.Frame, shapes: Iterable[Shape], source: str | None = None) -> bool:
        """Publish shapes drawn over a frame; see :meth:`skyloop.Drone.annotate`."""
        return self.sync.annotate(frame, shapes, source)

    @property
    def log(self) -> Logbook:
        """Publishes text and numbers beside the flight; see :class:`skyloop.client.Logbook`."""
        return self.sync.log


class Listener:
    """A callback that runs on the event loop, one call at a time."""

    def __init__(self, sync: client.Listener[Any]) -> None:
        """Wrap a listener whose function hands over to the event loop."""
        self._sync = sync

    def cancel(self) -> None:
        """Stop calling the function. Does not wait for a call that is under way."""
        self._sync.cancel(wait=False)  # its thread may be waiting for this very event loop

    @property
    def delivered(self) -> int:
        """How often the function was called."""
        return self._sync.delivered

    @property
    def dropped(self) -> int:
        """Samples that newer ones pushed out before the function was ready for them."""
        return self._sync.dropped

    @property
    def errors(self) -> int:
        """Calls that raised."""
        return self._sync.errors

"""One drone in the cockpit: the state that its pages share, and the connection that each page uses to fly it."""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, Protocol, Self

from skyloop.client import AuthorityStatus, Drone
from skyloop.client.actions import OUTDONE, OVERRULED
from skyloop.clock import monotonic_ns, nanoseconds, seconds
from skyloop.cockpit.alarms import ThresholdReader
from skyloop.cockpit.discovery import FoundProxy
from skyloop.cockpit.encoded_feed import CameraFeed, EncodedFeed, FeedFormat, SmallFeed
from skyloop.cockpit.feeds import ROW_HZ, EventFeed, LogFeed, PeriodicBroadcast
from skyloop.cockpit.routes import CheckedRoutes
from skyloop.cockpit.telemetry import TelemetryView
from skyloop.control.waypoint import Waypoint
from skyloop.errors import LinkError, NoAnswerError, RefusedError, SkyloopError
from skyloop.extend import Known, commands, let_go, open_unasked
from skyloop.messages import AnyAction, CameraInfo, EventKind, FlightState, Idle, LinkState, Outcome
from skyloop.transport.base import Dialer

if TYPE_CHECKING:
    from skyloop.client import Listener
    from skyloop.messages import Feedback

TELEMETRY_HZ: Final = 18.0  #: rate of the states sent to pages
FRESH_S: Final = 0.2  #: time to wait for fresh feedback
PILOT_S: Final = 2.0  #: time limit for opening a pilot's connection
RECORDINGS: Final = ("replay:", "video:")  #: address prefixes of recorded drones
SHOWN_S: Final = 8.0  #: time for which a stop is repeated until the vehicle reports that its motors have stopped
STOPPER: Final = "cockpit stop"  #: name of the application that sends emergency stops and nothing else
RETRY_S: Final = 0.05  #: pause between attempts to send an emergency stop
_log = logging.getLogger(__name__)


class PilotConnection(Drone):
    """A pilot's connection that requests authority in :meth:`acquire` rather than when it is opened.

    Without authority, it can only stop the motors in an emergency.
    """

    _newest: tuple[AnyAction, int] = Idle(), 0  # the last :meth:`command` and its sequence number

    @classmethod
    def open(cls, dial: Dialer, app: str, timeout_s: float) -> Self:
        """Connect without requesting authority. ``dial``: opens a new connection to the proxy on each call."""
        return open_unasked(cls, dial, app=app, timeout_s=timeout_s, on_exit="hover")

    def set_flown_by_person(self) -> None:
        """Repeat commands only while the page is known to be present, because a person is flying with it."""
        commands(self).flown_by_person()

    def present_until(self, until_ns: int) -> None:
        """Consider the page present until this time (on the process's monotonic clock), and silent afterwards."""
        commands(self).present_until(until_ns)

    @property
    def is_silent(self) -> bool:
        """Whether the page has been absent for too long."""
        return not commands(self).is_present(monotonic_ns())

    @property
    def is_linked(self) -> bool:
        """Whether there is currently a connection to the proxy."""
        return self.link.application in (LinkState.UP, LinkState.DEGRADED)

    def acquire(self, priority: int, *, ask: bool = False) -> AuthorityStatus:
        """Request authority now.

        ``priority``: 0 (highest) to 31 (lowest). ``ask``: ask the current holder first, and wait in the queue instead
        of failing. Raise ``AuthorityError`` if another application holds the authority; the message names it.
        """
        return self.request_authority(priority, takeover="ask" if ask else "now", stay=ask)

    def answer_takeover(self, lease: int, app_id: int, grant: bool, reason: str) -> None:
        """Answer a request for authority, and wait for the proxy; raise ``RefusedError`` without authority."""
        commands(self).answer(lease, app_id, grant, reason, wait=True)

    @property
    def proxy_now_ns(self) -> int:
        """The estimated time on the proxy's clock."""
        return monotonic_ns() + self.clock_offset_ns

    def command(self, action: AnyAction) -> bool:
        """Make ``action`` the newest set-point; see :meth:`Drone.command`."""
        sent = super().command(action)
        self._newest = action, commands(self).intent
        return sent

    def has_ended(self, action: AnyAction) -> bool:
        """Whether a failsafe, a lost link or a lost lease has ended this action and it could now be sent again."""
        newest, intent = self._newest
        outcome = commands(self).outcome(intent) if newest is action else None
        return outcome is not None and outcome.fate in OVERRULED and commands(self).may_ask

    @property
    def intent(self) -> int:
        """The number of the newest command."""
        return commands(self).intent

    def refusal(self, first: int) -> Outcome | None:
        """The newest outcome, if it is a refusal of a command with at least this number; None otherwise.

        An action that its application replaced or withdrew was not refused, nor was one that :meth:`has_ended` covers.
        """
        found = commands(self).newest_outcome
        if found is None or found.reason is None or found.intent < first or found.fate in (*OUTDONE, *OVERRULED):
            return None
        return found

    @property
    def is_acknowledged(self) -> bool:
        """Whether the proxy reports the outcome of the newest command, which proves that the command arrived."""
        newest, (_, intent) = Known(self).newest, self._newest
        outcome = None if newest is None else newest.outcome
        return outcome is not None and outcome.app_id == self.app_id and outcome.intent >= intent

    def let_go(self, reason: str, *, land: bool = False) -> bool:
        """Hover or land on the cockpit's initiative rather than a person's; see :func:`skyloop.extend.let_go`."""
        return let_go(self, reason, land=land)

    @property
    def is_flying(self) -> bool:
        """Whether the vehicle's state is flying rather than hovering, according to the newest feedback."""
        try:
            return self.feedback().state is FlightState.FLYING
        except LinkError:
            return False


class FlyingSession(Protocol):
    """A page's control of the drone."""

    app: str  #: the name shown to other applications

    @property
    def waits(self) -> bool:
        """Whether the page is waiting for authority."""

    def stand_down(self, why: str) -> None:
        """Send no more commands."""

    def let_go(self, why: str) -> None:
        """Hover if this page is flying the vehicle."""


class Station:
    """One drone, and the state that its pages share. Created and closed on the event loop.

    ``drone``: the drone, connected as an observer; closed by :meth:`close`.
    """

    def __init__(self, found: FoundProxy, drone: Drone) -> None:
        self.found = found
        self.drone = drone
        self.event_feed = EventFeed(drone)
        self.log_feed = LogFeed(drone)
        self.cameras: dict[str, CameraFeed] = {}
        self.small: dict[tuple[str, int], SmallFeed] = {}  #: keyed by camera and width [pixels]
        self.streams: dict[tuple[str, FeedFormat], EncodedFeed] = {}  #: H.264 streams by camera and encoding
        self.goals: dict[str, Waypoint] = {}  #: goals to which pages are flying the drone, by application name
        self.routes = CheckedRoutes()
        self.sessions: set[FlyingSession] = set()  #: sessions of pages that may fly the drone
        self.pilots: set[PilotConnection] = set()  #: connections over which pages fly the drone
        self.thresholds = ThresholdReader(drone)
        self.view = TelemetryView(self)
        self.broadcast = PeriodicBroadcast(1.0 / TELEMETRY_HZ, self.view.state, self._on_shown)
        drone.on_feedback(_nothing, inline=True, max_hz=ROW_HZ)  # registered until the drone is closed
        self._whole: Listener[Any] | None = None  # consumes all feedback while any page shows the drone
        self._stopper: asyncio.Task[PilotConnection] | None = None
        self._may_stop = 0
        self._stops = 0  # number of emergency stops in progress
        self._names: list[str] = []  # unused subscriber names for streams to a single page
        self._named = 0

    @property
    def flies(self) -> bool:
        """Whether there is a vehicle to fly. A recording accepts every command, but the command has no effect."""
        return bool(self.drone.capabilities.actions) and not self.drone.uri.startswith(RECORDINGS)

    @property
    def in_use(self) -> bool:
        """Whether a page shows the drone."""
        return self.broadcast.wanted or any(feed.wanted for feed in self.feeds)

    @property
    def feeds(self) -> list[CameraFeed | SmallFeed | EncodedFeed]:
        """The feeds of all cameras, in all sizes and encodings."""
        return [*self.cameras.values(), *self.small.values(), *self.streams.values()]

    def camera_info(self, name: str) -> CameraInfo | None:
        """Return a camera's description, or None if the vehicle has no such camera."""
        return next((info for info in self.drone.capabilities.cameras if info.name == name), None)

    def camera(self, name: str) -> CameraFeed | None:
        """Return a camera's feed, or None if the vehicle has no such camera."""
        if name not in self.cameras and self.camera_info(name) is not None:
            self.cameras[name] = CameraFeed(self.drone, name)
        return self.cameras.get(name)

    def small_video(self, name: str, width: int) -> SmallFeed | None:
        """Return a camera's feed scaled down to a width [pixels], or None if the vehicle has no such camera."""
        camera = self.camera_info(name)
        if (name, width) not in self.small and camera is not None:
            self.small[name, width] = SmallFeed(self.drone, camera, width)
        return self.small.get((name, width))

    def encoded(self, name: str, form: FeedFormat) -> EncodedFeed:
        """Return the feed of a camera's H.264 in one encoding; call :meth:`forget` once no page shows the feed."""
        if (name, form) not in self.streams:
            self.streams[name, form] = EncodedFeed(self.drone, name, form)
        return self.streams[name, form]

    def forget(self, feed: EncodedFeed) -> None:
        """Discard a feed that no page shows anymore."""
        self.streams.pop((feed.camera, feed.form), None)

    def own_name(self) -> str:
        """Return a subscriber name for a stream to one page; :meth:`free_name` makes it available again."""
        if not self._names:
            self._named += 1
            self._names.append(f"{secrets.token_hex(6)}-{self._named}")
        return self._names.pop()

    def free_name(self, name: str) -> None:
        """Release a name obtained from :meth:`own_name`."""
        self._names.append(name)

    def feedback(self) -> Feedback:
        """Return the newest feedback. Feedback arrives at a low rate while pages show only the drone's row.

        Raise ``LinkError`` if there is no feedback or the drone has been closed.
        """
        return self.drone.feedback(max_hz=ROW_HZ)

    def fresh_feedback(self) -> Feedback:
        """Wait for a state that is captured from now on, because the newest feedback may predate a take-off.

        Raise ``LinkError`` if no feedback arrives within :data:`FRESH_S`.
        """
        now_ns = self.drone.now_ns
        return self.drone.wait(lambda feedback: feedback.captured_ns >= now_ns, FRESH_S)

    @property
    def feedback_period_s(self) -> float:
        """The requested interval between feedback samples [s]; 0 for all samples."""
        return 1.0 / ROW_HZ if self._whole is None else 0.0

    def _on_shown(self, shown: bool) -> None:
        """Subscribe to all feedback while a page shows the whole drone."""
        self.log_feed.want(shown)
        if shown and self._whole is None:
            self._whole = self.drone.on_feedback(_nothing, inline=True)
        elif not shown and self._whole is not None:
            self._whole.cancel()
            self._whole = None

    # Pilots ----------------------------------------------------------------------------------------------------

    async def open_pilot(self, app: str) -> PilotConnection:
        """Open a pilot's connection, without authority; raise ``SkyloopError`` after :data:`PILOT_S`."""

        def connect() -> PilotConnection:
            return PilotConnection.open(self.found.dial, app, PILOT_S)

        pilot = await asyncio.to_thread(connect)
        self.pilots.add(pilot)
        return pilot

    async def close_pilot(self, pilot: PilotConnection) -> None:
        """Close a pilot's connection, which releases the authority it holds."""
        await asyncio.to_thread(pilot.close)
        self.pilots.discard(pilot)

    def pilot_came(self) -> None:
        """Open the connection for emergency stops if necessary, because a page that may send a stop has connected."""
        self._may_stop += 1
        if self._stopper is None:
            self._stopper = asyncio.create_task(self.open_pilot(STOPPER))
            self._stopper.add_done_callback(_ignore_error)

    async def pilot_went(self) -> None:
        """Close the connection for emergency stops once there are no pages left that may use it."""
        self._may_stop -= 1
        if not self._may_stop and self._stopper is not None:
            stopper, self._stopper = self._stopper, None
            await self._end(stopper)

    async def stopper(self) -> PilotConnection:
        """Return the pilot's connection for emergency stops, which never holds authority."""
        if self._stopper is None or (self._stopper.done() and self._stopper.exception() is not None):
            self._stopper = asyncio.create_task(self.open_pilot(STOPPER))
        return await asyncio.shield(self._stopper)

    async def stop_motors(self, until_ns: int, sent: Callable[[], None]) -> None:
        """Stop the motors over a dedicated connection; until this is done, no page may fly the vehicle.

        Args:
            until_ns: Latest time to send the stop for the first time, on this process's monotonic clock.
            sent: Called once the stop has been sent.

        Raises:
            LinkError: The stop was not sent, and no longer will be.
            NoAnswerError: The vehicle does not report that its motors have stopped within :data:`SHOWN_S`.
            UnsupportedError: The vehicle has no emergency stop.
        """
        self._stops += 1
        try:
            for session in self.sessions:
                try:
                    session.stand_down("the motors were stopped")
                except Exception:  # noqa: BLE001  (a failure of one page must not prevent the stop)
                    _log.exception("%s could not stand down", session.app)
            stopper = await self._send_stop(until_ns)
            sent()
            await asyncio.to_thread(_wait_until_stopped, stopper, stopper.now_ns)
        except SkyloopError:
            for session in self.sessions:  # flights of these sessions must not be resumed
                session.let_go("the vehicle does not show the emergency stop")
            raise
        finally:
            self._stops -= 1

    def check_stop(self) -> None:
        """Raise :class:`RefusedError` while an emergency stop is under way."""
        if self._stops:
            raise RefusedError("an emergency stop is under way: other commands wait until the vehicle shows it")

    async def _send_stop(self, until_ns: int) -> PilotConnection:
        why = "the proxy does not answer"
        while (left_s := seconds(until_ns - monotonic_ns())) > 0:
            try:
                stopper = await asyncio.wait_for(self.stopper(), left_s)
                if monotonic_ns() > until_ns:
                    break
                if stopper.emergency_stop():
                    return stopper
                why = f"the link to the proxy is {stopper.link.application}"
                with suppress(SkyloopError):
                    stopper.idle()  # this loop retries; otherwise the stop would be sent whenever the link is restored
            except LinkError as error:
                why = str(error)
            except TimeoutError:
                break
            await asyncio.sleep(RETRY_S)
        raise LinkError(f"the emergency stop was not sent: {why}")

    async def close(self) -> None:
        """Close all connections to the drone."""
        self.broadcast.close()
        self.log_feed.want(False)
        self.event_feed.close()
        self.thresholds.close()
        for feed in self.feeds:
            feed.close()
        if self._stopper is not None:
            await self._end(self._stopper)
        for pilot in list(self.pilots):
            await self.close_pilot(pilot)
        await asyncio.to_thread(self.drone.close)

    async def _end(self, stopper: asyncio.Task[PilotConnection]) -> None:
        await asyncio.gather(stopper, return_exceptions=True)
        if not stopper.cancelled() and stopper.exception() is None:
            await self.close_pilot(stopper.result())


def _wait_until_stopped(stopper: PilotConnection, from_ns: int) -> None:
    def shows(feedback: Feedback) -> bool:
        return feedback.captured_ns >= from_ns and feedback.state is FlightState.EMERGENCY

    try:
        stopper.wait(shows, SHOWN_S)
    except NoAnswerError:
        why = f"the vehicle has not shown stopped motors for {SHOWN_S:g} s: stop them again, or land it"
        since_ns = from_ns - nanoseconds(PILOT_S)  # the command may have been refused before this wait began
        refused = (
            event.text
            for event in reversed(stopper.recent_events())
            if event.kind is EventKind.COMMAND_REFUSED and event.app == STOPPER and event.at_ns >= since_ns
        )
        raise NoAnswerError(f"{why} ({text})" if (text := next(refused, "")) else why) from None


def _nothing(_: Feedback) -> None:
    """Ignore feedback. A callback is needed for feedback to arrive at all; pages show the newest sample."""


def _ignore_error(task: asyncio.Task[PilotConnection]) -> None:
    """Ignore the error: the next emergency stop tries again and raises the error."""
    if not task.cancelled():
        task.exception()

"""A drone as an application sees it: what it is, and from connecting to closing."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import Literal, Self

from skyloop.client.commander import Commander
from skyloop.client.config import Config
from skyloop.client.delivery import Listener
from skyloop.client.flying import Flying
from skyloop.client.link import Link, RedialPolicy
from skyloop.client.logbook import Logbook
from skyloop.client.pace import Pace
from skyloop.client.pilot import Pilot
from skyloop.client.reception import LinkStatus, Reception
from skyloop.client.result_reading import ResultReading
from skyloop.client.statistics import ChannelStats, Distribution
from skyloop.client.takeover import TakeoverAnswer, TakeoverRequest, TakeoverWay, answering
from skyloop.errors import AuthorityError, LinkError, NoAnswerError, SkyloopError, UsageError
from skyloop.messages import (
    Event,
    GetStatistics,
    Hello,
    LinkState,
    Role,
    Statistics,
    Vector,
    VehiclePose,
    encode,
)
from skyloop.transport.base import EVENTS, FEEDBACK, Dialer

Access = Literal["pilot", "observe"]
OnExit = Literal["land", "hover"]
_log = logging.getLogger("skyloop")


class Drone(Flying, ResultReading):
    """One vehicle, connected; made by :func:`skyloop.connect`. A context manager; every method may be called from any
    thread.

    At the end of its block a drone that is in the air and held by this application is landed, and the authority
    given back. A lost proxy is looked for until it is back, and everything is put back then but old set-points.
    """

    def __init__(
        self,
        dial: Dialer,
        *,
        app: str,
        access: Access = "pilot",
        rate_hz: float = 32.0,
        stall_s: float = 1.0,
        on_exit: OnExit = "land",
        policy: RedialPolicy | None = None,
        pace: Pace | None = None,
        on_close: Callable[[], None] | None = None,
        reach: str | None = None,
    ) -> None:
        if access not in ("pilot", "observe"):
            raise UsageError(f'access is {access!r} and must be "pilot" or "observe"')
        if on_exit not in ("land", "hover"):
            raise UsageError(f'on_exit is {on_exit!r} and must be "land" or "hover"')
        if not 1 <= len(app) <= 64:
            raise UsageError(f"an application's name has 1 to 64 characters, not {len(app)}: {app!r:.80}")
        super().__init__()
        role = Role.PILOT if access == "pilot" else Role.OBSERVER
        self._app = app
        self._role = role
        self._on_exit = on_exit
        self._on_close = on_close
        #: What another process connects to for the same vehicle; None if only this process can reach it.
        self.reach = reach
        commander = Commander(rate_hz=rate_hz, stall_s=stall_s)
        pace = pace or Pace()
        reception = self._reception = Reception(app, pace)
        self._link = reception.link = Link(
            dial, Hello(app, role), reception, policy=policy, clock=pace.clock, begin=pace.begin
        )
        reception.results.link = self._link
        self.config = reception.config = Config(self._link, lambda: self._pilot.status.lease, reception.tell)
        self.log = Logbook(self._link, app, self._now_ns)
        self._pilot = reception.pilot = Pilot(
            app,
            role,
            commander,
            pace,
            tell=reception.tell,
            changed=lambda _: reception.bell.ring(),
            granted=self.config.granted,
        )
        self._pilot.link = self._link
        for topic in (EVENTS, FEEDBACK):
            self._link.subscribe(topic)

    def open(
        self,
        *,
        priority: int = 16,
        wait_s: float = 0.0,
        timeout_s: float = 5.0,
        for_s: float | None = None,
        takeover: TakeoverWay = "now",
        stay: bool = False,
    ) -> Self:
        """Connect, and wait for feedback and (as a pilot) for the authority. What :func:`skyloop.connect` calls."""
        try:
            deadline = time.monotonic() + timeout_s
            self._link.start(timeout_s)
            left_s = max(0.1, deadline - time.monotonic())
            if not self._reception.bell.wait_for(self._known, left_s):
                raise NoAnswerError(f"{self.name} answered, but told nothing of its vehicle within {timeout_s:g} s")
            if self._role is Role.PILOT:
                self.request_authority(priority, wait_s=wait_s, for_s=for_s, takeover=takeover, stay=stay)
            self._reception.pace.opened()
        except BaseException:
            self.close()
            raise
        return self

    # For vehicles that fly by what others see ------------------------------------------------------------------

    def tell_pose(
        self,
        position: Vector,
        quaternion: tuple[float, float, float, float],
        *,
        at_ns: int | None = None,
        position_std_m: float | None = None,
        attitude_std_rad: float | None = None,
    ) -> bool:
        """Tell the vehicle itself where it was seen from outside: for an autopilot that flies by that, without GPS.

        ``position``: x east, y north, z up [m]; ``quaternion``: x, y, z, w, from body axes (x forward, y left, z up) to
        the world's; ``at_ns``: when, on the proxy's clock (default: now); standard deviations if they are known. Any
        thread; nothing waits, and the authority is not needed. Returns whether it was handed over; a vehicle that
        takes none is told of by an event (``command_refused``).

        Raises :class:`AuthorityError` for an observer and :class:`UsageError` for what is no pose.
        """
        if self._role is not Role.PILOT:
            raise AuthorityError('tell_pose: this application observes; connect with access="pilot"', code="observer")
        numbers = (*position, *quaternion, position_std_m or 0.0, attitude_std_rad or 0.0)
        if len(position) != 3 or len(quaternion) != 4 or not all(map(math.isfinite, numbers)):
            raise UsageError(f"a pose has three and four finite numbers, not {position!r} and {quaternion!r}")
        known_ns = self._now_ns() if at_ns is None else at_ns
        pose = VehiclePose(known_ns, position, quaternion, position_std_m, attitude_std_rad)
        return self._link.transmit(encode(pose))

    # What it is ------------------------------------------------------------------------------------------------

    @property
    def name(self) -> str:
        """The proxy's name."""
        return "" if self._reception.welcome is None else self._reception.welcome.proxy

    @property
    def uri(self) -> str:
        """The vehicle's address."""
        return "" if self._reception.welcome is None else self._reception.welcome.uri

    @property
    def clock_offset_ns(self) -> int:
        """The proxy's clock less this process's [ns], as estimated."""
        return self._link.offset_ns

    @property
    def now_ns(self) -> int:
        """The time on the proxy's clock [ns], as estimated; in a replay in step, the flight's."""
        return self._link.now_ns

    @property
    def clock_uncertainty_ns(self) -> int:
        """How wrong :attr:`clock_offset_ns` may be [ns], and with it each age and delay; 0 on the proxy's own host."""
        return self._link.uncertainty_ns

    @property
    def app_id(self) -> int:
        """This application's number in this run of the proxy."""
        return self._pilot.app_id

    @property
    def link(self) -> LinkStatus:
        """State of both hops; the reason is of the last change, or why the last attempt to connect again failed."""
        status = self._reception.status
        return replace(status, reason=self._link.reason) if status.application is LinkState.LOST else status

    @property
    def closed(self) -> bool:
        """Whether :meth:`close` was called."""
        return self._closed

    @property
    def stats(self) -> dict[str, ChannelStats]:
        """Statistics by channel: ``command``, ``feedback``, ``video/<camera>``, ``results/<processor>``.

        The command delay is that of this application's echoes while somebody listens to them (:meth:`on_command`),
        else what the proxy measured over all pilots, for which it is asked.
        """
        found = self._reception.stats()
        uncertainty_s = self.clock_uncertainty_ns / 1e9
        found = {name: replace(stats, uncertainty_s=uncertainty_s) for name, stats in found.items()}
        if found["command"].delay_s is None and self._link.connected and not self._link.receiving:
            found["command"] = _with_delay(found["command"], self._proxy_statistics())
        return found

    def recent_events(self) -> list[Event]:
        """The last 256 events, oldest first."""
        return list(self._reception.recent)

    def on_takeover(self, function: Callable[[TakeoverRequest], TakeoverAnswer]) -> Listener[Event]:
        """Call when another application asks for the authority that this one holds, on a thread of its own.

        The function returns True to hand it over, False or a text (the reason) to decline, None to leave it to the
        proxy: after its ``authority.ask_s`` a strictly higher priority wins in any case.
        """
        return self.on_event(answering(function, self._pilot))

    # The end ---------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Give the authority back and end the connection, all threads and a private proxy. Does not land. Idempotent.

        Whoever waits for this drone gets :class:`ClosedError`.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if self._link.connected:
                self._pilot.release(wait=not self._link.receiving)
        except LinkError:
            pass  # gone already, and the authority with it
        finally:
            self._link.close()
            for listener in list(self._listeners):
                listener.cancel()
            for buffer in list(self._buffers):
                buffer.close()
            self._reception.wake_all()
            if self._on_close is not None:
                self._on_close()

    def __enter__(self) -> Self:
        self._check_open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        problem = self.leave()
        if problem is not None:
            _log.warning("%s could not be left as it should: %s", self.name, problem)

    def leave(self) -> SkyloopError | None:
        """What the end of a block does: land what this application flies (or hover, as ``on_exit`` said), and close.

        Waits until it has landed. Returns what went wrong on the way, None if nothing did. Idempotent.
        """
        problem = None
        try:
            if not self._closed and self._flies():
                self._end_flight()
        except SkyloopError as error:
            problem = error
        finally:
            self.close()
        return problem

    def __repr__(self) -> str:
        return f"<Drone {self.name or '?'} ({self._link.state.value}, authority {self.authority.state})>"

    # Inside ----------------------------------------------------------------------------------------------------

    def _known(self) -> bool:
        """Whether the vehicle's state is known and the link was judged."""
        return self._reception.newest is not None and self._reception.status.application is not LinkState.CONNECTING

    def _flies(self) -> bool:
        """Whether this application has the vehicle in the air, or has just told it to take off."""
        newest = self._reception.newest
        if self._reception.status.vehicle is LinkState.CLOSED:
            return False  # a recording that is over: nothing can be landed any more
        airborne = newest is not None and newest.state.airborne
        return self._pilot.status.state == "held" and (airborne or self._pilot.wants_flight)

    def _end_flight(self) -> None:
        if self._on_exit == "land":
            self.land()
        else:
            self.hover()

    def _proxy_statistics(self) -> Statistics | None:
        try:
            answer = self._link.call(GetStatistics, 0.2)
        except LinkError:
            return None
        return answer if isinstance(answer, Statistics) else None


def _with_delay(stats: ChannelStats, statistics: Statistics | None) -> ChannelStats:
    """With the delay that the proxy measured between sending and applying."""
    counters = {} if statistics is None else statistics.counters
    count = int(counters.get("commands.delay.count", 0))
    if not count:
        return stats
    median = counters.get("commands.delay.median_s", 0.0)
    return replace(
        stats,
        delay_s=Distribution(
            median=median,
            p99=counters.get("commands.delay.p99_s", median),
            maximum=counters.get("commands.delay.max_s", median),
            mean=counters.get("commands.delay.mean_s", median),
            count=count,
        ),
    )

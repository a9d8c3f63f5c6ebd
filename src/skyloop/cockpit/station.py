"""One drone of the cockpit, with what all its pages share."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from skyloop.cockpit.beat import Beat
from skyloop.cockpit.feeds import CameraFeed, Listening, NewsFeed
from skyloop.cockpit.finder import Found
from skyloop.cockpit.telemetry import TelemetryView
from skyloop.control.waypoint import Waypoint

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.cockpit.hands import Hands

TELEMETRY_HZ: Final = 18.0
HANDS_S: Final = 2.0  #: for a pilot's connection to be made


class Station:
    """Made and closed on the event loop."""

    def __init__(self, found: Found, drone: Drone) -> None:
        self.found = found
        self.drone = drone
        self.news = NewsFeed(drone)
        self.listening = Listening(drone)
        self.cameras: dict[str, CameraFeed] = {}
        self.goals: dict[str, Waypoint] = {}  #: where pages fly it to, by the name of the application that does
        self.hands: set[Hands] = set()  #: pilots' connections of pages
        self.view = TelemetryView(self)
        self.beat = Beat(1.0 / TELEMETRY_HZ, self.view.state, self.listening.want)
        self._stopper: asyncio.Task[Hands] | None = None
        self._may_stop = 0

    @property
    def in_use(self) -> bool:
        """Whether a page shows it."""
        return self.beat.wanted or any(feed.wanted for feed in self.cameras.values())

    def camera(self, name: str) -> CameraFeed | None:
        """The camera of that name; None if the vehicle has none."""
        if name not in self.cameras and any(info.name == name for info in self.drone.capabilities.cameras):
            self.cameras[name] = CameraFeed(self.drone, name)
        return self.cameras.get(name)

    # Pilots ----------------------------------------------------------------------------------------------------

    async def open_hands(self, app: str) -> Hands:
        """A pilot's connection that holds nothing yet. Raises :class:`SkyloopError`."""
        from skyloop.cockpit.hands import Hands

        def connect() -> Hands:
            hands = Hands(self.found.dial, app=app, on_exit="hover")
            hands.open(timeout_s=HANDS_S)
            return hands

        hands = await asyncio.to_thread(connect)
        self.hands.add(hands)
        return hands

    async def close_hands(self, hands: Hands) -> None:
        """Give back what it holds."""
        await asyncio.to_thread(hands.close)
        self.hands.discard(hands)

    def pilot_came(self) -> None:
        """A page that may stop the motors is there: what it needs for that is made ready."""
        self._may_stop += 1
        if self._stopper is None:
            self._stopper = asyncio.create_task(self.open_hands("cockpit stop"))
            self._stopper.add_done_callback(_look)

    async def pilot_went(self) -> None:
        self._may_stop -= 1
        if not self._may_stop and self._stopper is not None:
            stopper, self._stopper = self._stopper, None
            await self._end(stopper)

    async def stopper(self) -> Hands:
        """A pilot's connection that never holds the authority, for emergency stops. Raises :class:`SkyloopError`."""
        if self._stopper is None or (self._stopper.done() and self._stopper.exception() is not None):
            self._stopper = asyncio.create_task(self.open_hands("cockpit stop"))
        return await asyncio.shield(self._stopper)

    async def close(self) -> None:
        self.beat.end()
        self.listening.want(False)
        self.news.close()
        for feed in self.cameras.values():
            feed.close()
        if self._stopper is not None:
            await self._end(self._stopper)
        for hands in list(self.hands):
            await self.close_hands(hands)
        await asyncio.to_thread(self.drone.close)

    async def _end(self, stopper: asyncio.Task[Hands]) -> None:
        await asyncio.gather(stopper, return_exceptions=True)
        if not stopper.cancelled() and stopper.exception() is None:
            await self.close_hands(stopper.result())


def _look(task: asyncio.Task[Hands]) -> None:
    """An error is told when somebody wants to stop, which tries again."""
    if not task.cancelled():
        task.exception()

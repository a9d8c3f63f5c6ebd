"""A program that draws or logs under thousands of names blocks neither a page's pictures nor the event loop."""

from __future__ import annotations

import asyncio
import json
from types import SimpleNamespace
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import ManualClock
from skyloop.cockpit.feeds import KEPT_S, MAX_SERIES, MAX_SOURCES, MAX_WAYPOINTS, EventFeed, LogFeed, Newest
from skyloop.cockpit.stream import DRAWN_BYTES, PageCounts, VideoSender
from skyloop.messages import Annotation, LogEntry, Points
from tests.support.cockpit import FakeDrone

SOURCES = 3000
LARGE = (Points(tuple((float(n), float(n)) for n in range(1500)), (255, 0, 0)),)


def drawing(source: str, captured_ns: int = 5) -> Annotation:
    return Annotation(source, "front", captured_ns, 64, 48, LARGE)


class Page:
    """A socket that accepts everything at once."""

    def __init__(self) -> None:
        self.sent: list[str] = []

    async def send_text(self, text: str) -> None:
        self.sent.append(text)


def video(page: Page, feed: EventFeed, counts: PageCounts) -> VideoSender:
    station: Any = SimpleNamespace(event_feed=feed)
    sender = VideoSender(page, station, SimpleNamespace(camera="front"), counts)  # type: ignore[arg-type]
    sender._sent_ns = 10  # a frame was sent
    return sender


def test_a_new_page_gets_drawings_in_small_pieces_and_in_turn_all_of_them() -> None:
    drone, counts, page = FakeDrone(), PageCounts(), Page()

    async def main() -> None:
        feed = EventFeed(drone)  # type: ignore[arg-type]
        steps = 0

        async def others() -> None:
            nonlocal steps
            while True:
                await asyncio.sleep(0)
                steps += 1

        woken = []
        feed.subscribe(lambda: woken.append(1))
        for number in range(SOURCES):
            drone.draw(drawing(f"source {number}"))
        beside = asyncio.create_task(others())
        await asyncio.sleep(0)
        assert woken == [1], "the loop is woken once for all of them"
        sender = video(page, feed, counts)
        seen: set[str] = set()
        while len(seen) < MAX_SOURCES:
            page.sent.clear()
            before = steps
            await sender._send_drawings()
            assert page.sent
            assert sum(map(len, page.sent[:-1])) <= DRAWN_BYTES
            assert steps - before >= len(page.sent), "other tasks had their turn after each"
            assert not seen & {json.loads(text)["source"] for text in page.sent}, "those that waited longest come first"
            seen |= {json.loads(text)["source"] for text in page.sent}
        page.sent.clear()
        await sender._send_drawings()
        assert not page.sent
        assert feed.drawings.refused == SOURCES - MAX_SOURCES
        drone.draw(drawing("source 3", captured_ns=6))
        await sender._send_drawings()
        assert [json.loads(text)["captured_ns"] for text in page.sent] == ["6"], "the older source continues"
        beside.cancel()
        feed.close()

    asyncio.run(main())
    assert len(counts.sources) <= MAX_SOURCES


def test_a_drawing_is_encoded_once_for_all_pages() -> None:
    drone, pages = FakeDrone(), [Page(), Page()]

    async def main() -> None:
        feed = EventFeed(drone)  # type: ignore[arg-type]
        drone.draw(drawing("tracker"))
        for page in pages:
            await video(page, feed, PageCounts())._send_drawings()
        feed.close()

    asyncio.run(main())
    assert pages[0].sent[0] is pages[1].sent[0]


def test_old_drawings_make_room() -> None:
    clock = ManualClock()
    newest: Newest[str, int] = Newest(2, clock)
    for name in "abc":
        newest.put(name, 1)
    assert dict(newest.items()) == {"a": 1, "b": 1}
    clock.advance(KEPT_S / 2)
    newest.put("a", 2)
    clock.advance(KEPT_S / 2)
    assert dict(newest.items()) == {"a": 2}
    newest.put("c", 3)
    newest.put("d", 4)
    assert dict(newest.items()) == {"a": 2, "c": 3}
    assert newest.refused == 2
    newest.clear()
    assert newest.items() == []


@given(st.lists(st.tuples(st.sampled_from("abcdefgh"), st.floats(0, 2 * KEPT_S)), max_size=60))
def test_there_are_never_more_than_allowed_and_a_known_one_is_never_refused(steps: list[tuple[str, float]]) -> None:
    clock = ManualClock()
    newest: Newest[str, int] = Newest(3, clock)
    for number, (name, seconds) in enumerate(steps):
        known = name in dict(newest.items())
        newest.put(name, number)
        now = dict(newest.items())
        assert len(now) <= 3
        assert now.get(name) == number or not known
        clock.advance(seconds)


def test_series_no_longer_logged_make_room_for_others() -> None:
    clock, drone = ManualClock(), FakeDrone()
    listening = LogFeed(drone, clock)  # type: ignore[arg-type]
    listening.want(True)

    def log(name: str) -> None:
        for function in list(drone.log_listeners):
            function(LogEntry(source="app", name=name, at_ns=1, number=1.0))

    for number in range(SOURCES):
        log(f"junk {number}")
    assert len(listening.numbers()) == MAX_SERIES
    assert listening.refused == SOURCES - MAX_SERIES
    clock.advance(KEPT_S)
    log("height")
    assert listening.numbers() == {"height": 1.0}


def test_a_path_of_thousands_of_waypoints_is_shown_in_part() -> None:
    drone = FakeDrone()
    listening = LogFeed(drone)  # type: ignore[arg-type]
    listening.want(True)
    entry: Any = LogEntry(source="app", name="waypoints", at_ns=1, values=(0.0,) * 3 * 1000, shape=(1000, 3))
    for function in list(drone.log_listeners):
        function(entry)
    assert len(listening.waypoints()) == MAX_WAYPOINTS

"""The page's overview in Chromium: all drones at once, one opened from it and back, landing them all."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest

import skyloop
from skyloop.cockpit.addresses import bind
from skyloop.messages import FlightState
from tests.cockpit.browser import PATIENCE_S, Deck, DronePage
from tests.support.processes import Process

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.process

NAMES = ["d1", "d2", "d3"]
BACK_S = 3.0
SMALL = ("cameras=front", "width=160", "height=120", "fps=10", "position=1")


@pytest.fixture(scope="module")
def open_cockpit(open_cockpit: tuple[Browser, str]) -> Iterator[tuple[Browser, str]]:
    """The cockpit, with three drones flying in one world."""
    options = [word for option in SMALL for word in ("--option", option)]
    world = Process("-m", "skyloop", "sim", "--drones", "3", "--name", "d", "--world", "empty", *options)
    try:
        world.until("ready d3")
        yield open_cockpit
    finally:
        world.end()


def frames(page: DronePage, name: str) -> int:
    return int(page.page.locator(f'.tile[data-drone="{name}"]').get_attribute("data-frames") or "0")


def test_all_drones_one_of_them_and_back(deck: Deck) -> None:
    page = deck.overview()
    page.page.locator(".tile").nth(2).wait_for()
    assert page.page.locator(".tile b").all_text_contents() == NAMES
    page.until(lambda: min(frames(page, name) for name in NAMES) >= 3, "every tile shows pictures")
    assert page.page.locator(".pane").count() == 0
    page.page.get_by_role("button", name="Open d2").click()
    page.page.locator('.pane[data-drone="d2"][data-lost="false"]').wait_for(timeout=PATIENCE_S * 1000)
    assert page.page.url.endswith("/#d2")
    assert not page.page.locator(".overview").is_visible()
    rested = frames(page, "d1")
    page.page.locator(".pane .camera[data-seq]").wait_for()
    assert frames(page, "d1") <= rested + 1, "nobody sees the tiles"
    page.page.go_back()
    page.page.locator(".tile").first.wait_for()
    assert (page.page.url.endswith("/#/"), page.page.locator(".pane").count()) == (True, 0)
    page.until(lambda: frames(page, "d1") > rested + 1, "pictures again")
    page.page.go_forward()
    page.page.locator('.pane[data-drone="d2"]').wait_for()
    page.page.get_by_role("button", name="All drones", exact=True).click()
    page.page.locator(".tile").first.wait_for()
    page.page.get_by_role("button", name="Table", exact=True).click()
    page.page.get_by_role("button", name="Drone", exact=True).click()
    assert page.page.locator(".lines tbody .line-name").all_text_contents() == NAMES[::-1], "sorted the other way"
    page.page.get_by_role("button", name="Open d3").click()
    page.page.locator('.pane[data-drone="d3"]').wait_for()
    assert page.problems == []


def test_keys_fly_no_invisible_drone_and_all_land(deck: Deck) -> None:
    page = deck.page("d1")
    with ExitStack() as stack:
        seen = {name: stack.enter_context(skyloop.connect(name, access="observe", name="test")) for name in NAMES}
        page.take_off()
        with skyloop.connect("d2", name="other.py") as other:
            other.takeoff()
        page.page.get_by_role("button", name="All drones", exact=True).click()
        tile = page.page.locator('.tile[data-drone="d1"]')
        tile.get_by_text("This page has control").wait_for()
        before = seen["d1"].feedback().position_m
        with page.holding("w"):
            page.page.wait_for_timeout(400)
        after = seen["d1"].feedback().position_m
        assert before is not None
        assert after is not None
        assert math.dist(before[:2], after[:2]) < 0.1
        button = page.page.get_by_role("button", name="Land all")
        button.hover()
        page.page.mouse.down()
        page.page.locator(".safety-message").wait_for()
        page.page.mouse.up()
        page.until(
            lambda: all(seen[name].feedback().state is FlightState.LANDED for name in ("d1", "d2")),
            "both have landed",
            3 * PATIENCE_S,
        )
    assert page.problems == []


def test_the_page_is_back_soon_after_its_cockpit(deck: Deck) -> None:
    with bind("127.0.0.1", 0) as free:
        port = str(free.getsockname()[1])
    first = deck.own_cockpit("--port", port)
    page = deck.overview()
    page.page.locator(".tile").nth(2).wait_for()
    first.end()
    page.page.locator('.overview[data-old="true"]').wait_for()
    deck.own_cockpit("--port", port)
    started_s = time.monotonic()
    page.page.locator('.overview[data-old="false"]').wait_for()
    page.page.locator(".tile").nth(2).wait_for()
    shown = frames(page, "d1")
    page.until(lambda: frames(page, "d1") > shown, "pictures again")
    assert time.monotonic() - started_s < BACK_S

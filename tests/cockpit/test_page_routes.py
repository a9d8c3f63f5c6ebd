"""Routes and zones on the page, in Chromium and Firefox: planned on the map and by keys, checked, kept, and flown."""

from __future__ import annotations

import json
import math
import os
from contextlib import suppress
from pathlib import Path

import pytest

import skyloop
from tests.cockpit.browser import IN_BOTH, Deck, DronePage

pytestmark = [pytest.mark.process, IN_BOTH]

SIM = "sim://?world=empty&cameras=front&width=64&fps=10&wind=0"


def write(page: DronePage, label: str, text: str) -> None:
    """Fill a number field by keys: Firefox does not clear one first."""
    page.pane.get_by_label(label, exact=True).focus()
    page.press("Control+A", *text)


def field(page: DronePage, name: str, number: int) -> str:
    return str(page.pane.locator(f".route-table tbody tr:nth-child({number}) [data-field={name}]").input_value())


def test_a_route_of_three_waypoints_is_planned_and_flown(deck: Deck, tmp_path: Path) -> None:
    from playwright.sync_api import TimeoutError as NotThere

    deck.proxy("planner", SIM)
    page = deck.page("planner")
    pane = page.pane
    pane.get_by_role("button", name="Route", exact=True).click()
    rows = pane.locator(".route-table tbody tr")
    canvas = pane.locator(".map")
    box = canvas.bounding_box()
    assert box is not None
    canvas.click(position={"x": box["width"] / 2 + 60, "y": box["height"] / 2})
    page.until(lambda: rows.count() == 1, "a press adds a waypoint")
    canvas.focus()
    page.press("ArrowUp", "ArrowUp", "Enter")
    page.until(lambda: rows.count() == 2, "so does Enter at the cursor")
    page.press("ArrowLeft", "ArrowLeft", "Enter")
    page.until(lambda: rows.count() == 3, "and again")
    places = ((0.8, 0.0, 1.0), (0.8, 0.8, 1.4), (0.0, 0.8, 1.0))
    for number, place in enumerate(places, 1):
        for name, value in zip("xyz", place, strict=True):
            write(page, f"{name} in metres of waypoint {number}", str(value))
    pane.get_by_label("Photo at waypoint 2").check()
    write(page, "wait in seconds of waypoint 1", "0.5")
    page.wait_for_text(".route-body .note[role=status]", "about")

    write(page, "z in metres of waypoint 3", "40")
    page.wait_for_text(".route-findings", "Waypoint 3: ")
    assert pane.get_by_role("button", name="Fly the route").is_disabled(), "what can't be flown is not flown"
    write(page, "z in metres of waypoint 3", "1")
    page.until(lambda: page.says(".route-findings") == "", "it is checked again")
    assert pane.get_by_role("button", name="Fly the route").is_disabled(), "nobody has control"

    pane.get_by_label("Name of the route").fill("square")
    pane.get_by_role("button", name="Save", exact=True).click()
    page.wait_for_text(".route", "saved as square")
    pane.get_by_role("button", name="New", exact=True).click()
    page.until(lambda: rows.count() == 0, "it is empty")
    pane.get_by_label("Saved routes").select_option("square")
    page.until(lambda: rows.count() == 3, "it is loaded")
    assert [float(field(page, axis, 2)) for axis in "xyz"] == [0.8, 0.8, 1.4]
    uploaded = tmp_path / "bad.route.json"
    uploaded.write_text(json.dumps({"waypoints": [{"x": 1}]}))
    pane.locator(".route input[type=file]").set_input_files(uploaded)
    page.wait_for_text(".route", "missing required field")
    assert rows.count() == 3, "what is no route takes nothing's place"
    if folder := os.environ.get("SKYLOOP_PICTURES"):
        page.page.screenshot(path=f"{folder}/route-plan.png")

    with skyloop.connect("planner", access="observe", name="test") as drone:
        canvas.evaluate("map => map.blur()")
        page.take_off()
        fly = pane.get_by_role("button", name="Fly the route")
        page.until(lambda: not fly.is_disabled(), "it can be flown")
        page.problems.clear()  # the refused upload is one
        fly.click()
        page.wait_for_text(".route-progress", "waypoint 1 of 3")
        pane.get_by_role("button", name="Pause the route").click()
        page.wait_for_text(".route-progress", "paused")
        resume = pane.get_by_role("button", name="Resume the route")

        def arrived() -> bool:
            """It pauses if a busy machine makes the page silent for half a second."""
            if resume.is_visible():
                with suppress(NotThere):  # it disappears as the press before it takes effect
                    resume.click(timeout=1000)
            return "done" in page.says(".route-progress")

        page.until(arrived, "it arrives", 60.0)
        position = drone.feedback().position_m
        assert position is not None
        assert math.dist(position, places[2]) < 0.4
        if folder:
            page.page.screenshot(path=f"{folder}/route-done.png")
    assert page.problems == []


def test_a_zone_is_drawn_refused_and_seen_by_another_page(deck: Deck) -> None:
    deck.proxy("zoned", SIM)
    page, other = deck.page("zoned"), deck.page("zoned")
    with skyloop.connect("zoned", access="observe", name="test") as drone:
        page.take_control()
        for one in (page, other):
            one.pane.get_by_role("button", name="Zones").click()
        canvas = page.pane.locator(".map")
        page.until(lambda: canvas.get_attribute("data-still") == "true", "it shows the room")
        page.pane.get_by_role("button", name="Add box").click()
        canvas.scroll_into_view_if_needed()
        box = canvas.bounding_box()
        assert box is not None
        # The room, 30 m wide, has 10/13 of the map's height.
        middle = box["width"] / 2
        canvas.hover(position={"x": middle + box["height"] * 0.1, "y": box["height"] * 0.4})
        page.page.mouse.down()
        page.page.mouse.move(box["x"] + middle + box["height"] * 0.3, box["y"] + box["height"] * 0.6, steps=3)
        page.page.mouse.up()
        page.wait_for_text(".zones .answer", "written")
        drawn = str(drone.config["safety.zones"])
        assert drawn.startswith("Z1: box "), "it has the name that the map and refusals call it by"
        other.wait_for_text(".zones select", "Z1, box")
        assert other.pane.get_by_role("button", name="Delete").is_disabled(), "the other page has no control"
        # Nonsense is refused, and the zone stays.
        top = page.pane.get_by_label("top in metres")
        bottom = page.pane.get_by_label("bottom in metres")
        page.page.bring_to_front()
        write(page, "bottom in metres", top.input_value())
        page.press("Tab")
        page.wait_for_text(".zones .answer", "must have an extent")
        assert drone.config["safety.zones"] == drawn
        page.until(lambda: bottom.input_value() == "0", "the field shows what is in force")
        # A place in it is refused before anything flies; then by keys alone: the cursor, and Del.
        page.pane.get_by_role("button", name="Zones").click()
        west, south, _, east, north, _ = map(float, drawn.split()[2:])
        for axis, value in (("x", (west + east) / 2), ("y", (south + north) / 2), ("z", 1.0)):
            write(page, f"Waypoint {axis} in metres", f"{value:.2f}")
        page.wait_for_text(".preview", "in a no-fly zone, Z1: box")
        page.pane.get_by_role("button", name="Zones").click()
        canvas.focus()
        page.press("ArrowRight", "Delete")
        page.until(lambda: drone.config["safety.zones"] == "", "it is deleted")
        other.until(lambda: "Z1" not in other.says(".zones select"), "on the other page, too")
        assert page.problems == []

"""Recordings and replays on the page: a flight is recorded, organised, and scrubbed through."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import skyloop
from skyloop.messages import Feedback
from tests.cockpit.browser import Deck, DronePage, browser_and_cockpit

pytestmark = pytest.mark.process

LONG_S = 30.0


@pytest.fixture
def deck() -> Iterator[Deck]:
    with browser_and_cockpit() as opened:
        deck = Deck(*opened)
        yield deck
        deck.end()


def replay(deck: Deck, name: str) -> DronePage:
    """Open the page with a recording replayed by its button."""
    page = deck.overview()
    page.page.get_by_role("button", name=f"Replay {name}").click()
    page.page.locator(".replay-slider:visible").wait_for(timeout=LONG_S * 1000)
    page.pane = page.page.locator(".pane")
    return page


def position(page: DronePage) -> float:
    return float(page.attribute(".replay", "data-position"))


def drag(page: DronePage, share: float) -> None:
    """Move to a share of the bar, with the mouse."""
    box = page.pane.locator(".replay-rail").bounding_box()
    assert box is not None
    mouse, y = page.page.mouse, box["y"] + box["height"] / 2
    mouse.move(box["x"] + 0.1 * box["width"], y)
    mouse.down()
    mouse.move(box["x"] + 0.9 * box["width"], y, steps=4)
    mouse.move(box["x"] + share * box["width"], y, steps=4)
    mouse.up()


def test_a_flight_is_recorded_beside_its_picture_and_only_once(deck: Deck, tmp_path: Path) -> None:
    (tmp_path / "broken.mcap").write_bytes(b"no recording")
    deck.address = deck.cockpit("--recordings", str(tmp_path))
    deck.proxy("large")
    page = deck.page("large", panels=False)
    page.wait_for_new_picture()
    record = page.pane.locator(".record-flight")
    record.click()
    page.until(lambda: "0:0" in (record.text_content() or ""), "how long it is by now")
    page.page.get_by_role("button", name="All drones").click()
    every = page.page.get_by_role("button", name="Record", exact=True)
    page.until(every.is_disabled, "all are being recorded")
    page.page.go_back()
    record.click()
    page.wait_for_text(".notice", "Recorded: large-")
    assert len(list(tmp_path.glob("large-*.mcap"))) == 1
    page.page.get_by_role("button", name="All drones").click()
    row = page.page.locator('[data-recording="broken.mcap"]')
    page.until(lambda: "not an MCAP file" in (row.text_content() or ""), "what is wrong with it")
    assert not row.get_by_role("link", name="Report").is_visible(), "nothing of it can be read"
    row.get_by_role("button", name="More").click()
    assert row.get_by_role("button", name="Delete").is_visible()
    page.page.locator('[data-recording^="large-"]').get_by_role("button", name="More").click()
    page.page.get_by_text(f'skyloop log export "{tmp_path}/large-').wait_for()
    assert page.problems == []


def test_a_flight_is_recorded_kept_in_order_and_replayed(deck: Deck, tmp_path: Path) -> None:
    deck.address = deck.cockpit("--recordings", str(tmp_path))
    deck.proxy("filmed")
    page = deck.page("filmed")
    page.wait_for_new_picture()
    page.page.get_by_role("button", name="Record", exact=True).click()
    page.page.get_by_role("button", name="Add a mark to the recording of filmed").click()
    with skyloop.connect("filmed", name="up.py") as drone:
        drone.takeoff()
        drone.land(wait=False)
    page.page.get_by_role("button", name="Stop recording filmed").click()
    (path,) = tmp_path.glob("*.mcap")

    page.page.get_by_role("button", name=f"More about {path.name}").click()
    page.page.get_by_label("Name", exact=True).fill("First flight")
    page.page.get_by_role("button", name="Rename").click()
    page.page.get_by_role("button", name="More about First flight.mcap").click()
    page.page.get_by_label("Note", exact=True).fill("calm air")
    page.page.get_by_role("button", name="Save note").click()
    page.page.locator(".rec-note", has_text="calm air").wait_for()
    with page.page.expect_download() as download:
        page.page.get_by_role("link", name="Download First flight.mcap").click()
    assert download.value.suggested_filename == "First flight.mcap"
    assert Path(download.value.path()).read_bytes() == (tmp_path / "First flight.mcap").read_bytes()

    page = replay(deck, "First flight.mcap")
    page.until(lambda: position(page) > 0.2, "it plays", LONG_S)
    shown = page.pane.get_attribute("data-drone")
    surroundings = f"fetch('/api/drones/{shown}/world').then((answer) => answer.json())"
    page.until(lambda: page.page.evaluate(surroundings)["room"] is not None, "its map has the recorded room", LONG_S)
    page.pane.locator(".replay-slider").focus()
    page.press("Space")
    page.until(lambda: page.attribute(".replay", "data-paused") == "true", "it is paused")
    page.pane.locator(".replay-ticks i[data-kind='mark']").wait_for(state="attached", timeout=LONG_S * 1000)
    name = page.pane.get_attribute("data-drone") or ""
    with skyloop.connect(name, access="observe", name="test") as drone:
        seen: dict[str, Feedback] = {}
        drone.on_feedback(lambda feedback: seen.update({str(feedback.captured_ns): feedback}), inline=True)
        heights = []
        for share in (0.6, 0.3):
            drag(page, share)
            duration_s = float(page.attribute(".replay-slider", "aria-valuemax"))
            there_s = share * duration_s
            page.until(lambda at_s=there_s: abs(position(page) - at_s) < 0.35, f"it is at {share}")  # type: ignore[misc]

            def one_instant() -> bool:
                state = seen.get(page.attribute(".camera", "data-captured"))
                at_s = (state.native or {}).get("replay.position_s") if state else None
                return isinstance(at_s, float) and abs(at_s - position(page)) < 0.001

            page.until(one_instant, "picture and state are of one instant")
            heights.append(page.says('[data-figure="altitude"]'))
        assert heights[0] != heights[1]
        assert page.says(".chip.age") == "paused"
    before = position(page)
    page.press("ArrowRight")
    page.until(lambda: abs(position(page) - before - 1.0) < 0.01, "a second further")
    page.pane.get_by_role("button", name="Mark", exact=True).click()
    page.pane.locator(".replay-form input").fill("look here")
    page.press("Enter")
    page.pane.locator(".replay-ticks i[data-kind='own']").wait_for(state="attached")
    page.press("Home")  # a key of the page's, not of the bar: the button has the focus
    page.pane.locator(".replay-slider").focus()
    page.press("End", "Space")
    page.wait_for_text(".pill", "recording over")
    page.pane.get_by_role("button", name="Play again").click()
    page.until(lambda: 0.0 < position(page) < before, "it plays from its begin")

    page.page.get_by_role("button", name="More about First flight.mcap").click()
    page.page.get_by_role("button", name="Delete First flight.mcap").click()
    page.page.get_by_role("button", name="Move to the trash").click()
    page.page.locator(".recordings .note", has_text="end the replay first").wait_for()
    page.page.get_by_role("button", name="End replay").click()
    page.page.get_by_role("button", name="Move to the trash").click()
    page.page.get_by_role("button", name="Undo").wait_for()
    assert (tmp_path / "trash" / "First flight.mcap").exists()
    page.page.get_by_role("button", name="Undo").click()
    page.page.get_by_role("button", name="Replay First flight.mcap").wait_for()
    # Deleting was refused during the replay, and the replay's elements are gone with it.
    assert all("409" in found or "404" in found for found in page.problems), page.problems

"""Dialogs, settings and the gamepad on the cockpit's page, in Chromium."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import pytest

import skyloop
from skyloop.messages import FlightState
from tests.cockpit.browser import Deck

if TYPE_CHECKING:
    pass

pytestmark = pytest.mark.process


def test_nothing_flies_while_a_dialog_is_open_but_the_emergency_stop_works(deck: Deck) -> None:
    deck.proxy("modal")
    page = deck.page("modal")
    with skyloop.connect("modal", access="observe", name="test") as drone:
        page.take_off()
        chip = page.page.locator(".bar .inputs")
        chip.click()
        dialog = page.page.get_by_role("dialog", name="Keys and gamepad")
        dialog.wait_for()
        assert dialog.get_by_role("button", name="Close").evaluate("button => button === document.activeElement")
        page.page.keyboard.down("w")
        page.press("l", "h")
        for _ in range(20):
            assert drone.next_feedback().state is FlightState.HOVERING
        for _ in range(12):
            page.press("Tab")
            within = "document.activeElement.closest('dialog') !== null || document.activeElement === document.body"
            assert page.page.evaluate(within), "the focus stays in it"
        page.press("Escape")
        page.until(lambda: not dialog.is_visible(), "it is closed")
        assert chip.evaluate("chip => chip === document.activeElement"), "the focus returns"
        for _ in range(10):
            assert drone.next_feedback().state is FlightState.HOVERING, "what was held counts when it is pressed again"
        page.page.keyboard.up("w")
        page.press("?")
        dialog.wait_for()
        assert dialog.get_by_role("button", name="Land all").is_visible(), "in reach whatever is open"
        with page.holding("Control", "Enter"):
            page.page.locator("dialog .counting").wait_for()
            page.until(lambda: drone.feedback().state is FlightState.EMERGENCY, "the motors are off")
        page.press("Escape")
        page.page.locator(".bar .safety").wait_for()
    assert page.problems == []


def test_settings_are_used_at_once_and_remembered(deck: Deck) -> None:
    deck.proxy("set")
    page = deck.page("set", color_scheme="dark")
    assert page.page.locator("html").get_attribute("data-theme") == "dark"
    page.page.get_by_role("button", name="Settings").click()
    for name in ("Imperial", "Light", "Mode 1"):
        page.page.get_by_role("radio", name=name).check()
    assert "Left stick: forward and back, turn." in (page.page.locator(".settings").text_content() or "")
    page.press("Escape")
    for _ in ("now", "when it is loaded again"):
        page.until(lambda: "ft/s" in page.says(".figures"), "speeds are in feet")
        assert page.page.locator("html").get_attribute("data-theme") == "light"
        page.page.reload()
    assert page.problems == []


PAD = """
window.pad = {id: "Test pad", mapping: "standard", connected: true, axes: [0, 0, 0, 0],
              buttons: Array.from({length: 17}, () => ({pressed: false}))};
navigator.getGamepads = () => [window.pad];
"""


def test_a_gamepad_is_mapped_and_commands_nothing_meanwhile(deck: Deck) -> None:
    deck.proxy("mapped")
    page = deck.page("mapped", prepare=PAD)

    def axes(*values: float) -> None:
        page.page.evaluate("axes => { window.pad.axes = axes; }", list(values))

    def button(number: int, pressed: bool) -> None:
        page.page.evaluate("([one, pressed]) => { window.pad.buttons[one].pressed = pressed; }", [number, pressed])

    with skyloop.connect("mapped", access="observe", name="test") as drone:
        page.take_off()
        page.press("?")
        page.page.get_by_role("button", name="Map the gamepad").click()
        dialog = page.page.get_by_role("dialog", name="Gamepad", exact=True)
        dialog.get_by_text("Test pad").wait_for()
        button(1, True)  # B lands, otherwise
        axes(0, 0, 0, -1)
        dialog.locator(".pad-button[data-pressed=true]").wait_for()
        button(1, False)
        axes(0, 0, 0, 0)
        dialog.get_by_role("button", name="Assign: Forward").click()
        axes(0, -1, 0, 0)
        forward = dialog.locator("[data-axis=forward]")
        page.until(lambda: "Left stick ↑" in (forward.text_content() or ""), "it is assigned")
        dialog.get_by_role("button", name="Assign: Land").click()
        for pressed in (True, False):
            page.page.wait_for_timeout(100)
            button(7, pressed)
        page.until(lambda: "RT" in (dialog.locator("[data-deed=land]").text_content() or ""), "it is assigned")
        for _ in range(10):
            assert drone.next_feedback().state is FlightState.HOVERING
        page.press("Escape")
        page.until(lambda: not dialog.is_visible(), "it is closed")
        for _ in range(10):
            assert drone.next_feedback().state is FlightState.HOVERING, "a stick must be centred first"
        axes(0, 0, 0, 0)
        page.page.wait_for_timeout(200)
        axes(0, -1, 0, 0)
        page.until(lambda: (drone.feedback().velocity_m_s or (0,))[0] > 0.3, "the left stick flies forward")
        axes(0, 0, 0, 0)
        button(7, True)
        page.wait_for_text(".pill", "landed")
    assert page.problems == []


APART = """
Object.defineProperty(document, "pictureInPictureEnabled", {get: () => true});
HTMLVideoElement.prototype.requestPictureInPicture = async function () { window.apart = this; };
document.exitPictureInPicture = async () => window.apart.dispatchEvent(new Event("leavepictureinpicture"));
"""


def test_pictures_are_saved_shown_on_the_full_screen_and_controlled(deck: Deck, tmp_path: Path) -> None:
    deck.proxy("film")
    page = deck.page("film", prepare=APART)
    page.wait_for_new_picture()
    camera = page.pane.locator(".camera")
    with page.page.expect_download() as photo:
        camera.get_by_role("button", name="Save a photo").click()
    name = photo.value.suggested_filename
    assert re.fullmatch(r"film-front-\d{4}-\d\d-\d\dT\d\d-\d\d-\d\d\.\d{3}Z\.png", name)
    photo.value.save_as(tmp_path / name)
    picture = cv2.imread(str(tmp_path / name))
    assert picture is not None
    assert picture.shape == (240, 320, 3), "as large as it came"
    assert picture.std() > 1
    record = camera.get_by_role("button", name="Record a clip")
    record.click()
    page.until(lambda: "Recording 0:01" in page.says(".clip-mark"), "a second of it")
    assert record.get_attribute("aria-pressed") == "true"
    with page.page.expect_download() as clip:
        record.click()
    assert clip.value.suggested_filename.endswith((".webm", ".mp4"))
    clip.value.save_as(tmp_path / "clip")
    assert (tmp_path / "clip").stat().st_size > 1000
    assert not page.pane.locator(".clip-mark").is_visible()
    apart = camera.get_by_role("button", name="in its own window")
    apart.click()
    page.until(lambda: apart.get_attribute("aria-pressed") == "true", "it has a window of its own")
    page.until(
        lambda: page.page.evaluate("window.apart.videoWidth === 320 && window.apart.currentTime > 0"), "it moves"
    )
    apart.click()
    page.until(lambda: apart.get_attribute("aria-pressed") == "false", "it is back")
    assert page.page.evaluate("window.apart.srcObject") is None
    camera.get_by_role("button", name="full screen").click()
    page.until(lambda: camera.evaluate("camera => document.fullscreenElement === camera"), "it is full")
    camera.get_by_role("button", name="Motors off").wait_for()  # within reach there, too
    page.begin_to_mark(camera.get_by_role("button", name="Follow something").click)
    camera.get_by_role("button", name="Motors off").click(trial=True)  # also above the layer for drawing a box
    camera.get_by_role("button", name="Follow something").click()
    page.page.evaluate("document.exitFullscreen()")
    page.page.locator(".bar .safety").wait_for()
    page.take_control()
    page.pane.get_by_role("button", name="Controls").click()
    gain = page.pane.locator('.camera-controls [data-parameter="camera.front.gain"]')
    gain.locator("input").fill("0.5")
    gain.get_by_role("button", name="Set").click()
    page.until(lambda: "written" in (gain.locator(".answer").text_content() or ""), "the drone has it")
    assert page.pane.locator('.camera-controls [data-parameter="limits.speed"]').is_hidden()
    assert page.problems == []

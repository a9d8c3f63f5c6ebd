"""Video on the page in Chromium: H.264 decoded and drawn, JPEGs otherwise; a stalled page harms no others."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import pytest

import skyloop
from skyloop.client import Frame
from skyloop.drivers.registry import make_driver
from skyloop.messages import FlightState, Polyline
from skyloop.proxy import Proxy
from skyloop.transport.local import LocalServer
from tests.cockpit.browser import WATCHED, Deck, DronePage
from tests.support.processes import Process, stopped
from tests.support.tello_addresses import Addresses

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.process
#: How much of the overlay is drawn on.
DRAWN_ON: Final = """(sheet) => {
  const { data } = sheet.getContext("2d").getImageData(0, 0, sheet.width, sheet.height);
  let most = 0;
  for (let at = 3; at < data.length; at += 4) most = Math.max(most, data[at]);
  return most;
}"""
pytest.importorskip("av", reason="H.264 needs: skyloop install video")

NO_DECODER: Final = "delete window.VideoDecoder"
BROKEN: Final = "VideoDecoder.prototype.decode = () => { throw new Error('broken') }"
INSECURE: Final = "Object.defineProperty(window, 'isSecureContext', { value: false })"
#: Drops binary WebSocket messages while ``window.lose`` is above 0, and records sent messages.
LOSES: Final = """
window.lose = 0;
window.said = [];
window.WebSocket = class extends WebSocket {
  constructor(...given) {
    super(...given);
    this.addEventListener("message", (event) => {
      if (window.lose <= 0 || typeof event.data === "string") return;
      window.lose -= 1;
      event.stopImmediatePropagation();
    });
  }
  send(text) {
    window.said.push(text);
    super.send(text);
  }
};
"""
#: As over a slow line: half a second passes before the cockpit knows what was shown.
SLOW: Final = """
window.WebSocket = class extends WebSocket {
  send(text) {
    if (!text.includes('"ack"')) super.send(text);
    else setTimeout(() => this.readyState === WebSocket.OPEN && super.send(text), 500);
  }
};
"""
#: Some of them: all would take long to get here.
PIXELS: Final = """canvas => [...canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data]
  .filter((_, at) => at % 37 === 0)"""
ARDRONE: Final = re.compile(r"at udp (\d+), navdata udp (\d+), video \w+ (\d+), control tcp (\d+)")
WIDE: Final = {"width": 2200, "height": 1500}  #: a pane has room for a picture's full size
MOST_S: Final = 40.0  # on a busy machine pictures arrive late, and the test retries
FAR: Final = 12.0  # of 255, on average: two encodings of one picture are closer than that


@pytest.fixture(scope="module")
def open_cockpit(open_cockpit: tuple[Browser, str]) -> Iterator[tuple[Browser, str]]:
    """The cockpit, with one drone on the ground."""
    drone = Process("-m", "skyloop", "proxy", WATCHED, "--name", "film")
    try:
        drone.until("ready")
        yield open_cockpit
    finally:
        drone.end()


def form(page: DronePage) -> str:
    return page.attribute(".camera", "data-form")


def pixels(page: DronePage) -> list[int]:
    found: list[int] = page.pane.locator(".video").evaluate(PIXELS)
    return found


@pytest.mark.daily
def test_h264_is_decoded_and_drawn_as_the_jpeg_is(deck: Deck) -> None:
    page = deck.page("film")
    page.until(lambda: form(page).startswith("h264"), "H.264 is shown", MOST_S)
    page.wait_for_new_picture()
    rate = page.pane.locator(".chip.rate")
    page.until(lambda: "H.264" in (rate.text_content() or "") and "kB/s" in (rate.text_content() or ""), "it says so")
    assert (rate.get_attribute("title") or "").startswith("H.264")
    plain = deck.page("film", prepare=NO_DECODER)
    plain.until(lambda: form(plain) == "jpeg", "JPEGs are shown")
    assert "can't decode H.264" in plain.attribute(".chip.rate", "title")
    one, other = pixels(page), pixels(plain)
    assert len(one) == len(other) > 8000
    assert sum(abs(a - b) for a, b in zip(one, other, strict=True)) / len(one) < FAR
    assert max(one) > 0
    assert (page.problems, plain.problems) == ([], [])


def test_a_browser_that_fails_to_decode_gets_jpegs(deck: Deck) -> None:
    page = deck.page("film", prepare=BROKEN)
    page.until(lambda: "could not decode" in page.attribute(".chip.rate", "title"), "it gave up")
    assert form(page) == "jpeg"
    page.wait_for_new_picture()


def test_over_plain_http_the_page_says_why_and_what_to_do(deck: Deck) -> None:
    page = deck.page("film", prepare=INSECURE)
    page.until(lambda: form(page) == "jpeg", "JPEGs are shown")
    assert "only over https" in page.attribute(".chip.rate", "title")
    page.page.get_by_role("button", name="Settings").click()
    page.page.get_by_text("skyloop cockpit --https").wait_for()


def test_a_key_picture_is_requested_after_a_gap(deck: Deck) -> None:
    page = deck.page("film", prepare=LOSES)
    page.until(lambda: form(page).startswith("h264"), "H.264 is shown", MOST_S)
    page.wait_for_new_picture()
    page.page.evaluate("window.lose = 2")
    page.until(lambda: page.page.evaluate("window.said.includes('{\"key\":true}')"), "a key picture is asked for")
    page.wait_for_new_picture()
    page.wait_for_new_picture()
    assert form(page).startswith("h264")
    assert page.problems == []


def test_a_page_that_falls_behind_shows_why_its_picture_is_smaller(deck: Deck) -> None:
    """It fell to 160 × 120, without any explanation."""
    page = deck.page("film", prepare=SLOW)
    page.until(lambda: form(page) == "h264 own", "it has a stream of its own", MOST_S)
    told = page.pane.locator(".chip.smaller")
    page.until(lambda: told.is_visible(), "it says so")
    said = told.text_content() or ""
    assert said.startswith(("Smaller picture, ", "Coarser picture: "))
    # On a computer also busy with other tests, that is the reason.
    assert said.endswith(("this connection is slow", "this computer is busy", "reach the cockpit late"))


def test_tiles_show_h264_and_its_data_rate(deck: Deck) -> None:
    page = deck.overview()
    tile = page.page.locator('.tile[data-drone="film"]')
    page.until(lambda: (tile.get_attribute("data-form") or "").startswith("h264"), "H.264 is shown", MOST_S)
    title = tile.locator("canvas").get_attribute("title") or ""
    assert "kB/s" in title
    shown = int(tile.get_attribute("data-frames") or "0")
    page.until(lambda: int(tile.get_attribute("data-frames") or "0") >= shown + 10, "pictures go on")
    assert page.problems == []


@contextmanager
def emulated(kind: str) -> Iterator[str]:
    """Run emulated firmware; yield the address to fly it by."""
    options = ["-m", "skyloop", "sim", "--firmware", kind]
    if kind == "tello":
        addresses = Addresses.free()
        firmware = Process(*options, "--bind", addresses.drone)
        said, address = "commands udp", addresses.uri()
    else:
        firmware = Process(*options, "--port-base", "0")
        said, address = "control tcp", ""
    try:
        firmware.until(said)
        firmware.until("\n")
        if not address:
            ports = ARDRONE.search(firmware.text)
            assert ports is not None, firmware.text
            address = "ardrone://127.0.0.1?at_port={}&navdata_port={}&video_port={}&control_port={}".format(
                *ports.groups()
            )
        yield address
    finally:
        firmware.end()


@pytest.mark.parametrize("kind", ["ardrone2", "tello"])
def test_video_encoded_by_the_vehicle_is_shown_unchanged(deck: Deck, kind: str) -> None:
    """The proxy runs here, which shows that it encodes nothing."""
    with emulated(kind) as address:
        proxy = Proxy(make_driver(address), LocalServer(kind), name=kind)
        with proxy:
            page = deck.page(kind, viewport=WIDE)
            page.until(lambda: form(page) == "h264 vehicle", "the vehicle's own stream is shown", MOST_S)
            streams = proxy.publisher.streams
            for _ in range(3):
                page.wait_for_new_picture()
            assert form(page) == "h264 vehicle"
            rate = page.pane.locator(".chip.rate")
            page.until(lambda: "kB/s" in (rate.text_content() or ""), "it says how much")
            assert "from the vehicle" in (rate.get_attribute("title") or "")
            assert streams.known == (), "nothing is encoded, for whomever"
            assert max(pixels(page)) > 0
            assert page.problems == []


def test_a_stopped_page_harms_neither_the_pilot_nor_other_pages(open_cockpit: tuple[Browser, str], deck: Deck) -> None:
    browser, _ = open_cockpit
    session = browser.new_browser_cdp_session()

    def renderers() -> set[int]:
        processes = session.send("SystemInfo.getProcessInfo")["processInfo"]
        return {one["id"] for one in processes if one["type"] == "renderer"}

    live = deck.page("film")
    live.until(lambda: form(live).startswith("h264"), "H.264 is shown", MOST_S)
    others = renderers()
    frozen = deck.page("film")
    frozen.until(lambda: form(frozen).startswith("h264"), "H.264 is shown", MOST_S)
    frozen.wait_for_new_picture()
    for page in (live, frozen):
        page.page.wait_for_load_state("networkidle")
        page.problems.clear()  # on a busy machine the drone's first answers may be late
    with skyloop.connect("film", name="flies.py") as pilot:
        pilot.takeoff()
        with stopped(*(renderers() - others)):
            until_s, seen = time.monotonic() + 3.0, 0
            while time.monotonic() < until_s or seen < 10:
                pilot.velocity(yaw_rate=0.2)
                live.wait_for_new_picture()
                seen += 1
                live.until(lambda: live.attribute(".camera", "data-stale") == "false", "it is young")
                live.until(lambda: pilot.feedback().state is FlightState.FLYING, "it does as the pilot says")
        pilot.land()
    frozen.until(lambda: frozen.attribute(".camera", "data-stale") == "false", "it is live again")
    frozen.wait_for_new_picture()
    assert (live.problems, frozen.problems) == ([], [])


def test_late_drawings_are_shown_faded_or_explained(deck: Deck) -> None:
    """Drawings by a detector that takes half a second were never visible, without any explanation."""
    deck.proxy("slow")
    page = deck.page("slow")
    late_s = 0.6
    frames: list[Frame] = []
    with skyloop.connect("slow", access="observe", name="test") as drone:

        def draw(frame: Frame) -> None:
            frames.append(frame)
            while frames and drone.now_ns - frames[0].captured_ns > late_s * 1e9:
                old = frames.pop(0)
                drone.annotate(old, [Polyline(((40, 40), (200, 40), (200, 160)), closed=True)], source="detector")

        drone.on_frame(draw)
        page.until(lambda: "shown faded" in page.says(".drawn-late"), "it says that they are late")
        # Counted from the picture shown, which is itself some time old.
        assert re.search(r"detector draws 0\.[3-9] s late", page.says(".drawn-late"))
        overlay = page.pane.locator(".overlay").first
        page.until(lambda: 0 < overlay.evaluate(DRAWN_ON) < 200, "they are shown, pale")
        late_s = 1.6
        page.until(lambda: "not shown" in page.says(".drawn-late"), "it says why they are not")
        page.until(lambda: overlay.evaluate(DRAWN_ON) == 0, "things are elsewhere by then")
    page.until(lambda: page.says(".drawn-late") == "", "nothing is late any more")
    assert page.problems == []

"""The stop and landing buttons are on the screen: at every width and zoom, with long words, long names and alarms."""

from __future__ import annotations

from typing import Any

import pytest

import skyloop
from tests.cockpit.browser import Deck, DronePage

pytestmark = pytest.mark.process

FINGER_PX = 44.0
WIDTHS = (320, 390, 641, 768, 850, 947, 1024, 1440)
#: A window of 1440 × 900 pixels and a tablet's of 1024 × 768, enlarged to 200, 300 and 400 %: the remaining sizes.
ENLARGED = ((720, 450), (480, 300), (360, 225), (512, 384), (256, 192))
LONG_NAME = "a-drone-with-a-name-as-long-as-names-can-be-1234"
PSEUDO = "localStorage.setItem('skyloop-language', 'pseudo');"
#: Problems of the controls that stop and land: outside of the window, covered, or smaller than ``least`` pixels.
WRONG = """([drone, least]) => {
  const pane = document.querySelector(`.pane[data-drone="${CSS.escape(drone)}"]`);
  const [own, ...all] = document.querySelectorAll(".safety button");
  const [land, stop] = [pane?.querySelector(".strip .land"), pane?.querySelector(".strip .stop")];
  const wanted = [...all, ...(pane ? [land, stop?.checkVisibility() ? stop : own] : [])];
  if (own.checkVisibility() && !wanted.includes(own)) wanted.push(own);
  return wanted.flatMap((one) => {
    const seen = one?.checkVisibility({visibilityProperty: true, opacityProperty: true});
    if (!seen) return [`${one?.textContent}: not shown`];
    const box = one.getBoundingClientRect();
    const found = [];
    const [right, bottom] = [innerWidth + 0.5, innerHeight + 0.5];
    if (box.left < -0.5 || box.top < -0.5 || box.right > right || box.bottom > bottom) found.push("outside");
    if (box.width < least - 0.5 || box.height < least - 0.5) found.push("small");
    for (const [x, y] of [[0.5, 0.5], [0.12, 0.2], [0.88, 0.2], [0.12, 0.8], [0.88, 0.8]]) {
      const top = document.elementFromPoint(box.left + x * box.width, box.top + y * box.height);
      if (!one.contains(top)) found.push(`covered by ${top?.tagName}.${top?.className}`);
    }
    const place = [box.left, box.top, box.width, box.height].map(Math.round).join(" ");
    return found.length ? [`${one.textContent} at ${place}: ${[...new Set(found)].join(", ")}`] : [];
  });
}"""
TO = """([name, block]) =>
  document.querySelector(`.pane[data-drone="${CSS.escape(name)}"]`).scrollIntoView({block})"""
DRAWN = "() => new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))"
WIDER = "document.documentElement.scrollWidth - innerWidth"


def wrong(page: DronePage, drone: str, least: float = 24.0) -> Any:
    return page.page.evaluate(WRONG, [drone, least])


def resize(page: DronePage, width: int, height: int) -> None:
    page.page.set_viewport_size({"width": width, "height": height})
    page.page.evaluate(DRAWN)


def sweep(page: DronePage, drones: tuple[str, ...], least: float = 24.0) -> str:
    """Return the problems at each size, with the open content scrolled to the top, middle and end."""
    found = []
    for width, height in [*((width, 860) for width in WIDTHS), *ENLARGED]:
        resize(page, width, height)
        for drone in drones or ("",):
            for block in ("start", "end") if drone else ("",):
                if drone:
                    page.page.evaluate(TO, [drone, block])
                    page.page.evaluate(DRAWN)
                said = wrong(page, drone, least)
                found += [f"{width}×{height} {drone} {block}: {one}" for one in said]
        if page.page.evaluate(WIDER) > 0:
            found.append(f"{width}×{height}: {page.page.evaluate(WIDER)} px beside the window")
    return "\n".join(found)


@pytest.mark.parametrize("panels", [False, True], ids=["picture", "panels"])
def test_one_drone(deck: Deck, panels: bool) -> None:
    deck.proxy("one")
    page = deck.page("one", panels=panels)
    page.take_control()
    assert sweep(page, ("one",)) == ""


def test_a_finger_a_long_name_and_alarms(deck: Deck) -> None:
    deck.proxy(LONG_NAME)
    page = deck.page(LONG_NAME, prepare=PSEUDO, panels=False, has_touch=True, viewport={"width": 1280, "height": 860})
    with skyloop.connect(LONG_NAME, name="an-application-with-a-long-name-too") as drone:
        drone.config["battery.warn"] = 1.0
        page.until(lambda: page.pane.locator(".alarm").count() > 0, "an alarm")
        assert sweep(page, (LONG_NAME,), FINGER_PX) == ""


def test_two_drones_and_all_of_them(deck: Deck) -> None:
    for name in ("left", "right"):
        deck.proxy(name)
    page = deck.page("left", "right")
    assert sweep(page, ("left", "right")) == ""
    all_of_them = deck.overview(has_touch=True)
    all_of_them.page.locator(".safety .own").wait_for(state="attached")
    assert sweep(all_of_them, (), FINGER_PX) == ""


def share(page: DronePage, selector: str) -> float:
    """Return how much of the window a part of the pane has."""
    found, size = page.pane.locator(selector).first.bounding_box(), page.page.viewport_size
    assert found is not None
    assert size is not None
    return float(found["width"] * found["height"] / (size["width"] * size["height"]))


def test_the_picture_is_first_and_the_panels_are_a_press_away(deck: Deck) -> None:
    deck.own_cockpit()  # without cards of other tests' drones above the picture
    deck.proxy("first")
    page = deck.page("first", panels=False, viewport={"width": 1440, "height": 900})
    assert share(page, ".pictures") > 0.6
    assert 0.01 < share(page, ".map-box") < 0.1, "the map is an inset"
    assert not page.pane.locator(".deck.lists").is_visible()
    page.pane.get_by_role("button", name="Enlarge the map").click()
    assert share(page, ".map-box") > 0.5
    page.pane.get_by_role("button", name="Enlarge the picture").click()
    assert share(page, ".pictures") > 0.6
    page.pane.get_by_role("button", name="Panels").click()
    page.pane.locator(".deck.lists").wait_for()
    page.page.reload()
    page.pane.locator(".deck.lists").wait_for()
    assert share(page, ".pictures") < 0.5, "it is remembered"
    assert page.problems == []


#: Fields and buttons of the route's table that are cut, or lie beside their place.
CUT = """() => {
  const place = document.querySelector(".route-body").getBoundingClientRect();
  return [...document.querySelectorAll(".route-table :is(input, button)")].filter((one) => {
    const box = one.getBoundingClientRect();
    const cut = one.scrollWidth > one.clientWidth + 2;
    return cut || box.width < 12 || box.left < place.left || box.right > Math.min(place.right, innerWidth);
  }).map((one) => one.getAttribute("aria-label"));
}"""


def test_a_route_fits_from_320_pixels_on(deck: Deck) -> None:
    deck.proxy("route")
    page = deck.page("route")
    page.pane.get_by_role("button", name="Route", exact=True).click()
    page.pane.locator(".map").focus()
    page.press("ArrowRight", "Enter", "ArrowUp", "ArrowUp", "ArrowUp", "Enter")
    page.until(lambda: page.pane.locator(".route-table input[data-field=x]").count() == 2, "two waypoints")
    for width in (320, 640, 768, 1024, 1280, 1440):
        resize(page, width, 900)
        assert page.page.evaluate(CUT) == [], width


#: The parts of a pane below its line of alarms.
COVERED = """() => [...document.querySelectorAll(".pane :is(button, h2, .pill, .chip)")].filter((one) => {
  const box = one.getBoundingClientRect();
  if (!one.checkVisibility({visibilityProperty: true}) || box.top < 0 || box.bottom > innerHeight) return false;
  const line = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2)?.closest(".said");
  return line && !line.contains(one);
}).map((one) => one.textContent)"""


def test_an_alarm_covers_nothing(deck: Deck) -> None:
    deck.proxy("warned")
    page = deck.page("warned", panels=False)
    with skyloop.connect("warned", name="test") as drone:
        # Late data on a busy machine changes the lines of text, and with them the measurements.
        page.wait_for_text(".now", "test has control")
        page.wait_for_new_picture()
        page.page.evaluate(DRAWN)
        before = page.pane.locator(".stage").bounding_box()
        drone.config["battery.warn"] = 1.0
        page.wait_for_text(".alarms", "battery low")
        assert page.page.evaluate(COVERED) == []
        assert page.pane.locator(".stage").bounding_box() == before, "and moves nothing"


#: Parts of parameters' names that are broken within a word, or lie beside their place.
BROKEN_NAMES = """() => [...document.querySelectorAll(".parameter")].flatMap((row) => {
  if (!row.checkVisibility()) return [];
  const name = row.querySelector(".about b");
  const lines = (part) => {
    const range = document.createRange();
    range.selectNodeContents(part);
    return range.getClientRects().length;
  };
  const broken = [...name.childNodes].filter((part) => part.nodeType === Node.TEXT_NODE && lines(part) > 1);
  const right = (one) => one.getBoundingClientRect().right;
  const beside = [name, ...row.querySelectorAll(".edit > *")].some((one) => right(one) > right(row) + 1);
  return broken.length || beside ? [`${row.dataset.parameter}${beside ? " is cut" : ""}`] : [];
})"""


def test_names_of_parameters_break_only_between_their_words(deck: Deck) -> None:
    deck.proxy("named")
    page = deck.page("named")
    page.pane.get_by_role("button", name="Parameters").click()
    page.pane.locator('[data-parameter="limits.speed"]').wait_for()
    found = []
    for width in WIDTHS:
        resize(page, width, 860)
        found += [f"{width}: {name}" for name in page.page.evaluate(BROKEN_NAMES)]
    assert found == []


#: Which controls, pictures and maps lie elsewhere while a banner is shown, and when it is not.
MOVED = """(selectors) => selectors.flatMap((selector) => {
  const boxes = () => [...document.querySelectorAll("button, input, select, a, .pill, .tile, .map, .video")]
    .filter((one) => one.checkVisibility({visibilityProperty: true}) && !one.closest(".said, .page-said, .alarm-chip"))
    .map((one) => {
      const {left, top, width, height} = one.getBoundingClientRect();
      return `${one.getAttribute("aria-label") ?? one.textContent}: ${[left, top, width, height].map(Math.round)}`;
    });
  const banner = document.querySelector(selector);
  const [hidden, text] = [banner.hidden, banner.textContent];
  banner.hidden = false;
  if (!text) banner.textContent = "2 alarms";
  const shown = boxes();
  banner.hidden = true;
  const without = boxes();
  banner.hidden = hidden;
  if (!text) banner.textContent = "";
  return shown.filter((one) => !without.includes(one)).map((one) => `${selector}: ${one}`);
})"""


def moved(page: DronePage, *banners: str) -> str:
    """Return what a banner moves, at each width, at the top of the page and further down."""
    found = []
    for width in WIDTHS:
        resize(page, width, 860)
        for down in (0, 150):
            page.page.evaluate(f"scrollTo(0, {down})")
            page.page.evaluate(DRAWN)
            found += [f"{width} {one}" for one in page.page.evaluate(MOVED, banners)]
    return "\n".join(found)


def landed(page: DronePage) -> None:
    """Order all drones to land, with the message at its usual place."""
    button = page.page.locator(".safety .land-all")
    page.until(lambda: not button.is_disabled(), "there is a drone")
    button.hover()
    page.page.mouse.down()
    page.until(lambda: "Land all ·" in (page.page.locator(".safety-message").text_content() or ""), "the outcome")
    page.page.mouse.up()


#: Drops the list of drones while ``window.deaf`` is true.
DEAF = """
window.WebSocket = class extends WebSocket {
  constructor(...given) {
    super(...given);
    this.addEventListener("message", (event) => window.deaf && event.stopImmediatePropagation());
  }
};
"""


def test_messages_about_one_or_all_drones_move_nothing(deck: Deck) -> None:
    for name in ("told", "beside"):
        deck.proxy(name)
    page = deck.page("told", panels=False)
    landed(page)
    assert page.page.locator(".said .safety-message").is_visible()
    page.page.locator(".card").nth(1).wait_for()
    assert moved(page, ".safety-message", ".alarms", ".alarm-chip", ".notice", ".card-alarm") == ""


def test_messages_above_all_drones_move_nothing(deck: Deck) -> None:
    deck.proxy("listed")
    page = deck.overview(DEAF)
    landed(page)
    assert page.page.locator(".overview-head .safety-message").is_visible()
    assert moved(page, ".safety-message") == ""
    page.page.evaluate("window.deaf = true")
    page.page.locator(".lost").wait_for()
    assert moved(page, ".lost") == ""

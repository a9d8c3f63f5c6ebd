"""An accessible page: axe-core finds no fault in it, and keys reach everything a mouse does."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pytest

from tests.cockpit.browser import Deck

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

RULES: dict[Literal["dark", "light"], str] = {"dark": "{}", "light": "{runOnly: ['color-contrast']}"}
AXE = Path(__file__).parents[2] / "cockpit-page/node_modules/axe-core/axe.min.js"

pytestmark = pytest.mark.process


def faults(page: Page) -> list[str]:
    """Return axe-core's findings, one per line: theme, rule, element, problem."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(AXE.read_text())
    lines: list[str] = []
    for scheme, rules in RULES.items():
        page.emulate_media(color_scheme=scheme)
        found: list[dict[str, Any]] = page.evaluate(f"axe.run({rules}).then((all) => all.violations)")
        for rule in found:
            for node in rule["nodes"]:
                wrong = node["failureSummary"].splitlines()[1].strip()
                lines.append(f"{scheme}: {rule['id']}: {node['html'][:160]}: {wrong}")
    return lines


@pytest.mark.timeout(240)  # a busy machine takes seconds for each look
@pytest.mark.skipif(not AXE.exists(), reason="no axe-core here (npm ci in cockpit-page)")
def test_axe_finds_no_fault(deck: Deck, open_cockpit: tuple[Browser, str], tmp_path: Path) -> None:
    deck.proxy("alpha")
    deck.proxy("beta")
    page = deck.page("alpha", reduced_motion="reduce")
    found: dict[str, list[str]] = {}
    page.wait_for_new_picture()
    page.take_off()
    found["one drone"] = faults(page.page)
    page.begin_to_mark(lambda: page.press("f"))
    page.press("ArrowUp", "Shift+ArrowRight")
    page.pane.locator(".follow-box").wait_for()
    found["marking a target"] = faults(page.page)
    page.press("Enter")
    page.pane.get_by_role("region", name="Target").wait_for()
    found["a target"] = faults(page.page)
    page.press("Escape")
    page.until(lambda: not page.pane.locator(".follow-panel").is_visible(), "it is forgotten")
    for name in ("Controls", "Parameters"):
        page.pane.get_by_role("button", name=name).dispatch_event("click")  # whatever banner lies over it
    page.pane.locator('.deck [data-parameter="limits.speed"]').wait_for()
    found["parameters"] = faults(page.page)
    map_box = page.pane.locator("canvas.map").bounding_box()
    assert map_box is not None
    page.pane.get_by_role("button", name="Route", exact=True).dispatch_event("click")
    page.page.mouse.click(map_box["x"] + map_box["width"] / 3, map_box["y"] + map_box["height"] / 3)
    page.pane.locator(".route-table tbody tr").wait_for()
    found["route"] = faults(page.page)
    page.pane.get_by_role("button", name="Zones", exact=True).dispatch_event("click")
    page.pane.get_by_label("Zone", exact=True).wait_for()
    found["zones"] = faults(page.page)
    page.press("?")
    found["keys"] = faults(page.page)
    page.page.get_by_role("button", name="Map the gamepad").click()
    found["gamepad"] = faults(page.page)
    page.press("Escape")
    page.page.get_by_role("button", name="Settings").click()
    found["settings"] = faults(page.page)
    page.press("Escape")
    page.page.set_viewport_size({"width": 390, "height": 844})
    found["phone"] = faults(page.page)
    page.pane.get_by_role("button", name="Flight mode").click()
    found["flight mode"] = faults(page.page)
    page.press("Escape")
    page.page.set_viewport_size({"width": 1280, "height": 860})
    page.page.get_by_role("button", name="All drones", exact=True).click()
    page.page.locator(".tile").nth(1).wait_for()
    page.page.get_by_role("button", name="Record", exact=True).click()
    page.page.get_by_role("button", name="Stop recording").click()
    page.page.get_by_role("button", name="More about").click()
    page.page.get_by_role("button", name="Delete ").click()
    found["all drones"] = faults(page.page)
    tokens = tmp_path / "tokens"
    tokens.write_text("pilot 0123456789abcdefP ann\n")
    tokens.chmod(0o600)
    browser, _ = open_cockpit
    with browser.new_context() as context:
        login = context.new_page()
        login.goto(deck.cockpit("--token-file", str(tokens), "--recordings", str(tmp_path)))
        login.get_by_label("Token").wait_for()
        found["login"] = faults(login)
    assert {where: what for where, what in found.items() if what} == {}
    assert page.problems == []


INTERACTIVE = "a[href], button, input, select, textarea, summary, [tabindex='0']"
AROUND = """() => {
  const element = document.activeElement;
  if (element === document.body) return false; // on the way around, or what had the focus was disabled
  if ("reached" in element.dataset) return true;
  const outlined = ({ outlineStyle, outlineWidth }) => outlineStyle !== "none" && parseFloat(outlineWidth) >= 1;
  // Some show it by their frame.
  element.dataset.reached = String([element, element.parentElement].map((one) => getComputedStyle(one)).some(outlined));
  return false;
}"""
MISSED = f"""() => [...document.querySelectorAll("body *")].filter((element) => {{
  if (!element.checkVisibility() || element.disabled) return false;
  if (element.matches("{INTERACTIVE}")) return element.dataset.reached !== "true";
  // What looks as if it could be pressed lies in something that can be focused.
  return getComputedStyle(element).cursor === "pointer" && !element.closest("label, {INTERACTIVE}");
}}).map((element) => `${{element.dataset.reached ?? "not reached"}}: ${{element.outerHTML.slice(0, 120)}}`)"""


def missed(page: Page) -> list[str]:
    """Return elements that the Tab key misses, or reaches without showing it."""
    page.evaluate("document.activeElement.blur()")
    page.evaluate("for (const one of document.querySelectorAll('[data-reached]')) delete one.dataset.reached")
    for _ in range(300):
        page.keyboard.press("Tab")
        if page.evaluate(AROUND):
            break
    found: list[str] = page.evaluate(MISSED)
    return found


def test_keys_reach_everything_and_show_where_they_are(deck: Deck) -> None:
    deck.proxy("tabs")
    deck.proxy("others")
    page = deck.page("tabs")
    page.take_control()
    page.pane.get_by_role("button", name="Parameters").dispatch_event("click")
    page.pane.locator('.deck [data-parameter="limits.speed"]').wait_for()
    assert missed(page.page) == []
    page.page.get_by_role("button", name="All drones", exact=True).click()
    page.page.locator(".tile").nth(1).wait_for()
    assert missed(page.page) == []
    page.press("?")
    page.page.get_by_role("button", name="Map the gamepad").wait_for()
    page.press("Tab")
    assert page.page.evaluate("document.activeElement.closest('dialog') !== null")
    assert page.problems == []

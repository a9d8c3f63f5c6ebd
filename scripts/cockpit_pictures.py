"""Photograph the cockpit: ``python scripts/cockpit_pictures.py``, or with ``one``, ``fleet``, ``swarm``,
``asked``, ``phone``, ``target`` or ``film`` for a part.

=======================================  ===========================================================================
``cockpit-one-dark.png``, ``…-light``    one simulated drone that follows a marker, with what its controller draws; once
                                         as the page opens it, once with the panels: the 3-D view and the parameters
``cockpit-fleet-dark.png``, ``…-phone``  all drones: six in one world, four of them on rounds
``cockpit-swarm-dark.png``, ``…-light``  three in one world, each on a round of waypoints that its controller logs
``cockpit-phone-dark.png``, ``…-light``  the first one again, on a telephone
``cockpit-flight-portrait.png``,         the flight mode of a telephone, upright and on its side
``cockpit-flight-landscape.png``
``cockpit-asked-dark.png``, ``…-phone``  a program asks for the drone that the page flies
``cockpit-target-dark.png``,             a person in a park who was detected, pressed and is followed; on a telephone
``cockpit-target-phone.png``             pressed with a finger, before anything flies
``cockpit-follow.webp``                  a film: a box drawn around a person in a park, and the flight after it
=======================================  ===========================================================================

Needs Chromium and ``pip install playwright pillow``.
"""

from __future__ import annotations

import io
import itertools
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal

import browser
from follow_truth import FrameTruth, TargetTruth
from page_film import PageFilm, Shown
from PIL import Image
from playwright.sync_api import Browser, Page, ViewportSize, sync_playwright

import skyloop
from skyloop.clock import nanoseconds
from skyloop.cockpit.child import CockpitProcess
from skyloop.control.follow import FollowMarker
from skyloop.control.waypoint import Waypoint, reached, velocity_to
from skyloop.messages import Annotation, Polyline, Text
from skyloop.sim import load_world

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
MARKER_ID = 7
DESK: ViewportSize = {"width": 1440, "height": 900}
WALL: ViewportSize = {"width": 1680, "height": 1020}
CINEMA: ViewportSize = {"width": 720, "height": 540}
PHONE: ViewportSize = {"width": 390, "height": 844}
PHONE_ON_ITS_SIDE: ViewportSize = {"width": 844, "height": 390}
TOUCHED = (PHONE, PHONE_ON_ITS_SIDE)
MOST_BYTES = 300_000
FILM_BYTES = 700_000
SIMULATED = (320, 240)  # pixels of the simulator's camera
MARGIN_PX = 2.0  # of a box drawn by hand, in these pixels
FIRST_PLACE, LAST_PLACE = (520.0, 440.0), (650.0, 340.0)  # of the mouse in the film, before and after
ROUND_M = 1.1
Scheme = Literal["dark", "light"]
SCHEMES: tuple[Scheme, ...] = ("dark", "light")
#: The page's meaningful colours, as six hexadecimal digits each.
INKS = """() => {
  const names = ["accent", "ok", "warn", "bad", "stop", "target", "series-1", "series-2"];
  const own = names.map((name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  const onPictures = ["#3fcf83", "#f2b14a", "#ffd23f", "#ffffff", "#24c24a", "#ff9800"];
  return [...own, ...onPictures].map((ink) => ink.slice(1));
}"""
Fly = Callable[[threading.Event], None]


def main() -> None:
    makers = {each.__name__: each for each in (one, fleet, swarm, asked, phone, target, film)}
    wanted = sys.argv[1:] or list(makers)
    for name in wanted:
        if name not in makers:
            sys.exit(f"there is no picture {name!r}: choose from {', '.join(makers)}")
        makers[name]()


# Scenes --------------------------------------------------------------------------------------------------------------


def one() -> None:
    """A marker is followed; the page at a desk and on a telephone."""

    def follow(stop: threading.Event) -> None:
        with skyloop.connect("alpha", name="follow.py") as drone:
            drone.takeoff()
            FollowMarker(drone, MARKER_ID).run(seconds=120.0, until=stop.is_set)
            drone.land(wait=False)

    command = ["sim", "--name", "alpha", "--seed", "4"]
    command += [word for option in ("width=640", "fps=15") for word in ("--option", option)]
    with flight(command, [follow]) as (chromium, address):
        for scheme in SCHEMES:
            page = open_page(chromium, f"{address}#alpha", DESK, scheme)
            if scheme == "light":
                page.get_by_role("button", name="Panels").click()
                page.get_by_role("button", name="3-D").click()
                page.get_by_role("button", name="Parameters").click()
            settle(page, ["alpha"], 16.0)
            save(page, f"cockpit-one-{scheme}.png")
        for scheme in SCHEMES:
            page = open_page(chromium, f"{address}#alpha", PHONE, scheme)
            page.get_by_role("button", name="Leave flight mode").tap()
            settle(page, ["alpha"], 5.0)
            save(page, f"cockpit-phone-{scheme}.png")


def swarm() -> None:
    """Three drones on separate rounds."""
    names = [f"d{number}" for number in (1, 2, 3)]
    command = ["sim", "--drones", "3", "--name", "d", "--seed", "1"]
    # Small pictures: three renderers and a browser share this machine.
    command += [word for option in ("width=320", "fps=10") for word in ("--option", option)]
    fliers = [rounds(name, number) for number, name in enumerate(names)]
    with flight(command, fliers) as (chromium, address):
        for scheme in SCHEMES:
            page = open_page(chromium, f"{address}#{','.join(names)}", WALL, scheme)
            settle(page, names, 12.0)
            save(page, f"cockpit-swarm-{scheme}.png")


def fleet() -> None:
    """All drones at once, at a desk and on a telephone."""
    names = [f"d{number}" for number in range(1, 7)]
    command = ["sim", "--drones", str(len(names)), "--name", "d", "--seed", "1", "--option", "fps=10"]
    with flight(command, [rounds(name, number) for number, name in enumerate(names[:4])]) as (chromium, address):
        views: list[tuple[str, ViewportSize, Scheme]] = [("dark", DESK, "dark"), ("phone", PHONE, "light")]
        for name, size, scheme in views:
            page = open_page(chromium, f"{address}#/", size, scheme)
            for drone in names[:4]:
                page.locator(f'.tile[data-drone="{drone}"] .tile-state', has_text="flying").wait_for(timeout=90_000)
            page.wait_for_timeout(12_000)
            save(page, f"cockpit-fleet-{name}.png")


def asked() -> None:
    """A person flies, and a program asks for the drone."""
    command = ["sim", "--name", "alpha", "--seed", "4"]
    command += [word for option in ("width=640", "fps=15") for word in ("--option", option)]
    with flight(command, []) as (chromium, address):
        views: list[tuple[str, ViewportSize, Scheme]] = [("dark", DESK, "dark"), ("phone", PHONE, "light")]
        for name, size, scheme in views:
            page = open_page(chromium, f"{address}#alpha", size, scheme)
            page.get_by_role("button", name="Take control").click()
            page.locator('.pane[data-mine="true"]').wait_for()
            page.keyboard.press("t")
            page.locator(".pill", has_text="hovering").wait_for()
            with skyloop.connect(
                "alpha", name="survey.py", authority=skyloop.Authority(priority=4, takeover="ask", for_s=600, stay=True)
            ):
                page.locator(".asks button.primary:enabled").wait_for()
                page.locator(".camera[data-seq]").first.wait_for()
                page.wait_for_timeout(1500)
                save(page, f"cockpit-asked-{name}.png")


def phone() -> None:
    """A person flies by touch."""
    command = ["sim", "--name", "alpha", "--seed", "4"]
    command += [word for option in ("width=640", "fps=15") for word in ("--option", option)]
    with flight(command, []) as (chromium, address):
        for name, size in (("portrait", PHONE), ("landscape", PHONE_ON_ITS_SIDE)):
            page = open_page(chromium, f"{address}#alpha", size, "dark")
            page.get_by_role("button", name="Take control").tap()
            page.locator('.pane[data-mine="true"]').wait_for()
            page.get_by_role("button", name="Take off").tap()
            page.locator(".pill", has_text="hovering").wait_for()
            page.locator(".camera[data-seq]").first.wait_for()
            page.wait_for_timeout(9500)  # until the first alarms of a loaded machine are over
            stick = page.locator(".thumb").nth(1).bounding_box()
            assert stick is not None
            x, y = stick["x"] + stick["width"] / 2, stick["y"] + stick["height"] / 2
            session = page.context.new_cdp_session(page)
            for kind, place in (("touchStart", (x, y)), ("touchMove", (x + 14, y - 26))):
                point = {"x": place[0], "y": place[1]}
                session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [point]})
            page.locator(".pill", has_text="flying").wait_for()
            page.wait_for_timeout(700)
            save(page, f"cockpit-flight-{name}.png")
            session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def target() -> None:
    """A person in a park is marked on the picture, and followed."""
    command = ["sim", "--name", "alpha", "--world", "park", "--seed", "4"]
    command += [
        word for option in ("cameras=front", "width=320", "fps=12", "battery=0.95") for word in ("--option", option)
    ]
    found: list[Annotation] = []
    with (
        flight(command, [lambda _: None]) as (chromium, address),  # waits until it has taken off
        skyloop.connect("alpha", access="observe", name="pictures") as drone,
    ):
        drone.on_annotation(lambda one: found.append(one) if one.source == "detections" and one.shapes else None)
        with detecting():
            views: list[tuple[str, ViewportSize]] = [("phone", PHONE), ("dark", DESK)]
            for name, size in views:
                page = open_page(chromium, f"{address}#alpha", size, "dark")
                touch = size == PHONE
                take = page.get_by_role("button", name="Take control")
                take.tap() if touch else take.click()
                page.locator('.pane[data-mine="true"]').wait_for()
                page.keyboard.press("t")
                page.locator(".pill", has_text="hovering").wait_for()
                page.keyboard.press("f")
                page.locator(".follow-hint", has_text="Drag a box").wait_for()
                while not page.locator(".follow-panel").is_visible():
                    page.wait_for_timeout(150)
                    if found:
                        mark(page, found[-1], touch=touch)
                page.locator(".follow-phase", has_text="Tracking").wait_for()
                page.wait_for_timeout(800)
                page.locator(".follow-figures", has_text="%").wait_for()
                if not touch:
                    page.keyboard.press("Enter")
                    page.wait_for_timeout(12_000)  # until the drone is near
                    # Not while a loaded machine makes it hover, nor behind a tree.
                    page.locator('.follow-panel[data-tone="busy"] .follow-figures', has_text="%").wait_for()
                save(page, f"cockpit-target-{name}.png")
                page.keyboard.press("l")
                page.locator(".pill", has_text="landed").wait_for()


def film() -> None:
    """A box drawn by hand around a person in a park; the drone follows, circles and leaves them.

    The simulator's truth gives the place of the box; the drone's true distance is printed.
    """
    command = ["sim", "--name", "alpha", "--world", "park", "--seed", "4"]
    command += [word for option in ("cameras=front", "width=320", "fps=15") for word in ("--option", option)]
    truth = TargetTruth(load_world("park", 4))
    away_m: list[float] = []
    with (
        flight(command, [lambda _: None]) as (chromium, address),
        skyloop.connect("alpha", access="observe", name="pictures") as drone,
        detecting(),
    ):

        def now(in_s: float = 0.0) -> FrameTruth:
            """Return the truth of the picture on the screen, now or soon."""
            true = truth.at_capture(drone.feedback(), shown.captured_ns + nanoseconds(in_s))
            assert true is not None
            return true

        page = open_page(chromium, f"{address}#alpha", CINEMA, "dark")
        shown = Shown(page)
        page.reload()
        page.get_by_role("button", name="Take control").click()
        page.locator('.pane[data-mine="true"]').wait_for()
        page.keyboard.press("t")
        page.locator(".pill", has_text="hovering").wait_for()
        page.locator('[data-tool="full"]').click()
        page.mouse.move(*FIRST_PLACE)
        taken = PageFilm(page, lambda: away_m.append(now().distances_m["walker"]))
        while not is_well_seen(now(in_s=1.2)):
            page.wait_for_timeout(50)
        taken.begin(*FIRST_PLACE)
        taken.shoot(0.2)
        taken.click(page.locator('[data-tool="follow"]'))
        taken.shoot_until(page.locator(".follow-hint", has_text="Drag a box"))
        taken.move(*corner(page, now(in_s=0.6), upper=True))
        shown.wait_for_next()
        pressed = now()
        page.mouse.move(*corner(page, pressed, upper=True))
        page.mouse.down()
        taken.move(*corner(page, pressed, upper=False), seconds=0.8)
        page.mouse.up()
        taken.shoot_until(page.locator(".follow-phase", has_text="Tracking"))
        panel = page.get_by_role("region", name="Target")
        taken.click(panel.get_by_role("button", name="Follow"))
        taken.move(*LAST_PLACE)
        taken.shoot(6.5)
        since = len(away_m)
        taken.click(panel.get_by_role("button", name="Orbit"))
        taken.shoot(4.5)
        print(f"truly {min(away_m[since:]):.1f} to {max(away_m[since:]):.1f} m away, from {away_m[0]:.1f} m at first")
        taken.click(panel.get_by_role("button", name="Stop"))
        taken.shoot(1.0)
    taken.save(PICTURES / "cockpit-follow.webp", FILM_BYTES)


def is_well_seen(true: FrameTruth) -> bool:
    """Return whether the walker is completely in the picture, near, and not close to its left edge."""
    box = true.boxes.get("walker")
    return box is not None and not box.cut and box.visible > 0.98 and 180 < box.box[0] < 275 and box.box[3] > 60


def corner(page: Page, true: FrameTruth, *, upper: bool) -> tuple[float, float]:
    """Return the upper left or lower right corner of a box around the walker on the screen [CSS pixels]."""
    x, y, width, height = true.boxes["walker"].box
    if upper:
        return on_screen(page, (x - MARGIN_PX, y - MARGIN_PX), SIMULATED)
    return on_screen(page, (x + width + MARGIN_PX, y + height + MARGIN_PX), SIMULATED)


def on_screen(page: Page, pixel: tuple[float, float], size: tuple[float, float]) -> tuple[float, float]:
    """Return the place of a pixel of the drone's picture on the screen [CSS pixels]."""
    picture = page.locator(".video").bounding_box()
    assert picture is not None
    scale = min(picture["width"] / size[0], picture["height"] / size[1])
    x = picture["x"] + picture["width"] / 2 + (pixel[0] - size[0] / 2) * scale
    return x, picture["y"] + picture["height"] / 2 + (pixel[1] - size[1] / 2) * scale


def mark(page: Page, found: Annotation, *, touch: bool) -> None:
    """Press the centre of the largest detected person; on a touch screen with a finger."""
    people = [
        outline
        for outline, text in itertools.pairwise(found.shapes)
        if isinstance(outline, Polyline) and isinstance(text, Text) and text.text.startswith("person")
        if outline.points[2][1] - outline.points[0][1] > found.height / 5  # others are too far for a picture
    ]
    if not people:
        return
    points = max((one.points for one in people), key=lambda corners: corners[2][1] - corners[0][1])
    across, down = (sum(values) / 4 for values in zip(*points, strict=True))
    x, y = on_screen(page, (across, down), (found.width, found.height))
    if touch:
        page.touchscreen.tap(x, y)
    else:
        page.mouse.click(x, y)


def rounds(name: str, number: int) -> Fly:
    """Fly a triangle around the place of take-off, at a separate height; its corners are logged for viewers."""

    def fly(stop: threading.Event) -> None:
        with skyloop.connect(name, name=f"rounds.py {number + 1}") as drone:
            drone.takeoff()
            x, y, _ = drone.feedback().position_m or (0.0, 0.0, 0.0)
            turns = [2 * math.pi * (corner / 3 + number / 9) for corner in range(3)]
            corners = [
                (x + ROUND_M * math.cos(turn), y + 0.5 * ROUND_M * math.sin(turn), 1.0 + 0.25 * number)
                for turn in turns
            ]
            corner = 0
            while not stop.wait(0.05):
                goal = Waypoint(*corners[corner % 3])
                feedback = drone.feedback()
                drone.log.array("waypoints", corners)
                drone.log.number("distance_m", math.dist(goal.position, feedback.position_m or goal.position))
                if reached(goal, feedback):
                    corner += 1
                drone.command(velocity_to(goal, feedback))
            drone.land(wait=False)

    return fly


@contextmanager
def detecting() -> Iterator[None]:
    """Run a processor that detects people."""
    command = [sys.executable, "-m", "skyloop", "detect", "--on", "alpha"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.terminate()


# Photographing --------------------------------------------------------------------------------------------------------


@contextmanager
def flight(command: list[str], fliers: list[Fly]) -> Iterator[tuple[Browser, str]]:
    """Run a world, its controllers, the cockpit and Chromium."""
    chromium = browser.find()
    if chromium is None:
        sys.exit("there is no Chromium here (Debian: apt install chromium)")
    stop = threading.Event()
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="skyloop-"))
        os.environ["SKYLOOP_RUNTIME_DIR"] = f"{folder}/run"
        world = stack.enter_context(
            subprocess.Popen([sys.executable, "-m", "skyloop", *command], stdout=subprocess.PIPE)
        )
        stack.callback(world.terminate)
        assert world.stdout is not None
        for _ in fliers:
            world.stdout.readline()  # reports that it is ready
        cockpit = stack.enter_context(CockpitProcess(recordings=Path(folder) / "recordings"))
        threads = [threading.Thread(target=fly, args=(stop,)) for fly in fliers]
        for thread in threads:
            stack.callback(thread.join)
        stack.callback(stop.set)
        for thread in threads:
            thread.start()
        playwright = stack.enter_context(sync_playwright())
        arguments = ["--enable-unsafe-swiftshader"] + (["--no-sandbox"] if os.geteuid() == 0 else [])
        opened = playwright.chromium.launch(executable_path=chromium, args=arguments)
        stack.callback(opened.close)
        yield opened, cockpit.address()


def open_page(chromium: Browser, address: str, size: ViewportSize, scheme: Scheme) -> Page:
    for context in chromium.contexts:
        context.close()
    context = chromium.new_context(
        viewport=size, color_scheme=scheme, has_touch=size in TOUCHED, is_mobile=size in TOUCHED
    )
    page = context.new_page()
    page.goto(address)
    return page


def settle(page: Page, names: list[str], seconds: float) -> None:
    """Wait until all are in the air, and then until plots and paths have something to show."""
    for name in names:
        page.locator(f'.pane[data-drone="{name}"] .pill', has_text="flying").wait_for(timeout=60_000)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        page.wait_for_timeout(100)


def save(page: Page, name: str) -> None:
    """Write a PNG of 256 colours; one too large for a page of documentation is an error."""
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    target = PICTURES / name
    PICTURES.mkdir(parents=True, exist_ok=True)
    # Lamps and lines have few pixels but meaningful colours: keep them unchanged.
    kept = [part for ink in page.evaluate(INKS) for part in bytes.fromhex(ink)]
    common = picture.quantize(256 - len(kept) // 3, dither=Image.Dither.NONE).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette(common[: 768 - len(kept)] + kept)
    picture.quantize(palette=palette, dither=Image.Dither.NONE).save(target, optimize=True)
    print(f"{name}: {picture.width}×{picture.height}, {target.stat().st_size:,} bytes")
    if target.stat().st_size > MOST_BYTES:
        sys.exit(f"{name} is larger than {MOST_BYTES:,} bytes")


if __name__ == "__main__":
    main()

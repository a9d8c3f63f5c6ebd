"""Measure the cockpit's video of many drones: frame rate and age in each pane, bytes, and the cost of each part.

``python -m benchmarks.cockpit_fleet --drones 12 --seconds 20`` starts the simulator, a cockpit and headless Chromium on
this machine, with a separate directory of sockets. It shows all drones as H.264, then as JPEGs, as for a browser
without a decoder; then one drone's pane in both. It needs Chromium and ``pip install playwright``.

An age runs from a frame's capture until the browser begins the animation frame that shows it, on one clock: the page's
clock is compared with this process's. Loads are of one core, from the processor time of each process and its children:
on a busy machine they remain meaningful, unlike the number of frames. The load before and after
is printed.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from skyloop.bench import Machine
from skyloop.cli.sim import OWN_OPTIONS
from skyloop.cockpit.child import CockpitProcess

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

NAME: Final = "drone"
WARM_UP_S: Final = 5.0
SIZE: Final = (1440, 900)
_TICKS: Final = os.sysconf("SC_CLK_TCK")
#: Counts the bytes from WebSockets, and records when each frame is shown.
_COUNT: Final = """
window.received = 0;
window.shown = [];
window.WebSocket = class extends WebSocket {
  constructor(...given) {
    super(...given);
    this.addEventListener("message", ({ data }) => (window.received += data.byteLength ?? data.length));
  }
};
new MutationObserver((changes) => {
  const drawn = changes.map(({ target }) => target.dataset.drawn);
  requestAnimationFrame(() => drawn.forEach((captured) => window.shown.push([captured, performance.now()])));
}).observe(document, { subtree: true, attributes: true, attributeFilter: ["data-drawn"] });
"""
_NO_DECODER: Final = "delete window.VideoDecoder"
_PANES: Final = "[...document.querySelectorAll('.tile, .camera')].map((pane) => pane.dataset.form ?? '')"
_TRIES: Final = 30  # readings of the page's clock, of which the quickest counts


class Moment(NamedTuple):
    """The counts up to a moment."""

    at_s: float
    bytes: int  #: bytes received by the page over WebSockets
    cpu_s: dict[str, float]  #: by part


class Watched(NamedTuple):
    """The result of watching a page."""

    name: str
    panes: int
    seconds: float
    ages_s: list[float]  #: age of each frame shown
    bytes: int
    cpu_s: dict[str, float]  #: by part


def main() -> None:
    """Measure, and print the results."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cockpit_fleet", description=__doc__.splitlines()[0])
    parser.add_argument("--drones", type=int, default=12, help="number of drones (default: 12)")
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of each measurement (default: 20)")
    parser.add_argument("--sim", nargs="*", default=[], help="further options of skyloop sim, e.g. world=empty fps=10")
    given = parser.parse_args()
    machine = Machine.here()
    found = []
    with running(given.drones, given.sim) as (browser, address, parts):
        for place, panes in (("#/", given.drones), (f"#{NAME}1", 1)):
            for form, script in (("h264 shared", ""), ("jpeg", _NO_DECODER)):
                context = browser.new_context(viewport={"width": SIZE[0], "height": SIZE[1]})
                context.add_init_script(_COUNT + script)
                page = context.new_page()
                page.goto(f"{address}{place}")
                while sum(one == form for one in page.evaluate(_PANES)) < panes:
                    page.wait_for_timeout(200)
                page.wait_for_timeout(WARM_UP_S * 1e3)
                name = f"{'overview' if panes > 1 else 'one pane'}, {'H.264' if 'h264' in form else 'JPEG'}"
                found.append(watch(name, page, panes, parts, given.seconds))
                context.close()
    print(f"{machine}, {os.getloadavg()[0]:.1f} after")
    for line in report(found):
        print(line)


def watch(name: str, page: Page, panes: int, parts: dict[str, int], seconds: float) -> Watched:
    """Watch a page for this time."""
    offset_s = clock_offset_s(page)
    page.evaluate("window.shown = []")
    before = moment(page, parts)
    page.wait_for_timeout(seconds * 1e3)
    after = moment(page, parts)
    shown = page.evaluate("window.shown")
    ages_s = [at_ms / 1e3 + offset_s - int(captured) / 1e9 for captured, at_ms in shown]
    cpu_s = {part: after.cpu_s[part] - before.cpu_s[part] for part in after.cpu_s}
    return Watched(name, panes, after.at_s - before.at_s, ages_s, after.bytes - before.bytes, cpu_s)


def clock_offset_s(page: Page) -> float:
    """Return this machine's monotonic clock minus the page's, from the quickest of some readings."""
    readings = []
    for _ in range(_TRIES):
        before_s = time.monotonic()
        there_ms = float(page.evaluate("performance.now()"))
        after_s = time.monotonic()
        readings.append((after_s - before_s, (before_s + after_s) / 2 - there_ms / 1e3))
    return min(readings)[1]


def report(found: list[Watched]) -> list[str]:
    """Return the results as lines, a column for each page."""
    rows: list[tuple[str, list[str]]] = [
        ("", [one.name for one in found]),
        ("frames/s of a pane", [f"{len(one.ages_s) / one.seconds / one.panes:.1f}" for one in found]),
        ("age on the screen, median", [f"{1e3 * quantile(one.ages_s, 0.5):.0f} ms" for one in found]),
        ("age, 95 %", [f"{1e3 * quantile(one.ages_s, 0.95):.0f} ms" for one in found]),
        ("kB/s of a pane", [f"{one.bytes / one.seconds / one.panes / 1e3:.1f}" for one in found]),
    ]
    rows += [
        (f"{part}, of a core", [f"{one.cpu_s[part] / one.seconds:.0%}" for one in found]) for part in found[0].cpu_s
    ]
    return [f"{name:<34}" + "".join(f"{cell:>18}" for cell in cells) for name, cells in rows]


def quantile(values: list[float], share: float) -> float:
    """Return a quantile; NaN without values."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))] if values else math.nan


@contextmanager
def running(drones: int, options: list[str]) -> Iterator[tuple[Browser, str, dict[str, int]]]:
    """Run a simulator, a browser and a cockpit; yield browser, address, and the process of each part."""
    from playwright.sync_api import sync_playwright

    chromium = next(
        (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
    )
    if chromium is None:
        sys.exit("there is no Chromium here (Debian: apt install chromium)")
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="skyloop-"))
        os.environ["SKYLOOP_RUNTIME_DIR"] = f"{folder}/run"
        command = [sys.executable, "-m", "skyloop", "sim", "--drones", str(drones), "--name", NAME]
        for name, _, value in (option.partition("=") for option in options):
            command += [f"--{name}", value] if name in OWN_OPTIONS else ["--option", f"{name}={value}"]
        simulator = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE))
        stack.callback(simulator.terminate)
        assert simulator.stdout is not None
        for _ in range(drones):
            simulator.stdout.readline()  # reports that it is ready
        cockpit = stack.enter_context(CockpitProcess(recordings=Path(folder) / "recordings"))
        address = cockpit.address()
        playwright = stack.enter_context(sync_playwright())
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        before = set(children_of(os.getpid()))
        opened = playwright.chromium.launch(executable_path=chromium, args=arguments)
        stack.callback(opened.close)
        ours = [pid for pid in set(children_of(os.getpid())) - before if "chrom" in command_of(pid)]
        yield opened, address, {"browser": min(ours), "cockpit": cockpit.pid, "simulator and proxies": simulator.pid}


def moment(page: Page, parts: dict[str, int]) -> Moment:
    """Count everything now."""
    cpu_s = {part: sum(map(cpu_of, [pid, *children_of(pid)])) for part, pid in parts.items()}
    return Moment(time.monotonic(), page.evaluate("window.received"), cpu_s)


def children_of(pid: int) -> list[int]:
    """Return all descendants of a process."""
    children: dict[int, list[int]] = {}
    for process in Path("/proc").iterdir():
        if process.name.isdigit() and (fields := _stat(int(process.name))):
            children.setdefault(int(fields[1]), []).append(int(process.name))
    found, looking = [], [pid]
    while looking:
        new = children.get(looking.pop(), [])
        found += new
        looking += new
    return found


def cpu_of(pid: int) -> float:
    """Return the processor time of a process without its children [s]; 0 if it has ended."""
    fields = _stat(pid)
    return (int(fields[11]) + int(fields[12])) / _TICKS if fields else 0.0


def command_of(pid: int) -> str:
    """Return the command line of a process; empty if it has ended."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
    return ""


def _stat(pid: int) -> list[str]:
    """Return the fields of ``/proc/PID/stat`` after the name; none if it has ended."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return []


if __name__ == "__main__":
    main()

"""The cockpit's overview of many drones: frames in each pane, and what browser, cockpit and simulator cost.

``python -m benchmarks.cockpit_fleet --drones 12 --seconds 20`` starts the simulator, a cockpit and headless Chromium on
this machine, in a directory of sockets of their own. It needs Chromium and ``pip install playwright``. Shares are of
one core, by the processor time of each process with its children: on a busy machine they still tell what work costs,
while frames are only as many as the machine had time for. The load before and after is printed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Final, NamedTuple

from skyloop.bench.machine import Machine
from skyloop.cli.sim import OWN_OPTIONS
from skyloop.cockpit.child import CockpitProcess

if TYPE_CHECKING:
    from playwright.sync_api import Page

NAME: Final = "drone"
WARM_UP_S: Final = 10.0
SIZE: Final = (1440, 900)
_TICKS: Final = os.sysconf("SC_CLK_TCK")
#: Counts what comes over WebSockets.
_COUNT: Final = """
window.received = 0;
window.WebSocket = class extends WebSocket {
  constructor(...given) {
    super(...given);
    this.addEventListener("message", ({ data }) => (window.received += data.byteLength ?? data.length));
  }
};
"""
_FRAMES: Final = "[...document.querySelectorAll('.tile')].map((tile) => Number(tile.dataset.frames ?? 0))"


class Moment(NamedTuple):
    """What was counted until some time."""

    at_s: float
    frames: list[int]  #: drawn in each pane
    bytes: int  #: that the page received over WebSockets
    cpu_s: dict[str, float]  #: by part


def main() -> None:
    """Measure, and print the results."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cockpit_fleet", description=__doc__.splitlines()[0])
    parser.add_argument("--drones", type=int, default=12, help="how many (default: 12)")
    parser.add_argument("--seconds", type=float, default=20.0, help="to measure for (default: 20)")
    parser.add_argument("--sim", nargs="*", default=[], help="more options of skyloop sim, e.g. world=empty fps=10")
    given = parser.parse_args()
    machine = Machine.here()
    with running(given.drones, given.sim) as (page, parts):
        page.locator(f".tile >> nth={given.drones - 1}").wait_for()
        page.wait_for_timeout(WARM_UP_S * 1e3)
        before = moment(page, parts)
        page.wait_for_timeout(given.seconds * 1e3)
        after = moment(page, parts)
    print(f"{machine}, {os.getloadavg()[0]:.1f} after")
    for line in report(before, after):
        print(line)


def report(before: Moment, after: Moment) -> list[str]:
    """Return what happened between two moments, as lines."""
    seconds = after.at_s - before.at_s
    rates = [(new - old) / seconds for old, new in zip(before.frames, after.frames, strict=True)]
    lines = [
        f"panes                 {len(rates)}",
        f"frames a second       {min(rates):.1f} in the slowest pane, median {median(rates):.1f}, all {sum(rates):.0f}",
        f"bytes a second        {(after.bytes - before.bytes) / seconds / 1e3:.0f} kB to the page",
    ]
    shares = {part: (after.cpu_s[part] - before.cpu_s[part]) / seconds for part in after.cpu_s}
    return lines + [f"{part:<22}{share:.0%} of a core" for part, share in shares.items()]


@contextmanager
def running(drones: int, options: list[str]) -> Iterator[tuple[Page, dict[str, int]]]:
    """The simulator, a cockpit and its page in a browser; and the process of each part."""
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
            simulator.stdout.readline()  # says that it is ready
        cockpit = stack.enter_context(CockpitProcess(recordings=Path(folder) / "recordings"))
        address = cockpit.address()
        playwright = stack.enter_context(sync_playwright())
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        before = set(children_of(os.getpid()))
        opened = playwright.chromium.launch(executable_path=chromium, args=arguments)
        stack.callback(opened.close)
        ours = [pid for pid in set(children_of(os.getpid())) - before if "chrom" in command_of(pid)]
        page = opened.new_context(viewport={"width": SIZE[0], "height": SIZE[1]}).new_page()
        page.add_init_script(_COUNT)
        page.goto(f"{address}#/")
        yield page, {"browser": min(ours), "cockpit": cockpit.pid, "simulator and proxies": simulator.pid}


def moment(page: Page, parts: dict[str, int]) -> Moment:
    """Count everything now."""
    cpu_s = {part: sum(map(cpu_of, [pid, *children_of(pid)])) for part, pid in parts.items()}
    return Moment(time.monotonic(), page.evaluate(_FRAMES), page.evaluate("window.received"), cpu_s)


def children_of(pid: int) -> list[int]:
    """Return all processes that descend from one."""
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
    """Return the processor time of a process without its children [s]; 0 if it is gone."""
    fields = _stat(pid)
    return (int(fields[11]) + int(fields[12])) / _TICKS if fields else 0.0


def command_of(pid: int) -> str:
    """Return the command line of a process; empty if it is gone."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
    return ""


def _stat(pid: int) -> list[str]:
    """Return the fields of ``/proc/PID/stat`` after the name; none if it is gone."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return []


if __name__ == "__main__":
    main()

"""Diagnostics: ``skyloop doctor`` checks this machine or one vehicle, ``skyloop preflight`` a drone before a flight.

``skyloop doctor`` lists what works and what must be installed for the rest; ``skyloop doctor ADDRESS`` connects to one
vehicle and lists the settings that need attention. None of these checks flies the vehicle.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import platform
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.console import Console
from rich.text import Text

from skyloop.cli.install import EXTRAS
from skyloop.cli.naming import DroneOption, KeysOption, NameArgument, NetworkOption, join_network, one_drone
from skyloop.cli.text import print_json
from skyloop.client.preflight import Level, PreflightFinding
from skyloop.errors import NoAnswerError, install_command
from skyloop.messages import EventKind, LinkState, Severity
from skyloop.platform import allow_restart

if TYPE_CHECKING:
    from skyloop.drivers.base import Driver
    from skyloop.drivers.recording_sink import RecordingSink
    from skyloop.messages.parameter import Diagnostic

IMPORT_BUDGET_S: Final = 0.3  #: an import that takes longer is reported as slow

#: Ports that Skyloop listens on or that vehicles send to, and their purposes.
PORTS: Final = (
    ("UDP", 14550, "MAVLink ground stations"),
    ("UDP", 14540, "PX4"),
    ("UDP", 8890, "Tello's state"),
    ("UDP", 11111, "Tello's video"),
    ("UDP", 5554, "AR.Drone's navdata"),
    ("TCP", 7447, "routers"),
)
ANSWER_S: Final = 3.5  #: time allowed for a vehicle to answer; chosen so that the user gets a result within 5 s
PATIENCE_S: Final = 40.0  #: time limit for reading the settings of a vehicle that responds
FEEDBACK_S: Final = 3.0  #: time limit for the battery's charge
SETTLE_S: Final = 2.0  #: time to wait for faults to clear that our first messages fix, such as a missing stick input
_POLL_S: Final = 0.1  # interval between checks during that time
_MARKS = {Level.OK: ("✓", "green"), Level.WARN: ("!", "yellow"), Level.FAIL: ("✗", "red")}
STATE_S = 2.0  #: time limit for the first feedback
VIDEO_S = 5.0  #: time limit for the first image; a Tello that has just been switched on takes several seconds


class Health(StrEnum):
    GOOD = "good"
    MISSING = "missing"  #: everything else works without this part
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report, followed by a line of advice if there is advice."""

    what: str
    health: Health
    detail: str
    advice: str = ""


MARKS: Final = {Health.GOOD: ("✓", "green"), Health.MISSING: ("–", "yellow"), Health.BAD: ("✗", "red")}


def as_text(finding: Finding) -> Text:
    mark, colour = MARKS[finding.health]
    text = Text.assemble((mark, colour), f" {finding.what}: {finding.detail}")
    return text.append(f"\n  → {finding.advice}", "bold") if finding.advice else text


def doctor(
    address: Annotated[
        str, typer.Argument(metavar="[ADDRESS]", help="Vehicle to check instead; nothing is flown")
    ] = "",
    json: Annotated[bool, typer.Option("--json", help="Print one JSON array")] = False,
) -> None:
    """Check Python, the local transport, all optional parts, cameras, ports, drivers and proxies; or check one vehicle.

    Marks: ✓ works, – an optional part is missing or a vehicle's safety net is disabled, ✗ broken. The exit code is 1 if
    something is broken.
    """
    console = Console(soft_wrap=True)
    findings = []
    for finding in examine_vehicle(address) if address else examine():
        if not json:
            console.print(as_text(finding))
        findings.append(finding)
    if json:
        print_json(findings)
    if any(finding.health is Health.BAD for finding in findings):
        raise typer.Exit(1)


def examine() -> Iterator[Finding]:
    """Yield all findings in reading order. A check that fails is itself reported."""
    from skyloop.errors import MissingExtraError

    checks: dict[str, Callable[[], Iterator[Finding]]] = {
        "Python": _python,
        "local transport": _local_transport,
        "import skyloop": _import_time,
        "optional parts": _extras,
        "compiled pictures": _compiled_pictures,
        "cameras": _cameras,
        "browser": _browser,
        "ports": _ports,
        "drivers": _drivers,
        "proxies": _proxies,
    }
    for what, check in checks.items():
        try:
            yield from check()
        except MissingExtraError as error:
            yield Finding(what, Health.MISSING, str(error))
        except Exception as error:  # noqa: BLE001  a check that fails is itself reported
            yield Finding(what, Health.BAD, f"{type(error).__name__}: {error}")


def _python() -> Iterator[Finding]:
    import skyloop

    yield Finding(
        "Python",
        Health.GOOD,
        f"{platform.python_version()} on {platform.system()} {platform.machine()}, {os.cpu_count()} cores, "
        f"Skyloop {skyloop.__version__}",
    )


def _local_transport() -> Iterator[Finding]:
    from skyloop.transport.local.directory import DIRECTORY_VARIABLE, find_directory
    from skyloop.transport.local.system import FAST, serving_side

    side = serving_side()
    directory = find_directory()
    try:
        directory.create()
    except OSError as error:
        detail = f"{directory.path} can't be created: {error.strerror}"
        yield Finding("local transport", Health.BAD, detail, f"set {DIRECTORY_VARIABLE} to a directory that you own")
    else:
        what = "sockets" if side == FAST else f"{side}: loopback TCP and named memory, registrations"
        yield Finding("local transport", Health.GOOD, f"{what} in {directory.path}")


def _import_time() -> Iterator[Finding]:
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", "pass"], check=True)
    bare = time.perf_counter() - begin
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import skyloop; skyloop.connect"], check=True)
    taken = time.perf_counter() - begin - bare
    slow = taken > IMPORT_BUDGET_S
    advice = "slow or busy machine, or first start without compiled files: try again" if slow else ""
    yield Finding("import skyloop", Health.GOOD, f"{taken:.2f} s", advice)


def _extras() -> Iterator[Finding]:
    for extra, use, modules in EXTRAS:
        what, install = f"{use} [{extra}]", install_command(extra)
        versions, missing, broken = [], [], []
        for module in modules:
            try:
                versions.append(f"{module} {getattr(importlib.import_module(module), '__version__', '')}".strip())
            except ModuleNotFoundError:
                missing.append(module)
            except ImportError as error:  # the package is installed, but one of its requirements is not
                broken.append(f"{module}: {error}")
        if broken:
            yield Finding(what, Health.BAD, "; ".join(broken), f"{install} --anew")
        elif missing:
            named = " and ".join(part for part in (", ".join(missing[:-1]), missing[-1]) if part)
            yield Finding(what, Health.MISSING, f"{named} not installed", install)
        else:
            yield Finding(what, Health.GOOD, ", ".join(versions))


def _compiled_pictures() -> Iterator[Finding]:
    if not all(importlib.util.find_spec(module) for module in ("numba", "cv2")):
        return
    from skyloop.sim.render.compiled import Compiler

    compiler = Compiler()
    begin = time.perf_counter()
    compiler.start().join()
    if compiler.problem:
        advice = "set NUMBA_CACHE_DIR to a writable directory; until then the simulator draws without it"
        yield Finding("compiled pictures", Health.MISSING, compiler.problem, advice)
    else:
        yield Finding("compiled pictures", Health.GOOD, f"ready after {time.perf_counter() - begin:.1f} s")


def _cameras() -> Iterator[Finding]:
    from skyloop.vehicles.video.v4l2 import cameras

    found = cameras()
    for camera in found:
        health = Health.GOOD if camera.allowed else Health.MISSING
        yield Finding("camera", health, str(camera))
    if not found:
        yield Finding("cameras", Health.MISSING, "none is connected", "for video:///dev/video0: connect a webcam")


def _browser() -> Iterator[Finding]:
    import webbrowser

    try:
        found = webbrowser.get()
    except webbrowser.Error:
        yield Finding(
            "browser", Health.MISSING, "none found on this machine", "open the cockpit's address from another machine"
        )
    else:
        yield Finding("browser", Health.GOOD, getattr(found, "name", type(found).__name__))


def _ports() -> Iterator[Finding]:
    taken = [f"{kind} {port} ({use})" for kind, port, use in PORTS if not _free(kind, port)]
    if taken:
        advice = "fine if your own proxy uses them; otherwise end the other program, such as a ground station"
        yield Finding("ports", Health.MISSING, f"in use: {', '.join(taken)}", advice)
    else:
        yield Finding("ports", Health.GOOD, f"free: {', '.join(f'{kind} {port}' for kind, port, _ in PORTS)}")


def _free(kind: str, port: int) -> bool:
    """Return whether a program could bind this port."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM if kind == "TCP" else socket.SOCK_DGRAM) as probe:
        if kind == "TCP":  # as servers do, so that a recently closed port counts as free
            allow_restart(probe)
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True


def _drivers() -> Iterator[Finding]:
    from skyloop.drivers.registry import driver_class, known_schemes
    from skyloop.errors import MissingExtraError

    schemes = known_schemes()
    if not schemes:
        yield Finding("drivers", Health.BAD, "none is registered", "install Skyloop with pip, again if necessary")
    for scheme in schemes:
        try:
            driver = driver_class(scheme)
        except MissingExtraError as error:
            yield Finding(f"driver {scheme}://", Health.MISSING, str(error))
        except Exception as error:  # noqa: BLE001  other people's drivers may raise anything
            yield Finding(f"driver {scheme}://", Health.BAD, str(error), "repair or uninstall that package")
        else:
            yield Finding(f"driver {scheme}://", Health.GOOD, f"{driver.__module__}.{driver.__qualname__}")


def _proxies() -> Iterator[Finding]:
    from skyloop.cli.listing import running

    rows = running()
    if not rows:
        yield Finding("proxies", Health.GOOD, "none is running", "to start one: skyloop proxy sim:// --name alpha")
    for row in rows:
        if row.problem:
            advice = "stopped (Ctrl-Z)? continue it with: kill -CONT PID; otherwise end it and start it again"
            if row.pid is not None:
                advice = advice.replace("PID", str(row.pid))
            yield Finding(f"proxy {row.name}", Health.BAD, row.problem, advice)
        else:
            yield Finding(f"proxy {row.name}", Health.GOOD, f"{row.uri}, {row.state}")


def examine_vehicle(address: str) -> Iterator[Finding]:
    """Yield the findings about a vehicle in reading order. Raise ``SkyloopError`` if the address is invalid."""
    from skyloop.drivers.recording_sink import RecordingSink
    from skyloop.drivers.registry import make_driver

    driver, sink = make_driver(address), RecordingSink(watch=set())
    driver.open(sink)
    try:
        sink.wait(lambda: sink.link_state not in (None, LinkState.CONNECTING), ANSWER_S)
        if sink.link_state not in (LinkState.UP, LinkState.DEGRADED):
            yield _unreachable(sink)
            return
        if sink.link_state is LinkState.DEGRADED:
            yield Finding("vehicle", Health.GOOD, f"it answers: {sink.links[-1][1] or 'being read'}")
        if sink.wait(lambda: sink.link_state is LinkState.UP, PATIENCE_S):
            sink.wait(lambda: sink.newest is not None and sink.newest.battery is not None, FEEDBACK_S)
        else:
            yield _unreachable(sink)
        newest = sink.newest
        if newest is not None:
            battery = "unknown" if newest.battery is None else f"{newest.battery:.0%}"
            yield Finding("vehicle", Health.GOOD, f"{newest.state.value}, battery {battery}")
        for event in sink.events:
            if event.kind is EventKind.DRIVER_ERROR or event.severity is Severity.ERROR:
                yield Finding("vehicle", Health.MISSING, event.text)
        for diagnostic in _settled(driver):
            health = Health.GOOD if diagnostic.good else Health.MISSING
            yield Finding(diagnostic.what, health, diagnostic.detail, diagnostic.advice)
    finally:
        driver.close()


def _settled(driver: Driver) -> list[Diagnostic]:
    end = time.monotonic() + SETTLE_S
    while True:
        found = driver.checkup()
        if time.monotonic() >= end or all(each.good or not each.severe for each in found):
            return found
        time.sleep(_POLL_S)


def _unreachable(sink: RecordingSink) -> Finding:
    state, reason = sink.links[-1] if sink.links else (LinkState.CONNECTING, "no state reported")
    advice = sink.remedy or "check power, cable, address"
    return Finding("vehicle", Health.BAD, f"its link is {state.value}: {reason}", advice)


def preflight(
    name: NameArgument = None,
    drone: DroneOption = None,
    folder: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Folder for recordings, to check its free space")
    ] = Path("recordings"),
    json: Annotated[bool, typer.Option("--json", help="Print the findings as a JSON array")] = False,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Check a drone before a flight: its link, battery, position, zones, video and built-in failsafes. Flies nothing.

    Marks: ✓ ready, ! missing but not required, ✗ prevents a flight or makes it unsafe. Exit code 1 if there is any ✗.
    """
    from contextlib import suppress

    from skyloop.client import connect

    join_network(network, keys)
    with connect(one_drone(name, drone), access="observe", name="skyloop preflight") as checked:
        with suppress(NoAnswerError):
            checked.next_feedback(STATE_S)
        findings = checked.preflight(video_s=VIDEO_S, folder=folder)
    if json:
        print_json([asdict(finding) for finding in findings])
    else:
        console = Console(soft_wrap=True)
        for finding in findings:
            console.print(_line(finding))
    if any(finding.level is Level.FAIL for finding in findings):
        raise typer.Exit(1)


def _line(finding: PreflightFinding) -> Text:
    mark, colour = _MARKS[finding.level]
    text = Text.assemble((mark, colour), f" {finding.check}: {finding.detail}")
    if finding.why:
        text.append(f"\n  {finding.why}")
    return text.append(f"\n  → {finding.remedy}", "bold") if finding.remedy else text

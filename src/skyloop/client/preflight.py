"""Check a drone before a flight with pure functions; :func:`inspect` collects the state they need."""

from __future__ import annotations

import re
import shutil
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

from skyloop.client.frame import Frame
from skyloop.client.parameters import Config
from skyloop.client.telemetry import LinkStatus
from skyloop.errors import ClosedError, SkyloopError
from skyloop.messages import Capabilities, Failsafe, Feedback, FlightState, LinkState, Value
from skyloop.messages.parameter import CHECKUP, Diagnostic, decode_checkup

STALE_S: Final = 1.0  #: maximum age for feedback to count as current [s]
STALE_VIDEO_S: Final = 1.0  #: maximum age for a frame to count as current [s]
CLOCK_S: Final = 0.05  #: maximum uncertainty of the samples' ages [s]
LEVEL_RAD: Final = 0.12  #: maximum tilt at which a vehicle counts as level [rad]
ACTIVE: Final = "camera.active"  #: the parameter that selects the camera, for vehicles that send one camera at a time
_COMMAND: Final = re.compile(r"(skyloop \w+) NAME\b")
FREE_BYTES: Final = 1_000_000_000  #: free disk space below which the storage check warns
FULL_BYTES: Final = 100_000_000  #: free disk space below which the storage check fails
FAR_M: Final = 10_000.0  #: a wall of the safety box is ignored if it is at least this far away [m]


class Level(StrEnum):
    """How serious a finding is."""

    OK = "ok"
    WARN = "warn"  #: the drone can fly, but lacks something helpful
    FAIL = "fail"  #: the drone would not fly at all, or not safely


@dataclass(frozen=True, slots=True)
class PreflightFinding:
    """One finding from the pre-flight checklist."""

    check: str  #: the subject: ``link``, ``battery``, ``position`` and so on
    level: Level  #: how serious the finding is
    detail: str  #: the result
    why: str = ""  #: why it matters; empty if there is no problem
    remedy: str = ""  #: what to do about it; empty if nothing needs to be done


@dataclass(frozen=True, slots=True)
class PreflightState:
    """The known state of a vehicle before a flight."""

    link: LinkStatus
    capabilities: Capabilities
    feedback: Feedback | None = None  #: the newest sample; None if there is none yet
    feedback_age_s: float | None = None
    #: Age of each camera's newest frame; None if none arrived in time.
    video_age_s: Mapping[str, float | None] = field(default_factory=dict)
    parameters: Mapping[str, Value] = field(default_factory=dict)  #: values by name; empty if not read
    clock_uncertainty_s: float = 0.0  #: uncertainty of the ages of all samples
    app_id: int = 0  #: this application's number in this run of the proxy
    free_bytes: int | None = None  #: free disk space for recordings [bytes]; None: not requested
    video_waited_s: float = 0.0  #: time spent waiting for frames
    name: str = "NAME"  #: the drone's name, used in the commands that remedies suggest


class Inspected(Protocol):
    """The part of a drone that the checks use."""

    config: Config

    @property
    def name(self) -> str: ...
    @property
    def link(self) -> LinkStatus: ...
    @property
    def capabilities(self) -> Capabilities: ...
    @property
    def clock_uncertainty_ns(self) -> int: ...
    @property
    def app_id(self) -> int: ...
    def age_s(self, sample: Feedback | Frame) -> float: ...
    def on_frame(self, function: Callable[[Frame], object], camera: str | None = None) -> Any: ...


def inspect(
    drone: Inspected, feedback: Feedback | None, video_s: float, folder: str | Path | None
) -> list[PreflightFinding]:
    """Return the checklist of a drone; see :meth:`skyloop.client.Drone.preflight`."""
    try:
        parameters = dict(drone.config.items())
    except ClosedError:
        raise
    except SkyloopError:
        parameters = {}  # the link is down, which is reported as a finding
    shown = shown_cameras(drone.capabilities, parameters)
    return check_before_flight(
        PreflightState(
            name=drone.name,
            link=drone.link,
            capabilities=drone.capabilities,
            feedback=feedback,
            feedback_age_s=None if feedback is None else drone.age_s(feedback),
            video_age_s=_picture_ages(drone, shown, video_s) if video_s > 0 else {},
            video_waited_s=video_s,
            parameters=parameters,
            clock_uncertainty_s=drone.clock_uncertainty_ns / 1e9,
            app_id=drone.app_id,
            free_bytes=None if folder is None else _free_bytes(Path(folder)),
        )
    )


def _picture_ages(drone: Inspected, shown: Collection[str], timeout_s: float) -> dict[str, float | None]:
    """Return the age of one frame per camera; None if no frame arrived in time. Waits only for cameras in ``shown``."""
    deadline = time.monotonic() + timeout_s
    ages: dict[str, float | None] = {camera.name: None for camera in drone.capabilities.cameras}
    came = {name: threading.Event() for name in ages}

    def note(name: str, frame: Frame) -> None:
        ages[name] = drone.age_s(frame)
        came[name].set()

    with ExitStack() as listening:
        for name in ages:
            listening.callback(drone.on_frame(partial(note, name), name).cancel)
        for name in shown:
            came[name].wait(max(0.0, deadline - time.monotonic()))
    return dict(ages)


def _free_bytes(folder: Path) -> int | None:
    """Return the free bytes on the disk of a folder, which need not exist yet; None if unknown."""
    there = folder.absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    try:
        return shutil.disk_usage(there).free
    except OSError:
        return None


def check_before_flight(state: PreflightState) -> list[PreflightFinding]:
    """Return the checklist in reading order, including findings without a problem."""
    found = [
        *_link(state),
        *_flight_state(state),
        *_battery(state),
        *_position(state),
        *_level(state),
        *_bounds(state),
        *_video(state),
        *_control(state),
        *_clock(state),
        *_storage(state),
        *_vehicle(state),
    ]
    # Drivers and the checks above give advice without the drone's name; adding it lets users copy the commands.
    return [replace(one, remedy=_COMMAND.sub(rf"\1 {state.name}", one.remedy)) for one in found]


def _ok(check: str, detail: str) -> PreflightFinding:
    return PreflightFinding(check, Level.OK, detail)


def _judged(level: Level, check: str, detail: str, why: str, remedy: str) -> PreflightFinding:
    """Return a finding at this level; at level OK, the reason and the remedy are left empty."""
    return _ok(check, detail) if level is Level.OK else PreflightFinding(check, level, detail, why, remedy)


def _link(state: PreflightState) -> Iterator[PreflightFinding]:
    link = state.link
    if link.application is not LinkState.UP:
        bad = link.application is not LinkState.DEGRADED
        yield PreflightFinding(
            "link",
            Level.FAIL if bad else Level.WARN,
            f"the link to the proxy is {link.application}: {link.reason or 'reason unknown'}",
            "commands may not arrive, and the display may be old",
            "check that the proxy runs (skyloop list) and that its computer is reachable",
        )
        if bad:
            return
    if link.vehicle is LinkState.UP:
        yield _ok("link", "the vehicle answers")
        return
    yield PreflightFinding(
        "link",
        Level.WARN if link.vehicle is LinkState.DEGRADED else Level.FAIL,
        f"the link to the vehicle is {link.vehicle}: {link.reason or 'reason unknown'}",
        "a silent vehicle probably receives nothing, either",
        link.remedy or "check its power, and the radio or Wi-Fi to it: skyloop doctor ADDRESS",
    )


def _flight_state(state: PreflightState) -> Iterator[PreflightFinding]:
    feedback = state.feedback
    if not state.capabilities.actions:
        why = state.capabilities.why_not or "it accepts no commands"
        yield PreflightFinding(
            "vehicle", Level.FAIL, f"nothing can be flown: {why}", "it can only be watched", "connect to another"
        )
    elif feedback is None:
        yield PreflightFinding(
            "vehicle", Level.FAIL, "it has not reported its state", "its state is unknown", "wait for its first data"
        )
    elif feedback.state is FlightState.EMERGENCY:
        yield PreflightFinding(
            "vehicle",
            Level.FAIL,
            "its emergency stop is in force: the motors are off",
            "it refuses to take off",
            "find out why it stopped, stand clear, and reset it (drone.reset_emergency(), or Reset on the page)",
        )
    elif state.feedback_age_s is not None and state.feedback_age_s > STALE_S:
        detail = f"its newest state is {state.feedback_age_s:.1f} s old"
        yield PreflightFinding("vehicle", Level.FAIL, detail, "the display is not current", "check the link to it")
    elif feedback.others:
        yield PreflightFinding(
            "vehicle",
            Level.WARN,
            f"another controller has it: {feedback.others}",
            "the proxy leaves it alone until a pilot commands hover, landing or take-off",
            "agree with the person flying it",
        )
    else:
        yield _ok("vehicle", str(feedback.state).replace("_", " "))
    if feedback is not None and feedback.failsafe is not Failsafe.NONE:
        doing = f"a failsafe is active: {feedback.failsafe}"
        yield PreflightFinding("failsafe", Level.WARN, doing, "its pilot fell silent", "take control, and command it")


def _battery(state: PreflightState) -> Iterator[PreflightFinding]:
    charge = None if state.feedback is None else state.feedback.battery
    land, warn = _number(state, "battery.land", 0.1), _number(state, "battery.warn", 0.2)
    back = _number(state, "battery.return", 0.0)
    if charge is None:
        yield PreflightFinding(
            "battery", Level.WARN, "its charge is not reported", "it may come down by itself", "check it by hand"
        )
        return
    level, detail, why = Level.OK, f"{charge:.0%} left", "the flight will be short"
    if charge < land:
        level, detail = Level.FAIL, f"{detail}, below {land:.0%} (battery.land)"
        why = "it would land right after take-off and accept no other command"
    elif charge < back:
        level, detail = Level.FAIL, f"{detail}, below {back:.0%} (battery.return)"
        why = "it refuses to take off, because it would return at once"
    elif charge < warn:
        level = Level.WARN
    yield _judged(level, "battery", detail, why, "charge or change it")


def _position(state: PreflightState) -> Iterator[PreflightFinding]:
    feedback = state.feedback
    if feedback is None:
        return
    if feedback.position_m is None:
        yield PreflightFinding(
            "position",
            Level.WARN,
            "it does not report its position",
            "waypoints, routes, the safety box and zones don't work; it can only be flown by sticks and velocities",
            "give it a position: GPS, optical flow, or motion capture (drone.send_external_pose)",
        )
    else:
        x, y, z = feedback.position_m
        yield _ok("position", f"{x:.1f} m east, {y:.1f} m north, {z:.1f} m up")
    known = feedback.yaw_rad is not None
    yield _judged(
        Level.OK if known else Level.WARN,
        "compass",
        "its heading is known" if known else "it does not report its heading",
        "it can't be flown to positions, and cameras' views have no direction",
        "calibrate its compass, or wait until its estimate has settled",
    )


def _level(state: PreflightState) -> Iterator[PreflightFinding]:
    feedback = state.feedback
    if feedback is None or feedback.state is not FlightState.LANDED:
        return
    if feedback.roll_rad is None or feedback.pitch_rad is None:
        return
    tilt = max(abs(feedback.roll_rad), abs(feedback.pitch_rad))
    level = tilt <= LEVEL_RAD
    yield _judged(
        Level.OK if level else Level.WARN,
        "level",
        "it stands level" if level else f"it stands tilted by {tilt:.2f} rad, or mistakes a tilted attitude for level",
        "it would drift off on take-off",
        "put it on level ground; if it stands level, calibrate it (AR.Drone: ardrone.flat_trim)",
    )


def _bounds(state: PreflightState) -> Iterator[PreflightFinding]:
    if not state.parameters:
        yield PreflightFinding(
            "zones",
            Level.WARN,
            "its parameters could not be read",
            "its limits and failsafes are unknown",
            "check again when its link is up",
        )
        return
    walls = [f"safety.box.{axis}_{end}" for axis in "xyz" for end in ("low", "high")]
    count = sum(abs(_number(state, wall, FAR_M)) < FAR_M for wall in walls)
    text = state.parameters.get("safety.zones", "")
    zones = sum(bool(part.strip()) for part in text.split(";")) if isinstance(text, str) else 0
    ceiling = state.parameters.get("limits.altitude")
    high = f", at most {ceiling:g} m high" if isinstance(ceiling, int | float) else ""
    if count or zones:
        works = state.feedback is not None and state.feedback.position_m is not None
        yield _judged(
            Level.OK if works else Level.FAIL,
            "zones",
            f"{count} of 6 walls of the safety box, {zones} zone{'' if zones == 1 else 's'}{high}",
            "without a position nothing keeps it inside",
            "give it a position",
        )
        return
    yield PreflightFinding(
        "zones",
        Level.WARN,
        f"no safety box and no zones are set{high}",
        "nothing stops it short of walls and people",
        "set them on the page's map (Zones), or skyloop param NAME safety.box.x_high 4",
    )


def _video(state: PreflightState) -> Iterator[PreflightFinding]:
    shown = shown_cameras(state.capabilities, state.parameters)
    for camera, age_s in state.video_age_s.items():
        check = f"video {camera}"
        if age_s is None and camera not in shown:
            yield _ok(check, f"not shown: it sends one camera at a time, now {', '.join(shown)} ({ACTIVE})")
        elif age_s is None:
            yield PreflightFinding(
                check,
                Level.WARN,
                f"no picture yet, in {state.video_waited_s:g} s",
                "a pilot who relies on it would fly blind",
                "a vehicle that has just started may need a few more seconds: check again; else check the camera, its "
                "link and its address (skyloop watch NAME)",
            )
        else:
            old = age_s > STALE_VIDEO_S
            yield _judged(
                Level.WARN if old else Level.OK,
                check,
                f"the newest picture is {age_s:.1f} s old" if old else "pictures arrive",
                "a pilot who relies on it would fly blind",
                "check the camera, its link and its address; skyloop watch NAME shows why",
            )


def shown_cameras(capabilities: Capabilities, parameters: Mapping[str, Value]) -> tuple[str, ...]:
    """Return the cameras whose images a vehicle currently sends: all cameras, or the selected one."""
    names = tuple(camera.name for camera in capabilities.cameras)
    chosen = parameters.get(ACTIVE)
    return (chosen,) if isinstance(chosen, str) and chosen in names else names


def _control(state: PreflightState) -> Iterator[PreflightFinding]:
    feedback = state.feedback
    if feedback is None or not feedback.lease:
        yield _ok("control", "no one has control")
    elif feedback.owner_id == state.app_id:
        yield _ok("control", "this application has control")
    else:
        yield PreflightFinding(
            "control",
            Level.WARN,
            f"{feedback.owner} has control, with priority {feedback.owner_priority}",
            "its commands count, yours are refused",
            "request control, or agree with them",
        )


def _clock(state: PreflightState) -> Iterator[PreflightFinding]:
    vague = state.clock_uncertainty_s > CLOCK_S
    milliseconds = state.clock_uncertainty_s * 1000
    yield _judged(
        Level.WARN if vague else Level.OK,
        "clock",
        f"ages are known to ±{milliseconds:.0f} ms only" if vague else f"ages are known to ±{milliseconds:.1f} ms",
        "commands may be refused as stale, and delays are wrong by as much",
        "use a faster or less busy network",
    )


def _storage(state: PreflightState) -> Iterator[PreflightFinding]:
    free = state.free_bytes
    if free is None:
        return
    yield _judged(
        Level.FAIL if free < FULL_BYTES else Level.WARN if free < FREE_BYTES else Level.OK,
        "storage",
        f"{free / 1e9:.1f} GB are free for recordings",
        "a recording would end early",
        "delete old ones, or record elsewhere",
    )


def _vehicle(state: PreflightState) -> Iterator[PreflightFinding]:
    """Yield the findings that the vehicle's driver reported."""
    text = state.parameters.get(CHECKUP)
    if not isinstance(text, str) or not text:
        return
    try:
        diagnostics = decode_checkup(text)
    except ValueError:
        unread = "its check-up can't be read: the state of its own safety nets is unknown"
        diagnostics = [Diagnostic("driver", False, unread, "run its proxy with the same version of Skyloop as this")]
    for one in diagnostics:
        level = Level.OK if one.good else Level.FAIL if one.severe else Level.WARN
        detail, _, why = (one.detail, "", "") if one.good else one.detail.partition(": ")
        yield _judged(level, one.what, detail, why, one.advice)


def _number(state: PreflightState, name: str, otherwise: float) -> float:
    value = state.parameters.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else otherwise

"""Gathers what the checks before a flight need to know of a drone."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Protocol

from skyloop.client.frame import Frame
from skyloop.client.parameters import Config
from skyloop.client.preflight import PreflightFinding, PreflightState, check_before_flight, shown_cameras
from skyloop.client.telemetry import LinkStatus
from skyloop.errors import ClosedError, SkyloopError
from skyloop.messages import Capabilities, Feedback, Value


class Inspected(Protocol):
    """What is asked of a drone."""

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
    parameters = _parameters(drone)
    shown = shown_cameras(drone.capabilities, parameters)
    return check_before_flight(
        PreflightState(
            name=drone.name,
            link=drone.link,
            capabilities=drone.capabilities,
            feedback=feedback,
            feedback_age_s=None if feedback is None else drone.age_s(feedback),
            video_age_s=_video(drone, shown, video_s) if video_s > 0 else {},
            video_waited_s=video_s,
            parameters=parameters,
            clock_uncertainty_s=drone.clock_uncertainty_ns / 1e9,
            app_id=drone.app_id,
            free_bytes=None if folder is None else _free(Path(folder)),
        )
    )


def _video(drone: Inspected, shown: Collection[str], timeout_s: float) -> dict[str, float | None]:
    """Return the age of a picture of each camera; None where none came in time. Waits for those that are shown."""
    deadline = time.monotonic() + timeout_s
    ages: dict[str, float | None] = {}
    listeners, events = [], []
    try:
        for camera in drone.capabilities.cameras:
            ages[camera.name] = None
            came = threading.Event()
            if camera.name in shown:
                events.append(came)

            def note(frame: Frame, name: str = camera.name, came: threading.Event = came) -> None:
                ages[name] = drone.age_s(frame)
                came.set()

            listeners.append(drone.on_frame(note, camera.name))
        for came in events:
            came.wait(max(0.0, deadline - time.monotonic()))
    finally:
        for listener in listeners:
            listener.cancel()
    return dict(ages)


def _parameters(drone: Inspected) -> dict[str, Value]:
    try:
        return dict(drone.config.items())
    except ClosedError:
        raise
    except SkyloopError:
        return {}  # the link is not up, which is a finding of its own


def _free(folder: Path) -> int | None:
    """Return the bytes that are free where a folder is, or will be; None if that can't be found out."""
    there = folder.absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    try:
        return shutil.disk_usage(there).free
    except OSError:
        return None

"""A proxy in a separate process and an application that flies it, with the time limits that real autopilots need."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

import skyloop
from skyloop.messages import Feedback, FlightState, LinkState

NAME = "hardware"
READY_S = 120.0  #: from an autopilot's start until it may be armed: up to 40 s were observed, including EKF and GPS
TAKEOFF_S = 60.0
LANDING_S = 60.0
LINK_S = 60.0


class Rig:
    """One vehicle's proxy, which can be started and killed repeatedly."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._process: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  closed by end()

    def start(self) -> None:
        """Start a proxy."""
        command = [sys.executable, "-m", "skyloop", "proxy", self.address, "--name", NAME]
        self._process = subprocess.Popen(command, stdout=self._log, stderr=subprocess.STDOUT)

    def connect(self) -> skyloop.Drone:
        """Connect as a pilot as soon as the proxy serves and the vehicle is found."""
        deadline = time.monotonic() + LINK_S
        while True:
            try:
                drone = skyloop.connect(NAME, timeout_s=10.0)
                break
            except skyloop.SkyloopError:
                assert time.monotonic() < deadline, self.said()
                time.sleep(0.2)
        until(drone, lambda f: f.vehicle_link in (LinkState.UP, LinkState.DEGRADED), LINK_S, "the vehicle is found")
        until(drone, lambda f: f.state is not FlightState.UNKNOWN, LINK_S, "its state is known")
        return drone

    def kill(self) -> None:
        """Kill the proxy."""
        assert self._process is not None
        self._process.send_signal(signal.SIGKILL)
        self._process.wait(10)
        self._process = None

    def end(self) -> None:
        """End the proxy, which lands a flying vehicle first."""
        if self._process is not None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(LANDING_S)
            except subprocess.TimeoutExpired:
                self.kill()
        self._log.close()

    def said(self) -> str:
        """Return the output of the proxies so far."""
        self._log.seek(0)
        return self._log.read().decode(errors="replace")[-4000:]


def until(
    drone: skyloop.Drone,
    wanted: Callable[[Feedback], bool],
    timeout_s: float,
    what: str,
    say: Callable[[], object] = lambda: None,
) -> Feedback:
    """Wait for a condition, repeating the command ``say``; a failure quotes the vehicle's last events."""
    deadline = time.monotonic() + timeout_s
    while True:
        say()
        newest = drone.feedback()
        if wanted(newest):
            return newest
        words = [event.text for event in drone.recent_events()][-12:]
        assert time.monotonic() < deadline, f"not within {timeout_s:g} s: {what}; {newest}; {words}"
        time.sleep(0.02)


def ready(feedback: Feedback) -> bool:
    """Whether the vehicle can take off: a MAVLink vehicle says so, others know where they are."""
    native = feedback.native or {}
    if any(name.startswith("mavlink.") for name in native):
        return bool(native.get("mavlink.ready"))
    return feedback.position_m is not None and not feedback.waking_up


def place(feedback: Feedback) -> tuple[float, float, float]:
    """Return the position east, north, up [m]."""
    assert feedback.position_m is not None, "the vehicle does not report its position"
    return feedback.position_m


def speed(feedback: Feedback) -> float:
    """Return the horizontal speed [m/s]."""
    assert feedback.velocity_m_s is not None, "the vehicle does not report its speed"
    return math.hypot(*feedback.velocity_m_s[:2])


def holds(
    drone: skyloop.Drone, seconds: float, radius_m: float, what: str, say: Callable[[], object] = lambda: None
) -> None:
    """Check that the vehicle holds its horizontal position for this time."""
    begun = place(drone.feedback())
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        say()
        east, north, _ = place(drone.feedback())
        gone = math.hypot(east - begun[0], north - begun[1])
        assert gone <= radius_m, f"{what}: it went {gone:.2f} m"
        time.sleep(0.05)


def runtime_folder() -> tempfile.TemporaryDirectory[str]:
    """Provide a folder for the sockets of these proxies alone."""
    return tempfile.TemporaryDirectory(prefix="skyloop-", dir=Path(tempfile.gettempdir()))

"""Measure the delay that the bridge to ROS 2 adds, in one run with Skyloop's own: ``python -m benchmarks.ros``.

Four processes: a simulated drone's proxy, the bridge, an rclpy program that flies by ``cmd_vel`` and receives images,
and this one, which receives the same images and the echoes of the commands like any Skyloop client.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import msgspec

from benchmarks.measuring.statistics import Summary, summarize
from benchmarks.measuring.tables import Table, median_and_p99
from skyloop.bench import Machine
from skyloop.client import Drone, connect
from skyloop.errors import NoAnswerError, UnsupportedError
from skyloop.messages import Applied, Velocity
from skyloop.vehicles.ros2.node import LOOPBACK_PROFILE, PROFILES_VARIABLE

ADDRESS: Final = "sim://?world=room&seed=0"
PERIOD_S: Final = 1 / 32  #: period of the velocities, as in ``ros_probe.py``
STEP: Final = 1e-4  #: step between their yaw rates, as there [rad/s]
IMAGE_PERIOD_S: Final = 1 / 30
PROBE: Final = Path(__file__).parent / "ros_probe.py"
STARTS_WITHIN_S: Final = 30.0


class RosDelays(msgspec.Struct, frozen=True):
    """A whole run, as in ``ros.json``.

    ``command``: from the published Twist until it is applied; ``command_own``: the part from the bridge on, as for a
    Skyloop application. ``image``: from capture to the rclpy callback; ``image_own``: to the Skyloop callback.
    """

    machine: Machine
    seconds: float
    command: Summary
    command_own: Summary
    image: Summary
    image_own: Summary


def measure(
    seconds: float,
    ros_python: str | None = None,
    progress: Callable[[float, str], None] = lambda _share, _what: None,
) -> RosDelays:
    """Fly for this time, and measure.

    Args:
        seconds: The duration [s].
        ros_python: An interpreter with rclpy and Skyloop; None for that in ``SKYLOOP_ROS_PYTHON``, or this one.
        progress: Called with the fraction done, 0 to 1, and the next step.

    Raises:
        NoAnswerError: A process did not start, or failed.
        UnsupportedError: rclpy is not installed.
    """
    python = ros_python or os.environ.get("SKYLOOP_ROS_PYTHON", sys.executable)
    if subprocess.run([python, "-c", "import rclpy, skyloop"], capture_output=True, check=False).returncode:
        raise UnsupportedError(f"{python} has no rclpy with Skyloop: skyloop install ros, or --ros-python")
    machine = Machine.here()
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        environment = _environment(Path(folder))
        os.environ["SKYLOOP_RUNTIME_DIR"] = environment["SKYLOOP_RUNTIME_DIR"]
        own = [sys.executable, "-m", "skyloop", "proxy", ADDRESS, "--name", "bench"]
        bridge = [python, "-m", "skyloop", "ros", "bench", "--priority", "16"]
        with _running(own, environment, "ready"), _running(bridge, environment, "ready"):
            progress(0.0, "a flight by cmd_vel")
            with connect("bench", access="observe", name="bench eye") as drone:
                echoes, ages_ns = _watch(drone)
                probe = [python, str(PROBE), "/bench", str(seconds)]
                done = subprocess.run(probe, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise NoAnswerError(f"the rclpy program failed: {done.stderr[-500:]}")
    told = json.loads(done.stdout.splitlines()[-1])
    return _judged(machine, seconds, told["published_ns"], told["image_ages_ns"], echoes, ages_ns)


def table(results: RosDelays) -> Table:
    """Return the delays of both channels, Skyloop's own, and the bridge's addition to the median."""
    rows = []
    for name, whole, own in (
        ("command: Twist published → applied", results.command, results.command_own),
        ("image: captured → callback", results.image, results.image_own),
    ):
        added_us = whole.median_us - own.median_us
        rows.append([name, str(whole.samples), median_and_p99(whole), median_and_p99(own), f"{added_us:.0f}"])
    columns = ["", "samples", "by ROS 2", "Skyloop's own", "added to the median"]
    return Table("Delays in µs by the bridge to ROS 2: median (99th percentile)", columns, rows)


def _environment(folder: Path) -> dict[str, str]:
    """Return an environment that isolates ROS 2 and Skyloop from the rest of this machine."""
    profile = folder / "loopback.xml"
    profile.write_text(LOOPBACK_PROFILE)
    places = {PROFILES_VARIABLE: str(profile), "SKYLOOP_RUNTIME_DIR": str(folder / "run")}
    return {**os.environ, **places, "ROS_DOMAIN_ID": str(1 + os.getpid() % 100)}


def _watch(drone: Drone) -> tuple[dict[int, Applied], list[int]]:
    """Return the echoes, by the number of their velocity, and the ages of frames [ns]; both are filled later."""
    echoes: dict[int, Applied] = {}
    ages_ns: list[int] = []

    def on_command(echo: Applied) -> None:
        if isinstance(echo.asked, Velocity):
            echoes.setdefault(round(echo.asked.yaw_rate / STEP), echo)  # the first one, because the others are repeats

    drone.on_command(on_command)
    drone.on_frame(lambda frame: ages_ns.append(drone.now_ns - frame.captured_ns))
    return echoes, ages_ns


def _judged(
    machine: Machine,
    seconds: float,
    published_ns: list[int],
    image_ages_ns: list[int],
    echoes: dict[int, Applied],
    ages_ns: list[int],
) -> RosDelays:
    found = {number: echoes[number] for number in range(1, len(published_ns)) if number in echoes}
    sent = len(published_ns)
    images = round(seconds / IMAGE_PERIOD_S)
    by_ros = [echo.applied_ns - published_ns[number] for number, echo in found.items()]
    return RosDelays(
        machine,
        seconds,
        command=summarize(by_ros, sent=sent, period_s=PERIOD_S),
        command_own=summarize([e.applied_ns - e.sent_ns for e in found.values()], sent=sent, period_s=PERIOD_S),
        image=summarize(image_ages_ns, sent=images, period_s=IMAGE_PERIOD_S),
        image_own=summarize(ages_ns, sent=images, period_s=IMAGE_PERIOD_S),
    )


@contextmanager
def _running(command: list[str], environment: dict[str, str], ready: str) -> Iterator[None]:
    """Run a process for the block, which begins when it prints a line that starts with ``ready``."""
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        try:
            end = time.monotonic() + STARTS_WITHIN_S
            while not child.stdout.readline().startswith(ready):
                if child.poll() is not None or time.monotonic() > end:
                    raise NoAnswerError(f"{' '.join(command)} did not start within {STARTS_WITHIN_S:g} s")
            yield
        finally:
            if child.poll() is None:
                child.send_signal(signal.SIGINT)
                try:
                    child.wait(30)
                except subprocess.TimeoutExpired:
                    child.kill()


if __name__ == "__main__":
    from benchmarks.command import main

    main("ros")

"""Functions that the tests run in an application on another host; :class:`Remote` calls each one there."""

from __future__ import annotations

import threading
import time
from typing import Any

import skyloop
from skyloop.messages import Applied, Event, LinkState
from tests.promises.hosts.remote import Here
from tests.support.processes import eventually

PERIOD_S = 0.05


def connect(here: Here, target: str, /, *, priority: int = 16, **options: Any) -> str:
    """Connect, and record changes of the link and events; returns the address connected to."""
    drone = here.drones[target] = skyloop.connect(target, authority=skyloop.Authority(priority=priority), **options)
    drone.on_link(here.tell(f"{target} link"))
    drone.on_event(here.tell(f"{target} event"), inline=True)
    return drone.link.application.value


def close(here: Here, name: str) -> None:
    here.drones.pop(name).close()


def call(here: Here, name: str, method: str, *arguments: Any, **keywords: Any) -> Any:
    """Call a method of the drone."""
    return getattr(here.drones[name], method)(*arguments, **keywords)


def wait(here: Here, name: str, state: str, timeout_s: float = 10.0) -> None:
    here.drones[name].wait(state, timeout_s=timeout_s)


def wait_link(here: Here, name: str, state: str, since_ns: int = 0, timeout_s: float = 10.0) -> int:
    """Wait until the link was reported in this state, at this time or later; returns when."""
    told = here.told[f"{name} link"]

    def when() -> list[int]:
        return [at for at, status in list(told) if at >= since_ns and status.application is LinkState(state)]

    eventually(lambda: bool(when()), f"the link to {name} is {state}: {told}", timeout_s)
    return when()[0]


def wait_authority(here: Here, name: str, state: str, timeout_s: float = 10.0) -> int:
    """Wait for the authority to be in this state; returns when it was seen."""
    eventually(lambda: here.drones[name].authority.state == state, f"the authority is {state}", timeout_s)
    return time.monotonic_ns()


def keep_flying(here: Here, name: str, forward: float = 0.1) -> None:
    """Send new commands twenty times a second, whatever the results, until :func:`stop_flying`."""
    end = here.objects[f"{name} end"] = threading.Event()
    calls = here.objects[f"{name} calls"] = []
    drone = here.drones[name]

    def fly() -> None:
        while not end.wait(PERIOD_S):
            try:
                sent = drone.velocity(forward=forward)
            except skyloop.AuthorityError:
                sent = False
            calls.append((time.monotonic_ns(), sent))

    thread = here.objects[f"{name} thread"] = threading.Thread(target=fly, daemon=True)
    thread.start()


def stop_flying(here: Here, name: str) -> list[tuple[int, bool]]:
    """Stop flying; returns the times of the calls, and whether each sent a command."""
    here.objects[f"{name} end"].set()
    here.objects[f"{name} thread"].join()
    calls: list[tuple[int, bool]] = here.objects[f"{name} calls"]
    return calls


def watch_commands(here: Here, name: str) -> None:
    """Record each command that the proxy received."""
    here.drones[name].on_command(here.tell(f"{name} command"), inline=True)


def commands(here: Here, name: str) -> list[Applied]:
    return [applied for _, applied in list(here.told.get(f"{name} command", []))]


def events(here: Here, name: str) -> list[Event]:
    return [event for _, event in list(here.told[f"{name} event"])]


def links(here: Here, name: str) -> list[tuple[int, str]]:
    return [(at, status.application.value) for at, status in list(here.told[f"{name} link"])]


def watch_frames(here: Here, name: str, /, **options: Any) -> None:
    """Record the shape, the age [s] and the time of capture [ns] of each frame."""
    write = here.tell(f"{name} frame")
    here.drones[name].on_frame(lambda frame: write((frame.shape, frame.age_s, frame.captured_ns)), **options)


def frames(here: Here, name: str) -> list[tuple[int, tuple[tuple[int, ...], float, int]]]:
    return list(here.told[f"{name} frame"])


def wait_frames(here: Here, name: str, number: int, since_ns: int = 0, timeout_s: float = 15.0) -> int:
    """Wait for this many frames, from now or from a given time; returns when the last one arrived."""
    told = here.told[f"{name} frame"]
    since_ns = since_ns or time.monotonic_ns()

    def came() -> list[int]:
        return [at for at, _ in list(told) if at >= since_ns]

    eventually(lambda: len(came()) >= number, f"{number} frames came", timeout_s)
    return came()[number - 1]


def wait_failsafe(here: Here, name: str, step: str, timeout_s: float = 10.0) -> int:
    """Wait until feedback shows a step of the failsafe ladder; returns when it was seen."""
    here.drones[name].wait(lambda feedback: feedback.failsafe.value == step, timeout_s=timeout_s)
    return time.monotonic_ns()


def feedback(here: Here, name: str) -> skyloop.Feedback:
    return here.drones[name].feedback()


def clock(here: Here, name: str) -> tuple[int, int]:
    """The proxy's clock minus this host's, as estimated, and its uncertainty [ns]."""
    drone = here.drones[name]
    return drone.clock_offset_ns, drone.clock_uncertainty_ns


def set_parameter(here: Here, name: str, parameter: str, value: float) -> None:
    here.drones[name].config[parameter] = value


def parameter(here: Here, name: str, parameter: str) -> Any:
    return here.drones[name].config[parameter]


def priority(here: Here, name: str) -> int:
    """The priority with which the authority is held."""
    found = here.drones[name].authority.priority
    assert found is not None
    return found


def watch_numbers(here: Here, name: str) -> None:
    """Record the number of each feedback packet, including duplicates."""
    found = here.objects[f"{name} numbers"] = []
    connection = here.drones[name]._connection.session
    assert connection is not None
    monitor = connection.monitor
    original = monitor.feedback

    def feedback(seq: int, now_ns: int, skipped: int = 0) -> bool:
        found.append(seq)
        return original(seq, now_ns, skipped)

    monitor.feedback = feedback  # type: ignore[method-assign]


def numbers(here: Here, name: str, count: int) -> list[int]:
    """Numbers of this many feedback packets."""
    found: list[int] = here.objects[f"{name} numbers"]
    eventually(lambda: len(found) >= count, f"{count} samples of feedback came")
    return list(found)

"""Trace the four most important paths through Skyloop on a live proxy, and count the files and calls of each.

    python scripts/paths.py            # the table
    python scripts/paths.py --list     # each call as well; --json: all as JSON
    python scripts/paths.py --check    # holds them against scripts/budgets.toml: `make check`

A simulated drone, its proxy, the local transport and the application run in this process, and ``sys.settrace`` records
each call of a function of the package. Only the pilot that dies is a separate process, which is killed.

- *velocity*: from ``drone.velocity()`` of a pilot in flight to the simulator's control loops.
- *frame*: from the simulated camera's finished image, at the driver, to the application's ``on_frame`` callback.
- *parameter*: from ``drone.config["limits.speed"] = …``, which proxy and vehicle share, to its confirmation.
- *death*: from the transport's notice that the pilot's connection ended to the end of the thread that received from it;
  meanwhile the vehicle was sent a hover.

Counting:

- A *call* is a call of a function or method of the package, including properties, or the resumption of a
  generator. Comprehensions belong to their function. Calls of Python and libraries, generated methods (as of
  dataclasses), and other threads than the path's are not counted.
- *files*: those that the calls are in.
- *returns*: calls into a file that the path had left: the call before was in another file. Returning from a call does
  not count.

Calls are put in the order of the path's threads, and within each in that of time: threads that run at once would
otherwise be mixed differently in each run. A path is run several times and the run with the fewest calls counts, as
feedback or a ping on one of its threads can only add to it; *spread* has the calls of all runs.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import groupby
from pathlib import Path
from types import FrameType
from typing import Final, NamedTuple

import skyloop

PACKAGE: Final = str(Path(skyloop.__file__).parent) + os.sep
BUDGETS: Final = Path(__file__).with_name("budgets.toml")
RUNS: Final = 6
TRIES: Final = 3  #: how often to trace everything again if a budget is exceeded or a path incomplete
WAIT_S: Final = 20.0
QUIET_S: Final = 0.05  #: a path is over once its threads have been quiet for this long
ADDRESS: Final = "sim://?rate=1&cameras=front&width=64&height=48&fps=3"
PILOT: Final = f"""import time, skyloop
drone = skyloop.connect("gauge", rate_hz=1, network=False, timeout_s={WAIT_S})
drone.feedback().state.airborne or drone.takeoff()
print(drone.hover(), flush=True)
time.sleep({WAIT_S})
"""
#: Parameters of the proxy that let a slow run continue: no hover or landing because the computer is busy.
PATIENT: Final = ("authority.timeout_s", "failsafe.hover_after_s", "failsafe.land_after_s", "command.max_age_s")
#: The path's threads by the suffixes of their names, in the path's order.
THREADS: Final = {
    "velocity": ("MainThread", "-peer"),
    "frame": ("-cameras", "-client", " of front"),
    "parameter": ("MainThread", "-peer", "-requests", "-client"),
    "death": ("-peer",),
}
#: The beginnings and ends of paths: prefix of the file, suffix of the function.
ANYWHERE: Final = ("", "")
SIMULATOR: Final = ("sim/", "")
CAMERA: Final = ("vehicles/", ".show")
HANG_UP: Final = ("transport/", "._end")
CALLBACK: Final = ("application", "on_frame")
_PARTS: Final = ("<listcomp>", "<setcomp>", "<dictcomp>", "<genexpr>", "<module>")


class Call(NamedTuple):
    """A call of a function of the package."""

    thread: str
    file: str
    function: str

    def at(self, place: tuple[str, str]) -> bool:
        """Return whether its file begins, and its function ends, like this."""
        return self.file.startswith(place[0]) and self.function.endswith(place[1])


class Tracer:
    """Records calls on this thread and on later ones while a path is traced."""

    def __init__(self) -> None:
        self.calls: list[Call] = []
        self._threads: tuple[str, ...] = ()
        self._begins = ANYWHERE
        threading.settrace(self._trace)
        sys.settrace(self._trace)

    def _trace(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if self._threads and event == "call" and code.co_filename.startswith(PACKAGE) and code.co_name not in _PARTS:
            thread, file = threading.current_thread().name, code.co_filename.removeprefix(PACKAGE)
            call = Call(thread, file, code.co_qualname)
            if thread.endswith(self._threads) and (self.calls or call.at(self._begins)):
                self.calls.append(call)

    @contextmanager
    def tracing(self, path: str, begins: tuple[str, str] = ANYWHERE) -> Iterator[None]:
        """Record the calls on a path's threads during the block, from the first at this place on."""
        self.calls, self._threads, self._begins = [], THREADS[path], begins
        try:
            yield
        finally:
            self._threads = ()

    def settled(self, ends: tuple[str, str] = ANYWHERE) -> list[Call]:
        """Return the calls, thread by thread, once one was at this place and all are quiet."""
        deadline_s = time.monotonic() + WAIT_S
        while time.monotonic() < deadline_s:
            count = len(self.calls)
            time.sleep(QUIET_S)
            if len(self.calls) == count and any(call.at(ends) for call in self.calls):
                return [call for end in self._threads for call in self.calls if call.thread.endswith(end)]
        return []


def figures(calls: Sequence[Call]) -> dict[str, int]:
    """Return a path's files, calls and returns."""
    files = [file for file, _ in groupby(call.file for call in calls)]
    return {"files": len(set(files)), "calls": len(calls), "returns": len(files) - len(set(files))}


def until(calls: Sequence[Call], last: tuple[str, str]) -> list[Call]:
    """Return the calls up to the last at this place; none if there is none."""
    return list(calls[: max((n for n, call in enumerate(calls, 1) if call.at(last)), default=0)])


def velocities(tracer: Tracer, drone: skyloop.Drone) -> Iterator[list[Call]]:
    for n in range(RUNS + 1):  # the first starts the hovering drone moving
        time.sleep(0.1)  # the connection's thread would send a sooner one
        with tracer.tracing("velocity"):
            drone.velocity(forward=0.1 if n % 2 else -0.1)
            path = tracer.settled(SIMULATOR)
        if n and any(call.thread == "MainThread" and call.at(("transport/", "")) for call in path):
            yield until(path, SIMULATOR)


def parameters(tracer: Tracer, drone: skyloop.Drone) -> Iterator[list[Call]]:
    for n in range(RUNS):
        with tracer.tracing("parameter"):
            drone.config["limits.speed"] = 2.0 + 0.1 * (n % 2)
            yield tracer.settled()


def frames(tracer: Tracer, drone: skyloop.Drone) -> Iterator[list[Call]]:
    def on_frame(_: skyloop.Frame) -> None:
        tracer.calls.append(Call(threading.current_thread().name, *CALLBACK))

    drone.on_frame(on_frame)
    for n in range(RUNS + 1):  # the first creates objects that later ones reuse
        with tracer.tracing("frame", CAMERA):
            path = until(tracer.settled(CALLBACK), CALLBACK)
        if n and [sum(call.at(place) for call in path) for place in (CAMERA, CALLBACK)] == [1, 1]:
            yield path[:-1]


def deaths(tracer: Tracer) -> Iterator[list[Call]]:
    for _ in range(RUNS // 2):
        with subprocess.Popen([sys.executable, "-c", PILOT], stdout=subprocess.PIPE, text=True) as pilot:
            assert pilot.stdout is not None
            flies = pilot.stdout.readline() == "True\n"
            time.sleep(QUIET_S)
            with tracer.tracing("death", HANG_UP):
                pilot.kill()
                yield tracer.settled(SIMULATOR) if flies else []


def trace() -> dict[str, list[list[Call]]]:
    """Fly, and return the complete runs of each path."""
    sys.modules["numba"] = None  # type: ignore[assignment]  # its import and compiling are slow, above all traced
    import skyloop.sim.camera_pipeline
    from skyloop.drivers.registry import make_driver
    from skyloop.proxy.proxy import Proxy
    from skyloop.transport.local import LocalServer

    tracer = Tracer()
    with ExitStack() as around:
        os.environ["SKYLOOP_RUNTIME_DIR"] = around.enter_context(tempfile.TemporaryDirectory(prefix="skyloop-"))
        around.enter_context(Proxy(make_driver(ADDRESS), LocalServer("gauge"), name="gauge"))
        with skyloop.connect(
            "gauge", network=False, on_exit="hover", rate_hz=1.0, timeout_s=WAIT_S, stall_s=math.inf
        ) as drone:
            for name in PATIENT:
                drone.config[name] = 10.0
            drone.takeoff()
            runs = {"velocity": list(velocities(tracer, drone)), "parameter": list(parameters(tracer, drone))}
            runs["frame"] = list(frames(tracer, drone))
        runs["death"] = list(deaths(tracer))
        sys.settrace(None)
    return {name: [run for run in each if run] for name, each in runs.items()}


def over(measured: Mapping[str, Mapping[str, int]], budgets: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Return a sentence for each exceeded budget, and for each incomplete path."""
    return [f"{name} was not complete in any run" for name in THREADS if name not in measured] + [
        f"{name}: {key} are {row[key]}, the budget is {most}"
        for name, row in measured.items()
        for key, most in budgets.get(name, {}).items()
        if row[key] > most
    ]


def main(arguments: Sequence[str]) -> int:
    """Return 0 unless a path was incomplete, or a budget is exceeded."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--list", action="store_true", help="print each call as well")
    parser.add_argument("--json", action="store_true", help="print all as JSON")
    parser.add_argument("--check", action="store_true", help="hold them against scripts/budgets.toml")
    options = parser.parse_args(arguments)
    if sys.platform != "linux":
        parser.exit(message="paths are traced on Linux only, over its local transport\n")
    budgets = tomllib.loads(BUDGETS.read_text(encoding="utf-8"))["paths"] if options.check else {}
    runs: dict[str, list[list[Call]]] = {name: [] for name in THREADS}
    for _ in range(TRIES):
        for name, more in trace().items():
            runs[name] += more
        paths = {name: min(each, key=len) for name, each in runs.items() if each}
        measured = {name: figures(path) for name, path in paths.items()}
        found = over(measured, budgets)
        if not found:
            break
    if options.json:
        print(json.dumps({name: {**measured[name], "path": path} for name, path in paths.items()}, indent=1))
    else:
        print(f"{'path':10}{'files':>7}{'calls':>7}{'returns':>9}  spread of calls")
        for name, row in measured.items():
            spread = " ".join(str(len(run)) for run in runs[name])
            print(f"{name:10}{row['files']:7}{row['calls']:7}{row['returns']:9}  {spread}")
            for thread, calls in groupby(paths[name] if options.list else [], lambda call: call.thread):
                print(f"  on {thread}", *(f"    {call.file:36} {call.function}" for call in calls), sep="\n")
    print(*found, sep="\n", file=sys.stderr, end="\n" if found else "")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

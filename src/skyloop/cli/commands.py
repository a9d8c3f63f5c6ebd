"""The commands of ``skyloop``, by what one wants to do: a line for each. A new command is one more line here.

Help and error messages are made of this table; the module of a command is imported when that command is used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, Final, NamedTuple


class Task(StrEnum):
    """What one wants to do, in the order in which ``skyloop --help`` shows it."""

    FLY = "Fly"
    SEE = "See"
    SHARE = "Share"
    RECORD = "Record"
    SET_UP = "Set up"
    MEASURE = "Measure"


class Entry(NamedTuple):
    """One command: where its function is, its line in the list of commands, how it is called and what it needs."""

    task: Task
    home: str  # module of skyloop.cli, and function
    summary: str  # up to 60 characters, so that the list fits into 80 columns
    example: str
    extras: tuple[str, ...] = ()  # optional parts that it needs: who lacks one is told of all that are missing
    settings: Mapping[str, Any] = {}
    behaviours: Mapping[str, Entry] = {}  # commands that take its place where they are its first word

    @property
    def module(self) -> str:
        """The module of its function, in ``skyloop.cli``."""
        return self.home.partition(":")[0]

    @property
    def function(self) -> str:
        """The name of its function, or of a :class:`typer.Typer` with commands of its own."""
        return self.home.partition(":")[2]


COMMANDS: Final = {
    "demo": Entry(
        Task.FLY,
        "demo:demo",
        "A simulated drone finds a marker and follows it",
        "demo --seconds 30",
        ("sim", "vision", "cockpit"),
    ),
    "sim": Entry(
        Task.FLY,
        "sim:sim",
        "Simulated drones in one world, with a proxy each",
        "sim --drones 3 --world room --seed 1",
        ("sim",),
    ),
    "fly": Entry(
        Task.FLY,
        "fly:fly",
        "Fly a controller from a Python file, or follow a target",
        "fly my_controller.py --drone alpha --seconds 30",
        ("sim", "vision"),
        behaviours={
            "follow": Entry(
                Task.FLY,
                "fly_follow:fly_follow",
                "Follow what is in a box, or of a class",
                "fly follow --class person --seconds 60",
                ("vision", "detect"),
            )
        },
    ),
    "route": Entry(
        Task.FLY, "route:route", "Check and fly routes of waypoints", "route fly tour.route.json --drone alpha"
    ),
    "teleop": Entry(Task.FLY, "teleop:teleop", "Fly a drone by the keys of the terminal", "teleop alpha --speed 0.5"),
    "land": Entry(Task.FLY, "ending:land", "Land a drone, or --all of them", "land alpha"),
    "return": Entry(
        Task.FLY, "ending:return_to_start", "Fly a drone, or --all, back to its start and land", "return alpha"
    ),
    "stop": Entry(Task.FLY, "ending:stop", "Emergency stop: cut a drone's motors, or --all", "stop alpha"),
    "preflight": Entry(
        Task.FLY, "doctor:preflight", "What speaks against a flight, and what to do about it", "preflight alpha"
    ),
    "list": Entry(Task.SEE, "listing:list_proxies", "The running proxies and who flies", "list"),
    "watch": Entry(Task.SEE, "watch:watch", "What a drone does, live in the terminal", "watch alpha"),
    "cockpit": Entry(
        Task.SEE,
        "cockpit:cockpit",
        "A page in the browser to watch and fly drones",
        "cockpit --port 8000",
        ("cockpit",),
    ),
    "view": Entry(Task.SEE, "record:view", "Show drones live in Foxglove or Rerun", "view alpha --foxglove"),
    "process": Entry(
        Task.SEE, "process:process", "Run a class of yours on a drone's frames", "process detector.py --drone alpha"
    ),
    "detect": Entry(
        Task.SEE,
        "process:detect",
        "Detect with your ONNX file in a drone's frames, drawn live",
        "detect my.onnx --on alpha",
        ("detect", "vision"),
    ),
    "proxy": Entry(Task.SHARE, "host:proxy", "Serve one vehicle under a name", "proxy sim:// --name alpha"),
    "host": Entry(
        Task.SHARE,
        "host:host",
        "Serve many vehicles from one process",
        "host fleet.toml",
        behaviours={
            "status": Entry(Task.SHARE, "host:status", "The vehicles of a running host", "host status"),
            "add": Entry(Task.SHARE, "host:add", "Serve one more vehicle", "host add delta tello://192.168.10.1"),
            "remove": Entry(Task.SHARE, "host:remove", "Land a vehicle and serve it no longer", "host remove delta"),
        },
    ),
    "router": Entry(
        Task.SHARE,
        "network:router",
        "Join proxies and programs of several networks",
        "router --network other-site.example:7447",
        ("network",),
    ),
    "keys": Entry(
        Task.SHARE,
        "network:keys",
        "Who may join the network: make, issue, revoke keys",
        "keys issue jane --role pilot",
        ("network",),
    ),
    "ros": Entry(Task.SHARE, "ros:ros", "Drones as nodes of ROS 2", "ros --drone alpha --priority 16", ("ros",)),
    "audit": Entry(Task.SHARE, "listing:audit", "Who flew which drone when", "audit alpha --last 20"),
    "record": Entry(
        Task.RECORD, "record:record", "Record drones to an MCAP file", "record alpha -o flight.mcap", ("record",)
    ),
    "log": Entry(
        Task.RECORD, "log:log", "Inspect, export, compare and repair recordings", "log info flight.mcap", ("record",)
    ),
    "doctor": Entry(
        Task.SET_UP,
        "doctor:doctor",
        "What of this machine works, what to install",
        "doctor mavlink://tcp:127.0.0.1:5760",
    ),
    "install": Entry(Task.SET_UP, "install:install", "Install optional parts of Skyloop", "install sim vision cockpit"),
    "param": Entry(
        Task.SET_UP,
        "param:param",
        "List, show or write a vehicle's parameters",
        "param alpha limits.tilt 0.2",
        settings={"ignore_unknown_options": True},  # a value may begin with a minus
    ),
    "camera": Entry(
        Task.SET_UP,
        "camera:camera",
        "Print a board, and calibrate a camera by it",
        "camera calibrate alpha",
        ("vision",),
    ),
    "bench": Entry(Task.MEASURE, "bench:bench", "Measure the delays of each channel", "bench delays --seconds 30"),
}


def entry_of(words: Sequence[str]) -> Entry | None:
    """Return the command that the words of a command line are for; None for no or an unknown one."""
    plain = [word for word in words if not word.startswith("-")]
    entry = COMMANDS.get(plain[0]) if plain else None
    return entry if entry is None or len(plain) < 2 else entry.behaviours.get(plain[1], entry)

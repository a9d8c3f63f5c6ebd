"""All commands of ``skyloop``, grouped by task, with one line for each. To add a command, add a line.

Help and error messages are based on this table; a command's module is imported when the command is used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, Final, NamedTuple


class Task(StrEnum):
    """A group of commands, in the order of ``skyloop --help``."""

    FLY = "Fly"
    SEE = "See"
    SHARE = "Share"
    RECORD = "Record"
    SET_UP = "Set up"
    MEASURE = "Measure"


class Entry(NamedTuple):
    """One command: the location of its function, its line in the list of commands, an example and its requirements."""

    task: Task
    home: str  # module in skyloop.cli, and the function in it
    summary: str  # up to 60 characters long, so that the list fits into 80 columns
    example: str
    extras: tuple[str, ...] = ()  # optional parts that the command needs; an error names all that are missing
    settings: Mapping[str, Any] = {}
    behaviours: Mapping[str, Entry] = {}  # commands that run instead if the first word is their name

    @property
    def module(self) -> str:
        """The function's module in ``skyloop.cli``."""
        return self.home.partition(":")[0]

    @property
    def function(self) -> str:
        """The name of the function, or of a :class:`typer.Typer` that has subcommands."""
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
                "fly:fly_follow",
                "Follow the target in a box, or one of a class",
                "fly follow --class person --seconds 60",
                ("vision", "detect"),
            )
        },
    ),
    "route": Entry(
        Task.FLY, "route:route", "Check and fly routes of waypoints", "route fly tour.route.json --drone alpha"
    ),
    "teleop": Entry(Task.FLY, "teleop:teleop", "Fly a drone with the terminal's keys", "teleop alpha --speed 0.5"),
    "land": Entry(Task.FLY, "ending:land", "Land a drone, or --all of them", "land alpha"),
    "return": Entry(
        Task.FLY, "ending:return_to_start", "Fly a drone, or --all, back to its start and land", "return alpha"
    ),
    "stop": Entry(Task.FLY, "ending:stop", "Emergency stop: cut a drone's motors, or --all", "stop alpha"),
    "preflight": Entry(Task.FLY, "doctor:preflight", "Check that a drone is ready to fly", "preflight alpha"),
    "list": Entry(Task.SEE, "listing:list_proxies", "List running proxies and their pilots", "list"),
    "watch": Entry(Task.SEE, "watch:watch", "Watch a drone live in the terminal", "watch alpha"),
    "cockpit": Entry(
        Task.SEE, "cockpit:cockpit", "Serve a web page to watch and fly drones", "cockpit --port 8000", ("cockpit",)
    ),
    "view": Entry(Task.SEE, "record:view", "Show drones live in Foxglove or Rerun", "view alpha --foxglove"),
    "process": Entry(
        Task.SEE, "process:process", "Run your own class on a drone's frames", "process detector.py --drone alpha"
    ),
    "detect": Entry(
        Task.SEE,
        "process:detect",
        "Run your ONNX detector on a drone's frames, drawn live",
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
            "status": Entry(Task.SHARE, "host:status", "Show the vehicles of a running host", "host status"),
            "add": Entry(Task.SHARE, "host:add", "Serve one more vehicle", "host add delta tello://192.168.10.1"),
            "remove": Entry(Task.SHARE, "host:remove", "Land a vehicle and stop serving it", "host remove delta"),
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
        "Make, issue and revoke the network's keys",
        "keys issue jane --role pilot",
        ("network",),
    ),
    "ros": Entry(Task.SHARE, "ros:ros", "Show drones as nodes of ROS 2", "ros --drone alpha --priority 16", ("ros",)),
    "audit": Entry(Task.SHARE, "listing:audit", "Show who flew which drone when", "audit alpha --last 20"),
    "record": Entry(
        Task.RECORD, "record:record", "Record drones to an MCAP file", "record alpha -o flight.mcap", ("record",)
    ),
    "log": Entry(
        Task.RECORD, "log:log", "Inspect, export, compare and repair recordings", "log info flight.mcap", ("record",)
    ),
    "doctor": Entry(
        Task.SET_UP, "doctor:doctor", "Check this machine, or one vehicle", "doctor mavlink://tcp:127.0.0.1:5760"
    ),
    "install": Entry(Task.SET_UP, "install:install", "Install optional parts of Skyloop", "install sim vision cockpit"),
    "param": Entry(
        Task.SET_UP,
        "param:param",
        "List, show or write a vehicle's parameters",
        "param alpha limits.tilt 0.2",
        settings={"ignore_unknown_options": True},  # a value may begin with a minus sign
    ),
    "camera": Entry(
        Task.SET_UP,
        "camera:camera",
        "Print a board, and calibrate a camera with it",
        "camera calibrate alpha",
        ("vision",),
    ),
    "bench": Entry(Task.MEASURE, "bench:bench", "Measure the delays of each channel", "bench delays --seconds 30"),
}


def entry_of(words: Sequence[str]) -> Entry | None:
    """Return the command selected by the words of a command line, or None if there is no command or it is unknown."""
    plain = [word for word in words if not word.startswith("-")]
    entry = COMMANDS.get(plain[0]) if plain else None
    return entry if entry is None or len(plain) < 2 else entry.behaviours.get(plain[1], entry)

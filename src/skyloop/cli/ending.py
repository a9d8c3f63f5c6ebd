"""``skyloop land``, ``return`` and ``stop``: end the flight of one drone, or of all drones, from any terminal."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
import typer

from skyloop.cli.naming import DronesOption, KeysOption, NamesArgument, NetworkOption, drones, join_network
from skyloop.cli.text import error_text, print_json
from skyloop.errors import AuthorityError, LinkError, NoAnswerError, SkyloopError, UsageError
from skyloop.extend import Known, connect_to_stop, let_go

if TYPE_CHECKING:
    from skyloop.client import Drone

FRESH_S: Final = 1.0  #: maximum age at which a state can still be trusted
LANDING_S: Final = 60.0  #: maximum time to wait for a landing
RETURN_S: Final = 600.0  #: maximum time to wait for a return
STOPPING_S: Final = 3.0  #: time for which a stop is repeated until the vehicle reports it
_REPEAT_S: Final = 0.1  # interval at which it is repeated
LEAVE: Final = "take over with --priority 0, or ask them"

PriorityOption = Annotated[
    int | None, typer.Option(metavar="P", min=0, max=31, help="0, the highest, takes over [default: 16; with --all: 0]")
]
AllOption = Annotated[bool, typer.Option("--all", help="All drones on this host, or on the --network")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON array once all have ended")]


class Ending(msgspec.Struct, frozen=True):
    """The result of ending one drone's flight."""

    name: str
    ok: bool
    outcome: str  #: how the flight ended, or why it did not end


def land(
    names: NamesArgument = None,
    drone: DronesOption = None,
    every: AllOption = False,
    priority: PriorityOption = None,
    json: JsonOption = False,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Land drones and wait until they have landed.

    A drone that another application is flying is reported and left alone, unless --priority is higher (a lower number).
    With --all, every drone lands except those flown with the highest priority. Exit code 1 if a drone has not landed.
    """
    chosen = _chosen(names, drone, every, network, keys)
    wanted = _priority(priority, every)
    _each(chosen, lambda name: _land(name, wanted), "NOT landed", json)


def return_to_start(
    names: NamesArgument = None,
    drone: DronesOption = None,
    every: AllOption = False,
    height: Annotated[
        float | None,
        typer.Option(
            metavar="M", min=0.0, help="Minimum height above the start on the way [m] [default: return.height]"
        ),
    ] = None,
    priority: PriorityOption = None,
    json: JsonOption = False,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Fly drones back to their take-off positions, land there, and wait until they have landed.

    Each drone climbs, flies straight to a point above its start and lands; nothing keeps drones apart on the way. A
    drone flown by another application is reported and left alone, unless --priority is higher (a lower number). Exit
    code 1 if a drone has not landed at its start. Such a drone, and every drone after Ctrl-C, hovers and lands 5 s
    later unless someone flies it.
    """
    chosen = _chosen(names, drone, every, network, keys)
    wanted = _priority(priority, every)
    flown: list[Drone] = []
    interrupted = threading.Event()

    def stay() -> None:
        interrupted.set()
        for one in flown:
            _stay(one)

    def back(name: str) -> str:
        return _return(name, wanted, height, flown, interrupted)

    _each(chosen, back, "NOT returned", json, stay)


def stop(
    names: NamesArgument = None,
    drone: DronesOption = None,
    every: AllOption = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Don't ask: cut the motors at once")] = False,
    json: JsonOption = False,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Emergency stop: cut the motors immediately. The drones FALL.

    It works no matter who is flying. It asks first, except with --yes. Exit code 1 if a drone did not confirm.
    """
    chosen = _chosen(names, drone, every, network, keys)
    if not yes:
        if not sys.stdin.isatty():
            raise UsageError("an emergency stop asks first: give --yes if there is no terminal to answer on")
        typer.confirm(f"Cut the motors of {', '.join(chosen)}? Flying drones FALL.", abort=True, err=True)
    _each(chosen, _stop, "NOT stopped", json)


def _priority(priority: int | None, every: bool) -> int:
    from skyloop.messages import DEFAULT_PRIORITY, HIGHEST_PRIORITY

    return (HIGHEST_PRIORITY if every else DEFAULT_PRIORITY) if priority is None else priority


def _chosen(
    names: list[str] | None, others: list[str] | None, every: bool, network: str | None, keys: Path | None
) -> list[str]:
    join_network(network, keys)
    if not every:
        return drones(names, others)
    if names or others:
        raise UsageError("--all means every drone: give either --all or names")
    from skyloop.cli.listing import none_runs
    from skyloop.client.connect import running_names
    from skyloop.network.config import choose

    found = running_names()
    if not found:
        raise LinkError(f"no drone found. {none_runs(choose())}")
    return found


def _each(
    names: Sequence[str],
    end: Callable[[str], str],
    failed: str,
    json: bool,
    interrupted: Callable[[], None] = lambda: None,
) -> None:
    """End all flights in parallel. Print a line for each drone, in the given order, as they end, or all as JSON.

    ``interrupted`` is called when Ctrl-C is pressed and must make each call of ``end`` return or raise.
    """

    def attempt(name: str) -> Ending:
        try:
            return Ending(name, True, end(name))
        except SkyloopError as error:
            return Ending(name, False, f"{failed}: {error_text(error)}")
        except Exception as error:  # noqa: BLE001 one failure must not hide the results of others
            return Ending(name, False, f"{failed}: {error!r}")

    ended = []
    with ThreadPoolExecutor(max_workers=len(names)) as pool:
        try:
            for one in pool.map(attempt, names):
                ended.append(one)
                if not json:
                    typer.echo(f"{one.name}: {one.outcome}", err=not one.ok)
        except KeyboardInterrupt:
            interrupted()
            raise
    if json:
        print_json(ended)
    if not all(one.ok for one in ended):
        raise typer.Exit(1)


def _land(name: str, priority: int) -> str:
    from skyloop.cli.listing import connect_pilot
    from skyloop.client import Authority

    over = _over_already(name, "skyloop land")
    if over:
        return over
    authority = Authority(priority=priority)
    try:
        with connect_pilot(name, LEAVE, name="skyloop land", authority=authority) as flown:
            flown.land(timeout_s=LANDING_S)
    except AuthorityError as error:
        if error.code != "busy" or not _lands_for_others(name):
            raise
        return "landed, by its pilot"
    return "landed"


def _lands_for_others(name: str) -> bool:
    """Wait while the pilot, such as another ``skyloop land``, is landing; return whether the drone is on the ground."""
    from skyloop.client import connect
    from skyloop.messages import FlightState

    with connect(name, access="observe", name="skyloop land") as seen:
        if seen.feedback().state is FlightState.LANDING:
            seen.wait("landed", LANDING_S)
        return _on_the_ground(seen)


def _stay(drone: Drone) -> None:
    """Hover permanently, so that the return is not attempted again."""
    let_go(drone, "its return was interrupted", for_good=True)


def _return(name: str, priority: int, height_m: float | None, flown: list[Drone], interrupted: threading.Event) -> str:
    from skyloop.cli.listing import connect_pilot
    from skyloop.client import Authority

    over = _over_already(name, "skyloop return")
    if over:
        return over
    authority = Authority(priority=priority)
    with connect_pilot(name, LEAVE, name="skyloop return", authority=authority, on_exit="hover") as back:
        flown.append(back)
        if interrupted.is_set():  # while connecting
            _stay(back)
        back.return_to_start(height_m, land=True, timeout_s=RETURN_S)
    return "landed at its start"


def _over_already(name: str, program: str) -> str:
    """Return the reason why there is no flight to end; empty if there is one."""
    from skyloop.client import connect

    with connect(name, access="observe", name=program) as seen:
        if not seen.capabilities.actions:
            return "takes no commands: it shows a recording or a camera"
        return "landed already" if _on_the_ground(seen) else ""


def _stop(name: str) -> str:
    """Cut the motors. This needs no authority and waits only for the connection."""
    from skyloop.messages import FlightState

    with closing(connect_to_stop(name, "skyloop stop")) as drone:
        if not drone.capabilities.actions:
            return "takes no commands: it shows a recording or a camera"
        end_s = time.monotonic() + STOPPING_S
        while time.monotonic() < end_s:
            drone.emergency_stop()
            time.sleep(_REPEAT_S)
            if (newest := Known(drone).newest) is not None and newest.state is FlightState.EMERGENCY:
                return "motors off"
        if _on_the_ground(drone):
            return "motors off, on the ground"
    raise NoAnswerError(f"sent for {STOPPING_S:g} s, but the vehicle has not confirmed it")


def _on_the_ground(drone: Drone) -> bool:
    """Return whether a recent state shows the vehicle on the ground."""
    from skyloop.messages import FlightState

    try:
        return drone.feedback(max_age_s=FRESH_S).state is FlightState.LANDED
    except NoAnswerError:
        return False

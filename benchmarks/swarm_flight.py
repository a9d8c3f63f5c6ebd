"""Fly several drones from one process, each by its own controller, and finally abandon all of them in the air.

::

    skyloop sim --drones 10 --name drone --world empty --option cameras=front --option width=64 --option fps=10
    python -m benchmarks.swarm_flight "drone*" --seconds 60

It measures the delay of each command until the driver has it, the delay of feedback, the number of frames, and needless
failsafe steps. At the end the pilot's connections close in flight, and it measures how soon each proxy makes its drone
hover, and whether it lands.

It exits with 1 if a failsafe was missed after the drones were abandoned in the air.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from skyloop.cli.text import columns
from skyloop.client import Distribution, Drone, Frame, Swarm, swarm
from skyloop.client.monitoring import distribution
from skyloop.client.swarm import Target
from skyloop.control import Controller
from skyloop.errors import SkyloopError
from skyloop.extend import Known
from skyloop.messages import Applied, Event, EventKind, Failsafe, Feedback

LAND_AFTER_S: Final = 5.0  #: default of ``failsafe.land_after_s``
_HOVER_WITHIN_S: Final = 5.0  # maximum wait for the hover
_LAND_WITHIN_S: Final = 30.0


@dataclass(frozen=True, slots=True)
class SwarmFlight:
    """The result of one drone's flight. Delays in s."""

    name: str
    commands: int  #: commands of this program that were applied
    command: Distribution | None  #: delay from sending to the driver
    feedback: Distribution | None  #: delay from the proxy's publishing to this program, of the last 1024 samples
    frames: int  #: frames passed to its controller
    refused: int  #: commands refused
    unwanted: int  #: failsafe steps while it was flown
    hover_s: float | None  #: time from abandoning it until the failsafe's hover was reported; None if missed
    landed: bool  #: whether it then landed automatically


class Rounds(Controller):
    """Flies rounds: forward while turning."""

    frames = 0

    def on_feedback(self, feedback: Feedback) -> None:  # noqa: ARG002  (it only sets the pace)
        self.drone.velocity(forward=0.2, yaw_rate=0.8)


class LookingRounds(Rounds):
    """Flies the same rounds, and receives each frame, like a controller with a camera."""

    brightness = 0.0

    def on_frame(self, frame: Frame) -> None:
        self.frames += 1
        self.brightness = float(frame.mean())


class _Notes:
    """What was observed of one drone while it was flown."""

    def __init__(self, drone: Drone) -> None:
        self.delays_ns: list[int] = []
        self.refused = self.unwanted = 0
        self._app_id = drone.app_id
        self._app = drone.feedback().owner
        drone.on_command(self._applied, inline=True)
        drone.on_event(self._event, inline=True)

    def _applied(self, applied: Applied) -> None:
        if applied.app_id == self._app_id:
            self.delays_ns.append(applied.applied_ns - applied.sent_ns)

    def _event(self, event: Event) -> None:
        if event.kind is EventKind.COMMAND_REFUSED and event.app == self._app:
            count = event.data.get("count", 1)
            self.refused += count if isinstance(count, int) else 1
        elif event.kind is EventKind.FAILSAFE and event.data.get("step") != Failsafe.NONE:
            self.unwanted += 1

    def distribution(self) -> Distribution | None:
        return distribution(np.array(self.delays_ns, np.int64))


def fly(*targets: Target, seconds: float, land_after_s: float = LAND_AFTER_S) -> list[SwarmFlight]:
    """Fly all drones, then abandon them in the air.

    Args:
        *targets: Names, patterns or addresses, as for :func:`skyloop.swarm`.
        seconds: Duration of the flight [s].
        land_after_s: When an abandoned drone should land [s].

    Raises:
        SwarmError: Some drones could not be flown; they are landed.
    """
    with swarm(*targets, access="observe") as watchers:
        # By proxy name, so that the watcher and the pilot of an address share its private proxy.
        reach = {name: Known(drone).reach or drone.name for name, drone in watchers.items()}
        pilots = swarm(reach, on_error="raise", on_exit="land")
        try:
            pilots.each(lambda drone: drone.config.__setitem__("failsafe.land_after_s", land_after_s), "configuring")
            flown = _fly(pilots, seconds)
        except BaseException:
            pilots._leave()
            raise
        let_go_s = _let_go(pilots)
        return _judge(watchers, flown, let_go_s)


def _fly(pilots: Swarm, seconds: float) -> dict[str, SwarmFlight]:
    pilots.takeoff(timeout_s=30.0)
    notes = {name: _Notes(drone) for name, drone in pilots.items()}
    controllers = {drone.name: (LookingRounds if drone.capabilities.cameras else Rounds)(drone) for drone in pilots}
    pilots.each(lambda drone: controllers[drone.name].run(seconds=seconds), "flying")
    return {
        name: SwarmFlight(
            name,
            len(notes[name].delays_ns),
            notes[name].distribution(),
            drone.stats["feedback"].delay_s,
            controllers[drone.name].frames,
            notes[name].refused,
            notes[name].unwanted,
            None,
            False,
        )
        for name, drone in pilots.items()
    }


def _let_go(pilots: Swarm) -> dict[str, float]:
    """Close each connection in flight; return the times, by name [s, ``time.monotonic``]."""
    let_go_s = {}
    for name, drone in pilots.items():
        drone.velocity(forward=0.2, yaw_rate=0.8)
        let_go_s[name] = time.monotonic()
        drone.close()
    return let_go_s


def _judge(watchers: Swarm, flown: Mapping[str, SwarmFlight], let_go_s: Mapping[str, float]) -> list[SwarmFlight]:
    names = {drone.name: name for name, drone in watchers.items()}

    def failsafe(drone: Drone) -> tuple[float | None, bool]:
        name = names[drone.name]
        try:
            drone.wait(lambda feedback: feedback.failsafe is not Failsafe.NONE, _HOVER_WITHIN_S)
            hover_s = time.monotonic() - let_go_s[name]
        except SkyloopError:
            return None, False
        try:
            drone.wait("landed", _LAND_WITHIN_S)
        except SkyloopError:
            return hover_s, False
        return hover_s, True

    seen = watchers.each(failsafe, "the failsafe")
    return [
        SwarmFlight(
            flight.name,
            flight.commands,
            flight.command,
            flight.feedback,
            flight.frames,
            flight.refused,
            flight.unwanted,
            *seen[name],
        )
        for name, flight in flown.items()
    ]


def missed(flights: list[SwarmFlight]) -> list[str]:
    """Return the names of the drones whose failsafe did not act, or did not land them."""
    return [flight.name for flight in flights if flight.hover_s is None or not flight.landed]


def report(flights: list[SwarmFlight]) -> list[list[str]]:
    """Return the rows of the table, the header first."""
    head = ["drone", "commands", "delay ms: median", "p99", "max", "feedback ms: median", "p99"]
    rows = [[*head, "frames", "refused", "unwanted failsafes", "hover after ms", "landed"]]
    for flight in flights:
        hover = "missed" if flight.hover_s is None else f"{flight.hover_s * 1e3:.0f}"
        rows.append(
            [
                flight.name,
                str(flight.commands),
                *_ms(flight.command, "median", "p99", "maximum"),
                *_ms(flight.feedback, "median", "p99"),
                str(flight.frames),
                str(flight.refused),
                str(flight.unwanted),
                hover,
                "yes" if flight.landed else "no",
            ]
        )
    return rows


def _ms(delays: Distribution | None, *figures: str) -> list[str]:
    return ["" if delays is None else f"{getattr(delays, figure) * 1e3:.2f}" for figure in figures]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="+", help="names, patterns or addresses")
    parser.add_argument("--seconds", type=float, default=60.0)
    wanted = parser.parse_args()
    flights = fly(*wanted.targets, seconds=wanted.seconds)
    for line in columns(tuple(row) for row in report(flights)):
        print(line)
    unwanted = sum(flight.unwanted for flight in flights)
    print(f"{len(flights)} drones, {unwanted} unwanted failsafe steps, {len(missed(flights))} missed failsafes")
    return 1 if missed(flights) else 0


if __name__ == "__main__":
    sys.exit(main())

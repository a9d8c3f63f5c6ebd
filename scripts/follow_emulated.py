"""Follow people with emulated firmware, in real time: ``python scripts/follow_emulated.py [ardrone2] [tello]``.

A person strolls around a lawn at 1.2 m/s, or at 0.7 m/s for a Tello, which flies at most 1 m/s by the sticks;
``--case hidden`` and the others are those of ``follow_flights.py``, with the same judgement. The vehicle is that of
``skyloop sim --firmware``, in this process, which therefore knows the truth; its proxy is a separate process. Video is
encoded, sent, decoded and delayed as from the real vehicle. Time is real: other load on the machine disturbs the
flight. Collisions are not counted.
"""

from __future__ import annotations

import argparse
import random
import tempfile
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Final

from follow_flights import CASES, Case, JudgedFlight, Outcome, person, rotated, spawn
from follow_judge import Judge

import skyloop
from skyloop.client import Drone, Frame
from skyloop.clock import monotonic_ns
from skyloop.messages import Feedback
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.sim.world import Wind
from skyloop.sim.world_file import load_world
from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Ports, with_ardrones
from skyloop.vehicles.ardrone.emulator.video import FRONT_2
from skyloop.vehicles.tello.emulator import FRONT, TelloFirmware, with_tellos
from skyloop.vision import simulated_detector

CAMERAS: Final = {"ardrone2": FRONT_2, "tello": FRONT}


def stroll(rng: random.Random, speed_m_s: float = 0.7) -> str:
    """Return a world in which a person walks around a lawn before the vehicle, while another one passes behind."""
    room = '[room]\nsize = [34, 30, 10]\nfloor = "grass"\nenclosed = false\n[light]\namplitude = 0.25\nperiod = 40\n'
    points = rotated([(3.5, -4), (9.5, -4), (9.5, 4), (3.5, 4)], rng)
    other = person("passer", rng.randrange(1000), [(13, -6), (13, 6), (13.5, 6), (13.5, -6)], 1.0)
    return room + spawn(0.0, 0.0, 0) + person("walker", rng.randrange(1000), points, speed_m_s) + other


STROLLS: Final = {
    "ardrone2": Case(partial(stroll, speed_m_s=1.2)),
    "tello": Case(stroll, speed_m_s=1.0),
}
_READY_S: Final = 30.0
_KEPT: Final = 200


class TruthLog:
    """The recent truth: recorded with each sample of feedback, looked up by the time of a frame."""

    def __init__(self, host: SimHost) -> None:
        self._simulation = host.simulation
        self._kept: deque[Feedback] = deque(maxlen=_KEPT)

    def note(self, _feedback: Feedback | None = None) -> None:
        """Record the present truth, as reported by the simulator's own driver."""
        truth = self._simulation.truth(0)
        native: dict[str, bool | int | float | str | tuple[float, ...]] = {"sim.time_s": truth.time_s}
        for axis, place, velocity in zip("xyz", truth.position_m, truth.velocity_m_s, strict=True):
            native[f"truth.{axis}"], native[f"truth.v{axis}"] = place, velocity
        native |= {"truth.roll": truth.roll_rad, "truth.pitch": truth.pitch_rad, "truth.yaw": truth.yaw_rad}
        self._kept.append(Feedback(captured_ns=monotonic_ns(), native=native))

    def near(self, frame: Frame) -> Feedback | None:
        """Return the truth nearest to a frame's capture."""
        kept = list(self._kept)
        return min(kept, key=lambda one: abs(one.captured_ns - frame.captured_ns), default=None)


@contextmanager
def flown(kind: str, host: SimHost, options: str = "") -> Iterator[Drone]:
    """Yield a hovering drone, behind its own proxy."""
    if kind == "tello":
        with TelloFirmware(host) as tello:
            address = f"tello://{tello.settings.bind}?{options}"
            with skyloop.connect(address) as drone:
                yield _taken_off(drone)
        return
    with ArdroneFirmware(host, ports=Ports.free()) as ardrone:
        ports = ardrone.ports
        address = (
            f"ardrone://{ardrone.settings.bind}?navdata_port={ports.navdata}&video_port={ports.video}"
            f"&at_port={ports.at}&control_port={ports.control}{options and '&' + options}"
        )
        with skyloop.connect(address) as drone:
            yield _taken_off(drone)


def _taken_off(drone: Drone) -> Drone:
    drone.wait(lambda feedback: feedback.vehicle_link == "up", _READY_S)
    drone.takeoff(timeout_s=_READY_S)
    return drone


def fly(
    kind: str,
    case: Case,
    seed: int,
    *,
    class_name: str | None = "person",
    gust_m_s: float = 0.0,
    seconds: float = 40.0,
    options: str = "",
) -> Outcome:
    """Wait until the target is in view, follow it, and judge the result.

    Args:
        kind: ``ardrone2`` or ``tello``.
        case: The target and its world.
        seed: Seed of the world.
        class_name: Follow the largest of this class; None: the content of the target's true box.
        gust_m_s: Standard deviation of gusts.
        seconds: Duration.
        options: Options of the vehicle's address.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "world.toml"
        file.write_text(case.world(random.Random(seed)))
        sim = SimOptions(world=str(file), seed=seed)
        host = SimHost(with_tellos(sim) if kind == "tello" else with_ardrones(sim))
        host.set_wind(Wind(gust_m_s=gust_m_s))
        log = TruthLog(host)
        judge = Judge(load_world(str(file), seed), case.target, CAMERAS[kind])
        with flown(kind, host, options) as drone, drone.on_feedback(log.note, inline=True):
            drone.config["limits.speed"] = case.speed_m_s
            flight = JudgedFlight(drone, judge, case, simulated_detector(), state_of=log.near, later=True)
            return flight.outcome(class_name, seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="vehicle", help=f"{', '.join(CAMERAS)}; default: both")
    parser.add_argument("--case", choices=("stroll", *CASES), default="stroll")
    parser.add_argument("--by", choices=("class", "box"), nargs="*", default=["class", "box"])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--gust", type=float, default=0.0, help="standard deviation of gusts [m/s]")
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--options", default="", help="options of the vehicle's address, such as velocity_axes=body")
    given = parser.parse_args()
    for kind in given.kinds or CAMERAS:
        if kind not in CAMERAS:
            parser.error(f"no such vehicle: {kind}; there are {', '.join(CAMERAS)}")
        case = STROLLS[kind] if given.case == "stroll" else CASES[given.case]
        name = "car" if case.target == "car" else "person"
        for by in given.by:
            for seed in range(given.seeds):
                outcome = fly(
                    kind,
                    case,
                    seed,
                    class_name=name if by == "class" else None,
                    gust_m_s=given.gust,
                    seconds=given.seconds,
                    options=given.options,
                )
                swapped = "another one in the box" if outcome.swapped else "never another"
                print(
                    f"{kind}, {given.case} by {by}, seed {seed}: RMS of the distance {outcome.rms_m:.2f} m, "
                    f"{outcome.seconds:.0f} s, {outcome.note}, {swapped}",
                    flush=True,
                )


if __name__ == "__main__":
    main()

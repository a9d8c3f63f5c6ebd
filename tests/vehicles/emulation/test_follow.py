"""Following a person with emulated firmware: encoded, delayed video and a separate proxy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import skyloop
from skyloop.client import Drone
from skyloop.control import FollowTarget
from skyloop.messages import Feedback
from skyloop.messages.geometry import wrap_angle
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Ports, with_ardrones
from skyloop.vehicles.tello.emulator import TelloFirmware, with_tellos
from skyloop.vision import simulated_detector
from tests.support.tello_addresses import Addresses

pytest.importorskip("av")
pytest.importorskip("cv2")
pytest.importorskip("scipy")

pytestmark = [pytest.mark.process, pytest.mark.flight]

READY_S = 30.0
FLIGHT_S = 10.0
SETTLED_S = 2.0
HALF_VIEW_RAD = 0.45  # less than half of either camera's horizontal field of view
WORLD = """
[room]
size = [30, 24, 8]
floor = "grass"
enclosed = false
[[spawn]]
position = [0, 0, 0]
[[target]]
name = "walker"
kind = "figure"
shape = "person"
look = 3
path = { kind = "waypoints", points = [[4, -1.5, 0], [5, 1.5, 0]], speed = 0.5 }
"""


@contextmanager
def flown(kind: str, host: SimHost) -> Iterator[Drone]:
    if kind == "tello":
        addresses = Addresses.free()
        with TelloFirmware(host, bind=addresses.drone), skyloop.connect(addresses.uri()) as drone:
            yield drone
        return
    with ArdroneFirmware(host, ports=Ports.free()) as firmware:
        ports = firmware.ports
        uri = f"ardrone://127.0.0.1?navdata_port={ports.navdata}&video_port={ports.video}"
        with skyloop.connect(f"{uri}&at_port={ports.at}&control_port={ports.control}") as drone:
            yield drone


@pytest.mark.parametrize("kind", ["ardrone2", "tello"])
def test_a_person_stays_in_view(kind: str, tmp_path: Path) -> None:
    file = tmp_path / "lawn.toml"
    file.write_text(WORLD)
    options = SimOptions(world=str(file), seed=1, wind=0.0)
    host = SimHost(with_tellos(options) if kind == "tello" else with_ardrones(options))
    azimuths: list[float] = []
    distances: list[float] = []

    def note(_: Feedback) -> None:
        vehicle, (target,) = host.simulation.truth(0), host.simulation.target_states()
        x, y = (target.position_m[axis] - vehicle.position_m[axis] for axis in (0, 1))
        azimuths.append(wrap_angle(math.atan2(y, x) - vehicle.yaw_rad))
        distances.append(math.hypot(x, y))

    with flown(kind, host) as drone:
        drone.wait(lambda feedback: feedback.vehicle_link == "up", READY_S)
        drone.takeoff(timeout_s=READY_S)
        detector = simulated_detector()
        detector.detect(drone.next_frame(timeout_s=READY_S))  # the first takes longest
        pilot = FollowTarget(drone, class_name="person", detector=detector)
        with drone.on_feedback(note, inline=True):
            pilot.run(seconds=FLIGHT_S)
        assert pilot.status.class_name == "person"
        settled = round(len(azimuths) * SETTLED_S / FLIGHT_S)
    assert len(azimuths) > 4 * FLIGHT_S, "feedback came"
    in_view = [abs(azimuth) < HALF_VIEW_RAD for azimuth in azimuths[settled:]]
    assert sum(in_view) >= 0.9 * len(in_view)
    assert min(distances) > 1.5
    assert max(distances[settled:]) < 7.0

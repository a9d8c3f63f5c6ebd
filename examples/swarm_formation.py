"""Fly several drones from one program: take off together, fly a V and a circle, and follow a leader.

skyloop sim --drones 3 --name drone --option cameras=none   # three drones in one world
python examples/swarm_formation.py "drone*"
"""

import math
import sys

import skyloop
from skyloop.control.formation import circle, placed, vee
from skyloop.control.formation_flight import Formation


def main(*targets: str, seconds: float = 6.0) -> None:
    # A drone that fails is reported at the end of the block; until then the others continue without it.
    with skyloop.swarm(*targets, on_error="continue") as drones:
        drones.takeoff()
        drones.wait_all("hovering", timeout_s=15)
        formation = Formation(drones, apart_m=0.6)
        middle = formation.middle()
        for shape, yaw in ((vee(len(drones), 1.0), 0.0), (circle(len(drones), 1.2), math.pi / 2)):
            report = formation.fly_to(placed(shape, at=middle, yaw=yaw), speed_m_s=0.8)
            print(f"{report.seconds:.1f} s, at most {max(report.errors_m.values()):.2f} m from the places")

        leader, *followers = drones.active
        offsets = {name: (-1.0 * k, 0.0, 0.0) for k, name in enumerate(followers, 1)}  # ahead, left, up [m]
        report = formation.follow(leader, offsets, seconds, lead=lambda _: skyloop.Velocity(0.2, yaw_rate=0.2))
        print(f"never closer than {report.closest_m:.2f} m")
        if report.spread_s is not None:
            print(f"set-points left within {report.spread_s * 1000:.2f} ms")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:] or ("drone*",))
    except skyloop.UnknownNameError:
        sys.exit("start three drones first: skyloop sim --drones 3 --name drone --option cameras=none")

"""Check a route for each of three drones, fly all of them at the same time, and land.

skyloop sim --drones 3 --name drone --option cameras=none   # three drones in one world
python examples/three_routes.py "drone*"
"""

import sys
import threading

import skyloop
from skyloop.control import FlyRoute, Route, RouteWaypoint, Wait


def tour(height: float, x: float, y: float) -> Route:
    """Return a square of 0.8 m at the drone's own height, so that no two drones meet. World axes [m]."""
    corners = [(x, y), (x + 0.8, y), (x + 0.8, y + 0.8), (x, y + 0.8)]
    places = [RouteWaypoint(a, b, height, look_at=(x + 0.4, y + 0.4), actions=(Wait(0.3),)) for a, b in corners]
    return Route(waypoints=tuple(places), name=f"square at {height:g} m", speed=0.6, end="return")


def fly(flight: FlyRoute) -> None:
    """Fly to the end of the route, or until it pauses because of a problem."""
    flight.run(seconds=120.0, until=lambda: bool(flight.law.problem))


def main(*targets: str) -> None:
    with skyloop.swarm(*targets) as drones:
        drones.wait_all(lambda feedback: feedback.position_m is not None, timeout_s=10)
        flights = []
        for number, drone in enumerate(drones):
            x, y, _ = drone.feedback().position_m or (0.0, 0.0, 0.0)
            report = lambda step, name=drone.name: print(f"{name}: {step.text}", flush=True)  # noqa: E731
            flights.append(FlyRoute(drone, tour(0.8 + 0.5 * number, x, y), on_progress=report))
        for flight in flights:
            for finding in (found := flight.check()).findings:
                print(flight.drone.name, finding.severity, finding.waypoint, finding.reason)
            if not found.ok:
                sys.exit("a route can't be flown: see above")
        drones.takeoff()
        running = [threading.Thread(target=fly, args=(flight,)) for flight in flights]
        for thread in running:
            thread.start()
        for thread in running:
            thread.join()
        for flight in flights:
            print(f"{flight.drone.name}: {flight.law.route.name} {flight.law.state} {flight.law.problem}")
        if any(flight.law.state != "done" for flight in flights):
            sys.exit("not all routes were flown to their end: see above")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:] or ("drone*",))
    except skyloop.UnknownNameError:
        sys.exit("start three drones first: skyloop sim --drones 3 --name drone --option cameras=none")

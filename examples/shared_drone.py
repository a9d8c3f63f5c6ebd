"""Share one drone between a pilot, any number of observers, and a colleague who asks for a turn.

skyloop sim --name alpha
python examples/shared_drone.py alpha pilot      # in one terminal: flies, and hands over when asked
python examples/shared_drone.py alpha look       # in others: prints the pilot and the drone's state
python examples/shared_drone.py alpha turn       # in another: asks, flies for a while, gives it back
"""

import sys
import time

import skyloop


def pilot(name: str, seconds: float = 60.0) -> None:
    """Turn on the spot, and hand over on request unless the battery is nearly empty."""
    with skyloop.connect(name, name="pilot", on_exit="land") as drone:

        def may_have_it(_: object) -> bool | str:
            battery = drone.feedback().battery  # None if the vehicle does not report it
            return battery is None or battery > 0.2 or "landing, the battery is nearly empty"

        drone.on_takeover(may_have_it)
        drone.takeoff()
        for _ in range(round(seconds * 10)):
            if drone.authority.state == "held":
                drone.velocity(yaw_rate=0.5)  # rad/s, counter-clockwise
            else:
                print("waiting for", drone.authority.holder, flush=True)
                drone.wait(lambda _: drone.authority.state == "held", timeout_s=60.0)
                print("flying again", flush=True)
            time.sleep(0.1)


def look(name: str, seconds: float = 60.0) -> None:
    """Print each change of pilot."""
    with skyloop.connect(name, access="observe") as drone:
        owner, end = "", time.monotonic() + seconds
        while time.monotonic() < end:
            now = drone.next_feedback(timeout_s=5.0)
            if (now.owner or "nobody") != owner:
                print(owner := now.owner or "nobody", "flies, battery", now.battery, flush=True)  # 0 to 1, or None


def turn(name: str, seconds: float = 5.0) -> None:
    """Ask politely, wait for the answer, climb a little, and give the drone back."""
    asking = skyloop.Authority(priority=8, takeover="ask", wait_s=30)
    with skyloop.connect(name, name="colleague", authority=asking, on_exit="hover") as drone:
        print("my turn", flush=True)
        drone.velocity(up=0.1)
        time.sleep(seconds)


if __name__ == "__main__":
    name, role, *seconds = sys.argv[1:] if sys.argv[2:] else ("alpha", "look")
    try:
        {"pilot": pilot, "look": look, "turn": turn}[role](name, *map(float, seconds))
    except skyloop.UnknownNameError:
        sys.exit("start the drone first: skyloop sim --name alpha")

"""Several people, one drone: a pilot, any number who look on, and a colleague who asks for a turn.

skyloop sim --name alpha
python examples/shared_drone.py alpha pilot      # in one terminal: flies, and hands over when asked
python examples/shared_drone.py alpha look       # in others: who flies, and how it is
python examples/shared_drone.py alpha turn       # in another: asks, flies for a while, gives it back
"""

import sys
import time

import skyloop


def pilot(name, seconds=60.0):
    """Turns on the spot, and hands over to whoever asks unless the battery is nearly empty."""
    with skyloop.connect(name, name="pilot", on_exit="land") as drone:
        drone.on_takeover(lambda _: drone.feedback().battery > 0.2 or "landing, the battery is nearly empty")
        drone.takeoff()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if drone.authority.state == "held":
                drone.velocity(yaw_rate=0.5)  # rad/s, counter-clockwise
            else:
                print("waiting for", drone.authority.holder, flush=True)
                drone.wait(lambda _: drone.authority.state == "held", timeout_s=60.0)
                print("flying again", flush=True)
            time.sleep(0.1)


def look(name, seconds=60.0):
    """Tells whenever somebody else flies."""
    with skyloop.connect(name, access="observe") as drone:
        owner, end = "", time.monotonic() + seconds
        while time.monotonic() < end:
            feedback = drone.next_feedback(timeout_s=5.0)
            if feedback.owner != owner:
                owner = feedback.owner
                print(owner or "nobody", "flies, battery", f"{feedback.battery:.0%}", flush=True)


def turn(name, seconds=5.0):
    """Asks politely, waits for the answer, climbs a little, and gives it back."""
    with skyloop.connect(name, name="colleague", priority=8, takeover="ask", wait_s=30, on_exit="hover") as drone:
        print("my turn", flush=True)
        drone.velocity(up=0.1)
        time.sleep(seconds)


if __name__ == "__main__":
    {"pilot": pilot, "look": look, "turn": turn}[sys.argv[2]](sys.argv[1], *map(float, sys.argv[3:4]))

"""Stand-in for ArduCopter's program: its JSON interface, without flight.

Its rotors get 0.1, 0.2, 0.3 and 0.4 in ArduCopter's order. Received states go to ``states.jsonl`` in the working
folder. STANDIN in the environment: ``garbage`` also sends other packets, ``dies`` ends after the third state,
``mavlink`` sends heartbeats and its attitude, and has no power.
"""

import argparse
import os
import socket
from pathlib import Path

from skyloop.vehicles.sim.firmware.ardupilot import ServoPacket, encode_servos

parser = argparse.ArgumentParser()
for option in ("model", "instance", "sim-port-out", "serial0", "sysid", "home", "defaults"):
    parser.add_argument(f"--{option}", required=True)
options = parser.parse_args()
print("starting with", Path(options.defaults).read_text().split("\n")[0], flush=True)
manner = os.environ.get("STANDIN", "")
simulator = "127.0.0.1", int(options.sim_port_out)
link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
place, port = options.serial0.removeprefix("udpclient:").split(":")
rotors = (0, 0, 0, 0) if manner == "mavlink" else (1100, 1200, 1300, 1400)
if manner == "mavlink":
    from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, dialect

    telemetry = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    codec = MavlinkCodec(int(options.sysid), 1)
with Path("states.jsonl").open("a", buffering=1) as states:
    for frame in range(1_000_000):
        if manner == "garbage":
            for junk in (b"", b"\x1aH", bytes(40), os.urandom(72)):
                link.sendto(junk, simulator)
        link.sendto(encode_servos(ServoPacket(400, frame, (*rotors, *[0] * 12))), simulator)
        states.write(link.recv(4096).decode().strip() + "\n")
        if manner == "mavlink" and frame % 20 == 0:
            for message in (
                dialect.MAVLink_heartbeat_message(2, 3, 81, 4, 3, 3),
                dialect.MAVLink_attitude_message(frame, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0),
            ):
                telemetry.sendto(codec.encode(message), (place, int(port)))
        if manner == "dies" and frame == 2:
            raise SystemExit("something went wrong in it")

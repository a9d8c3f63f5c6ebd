"""Stand-in for PX4's program: its link to a simulator, without flight.

It answers from its fifth ``HIL_SENSOR`` on, as PX4 needs some to start. Its rotors get 0.1, 0.2, 0.3 and 0.4 in PX4's
order. Each message adds a line to ``messages.txt`` in the working folder; the parameters go to ``parameters.txt``.
"""

import os
import socket
import sys
import time
from pathlib import Path

from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, dialect

instance = int(sys.argv[sys.argv.index("-i") + 1])
files = Path(sys.argv[sys.argv.index("-d") + 1])
assert (files / "init.d-posix").is_dir()
assert os.environ["PX4_SIM_MODEL"] == "none_iris"
given = sorted(f"{name}={value}\n" for name, value in os.environ.items() if name.startswith("PX4_PARAM_"))
Path("parameters.txt").write_text("".join(given))
codec = MavlinkCodec(1, 1)
while True:
    try:
        link = socket.create_connection(("127.0.0.1", int(os.environ["STANDIN_PORT"]) + instance))
        break
    except ConnectionRefusedError:
        time.sleep(0.01)
link.sendall(b"no MAVLink at all" + codec.encode(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3)))
heard = 0
with Path("messages.txt").open("a", buffering=1) as messages:
    while data := link.recv(65536):
        for message in codec.decode(data):
            messages.write(f"{message.get_type()} {getattr(message, 'time_usec', 0)}\n")
            if message.get_type() != "HIL_SENSOR":
                continue
            heard += 1
            if heard >= 5:
                controls = [0.1, 0.2, 0.3, 0.4, *[0.0] * 12]
                answer = dialect.MAVLink_hil_actuator_controls_message(message.time_usec, controls, 129, 1)
                link.sendall(codec.encode(answer))

"""Stand-in for Betaflight's program: its command line, its motors and its state, without flight.

STANDIN_PORTS in the environment: its ports for motors, state and MSP. Its motors are those of the other stand-ins.
STANDIN_DEAF, STANDIN_HANGS: a folder. A start that finds a file in it removes one, and then never answers, or answers
although its flight control never runs.
"""

import os
import socket
import sys
import threading
import time
from pathlib import Path

from skyloop.vehicles.msp.wire.frames import Direction, MspFrame, encode
from skyloop.vehicles.msp.wire.messages import Function, MspStatus
from skyloop.vehicles.sim.firmware.betaflight import decode_state, encode_motors

API_VERSION = encode(MspFrame(Function.API_VERSION))
STATUS = encode(MspFrame(Function.STATUS_EX))
BOOTGRACE = 1 << 9

assert sys.argv[1] == "127.0.0.1"
motors_port, state_port, msp_port = map(int, os.environ["STANDIN_PORTS"].split(","))


def command_line() -> None:
    server = socket.create_server(("127.0.0.1", msp_port))
    while True:
        link, _ = server.accept()
        text = b""
        while data := link.recv(4096):
            text += data
            if data == b"#":
                link.sendall(b"Entering CLI Mode\r\n\r\n# ")
            elif data == API_VERSION:
                link.sendall(encode(MspFrame(Function.API_VERSION, b"\0\1\57", Direction.REPLY)))
            elif data == STATUS:
                link.sendall(encode(MspFrame(Function.STATUS_EX, status.betaflight(), Direction.REPLY)))
            elif data == b"save\r\n":
                Path("eeprom.bin").write_bytes(text)
                os._exit(0)
            else:
                link.sendall(data + b"\r\n# ")


time.sleep(0.2)
for deaf in Path(os.environ.get("STANDIN_DEAF", os.devnull)).glob("*"):
    deaf.unlink()
    deaf_server = socket.create_server(("127.0.0.1", msp_port))
    time.sleep(600)
status = MspStatus(0, 0, flags=0, count=29)
for hangs in Path(os.environ.get("STANDIN_HANGS", os.devnull)).glob("*"):
    hangs.unlink()
    status = MspStatus(0, 0, flags=BOOTGRACE, count=29)
    break
threading.Thread(target=command_line, daemon=True).start()
link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
link.bind(("127.0.0.1", state_port))
motors = encode_motors((0.1, 0.2, 0.3, 0.4)), ("127.0.0.1", motors_port)
link.sendto(*motors)  # before any state, as Betaflight does
with Path("states.txt").open("a", buffering=1) as states:
    while True:
        states.write(f"{decode_state(link.recv(4096))}\n")
        link.sendto(*motors)

"""Stand-in for a Crazyflie's firmware: its link to a simulator, without flight.

It says hello until it is greeted, and answers its first request, unless a file is in the folder ``STANDIN_DEAF``, which
it removes. Each gyro reading is answered by the motors' power: 0.1, 0.4, 0.2 and 0.3, front right first. Each packet
adds a line to ``packets.txt`` in the working folder. A packet to port 14 comes back.
"""

import os
import socket
import struct
import sys
import time
from pathlib import Path

simulator = (sys.argv[2], int(sys.argv[1]))
link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
link.bind(("127.0.0.1", 0))
link.settimeout(0.05)
greeted = False
while not greeted:
    link.sendto(b"\xf3", simulator)
    try:
        greeted = link.recv(64) == b"\xf3"
    except TimeoutError:
        continue
for deaf in sorted(Path(os.environ.get("STANDIN_DEAF", "/nowhere")).glob("*"))[:1]:
    deaf.unlink()
    time.sleep(600)
link.settimeout(None)
with Path("packets.txt").open("a", buffering=1) as packets:
    while True:
        packet = link.recv(64)
        packets.write(packet.hex() + "\n")
        if packet[0] == 0x90 and packet[1] == 0:
            power = [round(65535 * share) for share in (0.1, 0.4, 0.2, 0.3)]
            link.sendto(struct.pack("<B4H", 0x90, *power), simulator)
        elif packet == b"\xd1\x00":
            link.sendto(b"\xd1\x00\x07\x00\x00\x00", simulator)
        elif packet[0] >> 4 == 14:
            link.sendto(packet, simulator)

"""Programs that measure the network between hosts without Skyloop: echoes and streams.

``python tests/promises/hosts/probes.py echo PROTOCOL ADDRESS``, or ``send PROTOCOL ADDRESS COUNT PERIOD_S``, which
prints a JSON list of when each probe came back, by its number: ``[number, sent_ns, heard_ns]``; or ``clock``, its own
clock.
"""

from __future__ import annotations

import json
import select
import socket
import struct
import sys
import time

PORT = 7000
RECORD = struct.Struct("!qq")
SETTLE_S = {"udp": 0.5, "tcp": 20.0}  # how long to wait for the last one: TCP's are certain to arrive
KINDS = {"udp": socket.SOCK_DGRAM, "tcp": socket.SOCK_STREAM}


def echo(protocol: str, address: str) -> None:
    """Return whatever arrives, forever."""
    sock = socket.socket(socket.AF_INET, KINDS[protocol])
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.bind((address, PORT))
    if protocol == "udp":
        print("ready", flush=True)
        while True:
            data, sender = sock.recvfrom(65536)
            sock.sendto(data, sender)
    sock.listen()
    print("ready", flush=True)
    connection, _ = sock.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    while data := connection.recv(65536):
        connection.sendall(data)


def send(protocol: str, address: str, count: int, period_s: float) -> None:
    """Send probes at a period; return those that came back."""
    sock = socket.socket(socket.AF_INET, KINDS[protocol])
    sock.connect((address, PORT))
    if protocol == "tcp":
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    heard: list[tuple[int, int, int]] = []
    waiting = b""
    begin_s = time.monotonic()
    sent = 0
    while len(heard) < count:
        now_s = time.monotonic()
        if now_s > begin_s + count * period_s + SETTLE_S[protocol]:
            break
        if sent < count and now_s >= begin_s + sent * period_s:
            sock.send(RECORD.pack(sent, time.monotonic_ns()))
            sent += 1
        next_s = begin_s + (sent * period_s if sent < count else count * period_s + SETTLE_S[protocol])
        if select.select([sock], [], [], max(0.0, next_s - time.monotonic()))[0]:
            waiting += sock.recv(65536)
            now_ns = time.monotonic_ns()
            while len(waiting) >= RECORD.size:
                number, sent_ns = RECORD.unpack_from(waiting)
                waiting = waiting[RECORD.size :]
                heard.append((number, sent_ns, now_ns))
    print(json.dumps(heard))


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["echo", protocol, address]:
            echo(protocol, address)
        case ["send", protocol, address, count, period_s]:
            send(protocol, address, int(count), float(period_s))
        case ["clock"]:
            print(time.monotonic_ns())
        case other:
            sys.exit(f"unknown: {other}")

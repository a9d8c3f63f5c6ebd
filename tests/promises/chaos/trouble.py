"""Programs that make trouble: ``python -m tests.promises.chaos.trouble WHAT …``. Each says ``ready`` once begun."""

from __future__ import annotations

import os
import random
import socket
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

import skyloop
from skyloop.errors import SkyloopError
from skyloop.host.serve import AddNamed, Remove, StatusRequest, ask
from skyloop.host.vehicle import Condition
from skyloop.messages import Hello, ListParameters, Ping, Request, Role, encode
from skyloop.network.config import free_port
from skyloop.transport.local import packets
from skyloop.transport.local.directory import find_directory
from skyloop.transport.local.system import PROXY

CONNECTIONS: Final = 40
BURSTS_PER_S: Final = 50.0
REMOVALS: Final = 6


def observe(name: str, network: str = "") -> None:
    """Subscribe to everything: feedback, video, events. Made to be stopped or killed meanwhile."""
    with skyloop.connect(name, name="watcher", access="observe", network=network or False, timeout_s=20.0) as drone:
        drone.next_frame(timeout_s=20.0)
        _ready()
        while True:
            with suppress(SkyloopError):
                drone.next_frame(timeout_s=10.0)


def silent(path: str) -> None:
    """Connect to a proxy's socket repeatedly, and never say hello."""
    held = [_connect(path) for _ in range(CONNECTIONS)]
    _ready()
    while True:
        time.sleep(1.0 / BURSTS_PER_S)
        with suppress(OSError):
            held.append(_connect(path))
        for connection in held[:-CONNECTIONS]:
            connection.close()
        del held[:-CONNECTIONS]


def garbage(path: str) -> None:
    """Send data that is not a packet, on one connection after another."""
    source = random.Random(1)
    _ready()
    while True:
        time.sleep(1.0 / BURSTS_PER_S)
        with suppress(OSError), _connect(path) as connection:
            for _ in range(20):
                connection.send(source.randbytes(source.randrange(1, 2000)))


def requests(path: str) -> None:
    """Say hello, request a lot, and never read an answer."""
    greeting = encode(Request(1, Hello("greedy", Role.OBSERVER)))
    questions = [encode(Request(number, ListParameters())) for number in range(2, 18)]
    questions += [encode(Request(number, Ping(0))) for number in range(18, 218)]
    held = []
    _ready()
    while True:
        with suppress(OSError):
            connection = _connect(path)
            held.append(connection)
            for packet in (packets.hello(), greeting, *questions):
                connection.send(packet)
        time.sleep(1.0 / BURSTS_PER_S)
        for connection in held[:-CONNECTIONS]:
            connection.close()
        del held[:-CONNECTIONS]


def network_requests(name: str, network: str) -> None:
    """Several observers on the network that request a lot; made to be stopped meanwhile."""
    from skyloop.network import FabricSettings
    from skyloop.network import dial as fabric_dial

    class Ignoring:
        def __getattr__(self, _: str) -> object:
            return lambda *_: None

    ends = []
    for _ in range(CONNECTIONS):
        dial = fabric_dial(name, FabricSettings(connect=(network,), multicast=False))
        ends.append(dial(Ignoring()))  # type: ignore[arg-type]
    for end in ends:
        end.send(encode(Request(1, Hello("greedy", Role.OBSERVER))))
        for topic in ("feedback", "events", "video/front"):
            end.subscribe(topic)
    _ready()
    number = 1
    while True:
        for end in ends:
            for _ in range(20):
                number += 1
                with suppress(SkyloopError):
                    end.send(encode(Request(number, ListParameters())))
        time.sleep(0.05)


def hog() -> None:
    """Compute, on one core."""
    _ready()
    while True:
        pass


def fill(path: str) -> None:
    """Fill this folder's disk, and keep it full."""
    block = bytes(1 << 20)
    with (Path(path) / "ballast").open("wb", buffering=0) as ballast:
        _ready()
        while True:
            try:
                ballast.write(block)
            except OSError:
                time.sleep(0.1)


def record(name: str, path: str) -> None:
    """Record everything onto a disk that is full, or will be."""
    with skyloop.connect(name, name="recorder", access="observe", network=False) as drone:
        _ready()
        while True:
            with suppress(SkyloopError), skyloop.record([drone], Path(path) / f"{os.getpid()}.mcap", overwrite=True):
                time.sleep(5.0)
            time.sleep(0.2)


def remove_starting(host: str, seed: str) -> None:
    """Add vehicles to a host and remove each while it starts; ends with an error if one is served after that."""
    source = random.Random(int(seed))
    for number in range(REMOVALS):
        name, address = f"extra{number}", f"mavlink://udpin:127.0.0.1:{free_port('127.0.0.1')}"
        add = AddNamed(name, address, own_process=source.random() < 0.3)
        adding = threading.Thread(target=_asked, args=(host, add))
        adding.start()
        time.sleep(source.choice((0.0, 0.005, 0.02, 0.1)))
        early = _asked(host, Remove(name))
        adding.join()
        if not early:  # it did not exist yet
            _asked(host, Remove(name))
        rows = [
            row
            for row in ask(host, StatusRequest()).vehicles
            if row.name == name and row.condition is not Condition.STOPPED
        ]
        deadline = time.monotonic() + 5.0
        path = str(find_directory(None, PROXY).socket_path(name))
        while (served := _is_served(path)) and time.monotonic() < deadline:
            time.sleep(0.05)
        if served or rows:
            sys.exit(f"{add} was removed ({'early' if early else 'late'}), and still {rows or 'serves'}")
    _ready()


def _asked(host: str, request: AddNamed | Remove) -> bool:
    try:
        ask(host, request)
    except SkyloopError as error:
        print(f"{request}: {error}", file=sys.stderr)
        return False
    return True


def _is_served(path: str) -> bool:
    try:
        _connect(path).close()
    except OSError:
        return False
    return True


def _connect(path: str) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    connection.setblocking(False)
    try:
        connection.connect(path)
    except BaseException:
        connection.close()
        raise
    return connection


def _ready() -> None:
    print("ready", flush=True)


if __name__ == "__main__":
    programs = (observe, silent, garbage, requests, network_requests, hog, fill, record, remove_starting)
    {program.__name__: program for program in programs}[sys.argv[1]](*sys.argv[2:])

"""A plain AR.Drone client for the tests: real datagrams, and waiting for what navdata says."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable

from skyloop.errors import DecodeError
from skyloop.vehicles.ardrone.emulator import Ports
from skyloop.vehicles.ardrone.wire.at import Argument, format_command
from skyloop.vehicles.ardrone.wire.configuration import END_OF_DUMP, parse_dump
from skyloop.vehicles.ardrone.wire.navdata import Navdata, State, decode

HERE = "127.0.0.1"
PERIOD_S = 0.03
PATIENCE_S = 12.0
TAKE_OFF, LAND, EMERGENCY = 512, 0, 256


class Pilot:
    """Sends ``REF`` and ``PCMD`` at the drone's pace while it waits, and checks each navdata that arrives."""

    def __init__(self, ports: Ports) -> None:
        self.ports = ports
        self.ref = LAND
        self.pcmd: tuple[Argument, ...] = (0, 0.0, 0.0, 0.0, 0.0)
        self.speaks = True
        self.seen: list[Navdata] = []
        self.damaged = 0
        self._sequence = 0
        self._next_s = 0.0
        self._at = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._navdata = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def close(self) -> None:
        self._at.close()
        self._navdata.close()

    def __enter__(self) -> Pilot:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def say(self, name: str, *arguments: Argument) -> None:
        self._sequence += 1
        self.send(format_command(name, self._sequence, *arguments))

    def send(self, datagram: bytes) -> None:
        self._at.sendto(datagram, (HERE, self.ports.at))

    def ask(self) -> None:
        self._navdata.sendto(b"\1\0\0\0", (HERE, self.ports.navdata))

    def until(self, reached: Callable[[Navdata], object], what: str, ask: Callable[[], None] | None = None) -> Navdata:
        """The first navdata of which this holds. ``ask`` is done before, and again with each command, as one may get
        lost."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            if time.monotonic() >= self._next_s:
                self._next_s = time.monotonic() + PERIOD_S
                if self.speaks:
                    self.say("REF", self.ref)
                    self.say("PCMD", *self.pcmd)
                    if ask is not None:
                        ask()
                if not self.seen:
                    self.ask()
            ready, _, _ = select.select([self._navdata], [], [], PERIOD_S)
            if not ready:
                continue
            try:
                self.seen.append(decode(self._navdata.recv(4096)))
            except DecodeError:
                self.damaged += 1
                continue
            if reached(self.seen[-1]):
                return self.seen[-1]
        raise AssertionError(f"waited {PATIENCE_S} s, still not true: {what}; last: {self.seen[-1:]}")

    def configure(self, key: str, value: str) -> Navdata:
        """With the handshake."""
        self.until(lambda n: not n.state & State.COMMAND_ACK, "the ack is clear", lambda: self.say("CTRL", 5, 0))
        done = self.until(
            lambda n: n.state & State.COMMAND_ACK, f"{key} is acknowledged", lambda: self.say("CONFIG", key, value)
        )
        self.until(lambda n: not n.state & State.COMMAND_ACK, "the ack is clear", lambda: self.say("CTRL", 5, 0))
        return done

    def read_configuration(self, mode: int = 4) -> dict[str, str]:
        with socket.create_connection((HERE, self.ports.control), PATIENCE_S) as control:
            self.say("CTRL", mode, 0)
            text = b""
            while not text.endswith(END_OF_DUMP):
                piece = control.recv(65536)
                assert piece, "the drone hung up"
                text += piece
        return parse_dump(text)

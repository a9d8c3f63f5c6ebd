"""Real Betaflight SITL beside the tests, in a world at rest."""

from __future__ import annotations

import math
import socket
import struct
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import IO, Final

from skyloop.vehicles.msp.wire.frames import MspFrame, encode
from skyloop.vehicles.msp.wire.messages import Function
from skyloop.vehicles.sim.firmware.betaflight import connected, program_path
from skyloop.vehicles.sim.firmware.keeper import request_real_time

MSP_PORT: Final = 5761  # all its ports are constants
_STATE, _MOTORS = 9003, 9002
_STEP_S: Final = 0.002
_SETTINGS: Final = (
    "set serial_update_rate_hz = 1000",
    "aux 0 0 0 1700 2100 0 0",
    "aux 1 1 1 900 2100 0 0",
    "save",
)


class Sitl:
    """Runs it in a folder, configured as in ``docs/msp.md``, and feeds it a level world at rest."""

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
        self._log = (self._folder / "log").open("wb")
        for _ in range(3):  # one in twenty never listens, because of a race between its threads
            self._process = subprocess.Popen(
                [program_path()],
                cwd=self._folder,
                stdout=self._log,
                stderr=subprocess.STDOUT,
                preexec_fn=request_real_time,  # noqa: PLW1509  the feeder's thread does not run yet
            )
            with suppress(OSError):
                connected(MSP_PORT, encode(MspFrame(Function.API_VERSION)), b"$M>").close()
                return
            self._process.kill()
            self._process.wait()
        log = (self._folder / "log").read_text(errors="replace")
        raise AssertionError(f"Betaflight does not listen: {log[-500:]}")

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        if self._log is not None:
            self._log.close()
        self._process = self._log = None

    def _configure(self) -> None:
        """Configure it on its command line; ``save`` ends that and the program."""
        time.sleep(0.5)  # until the client that checked its port is gone
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
                # A constant time keeps its clock in step with ours.
                numbers = (1.0, *(0.0,) * 5, -9.80665, math.cos(half), math.sin(half), *(0.0,) * 8, 101_325.0)
                state.sendto(struct.pack("<18d", *numbers), ("127.0.0.1", _STATE))
                try:
                    self.motors = struct.unpack("<4f", motors.recv(64))
                except BlockingIOError:
                    continue

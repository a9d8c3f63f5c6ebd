"""Flies a MAVLink vehicle with MAVProxy alone, without Skyloop: ``python fly_mavproxy.py arducopter|px4 MASTER``.

Types what a person would type; MAVProxy's own ``mode`` command fails for a PX4, so modes are set by ``long``. Writes
MAVProxy's output as one line of JSON. Runs with the Python of an environment that has MAVProxy 1.8.75.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

PATIENCE_S = 60.0


class Terminal:
    """MAVProxy with a simulated keyboard."""

    def __init__(self, master: str) -> None:
        program = Path(sys.executable).with_name("mavproxy.py")
        command = [
            sys.executable,
            str(program),
            f"--master={master}",
            "--no-state",
            "--default-modules=cmdlong,mode,arm",
        ]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "TERM": "dumb", "PYTHONUNBUFFERED": "1"},
            text=True,
        )
        self.text = ""
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        while piece := self._process.stdout.read(1):
            self.text += piece

    def type(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def until(self, words: str, typed: str = "", pace_s: float = 1.0) -> None:
        """Read until these words appear, typing a line repeatedly meanwhile."""
        deadline, begun, due = time.monotonic() + PATIENCE_S, len(self.text), 0.0
        while words not in self.text[begun:]:
            if time.monotonic() > deadline:
                raise SystemExit(f"waited {PATIENCE_S} s without success for {words!r}: {self.text[-3000:]}")
            if typed and time.monotonic() >= due:
                due = time.monotonic() + pace_s
                self.type(typed)
            time.sleep(0.05)

    def for_a_while(self, typed: str, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.type(typed)
            time.sleep(0.1)

    def end(self) -> None:
        self._process.kill()
        self._process.wait(10)


def main(kind: str, master: str) -> None:
    terminal = Terminal(master)
    try:
        terminal.until("Detected vehicle")
        if kind == "arducopter":
            terminal.until("GUIDED>", "mode GUIDED")
            terminal.until("Arming motors", "arm throttle")
            terminal.type("takeoff 2.5")
            time.sleep(6.0)  # it does not say when it is ready
            terminal.for_a_while("velocity 1 0 0", 3.0)
            terminal.until("LAND>", "mode LAND")
        else:
            terminal.until("Armed by external command", "arm throttle")
            terminal.until("TAKEOFF>", "long DO_SET_MODE 1 4 2")
            terminal.until("LOITER>")
            terminal.for_a_while("velocity 1 0 0", 1.5)
            terminal.until("OFFBOARD>", "long DO_SET_MODE 1 6", 0.2)
            terminal.for_a_while("velocity 1 0 0", 3.0)
            terminal.until("LAND>", "long DO_SET_MODE 1 4 6")
        terminal.until("DISARMED")
        print(json.dumps({"said": terminal.text[-4000:]}), flush=True)
    finally:
        terminal.end()


if __name__ == "__main__":
    main(*sys.argv[1:])

"""A vehicle that is absent is not ready: the proxy, the list and the doctor say what they wait for and what to do."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Empty, Queue

import pytest

from skyloop.cli.doctor import Health, examine_vehicle
from skyloop.cli.listing import describe, lines

PATIENCE_S = 10.0
SAID_WITHIN_S = 3.0

Start = Callable[[str], "Output"]


class Output:
    """The lines of a proxy, with their times."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._lines: Queue[tuple[float, str]] = Queue()
        self._stream = process.stdout
        self.thread = threading.Thread(target=self._read, daemon=True)
        self.thread.start()

    def _read(self) -> None:
        assert self._stream is not None
        for line in self._stream:
            self._lines.put((time.monotonic(), line.strip()))

    def until(self, text: str) -> tuple[float, str]:
        """The time of the first line with this text, and that line with the next."""
        while True:
            try:
                at_s, line = self._lines.get(timeout=PATIENCE_S)
            except Empty:
                pytest.fail(f"no line with {text!r} within {PATIENCE_S} s")
            assert not line.startswith("ready")
            if text in line:
                return at_s, f"{line} {self._lines.get(timeout=PATIENCE_S)[1] if 'vehicle of' in line else ''}"


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    started: list[tuple[subprocess.Popen[str], Output]] = []

    def begin(address: str) -> Output:
        command = [sys.executable, "-m", "skyloop", "proxy", address, "--name", "absent"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path)
        started.append((process, Output(process)))
        return started[-1][1]

    yield begin
    for process, output in started:
        process.terminate()
        process.wait(PATIENCE_S)
        output.thread.join(PATIENCE_S)
        assert process.stdout is not None
        process.stdout.close()


@pytest.mark.process
def test_a_drone_that_is_switched_off(start: Start) -> None:
    output = start("tello://127.0.0.9?local=127.0.0.77")
    serving_s, _ = output.until("serving absent: tello://127.0.0.9")
    lost_s, line = output.until("vehicle of absent: lost")
    assert lost_s - serving_s < SAID_WITHIN_S
    assert "no state from 127.0.0.9" in line
    assert "→ start the emulated drone" in line
    row = describe("absent")
    assert row.vehicle_link == "lost"
    assert "no state from" in row.link_reason
    assert "start the emulated drone" in lines([row])[1]


@pytest.mark.process
def test_a_serial_port_that_is_missing_and_one_that_is_silent(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "port"
    output = start(f"mavlink://serial:{port}")
    serving_s, _ = output.until("serving absent")
    lost_s, line = output.until("vehicle of absent: lost")
    assert lost_s - serving_s < SAID_WITHIN_S
    assert f"there is no {port}" in line
    assert "→ plug the vehicle in" in line
    ours, theirs = os.openpty()
    try:
        port.symlink_to(os.ttyname(theirs))
        _, line = output.until("vehicle of absent: lost")
        assert "there is no" not in line, "it is reported again when it changes"
        assert "→ check the vehicle's power, cable and speed" in line
    finally:
        os.close(ours)
        os.close(theirs)


@pytest.mark.parametrize(
    ("address", "reason", "remedy"),
    [
        ("mavlink://serial:/dev/none-here", "there is no /dev/none-here", "plug the vehicle in"),
        ("mavlink://tcp:127.0.0.1:9", "Connection refused", "start it at 127.0.0.1"),
        ("mavlink://udpin:127.0.0.1:14999", "no message on udpin", "point the vehicle"),
        ("ardrone://127.0.0.9", "no navdata from 127.0.0.9", "start the emulated drone"),
        ("tello://127.0.0.9?local=127.0.0.78", "no state from 127.0.0.9", "start the emulated drone"),
    ],
)
def test_the_doctor_answers_within_five_seconds(address: str, reason: str, remedy: str) -> None:
    began_s = time.monotonic()
    (finding,) = examine_vehicle(address)
    assert time.monotonic() - began_s < 5.0
    assert finding.health is Health.BAD
    assert reason in finding.detail
    assert remedy in finding.advice

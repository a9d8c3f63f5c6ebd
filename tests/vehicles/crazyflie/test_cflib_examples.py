"""Bitcraze's own examples for cflib fly the emulated Crazyflie, unchanged but for the address.

``SKYLOOP_CFLIB_PYTHON`` names a Python with cflib 0.1.34, and ``SKYLOOP_CFLIB_EXAMPLES`` the folder ``examples`` of
Bitcraze's crazyflie-lib-python, of its newest version or, for those that were moved away since, of 0.1.31. Both are
used beside the project: their licence is the GPL.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain, repeat
from pathlib import Path

import pytest

from skyloop.messages import FlightState
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.crazyflie.emulator import CrazyflieFirmware, with_crazyflies
from skyloop.vehicles.crazyflie.wire.contents import ValueType, set_by_name

PATIENCE_S = 150.0
LANDED_WITHIN_S = 5.0  # after the end of the program, which may end while the vehicle falls the last centimetres
RECORD_S = 0.05  # interval between recorded positions
_RADIO = re.compile(r"radio://0/\d+/2M/E7E7E7E7[0-9A-F]{2}")

pytestmark = [pytest.mark.process, pytest.mark.slow, pytest.mark.timeout(240)]


@dataclass(frozen=True)
class Example:
    """An example, and what it must do: heights, and the width of the flight along x and y [m]; words it prints."""

    path: str
    height: tuple[float, float] = (0.0, 0.02)
    width: tuple[float, float] = (0.0, 0.1)  # at least, at most, of the wider direction
    prints: str = ""
    drones: int = 1


EXAMPLES = [
    Example("step-by-step/sbs_connect_log_param.py", prints="stabilizer.estimator set at number: 1"),
    Example("logging/basiclog.py", prints="pm.vbat: 4."),
    Example("logging/basiclog_sync.py", prints="'stabilizer.yaw'"),
    Example("parameters/basicparam.py", prints="Read back: pid_attitude.pitch_kd=0.123"),
    Example("parameters/persistent_params.py", prints="Persisted ring.effect!"),
    Example("step-by-step/sbs_motion_commander.py", (0.3, 0.7), (0.0, 1.5), "Deck is attached!"),
    Example("autonomy/motion_commander_demo.py", (0.5, 1.1), (0.6, 1.6)),
    Example("autonomy/autonomous_sequence.py", (1.0, 1.4), (0.9, 1.3), "Setting position"),
    Example("autonomy/autonomous_sequence_high_level.py", (0.9, 1.3), (1.6, 2.2), "The sequence is"),
    Example("step-by-step/sbs_swarm.py", (0.9, 1.3), (0.4, 1.6), "Setting position", drones=4),
    Example("autonomy/autonomous_sequence_high_level_compressed.py", (0.9, 1.3), (1.6, 2.4)),
    Example("autonomy/position_commander_demo.py", (0.8, 1.3), (0.9, 1.7)),
    Example("autonomy/full_state_setpoint_demo.py", (0.9, 1.2), (0.0, 0.2), "land"),
    Example("supervisor/flying_with_supervisor.py", (0.9, 1.3), (0.0, 0.2), "landing!"),
    Example("positioning/flowsequence_sync.py", (0.3, 0.6), (0.9, 1.8)),
    Example("positioning/initial_position.py", (0.6, 0.9), (0.6, 0.9), "Setting position"),
    Example("swarm/hl_commander_swarm.py", (0.9, 1.3), (0.9, 1.4), drones=2),
]


@pytest.fixture
def python() -> str:
    python = os.environ.get("SKYLOOP_CFLIB_PYTHON")
    if not python:
        pytest.skip("SKYLOOP_CFLIB_PYTHON names no Python with cflib 0.1.34")
    asked = [python, "-c", "import cflib, importlib.metadata as m; print(m.version('cflib'))"]
    assert subprocess.run(asked, capture_output=True, text=True, timeout=60, check=True).stdout.strip() == "0.1.34"
    return python


def _share_axes(host: SimHost, drone: int, vehicle: CrazyflieFirmware) -> None:
    """Let a vehicle's estimate begin in axes that all vehicles share, so that they fly past each other."""
    starts = [host.simulation.truth(n).position_m for n in range(host.drones)]
    for axis, name in enumerate(("initialX", "initialY")):
        middle = sum(start[axis] for start in starts) / len(starts)
        vehicle.logic.receive(set_by_name("kalman", name, ValueType.FLOAT, starts[drone][axis] - middle))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.path)
def test_example(example: Example, python: str, tmp_path: Path) -> None:
    folder = os.environ.get("SKYLOOP_CFLIB_EXAMPLES")
    if not folder:
        pytest.skip("SKYLOOP_CFLIB_EXAMPLES names no folder with cflib's examples")
    program = Path(folder) / example.path
    if not program.exists():
        pytest.skip(f"{folder} has no {example.path}")
    host = SimHost(with_crazyflies(SimOptions(world="empty", seed=1)), example.drones)
    with ExitStack() as started:
        vehicles = [started.enter_context(CrazyflieFirmware(host, n, port=0)) for n in range(example.drones)]
        for drone, vehicle in enumerate(vehicles):
            _share_axes(host, drone, vehicle)
        uris = [f"udp://127.0.0.1:{vehicle.port}" for vehicle in vehicles]
        shutil.copytree(program.parent, tmp_path / "copy")
        copy = tmp_path / "copy" / program.name
        others = chain(uris, repeat(uris[-1]))
        copy.write_text(_RADIO.sub(lambda _: next(others), program.read_text()))
        places: list[list[tuple[float, float, float]]] = [[] for _ in vehicles]
        ended = threading.Event()

        def record() -> None:
            while not ended.wait(RECORD_S):
                for drone, each in enumerate(places):
                    each.append(host.simulation.truth(drone).position_m)

        recorder = threading.Thread(target=record)
        recorder.start()
        try:
            done = subprocess.run(
                [python, copy.name],
                cwd=copy.parent,
                env={**os.environ, "CFLIB_URI": uris[0], "PYTHONPATH": ""},
                capture_output=True,
                text=True,
                timeout=PATIENCE_S,
                check=False,
            )
            until_s = time.monotonic() + LANDED_WITHIN_S
            while time.monotonic() < until_s and any(
                host.simulation.state(drone) is not FlightState.LANDED for drone in range(example.drones)
            ):
                ended.wait(RECORD_S)
        finally:
            ended.set()
            recorder.join()
        assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        assert example.prints in done.stdout
        for drone, each in enumerate(places):
            xs, ys, zs = zip(*each, strict=True)
            assert example.height[0] <= max(zs) - zs[0] <= example.height[1]
            assert example.width[0] <= max(max(xs) - min(xs), max(ys) - min(ys)) <= example.width[1]
            assert host.simulation.state(drone) is FlightState.LANDED
            assert zs[-1] == pytest.approx(zs[0], abs=0.02)

"""Measure the Gymnasium environments: steps and 84×84 images per second on one core."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Literal, NamedTuple

import msgspec
import numpy as np

from benchmarks.measuring.tables import Table
from skyloop.bench import Machine, rounds
from skyloop.clock import monotonic_ns
from skyloop.gym import ReachEnv, ReachVectorEnv
from skyloop.sim.render import use_one_core
from skyloop.sim.render.compiled import COMPILER

STEP_S: Final = 0.04  #: simulated time of one environment step
PICTURE_PX: Final = 84
REAL_TIME_TARGET: Final = 100.0  #: simulated seconds per second of one environment without pictures
PICTURES_TARGET: Final = 400.0  #: pictures per second of an environment with many drones

Progress = Callable[[float], None]


class Case(NamedTuple):
    """An environment with a number of drones, with or without pictures."""

    drones: int
    pictures: bool


CASES: Final = (Case(1, False), Case(64, False), Case(1, True), Case(8, True))


class LearningRow(msgspec.Struct, frozen=True):
    """One environment. ``step_us``: median time of a step of all its drones."""

    drones: int
    pictures: bool
    step_us: float
    real_time: float  #: simulated seconds of flight per second, of all drones together
    pictures_per_s: float | None


class Learning(msgspec.Struct, frozen=True):
    """A whole run, as in ``learning.json``."""

    machine: Machine
    rows: list[LearningRow]


def measure(seconds: float, cases: tuple[Case, ...] = CASES, progress: Progress = lambda _: None) -> Learning:
    """Step each environment with random actions, in the calling thread.

    Args:
        seconds: Approximate total duration [s].
        cases: The environments.
        progress: Called with the fraction done, 0 to 1.
    """
    machine = Machine.here()
    COMPILER.start().join()
    use_one_core()
    rows = []
    for number, case in enumerate(cases):
        part = lambda share, number=number: progress((number + share) / len(cases))  # noqa: E731
        rows.append(_measure_one(case, seconds / len(cases), part))
    return Learning(machine, rows)


def _measure_one(case: Case, seconds: float, progress: Progress) -> LearningRow:
    observe: Literal["pixels", "state"] = "pixels" if case.pictures else "state"
    env: Any
    if case.drones == 1:
        env = ReachEnv(observe=observe, size_px=PICTURE_PX)
    else:
        env = ReachVectorEnv(case.drones, observe=observe, size_px=PICTURE_PX)
    env.action_space.seed(1)
    env.reset(seed=1)
    times_ns = []
    for _ in rounds(seconds, progress):
        action = env.action_space.sample()
        begin_ns = monotonic_ns()
        _, _, failed, over, _ = env.step(action)
        if case.drones == 1 and (failed or over):
            env.reset()
        times_ns.append(monotonic_ns() - begin_ns)
    env.close()
    step_us = float(np.median(times_ns)) / 1e3
    a_second = case.drones * len(times_ns) * 1e9 / sum(times_ns)
    return LearningRow(case.drones, case.pictures, step_us, a_second * STEP_S, a_second if case.pictures else None)


def table(results: Learning) -> Table:
    """Return the figures as a table."""
    rows = [
        [
            str(row.drones),
            f"{PICTURE_PX}×{PICTURE_PX}" if row.pictures else "none",
            f"{row.step_us:.0f}",
            f"{row.real_time:.0f} ×",
            "" if row.pictures_per_s is None else f"{row.pictures_per_s:.0f}",
            _target(row),
        ]
        for row in results.rows
    ]
    columns = ["drones", "pictures", "a step, µs", "flight to real time", "pictures/s", "target"]
    return Table("Gymnasium environments on one core", columns, rows)


def _target(row: LearningRow) -> str:
    if row.pictures:
        return f"≥ {PICTURES_TARGET:.0f} pictures/s" if row.drones > 1 else ""
    return f"≥ {REAL_TIME_TARGET:.0f} ×" if row.drones == 1 else ""


if __name__ == "__main__":
    from benchmarks.command import main

    main("learning")

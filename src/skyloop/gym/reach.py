"""Fly to a place and stay there, by velocity set-points: one drone, or many in one simulation."""

from __future__ import annotations

import math
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.gym.arena import Arena, outside
from skyloop.gym.picture import Picture

Floats = NDArray[np.float64]
Observation = NDArray[np.float32]

PERIOD_S: Final = 0.04  #: between two actions
SPEED_M_S: Final = 1.0  #: of a full action
TURN_RAD_S: Final = 1.5
NEAR_M: Final = 0.2  #: within this of the goal counts as there
_SPREAD: Final = (2.0, 2.0, 0.8)  #: goals and starts: this far from the middle of a cell [m] …
_HEIGHT: Final = 2.0  #: … whose middle is this high
#: goal ahead, left, up [m]; velocity ahead, left, up [m/s]; roll, pitch [rad]; heading to the goal's, sine and cosine
_HIGHEST: Final = np.array([10, 10, 10, 5, 5, 5, math.pi, math.pi, 1, 1], np.float32)

ACTIONS: Final = spaces.Box(-1.0, 1.0, (4,), np.float32)
OBSERVATIONS: Final = spaces.Box(-_HIGHEST, _HIGHEST, dtype=np.float32)


class Reaching:
    """The task, for all drones of an arena at once."""

    def __init__(self, drones: int, seconds: float, gusts_m_s: float) -> None:
        if not (1.0 <= seconds <= 600.0):
            raise UsageError(f"seconds is {seconds!r} and must be from 1 to 600")
        if not (0.0 <= gusts_m_s <= 5.0):
            raise UsageError(f"gusts_m_s is {gusts_m_s!r} and must be from 0 to 5")
        self.drones = drones
        self.steps = round(seconds / PERIOD_S)
        self.gusts_m_s = gusts_m_s
        self.goals = np.zeros((drones, 3))
        self.headings = np.zeros(drones)
        self.age = np.zeros(drones, dtype=np.int64)
        self._before = np.zeros((drones, 4))
        self.arena: Arena | None = None

    def begin(self, seed: int) -> None:
        """A new world from this seed, all drones hovering."""
        self.arena = Arena(self.drones, seed, gusts_m_s=self.gusts_m_s, period_s=PERIOD_S)

    def restart(self, which: NDArray[np.bool_], rng: np.random.Generator) -> None:
        """Another start and another goal for these drones."""
        arena = self._arena()
        for drone in np.flatnonzero(which):
            start, goal = (rng.uniform(-1, 1, 3) * _SPREAD + [0, 0, _HEIGHT] for _ in range(2))
            arena.put(int(drone), start, float(rng.uniform(-math.pi, math.pi)))
            self.goals[drone], self.headings[drone] = goal, rng.uniform(-math.pi, math.pi)
        self.age[which] = 0
        self._before[which] = 0.0

    def step(self, actions: Floats) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_], Floats]:
        """Rewards, which have failed, which are at the end of their time, and the distances from the goals [m]."""
        arena = self._arena()
        bounded = np.clip(np.nan_to_num(actions), -1.0, 1.0)
        arena.step(bounded * [SPEED_M_S, SPEED_M_S, SPEED_M_S, TURN_RAD_S])
        self.age += 1
        places, _, _ = arena.state()
        distances = np.linalg.norm(self.goals - places, axis=1)
        failed = outside(places) | ~arena.airborne()
        jerk = np.abs(bounded - self._before).sum(axis=1)
        self._before = bounded
        rewards = 0.1 * (np.exp(-2.0 * distances) - 0.1 * distances - 0.02 * jerk) - 5.0 * failed
        return rewards, failed, self.age >= self.steps, distances

    def observe(self) -> Observation:
        """The observation, shape (n, 10)."""
        places, velocities, angles = self._arena().state()
        ahead = self.goals - places
        sine, cosine = np.sin(angles[:, 2]), np.cos(angles[:, 2])
        turn = self.headings - angles[:, 2]
        columns = [
            cosine * ahead[:, 0] + sine * ahead[:, 1],
            cosine * ahead[:, 1] - sine * ahead[:, 0],
            ahead[:, 2],
            *velocities.T,
            angles[:, 0],
            angles[:, 1],
            np.sin(turn),
            np.cos(turn),
        ]
        return np.clip(np.stack(columns, axis=1).astype(np.float32), -_HIGHEST, _HIGHEST)

    def _arena(self) -> Arena:
        if self.arena is None:
            raise UsageError("the environment was not reset yet: call reset() first")
        return self.arena


def _info(distances: Floats) -> dict[str, NDArray[Any]]:
    """What a step's ``info`` holds of each drone."""
    return {"distance_m": distances, "is_success": distances < NEAR_M}


class ReachEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One drone. ``skyloop.gym.register()`` makes it known as ``skyloop/Reach-v0``.

    Action, shape (4,), float32, from -1 to 1: velocity ahead, left, up in shares of 1 m/s, turning counter-clockwise in
    shares of 1.5 rad/s, for 40 ms. Observation, shape (10,), float32: where the goal is, ahead, left, up [m];
    velocity as the drone believes [m/s]; roll (right side down), pitch (nose down) [rad]; sine and cosine of the turn
    to the goal's heading. Reward a step: up to 0.1 at the goal, less with distance and jerky actions; -5 where it
    leaves its cell of 7 m, which ends the episode. ``render_mode="rgb_array"``: a picture of the drone and its goal.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / PERIOD_S)}  # noqa: RUF012
    action_space = ACTIONS
    observation_space = OBSERVATIONS

    def __init__(self, *, seconds: float = 8.0, gusts_m_s: float = 0.3, render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UsageError(f'render_mode is {render_mode!r} and must be "rgb_array" or None')
        self.render_mode = render_mode
        self._task = Reaching(1, seconds, gusts_m_s)
        self._picture: Picture | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        if seed is not None or self._task.arena is None:
            self._task.begin(int(self.np_random.integers(2**31)))
            self._picture = None
        self._task.restart(np.array([True]), self.np_random)
        return self._task.observe()[0], {}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        rewards, failed, over, distances = self._task.step(np.asarray(action, dtype=float).reshape(1, 4))
        info = {name: values[0].item() for name, values in _info(distances).items()}
        return self._task.observe()[0], float(rewards[0]), bool(failed[0]), bool(over[0] and not failed[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        """RGB, shape (240, 320, 3), uint8, or None without a render mode."""
        if self.render_mode is None:
            return None
        arena = self._task._arena()
        if self._picture is None:
            self._picture = Picture(arena)
        return self._picture.draw(self._task.goals[0])


class ReachVectorEnv(VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """Many drones in one simulation, which is many times faster than as many simulations.

    As :class:`ReachEnv`, with a leading axis; an episode that ended starts over with the step after
    (``AutoresetMode.NEXT_STEP``).
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int = 16, *, seconds: float = 8.0, gusts_m_s: float = 0.3) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or not 1 <= num_envs <= 1000:
            raise UsageError(f"num_envs is {num_envs!r} and must be a whole number from 1 to 1000")
        self.num_envs = num_envs
        self.single_action_space, self.single_observation_space = ACTIONS, OBSERVATIONS
        self.action_space = batch_space(ACTIONS, num_envs)
        self.observation_space = batch_space(OBSERVATIONS, num_envs)
        self._task = Reaching(num_envs, seconds, gusts_m_s)
        self._ended = np.zeros(num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed[0] if isinstance(seed, list) else seed, options=options)
        if seed is not None or self._task.arena is None:
            self._task.begin(int(self.np_random.integers(2**31)))
        self._task.restart(np.ones(self.num_envs, dtype=np.bool_), self.np_random)
        self._ended[:] = False
        return self._task.observe(), {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        again = self._ended.copy()
        if again.any():
            self._task.restart(again, self.np_random)
        rewards, failed, over, distances = self._task.step(np.asarray(actions, dtype=float))
        # The first step of a new episode is its reset: it has no reward and can't end it.
        rewards[again], failed[again], over[again] = 0.0, False, False
        over &= ~failed
        self._ended = failed | over
        return self._task.observe(), rewards, failed, over, _info(distances)

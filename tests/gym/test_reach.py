"""The Gymnasium environments on the simulator."""

from __future__ import annotations

import math
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs Gymnasium: skyloop install gym")

import gymnasium
from gymnasium.utils.env_checker import check_env

from skyloop.errors import UnknownNameError, UsageError
from skyloop.gym import (
    FollowEnv,
    FollowVectorEnv,
    GatesVectorEnv,
    HoverVectorEnv,
    ReachEnv,
    ReachVectorEnv,
    register,
)
from skyloop.gym.envs import _circle, on_board
from skyloop.gym.tasks import FOLLOWED_M, GATES, NEAR_M
from skyloop.sim.camera import look_at

EXAMPLE = Path(__file__).parents[2] / "examples" / "learn_to_reach.py"


def steer(seen: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the actions of a plain controller: towards the goal, turning to its heading; shape (…, 4)."""
    turn = np.arctan2(seen[..., 8], seen[..., 9])
    wanted = np.concatenate([1.2 * seen[..., :3] - 0.3 * seen[..., 3:6], turn[..., None]], axis=-1)
    action: np.ndarray[Any, Any] = np.clip(wanted, -1, 1).astype(np.float32)
    return action


@pytest.mark.parametrize(
    ("task", "observe"), [("Reach", "state"), ("Hover", "state"), ("Follow", "both"), ("Gates", "pixels")]
)
def test_gymnasiums_own_checker_passes(task: str, observe: str) -> None:
    register()
    register()
    env = gymnasium.make(f"skyloop/{task}-v0", render_mode="rgb_array", seconds=2.0, observe=observe)
    check_env(env.unwrapped)
    seen, told = env.reset(seed=1)
    assert env.observation_space.contains(seen)
    assert told["is_success"] in (True, False)
    assert isinstance(env.step(env.action_space.sample())[4]["is_success"], bool)
    env.close()


def test_observations_are_numbers_pictures_or_both() -> None:
    seen: dict[str, Any] = {}
    for observe in ("state", "pixels", "both"):
        env = FollowEnv(observe=observe)
        seen[observe], _ = env.reset(seed=4)
    assert seen["pixels"].shape == (64, 64, 3)
    assert seen["pixels"].dtype == np.uint8
    assert np.array_equal(seen["both"]["pixels"], seen["pixels"])
    assert np.array_equal(seen["both"]["motion"], seen["state"][3:8]), "values that a picture lacks, without the goal"
    pixels = seen["pixels"].astype(int)
    red = (pixels[..., 0] > 150) & (pixels[..., 1] < 110) & (pixels[..., 2] < 110)
    across = np.flatnonzero(red.any(axis=0))
    left, ahead = seen["state"][1], seen["state"][0]
    assert across.mean() == pytest.approx(32 - 40 * left / ahead, abs=3.0), "the target's position matches the numbers"
    envs = GatesVectorEnv(2, observe="both")
    many, told = envs.reset(seed=1)
    assert envs.observation_space.contains(many)
    assert told["is_success"].tolist() == [False, False]
    with pytest.raises(UsageError, match="observe is 'video' and must be one of state, pixels, both"):
        FollowEnv(observe="video")  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", [FollowVectorEnv, GatesVectorEnv, HoverVectorEnv, ReachVectorEnv])
def test_an_episode_begins_the_same_whatever_came_before(kind: Any) -> None:
    """Targets once began where the last episode had left them, and the velocity was that of its end."""
    fresh, used = kind(3), kind(3)
    seen, _ = used.reset(seed=5)
    for _ in range(40):
        seen, *_ = used.step(steer(seen))
    assert np.abs(seen[:, 3:6]).max() > 0.1
    one, other = fresh.reset(seed=7)[0], used.reset(seed=7)[0]
    assert np.array_equal(one, other)
    for _ in range(40):
        other, *_ = used.step(steer(other))
    again, _ = used.reset()
    assert np.abs(again[:, 3:6]).max() < 0.2, "it begins at rest"
    assert np.array_equal(used._task.age, [0, 0, 0])
    before = used._task.goals.copy()
    used._task.age[:] = 0
    if hasattr(used._task, "_walk"):
        used._task._walk(used._task.age)
    assert np.array_equal(before, used._task.goals)


def test_pictures_have_the_requested_size_and_show_no_other_drone() -> None:
    envs = ReachVectorEnv(4, observe="pixels", size_px=84)
    many, _ = envs.reset(seed=1)
    assert many.shape == (4, 84, 84, 3)
    assert envs.observation_space.contains(many)
    arena = envs._task.arena
    for drone in range(4):  # each looks across its cell's middle towards its neighbours
        arena.put(drone, np.array([0.0, 0.0, 2.0]), [0.0, math.pi / 2, -math.pi / 2, math.pi][drone])
    camera = on_board(arena, 84)
    none: list[Any] = []
    before = camera.aboard(0, none)
    arena.put(1, np.array([-3.0, 0.0, 2.0]), 0.0)
    assert np.array_equal(camera.aboard(0, none), before)
    arena.put(0, np.array([0.0, 0.0, 2.5]), 0.0)
    assert not np.array_equal(camera.aboard(0, none), before), "its own cell is visible"
    for wrong in (15, 513, 84.0, True):
        with pytest.raises(UsageError, match=r"size_px is .* and must be a whole number from 16 to 512"):
            ReachEnv(observe="pixels", size_px=wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("normal", [[0.0, 0.0, 1.0], [0.6, -0.8, 0.0], [0.1, -0.2, -0.97]])
def test_a_ring_is_round_and_square_to_its_normal(normal: list[float]) -> None:
    axis, centre = np.array(normal) / np.linalg.norm(normal), np.array([1.0, 2.0, 3.0])
    spokes = _circle(centre, axis, 0.5) - centre
    assert np.linalg.norm(spokes, axis=1) == pytest.approx(0.5)
    assert spokes @ axis == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.norm(np.diff(spokes, axis=0), axis=1) == pytest.approx(math.sin(math.pi / 24))


@pytest.mark.filterwarnings("error")
def test_nan_actions_count_as_zero() -> None:
    first, second = ReachEnv(), ReachEnv()
    for env in (first, second):
        env.reset(seed=1)
    one = first.step(np.array([np.nan, np.inf, -np.inf, 0.5], np.float32))
    other = second.step(np.array([0.0, 1.0, -1.0, 0.5], np.float32))
    assert np.array_equal(np.asarray(one[0]), np.asarray(other[0]))


def test_a_plain_controller_hovers_follows_and_flies_the_gates() -> None:
    hovering = HoverVectorEnv(8, seconds=8.0)
    seen, _ = hovering.reset(seed=3)
    for _ in range(100):
        seen, _, ended, _, told = hovering.step(steer(seen))
        assert not ended.any()
    assert told["is_success"].all()

    following = FollowVectorEnv(8, seconds=8.0)
    seen, _ = following.reset(seed=3)
    shares = []
    for _ in range(150):
        turn = np.arctan2(seen[:, 8], seen[:, 9])
        wanted = [1.2 * (seen[:, 0] - FOLLOWED_M), 0 * turn, 1.2 * seen[:, 2], 1.5 * turn]
        seen, _, ended, _, told = following.step(np.clip(np.stack(wanted, 1), -1, 1).astype(np.float32))
        assert not ended.any()
        shares.append(told["is_success"].mean())
    assert np.mean(shares[75:]) > 0.9

    racing = GatesVectorEnv(8, seconds=30.0)
    seen, _ = racing.reset(seed=3)
    passed, total = np.zeros(8, dtype=bool), 0.0
    for _ in range(600):
        beyond = seen.copy()  # a little behind the gate, so that it flies through
        beyond[:, 0] += 0.6 * seen[:, 9]
        beyond[:, 1] += 0.6 * seen[:, 8]
        seen, rewards, ended, _, told = racing.step(steer(beyond))
        total += float(rewards.mean())
        assert ((told["gates_passed"] == GATES) == told["is_success"]).all()
        assert (ended <= told["is_success"]).all(), "only the last gate ends it"
        passed |= told["is_success"]
        if passed.all():
            break
    assert passed.all()
    assert total > GATES


def test_the_same_seed_and_actions_give_the_same_episode() -> None:
    def episode(seed: int) -> list[np.ndarray[Any, Any]]:
        env = ReachEnv(seconds=1.0)
        seen: list[Any] = [env.reset(seed=seed)[0]]
        env.action_space.seed(1)
        seen += [env.step(env.action_space.sample())[0] for _ in range(20)]
        return seen

    first, again, other = episode(3), episode(3), episode(4)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])


def test_a_plain_controller_reaches_the_goal_and_time_ends_the_episode() -> None:
    env: gymnasium.Env[Any, Any] = ReachEnv(seconds=8.0)
    seen, _ = env.reset(seed=5)
    total, steps, over = 0.0, 0, False
    while not over:
        seen, reward, failed, over, told = env.step(steer(seen))
        assert not failed
        total, steps = total + float(reward), steps + 1
    assert steps == 200
    assert told["distance_m"] < NEAR_M
    assert told["is_success"]
    assert total > 5.0
    seen, _ = env.reset()
    assert np.linalg.norm(seen[:3]) > NEAR_M, "another start and goal, in the same world"


def test_a_drone_that_leaves_its_cell_has_failed() -> None:
    env = ReachEnv(seconds=60.0)
    env.reset(seed=1)
    for _ in range(500):
        _, reward, failed, over, _ = env.step(np.array([1.0, 0.0, 0.0, 0.0], np.float32))
        if failed:
            break
    assert failed
    assert not over
    assert reward < -4.0


def test_many_drones_restart_independently() -> None:
    register()
    envs = gymnasium.make_vec("skyloop/Reach-v0", num_envs=5, seconds=2.0)
    assert isinstance(envs.unwrapped, ReachVectorEnv)
    seen, _ = envs.reset(seed=2)
    assert seen.shape == (5, 10)
    assert envs.observation_space.contains(seen)
    for _ in range(50):
        seen, _, failed, over, told = envs.step(steer(seen))
    assert over.all()
    assert not failed.any()
    assert told["is_success"].tolist() == (told["distance_m"] < NEAR_M).tolist()
    near = told["distance_m"].copy()
    _, rewards, failed, over, told = envs.step(steer(seen))
    none = np.concatenate([rewards != 0.0, failed, over])
    assert not none.any(), "the first step of an episode is its reset"
    assert (told["distance_m"] > near).any()
    with pytest.raises(UsageError, match="num_envs is 0"):
        ReachVectorEnv(0)


def test_a_picture_shows_the_goal() -> None:
    env = ReachEnv(render_mode="rgb_array")
    env.reset(seed=1)
    picture = env.render()
    assert picture is not None
    assert picture.shape == (240, 320, 3)
    red = (picture[..., 0] > 180) & (picture[..., 1] < 90) & (picture[..., 2] < 90)
    assert red.sum() > 10
    assert ReachEnv().render() is None
    turn = look_at(np.array([1.0, 2.0, 3.0]), np.array([4.0, 4.0, 1.0]))
    assert np.allclose(turn @ turn.T, np.eye(3))
    assert math.isclose(float(np.linalg.det(turn)), 1.0)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"render_mode": "human"}, "render_mode"), ({"seconds": 0.0}, "seconds"), ({"gusts_m_s": math.nan}, "gusts_m_s")],
)
def test_wrong_arguments_are_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        ReachEnv(**wrong)


def test_it_must_be_reset_first() -> None:
    with pytest.raises(UsageError, match="call reset"):
        ReachEnv().step(np.zeros(4, np.float32))


def test_a_short_run_learns() -> None:
    """Train a linear policy by the cross-entropy method, in seconds on one core and without a framework."""
    learn = runpy.run_path(str(EXAMPLE))["learn"]
    curve = learn(8, seconds=3.0)
    assert curve[-1] > curve[0] + 1.0


def test_a_rotor_level_vehicle_also_reaches_the_goal() -> None:
    env = ReachEnv(vehicle="crazyflie", gusts_m_s=0.0)
    seen, _ = env.reset(seed=3)
    for _ in range(150):
        ahead = np.clip(np.asarray(seen)[:3], -1.0, 1.0)
        seen, _, ended, _, told = env.step(np.array([*ahead, 0.0], np.float32))
        assert not ended
    assert told["distance_m"] < 0.3
    with pytest.raises(UnknownNameError, match="crazyfly"):
        ReachEnv(vehicle="crazyfly")

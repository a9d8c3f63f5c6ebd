"""Reinforcement learning environments that run on the simulator much faster than real time (extra ``[gym]``).

::

    import gymnasium, skyloop.gym

    skyloop.gym.register()
    env = gymnasium.make("skyloop/Reach-v0")
    env = gymnasium.make("skyloop/Follow-v0", observe="pixels")
    envs = skyloop.gym.ReachVectorEnv(64)  # 64 drones in one simulation
"""

from __future__ import annotations

from skyloop.errors import MissingExtraError

try:
    import gymnasium
except ImportError:
    raise MissingExtraError("skyloop.gym", "gym") from None

from skyloop.gym.envs import (
    FollowEnv,
    FollowVectorEnv,
    GatesEnv,
    GatesVectorEnv,
    HoverEnv,
    HoverVectorEnv,
    ReachEnv,
    ReachVectorEnv,
)

__all__ = [
    "FollowEnv",
    "FollowVectorEnv",
    "GatesEnv",
    "GatesVectorEnv",
    "HoverEnv",
    "HoverVectorEnv",
    "ReachEnv",
    "ReachVectorEnv",
    "register",
]
TASKS = ("Reach", "Hover", "Follow", "Gates")


def register() -> None:
    """Register ``skyloop/Reach-v0`` and the other :data:`TASKS` for ``gymnasium.make``. Safe to call repeatedly."""
    for task in TASKS:
        if f"skyloop/{task}-v0" not in gymnasium.registry:
            gymnasium.register(
                f"skyloop/{task}-v0",
                entry_point=f"skyloop.gym:{task}Env",
                vector_entry_point=f"skyloop.gym:{task}VectorEnv",
            )

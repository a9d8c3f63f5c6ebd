"""Environments for reinforcement learning, over the simulator and much faster than real time (extra ``[gym]``).

::

    import gymnasium, skyloop.gym

    skyloop.gym.register()
    env = gymnasium.make("skyloop/Reach-v0")
    envs = skyloop.gym.ReachVectorEnv(64)  # 64 drones in one simulation
"""

from __future__ import annotations

from skyloop.errors import MissingExtraError

try:
    import gymnasium
except ImportError:
    raise MissingExtraError("skyloop.gym", "gym") from None

from skyloop.gym.reach import ReachEnv, ReachVectorEnv

__all__ = ["ReachEnv", "ReachVectorEnv", "register"]


def register() -> None:
    """Make ``skyloop/Reach-v0`` known to ``gymnasium.make`` and ``gymnasium.make_vec``. May be called twice."""
    if "skyloop/Reach-v0" not in gymnasium.registry:
        gymnasium.register(
            "skyloop/Reach-v0",
            entry_point="skyloop.gym:ReachEnv",
            vector_entry_point="skyloop.gym:ReachVectorEnv",
        )

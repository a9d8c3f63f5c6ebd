"""Teach a linear policy to fly to a place by the cross-entropy method, on 64 simulated drones at once.

Run it: python examples/learn_to_reach.py --rounds 12 (extra [gym]). It prints the mean return of each round.
"""

import argparse

import numpy as np

from skyloop.gym import ReachVectorEnv

DRONES, ELITE = 64, 12  # policies tried in each round, and the best ones, from which the next round starts


def returns_of(policies: np.ndarray, seconds: float, seed: int) -> np.ndarray:
    """Return the sum of rewards of each policy, with one drone each; shape (n,)."""
    envs = ReachVectorEnv(len(policies), seconds=seconds)
    seen, _ = envs.reset(seed=seed)
    total, alive = np.zeros(len(policies)), np.ones(len(policies), dtype=bool)
    for _ in range(round(seconds / 0.04)):
        actions = np.tanh(np.einsum("nij,nj->ni", policies, seen))
        seen, rewards, failed, over, _ = envs.step(actions.astype(np.float32))
        total += rewards * alive
        alive &= ~(failed | over)
    return total


def learn(rounds: int, seconds: float = 4.0, seed: int = 1) -> list[float]:
    """Return the mean returns of all policies, round by round, and finally the mean policy's."""
    rng = np.random.default_rng(seed)
    mean, spread = np.zeros((4, 10)), np.full((4, 10), 0.5)
    curve = []
    for number in range(rounds):
        policies = mean + spread * rng.normal(size=(DRONES, 4, 10))
        returns = returns_of(policies, seconds, seed + number)
        best = policies[np.argsort(returns)[-ELITE:]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.02
        curve.append(float(returns.mean()))
        print(f"round {number + 1:2d}: mean return {curve[-1]:6.2f}, best {returns.max():6.2f}")
    final = returns_of(np.repeat(mean[None], DRONES, axis=0), seconds, seed + 1000)
    print(f"learned policy: mean return {final.mean():.2f} on {DRONES} new starts and goals")
    return [*curve, float(final.mean())]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=12)
    learn(parser.parse_args().rounds)

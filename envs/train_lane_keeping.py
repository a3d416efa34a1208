"""Train the network shipped as `lane_keeping_policy.npz`; the same seed gives the same weights.

    python -m envs.train_lane_keeping
    python -m envs.train_lane_keeping --seed 3 --steps 1000000 --out my_policy.npz

Nothing is written, and the exit status is 1, if the policy did not learn to keep the lane.
"""

import argparse
import sys
import time
from pathlib import Path

from envs.lane_keeping import POLICY_FILE, LaneKeepingTask
from verifai_jax.rl import PPO, evaluate, save_policy, train

HYPER_PARAMETERS = PPO(
    learning_rate=1e-3,
    entropy=0.0,  # Exploration that is rewarded for itself would keep the wheel shaking.
    hidden=(16, 16),
    value_hidden=(64, 64),
    environments=32,
    horizon=128,
)
SOLVED = 235.0  # Of 250: on average 0.2 m beside the middle, or a little jerk.


def main(arguments: list[str] | None = None) -> int:
    """Train, measure, and write the weights; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=2_000_000, help="environment steps")
    parser.add_argument("--out", type=Path, default=POLICY_FILE)
    chosen = parser.parse_args(arguments)

    task = LaneKeepingTask()
    started = time.perf_counter()
    trained = train(task, HYPER_PARAMETERS, seed=chosen.seed, steps=chosen.steps)
    seconds = time.perf_counter() - started
    returns = evaluate(task, trained.policy, seed=chosen.seed + 1, episodes=1000)
    mean_return = float(returns.mean())
    print(
        f"{trained.steps[-1]} steps in {seconds:.1f} s, compile included; "
        f"mean return {mean_return:.1f} of 250, worst {returns.min():.0f} of 1000 episodes"
    )
    if mean_return < SOLVED:
        print(f"not solved: the mean return must reach {SOLVED:g}; nothing written")
        return 1
    save_policy(
        trained.policy,
        chosen.out,
        task="lane keeping",
        algorithm="PPO",
        seed=chosen.seed,
        steps=int(trained.steps[-1]),
        mean_return=mean_return,
    )
    print(f"wrote {chosen.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

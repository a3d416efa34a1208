"""Train the network that is shipped as `hopper_policy.npz`; the same seed gives the same weights.

    python -m envs.train_hopper
    python -m envs.train_hopper --seed 3 --steps 2000000 --out my_policy.npz

It takes seven minutes on one core. Nothing is written, and the exit status is 1, if the policy did
not learn to run.
"""

import argparse
import sys
import time
from pathlib import Path

from envs.hopper import POLICY_FILE, HopperTask
from verifai_jax.rl import PPO, evaluate, save_policy, train

HYPER_PARAMETERS = PPO(
    learning_rate=5e-4,
    entropy=0.002,
    environments=64,  # more are slower a step: their states no longer fit the cache
    horizon=128,
    epochs=6,
    minibatches=16,
    hidden=(32, 32),
    normalise=True,
)
SOLVED = 500.0  # of 750; standing still for 6 s earns 300


def main(arguments: list[str] | None = None) -> int:
    """Train, measure, and write the weights; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=4_000_000, help="environment steps")
    parser.add_argument("--out", type=Path, default=POLICY_FILE)
    chosen = parser.parse_args(arguments)

    started = time.perf_counter()
    trained = train(HopperTask(), HYPER_PARAMETERS, seed=chosen.seed, steps=chosen.steps)
    seconds = time.perf_counter() - started
    returns = evaluate(HopperTask(), trained.policy, seed=chosen.seed + 1, episodes=256)
    mean_return = float(returns.mean())
    print(
        f"{trained.steps[-1]} steps in {seconds:.1f} s, compile included; "
        f"mean return {mean_return:.1f} of 750, worst {returns.min():.0f} of 256 episodes"
    )
    if mean_return < SOLVED:
        print(f"not solved: the mean return must reach {SOLVED:g}; nothing written")
        return 1
    save_policy(
        trained.policy,
        chosen.out,
        task="hopper",
        algorithm="PPO",
        seed=chosen.seed,
        steps=int(trained.steps[-1]),
        mean_return=mean_return,
    )
    print(f"wrote {chosen.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

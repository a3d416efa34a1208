"""Train the network that is shipped as `hopper_policy.npz`; the same seed gives the same weights.

    python -m envs.train_hopper
    python -m envs.train_hopper --seed 3 --steps 2000000 --out my_policy.npz

It takes seven minutes on one core. Nothing is written, and the exit status is 1, if the policy did
not learn to run.
"""

import sys

from envs.hopper import POLICY_FILE, HopperTask
from envs.training import Training
from verifai_jax.addons.rl import PPO

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

TRAINING = Training(
    HopperTask(),
    HYPER_PARAMETERS,
    name="hopper",
    file=POLICY_FILE,
    steps=4_000_000,
    solved=SOLVED,
    maximum=750,
    seed=1,
    episodes=256,
)


if __name__ == "__main__":
    sys.exit(TRAINING.main(__doc__))

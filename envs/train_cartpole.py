"""Train the network that is shipped as `cartpole_policy.npz`; the same seed gives the same weights.

    python -m envs.train_cartpole
    python -m envs.train_cartpole --seed 3 --steps 300000 --out my_policy.npz

Nothing is written, and the exit status is 1, if the policy did not learn to balance.
"""

import sys

from envs.cartpole import POLICY_FILE
from envs.cartpole_task import CartPoleTask
from envs.training import Training
from verifai_jax.addons.rl import PPO

HYPER_PARAMETERS = PPO(
    learning_rate=5e-4,
    hidden=(16, 16),  # as good as wider ones here, and the faster to simulate
    value_hidden=(64, 64),
    environments=8,
    horizon=128,
)
SOLVED = 475.0  # CartPole-v1's reward threshold

TRAINING = Training(
    CartPoleTask(),
    HYPER_PARAMETERS,
    name="CartPole-v1",
    file=POLICY_FILE,
    steps=500_000,
    solved=SOLVED,
    maximum=500,
)


if __name__ == "__main__":
    sys.exit(TRAINING.main(__doc__))

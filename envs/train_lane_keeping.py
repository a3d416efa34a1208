"""Train the network shipped as `lane_keeping_policy.npz`; the same seed gives the same weights.

    python -m envs.train_lane_keeping
    python -m envs.train_lane_keeping --seed 3 --steps 1000000 --out my_policy.npz

Nothing is written, and the exit status is 1, if the policy did not learn to keep the lane.
"""

import sys

from envs.lane_keeping import POLICY_FILE, LaneKeepingTask
from envs.training import Training
from verifai_jax.addons.rl import PPO

HYPER_PARAMETERS = PPO(
    learning_rate=1e-3,
    entropy=0.0,  # Exploration that is rewarded for itself would keep the wheel shaking.
    hidden=(16, 16),
    value_hidden=(64, 64),
    environments=32,
    horizon=128,
)
SOLVED = 235.0  # Of 250: on average 0.2 m beside the middle, or a little jerk.

TRAINING = Training(
    LaneKeepingTask(),
    HYPER_PARAMETERS,
    name="lane keeping",
    file=POLICY_FILE,
    steps=2_000_000,
    solved=SOLVED,
    maximum=250,
)


if __name__ == "__main__":
    sys.exit(TRAINING.main(__doc__))

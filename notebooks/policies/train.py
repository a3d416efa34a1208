"""Train the policy of notebook 15 with Stable-Baselines3: a minute on one core.

pip install stable-baselines3
python notebooks/policies/train.py
"""

from pathlib import Path

import gymnasium
import stable_baselines3 as sb3

model = sb3.PPO(
    "MlpPolicy", gymnasium.make("CartPole-v1"), seed=1, n_steps=512, learning_rate=1e-3,
    policy_kwargs={"net_arch": [16, 16]},
)  # fmt: skip
model.learn(30_000)
model.save(Path(__file__).parent / "cartpole_ppo.zip")

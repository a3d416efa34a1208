"""Training configurations of the cart-pole's network, and which of them are safe.

verifai-jax sweep specs/cartpole_training.py:safe_training --configurations 32
"""

import verifai_jax as vj
from envs.cartpole_task import CartPoleTask
from specs.cartpole import balance_with
from verifai_jax.addons.rl import PPO

# Return says how long the nominal pole stays up; whether any pole does is another question. A
# training that varies the pole (`length_range`, `masspole_range`) sees what it is asked later.
safe_training = vj.Study(
    "safe_training",
    vj.FeatureSpace(
        {
            "learning_rate": vj.LogUniform(3e-4, 1e-2),
            "discount": vj.Box(0.95, 0.999),
            "gae_lambda": vj.Box(0.9, 1.0),
            "clip": vj.Box(0.1, 0.4),
            "entropy": vj.Box(0.0, 0.02),
            "length_range": vj.Box(0.0, 2.0),
            "x0_range": vj.Box(0.05, 1.0),
        }
    ),
    vj.Trainer(CartPoleTask(), PPO(anneal=False), steps=32_768),
    balance_with,
    p=0.01,
    description="which PPO trainings give a network that keeps every pole of `balance` up",
)

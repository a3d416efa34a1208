"""The problem of `held_pendulum.py`: verify it, and check what is proved by another program.

verifai-jax verify held_pendulum_problem.py:problem --continuous --into boxes.json
python check_plant.py held_pendulum.py boxes.json
"""

import sys
from pathlib import Path

import jax.numpy as jnp

import verifai_jax as vj

sys.path.append(str(Path(__file__).parent))
import held_pendulum as plant

problem = vj.Problem(
    "held_pendulum",
    {name: vj.Box(*ends) for name, ends in plant.FEATURES.items()},
    vj.ode(
        lambda t, s, u, f: plant.rates(s, u, [f[name] for name in plant.FEATURES], jnp),
        lambda f, key: plant.start([f[name] for name in plant.FEATURES]),
        dt=plant.PERIOD / 2, duration=plant.SECONDS,
        controller=lambda t, s, f: plant.control(s, jnp), control_period=plant.PERIOD,
        signals=lambda t, s, u, f: {"margin": plant.margin(s)},
    ),
    "always margin >= 0",
)  # fmt: skip

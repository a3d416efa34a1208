"""Modes of failure: the failing regions, their probabilities and their causes.

found = modes(problem)
print(found)
found[0].probability, found[0].features, found[0].cause
"""

from verifai_jax.addons.estimation.failure_modes._modes import modes as modes
from verifai_jax.addons.estimation.failure_modes.result import Mode as Mode
from verifai_jax.addons.estimation.failure_modes.result import Modes as Modes

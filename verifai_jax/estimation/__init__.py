"""Failure probabilities: Monte Carlo, importance sampling and multilevel splitting.

result = vj.estimate(problem)                        # chooses the method itself
result = vj.estimate(problem, method="monte_carlo")
simulations_until(1e-6, failures=0, simulations=50_000)
"""

from verifai_jax.estimation._estimate import estimate as estimate
from verifai_jax.estimation.intervals import simulations_until as simulations_until
from verifai_jax.estimation.intervals import upper_bound as upper_bound
from verifai_jax.estimation.result import METHODS as METHODS
from verifai_jax.estimation.result import Estimate as Estimate

"""Failure probabilities: Monte Carlo, importance sampling and multilevel splitting.

result = vj.estimate(problem)                        # chooses the method itself
result = vj.estimate(problem, method="monte_carlo")
simulations_until(1e-6, failures=0, simulations=50_000)
"""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.addons.estimation._estimate import estimate as estimate
    from verifai_jax.addons.estimation._sequence import sequence as sequence
    from verifai_jax.addons.estimation.intervals import simulations_until as simulations_until
    from verifai_jax.addons.estimation.intervals import upper_bound as upper_bound
    from verifai_jax.addons.estimation.result import METHODS as METHODS
    from verifai_jax.addons.estimation.result import Estimate as Estimate
    from verifai_jax.addons.estimation.sequence_result import SequenceEstimate as SequenceEstimate
__getattr__, __dir__, __all__ = attach(__name__)

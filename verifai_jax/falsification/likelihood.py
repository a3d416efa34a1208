"""The objective of a search for likely failures: the reward of adaptive stress testing.

    objective = Likelihood(problem.space)
    objective, verdicts = objective.learned(points, rho, verdicts)

Likelier failures have a lower objective. Safe rows have a higher objective than any failure, and it
grows with their robustness (Lee et al., Adaptive stress testing: finding likely failure events with
reinforcement learning, JAIR 69, 2020). It is never negative, so that no search stays with the
failures that it has found.
"""

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.core.values.clauses import ABSENT
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.features import FeatureSpace
from verifai_jax.features.improbability import Improbability

SAFE = 1e4
"""The objective of a robustness of zero: more standard deviations than any failure has."""


class Likelihood:
    """The objective of a search for likely failures, as `problem.rulebook.Objective`.

    **Arguments:**
    - `space`: the space of the features.
    **Raises:** `NoDensityError` for a space whose features have no density.
    """

    def __init__(self, space: FeatureSpace) -> None:
        self.improbability = Improbability(space)
        self.state: dict[str, np.ndarray] = {"scale": np.zeros(())}  # 0 until a batch shows it.

    def __call__(
        self, points: Float[np.ndarray, "n d"], rho: Float[np.ndarray, " n"],
        failing: Bool[np.ndarray, " n"],
    ) -> Float[np.ndarray, " n"]:  # fmt: skip
        """Return the distance of failures in standard deviations, and more for safe rows."""
        known = np.abs(rho[np.isfinite(rho)])
        if not self.state["scale"] and known.any():
            self.state = {"scale": np.array(np.mean(known))}
        safe = SAFE * (1 + np.maximum(rho, 0.0) / (self.state["scale"] or 1.0))
        return np.where(failing, np.sqrt(self._square(points)), safe)

    def learned(
        self, points: Float[np.ndarray, "n d"], rho: Float[np.ndarray, " n"], verdicts: Verdicts
    ) -> tuple[Float[np.ndarray, " n"], Verdicts]:
        """Return the objective, and verdicts with its clauses and gradients.

        **Arguments:**
        - `points`: the points of a round, in the unit cube.
        - `rho`: the usual objective, which is positive for failures that are not claimed.
        - `verdicts`: the verdicts of their simulations.
        """
        points = np.asarray(points, np.float64)
        failing = verdicts.violated & (rho <= 0)
        objective = self(points, rho, failing)
        away = self.improbability.departure(points) * self.improbability.slope(points)
        uphill = away / np.maximum(np.sqrt(self._square(points)), 1e-6)[:, None]
        uphill[:, self.improbability.space.cube.discrete] = 0.0
        factor = SAFE / (self.state["scale"] or 1.0)

        def mixed(gradient: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
            return np.where(failing[:, None], uphill, factor * gradient).astype(np.float32)

        if verdicts.gradient is not None:
            verdicts = verdicts._replace(gradient=mixed(verdicts.gradient))
        if verdicts.clauses is None:
            return objective, verdicts
        # One clause, the objective: all have to be broken, so that the greatest one decides.
        greatest = np.argmax(verdicts.clauses, axis=1)
        clauses = np.full_like(verdicts.clauses, ABSENT)
        clauses[:, 0] = objective
        gradients = verdicts.clause_gradients
        if gradients is not None:
            own = gradients[np.arange(len(points)), greatest]
            gradients = np.zeros_like(gradients)
            gradients[:, 0] = mixed(own)
        return objective, verdicts._replace(clauses=clauses, clause_gradients=gradients)

    def _square(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        return np.sum(self.improbability.square(points), axis=1)

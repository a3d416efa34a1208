"""Candidates for a smaller counterexample, simulated once each, and all that came of them.

judge = Judge(problem, nominal, budget=2000, precision="float32")
rho, failing = judge(points)                        # refused, repeated and unpaid ones too
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.counterexamples.nominal import Nominal
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.problem.problem import Problem

BATCH = 64
"""Simulations at once: what a round of candidates takes."""
FEW = 8
"""Gradients at once: one for each point that a search of the boundary follows."""


class Linear(NamedTuple):
    """Robustness near a point: `value + slope (u - point)`."""

    point: Float[np.ndarray, " d"]
    value: float
    slope: Float[np.ndarray, " d"]


class Judge:
    """Simulates settled points and remembers them; `simulations` counts, at most `budget`.

    A gradient counts as one simulation.
    """

    def __init__(
        self, problem: Problem, nominal: Nominal, budget: int, precision: str = "float32"
    ) -> None:
        self.problem, self.nominal, self.budget = problem, nominal, budget
        self.precision, self.limit = precision, budget
        self._evaluate = Evaluator(problem, BATCH, precision=precision)
        self._differentiate: Evaluator | None = None
        self._known: dict[bytes, tuple[float, bool]] = {}
        self._linear: dict[bytes, Linear] = {}
        self.points = np.zeros((0, nominal.space.dim), np.float32)
        self.rho = np.zeros(0)
        self.failing = np.zeros(0, bool)
        self.temperature = 1.0
        self.gradients = not problem.black_box
        self.note = ""

    @property
    def simulations(self) -> int:
        """How many there were."""
        differentiated = 0 if self._differentiate is None else self._differentiate.simulations
        return self._evaluate.simulations + differentiated

    @property
    def left(self) -> int:
        """How many there may still be."""
        return self.limit - self.simulations

    def __call__(self, points: Any) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Robustness and whether each point fails.

        A point that the constraint refuses, or that the budget no longer pays for, or whose
        simulation has no verdict, does not fail and has an infinite robustness.
        """
        points = self.nominal.settle(points)
        keys = [point.tobytes() for point in points]
        fresh = {key: i for i, key in reversed(list(enumerate(keys))) if key not in self._known}
        order = sorted(fresh.values())
        order = self._accepted(points, order)[: max(self.left, 0)]
        if order:
            judged = self._evaluate(points[order])
            rho = np.where(judged.proper, judged.rho, np.inf).astype(np.float64)
            for i, value, fails in zip(order, rho, judged.failing, strict=True):
                self._known[keys[i]] = (float(value), bool(fails))
            self.points = np.concatenate([self.points, points[order]])
            self.rho = np.concatenate([self.rho, rho])
            self.failing = np.concatenate([self.failing, judged.failing])
        found = [self._known.get(key, (np.inf, False)) for key in keys]
        return np.array([rho for rho, _ in found]), np.array([bad for _, bad in found], bool)

    def linear(self, points: Any) -> list[Linear | None]:
        """The tangents of the robustness at these points; None where there is none of use."""
        points = self.nominal.settle(points)
        keys = [point.tobytes() for point in points]
        if self.gradients:
            todo = [i for i, key in enumerate(keys) if key not in self._linear]
            todo = self._accepted(points, todo)[: max(self.left, 0)]
            if todo:
                self._tangents(points[todo], [keys[i] for i in todo])
        return [self._linear.get(key) for key in keys]

    def _tangents(self, points: Float[np.ndarray, "n d"], keys: list[bytes]) -> None:
        try:
            if self._differentiate is None:
                self._differentiate = Evaluator(
                    self.problem, FEW, gradient=True, precision=self.precision
                )
            judged = self._differentiate(points, self.temperature)
        except Exception as error:
            # Some systems run and cannot be differentiated; without a slope it takes longer.
            self.gradients = False
            self.note = f"without gradients, which raised {type(error).__name__}"
            return
        assert judged.gradient is not None
        free = np.array(self.nominal.cube.levels) == 0
        for key, point, rho, slope in zip(keys, points, judged.rho, judged.gradient, strict=True):
            slope = np.where(free, slope, 0.0).astype(np.float64)
            if np.isfinite(rho) and np.all(np.isfinite(slope)) and np.any(slope):
                self._linear[key] = Linear(point.astype(np.float64), float(rho), slope)

    def _accepted(self, points: Float[np.ndarray, "n d"], order: list[int]) -> list[int]:
        if self.nominal.space.where is None or not order:
            return order
        kept = []
        for start in range(0, len(order), BATCH):
            part = order[start : start + BATCH]
            block = np.zeros((BATCH, points.shape[1]), np.float32)
            block[: len(part)] = points[part]
            accepted = np.asarray(self.nominal.space.accepts_points(block))[: len(part)]
            kept += [i for i, good in zip(part, accepted, strict=True) if good]
        return kept

"""Candidates for a smaller counterexample: each is simulated once, within a budget.

candidates = Candidates(problem, nominal, budget=2000, precision="float32")
rho, failing = candidates(points)                   # also of points that cannot be simulated
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.core.messages.text import one_line
from verifai_jax.counterexamples.nominal import Nominal
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.problem.problem import Problem

BATCH = 64
"""Simulations in one call of the compiled program."""
GRADIENTS = 8
"""Gradients in one call of the compiled program."""


class Tangent(NamedTuple):
    """Linear model of the robustness near a point: `value + gradient (u - point)`."""

    point: Float[np.ndarray, " d"]
    value: float
    gradient: Float[np.ndarray, " d"]


class Candidates:
    """Simulations of candidate points, at most `budget` of them, each made once.

    A gradient counts as one simulation.

    **Arguments:**
    - `problem`: the problem whose system is simulated.
    - `nominal`: the point from which candidates depart.
    - `budget`: maximum number of simulations.
    - `precision`: the precision of the simulations, `"float32"` or `"float64"`.

    **Attributes:** `points` `[n, d]`, `rho` `[n]` and `failing` `[n]` of all simulations; `limit`:
    the current maximum number of simulations; `max_items`: points with more items (such as events)
    are not simulated; `temperature` of the smooth robustness that is differentiated;
    `differentiable`: whether gradients are available; `note`: why not, as text; `without_verdict`:
    number of simulations without a verdict; `trouble`: the error of the first of these.
    """

    def __init__(
        self, problem: Problem, nominal: Nominal, budget: int, precision: str = "float32"
    ) -> None:
        self.problem, self.nominal, self.budget = problem, nominal, budget
        self.precision, self.limit = precision, budget
        self.max_items: int | None = None
        self._evaluate = Evaluator(problem, BATCH, precision=precision)
        self._differentiate: Evaluator | None = None
        self._known: dict[bytes, tuple[float, bool]] = {}
        self._tangents_at: dict[bytes, Tangent] = {}
        self.points = np.zeros((0, nominal.space.dim), np.float32)
        self.rho = np.zeros(0)
        self.failing = np.zeros(0, bool)
        self.temperature = 1.0
        self.differentiable = not problem.black_box and 0 in nominal.space.levels
        self.note = ""
        self.without_verdict, self.trouble = 0, ""

    @property
    def notes(self) -> list[str]:
        """Sentences on missing gradients, and on simulations without a verdict."""
        notes = [self.note] if self.note else []
        if self.without_verdict:
            why = f", the first because of {one_line(self.trouble, 200)}" if self.trouble else ""
            notes.append(
                f"{self.without_verdict:,} of {len(self.rho):,} simulations had no verdict{why}"
            )
        return notes

    @property
    def simulations(self) -> int:
        """Number of simulations and gradients so far."""
        differentiated = 0 if self._differentiate is None else self._differentiate.simulations
        return self._evaluate.simulations + differentiated

    @property
    def left(self) -> int:
        """Number of simulations that may still be made before the limit."""
        return self.limit - self.simulations

    def __call__(
        self, points: np.ndarray
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Simulate points `[n, d]`; return the robustness of each and whether it fails.

        A point that the constraint refuses, that the limit leaves no simulation for, or whose
        simulation has no verdict, does not fail and has an infinite robustness.
        """
        points = self.nominal.settle(points)
        keys = [point.tobytes() for point in points]
        fresh = {key: i for i, key in reversed(list(enumerate(keys))) if key not in self._known}
        order = sorted(fresh.values())
        order = self._accepted(points, order)[: max(self.left, 0)]
        if order:
            verdicts = self._evaluate(points[order])
            rho = np.where(verdicts.proper, verdicts.lowest, np.inf).astype(np.float64)
            self.without_verdict += int(np.sum(~verdicts.proper))
            self.trouble = next(filter(None, [self.trouble, *(verdicts.messages or [])]), "")
            for i, value, fails in zip(order, rho, verdicts.violated, strict=True):
                self._known[keys[i]] = (float(value), bool(fails))
            self.points = np.concatenate([self.points, points[order]])
            self.rho = np.concatenate([self.rho, rho])
            self.failing = np.concatenate([self.failing, verdicts.violated])
        known = [self._known.get(key, (np.inf, False)) for key in keys]
        return np.array([rho for rho, _ in known]), np.array([fails for _, fails in known], bool)

    def tangents(self, points: Float[np.ndarray, "n d"]) -> list[Tangent | None]:
        """Return the tangents of the robustness at points `[n, d]`; None if it has none."""
        points = self.nominal.settle(points)
        keys = [point.tobytes() for point in points]
        if self.differentiable:
            todo = [i for i, key in enumerate(keys) if key not in self._tangents_at]
            todo = self._accepted(points, todo)[: max(self.left, 0)]
            if todo:
                self._differentiate_at(points[todo], [keys[i] for i in todo])
        return [self._tangents_at.get(key) for key in keys]

    def _differentiate_at(self, points: Float[np.ndarray, "n d"], keys: list[bytes]) -> None:
        try:
            if self._differentiate is None:
                self._differentiate = Evaluator(
                    self.problem, GRADIENTS, gradient=True, precision=self.precision
                )
            verdicts = self._differentiate(points, self.temperature)
        except Exception as error:
            # Some systems run and cannot be differentiated; without a gradient it takes longer.
            self.differentiable = False
            self.note = f"without gradients, which raised {type(error).__name__}"
            return
        assert verdicts.gradient is not None
        free = np.array(self.nominal.cube.levels) == 0
        gradients = np.where(free, verdicts.gradient, 0.0).astype(np.float64)
        for key, point, rho, gradient in zip(keys, points, verdicts.lowest, gradients, strict=True):
            if np.isfinite(rho) and np.all(np.isfinite(gradient)) and np.any(gradient):
                self._tangents_at[key] = Tangent(point.astype(np.float64), float(rho), gradient)

    def _accepted(self, points: Float[np.ndarray, "n d"], order: list[int]) -> list[int]:
        if self.max_items is not None and order:
            items = self.nominal.items(points[order])
            order = [i for i, n in zip(order, items, strict=True) if n <= self.max_items]
        if self.nominal.space.where is None or not order:
            return order
        accepted_indices = []
        for start in range(0, len(order), BATCH):
            part = order[start : start + BATCH]
            block = np.zeros((BATCH, points.shape[1]), np.float32)
            block[: len(part)] = points[part]
            accepted = np.asarray(self.nominal.space.accepts_points(block))[: len(part)]
            accepted_indices += [i for i, good in zip(part, accepted, strict=True) if good]
        return accepted_indices

"""Any number of points of the unit cube, simulated and judged in batches of one shape.

    evaluate = Evaluator(problem, batch=512, seed=0)
    judged = evaluate(u)                                # u [n, d], any n
    judged.failing, judged.proper, judged.rho           # [n] each

What the verbs over a problem share that need simulations and no search: they say which points, and
get verdicts. Each simulation has a random key of its own, by its number.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.core.keys import run_keys
from verifai_jax.core.trace import Status
from verifai_jax.evaluation.engine import Engine, Evaluation, engine_for
from verifai_jax.evaluation.host_engine import HostEngine
from verifai_jax.problem.problem import Problem


class Judged(NamedTuple):
    """What came of points, on the host, one row each.

    - `rho`: the least formula's hard robustness; NaN where there is no verdict.
    - `failing`: whether the simulation ended properly and breaks a formula; where the robustness
      is exactly zero the Boolean semantics decide.
    - `proper`: whether it ended properly.
    - `gradient`: `[n, d]` of the least smooth robustness by the unit coordinates, if asked for.
    - `each`: `[n, formulas]`, the robustness of each formula.
    """

    rho: Float[np.ndarray, " n"]
    failing: Bool[np.ndarray, " n"]
    proper: Bool[np.ndarray, " n"]
    gradient: Float[np.ndarray, "n d"] | None
    each: Float[np.ndarray, "n formulas"]


class Evaluator:
    """Simulates and judges points of a problem's unit cube; `simulations` counts them.

    **Arguments:**

    - `problem`: a checked one, on the backend it is to run on.
    - `batch`: simulations at once; a call with fewer points is padded.
    - `gradient`: whether the smooth robustness is differentiated too.
    - `seed`: of the random keys of simulations; as in `falsify`.
    """

    def __init__(
        self,
        problem: Problem,
        batch: int = 512,
        *,
        gradient: bool = False,
        precision: str = "float32",
        seed: int = 0,
    ) -> None:
        self.problem, self.batch = problem, batch
        self.engine = (
            HostEngine(problem, precision)
            if problem.black_box
            else engine_for(problem, batch, gradient, precision)
        )
        self.key = run_keys(seed)[1]
        self.simulations = 0

    def __call__(self, u: Any, temperature: float = 1.0) -> Judged:
        """Simulate and judge these points `[n, d]`; their numbers go on from those before."""
        parts = []
        for start in range(0, len(u), self.batch):
            points: Any = np.asarray(u[start : start + self.batch], np.float32)
            found = self.engine.evaluate(points, self.key, self.simulations, temperature)
            failing = violated(self.engine, found, points, self.key, self.simulations)
            self.simulations += len(points)
            rho = np.min(found.rho, axis=1)
            proper = found.status == Status.OK
            parts.append(Judged(rho, failing, proper, found.gradient, found.rho))
        if len(parts) == 1:
            return parts[0]
        if not parts:
            d, formulas = self.problem.space.dim, len(self.problem.formulas)
            nothing, no = np.zeros(0, np.float32), np.zeros(0, bool)
            gradient = np.zeros((0, d), np.float32)
            return Judged(nothing, no, no, gradient, np.zeros((0, formulas), np.float32))
        columns: Any = [
            None if column[0] is None else np.concatenate(column)
            for column in zip(*parts, strict=True)
        ]
        return Judged(*columns)


def violated(
    engine: Engine | HostEngine, evaluation: Evaluation, points: Any, key: Any, first: int
) -> Bool[np.ndarray, " n"]:
    """Which simulations ended properly and break a formula."""
    broken = np.any(evaluation.rho < 0, axis=1)
    proper = evaluation.status == Status.OK
    undecided = proper & ~broken & np.any(evaluation.rho == 0, axis=1)
    if undecided.any():
        # At exactly zero the comparator decides: x >= 0 holds there, x > 0 does not.
        holds = evaluation.holds
        if holds is None:
            assert isinstance(engine, Engine)
            holds = engine.verdicts(points, key, first)
        broken |= undecided & ~np.all(holds, axis=1)
    return broken

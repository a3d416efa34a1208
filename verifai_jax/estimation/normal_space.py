"""What the methods ask of a problem: verdicts of points in standard normal space, and the prior.

    judge = Judge(evaluate, dim, budget=50_000, batch=256)
    z = judge.prior(rng, 1000)                  # accepted by the constraint, not simulated yet
    seen = judge(z)                             # seen.score, seen.failing, seen.proper; counted

Points are `z [n, d]`, of which `u = Phi(z)` lies in the unit cube: the prior, uniform there, is
standard normal here, conditional on the constraint. The methods are pure functions over a judge, so
that they are tested on closed forms without a simulation.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

MOST_DRAWN = 4_000_000
"""Points drawn from the prior in search of accepted ones, at most, for each one wanted."""


class Seen(NamedTuple):
    """Verdicts of points, one row each.

    - `score`: what the splitting lowers: minus infinity for a failure, infinite without a verdict,
      else the robustness, which is not negative.
    - `failing`, `proper`: whether it fails; whether it has a verdict.
    """

    score: Float[np.ndarray, " n"]
    failing: Bool[np.ndarray, " n"]
    proper: Bool[np.ndarray, " n"]


class Ended(Exception):
    """Time is over, or the user has interrupted; what is finished counts."""


class Judge:
    """Simulates points of normal space within a budget.

    **Arguments:**

    - `evaluate`: `u [n, d] -> (rho, failing, proper)`, each `[n]`.
    - `dim`: unit coordinates.
    - `budget`: simulations in all; a method has to plan with `left`.
    - `batch`: points that are simulated together.
    - `accepts`: the constraint, of points `u`; none when left out.
    - `deadline`: on the clock of `time.perf_counter`, after which `Ended` is raised.
    - `told`: is told of the simulations done and the failures seen after each batch.
    """

    def __init__(
        self,
        evaluate: Callable[[Any], tuple[Any, Any, Any]],
        dim: int,
        budget: int,
        batch: int = 256,
        accepts: Callable[[Any], Any] | None = None,
        deadline: float | None = None,
        told: Callable[[int, int, float], None] | None = None,
    ) -> None:
        self.evaluate, self.dim, self.budget, self.batch = evaluate, dim, budget, batch
        self.accepts_unit, self.deadline, self.told = accepts, deadline, told
        self.simulations = self.failures = self.no_verdict = 0
        self.first: tuple[int, int, int] = (
            0,
            0,
            0,
        )  # Simulations, failures and no verdicts of a pilot of the prior.
        self.least = np.inf
        self.ended: str | None = None

    @property
    def left(self) -> int:
        """Simulations that may still be done."""
        return 0 if self.ended else self.budget - self.simulations

    def accepts(self, z: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
        """Which points the constraint accepts; nothing is simulated."""
        if self.accepts_unit is None or not len(z):
            return np.ones(len(z), bool)
        size = 4096  # One shape, whatever is asked.
        parts = []
        for start in range(0, len(z), size):
            part = unit(z[start : start + size])
            padded = np.pad(part, ((0, size - len(part)), (0, 0)), mode="edge")
            parts.append(np.asarray(self.accepts_unit(padded))[: len(part)])
        return np.concatenate(parts)

    def prior(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        """`n` independent points of the prior, given that the constraint accepts them."""
        if self.accepts_unit is None:
            return rng.standard_normal((n, self.dim))
        found, have, drawn = [], 0, 0
        while have < n:
            z = rng.standard_normal((4096, self.dim))
            z = z[self.accepts(z)][: n - have]
            found.append(z)
            have, drawn = have + len(z), drawn + 4096
            if drawn > MOST_DRAWN and have < n * drawn / (100 * MOST_DRAWN):
                raise ValueError("where accepts too little of the space to sample it")
        return np.concatenate(found) if found else np.zeros((0, self.dim))

    def acceptance(self, rng: np.random.Generator, n: int = 200_000) -> tuple[float, float]:
        """The share of the prior that the constraint accepts, and its relative error."""
        if self.accepts_unit is None:
            return 1.0, 0.0
        share = float(np.mean(self.accepts(rng.standard_normal((n, self.dim)))))
        return share, float(np.sqrt((1 - share) / (share * n))) if share else np.inf

    def __call__(self, z: Float[np.ndarray, "n d"]) -> Seen:
        """Simulate these points; an end in between raises `Ended`, the batch before it counted."""
        parts = []
        for start in range(0, len(z), self.batch):
            if self.ended or (self.deadline is not None and time.perf_counter() > self.deadline):
                self.ended = self.ended or "max_seconds"
                raise Ended
            try:
                seen = self._batch(z[start : start + self.batch])
            except KeyboardInterrupt:
                self.ended = "interrupted"
                raise Ended from None
            parts.append(seen)
        if not parts:
            return Seen(np.zeros(0), np.zeros(0, bool), np.zeros(0, bool))
        return Seen(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _batch(self, z: Float[np.ndarray, "n d"]) -> Seen:
        rho, failing, proper = (np.asarray(part) for part in self.evaluate(unit(z)))
        known = proper & np.isfinite(rho)
        score = np.where(known, np.maximum(rho, 0.0), np.inf).astype(np.float64)
        score[failing] = -np.inf
        self.simulations += len(z)
        self.failures += int(failing.sum())
        self.no_verdict += int((~proper).sum())
        if known.any():
            self.least = min(self.least, float(rho[known].min()))
        if self.told is not None:
            self.told(self.simulations, self.failures, self.least)
        return Seen(score, failing, proper)


def unit(z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """The points of the unit cube, in double precision: single has no probabilities near one."""
    from scipy.special import ndtr

    return ndtr(z)

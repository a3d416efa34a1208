"""The limit state of a problem in standard normal space: scores of points, and the prior.

    limit_state = LimitState(evaluate, dim, budget=50_000, batch=256)
    z = limit_state.sample_prior(rng, 1000)     # accepted by the constraint, not simulated yet
    scores = limit_state(z)                     # scores.score, scores.failing, scores.proper

Points are `z [n, d]`, and `u = Phi(z)` lies in the unit cube: the prior, uniform there, is standard
normal here, conditional on the constraint. The methods are pure functions over a limit state, so
they are tested on closed forms without a simulation.
"""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

if TYPE_CHECKING:
    from verifai_jax.addons.verification.rest import Rest
Evaluate: TypeAlias = Callable[
    [Float[np.ndarray, "n d"]],
    tuple[Shaped[np.ndarray, " n"], Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]],
]
"""From points `u [n, d]` of the unit cube to robustness, violation, and a proper verdict, `[n]`."""
Differentiate: TypeAlias = Callable[
    [Float[np.ndarray, "n d"]],
    tuple[
        Shaped[np.ndarray, " n"],
        Bool[np.ndarray, " n"],
        Bool[np.ndarray, " n"],
        Float[np.ndarray, "n d"],
    ],
]
"""The same, and the gradient `[n, d]` of the robustness by the coordinates of the unit cube."""
MAX_DRAWN = 4_000_000
"""Points drawn from the prior in search of accepted ones, at most, for each one wanted."""
_CONSTRAINT_BATCH = 4096
"""Points of one call of the constraint, so that one shape compiles."""


class Scores(NamedTuple):
    """Scores of points, one row each.

    - `score`: the number that splitting lowers: minus infinity for a failure, infinity without a
      verdict, otherwise the robustness, which is not negative.
    - `failing`: True where the simulation ended properly and breaks a formula.
    - `proper`: True where the simulation has a verdict.
    """

    score: Float[np.ndarray, " n"]
    failing: Bool[np.ndarray, " n"]
    proper: Bool[np.ndarray, " n"]


class Linearized(NamedTuple):
    """Robustness and gradient at points of normal space, one row each.

    - `score`: as in `Scores`.
    - `rho`: the robustness; NaN without a verdict.
    - `gradient`: by the coordinates of normal space; zero where it is not finite.
    """

    score: Float[np.ndarray, " n"]
    rho: Float[np.ndarray, " n"]
    gradient: Float[np.ndarray, "n d"]


FIRST = 16
"""Initial number of requested simulations, if they run one after another."""
SECONDS = 1.0
"""Seconds after which fewer of these are asked for at a time."""
BUSY = 4
"""Simulations for each of several workers that are asked for at a time, at least: most of them are
busy until the last one ends."""


class Ended(Exception):
    """The time is over, or the user has interrupted; finished simulations count."""


class Spent(Ended):
    """The budget of a strict limit state is spent; finished simulations count."""


class LimitState:
    """Scores of points of standard normal space, within a budget of simulations.

    **Arguments:**
    - `evaluate`: a function from points `u [n, d]` of the unit cube to `(rho, failing, proper)`,
      each `[n]`.
    - `dim`: number of unit coordinates.
    - `budget`: number of simulations in all; methods plan with `left`.
    - `batch`: points that are simulated together.
    - `constraint`: a function from points `u [n, d]` to whether each is accepted `[n]`; none when
      left out.
    - `deadline`: time on the clock of `time.perf_counter` after which `Ended` is raised.
    - `report`: called after each batch with simulations, failures and the least robustness so far.
    - `together`: number of batches that are simulated at a time, if there are several workers.
    - `one_by_one`: whether simulations run one after another. If they are slow, fewer are then
      requested at a time, so that an interrupt loses only these.
    - `workers`: how many of these simulations run side by side.
    - `gradient`: like `evaluate`, but also returns the gradient with respect to the cube; none when
      left out. A simulation with its gradient counts as 2.
    - `uniform`: True at coordinates `[dim]` of uniform features; all False when left out.
    - `rest`: share of the prior that is not proved; the constraint has to refuse proved points.
    - `draws`: whether the system uses its random key, so that a point fails with a probability.

    `evaluated` counts simulations, one with its gradient as 1: it is the number of the next random
    key.
    """

    def __init__(
        self,
        evaluate: Evaluate,
        dim: int,
        budget: int,
        batch: int = 256,
        constraint: Callable[[Float[np.ndarray, "n d"]], Bool[np.ndarray, " n"]] | None = None,
        deadline: float | None = None,
        report: Callable[[int, int, float], None] | None = None,
        together: int = 1,
        gradient: Differentiate | None = None,
        uniform: Bool[np.ndarray, " dim"] | None = None,
        draws: bool = False,
        one_by_one: bool = False,
        workers: int = 1,
        rest: "Rest | None" = None,
    ) -> None:
        self.max_step = self.step = batch * together
        self.one_by_one = one_by_one
        if one_by_one:
            self.step = min(FIRST, self.max_step)
        self.min_step = 1 if workers == 1 else min(BUSY * workers, self.max_step)
        self.step = max(self.step, self.min_step)
        self.evaluate, self.dim, self.budget, self.batch = evaluate, dim, budget, batch
        self.constraint, self.deadline, self.report = constraint, deadline, report
        self.gradient, self.draws, self.rest = gradient, draws, rest
        self.uniform = np.zeros(dim, bool) if uniform is None else uniform
        self.simulations = self.evaluated = self.failures = self.no_verdict = 0
        self.pilot: tuple[int, int, int] = (0, 0, 0)
        # Independent searches that were made, and those that found failures.
        self.searches: tuple[int, int] = (0, 0)
        """Simulations, failures and missing verdicts of the first samples of the prior."""
        self.own_chance = ""
        """A sentence on memory or chance that does not come from the random key; empty if none."""
        self.rows: list[tuple[np.ndarray, np.ndarray]] | None = None
        """Points and robustness of all simulations, where a method wants them; NaN for none."""
        self.seconds = 0.0
        """Seconds of one of the simulations that were asked for last."""
        self.lowest = np.inf
        self.ended: str | None = None
        self.strict = False
        """Whether simulations beyond the budget are refused; methods that plan need no refusal."""

    @property
    def left(self) -> int:
        """Number of simulations that may still be made."""
        return 0 if self.ended else self.budget - self.simulations

    def accepts(self, z: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
        """Check the constraint at points of normal space; nothing is simulated."""
        if self.constraint is None or not len(z):
            return np.ones(len(z), bool)
        size = _CONSTRAINT_BATCH
        parts = []
        for start in range(0, len(z), size):
            part = to_unit_cube(z[start : start + size])
            padded = np.pad(part, ((0, size - len(part)), (0, 0)), mode="edge")
            parts.append(np.asarray(self.constraint(padded))[: len(part)])
        return np.concatenate(parts)

    def sample_prior(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        """Draw `n` independent points of the prior, given that the constraint accepts them.

        **Raises:** `ValueError` if the constraint refuses almost every point.
        """
        if self.constraint is None:
            return rng.standard_normal((n, self.dim))
        accepted, count, drawn = [], 0, 0
        while count < n:
            z = self._drawn(rng, _CONSTRAINT_BATCH)
            z = z[self.accepts(z)][: n - count]
            accepted.append(z)
            count, drawn = count + len(z), drawn + _CONSTRAINT_BATCH
            if drawn > MAX_DRAWN and count < n * drawn / (100 * MAX_DRAWN):
                raise ValueError("where accepts too little of the space to sample it")
        return np.concatenate(accepted) if accepted else np.zeros((0, self.dim))

    def acceptance(self, rng: np.random.Generator, n: int = 200_000) -> tuple[float, float]:
        """Return the share of the prior that the constraint accepts, and its relative error."""
        if self.constraint is None:
            return 1.0, 0.0
        share = float(np.mean(self.accepts(self._drawn(rng, n))))
        error = float(np.sqrt((1 - share) / (share * n))) if share else np.inf
        return share * (1.0 if self.rest is None else self.rest.mass), error

    def _drawn(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        """Draw points of the prior, or of its rest, whatever the constraint says of them."""
        if self.rest is None:
            return rng.standard_normal((n, self.dim))
        return to_normal_space(self.rest.draw(rng, n))

    def __call__(self, z: Float[np.ndarray, "n d"]) -> Scores:
        """Simulate points of normal space.

        **Raises:** `Ended` where time is over or the user interrupts, `Spent` where a strict budget
        is; batches before it count.
        """
        if not len(z):
            return Scores(np.zeros(0), np.zeros(0, bool), np.zeros(0, bool))
        return Scores(*self._in_batches(self._score, z))

    def begin(self, z: Float[np.ndarray, "n d"]) -> "Begun":
        """Start simulating points, and return an object that waits for their scores.

        An executor starts at once; without one the simulation starts when its result is requested.
        """
        return Begun(self, z)

    def linearize(self, z: Float[np.ndarray, "n d"]) -> Linearized:
        """Simulate points of normal space, and differentiate their robustness.

        **Raises:** `Ended` as in a call; `ValueError` for a limit state without gradients.
        """
        if self.gradient is None:
            raise ValueError("this limit state has no gradient")
        if not len(z):
            return Linearized(np.zeros(0), np.zeros(0), np.zeros((0, self.dim)))
        return Linearized(*self._in_batches(self._linearize, z))

    def _in_batches(
        self, part_of: Callable[[np.ndarray], tuple[np.ndarray, ...]], z: Float[np.ndarray, "n d"]
    ) -> list[np.ndarray]:
        parts, start = [], 0
        while start < len(z):
            if self.ended or (self.deadline is not None and time.perf_counter() > self.deadline):
                self.ended = self.ended or "max_seconds"
                raise Ended
            began, stop = time.perf_counter(), start + self.step
            cost = 2 if part_of == self._linearize else 1
            if self.strict and cost * min(self.step, len(z) - start) > self.left:
                raise Spent
            try:
                parts.append(part_of(z[start:stop]))
            except KeyboardInterrupt:
                self.ended = "interrupted"
                raise Ended from None
            took = time.perf_counter() - began
            self.seconds = took / min(self.step, len(z) - start)
            start = stop
            if self.one_by_one:
                quick = took < SECONDS
                self.step = (
                    min(2 * self.step, self.max_step)
                    if quick
                    else max(self.min_step, self.step // 2)
                )
        return [np.concatenate(column) for column in zip(*parts, strict=True)]

    def _linearize(self, z: Float[np.ndarray, "n d"]) -> Linearized:
        assert self.gradient is not None
        rho, failing, proper, slopes = (np.asarray(p) for p in self.gradient(to_unit_cube(z)))
        self.simulations += len(z)
        scores = self._counted(z, rho, failing, proper)
        with np.errstate(invalid="ignore", over="ignore"):
            gradient = slopes * np.exp(-z * z / 2) / np.sqrt(2 * np.pi)
        usable = np.all(np.isfinite(gradient), axis=1, keepdims=True)
        return Linearized(
            scores.score, np.asarray(rho, np.float64), np.where(usable, gradient, 0.0)
        )

    def _score(self, z: Float[np.ndarray, "n d"]) -> Scores:
        rho, failing, proper = (np.asarray(part) for part in self.evaluate(to_unit_cube(z)))
        return self._counted(z, rho, failing, proper)

    def _counted(
        self, z: Float[np.ndarray, "n d"], rho: Shaped[np.ndarray, " n"],
        failing: Bool[np.ndarray, " n"], proper: Bool[np.ndarray, " n"],
    ) -> Scores:  # fmt: skip
        """Count these simulations, and return their scores."""
        known = proper & np.isfinite(rho)
        score = np.where(known, np.maximum(rho, 0.0), np.inf).astype(np.float64)
        score[failing] = -np.inf
        if self.rows is not None:
            self.rows.append((z, np.where(known, rho, np.nan)))
        self.simulations += len(z)
        self.evaluated += len(z)
        self.failures += int(failing.sum())
        self.no_verdict += int((~proper).sum())
        if known.any():
            self.lowest = min(self.lowest, float(rho[known].min()))
        if self.report is not None:
            self.report(self.simulations, self.failures, self.lowest)
        return Scores(score, failing, proper)


class Begun:
    """Simulations in progress; call each `result` once, in the order in which they were started.

    **Arguments:**
    - `limit_state`: the limit state, which counts them when their result is fetched.
    - `z`: their points.
    """

    def __init__(self, limit_state: LimitState, z: Float[np.ndarray, "n d"]) -> None:
        self.z, self._limit_state = z, limit_state
        begin = getattr(limit_state.evaluate, "begin", None)
        together = begin is not None and 0 < len(z) <= limit_state.step
        self._waits: Any = begin(to_unit_cube(z)) if together and begin is not None else None

    def result(self) -> Scores:
        """Wait for the scores and return them.

        **Raises:** the errors of a call of the limit state.
        """
        if self._waits is None:
            return self._limit_state(self.z)
        return Scores(*self._limit_state._in_batches(self._score, self.z))

    def _score(self, z: Float[np.ndarray, "n d"]) -> Scores:
        verdicts = self._waits.result()
        return self._limit_state._counted(z, verdicts.lowest, verdicts.violated, verdicts.proper)

    def cancel(self) -> None:
        """Remove simulations that have not started from the workers' queue."""
        if self._waits is not None:
            self._waits.cancel()


def to_unit_cube(z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Map points of normal space to the unit cube, in double precision.

    Single precision cannot represent probabilities near one.
    """
    from scipy.special import ndtr

    return ndtr(z)


def to_normal_space(u: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Map probabilities to standard normal numbers, which stay finite for 0 and 1."""
    from scipy.special import ndtri

    return ndtri(np.clip(u, 1e-300, 1 - 1e-16))


def scores_of(limit_state: LimitState, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Return the scores of points; infinity for a point that the constraint refuses."""
    fits: Bool[np.ndarray, " n"] = limit_state.accepts(z)
    score = np.full(len(z), np.inf)
    if fits.any():
        score[fits] = limit_state(z[fits]).score
    return score


def fails_at(limit_state: LimitState, z: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
    """Simulate points, and return which fail; points that the constraint refuses do not."""
    return scores_of(limit_state, z) == -np.inf


def squared_distances(
    z: Float[np.ndarray, "n d"], points: Float[np.ndarray, "m d"]
) -> Float[np.ndarray, "n m"]:
    """Return the squared distances of each point `z` to the other points."""
    return np.sum(points**2, axis=1)[None] - 2 * z @ points.T + np.sum(z * z, axis=1)[:, None]


def farthest_first(
    first: int, gaps_from: Callable[[int], Float[np.ndarray, " n"]], maximum: int,
    min_gap: float = -1.0,
) -> Int[np.ndarray, " chosen"]:  # fmt: skip
    """Choose points that are far from one another.

    **Arguments:**
    - `first`: the point that is chosen first.
    - `gaps_from`: the distances `[n]` of all points from one.
    - `maximum`: maximum number of points.
    - `min_gap`: points closer than this to a chosen one are not chosen.
    """
    chosen, gaps = [first], gaps_from(first)
    while len(chosen) < min(maximum, len(gaps)) and gaps.max() > min_gap:
        chosen.append(int(gaps.argmax()))
        gaps = np.minimum(gaps, gaps_from(chosen[-1]))
    return np.array(chosen)

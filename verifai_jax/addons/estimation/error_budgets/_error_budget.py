"""The error of a probability: by its samples, step, precision, solver, seeds and prior.

    budget = vj.error_budget(problem, vj.estimate(problem), pairs=20_000)
    budget = vj.error_budget(candidate, comparison["candidate"], baseline=problem)

A part is measured on pairs with the same features and random numbers, simulated once unchanged and
once with the change, so that common errors cancel. Its interval is that of the difference in
probability. For very rare failures two estimates are compared instead.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.addons.estimation import estimate
from verifai_jax.addons.estimation.certification.result import Certificate
from verifai_jax.addons.estimation.comparison.result import Compared
from verifai_jax.addons.estimation.divergence import radius_of_mean, worst_mean
from verifai_jax.addons.estimation.error_budgets.result import (
    DIFFERENCE,
    PROBABILITY,
    ErrorBudget,
    ErrorPart,
    PriorError,
)
from verifai_jax.addons.estimation.paired_rates import PairedRates, paired_rates
from verifai_jax.addons.estimation.result import Estimate
from verifai_jax.core.messages.checks import check_count, check_fraction
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.messages.text import format_percent
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.problem.dependence import depends_on_key
from verifai_jax.problem.problem import Problem
from verifai_jax.statistics.binomial import Rate, clopper_pearson

BATCH = 512
"""Simulations at once."""
RARE = 30
"""Failures expected among the pairs below which two estimates are compared instead."""
RADII = (0.01, 0.1, 1.0)
"""Divergences in nats for which the worst probability is shown."""
FINEST = 4
"""The step is divided by that; an error of first order or better shrinks by as much at least."""
Judged = tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]
"""Which samples fail, and which have a verdict."""
Number = Estimate | Rate | Certificate | Compared
"""Results with a probability, or a difference of two."""


@suggests_options
def error_budget(
    problem: Problem,
    result: Number,
    *,
    baseline: Problem | None = None,
    pairs: int = 10_000,
    solvers: Mapping[str, Problem] | None = None,
    seeds: int = 0,
    limit: float | None = None,
    seed: int = 1,
    confidence: float = 0.95,
) -> ErrorBudget:
    """Bound the parts of the error of a probability, and the admissible error of the prior.

    **Arguments:**
    - `problem`: the simulated problem; for a comparison that of the candidate, for a certificate
      that of the policy.
    - `result`: an estimate, a rate (`run.failure_rate`), a certificate, or a candidate of a
      comparison, `comparison["NAME"]`.
    - `baseline`: the baseline of a comparison.
    - `pairs`: number of samples of the prior that are simulated unchanged, at a half and a quarter
      of the step, in the other precision, and by each solver.
    - `solvers`: the same problem with other algorithms, by name, for example with another
      integrator; other backends of the system are added automatically.
    - `seeds`: number of further estimates with other seeds, each with the budget of the estimate.
    - `limit`: the claimed upper limit of the number; by default `p0` of the estimate, or twice the
      upper end (0 for a difference).
    - `seed`: the seed of the pairs, which are different samples than those of the result.
    - `confidence`: the probability that all intervals hold together.
    **Returns:** the `ErrorBudget`.
    **Raises:** `TypeError` for another result; `ValueError` for options out of range, a comparison
    without its baseline, and solvers with other features or formulas.
    """
    check_count("pairs", pairs)
    check_count("seeds", seeds, 0)
    check_fraction("confidence", confidence)
    number = _number(result, baseline)
    for name, other in (solvers or {}).items():
        if other.space.columns != problem.space.columns or [*other.formulas] != [*problem.formulas]:
            raise ValueError(
                f"solver {name!r} must be the same problem with another algorithm; it has other "
                "features or formulas"
            )
    precision = getattr(result, "precision", "float32")
    others = {**(solvers or {}), **_other_backends(problem, getattr(result, "backend", None))}
    each = 1 - (1 - confidence) / (3 + len(others))
    sides = [problem] if baseline is None else [problem, baseline]
    work = _Work(sides, pairs, seed, precision, each, number, result)
    parts = [
        _sampling(result, number, each),
        work.step(),
        work.precision_part(),
        *(work.solver(name, other) for name, other in others.items()),
    ]
    if not others:
        text = (
            "No second algorithm was given: solvers={'name': problem} takes the same problem with "
            "another integrator, engine or tolerance."
        )
        parts.append(ErrorPart("solver", math.nan, math.nan, text))
    parts += [work.seeds(seeds)] if seeds else []
    parts.append(work.randomness())
    what = PROBABILITY if baseline is None else DIFFERENCE
    found = ErrorBudget(
        problem.name, what, number.value, tuple(parts), confidence,
        PriorError(0.0, 0.0, 0.0, ()), 0,
    )  # fmt: skip
    if limit is None:
        limit = getattr(result, "p0", None)
    if limit is None:
        limit = 0.0 if baseline is not None else min(1.0, 2 * found.high)
    prior = _prior(found, result, limit)
    return replace(found, prior=prior, simulations=work.simulations)


@dataclass(frozen=True)
class _Number:
    """A number with its interval; `difference` of two probabilities or one of them."""

    value: float
    low: float
    high: float
    difference: bool


def _number(result: Number, baseline: Problem | None) -> _Number:
    rate = result.rate if isinstance(result, Certificate) else result
    if isinstance(rate, Compared):
        if baseline is None:
            raise ValueError("the error of a comparison needs its baseline: baseline=problem")
        return _Number(rate.rates.estimate, rate.rates.low, rate.rates.high, True)
    if baseline is not None:
        raise ValueError("a baseline goes with a candidate of a comparison, comparison['NAME']")
    if isinstance(rate, Estimate):
        value = math.nan if rate.probability is None else rate.probability
        return _Number(value, rate.low, rate.high, False)
    if isinstance(rate, Rate):
        return _Number(rate.estimate, rate.low, rate.high, False)
    raise TypeError(
        "an error budget needs an estimate, a rate, a certificate with a sample, or a candidate "
        f"of a comparison; got {type(rate).__name__}"
    )


def _sampling(result: Number, number: _Number, each: float) -> ErrorPart:
    """Return the interval of the result at the confidence of one part, if its own is less."""
    rate = result.rate if isinstance(result, Certificate) else result
    own = rate.rates.confidence if isinstance(rate, Compared) else getattr(rate, "confidence", each)
    base = 0.0 if math.isnan(number.value) else number.value
    low, high = number.low - base, number.high - base
    if own < each:
        from scipy.special import ndtri

        # As wide as a normal interval would become.
        factor = float(ndtri((1 + each) / 2) / ndtri((1 + own) / 2))
        low, high = factor * low, factor * high
    text = (
        f"The interval of the result, {number.low:z.3g} to {number.high:z.3g} at "
        f"{format_percent(own)}{f', widened to {format_percent(each)}' if own < each else ''}."
    )
    return ErrorPart("sampling", low, high, text)


class _Work:
    """The simulations of a budget, each variant on the same points under the same random keys."""

    def __init__(
        self, sides: list[Problem], pairs: int, seed: int, precision: str, each: float,
        number: _Number, result: Number,
    ) -> None:  # fmt: skip
        self.sides, self.pairs, self.seed, self.precision = sides, pairs, seed, precision
        self.each, self.number, self.result, self.simulations = each, number, result, 0
        self.points = _prior_points(sides[0], pairs, seed)
        self.rare = isinstance(result, Estimate) and number.value * pairs < RARE
        self.own = self._as(lambda side: side)

    def _judge(self, problem: Problem, precision: str, seed: int) -> Judged:
        """Return which samples fail, and which have a verdict."""
        evaluate = Evaluator(problem, min(BATCH, self.pairs), precision=precision, seed=seed)
        verdicts = evaluate(self.points)
        self.simulations += self.pairs
        return verdicts.violated, verdicts.proper

    def _as(self, change: Callable[[Problem], Problem], precision: str = "") -> list[Judged]:
        """Simulate the pairs otherwise."""
        precision = precision or self.precision
        return [self._judge(change(side), precision, self.seed) for side in self.sides]

    def _between(self, before: Sequence[Judged], after: Sequence[Judged]) -> PairedRates:
        """Return by how much the number differs; of two problems, that of one less the other's."""
        confidence = 1 - (1 - self.each) / len(self.sides)
        found = []
        for (was, had), (now, has) in zip(before, after, strict=True):
            proper = had & has
            lost = int(np.sum(~proper))
            found.append(
                paired_rates(
                    int(np.sum(was & ~now & proper)), int(np.sum(now & ~was & proper)),
                    self.pairs, confidence, lost, at_any_time=False,
                )
            )  # fmt: skip
        one, *others = found
        for two in others:
            one = replace(
                one,
                only_first=one.only_first + two.only_second,
                only_second=one.only_second + two.only_first,
                low=one.low - two.high,
                high=one.high - two.low,
                undecided=one.undecided + two.undecided,
            )
        return one

    def step(self) -> ErrorPart:
        """Return the part of the step, extrapolated to a step of nothing."""
        nothing = math.nan, math.nan
        system = self.sides[0].system
        if system.exact_step:
            text = "The step belongs to the system as its authors defined it, so it is no error."
            return ErrorPart("step", 0.0, 0.0, text)
        if not all(side.system.can_refine for side in self.sides):
            return ErrorPart("step", *nothing, "The system has no finer step to compare with.")
        if self.rare:
            return self._rare_step()
        half = self._as(partial(_refined, factor=FINEST // 2))
        quarter = self._as(partial(_refined, factor=FINEST))
        first, last = self._between(self.own, half), self._between(half, quarter)
        found = self._between(self.own, quarter)
        # An error of first order or better halves at least, so that all further halvings together
        # change no more than the last one did, and in its direction.
        less, more = min(0.0, last.low), max(0.0, last.high)
        text = (
            f"At half the step {_turned(first)}; from there to a quarter of it {_turned(last)}. "
            f"All smaller steps together add {less:z.2g} to {more:z.2g}, if the error halves with "
            "the step or shrinks faster."
        )
        noise = 2 * math.sqrt(last.only_first + last.only_second)
        if abs(_balance(last)) > abs(_balance(first)) + noise:
            text += " It does not: the second halving has changed more than the first."
        return ErrorPart("step", found.low + less, found.high + more, text)

    def _rare_step(self) -> ErrorPart:
        """Compare with an estimate at a quarter of the step, of failures too rare for pairs."""
        assert isinstance(self.result, Estimate)
        finer = _refined(self.sides[0], FINEST)
        found = self._estimate(finer, self.result.seed)
        # Both intervals are of one size, so that a normal one of the difference has its root.
        low, high = _combined(self.number, found)
        if found.probability is not None:
            beyond = abs(found.probability - self.number.value) / (FINEST - 1)
            low, high = low - beyond, high + beyond
        text = (
            f"Failures are too rare for {self.pairs:,} pairs: a second estimate, at a quarter of "
            f"the step, gives {found.low:z.3g} to {found.high:z.3g}."
        )
        return ErrorPart("step", low, high, text)

    def _estimate(self, problem: Problem, seed: int) -> Estimate:
        assert isinstance(self.result, Estimate)
        found = estimate(
            problem, self.result.method, self.result.budget, seed=seed, confidence=self.each,
            precision=self.result.precision, progress=False,
        )  # fmt: skip
        self.simulations += found.simulations
        return found

    def precision_part(self) -> ErrorPart:
        """Return the part of the precision."""
        other = "float32" if self.precision == "float64" else "float64"
        if self.sides[0].black_box:
            text = "The system computes in its own precision, which cannot be changed here."
            return ErrorPart("precision", math.nan, math.nan, text)
        if any(depends_on_key(side) for side in self.sides):
            text = f"In {other} the system draws other random numbers, so no pair is the same."
            return ErrorPart("precision", math.nan, math.nan, text)
        found = self._between(self.own, self._as(lambda side: side, other))
        counted = self.precision == "float32" and not self.rare
        why = "" if counted else (
            " It is not in the sum: failures are too rare for these pairs to say more."
            if self.rare else " It is not in the sum: the number is of the finer precision."
        )  # fmt: skip
        text = f"In {other} instead of {self.precision} {_turned(found)}.{why}"
        return ErrorPart("precision", found.low, found.high, text, counted)

    def solver(self, name: str, other: Problem) -> ErrorPart:
        """Return how far another algorithm is from the one that was used."""
        if len(self.sides) > 1:
            text = "Solvers are compared for one problem at a time, not for a difference of two."
            return ErrorPart(name, math.nan, math.nan, text)
        if self.rare:
            found = self._estimate(other, getattr(self.result, "seed", 0))
            low, high = _combined(self.number, found)
            text = f"A second estimate by {name} gives {found.low:z.3g} to {found.high:z.3g}."
            return ErrorPart(name, low, high, text, False)
        found = self._between(self.own, self._as(lambda side: other))
        # Which of two algorithms is right, a difference does not say: it is shown, and not added.
        text = (
            f"By {name} {_turned(found)}. It is not in the sum: of two algorithms either may be "
            "the better one."
        )
        return ErrorPart(name, found.low, found.high, text, False)

    def seeds(self, count: int) -> ErrorPart:
        """Return how far estimates with other seeds lie apart."""
        if not isinstance(self.result, Estimate):
            text = "Other seeds are only tried for an estimate."
            return ErrorPart("seeds", math.nan, math.nan, text)
        found = [self._estimate(self.sides[0], self.result.seed + 1 + i) for i in range(count)]
        values = [each.probability for each in found if each.probability is not None]
        if not values or math.isnan(self.number.value):
            text = "No estimate resulted from the other seeds, or from the first one."
            return ErrorPart("seeds", math.nan, math.nan, text)
        apart = [value - self.number.value for value in values]
        meet = sum(f.low <= self.number.high and f.high >= self.number.low for f in found)
        text = (
            f"{meet} of {count} intervals of other seeds meet that of the result. It is not in the "
            "sum: the sampling is."
        )
        return ErrorPart("seeds", min(apart), max(apart), text, False)

    def randomness(self) -> ErrorPart:
        """Return the contribution of the model's own random numbers."""
        if not depends_on_key(self.sides[0]):
            return ErrorPart("randomness", 0.0, 0.0, "The model draws no random numbers.", False)
        own, again = self.own[0], self._judge(self.sides[0], self.precision, self.seed + 1)
        proper = own[1] & again[1]
        turned = own[0][proper] != again[0][proper]
        rate = float(np.mean(own[0][proper])) if proper.any() else math.nan
        spread = rate * (1 - rate)
        share = float(np.mean(turned)) / 2 / spread if spread else math.nan
        said = f"{format_percent(min(share, 1.0))} of the variance" if spread else "an unknown part"
        interval = clopper_pearson(int(turned.sum()), max(len(turned), 1), self.each)
        text = (
            f"With the same features and other random numbers {format_percent(np.mean(turned))} of "
            f"the verdicts change ({format_percent(interval.low)} to "
            f"{format_percent(interval.high)}), {said}. The sampling error includes it."
        )
        return ErrorPart("randomness", 0.0, 0.0, text, False)


def _prior_points(problem: Problem, count: int, seed: int) -> Float[np.ndarray, "n d"]:
    """Draw points of the prior that the constraint accepts."""
    space, rng = problem.space, np.random.default_rng((seed, 51))
    space.check_where()
    points = np.zeros((0, space.dim), np.float32)
    while len(points) < count:
        more = rng.random((max(count, 64), space.dim), np.float32)
        if space.where is not None:
            more = more[np.asarray(space.accepts_points(more))]
        points = np.concatenate([points, more])
    return points[:count]


def _refined(problem: Problem, factor: int) -> Problem:
    return replace(problem, system=problem.system.refined(factor))


def _other_backends(problem: Problem, used: str | None) -> dict[str, Problem]:
    """Return the problem on the backends that the result was not made on."""
    others = [name for name in problem.system.backends if name != used] if used else []
    return {name: problem.on_backend(name) for name in others if not problem.system.why_not(name)}


def _balance(rates: PairedRates) -> int:
    return rates.only_second - rates.only_first


def _turned(rates: PairedRates) -> str:
    """Write how many verdicts turn."""
    without = f", and {rates.undecided:,} have no verdict" if rates.undecided else ""
    return (
        f"{rates.only_second:,} of {rates.pairs:,} pairs fail that did not, "
        f"{rates.only_first:,} no longer fail{without}"
    )


def _combined(number: _Number, found: Estimate) -> tuple[float, float]:
    """Return an interval of the difference of two independent estimates."""
    value = 0.0 if found.probability is None else found.probability
    base = 0.0 if math.isnan(number.value) else number.value
    down = math.hypot(value - found.low, number.high - base)
    up = math.hypot(found.high - value, base - number.low)
    return value - base - down, value - base + up


def _prior(found: ErrorBudget, result: Number, limit: float) -> PriorError:
    """Return how far the prior may be wrong for the number to stay below a limit."""
    bound = found.high
    if not isinstance(result, Compared):
        values, weights = (0.0, 1.0), (1 - bound, bound)
    else:
        pairs = result.rates.pairs
        better = result.rates.only_first / pairs
        # The difference is taken at its upper end, by more pairs in which the candidate fails.
        worse = min(max(bound + better, 0.0), 1 - better)
        values, weights = (-1.0, 0.0, 1.0), (better, 1 - better - worse, worse)
    worst = tuple((radius, worst_mean(values, weights, radius)) for radius in RADII)
    return PriorError(limit, bound, radius_of_mean(values, weights, limit), worst)

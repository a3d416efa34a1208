"""Simulations for a failure table: samples of faults, searches, and the weakest failures."""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.addons.estimation import estimate
from verifai_jax.addons.faults.failure_table.result import Effect
from verifai_jax.addons.faults.fault import Fault
from verifai_jax.core.messages.errors import end_if_interrupted
from verifai_jax.core.store.cache import Cache
from verifai_jax.counterexamples.nominal import Nominal
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.falsification import falsify
from verifai_jax.problem.dependence import depends_on_key
from verifai_jax.problem.problem import Problem
from verifai_jax.statistics.binomial import clopper_pearson

if TYPE_CHECKING:
    from verifai_jax.core.compute.executors import Executor
LEVELS = 33
"""Severities simulated at once; a second grid within one interval of the first resolves 1/1000."""
FOLLOWED = 6
"""Number of failing samples of a fault whose severity is lowered."""
FEW = 10
"""With fewer failing samples a search looks for more, and another estimator is used."""
TRIED = 32
"""Failing samples simulated again with the lowered ones, whose verdicts are less stable."""
Points = Float[np.ndarray, "n d"]


@dataclass(eq=False)
class Rows:
    """Simulations of one problem with all faults; repeated points are simulated only once."""

    problem: Problem
    faults: Mapping[str, Fault]
    cache: Cache
    seed: int
    executor: "Executor | None"

    def __post_init__(self) -> None:
        self.rng, self.nominal = np.random.default_rng(self.seed), Nominal.of(self.problem)
        self.groups: dict[str, Int[np.ndarray, " k"]] = dict(self.nominal.groups)
        self.draws = depends_on_key(self.problem)
        self._evaluate = Evaluator(self.problem, 512, seed=self.seed, executor=self.executor)
        self._count = 0

    def coordinate(self, fault: str, number: str) -> int:
        """Return the index of the coordinate of one number of a fault."""
        return int(self.groups[fault][list(self.faults[fault].domains).index(number)])

    def __call__(self, what: str, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """Simulate points; return flags of the violations, and of the rows with a verdict."""
        points = self.nominal.settle(points)
        first, self._count = self._count, self._count + len(points)

        def simulated() -> dict[str, np.ndarray]:
            verdicts = self._evaluate(points, first=first)
            return {"violated": verdicts.violated, "proper": verdicts.proper}

        known = self.cache.remember(f"{what}/{zlib.crc32(points.tobytes())}", simulated)
        return known["violated"], known["proper"]

    def try_out(self, names: tuple[str, ...], samples: int, budget: int) -> tuple[Effect, Points]:
        """Sample a fault or a pair, search for more failures if few, and lower their severity.

        **Returns:** the effect without the parts of its counterexample, and failing points, the
        least severe first.
        """
        points = np.repeat(self.nominal.u[None], samples, axis=0)
        for name in names:
            points[:, self.groups[name]] = self.rng.random((samples, len(self.groups[name])))
        violated, proper = self(f"samples/{'+'.join(names)}", points)
        failing = points[violated]
        if len(failing) < FEW and budget:
            # A few failures by chance may all be refuted; the worst of a search seldom are.
            failing = np.concatenate([failing, self._searched(names, budget)])
        if len(failing):
            failing = self._lowered(names, failing)
        failures, undecided = int(violated.sum()), int((~proper).sum())
        return Effect(names, len(failing) > 0, failures, samples, undecided), failing

    def probability(self, effect: Effect, confidence: float, budget: int) -> Float[np.ndarray, "3"]:
        """Return the interval and the probability of a failure, given that the faults happen."""
        rate = clopper_pearson(effect.failures, effect.simulations, confidence, effect.undecided)
        enough = not effect.fails or effect.failures >= FEW
        if enough or not budget or len(effect.faults) > 1:
            return np.array([rate.low, rate.high, rate.estimate])

        def estimated() -> dict[str, np.ndarray]:
            seen = estimate(
                self.problem.only(*effect.faults), budget=2 * budget, confidence=confidence,
                seed=self.seed, progress=False, executor=self.executor,
            )  # fmt: skip
            end_if_interrupted(seen.stopped)
            chance = rate.estimate if seen.probability is None else seen.probability
            return {"interval": np.array([seen.low, seen.high, chance])}

        return self.cache.remember(f"estimate/{effect.name}/{confidence}", estimated)["interval"]

    def _searched(self, names: Sequence[str], budget: int) -> Points:
        """Return the worst failing points that a search finds."""

        def searched() -> dict[str, np.ndarray]:
            run = falsify(
                self.problem.only(*names), "cross_entropy", budget, seed=self.seed, confirm=False,
                progress=False, executor=self.executor,
            )  # fmt: skip
            end_if_interrupted(run.stopped)
            worst = run.table.counterexamples.sort_values("rho").head(FOLLOWED)
            points = self.problem.space.points(worst) if len(worst) else self.nominal.u[None][:0]
            return {"points": np.asarray(points, np.float32)}

        return self.cache.remember(f"search/{'+'.join(names)}", searched)["points"]

    def _lowered(self, names: Sequence[str], failing: Points) -> Points:
        """Return failing points with their severity lowered as far as they fail, lowest first."""
        home, faults = self.nominal.u, self.faults
        index = np.array([self.coordinate(name, faults[name].grade) for name in names])

        def ordered(points: Points) -> Points:
            away = np.abs(points[:, index] - home[index]).sum(axis=1)
            return points[np.argsort(away, kind="stable")]

        failing = ordered(failing)
        longest = failing[:FOLLOWED].copy()
        for name in names:
            if "duration" in faults[name].domains and faults[name].grade != "duration":
                # With the longest duration they may fail at less.
                longest[:, self.coordinate(name, "duration")] = 1.0
        starts = np.unique(np.concatenate([failing[:FOLLOWED], longest]), axis=0)
        away = (starts[:, index] - home[index])[:, None]
        low, high = np.zeros(len(starts)), np.ones(len(starts))
        fails = np.zeros(len(starts), bool)
        for turn in range(2):
            shares = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, LEVELS)
            points = np.repeat(starts[:, None], LEVELS, axis=1)
            points[:, :, index] = home[index] + shares[:, :, None] * away
            label = f"severity/{'+'.join(names)}/{turn}"
            violated = self(label, points.reshape(-1, len(home)))[0].reshape(-1, LEVELS)
            fails, first = np.any(violated, axis=1), np.argmax(violated, axis=1)
            each = np.arange(len(starts))
            high = np.where(fails, shares[each, first], high)
            low = np.where(fails, shares[each, np.maximum(first - 1, 0)], low)
        starts[:, index] = home[index] + high[:, None] * away[:, 0]
        # Where chance decides, a few failing points are tried many times.
        others = any(fault.draws for fault in faults.values())
        draws = self.draws and (not others or any(faults[name].draws for name in names))
        tried = np.resize(failing, (8 * TRIED, len(home))) if draws else failing[:TRIED]
        return np.concatenate([ordered(starts[fails]), tried])

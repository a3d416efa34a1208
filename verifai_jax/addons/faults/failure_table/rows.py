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
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.falsification import falsify
from verifai_jax.problem.dependence import depends_on_key
from verifai_jax.problem.problem import Problem
from verifai_jax.statistics.binomial import clopper_pearson

if TYPE_CHECKING:
    pass
LEVELS, TURNS = 33, 3
"""Severities simulated at once, and how often a grid lies within one interval of the last."""
RESOLVED = 1 / 2000
"""Share of the range of a severity by which a search looks below the lowest one that fails."""
ABOVE = np.array([0.0, 0.25, 0.5, 1.0])
"""Distances above the lowest severity, in these shares, at which its point is tried as well."""
ROUND, PATIENCE = 128, 4
"""Simulations of a round below the lowest severity, and rounds without a failure that end it."""
FOLLOWED = 6
"""Number of failing samples of a fault whose severity is lowered."""
FEW = 10
"""With fewer failing samples a search looks for more, and another estimator is used."""
TRIED = 32
"""Failing samples simulated again with the lowered ones, whose verdicts are less stable."""
Points = Float[np.ndarray, "n d"]
Index = Int[np.ndarray, " k"]


@dataclass(eq=False)
class Rows:
    """Simulations of one problem with all faults; repeated points are simulated only once."""

    problem: Problem
    faults: Mapping[str, Fault]
    cache: Cache
    seed: int
    run_on: RunOn

    def __post_init__(self) -> None:
        self.rng, self.nominal = np.random.default_rng(self.seed), Nominal.of(self.problem)
        self.groups: dict[str, Int[np.ndarray, " k"]] = dict(self.nominal.groups)
        self.draws = depends_on_key(self.problem)
        self._evaluate = Evaluator(self.problem, 512, seed=self.seed, executor=self.run_on.executor)
        self._count = 0

    def __call__(self, what: str, points: Points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulate points; return which violate, which have a verdict, and their robustness."""
        points = self.nominal.settle(points)
        first, self._count = self._count, self._count + len(points)

        def simulated() -> dict[str, np.ndarray]:
            verdicts = self._evaluate(points, first=first)
            rho = verdicts.rho.min(axis=1)
            return {"violated": verdicts.violated, "proper": verdicts.proper, "rho": rho}

        known = self.cache.remember(f"{what}/{zlib.crc32(points.tobytes())}", simulated)
        return known["violated"], known["proper"], known["rho"]

    def try_out(self, names: tuple[str, ...], samples: int, budget: int) -> tuple[Effect, Points]:
        """Sample a fault or a pair, search for more failures if few, and lower their severity.

        **Returns:** the effect without the parts of its counterexample, and failing points, the
        least severe first.
        """
        points = np.repeat(self.nominal.u[None], samples, axis=0)
        for name in names:
            points[:, self.groups[name]] = self.rng.random((samples, len(self.groups[name])))
        violated, proper, _ = self(f"samples/{'+'.join(names)}", points)
        failing = points[violated]
        if len(failing) < FEW and budget and len(names) == 1:
            # A few failures by chance may all be refuted; the worst of a search seldom are.
            failing = np.concatenate([failing, self._searched(names, budget)])
        failing, edge = self._lowered(names, failing, budget) if len(failing) else (failing, False)
        failures, undecided = int(violated.sum()), int((~proper).sum())
        return Effect(names, len(failing) > 0, failures, samples, undecided, edge=edge), failing

    def probability(self, effect: Effect, confidence: float, budget: int) -> Float[np.ndarray, "3"]:
        """Return the interval and the probability of a failure, given that the faults happen."""
        rate = clopper_pearson(effect.failures, effect.simulations, confidence, effect.undecided)
        enough = not effect.fails or effect.failures >= FEW
        if enough or not budget or len(effect.faults) > 1:
            return np.array([rate.low, rate.high, rate.estimate])

        def estimated() -> dict[str, np.ndarray]:
            seen = estimate(
                self.problem.only(*effect.faults), budget=2 * budget, confidence=confidence,
                seed=self.seed, progress=False, run_on=self.run_on,
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
                progress=False, run_on=self.run_on,
            )  # fmt: skip
            end_if_interrupted(run.stopped)
            worst = run.table.counterexamples.sort_values("rho").head(FOLLOWED)
            points = self.problem.space.points(worst) if len(worst) else self.nominal.u[None][:0]
            return {"points": np.asarray(points, np.float32)}

        return self.cache.remember(f"search/{'+'.join(names)}", searched)["points"]

    def _lowered(self, names: Sequence[str], failing: Points, budget: int) -> tuple[Points, bool]:
        """Return failing points, the least severe first, and whether a search below found none."""
        own = {name: self.faults[name] for name in names}
        index = np.array(
            [self.groups[name][list(one.domains).index(one.grade)] for name, one in own.items()]
        )
        # Where chance decides, no severity is an edge: a few failing points are tried many times.
        others = any(fault.draws for fault in self.faults.values())
        draws = self.draws and (not others or any(fault.draws for fault in own.values()))

        failing = self._ordered(failing, index)
        lowest = self._ordered(self._on_lines(names, index, failing[:FOLLOWED]), index)
        edge = False
        if len(lowest) and not draws:
            lowest, edge = self._below(names, index, lowest, budget)
        # Closer replays may refute the very edge, and are given some points just above it.
        above = np.repeat(lowest[:1], len(ABOVE) if len(lowest) else 0, axis=0)
        above = self._moved(above, index, self._away(above, index) + RESOLVED * ABOVE[: len(above)])
        size = len(self.nominal.u)
        tried = np.resize(failing, (8 * TRIED, size)) if draws else failing[:TRIED]
        return np.concatenate([above, lowest[1:FOLLOWED], tried]), edge

    def _away(self, points: Points, index: Index) -> Float[np.ndarray, " n"]:
        """Return how severe faults are, in shares of the ranges of their severities."""
        return np.abs(points[:, index] - self.nominal.u[index]).sum(axis=1)

    def _ordered(self, points: Points, index: Index) -> Points:
        return points[np.argsort(self._away(points, index), kind="stable")]

    def _moved(self, points: Points, index: Index, away: Float[np.ndarray, " n"] | float) -> Points:
        """Return points whose faults are as severe as this, in the same shares as before."""
        home, moved = self.nominal.u[index], points.copy()
        share = np.asarray(away / np.maximum(self._away(points, index), 1e-9))[:, None]
        moved[:, index] = np.clip(home + (points[:, index] - home) * share, 0, 1)
        return moved

    def _on_lines(self, names: Sequence[str], index: Index, starts: Points) -> Points:
        """Return those of some points that fail, each with the lowest severity found to fail."""
        home = self.nominal.u
        away = (starts[:, index] - home[index])[:, None]
        low, high = np.zeros(len(starts)), np.ones(len(starts))
        fails = np.ones(len(starts), bool)
        for _ in range(TURNS):
            shares = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, LEVELS)
            points = np.repeat(starts[:, None], LEVELS, axis=1)
            points[:, :, index] = home[index] + shares[:, :, None] * away
            label = f"severity/{'+'.join(names)}"
            violated = self(label, points.reshape(-1, len(home)))[0].reshape(-1, LEVELS)
            fails, first = np.any(violated, axis=1), np.argmax(violated, axis=1)
            each = np.arange(len(starts))
            high = np.where(fails, shares[each, first], high)
            low = np.where(fails, shares[each, np.maximum(first - 1, 0)], low)
        lowered = starts.copy()
        lowered[:, index] = home[index] + high[:, None] * away[:, 0]
        return lowered[fails]

    def _below(
        self, names: Sequence[str], index: Index, lowest: Points, budget: int
    ) -> tuple[Points, bool]:
        """Search below the lowest severity; return failures, and whether the last had none."""
        misses = 0
        own = np.concatenate([self.groups[name] for name in names])
        good = lowest[:FOLLOWED]
        for _ in range(budget // ROUND):
            level = self._away(lowest[:1], index)[0] - RESOLVED
            if misses == PATIENCE or level <= 0:
                return lowest, True
            # Near the points that come closest to failing, at all distances, and anywhere.
            points = good[self.rng.integers(len(good), size=ROUND)].copy()
            reach = 10.0 ** self.rng.uniform(-3.5, 0, (ROUND, 1))
            points[:, own] += reach * self.rng.normal(size=(ROUND, len(own)))
            points[: ROUND // 4, own] = self.rng.random((ROUND // 4, len(own)))
            points[:, own] = np.clip(points[:, own], 0, 1)
            points = self._moved(points, index, level)
            violated, _, rho = self(f"below/{'+'.join(names)}", points)
            order = np.argsort(rho)
            good, misses = points[order[:FOLLOWED]], misses + 1
            if violated.any():
                found = self._on_lines(names, index, points[order[violated[order]]][:FOLLOWED])
                lowest, misses = self._ordered(np.concatenate([found, lowest]), index), 0
        return lowest, False

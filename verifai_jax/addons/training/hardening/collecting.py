"""Failures of a stage's policy, as points for the next training to concentrate on.

Failures of the certificate and of its attack, earlier points and samples of the prior are simulated
together. This table yields rules, and some of its failures are shrunk. Failing samples come first,
because they represent typical failures. The attack finds the worst failures, which no policy may be
able to avoid.
"""

from typing import NamedTuple

import jax
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from verifai_jax.addons.analysis import rules
from verifai_jax.addons.training.hardening.mixture import NARROW, RADIUS, neighbourhoods
from verifai_jax.core.messages.errors import end_if_interrupted
from verifai_jax.counterexamples import shrink
from verifai_jax.falsification import falsify
from verifai_jax.problem.problem import Problem
from verifai_jax.search import PointList

SHRINKING = 300
"""Simulations to shrink a counterexample: a close failure suffices, not the closest."""
AROUND, THIN = 8, 0.25
"""Samples around each point, and the failing share below which its neighbourhood is narrow."""
PRIOR = 4096
"""Samples drawn from the prior to find some that satisfy the rules."""


class Collected(NamedTuple):
    """Points of the unit cube to train around: new `points` `[n, d]`, the `radii` of their
    neighbourhoods, and their `sources` (`"sample"`, `"counterexample"`, `"shrunk"` or `"rule"`);
    which of the earlier points to keep, all that still fail and an equal number of others; the
    number of simulations.
    """

    points: Float[np.ndarray, "n d"]
    radii: Float[np.ndarray, " n"]
    sources: np.ndarray
    kept: Bool[np.ndarray, " m"]
    simulations: int


def collect(
    problem: Problem, failing: pd.DataFrame, earlier: Float[np.ndarray, "m d"], *, seed: int,
    added: int, table: int, shrunk: int,
) -> Collected:  # fmt: skip
    """Confirm failures, the worst first, and convert them to points to train around.

    - `earlier`: points of earlier rounds; `table`: the number of samples from the prior.
    - `added`: the maximum number of points.
    - `shrunk`: number of counterexamples to shrink, if the problem has nominal features.
    """
    space, points, sources = problem.space, [np.zeros((0, problem.space.dim), np.float32)], []
    if not len(failing):
        kept = np.ones(len(earlier), bool)
        return Collected(points[0], np.zeros(0), np.zeros(0, np.str_), kept, 0)

    def add(found: Float[np.ndarray, "n d"], source: str) -> None:
        points.append(np.asarray(found, np.float32))
        sources.extend([source] * len(found))

    # From the worst to the mildest: the worst ones alone are often of one kind.
    spread = np.unique(np.linspace(0, len(failing) - 1, added).astype(int))
    sampled = np.asarray(space.points_at(space.sample(jax.random.key(seed), table)))
    tried = np.concatenate([earlier, sampled, space.points(failing.iloc[spread])])
    run = falsify(problem, PointList(tried), len(tried), seed=seed, progress=False)
    end_if_interrupted(run.stopped)
    simulations, confirmed = run.simulations, run.table.counterexamples
    if len(confirmed):
        worst = np.unique(np.linspace(0, len(confirmed) - 1, shrunk).astype(int))
        for row in confirmed.sort_values("rho").index[worst]:
            try:
                small = shrink(run, int(row), budget=SHRINKING, others=False, progress=False)
            except ValueError:
                continue  # No nominal features, or a failure of its own random key alone.
            end_if_interrupted(small.stopped)
            add(small.u[None], "shrunk")
            simulations += small.simulations
        drawn = space.rows(space.sample(jax.random.key(seed + 1), PRIOR))
        prior = pd.DataFrame({name: np.asarray(column) for name, column in drawn.items()})
        try:
            within = prior.loc[rules(run).matches(prior)].iloc[: added // 4]
        except ValueError:
            within = prior.iloc[:0]  # Nothing or everything fails, so that there is no rule.
        if len(within):
            add(space.points(within), "rule")
    rows = np.asarray(confirmed.index, int)
    fails = np.isin(np.arange(len(tried)), rows)
    first, last = len(earlier), len(earlier) + table
    add(tried[rows[(rows >= first) & (rows < last)]][: added // 2], "sample")
    add(tried[rows[rows >= last]][: max(added - len(sources), 0)], "counterexample")
    kept = fails[:first]
    passing = np.flatnonzero(~kept)
    kept[passing[max(len(passing) - int(kept.sum()) - len(sources), 0) :]] = True
    centres = np.concatenate(points)
    radii, spent = _radii(problem, centres, seed) if len(centres) else (np.zeros(0), 0)
    return Collected(centres, radii, np.array(sources, np.str_), kept, simulations + spent)


def _radii(
    problem: Problem, centres: Float[np.ndarray, "n d"], seed: int
) -> tuple[Float[np.ndarray, " n"], int]:
    """Return the radius of the failing neighbourhood of each point, and the simulations used."""
    space, count = problem.space, len(centres)
    low, high = (np.repeat(ends, AROUND, 0) for ends in neighbourhoods(space, centres, RADIUS))
    points = low + np.random.default_rng(seed).random(low.shape) * (high - low)
    possible = np.asarray(jax.vmap(space.accepts)(space.features_at(points)))
    found = PointList(points[possible])
    run = falsify(problem, found, int(possible.sum()), seed=seed, confirm=False, progress=False)
    end_if_interrupted(run.stopped)
    fails = np.zeros(len(points), bool)
    fails[np.flatnonzero(possible)[np.asarray(run.table.violating.index, int)]] = True
    thin = fails.reshape(count, AROUND).mean(axis=1) < THIN
    return np.where(thin, NARROW, RADIUS), run.simulations

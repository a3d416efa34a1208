"""Elementary effects: a screening of influential features with few simulations."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.addons.analysis.sensitivity.sensitivity import (
    RESAMPLES,
    Coordinates,
    Sensitivity,
    Simulator,
    check_problem,
    coordinates_of,
    mean_of,
    ranked,
    variance_of,
)
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count
from verifai_jax.problem.problem import Problem


@shows_progress("finding elementary effects in")
def morris(
    problem: Problem, trajectories: int = 32, levels: int = 4, *, seed: int = 0, batch: int = 1024,
    of: str | None = None, progress: bool | None = None,
) -> Sensitivity:  # fmt: skip
    """Measure elementary effects: how the robustness changes when one feature makes a large step.

    `mu_star` is the mean size of the effect over the whole range. `sigma` is its standard
    deviation, which is large if the effect is nonlinear or depends on the other features. `mu` is
    the mean with its sign (NaN for choices without an order).

    - `trajectories`: number of paths that change each coordinate once; each has `d + 1`
      simulations.
    - `levels`: even number of values that a continuous coordinate takes: the middles of equally
      probable cells, so that long-tailed features stay finite. A discrete one takes all of its
      values.
    - `of`: name of the formula; when left out, the least robustness over all.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.

    Sources: Morris, Factorial sampling plans for preliminary computational experiments,
    Technometrics 33 (1991); `mu_star` of Campolongo, Cariboni and Saltelli, An effective screening
    design for sensitivity analysis of large models, Environmental Modelling and Software 22 (2007).

    **Raises:** `ValueError` for a space with a constraint, fewer than 2 trajectories, an odd number
    of levels, and if no simulation has a verdict or the robustness never varies.
    """
    check_problem(problem, "elementary effects", of)
    check_count("trajectories", trajectories, 2)
    if not isinstance(levels, int) or levels < 2 or levels % 2:
        raise ValueError(f"levels must be an even number of at least 2; got {levels!r}")
    space = coordinates_of(problem)
    d = len(space.names)
    generator = np.random.default_rng(seed)
    counts = np.where(np.array(space.levels) == 0, levels, space.levels).astype(int)
    start, stop, step = elementary_steps(counts, space, generator, trajectories)
    index = generator.permuted(np.tile(np.arange(d), (trajectories, 1)), axis=1)
    simulate = Simulator(problem, seed, min(batch, trajectories), of)
    cells, rows = start.copy(), np.arange(trajectories)
    before = simulate(space.centres(cells, counts), 0)
    seen, effects = [before], np.full((trajectories, d), np.nan)
    for turn in range(d):
        moved = index[:, turn]
        cells[rows, moved] = stop[rows, moved]
        after = simulate(space.centres(cells, counts), 0)
        size = step[rows, moved]
        with np.errstate(invalid="ignore", divide="ignore"):
            effects[rows, moved] = np.where(size == 0, 0.0, (after - before) / size)
        seen.append(after)
        before = after
    variance = variance_of(np.concatenate(seen), problem)
    effects[~np.isfinite(effects)] = np.nan
    again = [
        mean_of(np.abs(effects[generator.integers(trajectories, size=trajectories)]))
        for _ in range(RESAMPLES)
    ]
    low, high = np.nanpercentile(np.array(again), [2.5, 97.5], axis=0)
    centred = effects - mean_of(effects)
    count = np.sum(np.isfinite(effects), axis=0)
    table = ranked(
        space.names,
        {
            "mu_star": mean_of(np.abs(effects)),
            "low": low,
            "high": high,
            "sigma": np.sqrt(np.nansum(centred**2, axis=0) / np.maximum(count - 1, 1)),
            "mu": np.where(space.ordered, mean_of(effects), np.nan),
            "effects": count,
        },
        by="mu_star",
    )
    return Sensitivity(
        "Elementary effects", problem.name, table, simulate.done, simulate.dropped, variance
    )


def elementary_steps(
    counts: Int[np.ndarray, " d"], space: "Coordinates", generator: Any, n: int
) -> tuple[Int[np.ndarray, "n d"], Int[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
    """Return first and last cell of every coordinate on every path, and the signed step length."""
    start = generator.integers(counts, size=(n, len(counts)))
    half = counts // 2
    # Half the range up, or down from the upper half: every cell is visited equally often.
    up = start + half < counts
    ordered = np.where(up, start + half, start - half)
    other = generator.integers(np.maximum(counts - 1, 1), size=start.shape)
    other = np.where(counts == 1, 0, other + (other >= start))
    stop = np.where(space.ordered, ordered, other)
    continuous = np.array(space.levels) == 0
    # In shares of the whole range: from the first to the last value of a discrete coordinate is 1.
    length = np.where(continuous, half / counts, half / np.maximum(counts - 1, 1))
    step = np.where(space.ordered, np.where(up, length, -length), 1.0)
    return start, stop, np.where(stop == start, 0.0, step)

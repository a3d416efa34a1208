"""Gradients as sensitivities: upper bounds that show which features have no influence."""

import numpy as np

from verifai_jax.addons.analysis.sensitivity import sensitivity
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count
from verifai_jax.problem.problem import Problem


@shows_progress("finding gradients of")
def gradient_sensitivity(
    problem: Problem, samples: int = 1024, *, seed: int = 0, batch: int = 1024,
    temperature: float | None = None, progress: bool | None = None,
) -> sensitivity.Sensitivity:  # fmt: skip
    """Measure the mean squared gradient of the robustness by each feature, and the bound it gives.

    `bound` is an upper bound on the total Sobol index: a feature whose bound is near 0 can be
    fixed. It is no estimate of the index, and a bound above 1, which a few huge gradients of a
    chaotic system can cause, says nothing. `slope` is the mean gradient, whose sign tells which
    direction is worse; `typical` is the median of its size. NaN for discrete coordinates, which
    have no gradient.

    - `temperature`: the temperature of the smooth robustness that is differentiated; by default a
      hundredth of the standard deviation of the robustness. The bound holds for the smooth
      robustness, if the gradients of the system are correct.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.

    Source: Sobol and Kucherenko, Derivative based global sensitivity measures and their link with
    global sensitivity indices, Mathematics and Computers in Simulation 79 (2009).

    **Raises:** `ValueError` for a black box, a space with a constraint or without continuous
    coordinates, fewer than 16 samples, and a robustness that never varies.
    """
    sensitivity.check_problem(problem, "gradient sensitivity", None)
    if problem.black_box:
        raise ValueError(
            f"the system of problem {problem.name!r} is a black box, which has no gradient; "
            "use sobol_indices or morris"
        )
    check_count("samples", samples, 16)
    space = sensitivity.coordinates_of(problem)
    continuous = np.array(space.levels) == 0
    if not continuous.any():
        raise ValueError(
            f"problem {problem.name!r} has no continuous feature, so no gradient; "
            "use sobol_indices or morris"
        )
    if temperature is not None and not temperature > 0:
        raise ValueError(f"temperature must be positive; got {temperature!r}")
    from scipy.stats import qmc

    exponent = int(np.ceil(np.log2(samples)))
    u = qmc.Sobol(len(space.names), rng=seed).random_base2(exponent)[:samples]
    simulate = sensitivity.Simulator(problem, seed, min(batch, samples), None, gradient=True)
    rho = simulate(u.astype(np.float32)[: simulate.batch], 0)
    if temperature is None:
        temperature = 0.01 * float(np.sqrt(sensitivity.variance_of(rho, problem)))
    simulate.done = simulate.dropped = 0
    simulate.gradients.clear()
    rho = simulate(u.astype(np.float32), 0, temperature)
    gradient = np.concatenate(simulate.gradients)
    proper = np.isfinite(rho) & np.all(np.isfinite(gradient), axis=1)
    variance = sensitivity.variance_of(np.where(proper, rho, np.nan), problem)
    gradient, rho = gradient[proper].astype(np.float64), rho[proper]
    gradient[:, ~continuous] = np.nan
    generator = np.random.default_rng(seed)
    again = []
    for _ in range(sensitivity.RESAMPLES):
        rows = generator.integers(len(rho), size=len(rho))
        again.append(np.mean(gradient[rows] ** 2, axis=0) / (np.pi**2 * (np.var(rho[rows]) or 1)))
    low, high = np.percentile(np.array(again), [2.5, 97.5], axis=0)
    squared = np.mean(gradient**2, axis=0)
    table = sensitivity.ranked(
        space.names,
        {
            "bound": squared / (np.pi**2 * variance),
            "low": low,
            "high": high,
            "mean_squared": squared,
            "slope": np.mean(gradient, axis=0),
            "typical": np.median(np.abs(gradient), axis=0),
        },
        by="bound",
    )
    dropped = int(np.sum(~proper))
    return sensitivity.Sensitivity(
        "Gradient sensitivity", problem.name, table, simulate.done, dropped, variance
    )

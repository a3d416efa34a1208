"""Common parts of the sensitivity analyses, which simulate the effect of each feature.

    sobol_indices(problem, samples=4096)         sobol.py: shares of the variance
    morris(problem, trajectories=32)             morris.py: cheap screening
    gradient_sensitivity(problem, samples=1024)  gradients.py: bounds on total indices

All three methods sample the unit cube: features are independent and distributed as under the prior.
Simulation noise is fixed while a feature changes, and counts as a separate input.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.messages.text import format_percent
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd
RESAMPLES = 200
"""Bootstrap samples behind an interval."""
MAX_SHOWN = 20


@dataclass(frozen=True, eq=False)
class Sensitivity(Drawn, InNotebook):
    """Result of a sensitivity analysis.

    **Fields:** `method`; `problem`: its name; `table`: one row for each unit coordinate, by
    decreasing influence, with `low` and `high` ends of 95 % bootstrap intervals; `simulations`
    made; `dropped`: how many of them had no verdict and were left out together with their partners;
    `variance` of the robustness.
    """

    _picture = "verifai_jax.addons.analysis.pictures.overview", "plot_sensitivity"
    """The indices with their intervals."""
    method: str
    problem: str
    table: "pd.DataFrame"
    simulations: int
    dropped: int
    variance: float

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        lines = [
            f"{self.method} of {self.problem!r} from {self.simulations:,} simulations, robustness "
            f"{'varies' if self.variance else 'does not vary'}: "
            f"standard deviation {np.sqrt(self.variance):z.3g}"
        ]
        if self.dropped:
            lines.append(f"{self.dropped:,} simulations had no verdict and were left out")
        width = max(len(str(name)) for name in self.table.index)
        for name, row in self.table.head(MAX_SHOWN).iterrows():
            lines.append(f"  {name!s:<{width}}  {_words(self.method, row)}")
        if len(self.table) > MAX_SHOWN:
            lines.append(f"  and {len(self.table) - MAX_SHOWN} more with less influence")
        return "\n".join(lines)


class Simulator:
    """The robustness of points of the cube, computed in batches of one shape and counted."""

    def __init__(
        self, problem: Problem, seed: int, batch: int, of: str | None, gradient: bool = False
    ) -> None:
        problem = resolved(problem, gradient=gradient, batch=batch).problem
        problem.check()
        self.batch = batch
        self._evaluate = Evaluator(problem, batch, gradient=gradient, seed=seed, ends_raising=True)
        self.column = None if of is None else list(problem.formulas).index(of)
        self.done = self.dropped = 0
        self.gradients: list[Any] = []

    def __call__(
        self, u: Float[np.ndarray, "n d"], first: int, temperature: float = 1.0
    ) -> Float[np.ndarray, " n"]:
        """Robustness `[n]`, NaN without a verdict; row `i` has the random key `first + i`."""
        verdicts = self._evaluate(u, temperature, first)
        self.gradients.append(verdicts.gradient)
        rho = verdicts.lowest if self.column is None else verdicts.rho[:, self.column]
        rho = rho.astype(np.float64)
        rho[~np.isfinite(rho)] = np.nan
        self.done += len(rho)
        self.dropped += int(np.sum(np.isnan(rho)))
        return rho


class Coordinates(NamedTuple):
    """The unit coordinates of a problem, with their names and values."""

    names: tuple[str, ...]
    levels: tuple[int, ...]
    ordered: tuple[bool, ...]
    weights: tuple[Any, ...]

    def centres(
        self, cells: Int[np.ndarray, "n d"], counts: Int[np.ndarray, " d"]
    ) -> Float[np.ndarray, "n d"]:
        """Return the middles of cells; coordinate `i` has `counts[i]` cells."""
        middles = (cells + 0.5) / counts
        for i, weights in enumerate(self.weights):
            if weights is not None:
                edges = np.concatenate([[0.0], np.cumsum(weights)])
                middles[:, i] = ((edges[1:] + edges[:-1]) / 2)[cells[:, i]]
        return middles.astype(np.float32)


def coordinates_of(problem: Problem) -> Coordinates:
    space: Any = problem.space
    levels = tuple(space.levels)
    names = tuple(space.columns)
    if len(names) != len(levels):
        names = tuple(f"u[{i}]" for i in range(len(levels)))
    return Coordinates(
        tuple(getattr(space, "coordinates", None) or names),
        levels,
        tuple(getattr(space, "ordered", None) or (True,) * len(levels)),
        tuple(getattr(space, "weights", None) or (None,) * len(levels)),
    )


def check_problem(problem: Any, what: str, of: str | None) -> None:
    if not isinstance(problem, Problem):
        raise TypeError(f"a sensitivity analysis needs a Problem; got {type(problem).__name__}")
    if getattr(problem.space, "where", None) is not None:
        raise ValueError(
            f"the space of problem {problem.name!r} has a constraint (where), so its features "
            f"depend on each other, and {what} assume that they do not; drop the constraint "
            "or use importance(run), which works on any table"
        )
    if not problem.space.dim:
        raise ValueError(f"nothing varies in the space of problem {problem.name!r}")
    if of is not None:
        check_names("formula", [of], problem.formulas)


def variance_of(rho: Float[np.ndarray, " n"], problem: Problem) -> float:
    proper = rho[np.isfinite(rho)]
    if not len(proper):
        raise ValueError(
            f"none of {len(rho)} simulations of problem {problem.name!r} has a verdict; "
            "falsify(problem, 'uniform', 10).summary() shows why"
        )
    if np.ptp(proper) == 0:
        raise ValueError(
            f"the robustness of problem {problem.name!r} is {proper[0]:z.4g} in all of "
            f"{len(proper)} simulations: there is no variation that features could explain"
        )
    return float(np.var(proper))


def mean_of(values: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " d"]:
    """Return the mean of each column without its NaN; NaN if nothing is left."""
    count = np.sum(np.isfinite(values), axis=0)
    return np.where(count > 0, np.nansum(values, axis=0) / np.maximum(count, 1), np.nan)


def ranked(names: tuple[str, ...], columns: dict[str, Any], by: str) -> "pd.DataFrame":
    import pandas as pd

    frame = pd.DataFrame(columns, index=pd.Index(names, name="feature"))
    return frame.sort_values(by, ascending=False, kind="stable", na_position="last")


def _words(method: str, row: Any) -> str:
    if "total" in row:
        between = f"{format_percent(row['total_low'])} to {format_percent(row['total_high'])}"
        alone = f"{format_percent(max(row['first'], 0))} alone"
        return f"{format_percent(row['total'])} of the variance in all ({between}), {alone}"
    if "mu_star" in row:
        direction = {1.0: ", up on average", -1.0: ", down on average"}.get(np.sign(row["mu"]), "")
        return (
            f"moves the robustness by {row['mu_star']:z.3g} "
            f"({row['low']:z.3g} to {row['high']:z.3g}) over its range, "
            f"standard deviation {row['sigma']:z.3g}{direction}"
        )
    if np.isnan(row["bound"]):
        return "discrete: has no gradient"
    slope = f"typical slope {row['typical']:z.3g}"
    if row["bound"] >= 1:
        return f"no bound below 100 %: mean squared slope {row['mean_squared']:z.3g}, {slope}"
    between = f"{format_percent(row['low'])} to {format_percent(row['high'])}"
    return f"at most {format_percent(row['bound'])} of the variance ({between}), {slope}"

"""The reasons of a failure: the predicate, the instant, and the features that matter.

    why = explain(run)                                  # the worst row
    print(why)                                          # a paragraph
    why.plot("why.png")                                 # the signal, and the features next to it

Predicate and instant come from `mtl.explain` on the replayed trace. The influence of a feature is
the robustness after resetting only this feature to nominal, and its gradient.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.counterexamples.candidates import Candidates
from verifai_jax.counterexamples.description import describe
from verifai_jax.counterexamples.fixed_key import fix_key, note_on_key
from verifai_jax.counterexamples.influence import Influence, spans_of
from verifai_jax.counterexamples.nominal import Nominal
from verifai_jax.counterexamples.selection import Row, problem_of, select_row
from verifai_jax.evaluation.replay import Replay, replay
from verifai_jax.falsification.run import Run
from verifai_jax.features import FeatureSpace
from verifai_jax.mtl import Explanation

MATTERS = 0.05
"""Share of the greatest influence below which a feature does not matter."""


@dataclass(frozen=True, eq=False)
class Explained(Drawn, InNotebook):
    """Reasons of a failure; `str()` is a paragraph, `plot` a picture.

    **Fields:** `row`; `formula`: the name of the formula that is broken most; `rho` of the row;
    `why`: the predicate, the instant and the path (`mtl.Explanation`); `influences`: the features
    by decreasing influence; `simulations` spent; `replay`: the trace; `notes`.
    """

    _picture = "verifai_jax.pictures.counterexamples", "plot_explanation"
    """The deciding signal with its bound and instant, and the features."""
    row: int
    formula: str
    rho: float
    why: Explanation
    influences: tuple[Influence, ...]
    simulations: int
    replay: Replay
    notes: tuple[str, ...] = ()

    def effect(self, influence: Influence) -> float:
        """Return how a feature changes the robustness: when reset to nominal, or by its slope."""
        return influence.effect(self.rho)

    @property
    def matter(self) -> tuple[Influence, ...]:
        """The features with at least 5 % of the greatest influence, by decreasing influence."""
        maximum = max((abs(self.effect(i)) for i in self.influences), default=0.0)
        return tuple(
            i
            for i in self.influences
            if i.gone or abs(self.effect(i)) > MATTERS * max(maximum, 1e-12)
        )

    def __str__(self) -> str:
        name = self.replay.problem.name
        text = describe(
            name, self.row, self.why, self.rho, self.influences, self.matter, self.notes
        )
        return "\n".join([*self.replay.warnings, text])

    __repr__ = __str__


@suggests_options
@shows_progress("explaining a counterexample of")
def explain(
    run: Run, row: Row = None, *, nominal: Mapping[str, Any] | None = None,
    progress: bool | None = None,
) -> Explained:  # fmt: skip
    """Explain a counterexample: the deciding predicate, its time, and the features that matter.

    **Arguments:**
    - `run`: a run of a problem, with a counterexample.
    - `row`: the number of a counterexample, or its row of the table; the worst when left out.
    - `nominal`: nominal features, instead of those of the problem, if any.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.

    This takes one simulation for each feature and each unit coordinate, and one gradient. Without
    nominal features only the gradient shows which features matter.

    **Returns:** an `Explained`.
    **Raises:** `ValueError` for a run without its problem or without a counterexample, and for a
    row that is not a counterexample, or has no verdict when simulated again.
    """
    problem = problem_of(run)
    number, entry = select_row(run, row)
    notes = []
    try:
        at, known = Nominal.of(problem, nominal), True
    except ValueError:
        if nominal:
            raise
        at, known = Nominal(problem.space, np.full(problem.space.dim, 0.5, np.float32)), False
    replayed = run.compared(replay(problem, entry, run_keys(run.seed)[1], number, run.precision))
    if not replayed.violated:
        notes.append("simulated again alone the row does not fail; see what confirm says of it")
    why = replayed.explain()
    notes += note_on_key(problem, number)
    fixed = fix_key(problem, run, number)
    features = problem.space.from_row(entry)
    u = at.settle(np.asarray(problem.space.point_of(features))[None])[0]
    candidates = Candidates(fixed, at, 10**9, run.precision)
    groups = at.groups
    singles = list(range(len(u)))
    points = np.repeat(u[None], 1 + len(groups) + len(singles), axis=0)
    for point, (_, coordinates) in zip(points[1:], groups, strict=False):
        point[coordinates] = at.u[coordinates]
    for point, i in zip(points[1 + len(groups) :], singles, strict=True):
        point[i] = at.u[i]
    rho, failing = candidates(points if known else points[:1])
    if not known:
        rho = np.concatenate([rho, np.full(len(points) - 1, np.nan)])
        failing = np.concatenate([failing, np.ones(len(points) - 1, bool)])
    # A simulation without a verdict, or one that the constraint refuses, says nothing.
    rho[~np.isfinite(rho)] = np.nan
    spread = np.nanmax(np.abs(rho), initial=0.0)
    # Near the hard robustness, since the gradient is reported as a number.
    candidates.temperature = max(0.002 * float(spread), 1e-6)
    tangent = candidates.tangents(u[None])[0]
    slopes = gradient = np.full(len(u), np.nan)
    if tangent is not None:
        slopes, ranges = slopes_of(problem.space, u, tangent.gradient, run.precision)
        gradient = slopes * ranges
    if not known:
        only = "only gradients tell what matters"
        if tangent is None:
            only = "and has no gradient here: give nominal= to learn what matters"
        notes.append(f"the problem does not say what is nominal{':' if tangent else ','} {only}")
    notes += candidates.notes
    duration = replayed.duration or 0.0
    influences = []
    for n, (name, coordinates) in enumerate(groups, start=1):
        one = 1 + len(groups) + coordinates
        values, usual = values_of(problem.space, name, u), values_of(problem.space, name, at.u)
        safe = ~failing & np.isfinite(rho)
        influences.append(
            Influence(
                name=name,
                coordinates=tuple(at.names[i] for i in coordinates),
                value=values,
                nominal=usual if known else (),
                spans=spans_of(problem.space.domains[name], duration),
                reverted=float(rho[n]),
                gone=bool(safe[n]),
                departs=bool(at.departs(u[None])[0, coordinates].any()),
                each=rho[one],
                each_gone=tuple(bool(gone) for gone in safe[one]),
                gradient=gradient[coordinates],
                slopes=slopes[coordinates],
            )
        )
    explained = Explained(
        row=number,
        formula=replayed.worst,
        rho=min(replayed.rho.values()),
        why=why,
        influences=tuple(influences),
        simulations=candidates.simulations + 1,
        replay=replayed,
        notes=tuple(notes),
    )
    ordered = sorted(influences, key=lambda i: (-i.gone, -abs(explained.effect(i))))
    object.__setattr__(explained, "influences", tuple(ordered))
    return explained


def slopes_of(
    space: FeatureSpace, u: Float[np.ndarray, " d"], gradient: Float[np.ndarray, " d"],
    precision: str,
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:  # fmt: skip
    """Return derivatives with respect to the features' real numbers, and the ranges of these.

    Unit coordinates are probabilities: a step of 0.01 changes a feature much in the tail of its
    distribution and little in the middle, so their gradient is converted.

    **Arguments:**
    - `u`: the point at which the gradient was taken.
    - `gradient`: the gradient with respect to the unit coordinates.
    - `precision`: the precision in which it was computed.
    **Returns:** for each coordinate, the derivative with respect to its number in its unit, NaN for
    choices, integers and lengths; and twice the interquartile range, which is the whole range of a
    Box.
    """

    def numbers(point: Array) -> Array:
        leaves = jax.tree.leaves(space.unflatten(point))
        real = [jnp.ravel(leaf) for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
        return jnp.concatenate([*real, jnp.zeros(1, point.dtype)])

    with in_precision(precision):
        jacobian = np.asarray(jax.jit(jax.jacfwd(numbers))(jnp.asarray(u, precision)), np.float64)
        quarters = np.repeat(u[None].astype(precision), 2 * len(u), axis=0)
        for i in range(len(u)):
            quarters[2 * i : 2 * i + 2, i] = 0.25, 0.75
        there = np.asarray(jax.jit(jax.vmap(numbers))(quarters), np.float64)
    each = np.arange(len(u))
    own = np.argmax(np.abs(jacobian), axis=0)
    moved = jacobian[own, each]
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.where(moved == 0, np.nan, gradient / moved)
    return slopes, 2 * (there[2 * each + 1, own] - there[2 * each, own])


def values_of(space: FeatureSpace, name: str, u: Float[np.ndarray, " d"]) -> tuple[Any, ...]:
    """Return the entries of a feature's table columns at a point."""
    features = jax.tree.map(np.asarray, space.features_at(u[None]))
    columns = space.domains[name].to_columns(features[name], name)
    return tuple(c[0].item() if isinstance(c[0], np.generic) else c[0] for c in columns.values())

"""A problem whose signals on sets contain the values at all times between two samples.

    problem = between_samples(problem)      # of a system that `vj.ode` made

Sample k of a signal represents all its values from time k `dt` until the next sample, with the
control that is held then; the last sample represents only the final time. Closed windows of
`always` and `eventually` over such samples cover every instant of the windows in time, and each of
their samples contains such an instant. A duration is what the instants within a window measure. So
bounds of the robustness over sets also hold in continuous time.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import PyTree

from verifai_jax.addons.verification.sets import flow
from verifai_jax.mtl.fitting import changed_leaves, with_terms
from verifai_jax.mtl.formula import Formula, Interval, Next, Prev, Term, Witness
from verifai_jax.mtl.sampled import Duration, Operations, V, sampled_in, with_counted
from verifai_jax.problem.problem import Problem, ProblemError
from verifai_jax.systems.ode.closed_loop import Ode, substep
from verifai_jax.systems.pytree_checks import default_signals


def between_samples(problem: Problem) -> Problem:
    """Return the problem with the differential equation, whose system only sets can evaluate.

    **Raises:** `ProblemError` for a system that was not made by `vj.ode`, or that ends or jumps at
    its own instants, and for a formula about single samples.
    """
    loop = problem.system
    if not isinstance(loop, Ode):
        raise ProblemError(
            f"continuous=True is about the equations of a system that vj.ode made; that of problem "
            f"{problem.name!r} is a {type(loop).__name__}. Leave it out to verify the system in "
            "discrete time"
        )
    for name in ("switches", "terminate", "exact_step"):
        if getattr(loop, name):
            raise ProblemError(
                "continuous=True needs a plant that moves continuously for the whole duration; "
                f"the system of problem {problem.name!r} has {name}=. Leave one of the two out"
            )
    every = with_counted(*problem.formulas.values())
    for part in (part for f in every for part in f.subformulas(valued=True)):
        if isinstance(part, Next | Prev | Witness) or any(
            not isinstance(each, Duration) for each in sampled_in(part)
        ):
            raise ProblemError(
                "continuous=True supports formulas with comparisons, not, and, or, always, "
                f"eventually, historically, once and durations; {part} is about single samples"
            )
        if not (window := getattr(part, "interval", Interval())).closed:
            raise ProblemError(
                f"continuous=True needs closed windows, such as [0,1], not the {window} of {part}"
            )

    def during(time: Any, state: PyTree, control: Any, features: Any) -> Any:
        left = jnp.where(time < (loop.steps - 0.5) * loop.dt, loop.dt, 0.0)
        inside = replace(loop, method=lambda *step: flow(*step)[1])
        states = substep(inside, features, control, time, state, left)
        if loop.signals is None:
            return default_signals(states, control)
        return loop.signals(_instants(time, left), states, control, features)

    system = replace(loop, method=lambda *step: flow(*step)[0], signals=during)
    spec = {name: _measured(formula) for name, formula in problem.formulas.items()}
    return replace(problem, system=system, spec=spec)


class _Measure(Duration):
    """The seconds, within a window of time, in which a formula holds: no period counts as whole.

    A window covers parts of its first and its last step, together as long as one step. In these
    parts the formula holds as long as in one of the two steps, or some time in between.
    """

    def value(self, of: Operations[V], operands: Sequence[V], first: int, last: int) -> V:
        window, (truth,) = self.window, operands
        assert window is not None
        first, last = first - window.open_start, last + window.open_end
        ends = of.before(truth, first), of.before(truth, last)
        part = of.apply("max", of.apply("min", *ends), _instants(of.number(0.0), of.number(1.0)))
        part = of.apply("min", of.apply("max", *ends), part)
        if last > first + 1:
            part = of.apply("+", part, of.total(of.before(truth, first + 1), last - first - 1))
        return of.apply("*", part, of.number(of.dt if last > first else 0.0))


def _measured(formula: Formula) -> Formula:
    """Return a formula whose durations are those of time, not of samples."""

    def measured(part: Term) -> Term | None:
        own = part if isinstance(part, Duration) else None
        return None if own is None else _Measure.of([*map(_measured, own.counted)], own.window)

    return changed_leaves(formula, lambda leaf: with_terms(leaf, measured))


def _instants(time: Any, seconds: Any) -> Any:
    """Return the set of all times from one on until some seconds later."""
    return flow(lambda time, clock: jnp.ones_like(clock), time, time, seconds)[1]

"""Formulas as goals to break, each of a few clauses to violate together.

    goals = goals_of([formula])
    goals.values(trace, hard)                           # [goals, CLAUSES]
    goals.values(trace, smooth(0.05))                   # differentiable, temperature without unit

A formula is broken by breaking one of its goals (the parts of a conjunction), and a goal by
breaking all of its clauses (the parts of a disjunction). A separate value for each clause lets a
search lower one without raising another; their maximum shows only one. Predicates are divided by
their variation along the trace, so that clauses in different units can be compared; signs do not
change.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from verifai_jax.core.values.clauses import ABSENT, CLAUSES
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl._robustness import robustness
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.expression import Number, Signal
from verifai_jax.mtl.fitting import fitted, sizes_of
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.rewriting import nnf, rebuild, replaced
from verifai_jax.mtl.semantics import Semantics, hard
from verifai_jax.mtl.setting import evaluator_of, prepare

GOALS = 16
"""Greatest number of goals; the last one has all that a conjunction has beyond. Each costs an
evaluation of its clauses in every simulation."""


@dataclass(frozen=True)
class Goals:
    """The goals of formulas, over the margins of their predicates.

    - `leaves`: the predicates; the margin of the i-th is a signal named `leaf i`.
    - `goals`: the clauses of each goal, over these signals.
    """

    leaves: tuple[Formula, ...]
    goals: tuple[tuple[Formula, ...], ...]

    @property
    def max_clauses(self) -> int:
        """Maximum number of clauses of a goal."""
        return max(len(goal) for goal in self.goals)

    def margins(self, trace: Trace, end: End = "hold") -> Trace:
        """Compute the margins of the predicates divided by their scale, as the signals of a trace.

        The scale is the standard deviation along the trace plus a share of the size of the compared
        values, for constant signals; it is not differentiated.
        """
        # A search is guided by the samples of the clock; verdicts count all.
        trace = replace(trace, between=None)
        if not self.leaves:
            return trace  # Constants alone.
        signals = {}
        for i, leaf in enumerate(self.leaves):
            setting, arrays, _, valid = prepare(leaf, trace, hard, end, None)
            evaluator = evaluator_of(setting, arrays, None, valid, 0)
            margin = evaluator.value(leaf, 0, setting.length - 1)
            size = sum(
                jnp.mean(jnp.abs(jnp.asarray(evaluator.expression(side, 0, setting.length - 1))))
                for part in fitted(leaf, evaluator.units, sizes_of(arrays)).subformulas()
                for side in part.terms()
            )
            scale = jnp.sqrt(jnp.var(margin) + (0.1 * size) ** 2)
            scale = jax.lax.stop_gradient(scale)
            # A trace on the edge of the predicate all along has no scale of its own.
            signals[_name(i)] = margin / jnp.where(scale > 1e-12, scale, 1.0)
        return replace(trace, signals=signals, finite=())

    def values(
        self, trace: Trace, semantics: Semantics = hard, end: End = "hold"
    ) -> Float[Array, "goals clauses"]:
        """Compute the robustness of each clause from scaled margins; `ABSENT` for a missing one."""
        scaled = self.margins(trace, end)
        rows = []
        for goal in self.goals:
            found = [robustness(clause, scaled, semantics, end=end) for clause in goal]
            absent = [jnp.full_like(found[0], ABSENT)] * (self.max_clauses - len(goal))
            rows.append(jnp.stack([*found, *absent]))
        # A window without samples gives infinities, of which nothing can be learned.
        return jnp.clip(jnp.stack(rows), ABSENT, -ABSENT)


def goals_of(formulas: Iterable[Formula]) -> Goals:
    """Return the goals of a conjunction of these formulas."""
    goals: list[tuple[Formula, ...]] = []
    for formula in formulas:
        goals.extend(
            _few(_parts(part, ast.Or), ast.Or, CLAUSES) for part in _parts(nnf(formula), ast.And)
        )
    if len(goals) > GOALS:
        rest = [ast.Or(goal) if len(goal) > 1 else next(iter(goal)) for goal in goals[GOALS - 1 :]]
        goals = [*goals[: GOALS - 1], (ast.conjunction(*rest),)]
    leaves = tuple(
        dict.fromkeys(
            leaf
            for goal in goals
            for clause in goal
            for leaf in clause.subformulas()
            if leaf.is_predicate
        )
    )
    names: dict[Formula, Formula] = {
        leaf: ast.Predicate(">", Signal(_name(i)), Number(0.0)) for i, leaf in enumerate(leaves)
    }
    return Goals(leaves, tuple(tuple(replaced(clause, names) for clause in goal) for goal in goals))


def _name(i: int) -> str:
    return f"leaf {i}"


def _parts(formula: Formula, kind: type[ast.And] | type[ast.Or]) -> tuple[Formula, ...]:
    """Split a conjunction or disjunction, through the operators that distribute over it."""
    if isinstance(formula, kind):
        return tuple(part for each in formula.operands() for part in _parts(each, kind))
    if isinstance(formula, ast.Window) and formula.sign == kind.sign:
        inner = _parts(formula.operand, kind)
        if len(inner) > 1:
            return tuple(rebuild(formula, (part,)) for part in inner)
    return (formula,)


def _few(
    parts: tuple[Formula, ...], kind: type[ast.And] | type[ast.Or], count: int
) -> tuple[Formula, ...]:
    if len(parts) <= count:
        return parts
    return (*parts[: count - 1], kind(parts[count - 1 :]))

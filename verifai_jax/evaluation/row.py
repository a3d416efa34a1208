"""The function of one row that engines batch: robustness, status, clauses, derivatives, Booleans.

    function = RowFunction(problem, inputs, "float32", gradient=True, goals=None, guidance=NOTHING)
    function(row, key, temperature, shared, Derivative(d))          # Row, traced by JAX

Derivatives are of an objective, which is a simulation and its monitor: `objective` is that alone,
and `finish` makes a row's result of its values and their derivatives.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from verifai_jax.core.clauses import CLAUSES
from verifai_jax.core.trace import Trace
from verifai_jax.evaluation.differentiation import Derivative
from verifai_jax.evaluation.guidance import NOTHING, Guidance
from verifai_jax.evaluation.inputs import Inputs
from verifai_jax.evaluation.streaming_monitor import streaming_monitor
from verifai_jax.evaluation.verdicts import boolean_semantics, trace_coverage_ids, trace_verdict
from verifai_jax.mtl import hard, robustness, smooth
from verifai_jax.mtl.clauses import ABSENT, Goals
from verifai_jax.problem.problem import Problem


class Row(NamedTuple):
    """The result of one row under `jax.vmap`; see `Verdicts`."""

    rho: Float[Array, " formulas"]
    status: Int[Array, ""]
    features: PyTree
    derivatives: dict[str, PyTree]


class RowFunction(NamedTuple):
    """The function of one row; see the module's docstring.

    - `problem`: a checked `Problem`.
    - `inputs`: how a row becomes features and a system.
    - `precision`: of simulation, monitor and gradient.
    - `gradient`: whether the smooth robustness is differentiated.
    - `goals`: for an evaluation clause by clause.
    - `guidance`: what is computed for a search in addition to the robustness.
    """

    problem: Problem
    inputs: Inputs
    precision: str
    gradient: bool
    goals: Goals | None
    guidance: Guidance

    def __call__(
        self,
        row: PyTree,
        key: Key[Array, ""],
        temperature: Float[Array, ""],
        shared: PyTree,
        derivative: Derivative,
    ) -> Row:
        """Evaluate one row; `derivative` is how it is differentiated, where it is."""
        if self.goals is None and not self.gradient:
            return self._plain(row, key, shared)
        coordinates = self.coordinates(row, shared)

        def objective(coordinates: Array) -> tuple[Array, Any]:
            return self.objective(coordinates, row, key, temperature, shared)

        if not self.gradient:
            _, results = objective(coordinates)
            return self.finish(None, results)
        if self.goals is None:
            return self.finish(*derivative(objective, coordinates))
        return self.finish(*derivative.of_several(objective, coordinates))

    def coordinates(self, row: PyTree, shared: PyTree) -> Float[Array, " dim"]:
        """Return what the objective is differentiated by."""
        return self.inputs.coordinates(row, shared, self.precision)

    def objective(
        self,
        coordinates: Float[Array, " dim"],
        row: PyTree,
        key: Key[Array, ""],
        temperature: Float[Array, ""],
        shared: PyTree,
    ) -> tuple[Float[Array, "*clauses"], PyTree]:
        """Return what is differentiated, and the results that go with it.

        That is the least smooth robustness, or the clauses of the goal that is nearest to being
        broken.
        """
        features, system = self.inputs.simulated(coordinates, row, shared)
        trace = system(features, key).hold()
        verdict = trace_verdict(self.problem, trace)
        more = self.guidance.all(self.problem, trace, features)
        dtype = coordinates.dtype
        if self.goals is None:
            semantics = smooth(temperature.astype(dtype))
            smoothed = [
                robustness(formula, trace, semantics, end=self.problem.end)
                for formula in self.problem.formulas.values()
            ]
            lowest = self._with_guide(jnp.min(jnp.stack(smoothed)), trace, features)
            return lowest, (*verdict, features, None, more)
        values = self.goals.values(trace, hard, self.problem.end)
        nearest = jnp.argmin(jnp.max(values, axis=1))
        # A goal that is broken is a failure, whatever the guide says.
        broken = jnp.max(values[nearest]) < 0
        observed = self._with_guide(values[nearest], trace, features)
        # And clauses that do not exist stay absent.
        observed = jnp.where(broken | (values[nearest] <= 0.5 * ABSENT), values[nearest], observed)
        results = (*verdict, features, observed, more)
        if not self.gradient:
            return values[nearest], results
        semantics = smooth(temperature.astype(dtype))
        smoothed = self.goals.values(trace, semantics, self.problem.end)[nearest]
        return self._with_guide(smoothed, trace, features), results

    def finish(self, derivatives: Float[Array, "*clauses dim"] | None, results: PyTree) -> Row:
        """Return the row of these derivatives and of the results of the objective."""
        rho, status, features, clauses, more = results
        dtype, more = jnp.dtype(self.precision), dict(more)
        if clauses is None:
            assert derivatives is not None
            return Row(
                rho.astype(dtype), status, features, more | {"gradient": derivatives.astype(dtype)}
            )
        missing = CLAUSES - len(clauses)
        padded = jnp.pad(clauses, (0, missing), constant_values=ABSENT)
        more["clauses"] = padded.astype(dtype)
        if derivatives is not None:
            more["clause_gradients"] = jnp.pad(derivatives, ((0, missing), (0, 0))).astype(dtype)
        return Row(rho.astype(dtype), status, features, more)

    def holds(
        self, row: PyTree, key: Key[Array, ""], shared: PyTree = ()
    ) -> Bool[Array, " formulas"]:
        """Return the Boolean semantics of one row."""
        features, system = self._simulated(row, shared)
        return boolean_semantics(self.problem, system(features, key))

    def _plain(self, row: PyTree, key: Key[Array, ""], shared: PyTree) -> Row:
        """Return robustness and status."""
        features, system = self._simulated(row, shared)
        dtype = jnp.dtype(self.precision)
        traced = self.problem.behaviour is not None and self.inputs.streaming
        if traced or self.guidance != NOTHING:
            trace = system(features, key)
            rho, status = trace_verdict(self.problem, trace)
            more = self.guidance.all(self.problem, trace, features)
            if traced:
                more |= {"coverage_ids": trace_coverage_ids(self.problem, trace)}
            return Row(rho.astype(dtype), status, features, more)
        monitor = streaming_monitor(self.problem) if self.inputs.streaming else None
        if monitor is not None:
            rho, status = monitor(features, key)
        else:
            rho, status = trace_verdict(self.problem, system(features, key))
        return Row(rho.astype(dtype), status, features, {})

    def _simulated(self, row: PyTree, shared: PyTree) -> tuple[PyTree, Callable[..., Any]]:
        return self.inputs.simulated(self.coordinates(row, shared), row, shared)

    def _with_guide(self, values: Array, trace: Trace, features: PyTree) -> Array:
        """Return robustness, or clauses, with the guide's share, for their derivatives."""
        guide = self.problem.guide
        if not self.guidance.guide or guide is None:
            return values
        share = guide.share(guide.value(trace, features, self.problem.end))
        return (1 - guide.weight) * values + guide.weight * share.astype(values.dtype)

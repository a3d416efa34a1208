"""The function of one row that engines batch: robustness, status, clauses, derivatives, Booleans.

    inputs = CubePoints(problem)                        # points of the unit cube, or given features
    inputs = TableRows(refiner, formats)                # features of a table, at a finer step
    function = RowFunction(problem, inputs, "float32", gradient=True, goals=None, guidance=NOTHING)
    function(row, key, temperature, shared, Derivative(d))          # Row, traced by JAX

An engine compiles one such program for each kind of inputs. The differentiated objective consists
of a simulation and its monitor: `objective` computes its values, and `finish` makes the row's
result from these values and their derivatives.
"""

import abc
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from verifai_jax.core.compute.lifting import lifting
from verifai_jax.core.values.clauses import ABSENT, CLAUSES
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.differentiation import Derivative
from verifai_jax.evaluation.guidance import NOTHING, Guidance
from verifai_jax.evaluation.verdicts import (
    boolean_semantics,
    trace_coverage_ids,
    trace_verdict,
    with_status,
)
from verifai_jax.mtl import hard, online, robustness, smooth
from verifai_jax.mtl.clauses import Goals
from verifai_jax.problem.problem import Problem


class Inputs(abc.ABC):
    """The inputs of one row, and the values shared by all rows; pytrees that JAX traces."""

    row_form: PyTree
    """Shapes and types of one row, as `jax.ShapeDtypeStruct`s."""
    shared_form: PyTree = ()
    """The same for values shared by all rows."""
    dim: int = 0
    """Coordinates by which the robustness may be differentiated."""
    keeps_features: bool = False
    """Whether the simulated features are part of the results."""
    streaming: bool = False
    """Whether the monitor may travel with the rollout, where the system allows it."""
    purpose: str = "the simulation"
    """Description of the simulation, shown while it compiles."""

    @abc.abstractmethod
    def coordinates(self, row: PyTree, shared: PyTree, precision: str) -> Float[Array, " dim"]:
        """Return the coordinates by which the robustness is differentiated, in this precision."""

    @abc.abstractmethod
    def simulated(
        self, coordinates: Float[Array, " dim"], row: PyTree, shared: PyTree
    ) -> tuple[PyTree, Callable[..., Any]]:
        """Return the features and the system to simulate."""


class CubePoints(Inputs):
    """Points of the unit cube of a problem's feature space.

    **Arguments:**
    - `problem`: the problem whose space it is.
    - `given`: whether rows have the form of `given_rows`: a point, followed by the real numbers of
      user-given features, which are simulated exactly. NaN means that the number follows from the
      point.
    - `precision`: the precision of the given numbers.
    """

    keeps_features = True
    streaming = True

    def __init__(self, problem: Problem, given: bool = False, precision: str = "float32") -> None:
        self.problem, self.given = problem, given
        self.dim = problem.space.dim
        size = self.dim + (problem.space.width if given else 0)
        dtype = jnp.dtype(precision if given else "float32")
        self.row_form = jax.ShapeDtypeStruct((size,), dtype)

    def coordinates(self, row: PyTree, shared: PyTree, precision: str) -> Float[Array, " dim"]:
        return row[: self.dim].astype(precision)

    def simulated(
        self, coordinates: Float[Array, " dim"], row: PyTree, shared: PyTree
    ) -> tuple[PyTree, Callable[..., Any]]:
        space = self.problem.space
        with lifting():
            if self.given:
                features = space.unflatten_given(coordinates, row[self.dim :])
            else:
                features = space.unflatten(coordinates)
        return features, self.problem.system


class TableRows(Inputs):
    """Features as stored in a table, simulated by a system that depends on a shared number.

    **Arguments:**
    - `form`: the features of one row, as `jax.ShapeDtypeStruct`s in the engine's precision.
    - `system_at`: a function from the shared number, a refinement `factor`, to the system.
    """

    purpose = "closer replays"

    def __init__(self, form: PyTree, system_at: Callable[[Any], Callable[..., Any]]) -> None:
        self.row_form, self.system_at = form, system_at
        self.shared_form = jax.ShapeDtypeStruct((), jnp.int32)

    def coordinates(self, row: PyTree, shared: PyTree, precision: str) -> Float[Array, " dim"]:
        return jnp.zeros(0, precision)

    def simulated(
        self, coordinates: Float[Array, " dim"], row: PyTree, shared: PyTree
    ) -> tuple[PyTree, Callable[..., Any]]:
        return row, self.system_at(shared)


class Row(NamedTuple):
    """The result of one row under `jax.vmap`; see `Verdicts`."""

    rho: Float[Array, " formulas"]
    status: Int[Array, ""]
    features: PyTree
    derivatives: dict[str, PyTree]


class RowFunction(NamedTuple):
    """The function that simulates and evaluates one row; see the module's docstring.

    - `problem`: a checked `Problem`.
    - `inputs`: how a row is converted to features and a system.
    - `precision`: the precision of simulation, monitor and gradient.
    - `gradient`: whether to differentiate the smooth robustness.
    - `goals`: the goals of an evaluation by clauses.
    - `guidance`: additional results for a search.
    """

    problem: Problem
    inputs: Inputs
    precision: str
    gradient: bool
    goals: Goals | None
    guidance: Guidance

    def __call__(
        self, row: PyTree, key: Key[Array, ""], temperature: Float[Array, ""], shared: PyTree,
        derivative: Derivative,
    ) -> Row:  # fmt: skip
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
        """Return the coordinates by which the objective is differentiated."""
        return self.inputs.coordinates(row, shared, self.precision)

    def objective(
        self, coordinates: Float[Array, " dim"], row: PyTree, key: Key[Array, ""],
        temperature: Float[Array, ""], shared: PyTree,
    ) -> tuple[Float[Array, "*clauses"], PyTree]:  # fmt: skip
        """Return the differentiated objective, and the results computed with it.

        The objective is the least smooth robustness, or the clauses of the goal nearest to failing.
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
        """Return the row from the derivatives and results of the objective."""
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


SMALL = 16
"""Numbers that a monitor may hold to be worth carrying: one with windows of samples, which it
moves at every step, holds more."""
Monitor = Callable[[PyTree, Key[Array, ""]], tuple[Float[Array, " formulas"], Int[Array, ""]]]
"""A function `(features, key) -> robustness, status`."""


def streaming_monitor(problem: Problem) -> Monitor | None:
    """Return the streaming monitor of a problem; None if streaming does not pay."""
    system = problem.system
    if not system.can_fold or system.dt is None or problem.end != "hold":
        return None
    try:
        monitors = [online(f, system.dt, gaps=False) for f in problem.formulas.values()]
        if sum(monitor.memory for monitor in monitors) > SMALL:
            return None
    except ValueError:
        # It looks ahead without end; or its clock is wrong, which the engine says better.
        return None
    form = problem.form()
    # A part of the state is finite where the last state is, which the status says.
    known_finite, count = ((), None) if form is None else (form.finite, form.length)

    def update(carry: PyTree, sample: Mapping[str, Array]) -> PyTree:
        states, finite = carry
        for name in problem.monitored:
            signal = jnp.asarray(sample[name])
            if name not in known_finite and jnp.issubdtype(signal.dtype, jnp.inexact):
                finite &= jnp.all(jnp.isfinite(signal))
        stepped = [m.step(state, sample) for m, state in zip(monitors, states, strict=True)]
        return tuple(stepped), finite

    def monitor(features: PyTree, key: Key[Array, ""]) -> tuple[Array, Array]:
        start = (tuple(monitor.init() for monitor in monitors), jnp.array(True))
        (states, finite), status = system.fold(features, key, start, update)
        rho = jnp.stack([m.finish(state, count) for m, state in zip(monitors, states, strict=True)])
        return with_status(rho, status, finite)

    return monitor


class _Slot(NamedTuple):
    group: str
    start: int
    shape: tuple[int, ...]
    dtype: Any


class Packing:
    """The positions of a pytree's leaves in one vector per width; known once `pack` is traced."""

    def __init__(self) -> None:
        self._slots: list[_Slot] = []
        self._form: Any = None

    def pack(self, row: PyTree) -> dict[str, Array]:
        """Concatenate the bits of one row's leaves, in one vector for each width."""
        leaves, self._form = jax.tree.flatten(row)
        self._slots, parts, filled = [], {}, {}
        for leaf in map(jnp.asarray, leaves):
            group = f"uint{8 * leaf.dtype.itemsize}"
            start = filled.get(group, 0)
            self._slots.append(_Slot(group, start, leaf.shape, np.dtype(leaf.dtype)))
            bits = leaf.astype(group) if leaf.dtype == bool else leaf.view(group)
            parts.setdefault(group, []).append(bits.ravel())
            filled[group] = start + leaf.size
        return {group: jnp.concatenate(vectors) for group, vectors in parts.items()}

    def unpack(self, packed: dict[str, Array], n: int) -> PyTree:
        """Return the first `n` rows of a batch of packed rows."""
        whole = {group: np.asarray(block)[:n] for group, block in packed.items()}

        def taken(slot: _Slot) -> np.ndarray:
            bits = whole[slot.group][:, slot.start : slot.start + math.prod(slot.shape)]
            return np.ascontiguousarray(bits).view(slot.dtype).reshape(n, *slot.shape)

        return jax.tree.unflatten(self._form, [taken(slot) for slot in self._slots])

"""A system with parameters, simulated in environments: one program for all pairs of both.

    loop = FeatureParameters(problem, ["k_x", "k_theta"])          # parameters are features
    loop = ArrayParameters(problem, weights, system_of)            # parameters are arrays
    loop.evaluate(thetas, environments)  # [k, p] x [n, d] -> [k, n]
    loop.evaluate(thetas, environments, temperature=0.1)  # and d rho / d theta [k, n, p]

Parameters are inputs of the compiled program, so new candidates need no compilation. A pair that
the constraint of the space refuses cannot happen: it is not simulated, and its robustness is
infinite.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from verifai_jax.core.compute.compilation import pad_rows
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.lifting import lifting
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.messages.errors import check_names
from verifai_jax.evaluation.engine import Engine
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.row import Inputs
from verifai_jax.evaluation.verdicts import trace_verdict
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd
ROWS = 64
"""Rows of a table made at a time, so that one shape compiles."""
MAX_DIFFERENTIATED = 64
"""Simulations differentiated at a time by arrays of parameters."""


class Pairs(NamedTuple):
    """Verdicts of `k` parameters in `n` environments each.

    - `rho`: least robustness of the formulas; NaN without a verdict, infinite if the constraint
      refuses the pair.
    - `failing`: whether a formula is broken.
    - `proper`: whether there is a verdict, or the pair is impossible.
    - `by_parameters`, `by_environment`: gradients of the smooth robustness with respect to the
      coordinates, zero where they are not finite; None unless requested.
    """

    rho: Float[np.ndarray, "k n"]
    failing: Bool[np.ndarray, "k n"]
    proper: Bool[np.ndarray, "k n"]
    by_parameters: Float[np.ndarray, "k n p"] | None = None
    by_environment: Float[np.ndarray, "k n d"] | None = None

    def violates(self, margin: float) -> Bool[np.ndarray, "k n"]:
        """Return which pairs break a formula, or keep it by less than this margin."""
        return self.proper & (self.failing | (self.rho < margin))


class FeatureParameters:
    """Some features of a problem as parameters, the others as the environment.

    **Arguments:**
    - `problem`: the problem, on the backend on which it should run.
    - `names`: the names of the features that are parameters; by default all that vary.
    - `batch`: simulations at once.
    - `gradient`: whether gradients may be requested.
    **Raises:** `ValueError` for unknown features, none, or one that does not vary.
    """

    bounded = True

    def __init__(
        self, problem: Problem, names: Sequence[str] | None = None, *, batch: int = 256,
        gradient: bool = True, precision: str = "float32", seed: int = 0,
    ) -> None:  # fmt: skip
        domains = problem.space.domains
        varied = [name for name, domain in domains.items() if domain.size]
        if isinstance(names, str):
            names = [name.strip() for name in names.split(",")]
        names = varied if names is None else list(dict.fromkeys(names))
        if not names:
            raise ValueError(
                f"name at least one parameter, of {', '.join(varied)}"
                if varied
                else f"no feature of problem {problem.name!r} varies"
            )
        check_names("parameter", names, domains)
        for name in names:
            if name not in varied:
                raise ValueError(f"{name} does not vary, so it cannot be chosen")
        self.problem = problem
        self.names = tuple(name for name in domains if name in names)
        sizes = [(name, domain.size) for name, domain in domains.items()]
        owner = np.array([name in names for name, size in sizes for _ in range(size)], bool)
        self.mine, self.theirs = np.flatnonzero(owner), np.flatnonzero(~owner)
        self.dim = len(self.mine)
        # Where there is no environment the constraint speaks of the parameters alone.
        alone = len(self.names) == len(varied)
        of_their_own = FeatureSpace({name: domains[name] for name in self.names})
        self.space = problem.space if alone else of_their_own
        others = {name: d for name, d in domains.items() if name in varied and name not in names}
        self.environment = FeatureSpace(others) if others else None
        self.free = np.array(self.space.levels) == 0
        self.differentiable = gradient and not problem.black_box and bool(self.free.any())
        evaluator = partial(Evaluator, problem, batch, precision=precision, ends_raising=True)
        self._values = evaluator(seed=seed)
        self._slopes = None
        if self.differentiable:
            # Other random numbers than those of the verdicts.
            other = (seed + 1) % 2**63
            self._slopes = evaluator(gradient=True, seed=other)
        self.without_verdict = 0
        self.nominal: dict[str, Any] = {}
        self.start: Float[np.ndarray, " p"] | None = None

    @property
    def simulations(self) -> int:
        """Number of simulations so far; one with its gradient counts as one."""
        return self._values.simulations + (self._slopes.simulations if self._slopes else 0)

    def evaluate(self, thetas: Any, environments: Any, temperature: float | None = None) -> Pairs:
        """Simulate every pair; with a `temperature` also differentiate the smooth robustness."""
        k, n, d = len(thetas), len(environments), self.problem.space.dim
        rows = self._rows(thetas, environments)
        happens = accepted(self.problem.space, rows)
        evaluate = self._values if temperature is None else self._slopes
        assert evaluate is not None
        verdicts = evaluate(rows[happens], 1.0 if temperature is None else temperature)
        self.without_verdict += int(np.sum(~verdicts.proper))
        rho = np.full(k * n, np.inf)
        rho[happens] = np.where(verdicts.proper, verdicts.lowest, np.nan)
        failing, proper = np.zeros(k * n, bool), np.ones(k * n, bool)
        failing[happens], proper[happens] = verdicts.violated, verdicts.proper
        slopes: Any = (None, None)
        if temperature is not None and verdicts.gradient is not None:
            whole = np.zeros((k * n, d))
            whole[happens] = _finite(verdicts.gradient, verdicts.proper)
            whole = whole.reshape(k, n, d)
            slopes = whole[..., self.mine], whole[..., self.theirs]
        return Pairs(*(x.reshape(k, n) for x in (rho, failing, proper)), *slopes)

    def values(self, theta: Float[np.ndarray, " p"]) -> dict[str, Any]:
        """Return the values of the parameters by name, as a user writes them."""
        columns = {c: entries[0] for c, entries in columns_of(self.space, theta[None]).items()}
        values = {name: _plain(self.space[name], name, columns) for name in self.names}
        if self.start is None:
            return values
        moved = np.asarray(theta, np.float32) != self.start.astype(np.float32)
        first = np.cumsum([0, *(self.space[name].size for name in self.names)])
        for name, begin, end in zip(self.names, first, first[1:], strict=False):
            if not moved[begin:end].any():
                values[name] = self.nominal[name]  # Not rounded by the way through the cube.
        return values

    def begin(self, nominal: dict[str, Any]) -> Float[np.ndarray, " p"]:
        """Return coordinates of named values from which `values` recovers them without rounding."""
        ordered = {name: nominal[name] for name in self.names}
        fields = [(self.space[name], value) for name, value in ordered.items()]
        parts = [np.ravel(np.asarray(d.to_unit(d.coerce(value)), float)) for d, value in fields]
        self.nominal, self.start = ordered, np.concatenate(parts)
        return self.start

    def with_parameters(self, theta: Float[np.ndarray, " p"]) -> Problem:
        """Return the problem with these features fixed."""
        return held(self.problem, self.values(theta))

    def happens(self, theta: Any, environments: Any) -> Bool[np.ndarray, " n"]:
        """Return which environments the constraint accepts with these parameters."""
        return accepted(self.problem.space, self._rows(np.asarray(theta)[None], environments))

    def _rows(self, thetas: Any, environments: Any) -> Float[np.ndarray, "kn d"]:
        u = np.empty((len(thetas), len(environments), self.problem.space.dim), np.float32)
        u[..., self.mine] = np.asarray(thetas, np.float32)[:, None, :]
        u[..., self.theirs] = np.asarray(environments, np.float32)[None, :, :]
        return u.reshape(-1, u.shape[-1])


class ArrayParameters:
    """Arrays as parameters, such as the weights of a network; all features are the environment.

    **Arguments:**
    - `problem`: the problem, whose space, formulas and `end` are used with the system of
      `system_of`.
    - `parameters`: a pytree of arrays of real numbers.
    - `system_of(parameters) -> system`: a pure function, traced by JAX.
    - `batch`: simulations at once.
    **Raises:** `TypeError` for leaves that are not real numbers; `ValueError` for a system that JAX
    cannot trace in the parameters.
    """

    bounded = False
    differentiable = True
    space = None

    def __init__(
        self, problem: Problem, parameters: Any, system_of: Callable[[Any], Any], *,
        batch: int = 256, precision: str = "float32", seed: int = 0,
    ) -> None:  # fmt: skip
        from jax.flatten_util import ravel_pytree

        for path, leaf in jax.tree_util.tree_leaves_with_path(parameters):
            if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
                leaf_path = jax.tree_util.keystr(path)
                raise TypeError(
                    f"parameters must be arrays of real numbers; {leaf_path or 'they'} is "
                    f"{jnp.result_type(leaf)}"
                )
        flat, self._restore = ravel_pytree(parameters)
        if not flat.size:
            raise ValueError("parameters contain no number to change")
        self.problem, self.environment = problem, problem.space
        self.start, self.dim = np.asarray(flat, np.float64), int(flat.size)
        self.free = np.ones(self.dim, bool)
        self.system_of, self.batch, self.precision = system_of, batch, precision
        self.simulations = self.without_verdict = 0
        self._key = run_keys(seed)[1]
        self._check()

    def _check(self) -> None:
        features = jax.eval_shape(self.problem.space.unflatten, jnp.zeros(self.problem.space.dim))
        key = jax.eval_shape(lambda: jax.random.key(0))
        if self.with_parameters(self.start).black_box:
            raise ValueError(
                "arrays of parameters are repaired by gradients, which a black box has not; make "
                "the parameters features of the space, and name them"
            )
        theta = jax.ShapeDtypeStruct((self.dim,), jnp.float32)

        def simulated(theta: Array, features: PyTree, key: Array) -> PyTree:
            return trace_verdict(self.problem, self.system_at(theta)(features, key))

        try:
            jax.eval_shape(simulated, theta, features, key)
        except Exception as error:
            raise ValueError(
                "system_of(parameters) must make a system that JAX can trace in the parameters "
                f"(no float(), no NumPy on them); it raised {type(error).__name__}: {error}"
            ) from error

    def evaluate(self, thetas: Any, environments: Any, temperature: float | None = None) -> Pairs:
        """Simulate every pair; with a `temperature` also differentiate the smooth robustness."""
        with in_precision(self.precision):
            parts = [
                self._one(np.asarray(theta, np.float32), environments, temperature)
                for theta in thetas
            ]
        columns: Any = zip(*parts, strict=True)
        stacked: Any = (None if column[0] is None else np.stack(column) for column in columns)
        return Pairs(*stacked)

    def happens(self, theta: Any, environments: Any) -> Bool[np.ndarray, " n"]:
        """Return which environments the constraint accepts."""
        return accepted(self.problem.space, np.asarray(environments, np.float32))

    def _one(self, theta: np.ndarray, environments: Any, temperature: float | None) -> Pairs:
        rows = np.asarray(environments, np.float32)
        space, happens = self.problem.space, self.happens(theta, rows)
        rho, failing = np.full(len(rows), np.inf), np.zeros(len(rows), bool)
        proper = np.ones(len(rows), bool)
        slopes: Any = (None, None)
        if temperature is not None:
            slopes = np.zeros((len(rows), self.dim)), np.zeros((len(rows), space.dim))
        indices = np.flatnonzero(happens)
        engine = self._values if temperature is None else self._gradients
        for start in range(0, len(indices), engine.batch):
            these = indices[start : start + engine.batch]
            verdicts = engine.evaluate(
                rows[these], self._key, self.simulations, temperature or 1.0, shared=theta
            )
            rho[these] = np.where(verdicts.proper, verdicts.lowest, np.nan)
            failing[these], proper[these] = verdicts.violated, verdicts.proper
            if verdicts.gradient is not None:
                usable = _finite(verdicts.gradient, verdicts.proper)
                slopes[0][these], slopes[1][these] = usable[:, : self.dim], usable[:, self.dim :]
            self.simulations += len(these)
            self.without_verdict += int(np.sum(~verdicts.proper))
        return Pairs(rho, failing, proper, *slopes)

    def values(self, theta: Float[np.ndarray, " p"]) -> Any:
        """Return the parameters as a pytree."""
        return self._restore(jnp.asarray(theta, jnp.float32))

    def with_parameters(self, theta: Float[np.ndarray, " p"]) -> Problem:
        """Return the problem with the system for these parameters."""
        return replace(self.problem, system=self.system_of(self.values(theta)))

    def system_at(self, theta: Array) -> Callable[..., Any]:
        """Return the system with these parameters, which JAX may trace."""
        return self.system_of(self._restore(theta))

    @cached_property
    def _values(self) -> Engine:
        return self._engine(self.batch, gradient=False)

    @cached_property
    def _gradients(self) -> Engine:
        # The gradient of each row is kept, which is as long as the parameters.
        return self._engine(min(self.batch, MAX_DIFFERENTIATED), gradient=True)

    def _engine(self, batch: int, gradient: bool) -> Engine:
        precision, inputs = self.precision, _Inputs(self)
        return Engine(self.problem, batch, gradient, precision=precision, inputs=inputs)


class _Inputs(Inputs):
    """The coordinates of the environment, with the arrays, which all rows share, before them."""

    def __init__(self, arrays: ArrayParameters) -> None:
        self.arrays, self.space = arrays, arrays.problem.space
        self.dim = arrays.dim + self.space.dim
        self.row_form = jax.ShapeDtypeStruct((self.space.dim,), jnp.float32)
        self.shared_form = jax.ShapeDtypeStruct((arrays.dim,), jnp.float32)

    def coordinates(self, row: PyTree, shared: PyTree, precision: str) -> Float[Array, " dim"]:
        return jnp.concatenate([shared.astype(precision), row.astype(precision)])

    def simulated(
        self, coordinates: Float[Array, " dim"], row: PyTree, shared: PyTree
    ) -> tuple[PyTree, Callable[..., Any]]:
        theta, u = jnp.split(coordinates, [self.arrays.dim])
        with lifting():
            features = self.space.unflatten(u)
        return features, self.arrays.system_at(theta)


Parametric = FeatureParameters | ArrayParameters


def held(problem: Problem, values: dict[str, Any]) -> Problem:
    """Return the problem with these features fixed, also in its nominal features if it has any."""
    nominal = None if problem.nominal is None else {**problem.nominal, **values}
    return replace(problem, space=problem.space.fixed(**values), nominal=nominal)


def accepted(space: FeatureSpace, rows: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
    """Return which points the constraint of the space accepts."""
    if space.where is None or not len(rows):
        return np.ones(len(rows), bool)
    return np.asarray(space.accepts_points(pad_rows(rows)))[: len(rows)]


def columns_of(space: FeatureSpace, points: Any) -> dict[str, np.ndarray]:
    """Return table columns with the features at points of the space's cube."""
    u = np.asarray(points, np.float32).reshape(len(points), space.dim)
    padded = np.pad(u, ((0, -len(u) % ROWS), (0, 0)), constant_values=0.5)
    parts = [
        space.rows(jax.tree.map(np.asarray, space.features_at(padded[start : start + ROWS])))
        for start in range(0, max(len(padded), 1), ROWS)
        if len(padded)
    ]
    if not parts:
        return {column: np.zeros(0) for column in space.columns}
    whole = {column: np.concatenate([part[column] for part in parts]) for column in parts[0]}
    return {column: entries[: len(u)] for column, entries in whole.items()}


def rows_of(space: FeatureSpace | None, points: Any) -> "pd.DataFrame":
    """Return a table of the features at points of the space's cube."""
    import pandas as pd

    if space is None:
        return pd.DataFrame(index=range(len(points)))
    return pd.DataFrame(columns_of(space, points))


def _plain(domain: Any, name: str, columns: dict[str, Any]) -> Any:
    """Return one feature of a table's row as a person writes it."""
    if name in columns:
        return columns[name].item() if hasattr(columns[name], "item") else columns[name]
    return jax.tree.map(lambda leaf: np.asarray(leaf).tolist(), domain.from_columns(columns, name))


def _finite(gradient: Any, proper: Any) -> Float[np.ndarray, "n d"]:
    usable = proper & np.all(np.isfinite(gradient), axis=1)
    return np.where(usable[:, None], gradient, 0.0)

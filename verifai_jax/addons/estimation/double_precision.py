"""Evaluation of points of the unit cube whose features are computed in double precision.

    evaluate = DoublePrecisionEvaluator(problem, batch=448, precision="float32", seed=0)
    rho, failing, proper = evaluate(u)              # u [n, d], float64

Rare failures lie near the ends of the coordinates, where single precision is too coarse: next to 1
its numbers are multiples of 6e-8. So features are computed from the points in double precision, and
simulated in the precision of the run.
"""

from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.compute.keys import run_keys, simulation_key
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.evaluation.engine import Engine
from verifai_jax.evaluation.evaluator import Evaluator, Sent
from verifai_jax.evaluation.kept_work import present_part
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    from verifai_jax.core.compute.executors import Executor
    from verifai_jax.evaluation.host_engine import HostEngine
    from verifai_jax.evaluation.unfinished import Part
EXACT = 2**24
"""Greatest integer up to which all integers are float32 numbers."""
TEMPERATURE = 1e-3
"""Temperature of the smooth robustness that is differentiated."""
BEYOND = (2.0**-27, 2.0**-32)
"""Two probabilities at which a distribution with an outermost value has the same value."""
LINEAR = (0.05, 0.1, 0.3)
"""Probabilities whose values lie in a line for a uniform feature, and for no symmetric other."""
FLATTENED: Slot[str, Problem] = Slot("flattened features")
"""The problem over plain numbers, by precision."""


class FlattenedFeatures(FeatureSpace):
    """A space whose points are the features themselves, as plain numbers `[size]`."""

    def __init__(self, space: FeatureSpace, precision: str) -> None:
        self.root, self.where = space.root, None
        self._original, self._precision = space, precision
        with in_precision(precision):
            form = jax.eval_shape(space.unflatten, jnp.zeros(space.dim, precision))
        self._leaves, self._tree = jax.tree.flatten(form)
        self._ends = np.cumsum([int(np.prod(leaf.shape)) for leaf in self._leaves])

    def __reduce__(self) -> tuple[Any, ...]:
        # The structure of a pytree is none that every pickler takes.
        return type(self), (self._original, self._precision)

    @property
    def dim(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def unflatten(self, u: Float[Array, " size"]) -> dict[str, Any]:
        parts = jnp.split(u, self._ends[:-1])
        leaves = [
            part.reshape(leaf.shape).astype(
                u.dtype if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf.dtype
            )
            for part, leaf in zip(parts, self._leaves, strict=True)
        ]
        # Features in double precision may have been rounded across an end of their domain.
        return self.root.coerce(jax.tree.unflatten(self._tree, leaves))


class DoublePrecisionEvaluator:
    """An evaluator of points in double precision; see the module's docstring.

    `clamped` `[d]` is True at coordinates whose domain has an outermost value, which no simulation
    exceeds. `uniform` is True at coordinates on which the features depend linearly.

    **Arguments:**
    - `problem`: a checked problem, on the backend on which it should run.
    - `batch`: simulations at once.
    - `precision`: the precision of the simulations, `"float32"` or `"float64"`.
    - `seed`: the seed of the random keys of simulations; as in `falsify`.
    - `executor`: an executor whose workers simulate; this process when left out.
    """

    def __init__(
        self, problem: Problem, batch: int, precision: str, seed: int,
        executor: "Executor | None" = None,
    ) -> None:  # fmt: skip
        space = problem.space
        self._held = max(space.levels, default=0) <= EXACT
        if self._held:
            original = problem
            problem = original.programs.get(
                FLATTENED,
                precision,
                lambda: _with_space(original, FlattenedFeatures(space, precision)),
            )
        self._evaluator = Evaluator(
            problem, batch, precision=precision, seed=seed, executor=executor, ends_raising=True
        )
        self._sends = executor is not None
        self._differentiated: Evaluator | None = None
        self._problem, self._precision, self._seed = problem, precision, seed
        self._numbers = jax.jit(jax.vmap(lambda u: _flat(space.unflatten(u))))
        self._pullback = jax.jit(jax.vmap(lambda u, by_numbers: _pulled(space, u, by_numbers)))
        self._batch = batch
        self.clamped = self._clamped(space)
        self.uniform = self._uniform(space)

    def __call__(
        self, u: Float[np.ndarray, "n d"]
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        verdicts = self._evaluator(self._plain(u))
        return verdicts.lowest, verdicts.violated, verdicts.proper

    def begin(self, u: Float[np.ndarray, "n d"]) -> Sent | None:
        """Send points to the executor's workers, if there is one; results are fetched later."""
        return self._evaluator.begin(self._plain(u)) if self._sends else None

    def gradient(
        self, u: Float[np.ndarray, "n d"]
    ) -> tuple[
        Float[np.ndarray, " n"],
        Bool[np.ndarray, " n"],
        Bool[np.ndarray, " n"],
        Float[np.ndarray, "n d"],
    ]:
        """Evaluate points, and differentiate their robustness with respect to the unit cube.

        It differentiates the smooth robustness at so low a temperature that only ties between
        predicates are smoothed.
        """
        if self._differentiated is None:
            self._differentiated = Evaluator(
                self._problem, self._batch, gradient=True, precision=self._precision,
                seed=self._seed, ends_raising=True,
            )  # fmt: skip
        # Each simulation keeps a random key of its own, by its number.
        first = self._evaluator.simulations
        verdicts = self._differentiated(self._plain(u), TEMPERATURE, first)
        self._evaluator.simulations = first + len(u)
        return verdicts.lowest, verdicts.violated, verdicts.proper, self._by_cube(u, verdicts)

    def held(
        self, u: Float[np.ndarray, "n d"], numbers: Int[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Evaluate points, each with the random key of the earlier simulation with this number."""
        verdicts = self._held_keys(self._plain(u), numbers)
        return verdicts.lowest, verdicts.violated, verdicts.proper

    def gradient_held(
        self, u: Float[np.ndarray, "n d"], numbers: Int[np.ndarray, " n"]
    ) -> tuple[
        Float[np.ndarray, " n"],
        Bool[np.ndarray, " n"],
        Bool[np.ndarray, " n"],
        Float[np.ndarray, "n d"],
    ]:
        """Evaluate points with the random keys of earlier simulations, and differentiate."""
        verdicts = self._held_slopes(self._plain(u), numbers, TEMPERATURE)
        return verdicts.lowest, verdicts.violated, verdicts.proper, self._by_cube(u, verdicts)

    @cached_property
    def _held_keys(self) -> "HeldKeys":
        return HeldKeys(self._problem, self._batch, self._precision, self._seed)

    @cached_property
    def _held_slopes(self) -> "HeldKeys":
        return HeldKeys(self._problem, self._batch, self._precision, self._seed, gradient=True)

    def _padded(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "padded d"]:
        return np.pad(u, ((0, -len(u) % self._batch), (0, 0)), mode="edge")

    def _plain(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n numbers"]:
        """Return the plain numbers of points; the points themselves where they are not held."""
        if not self._held:
            return u
        with in_precision("float64"):
            return np.asarray(self._numbers(self._padded(u)))[: len(u)]

    def _by_cube(self, u: Float[np.ndarray, "n d"], verdicts: Verdicts) -> Float[Any, "n d"]:
        """Return the derivatives by the coordinates of the cube."""
        assert verdicts.gradient is not None
        slopes = np.asarray(verdicts.gradient, np.float64)
        if self._held:
            padded = self._padded(u)
            slopes = np.pad(slopes, ((0, len(padded) - len(u)), (0, 0)))
            with in_precision("float64"):
                slopes = np.asarray(self._pullback(padded, slopes))[: len(u)]
        return slopes

    def compile(self) -> None:
        """Compile the program of a batch now."""
        self._evaluator.compile()

    def _clamped(self, space: FeatureSpace) -> Bool[np.ndarray, " d"]:
        if not self._held:
            return np.ones(space.dim, bool)
        low, high = (self._moved(space, value) for value in BEYOND)
        return np.all(low == high, axis=1) & (np.array(space.levels) == 0)

    def _uniform(self, space: FeatureSpace) -> Bool[np.ndarray, " d"]:
        if not self._held:
            return np.zeros(space.dim, bool)
        begin, between, end = (self._moved(space, value) for value in LINEAR)
        share = (LINEAR[1] - LINEAR[0]) / (LINEAR[2] - LINEAR[0])
        step = end - begin
        straight = np.abs(between - begin - share * step) <= 1e-6 * np.abs(step)
        return np.all(straight, axis=1) & np.any(step != 0, axis=1) & (np.array(space.levels) == 0)

    def _moved(self, space: FeatureSpace, value: float) -> Float[np.ndarray, "d n"]:
        """Return the plain numbers of points in the middle but for one coordinate each."""
        points = np.full((space.dim, space.dim), 0.5)
        np.fill_diagonal(points, value)
        with in_precision("float64"):
            return np.asarray(self._numbers(points))


class HeldKeys:
    """An evaluator of points with the random keys of earlier simulations, given by their numbers.

    **Arguments:** those of `Evaluator`.
    """

    def __init__(
        self, problem: Problem, batch: int, precision: str, seed: int, *, gradient: bool = False
    ) -> None:
        self.batch, self.precision, self.problem = batch, precision, problem
        self._mode = ("held keys", precision, gradient, seed)
        self._kept: Part | None = None
        self._keys = jax.jit(jax.vmap(partial(simulation_key, run_keys(seed)[1])))
        self._engine: Engine | HostEngine
        if problem.black_box:
            from verifai_jax.evaluation import host_engine

            self._engine = host_engine.HostEngine(problem, precision)
            self._features = jax.jit(jax.vmap(problem.space.unflatten))
        else:
            self._engine = Engine(
                problem, batch, gradient, precision=precision, own_keys=True, effort="little"
            )

    def __call__(
        self, points: Float[np.ndarray, "n d"], numbers: Int[np.ndarray, " n"], *temperature: float
    ) -> Verdicts:
        """Simulate points with the keys of these numbers."""
        return Verdicts.concatenate(
            [
                self._block(points[i : i + self.batch], numbers[i : i + self.batch], *temperature)
                for i in range(0, len(points), self.batch)
            ]
        )

    def _block(self, points: Any, numbers: Any, temperature: float = 1.0) -> Verdicts:
        simulate = partial(self._simulated, points, numbers, temperature)
        self._kept = kept = present_part(self._kept, self.problem, *self._mode)
        if kept is None:
            return simulate()
        return kept.recall_or(points, numbers, temperature, simulate)

    def _simulated(self, points: Any, numbers: Any, temperature: float) -> Verdicts:
        count, size = len(points), self.batch
        numbers = np.pad(numbers, (0, size - count), mode="edge").astype(np.int32)
        keys = self._keys(numbers)
        points = np.asarray(points, np.float32)
        if isinstance(self._engine, Engine):
            return self._engine.evaluate(points, keys[:count], temperature=temperature)
        with in_precision(self.precision):
            padded = np.pad(points, ((0, size - count), (0, 0)), mode="edge")
            features = jax.tree.map(
                lambda leaf: np.asarray(leaf)[:count], self._features(padded.astype(self.precision))
            )
            seeds = np.asarray(jax.vmap(jax.random.bits)(keys))[:count]
        return self._engine.evaluate_features(features, seeds, keys[:count])


def _flat(features: Any) -> Array:
    leaves = [jnp.ravel(leaf).astype(jnp.float64) for leaf in jax.tree.leaves(features)]
    return jnp.concatenate(leaves) if leaves else jnp.zeros(0)


def _pulled(space: FeatureSpace, u: Array, by_numbers: Array) -> Array:
    """Return derivatives by the coordinates from those by the plain numbers."""
    numbers, pull = jax.vjp(lambda point: _flat(space.unflatten(point)), u)
    return pull(by_numbers.astype(numbers.dtype))[0]


def _with_space(problem: Problem, space: FeatureSpace) -> Problem:
    from dataclasses import replace

    return replace(problem, space=space, nominal=None)

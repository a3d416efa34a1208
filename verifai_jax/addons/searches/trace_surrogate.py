"""Search on a model of the traces, for simulators that take seconds.

A simulation has only one robustness, but its trace has thousands of numbers. For slow simulations
this search learns a model of the traces (`trace_model`), and monitors it in place of the system.
Each proposal comes from a simulator drawn from the model's posterior: many points are monitored on
it, and gradient descents on the smooth robustness start from the best, all in one batch. If the
model is certain of a failure, all proposals go there; otherwise they differ according to its
uncertainty (Thompson sampling). The real system decides the verdict of each. The loop provides the
traces; without them the search is `TuRBO`. Some points always come from `TuRBO`, in case the model
is wrong.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.addons.searches import trace_model as models
from verifai_jax.addons.searches.moves import near_others
from verifai_jax.addons.searches.process_data import snap
from verifai_jax.addons.searches.trace_form import TraceForm, signals_of
from verifai_jax.addons.searches.turbo import TuRBO, TuRBOState
from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.values.cube import Cube
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.mtl import hard, smooth
from verifai_jax.mtl.clauses import goals_of
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.semantics import Semantics
from verifai_jax.problem.problem import Problem
from verifai_jax.search.base import Wants, check_options
from verifai_jax.search.draws import draw_uniform
from verifai_jax.search.wrapper import Wrapper

POOL = 512
"""Points that are monitored on each drawn simulator, before the best ones descend."""
PARENTS = 8
"""Number of best rows; half of the pool lies around them."""
NEIGHBOUR = 0.1
"""Maximum distance of neighbours, in the maximum norm."""
MIN_ROWS = 64
"""Minimum size of programs in rows; each further size is four times the last."""
RATE = (0.1, 0.01)
"""First and last step of a descent, in cubes."""
TEMPERATURES = (0.3, 0.02)
"""First and last temperature of the smooth robustness, without unit."""
MEANS = 6
"""Of so many proposals one is the model's own guess, the mean of its posterior; where all are, a
model that is wrong is not left."""
APART = 1e-3
"""Distance in the maximum norm below which two points count as the same."""
MAX_BATCH = 8
"""Points in a round by default: in rounds of eight it was compared with other searches
(`benchmarks/RESULTS.md`, "Slow black boxes")."""


@dataclass(frozen=True)
class TraceSurrogate(Wrapper[TuRBOState]):
    """A model of the traces on which searches descend; real simulations decide.

    **Arguments:**
    - `initial`: number of points of the prior before the model proposes any.
    - `share`: share of the points that the model proposes; `TuRBO` proposes the others.
    - `capacity`: maximum number of rows in the model: the best half and the latest ones.
    - `starts`: number of descents for each proposal; the best one is simulated.
    - `steps`: number of steps of a descent.
    **Raises:** `ValueError` for values out of range.
    """

    initial: int = 8
    share: float = 0.75
    capacity: int = 512
    starts: int = 16
    steps: int = 40

    _internal = frozenset(("trace_model",))

    def __post_init__(self) -> None:
        check_options(self, {"initial": 2, "capacity": 16, "starts": 1, "steps": 1}, ["share"])

    @property
    def search(self) -> TuRBO:
        """The search that is used without traces."""
        return TuRBO(initial=self.initial, capacity=self.capacity)

    @property
    def fallback(self) -> TuRBO:
        return self.search

    @property
    def wants(self) -> Wants:
        return replace(self.search.wants, traces=self, max_batch=MAX_BATCH)

    def trace_model(self, problem: Problem, key: Key[Array, ""]) -> "Surrogate":
        """Return a model of the traces of a problem, without rows."""
        return Surrogate(problem, self, key)


class Surrogate:
    """The rows of a run with their traces, and proposals from a model of them.

    **Arguments:**
    - `problem`: the problem of the run, whose monitored signals are modelled.
    - `options`: the options of the model and of the descents on it.
    - `key`: the key of its random numbers.
    """

    def __init__(self, problem: Problem, options: TraceSurrogate, key: Key[Array, ""]) -> None:
        self.problem, self.options = problem, options
        self.cube = problem.space.cube
        self.key = jax.random.fold_in(key, 0x7ACE)
        self.form: TraceForm | None = None
        self.u = np.zeros((0, self.cube.dim), np.float32)
        self.traces = np.zeros((0, 0), np.float32)
        self.rho = np.zeros(0, np.float32)
        self.round = self.fitted = 0
        self.hyper = models.first_hyper(models.width_of(self.cube))
        self._programs = problem.programs.get(DESCENTS, options, lambda: Descents(problem, options))

    def learn(self, u: Float[Any, "n d"], verdicts: Verdicts) -> None:
        """Keep rows with a verdict and a trace of the same form as the others."""
        proper = verdicts.proper & np.isfinite(verdicts.lowest)
        given = [
            (i, trace)
            for i, trace in enumerate(verdicts.traces or [])
            if trace is not None and proper[i]
        ]
        for _, trace in given:
            self._extend(trace)
        form = self.form
        if form is None:
            return
        given = [(i, trace) for i, trace in given if form.fits(trace)]
        if not given:
            return
        rows = np.array([i for i, _ in given])
        flat = np.stack([form.flat(trace) for _, trace in given])
        finite = np.all(np.isfinite(flat), axis=1)
        self.u = np.concatenate([self.u, np.asarray(u, np.float32)[rows][finite]])
        # Without rows there is no width yet.
        before = self.traces if len(self.traces) else flat[:0]
        self.traces = np.concatenate([before, flat[finite]])
        lowest = verdicts.lowest[rows][finite].astype(np.float32)
        self.rho = np.concatenate([self.rho, lowest])
        self._forget()

    def improve(self, points: Float[Any, "batch d"]) -> Float[Any, "batch d"]:
        """Replace the model's share of the proposed points."""
        before, after = (
            round(self.options.share * number * len(points))
            for number in (self.round, self.round + 1)
        )
        self.round += 1
        count, guess = after - before, after // MEANS > before // MEANS
        enough = len(self.rho) >= self.options.initial and self.cube.dim > 0
        if not enough or count == 0 or np.ptp(self.traces, axis=0).max() == 0:
            return points
        proposed = self._proposals(count, guess)
        return np.concatenate([proposed, np.asarray(points)[len(proposed) :]])

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Return the state that determines the next proposals; its arrays are never modified."""
        form = self.form
        signals = () if form is None else form.signals
        return {
            "surrogate.u": self.u,
            "surrogate.traces": self.traces,
            "surrogate.rho": self.rho,
            "surrogate.counts": np.array([self.round, self.fitted], np.int64),
            "surrogate.signals": np.array([name for name, _ in signals], "U"),
            "surrogate.components": np.array([width for _, width in signals], np.int64),
            "surrogate.clock": np.array(
                [0, 0] if form is None else [form.dt, form.length], np.float64
            ),
            **{f"surrogate.{n}": np.asarray(v) for n, v in self.hyper._asdict().items()},
        }

    def restore(self, checkpoint: Mapping[str, Any]) -> None:
        """Continue from a checkpoint; one without a surrogate gives an empty model."""
        if "surrogate.u" not in checkpoint:
            return
        self.u, self.traces, self.rho = (
            np.asarray(checkpoint[f"surrogate.{name}"]) for name in ("u", "traces", "rho")
        )
        self.round, self.fitted = (int(n) for n in checkpoint["surrogate.counts"])
        dt, length = checkpoint["surrogate.clock"]
        names, widths = checkpoint["surrogate.signals"], checkpoint["surrogate.components"]
        if length:
            signals = tuple((str(n), int(w)) for n, w in zip(names, widths, strict=True))
            self.form = self._form(signals, float(dt), int(length))
        self.hyper = models.TraceHyper(
            *(jnp.asarray(checkpoint[f"surrogate.{n}"]) for n in self.hyper._fields)
        )

    def _form(self, signals: tuple[tuple[str, int], ...], dt: float, length: int) -> TraceForm:
        return TraceForm.of(signals, dt, length, self.problem.formulas.values())

    def _extend(self, trace: Trace) -> None:
        """Take the form of the first trace, and of a longer one that comes later."""
        if self.form is None:
            assert trace.dt is not None
            signals = signals_of(trace, sorted(self.problem.monitored))
            self.form = self._form(signals, float(trace.dt), trace.length)
        elif trace.length > self.form.length and self.form.fits(trace):
            before = self.form
            self.form = self._form(before.signals, before.dt, trace.length)
            whole = [np.asarray(before.held(row)) for row in self.traces]
            here = np.minimum(self.form.positions, before.length - 1)
            own = np.arange(before.length)
            each = [np.concatenate([np.interp(here, own, c) for c in row]) for row in whole]
            empty = np.zeros((0, 0), np.float32)
            self.traces = np.stack(each).astype(np.float32) if each else empty

    def _forget(self) -> None:
        """Reduce the rows to the capacity: the best rows for one half, the latest for the other."""
        extra = len(self.rho) - self.options.capacity
        if extra <= 0:
            return
        best = np.argsort(self.rho, kind="stable")[: self.options.capacity // 2]
        spare = np.setdiff1d(np.arange(len(self.rho)), best)[:extra]
        kept = np.setdiff1d(np.arange(len(self.rho)), spare)
        self.u, self.traces, self.rho = self.u[kept], self.traces[kept], self.rho[kept]

    def _proposals(self, count: int, guess: bool) -> Float[np.ndarray, "m d"]:
        """Return this number of different points, or fewer if there are no more.

        - `guess`: whether the first point is from the posterior's mean.
        """
        form = self.form
        assert form is not None
        # Signals count alike, whatever their unit.
        grouped = self.traces.reshape(len(self.traces), -1, len(form.positions))
        scale = np.std(grouped, axis=(0, 2))
        scale = np.repeat(np.where(scale > 0, scale, 1.0), len(form.positions)).astype(np.float32)
        mean, components = models.principal_components(self.traces / scale)
        coefficients = ((self.traces / scale - mean) @ components.T).astype(np.float32)
        size = padded_rows(len(self.rho), self.options.capacity)
        missing = size - len(self.rho)
        coefficients = np.pad(coefficients, ((0, missing), (0, 0)))
        u = np.pad(self.u, ((0, missing), (0, 0)), constant_values=0.5)
        mask = np.arange(size) < len(self.rho)
        if 4 * (len(self.rho) - self.fitted) >= self.fitted:
            self.hyper = self._programs.fit(self.hyper, u, mask, coefficients)
            self.fitted = len(self.rho)
        parents = np.resize(self._parents(), (PARENTS, self.cube.dim))
        key = jax.random.fold_in(self.key, np.uint32(self.round))
        spread = np.float32(models.spread_factor(self.rho, self.round, self.cube.dim))
        ends, value = self._programs.descend(
            form, count, self.hyper, u, mask, coefficients, mean * scale, components * scale,
            parents, key, np.bool_(guess), spread,
        )  # fmt: skip
        return self._distinct(np.asarray(ends), np.asarray(value))

    def _parents(self) -> Float[np.ndarray, "parents d"]:
        """Return the best rows that are not close neighbours, so that not all share one minimum."""
        chosen = np.zeros((0, self.cube.dim), np.float32)
        for point in self.u[np.argsort(self.rho, kind="stable")]:
            if np.all(np.max(np.abs(chosen - point), axis=1) > NEIGHBOUR):
                chosen = np.concatenate([chosen, point[None]])
                if len(chosen) == PARENTS:
                    break
        return chosen

    def _distinct(
        self, u: Float[np.ndarray, "draws starts d"], value: Float[np.ndarray, "draws starts"]
    ) -> Float[np.ndarray, "m d"]:
        """Return the best point of each draw that is neither simulated nor proposed."""
        taken, chosen = self.u, []
        for points, values in zip(u, value, strict=True):
            for i in np.argsort(values, kind="stable"):
                near = np.max(np.abs(taken - points[i]), axis=1, initial=0.0) < APART
                if not near.any():
                    chosen.append(points[i])
                    taken = np.concatenate([taken, points[i][None]])
                    break
        return np.array(chosen, np.float32).reshape(-1, self.cube.dim)


class Descents:
    """The compiled programs of a problem: the fit, and descents on simulators drawn from it."""

    def __init__(self, problem: Problem, options: TraceSurrogate) -> None:
        self.end: End = problem.end
        self.options, self.cube = options, problem.space.cube
        self.goals = goals_of(problem.formulas.values())
        # Rows become what the model takes inside of the programs: outside each operation would
        # compile a program for each number of rows.
        cube = self.cube
        self.fit = jax.jit(lambda hyper, u, *rest: models.fit(hyper, models.embed(u, cube), *rest))
        self.descend: Any = jax.jit(self._descend, static_argnums=(0, 1))

    def _descend(
        self,
        form: TraceForm,
        count: int,
        hyper: models.TraceHyper,
        u: Float[Array, "n d"],
        mask: Array,
        coefficients: Float[Array, "n c"],
        mean: Float[Array, " values"],
        components: Float[Array, "c values"],
        parents: Float[Array, "parents d"],
        key: Key[Array, ""],
        guess: Bool[Array, ""],
        spread: Float[Array, ""],
    ) -> tuple[Float[Array, "count starts d"], Float[Array, "count starts"]]:
        """Return the end points of the descents on `count` drawn simulators, and their values."""
        cube = self.cube
        x = models.embed(u, cube)
        model = models.condition(hyper, x, mask, coefficients, mean, components)
        drawing, placing = jax.random.split(key)
        waves, weights = models.draw(model, drawing, count, guess, spread)
        pool = _pool(placing, parents, cube)

        def values(
            u: Float[Array, "m d"], weights: Float[Array, "terms c"], semantics: Semantics
        ) -> Float[Array, " m"]:
            terms = models.basis(model, waves, models.embed(u, cube))
            flat = model.decode(terms @ weights)
            return jax.vmap(lambda row: self._value(form.trace(row), semantics))(flat)

        def slope(u: Array, weights: Array, tau: Array) -> Float[Array, "m d"]:
            gradient = jax.grad(lambda u: jnp.sum(values(u, weights, smooth(tau))))(u)
            return jnp.where(jnp.isfinite(gradient), gradient, 0.0)

        def one(weights: Float[Array, "terms c"]) -> tuple[Array, Array]:
            lowest, index = jax.lax.top_k(
                -_number(values(pool, weights, hard)), self.options.starts
            )
            start = pool[index]

            def step(carry: tuple, part: Array) -> tuple:
                u, first, second, best, lowest = carry
                tau = TEMPERATURES[0] * (TEMPERATURES[1] / TEMPERATURES[0]) ** part
                gradient = slope(u, weights, tau)
                # A common size for all coordinates of a point keeps its direction.
                first = 0.8 * first + 0.2 * gradient
                second = 0.9 * second + 0.1 * gradient**2
                size = RATE[0] * (RATE[1] / RATE[0]) ** part
                moved = jnp.clip(u - size * first / (jnp.sqrt(second) + 1e-9), 0.0, 1.0)
                u = moved.at[:, cube.discrete].set(u[:, cube.discrete])
                value = _number(values(u, weights, hard))
                better = value < lowest
                best = jnp.where(better[:, None], u, best)
                return (u, first, second, best, jnp.where(better, value, lowest)), None

            zero = jnp.zeros_like(start)
            parts = jnp.linspace(0.0, 1.0, self.options.steps)
            (_, _, _, best, value), _ = jax.lax.scan(
                step, (start, zero, zero, start, -lowest), parts
            )
            return best, value

        return jax.lax.map(one, weights)

    def _value(self, trace: Trace, semantics: Semantics) -> Float[Array, ""]:
        """Return the least value over the goals, each a set of clauses to break together."""
        clauses = self.goals.values(trace, semantics, self.end)
        return jnp.min(jnp.max(clauses, axis=1))


DESCENTS: Slot[TraceSurrogate, Descents] = Slot("descents on a model of the traces")
"""The programs of a problem for its surrogates, by their options."""


def _number(value: Float[Array, " m"]) -> Float[Array, " m"]:
    return jnp.where(jnp.isfinite(value), value, jnp.inf)


def padded_rows(rows: int, capacity: int) -> int:
    """Return the padded size, from few that each compile once, for a number of rows."""
    size = MIN_ROWS
    while size < rows:
        size *= 4
    return min(size, capacity)


def _pool(
    key: Key[Array, ""], parents: Float[Array, "parents d"], cube: Cube
) -> Float[Array, "pool d"]:
    """Return points of the prior, corners among them, and points around the best rows."""
    d = cube.dim
    random = draw_uniform(key, (POOL, 2 * d + 2))
    half = POOL // 2
    fresh = random[:half, :d]
    # Failures lie in corners more often than not.
    fresh = jnp.where(jnp.arange(half)[:, None] % 2 == 0, fresh, jnp.round(fresh))
    rest = random[half:]
    rest = rest[:, np.r_[0, 2 * d + 1, 2 * d, d : 2 * d, :d]]
    near = near_others(parents[jnp.arange(half) % PARENTS], rest, cube, jnp.array([0.5, 0.025]))
    return snap(jnp.concatenate([fresh, near]), cube)

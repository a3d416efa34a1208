"""The least departure from nominal that still fails: a counterexample made small.

    small = shrink(run)                                 # from the worst row
    small = shrink(run, 17, by="small", budget=5000)
    print(small); small.features; small.replay().plot()

As a property-testing library does with its failing example: first few features, then small values
(MacIver and Donaldson, Test-case reduction via test-case generation, ECOOP 2020), with batches,
and with gradients where there are some.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.backends import resolved
from verifai_jax.counterexample.departure import Nominal
from verifai_jax.counterexample.few import fewest
from verifai_jax.counterexample.judge import Judge
from verifai_jax.counterexample.keyed import with_key_of
from verifai_jax.counterexample.small import nearest
from verifai_jax.errors import suggests_options, unknown_name
from verifai_jax.problem import Problem
from verifai_jax.proposals import units
from verifai_jax.run import Replay, Run, replay, run_keys

ORDERS = ("few", "small")
STARTS = 32
"""Other counterexamples of the run that are looked at,"""
FOLLOWED = 5
"""and points that are followed along the boundary."""


class Step(NamedTuple):
    """What was known after so many simulations: departing coordinates, and their distance."""

    simulations: int
    count: int
    distance: float


@dataclass(frozen=True, eq=False)
class Shrunk:
    """The least departure from nominal that was found to fail.

    **Fields:** `features` and `u` `[d]`, their point of the unit cube; `rho`: their robustness, the
    margin by which they fail; `row`: of the run, at which it began; `changed`: what departs, by
    name of coordinate: `(nominal, value)`; `count`: how many; `distance`: Euclidean, in unit
    coordinates; `start_count` and `start_distance` of the row; `simulations` spent; `history`;
    `by`: what was made least first; `notes` for people.
    """

    problem: Problem
    row: int
    features: dict[str, Any]
    u: Float[np.ndarray, " d"]
    rho: float
    changed: dict[str, tuple[Any, Any]]
    distance: float
    start_count: int
    start_distance: float
    simulations: int
    by: str
    precision: str
    history: tuple[Step, ...]
    notes: tuple[str, ...] = ()
    key: Key[Array, ""] | None = field(default=None, repr=False)

    @property
    def count(self) -> int:
        """How many coordinates are not nominal."""
        return len(self.changed)

    def replay(self, precision: str | None = None) -> Replay:
        """Simulate it again, with the random key of the row, and keep the trace."""
        columns = _columns(self.problem, self.u)
        return replay(self.problem, columns, self.key, self.row, precision or self.precision)  # pyright: ignore[reportArgumentType]

    def plot(self, path: Any = None) -> Any:
        """Draw what departs, and the signals of the simulation; returns the figure."""
        from verifai_jax.counterexample.picture import draw_shrunk

        return draw_shrunk(self, path)

    def __str__(self) -> str:
        d = len(self.u)
        name = self.problem.name
        if not self.count:
            lines = [
                f"{name}: the nominal features fail themselves, with robustness {self.rho:.4g}; "
                "there is nothing to shrink"
            ]
        else:
            lines = [
                f"{name}: {_of(self.count, d)} away from nominal "
                f"{'is' if self.count == 1 else 'are'} enough for a failure, by "
                f"{self.distance:.3g} of {'its' if self.count == 1 else 'their'} range "
                f"(robustness {self.rho:.3g})"
            ]
            width = max(map(len, self.changed))
            lines += [
                f"  {name:<{width}}  {_shown(was)} -> {_shown(now)}"
                for name, (was, now) in self.changed.items()
            ]
        lines.append(
            f"  row {self.row} departed in {_of(self.start_count, d)}, by "
            f"{self.start_distance:.3g}; {self.simulations} simulations"
        )
        lines += [f"  note: {note}" for note in self.notes]
        return "\n".join(lines)

    __repr__ = __str__


@suggests_options
def shrink(
    run: Run,
    row: Any = None,
    *,
    nominal: Mapping[str, Any] | None = None,
    by: str = "few",
    budget: int = 2000,
    seed: int = 0,
    others: bool = True,
) -> Shrunk:
    """The least departure from the nominal features that still fails.

    **Arguments:**

    - `run`: a run of a problem, with a counterexample.
    - `row`: the number of one, or a row of the table; the worst when left out.
    - `nominal`: features that are ordinary, where the problem does not say or others are meant.
    - `by`: `"few"`: first the fewest coordinates that are not exactly nominal, then, with so many,
      the least distance; `"small"`: the least distance, whatever their number. The distance is
      Euclidean in unit coordinates, of which each is 1 over its whole range (by probability, for a
      distribution), between two choices 1, and by places in integers. Every control point of a
      signal and every component of a vector is a coordinate of its own.
    - `budget`: simulations at most; a gradient counts as one.
    - `seed`: of the random candidates.
    - `others`: whether other counterexamples of the run may be taken where they are nearer.

    All simulations have the random key of the row. The result was simulated alone, in the
    precision of the run, and failed. Ctrl-C ends the search and returns the least so far.

    **Raises:** `ValueError` for a run without its problem or without a counterexample, a row that
    is none or does not fail when simulated again, a feature without a nominal value.
    """
    problem = _problem(run)
    if by not in ORDERS:
        raise unknown_name("order", by, ORDERS)
    if isinstance(budget, bool) or not isinstance(budget, int | np.integer) or budget < 1:
        raise ValueError(f"budget must be an integer of at least 1; got {budget!r}")
    number, first = _row(run, row)
    at = Nominal.of(problem, nominal)
    problem = with_key_of(problem, run, number)
    key = run_keys(run.seed)[1]
    seen = replay(problem, first, key, number, run.precision)
    if not seen.violated:
        told = f"robustness {min(seen.rho.values()):.4g}" if seen.status == 0 else seen.status.name
        raise ValueError(
            f"row {number} of the run of {run.name!r} does not fail when it is simulated again "
            f"({told}); see what confirm says of it, and shrink another"
        )
    judge = Judge(problem, at, int(budget), run.precision)
    shrinking = _Shrinking(judge, by, np.random.default_rng(seed))
    start = at.settle(
        np.asarray(jax.jit(problem.space.flatten)(problem.space.from_row(first)))[None]
    )
    points = np.concatenate([start, _others(run, at, number)]) if others else start
    notes = []
    try:
        shrinking.search(points)
    except KeyboardInterrupt:
        notes.append("interrupted: the least so far")
    found = _verified(problem, shrinking, key, number, run.precision, notes)
    u = start[0] if found is None else found[0]
    replayed = seen if found is None else found[1]
    if judge.note:
        notes.append(judge.note)
    return Shrunk(
        problem=problem,
        row=number,
        features=replayed.features,
        u=u,
        rho=min(replayed.rho.values()),
        changed=_changed(at, u),
        distance=float(at.distance(u[None])[0]),
        start_count=int(at.count(start)[0]),
        start_distance=float(at.distance(start)[0]),
        simulations=judge.simulations,
        by=by,
        precision=run.precision,
        history=tuple(shrinking.history),
        notes=tuple(notes),
        key=key,
    )


class _Shrinking:
    """The order of things: what is few, what is near, and whether another mode is nearer."""

    def __init__(self, judge: Judge, by: str, rng: np.random.Generator) -> None:
        self.judge, self.by, self.rng = judge, by, rng
        self.history: list[Step] = []

    def order(self, points: Float[np.ndarray, "n d"]) -> np.ndarray:
        """Which come first."""
        count, length = self.judge.nominal.count(points), self.judge.nominal.distance(points)
        if self.by == "few":
            return np.lexsort((length, count))
        return np.lexsort((count, length))

    def failures(self) -> Float[np.ndarray, "n d"]:
        """All failing points so far, the least first."""
        points = self.judge.points[self.judge.failing]
        return points[self.order(points)]

    def note(self) -> None:
        points = self.failures()[:1]
        if len(points):
            nominal = self.judge.nominal
            step = (int(nominal.count(points)[0]), float(nominal.distance(points)[0]))
            if not self.history or self.history[-1][1:] != step:
                self.history.append(Step(self.judge.simulations, *step))

    def search(self, points: Float[np.ndarray, "n d"]) -> None:
        """Spend the budget; what is found is in `judge`."""
        judge, nominal = self.judge, self.judge.nominal
        rho, _ = judge(np.concatenate([nominal.u[None], points]))
        self.note()
        failures = self.failures()
        if not len(failures) or not nominal.count(failures[:1])[0]:
            return
        spread = [abs(r) for r in rho if math.isfinite(r)]
        # Smooth enough for a slope where several instants compete, and near the hard value.
        judge.temperature = max(0.02 * max(spread, default=1.0), 1e-6)
        if self.by == "few":
            # Half for the number of features, so that some is left for the distance.
            judge.limit = judge.budget // 2
            fewest(judge, failures[:4], self.rng)
            judge.limit = judge.budget
            self.note()
        self.follow(self.starts())
        for _ in range(3):
            if judge.left < judge.budget // 20:
                break
            before = self.failures()[0]
            elsewhere(judge, before, self.by == "few", self.rng)
            self.note()
            if np.array_equal(self.failures()[0], before):
                continue
            self.follow(self.failures()[:1])

    def starts(self) -> Float[np.ndarray, "n d"]:
        """The least failures in different directions, or on different features."""
        failures, nominal = self.failures(), self.judge.nominal
        count = nominal.count(failures)
        if self.by == "few":
            failures = failures[count == count[0]]
        chosen = [failures[0]]
        for u in failures[1:]:
            if len(chosen) >= FOLLOWED:
                break
            v = u - nominal.u
            ways = [w - nominal.u for w in chosen]
            if all(v @ w < 0.7 * np.linalg.norm(v) * np.linalg.norm(w) for w in ways):
                chosen.append(u)
        return np.array(chosen)

    def follow(self, starts: Float[np.ndarray, "n d"]) -> None:
        nearest(self.judge, starts, self.rng, few=self.by == "few")
        self.note()


def elsewhere(judge: Judge, u: Float[np.ndarray, " d"], few: bool, rng: Any) -> None:
    """Look for a failure nearer than `u` in other directions, with no more departures if `few`."""
    nominal = judge.nominal
    d = nominal.space.dim
    free = np.flatnonzero(np.array(nominal.cube.levels) == 0)
    most = min(int(nominal.count(u[None])[0]), len(free)) if few else len(free)
    reach = float(nominal.distance(u[None])[0])
    if not most:
        return
    near = np.zeros((0, d))
    for turn in range(4):
        n = 48
        moved = np.zeros((n, d))
        for row in moved:
            places = rng.permutation(free)[:most]
            row[places] = rng.standard_normal(most)
        if turn and len(near):
            # Around what came nearest to failing, on the same coordinates.
            parents = near[rng.integers(len(near), size=n)] - nominal.u
            step = 0.35 * 0.6**turn * reach
            moved = parents + step * moved / np.maximum(
                np.linalg.norm(moved, axis=1, keepdims=True), 1e-9
            ) * (parents != 0)
            length = np.linalg.norm(moved, axis=1, keepdims=True)
            moved *= np.minimum(1, 0.98 * reach / np.maximum(length, 1e-9))
        else:
            length = np.linalg.norm(moved, axis=1, keepdims=True)
            moved *= reach * rng.uniform(0.3, 0.98, (n, 1)) / np.maximum(length, 1e-9)
        points = nominal.settle(nominal.u + moved)
        rho, failing = judge(points)
        if failing.any() or judge.left <= 0:
            return
        near = points[np.argsort(rho)[:8]].astype(np.float64)


def _verified(
    problem: Problem, shrinking: _Shrinking, key: Any, number: int, precision: str, notes: list[str]
) -> tuple[np.ndarray, Replay] | None:
    """The least failure that fails alone too; None where none does."""
    failures = shrinking.failures()
    for i, u in enumerate(failures[:50]):
        again = replay(problem, _columns(problem, u), key, number, precision)
        if again.violated:
            if i:
                notes.append(f"{i} smaller ones fail in a batch and not alone: too near to zero")
            return u, again
    return None


def _problem(run: Any) -> Problem:
    if not isinstance(run, Run):
        raise TypeError(f"a run of falsify is needed; got {type(run).__name__}")
    if run.problem is None:
        raise ValueError(
            f"the run of {run.name!r} was loaded without its problem; "
            "give it: vj.load(path, problem)"
        )
    return resolved(run.problem, wanted=run.backend).problem


def _row(run: Run, row: Any) -> tuple[int, Any]:
    """The number and the entries of a counterexample.

    **Raises:** `ValueError` where there is none, or this is none.
    """
    failing = run.table.counterexamples
    if not len(failing):
        raise ValueError(
            f"the run of {run.name!r} has no counterexample in {run.simulations} simulations"
        )
    number = failing["rho"].idxmin() if row is None else getattr(row, "name", row)
    if isinstance(number, bool) or not isinstance(number, int | np.integer):
        raise TypeError(f"row must be the number of a row of the table; got {row!r}")
    number = int(number)
    if not 0 <= number < run.simulations:
        raise IndexError(f"row {number} is not in the table of {run.simulations} simulations")
    if number not in failing.index:
        entry = run.table.all.iloc[number]
        some = ", ".join(map(str, failing.index[:5]))
        raise ValueError(
            f"row {number} is no counterexample: status {entry['status']}, robustness "
            f"{entry['rho']:.4g}; counterexamples are {some}{', ...' * (len(failing) > 5)}"
        )
    return number, failing.loc[number]


def _others(run: Run, nominal: Nominal, number: int) -> Float[np.ndarray, "n d"]:
    """Other counterexamples: the nearest, and some of all the rest."""
    failing = run.table.counterexamples
    failing = failing.loc[failing.index != number]
    if not len(failing):
        return np.zeros((0, nominal.space.dim), np.float32)
    if len(failing) > 4096:
        failing = failing.iloc[np.linspace(0, len(failing) - 1, 4096).astype(int)]
    points = nominal.settle(units(nominal.space, failing))
    order = np.argsort(nominal.distance(points))
    if len(order) > STARTS:
        half = STARTS // 2
        rest = np.linspace(half, len(order) - 1, STARTS - half).astype(int)
        order = np.concatenate([order[:half], order[rest]])
    return points[order]


def _columns(problem: Problem, u: Float[np.ndarray, " d"]) -> dict[str, Any]:
    """The row of a table with the features at this point."""
    features = jax.tree.map(
        lambda leaf: np.asarray(leaf)[None], jax.jit(problem.space.unflatten)(u)
    )
    return {name: column[0] for name, column in problem.space.rows(features).items()}


def _changed(nominal: Nominal, u: Float[np.ndarray, " d"]) -> dict[str, tuple[Any, Any]]:
    """What departs, by coordinate: its nominal value and that at `u`."""
    pair = jax.jit(jax.vmap(nominal.space.unflatten))(np.stack([nominal.u, u]))
    columns = nominal.space.rows(pair)
    names = list(columns) if len(columns) == len(u) else []
    changed = {}
    for i in np.flatnonzero(nominal.departs(u[None])[0]):
        name = nominal.names[i]
        column = columns.get(name)
        if column is None and names:
            column = columns[names[i]]
        values = (nominal.u[i], u[i]) if column is None else column
        changed[name] = (_plain(values[0]), _plain(values[1]))
    return changed


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _of(count: int, d: int) -> str:
    return f"{count} of {d} features" if d != 1 else "its one feature"


def _shown(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
